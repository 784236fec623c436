// Not run, not compiled: needs Xcode. tests/test_frames.py runs the same formula in Python.
// Where an ARKit session (or ARCore's for iOS, which has the same camera axes) has a scene of splatfix.
import ARKit
import simd

struct SplatfixResult: Decodable {
    struct Transform: Decodable { let matrix: [[Double]] }
    struct Axes: Decodable { let world_from_camera: Transform }
    struct Pose: Decodable { let opengl: Axes }
    let status: String, reason: String, hint: String, pose: Pose
}

struct SplatfixJob: Decodable { let id: String, state: String, result: SplatfixResult? }

struct SplatfixSession {
    let url: URL, key: String, scene: String, metresPerUnit: Float

    /// The transform of the node that holds the scene's content; nil if the photo was not localized.
    /// The sensor's image is sent as it is, with the intrinsics that ARKit gives for it.
    func sessionFromScene(_ frame: ARFrame) async throws -> simd_float4x4? {
        let k = frame.camera.intrinsics, size = frame.camera.imageResolution
        let pixel: Float = 0.5  // ARKit has the centre of the first pixel at (0, 0)
        let intrinsics = """
            {"width": \(Int(size.width)), "height": \(Int(size.height)), "fx": \(k[0][0]), "fy": \(k[1][1]), \
            "cx": \(k[2][0] + pixel), "cy": \(k[2][1] + pixel)}
            """
        let image = CIImage(cvPixelBuffer: frame.capturedImage)
        guard let jpeg = CIContext().jpegRepresentation(of: image, colorSpace: CGColorSpaceCreateDeviceRGB()) else { return nil }
        let job = try await localize(jpeg, ["scene": scene, "intrinsics": intrinsics])
        guard let result = job.result, result.status == "localized" else { return nil }
        return Self.sessionFromScene(frame.camera.transform, result.pose.opengl.world_from_camera.matrix, metresPerUnit)
    }

    /// `sessionFromCamera`: `ARCamera.transform`. `worldFromCamera`: of `pose.opengl`, row by row.
    static func sessionFromScene(
        _ sessionFromCamera: simd_float4x4, _ worldFromCamera: [[Double]], _ metresPerUnit: Float
    ) -> simd_float4x4 {
        var metric = simd_float4x4(rows: worldFromCamera.map { SIMD4<Float>($0.map(Float.init)) })
        metric.columns.3 *= SIMD4<Float>(metresPerUnit, metresPerUnit, metresPerUnit, 1)
        let scale = simd_float4x4(diagonal: SIMD4<Float>(metresPerUnit, metresPerUnit, metresPerUnit, 1))
        return sessionFromCamera * metric.inverse * scale
    }

    private func localize(_ jpeg: Data, _ fields: [String: String]) async throws -> SplatfixJob {
        let boundary = UUID().uuidString
        var body = Data()
        for (name, value) in fields {
            body += Data("--\(boundary)\r\nContent-Disposition: form-data; name=\"\(name)\"\r\n\r\n\(value)\r\n".utf8)
        }
        body += Data("--\(boundary)\r\nContent-Disposition: form-data; name=\"photo\"; filename=\"photo.jpg\"\r\n".utf8)
        body += Data("Content-Type: image/jpeg\r\n\r\n".utf8) + jpeg + Data("\r\n--\(boundary)--\r\n".utf8)
        var request = self.request("localize")
        request.httpMethod = "POST"
        request.setValue("multipart/form-data; boundary=\(boundary)", forHTTPHeaderField: "Content-Type")
        request.setValue("wait=30", forHTTPHeaderField: "Prefer")
        request.httpBody = body
        var job = try await answer(request)
        while job.state == "queued" || job.state == "running" {
            try await Task.sleep(nanoseconds: 1_000_000_000)
            job = try await answer(self.request("jobs/\(job.id)"))
        }
        return job
    }

    private func request(_ path: String) -> URLRequest {
        var request = URLRequest(url: url.appendingPathComponent(path))
        if !key.isEmpty { request.setValue("Bearer \(key)", forHTTPHeaderField: "Authorization") }
        return request
    }

    private func answer(_ request: URLRequest) async throws -> SplatfixJob {
        let (data, response) = try await URLSession.shared.data(for: request)
        guard let http = response as? HTTPURLResponse, http.statusCode < 300 else {
            // A problem document: its `code` is stable.
            throw NSError(domain: "splatfix", code: 1, userInfo: [NSLocalizedDescriptionKey: String(decoding: data, as: UTF8.self)])
        }
        return try JSONDecoder().decode(SplatfixJob.self, from: data)
    }
}
