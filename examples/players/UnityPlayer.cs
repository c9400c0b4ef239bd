// Plays a skinned .glb in Unity, drawn by the package gsplat-unity (https://github.com/wuyize25/gsplat-unity, MIT, read at
// version 1.3). Put both scripts of this folder into Assets, the .glb into Assets/StreamingAssets, and this component
// beside a GsplatRenderer whose asset is empty.

using System.IO;
using Gsplat;
using UnityEngine;

namespace ScgsWarp
{
    [RequireComponent(typeof(GsplatRenderer))]
    public sealed class UnityPlayer : MonoBehaviour
    {
        const float ShC0 = 0.28209479f;

        [Tooltip("Name of the file in Assets/StreamingAssets")]
        public string File = "scene.glb";
        public float Speed = 1f;
        public bool Loop = true;

        SkinnedSplats splats;
        GsplatRenderer shown;
        GsplatAssetUncompressed asset;
        float seconds;

        void Start()
        {
            splats = new SkinnedSplats(System.IO.File.ReadAllBytes(Path.Combine(Application.streamingAssetsPath, File)));
            asset = ScriptableObject.CreateInstance<GsplatAssetUncompressed>();
            asset.SplatCount = (uint)splats.Count;
            asset.SHBands = 0;
            asset.Allocate();
            for (int n = 0; n < splats.Count; n++)
            {
                asset.Scales[n] = new Vector3(splats.Scales[3 * n], splats.Scales[3 * n + 1], splats.Scales[3 * n + 2]);
                asset.Colors[n] = new Vector4(Harmonic(3 * n), Harmonic(3 * n + 1), Harmonic(3 * n + 2), splats.Opacities[n]);
            }
            Pose();
            shown = GetComponent<GsplatRenderer>();
            shown.GsplatAsset = asset;
        }

        void Update()
        {
            seconds += Speed * Time.deltaTime;
            seconds = Loop && splats.Duration > 0 ? Mathf.Repeat(seconds, splats.Duration) : Mathf.Min(seconds, splats.Duration);
            Pose();
            if (!(shown.GsplatResource is GsplatResourceUncompressed buffers)) return; // not uploaded yet
            buffers.PositionBuffer.SetData(asset.Positions);
            buffers.RotationBuffer.SetData(asset.Rotations);
        }

        // Unity is left-handed: x changes its sign, and with it the sense of rotations about y and z.
        void Pose()
        {
            splats.At(seconds);
            float[] means = splats.Means, turns = splats.Rotations;
            for (int n = 0; n < splats.Count; n++)
            {
                asset.Positions[n] = new Vector3(-means[3 * n], means[3 * n + 1], means[3 * n + 2]);
                asset.Rotations[n] = new Vector4(turns[4 * n + 3], turns[4 * n], -turns[4 * n + 1], -turns[4 * n + 2]);
            }
            var low = asset.Positions[0];
            var high = low;
            foreach (var position in asset.Positions)
            {
                low = Vector3.Min(low, position);
                high = Vector3.Max(high, position);
            }
            asset.Bounds.SetMinMax(low, high);
        }

        float Harmonic(int index) => (splats.Colors[index] - 0.5f) / ShC0;

        void OnDestroy()
        {
            if (asset != null) Destroy(asset);
        }
    }
}
