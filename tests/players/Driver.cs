// Writes means and rotations of a file at a second as float32: what tests compare.

using System;
using System.Globalization;
using System.IO;
using ScgsWarp;

static class Driver
{
    static void Main(string[] arguments)
    {
        var splats = new SkinnedSplats(File.ReadAllBytes(arguments[0]));
        splats.At(float.Parse(arguments[1], CultureInfo.InvariantCulture));
        using (var writer = new BinaryWriter(File.Create(arguments[2])))
        {
            foreach (float value in splats.Means) writer.Write(value);
            foreach (float value in splats.Rotations) writer.Write(value);
        }
        Console.WriteLine(splats.Duration.ToString(CultureInfo.InvariantCulture) + " " + string.Join(",", splats.Names));
    }
}
