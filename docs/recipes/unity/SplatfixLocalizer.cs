// Not run, not compiled: needs Unity. tests/test_recipes.py runs the conversions in SplatfixPose.cs.
// Sends a photo to splatfix and moves `target` (a camera, or the origin of what it shows) to where it was taken.
using System;
using System.Collections;
using System.Collections.Generic;
using UnityEngine;
using UnityEngine.Networking;

public class SplatfixLocalizer : MonoBehaviour
{
    public string url = "http://127.0.0.1:8000";
    public string key = "";
    public string scene = "studio";
    public float metresPerUnit = 1f;
    public Camera target;

    // JsonUtility reads only the fields that are named here.
    [Serializable] class Transformation { public float[] quaternion_wxyz; }
    [Serializable] class Pose { public float[] position; public Transformation world_from_camera; }
    [Serializable] class Intrinsics { public float width, height, fx, fy, cx, cy; }
    [Serializable] class Result { public string status, reason, hint; public float score; public Pose pose; public Intrinsics intrinsics; }
    [Serializable] class Job { public string id, state; public Result result; }
    [Serializable] class Problem { public string code, detail, hint; }

    /// <summary>`jpeg`: the upright photo. `intrinsics`: JSON as docs/api.md has it, or empty if they are not known.</summary>
    public IEnumerator Localize(byte[] jpeg, string intrinsics = "")
    {
        var form = new List<IMultipartFormSection>
        {
            new MultipartFormFileSection("photo", jpeg, "photo.jpg", "image/jpeg"),
            new MultipartFormDataSection("scene", scene),
        };
        if (intrinsics != "") form.Add(new MultipartFormDataSection("intrinsics", intrinsics));
        var request = UnityWebRequest.Post(url + "/localize", form);
        request.SetRequestHeader("Prefer", "wait=30");
        Job job = null;
        while (true)
        {
            if (key != "") request.SetRequestHeader("Authorization", "Bearer " + key);
            yield return request.SendWebRequest();
            if (request.result != UnityWebRequest.Result.Success)
            {
                string body = request.downloadHandler?.text ?? "";
                var problem = body.StartsWith("{") ? JsonUtility.FromJson<Problem>(body) : null;
                Debug.LogError(problem != null ? $"{problem.code}: {problem.detail} {problem.hint}" : request.error);
                yield break;
            }
            job = JsonUtility.FromJson<Job>(request.downloadHandler.text);
            if (job.state != "queued" && job.state != "running") break;
            yield return new WaitForSeconds(1);
            request = UnityWebRequest.Get($"{url}/jobs/{job.id}");
        }
        if (job.state == "succeeded" && job.result.status == "localized") Apply(job.result);
        else Debug.LogWarning($"{job.state} {job.result?.status}: {job.result?.reason} {job.result?.hint}");
    }

    void Apply(Result result)
    {
        target.transform.SetPositionAndRotation(
            SplatfixPose.Position(result.pose.position, metresPerUnit),
            SplatfixPose.Rotation(result.pose.world_from_camera.quaternion_wxyz));
        var k = result.intrinsics;
        target.projectionMatrix = SplatfixPose.Projection(
            k.width, k.height, k.fx, k.fy, k.cx, k.cy, target.nearClipPlane, target.farClipPlane);
    }
}
