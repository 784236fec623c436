// What the recipe for Unity uses of UnityEngine, by Unity's documentation: left-handed, a quaternion turns by q v q*.
// Prints the pixel of the golden case: position, quaternion_wxyz, size, fx fy cx cy, point.
using System;
using System.Globalization;
using System.Linq;

namespace UnityEngine
{
    public struct Vector3
    {
        public float x, y, z;
        public Vector3(float x, float y, float z) { this.x = x; this.y = y; this.z = z; }
        public static Vector3 operator *(Vector3 v, float s) { return new Vector3(v.x * s, v.y * s, v.z * s); }
        public static Vector3 operator -(Vector3 a, Vector3 b) { return new Vector3(a.x - b.x, a.y - b.y, a.z - b.z); }
        public static float Dot(Vector3 a, Vector3 b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
    }

    public struct Quaternion
    {
        public Vector3 right, up, forward;  // the axes after the rotation are all that is asked for here
        public static Quaternion LookRotation(Vector3 forward, Vector3 upwards)
        {
            var q = new Quaternion { forward = forward * (1 / (float)Math.Sqrt(Vector3.Dot(forward, forward))) };
            var up = upwards - q.forward * Vector3.Dot(upwards, q.forward);
            q.up = up * (1 / (float)Math.Sqrt(Vector3.Dot(up, up)));
            // Left-handed: x = y cross z, by the same formula.
            q.right = new Vector3(q.up.y * q.forward.z - q.up.z * q.forward.y, q.up.z * q.forward.x - q.up.x * q.forward.z,
                                  q.up.x * q.forward.y - q.up.y * q.forward.x);
            return q;
        }
    }

    public struct Matrix4x4 { public float m00, m02, m11, m12, m22, m23, m32; }
}

public static class Golden
{
    public static void Main(string[] arguments)
    {
        var n = arguments.Select(a => float.Parse(a, CultureInfo.InvariantCulture)).ToArray();
        var position = SplatfixPose.Position(n.Take(3).ToArray());
        var rotation = SplatfixPose.Rotation(n.Skip(3).Take(4).ToArray());
        var p = SplatfixPose.Projection(n[7], n[8], n[9], n[10], n[11], n[12], 0.1f, 100f);
        var point = SplatfixPose.Point(new UnityEngine.Vector3(n[13], n[14], n[15])) - position;
        float right = UnityEngine.Vector3.Dot(point, rotation.right), up = UnityEngine.Vector3.Dot(point, rotation.up);
        float back = -UnityEngine.Vector3.Dot(point, rotation.forward);  // Unity's view space is OpenGL's
        float w = p.m32 * back, x = (p.m00 * right + p.m02 * back) / w, y = (p.m11 * up + p.m12 * back) / w;
        float z = (p.m22 * back + p.m23) / w;
        Console.WriteLine(string.Format(CultureInfo.InvariantCulture, "{0} {1} {2}", (x + 1) / 2 * n[7], (1 - y) / 2 * n[8], z));
    }
}
