// Gaussians of a skinned .glb at any second of its animation; plain C# without Unity, so that it can be tested alone.
// World axes are glTF's: y up, right-handed. Rotations are quaternions x, y, z, w.

using System;
using System.Collections.Generic;
using System.Globalization;
using System.IO;
using System.Text;

namespace ScgsWarp
{
    using Json = Dictionary<string, object>;

    public sealed class SkinnedSplats
    {
        const string Extension = "KHR_gaussian_splatting";
        const float ShC0 = 0.28209479f;

        public readonly int Count;
        public readonly float[] Scales, Colors, Opacities; // 3, 3 (sRGB) and 1 numbers for each Gaussian
        public readonly float[] Means, Rotations; // 3 and 4 numbers; At(seconds) fills them
        public readonly string[] Names; // of the joints
        public readonly float Duration;

        readonly Json gltf;
        readonly byte[] data;
        readonly int blob;
        readonly float[] rest, quats, seconds;
        readonly float[][] weights; // of each set of four
        readonly int[][] joints;
        readonly float[] bind;
        readonly List<object> nodes, skinned;
        readonly Dictionary<(int, string), float[]> tracks = new Dictionary<(int, string), float[]>();
        readonly float[] turns, places; // 4 and 3 numbers for each node, in the world

        public SkinnedSplats(byte[] file)
        {
            data = file;
            if (file.Length < 28 || BitConverter.ToUInt32(file, 0) != 0x46546C67)
                throw new InvalidDataException("no binary glTF");
            int size = BitConverter.ToInt32(file, 12);
            gltf = (Json)new JsonReader(Encoding.UTF8.GetString(file, 20, size)).Read();
            blob = 28 + size;
            var mesh = (Json)((List<object>)gltf["meshes"])[0];
            var primitive = (Json)((List<object>)mesh["primitives"])[0];
            var attributes = (Json)primitive["attributes"];
            rest = Floats(attributes["POSITION"]);
            quats = Floats(attributes[Extension + ":ROTATION"]);
            Scales = Floats(attributes[Extension + ":SCALE"]);
            Opacities = Floats(attributes[Extension + ":OPACITY"]);
            Colors = Floats(attributes[Extension + ":SH_DEGREE_0_COEF_0"]);
            for (int i = 0; i < Colors.Length; i++)
                Colors[i] = Math.Min(1f, Math.Max(0f, 0.5f + ShC0 * Colors[i]));
            Count = rest.Length / 3;
            Means = new float[3 * Count];
            Rotations = new float[4 * Count];

            int sets = 0;
            while (attributes.ContainsKey("JOINTS_" + sets)) sets++;
            joints = new int[sets][];
            weights = new float[sets][];
            for (int set = 0; set < sets; set++)
            {
                joints[set] = Array.ConvertAll(Floats(attributes["JOINTS_" + set]), value => (int)value);
                weights[set] = Floats(attributes["WEIGHTS_" + set]);
            }

            nodes = (List<object>)gltf["nodes"];
            var skin = (Json)((List<object>)gltf["skins"])[0];
            skinned = (List<object>)skin["joints"];
            bind = Floats(skin["inverseBindMatrices"]);
            Names = new string[skinned.Count];
            for (int i = 0; i < Names.Length; i++)
                Names[i] = (string)((Json)nodes[Int(skinned[i])])["name"];
            turns = new float[4 * nodes.Count];
            places = new float[3 * nodes.Count];

            seconds = new float[1];
            if (!gltf.ContainsKey("animations")) return;
            var animation = (Json)((List<object>)gltf["animations"])[0];
            var samplers = (List<object>)animation["samplers"];
            seconds = Floats(((Json)samplers[0])["input"]);
            Duration = seconds[seconds.Length - 1];
            foreach (Json channel in (List<object>)animation["channels"])
            {
                var target = (Json)channel["target"];
                var sampler = (Json)samplers[Int(channel["sampler"])];
                tracks[(Int(target["node"]), (string)target["path"])] = Floats(sampler["output"]);
            }
        }

