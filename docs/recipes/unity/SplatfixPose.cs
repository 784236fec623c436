// Poses of splatfix in Unity: left-handed, y up, metres, a camera looks along +z.
// For a scene whose world has z up (else give its scene.json a `world_from_scene`, see docs/scenes.md).
using UnityEngine;

public static class SplatfixPose
{
    /// <summary>A point of the scene's world in Unity: (x, y, z) becomes (x, z, y).</summary>
    public static Vector3 Point(Vector3 world, float metresPerUnit = 1f)
    {
        return new Vector3(world.x, world.z, world.y) * metresPerUnit;
    }

    /// <summary>`Transform.position` from `result.pose.position`.</summary>
    public static Vector3 Position(float[] position, float metresPerUnit = 1f)
    {
        return Point(new Vector3(position[0], position[1], position[2]), metresPerUnit);
    }

    /// <summary>`Transform.rotation` from `result.pose.world_from_camera.quaternion_wxyz`.</summary>
    public static Quaternion Rotation(float[] wxyz)
    {
        float w = wxyz[0], x = wxyz[1], y = wxyz[2], z = wxyz[3];
        // The camera's z axis, which looks forward, and its y axis, which points down, in the world.
        Vector3 forward = new Vector3(2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y));
        Vector3 down = new Vector3(2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x));
        return Quaternion.LookRotation(Point(forward), Point(down) * -1f);
    }

    /// <summary>`Camera.projectionMatrix` is wider than `fieldOfView`: it keeps fx, fy and the principal point.</summary>
    public static Matrix4x4 Projection(float width, float height, float fx, float fy, float cx, float cy, float near, float far)
    {
        Matrix4x4 p = new Matrix4x4();  // OpenGL's, as Unity has it on every platform
        p.m00 = 2 * fx / width;
        p.m11 = 2 * fy / height;
        p.m02 = 1 - 2 * cx / width;
        p.m12 = 2 * cy / height - 1;
        p.m22 = -(far + near) / (far - near);
        p.m23 = -2 * far * near / (far - near);
        p.m32 = -1;
        return p;
    }
}
