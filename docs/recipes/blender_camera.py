"""`blender scene.blend --python blender_camera.py -- job.json photo.jpg`: adds the camera of a job, with its photo.

`job.json` is the answer of GET /jobs/{id}. Of a sequence the camera moves, a frame for each photo.
"""

import itertools
import json
import sys

import bpy
from mathutils import Matrix

OPENGL = Matrix.Diagonal((1, -1, -1, 1))
"""Blender's cameras look along -z and have y up."""


def add_camera(result, plate=""):
    """Return the camera object of a result; `plate` is an image or a video behind the scene."""
    k = result["intrinsics"]
    data = bpy.data.cameras.new("splatfix")
    data.sensor_fit, data.sensor_width = "HORIZONTAL", 36.0
    data.lens = 36.0 * k["fx"] / k["width"]
    data.shift_x = (k["width"] / 2 - k["cx"]) / k["width"]
    data.shift_y = (k["cy"] - k["height"] / 2) / k["width"] * k["fx"] / k["fy"]
    camera = bpy.data.objects.new("splatfix", data)
    render = bpy.context.scene.render
    render.resolution_x, render.resolution_y, render.resolution_percentage = k["width"], k["height"], 100
    # A camera whose fx and fy differ has pixels that are not square.
    render.pixel_aspect_x, render.pixel_aspect_y = max(1.0, k["fy"] / k["fx"]), max(1.0, k["fx"] / k["fy"])
    bpy.context.scene.collection.objects.link(camera)
    bpy.context.scene.camera = camera
    move(camera, result)
    if plate:
        add_plate(data, plate)
    return camera


def move(camera, result):
    """Give the camera its pose, or a key for each localized photo of a sequence."""
    frames = [f for f in result.get("frames") or () if f["status"] == "localized"]
    if not frames:
        camera.matrix_world = Matrix(result["pose"]["world_from_camera"]["matrix"]) @ OPENGL
        return
    scene, times = bpy.context.scene, [f["time_s"] for f in result["frames"]]
    # The frame rate is that of the photos: a frame is a photo.
    gaps = sorted(b - a for a, b in itertools.pairwise(times))
    rate = 1 / gaps[len(gaps) // 2] if gaps and gaps[0] > 0 else 24.0
    scene.render.fps, scene.render.fps_base = round(rate), round(rate) / rate
    scene.frame_start, scene.frame_end = 0, len(times) - 1
    camera.rotation_mode = "QUATERNION"
    for f in frames:
        camera.matrix_world = Matrix(f["world_from_camera"]["matrix"]) @ OPENGL
        camera.keyframe_insert("location", frame=f["index"])
        camera.keyframe_insert("rotation_quaternion", frame=f["index"])


def add_plate(data, path):
    """Show the photo, or the video, behind what the camera sees."""
    background = data.background_images.new()
    background.image = bpy.data.images.load(path)
    if background.image.source == "MOVIE":
        background.image_user.frame_duration = background.image.frame_duration
    background.frame_method, background.alpha = "FIT", 0.5
    data.show_background_images = True


if __name__ == "__main__" and "--" in sys.argv:
    job, *plate = sys.argv[sys.argv.index("--") + 1 :]
    with open(job, encoding="utf-8") as file:
        add_camera(json.load(file)["result"], *plate[:1])