        /// Pose all Gaussians: fill Means and Rotations.
        public void At(float time)
        {
            PoseJoints(time);
            var turn = new float[4];
            for (int n = 0; n < Count; n++)
            {
                float x = 0, y = 0, z = 0;
                Array.Clear(turn, 0, 4);
                int first = -1;
                for (int set = 0; set < joints.Length; set++)
                for (int k = 0; k < 4; k++)
                {
                    float share = weights[set][4 * n + k];
                    if (share <= 0) continue;
                    int slot = joints[set][4 * n + k], node = Int(skinned[slot]), q = 4 * node;
                    Rotate(turns, q, rest[3 * n] + bind[16 * slot + 12], rest[3 * n + 1] + bind[16 * slot + 13],
                        rest[3 * n + 2] + bind[16 * slot + 14], out float mx, out float my, out float mz);
                    x += share * (mx + places[3 * node]);
                    y += share * (my + places[3 * node + 1]);
                    z += share * (mz + places[3 * node + 2]);
                    if (first < 0) first = q;
                    float side = 0; // of the sphere of rotations, relative to the first joint
                    for (int c = 0; c < 4; c++) side += turns[q + c] * turns[first + c];
                    float signed = side < 0 ? -share : share;
                    for (int c = 0; c < 4; c++) turn[c] += signed * turns[q + c];
                }
                Means[3 * n] = x;
                Means[3 * n + 1] = y;
                Means[3 * n + 2] = z;
                Multiply(turn, 0, quats, 4 * n, Rotations, 4 * n);
                Normalise(Rotations, 4 * n);
            }
        }

        void PoseJoints(float time)
        {
            int low = 0;
            while (low + 1 < seconds.Length && seconds[low + 1] <= time) low++;
            int high = Math.Min(low + 1, seconds.Length - 1);
            float span = seconds[high] - seconds[low];
            float part = span > 0 ? Math.Min(1f, Math.Max(0f, (time - seconds[low]) / span)) : 0f;
            var scene = (Json)((List<object>)gltf["scenes"])[0];
            foreach (object node in (List<object>)scene["nodes"])
                PoseNode(Int(node), new float[] { 0, 0, 0, 1 }, 0, new float[3], 0, low, high, part);
        }

        void PoseNode(int node, float[] above, int q, float[] place, int p, int low, int high, float part)
        {
            var own = Local(node, "rotation", new float[] { 0, 0, 0, 1 }, low, high, part);
            var shift = Local(node, "translation", new float[3], low, high, part);
            Normalise(own, 0);
            Rotate(above, q, shift[0], shift[1], shift[2], out float x, out float y, out float z);
            places[3 * node] = place[p] + x;
            places[3 * node + 1] = place[p + 1] + y;
            places[3 * node + 2] = place[p + 2] + z;
            Multiply(above, q, own, 0, turns, 4 * node);
            if (((Json)nodes[node]).TryGetValue("children", out object children))
                foreach (object child in (List<object>)children)
                    PoseNode(Int(child), turns, 4 * node, places, 3 * node, low, high, part);
        }

        float[] Local(int node, string path, float[] otherwise, int low, int high, float part)
        {
            int width = otherwise.Length;
            var found = new float[width];
            if (tracks.TryGetValue((node, path), out float[] track))
                for (int c = 0; c < width; c++)
                    found[c] = track[width * low + c] + part * (track[width * high + c] - track[width * low + c]);
            else if (((Json)nodes[node]).TryGetValue(path, out object still))
                for (int c = 0; c < width; c++)
                    found[c] = Convert.ToSingle(((List<object>)still)[c]);
            else
                otherwise.CopyTo(found, 0);
            return found;
        }

        float[] Floats(object index)
        {
            var accessor = (Json)((List<object>)gltf["accessors"])[Int(index)];
            var view = (Json)((List<object>)gltf["bufferViews"])[Int(accessor["bufferView"])];
            string kind = (string)accessor["type"];
            int width = kind == "SCALAR" ? 1 : kind == "MAT4" ? 16 : kind[3] - '0';
            int start = blob + Offset(view) + Offset(accessor), component = Int(accessor["componentType"]);
            var values = new float[width * Int(accessor["count"])];
            for (int i = 0; i < values.Length; i++)
                values[i] = component == 5126 ? BitConverter.ToSingle(data, start + 4 * i)
                    : component == 5123 ? BitConverter.ToUInt16(data, start + 2 * i)
                    : component == 5121 ? data[start + i]
                    : throw new InvalidDataException("component type " + component);
            return values;
        }

