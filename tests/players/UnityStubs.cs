// The names of Unity and gsplat-unity that UnityPlayer.cs uses, with their signatures and without function, so that a
// compiler checks the script where there is no Unity.

using System;

namespace UnityEngine
{
    public class Object { public static void Destroy(Object item) { } }
    public class ScriptableObject : Object { public static T CreateInstance<T>() where T : ScriptableObject, new() => new T(); }
    public class MonoBehaviour : Object { public T GetComponent<T>() => default(T); }
    public sealed class RequireComponent : Attribute { public RequireComponent(Type type) { } }
    public sealed class TooltipAttribute : Attribute { public TooltipAttribute(string text) { } }
    public static class Application { public static string streamingAssetsPath => ""; }
    public static class Time { public static float deltaTime => 0f; }
    public static class Mathf
    {
        public static float Repeat(float value, float length) => value % length;
        public static float Min(float a, float b) => a < b ? a : b;
    }
    public struct Vector3
    {
        public Vector3(float x, float y, float z) { }
        public static Vector3 Min(Vector3 a, Vector3 b) => a;
        public static Vector3 Max(Vector3 a, Vector3 b) => a;
    }
    public struct Vector4 { public Vector4(float x, float y, float z, float w) { } }
    public struct Bounds { public void SetMinMax(Vector3 low, Vector3 high) { } }
    public class GraphicsBuffer { public void SetData(Array data) { } }
}

namespace Gsplat
{
    using UnityEngine;

    public class GsplatResource { }
    public class GsplatResourceUncompressed : GsplatResource
    {
        public GraphicsBuffer PositionBuffer { get; }
        public GraphicsBuffer RotationBuffer { get; }
    }
    public class GsplatAsset : ScriptableObject
    {
        public uint SplatCount;
        public byte SHBands;
        public Bounds Bounds;
    }
    public class GsplatAssetUncompressed : GsplatAsset
    {
        public Vector3[] Positions, Scales;
        public Vector4[] Colors, Rotations;
        public void Allocate() { }
    }
    public class GsplatRenderer : MonoBehaviour
    {
        public GsplatAsset GsplatAsset;
        public GsplatResource GsplatResource => null;
    }
}