        static int Offset(Json item) => item.TryGetValue("byteOffset", out object offset) ? Int(offset) : 0;

        static int Int(object number) => Convert.ToInt32(number);

        static void Normalise(float[] q, int i)
        {
            double size = 0;
            for (int c = 0; c < 4; c++) size += (double)q[i + c] * q[i + c];
            float scale = size > 0 ? (float)(1 / Math.Sqrt(size)) : 0f;
            for (int c = 0; c < 4; c++) q[i + c] *= scale;
        }

        static void Multiply(float[] a, int i, float[] b, int j, float[] result, int k)
        {
            float ax = a[i], ay = a[i + 1], az = a[i + 2], aw = a[i + 3];
            float bx = b[j], by = b[j + 1], bz = b[j + 2], bw = b[j + 3];
            result[k] = aw * bx + bw * ax + ay * bz - az * by;
            result[k + 1] = aw * by + bw * ay + az * bx - ax * bz;
            result[k + 2] = aw * bz + bw * az + ax * by - ay * bx;
            result[k + 3] = aw * bw - ax * bx - ay * by - az * bz;
        }

        static void Rotate(float[] q, int i, float x, float y, float z, out float rx, out float ry, out float rz)
        {
            float ux = q[i], uy = q[i + 1], uz = q[i + 2], w = q[i + 3];
            float cx = uy * z - uz * y + w * x, cy = uz * x - ux * z + w * y, cz = ux * y - uy * x + w * z;
            rx = x + 2 * (uy * cz - uz * cy);
            ry = y + 2 * (uz * cx - ux * cz);
            rz = z + 2 * (ux * cy - uy * cx);
        }
    }

    /// Reader of JSON: objects as Dictionary, arrays as List, numbers as double, texts as string.
    sealed class JsonReader
    {
        readonly string text;
        int at;

        public JsonReader(string text) { this.text = text; }

        public object Read()
        {
            char next = Peek();
            if (next == '{') return ReadObject();
            if (next == '[') return ReadArray();
            if (next == '"') return ReadText();
            int start = at;
            while (at < text.Length && ",]} \t\r\n".IndexOf(text[at]) < 0) at++;
            string word = text.Substring(start, at - start);
            if (word == "true" || word == "false") return word == "true";
            return word == "null" ? (object)null : double.Parse(word, CultureInfo.InvariantCulture);
        }

        Json ReadObject()
        {
            var found = new Json();
            for (at++; Peek() != '}';)
            {
                string name = ReadText();
                Expect(':');
                found[name] = Read();
                if (Peek() == ',') at++;
            }
            at++;
            return found;
        }

        List<object> ReadArray()
        {
            var found = new List<object>();
            for (at++; Peek() != ']';)
            {
                found.Add(Read());
                if (Peek() == ',') at++;
            }
            at++;
            return found;
        }

        string ReadText()
        {
            var found = new StringBuilder();
            Expect('"');
            for (; text[at] != '"'; at++)
            {
                if (text[at] != '\\') { found.Append(text[at]); continue; }
                at++;
                int escape = "bfnrt".IndexOf(text[at]);
                if (escape >= 0) found.Append("\b\f\n\r\t"[escape]);
                else if (text[at] != 'u') found.Append(text[at]);
                else
                {
                    found.Append((char)int.Parse(text.Substring(at + 1, 4), NumberStyles.HexNumber));
                    at += 4;
                }
            }
            at++;
            return found.ToString();
        }

        char Peek()
        {
            while (at < text.Length && char.IsWhiteSpace(text[at])) at++;
            if (at >= text.Length) throw new InvalidDataException("JSON ends early");
            return text[at];
        }

        void Expect(char wanted)
        {
            if (Peek() != wanted) throw new InvalidDataException("JSON: no " + wanted + " at " + at);
            at++;
        }
    }
}
