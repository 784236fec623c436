"""Make the photos of the demo scene "studio".

Models a furnished workshop room of 5 x 4 x 2.7 m (room.py, furniture.py, objects.py, decor.py; all
geometry and all textures are made here, nothing is borrowed), path-traces it with Blender's
Cycles on the CPU, and writes to the `--out` folder

    train/0000.png ...        120 photos at 640 x 480 that cover the room
    heldout_original/*.png    16 photos from poses between the training poses, upright
    photos/*.jpg              the same 16 as they are sent to the service: 3 with another exposure,
                              3 partly occluded, 2 wide-angle, 2 stored turned with an EXIF tag
    transforms.json           all poses in nerfstudio's layout
    truth.json                poses and intrinsics of photos/*.jpg, OpenCV axes, upright image
    points.npy                240,000 coloured surface points to start training from

Needs Python 3.11 with bpy 5.0, numpy below 2 and Pillow. A photo takes 10 to 15 s on two idle
cores, everything about half an hour. Photos that are there are kept, so an interrupted run goes
on where it stopped.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import bpy
import cameras
import furniture
import numpy as np
import outputs
import room
import shapes
from cameras import View
from mathutils import Matrix

SEED = 7
TRAINING = 120
# Per pixel, before denoising.
SAMPLES = {"train": 16, "heldout_original": 24}
MODIFICATIONS = (
    "none", "exposure", "wide", "occlusion", "none", "portrait", "none", "exposure",
    "occlusion", "none", "wide", "none", "exposure", "portrait", "occlusion", "none",
)  # fmt: skip


def model() -> None:
    """Build the room in an empty Blender scene."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    rng = np.random.default_rng(SEED)
    room.build(rng)
    furniture.build(rng)
    shapes.merge(spare=room.OUTSIDE)


def set_up_renderer() -> bpy.types.Object:
    """Set up path tracing on the CPU with few samples and a denoiser; return the camera."""
    scene = bpy.context.scene
    scene.render.engine = "CYCLES"
    cycles = scene.cycles
    cycles.device = "CPU"
    cycles.use_denoising = True
    cycles.denoiser = "OPENIMAGEDENOISE"
    cycles.denoising_prefilter = "FAST"
    cycles.max_bounces = 4
    cycles.diffuse_bounces = 2
    cycles.glossy_bounces = 2
    cycles.transmission_bounces = 0
    cycles.transparent_max_bounces = 2
    cycles.caustics_reflective = cycles.caustics_refractive = False
    cycles.sample_clamp_indirect = 3.0  # no fireflies
    scene.render.use_persistent_data = True  # geometry and textures are set up once
    scene.view_settings.view_transform = "Standard"
    scene.view_settings.look = "None"
    scene.view_settings.exposure = 0.0
    scene.view_settings.gamma = 1.0
    scene.render.image_settings.file_format = "PNG"
    scene.render.image_settings.color_mode = "RGB"
    scene.render.image_settings.color_depth = "8"
    data = bpy.data.cameras.new("camera")
    data.clip_start = 0.02
    camera = bpy.data.objects.new("camera", data)
    scene.collection.objects.link(camera)
    scene.camera = camera
    return camera


@contextmanager
def quiet() -> Iterator[None]:
    """Discard what Blender's C code prints, which would interleave with the progress lines."""
    sys.stdout.flush()
    kept = os.dup(1)
    with open(os.devnull, "w") as sink:
        os.dup2(sink.fileno(), 1)
    try:
        yield
    finally:
        os.dup2(kept, 1)
        os.close(kept)


def take(view: View, target: Path, camera: bpy.types.Object, samples: int) -> None:
    """Render one upright photo with so many samples a pixel; the file appears only when it is complete."""
    scene = bpy.context.scene
    upright = view.height > view.width
    camera.data.sensor_fit = "VERTICAL" if upright else "HORIZONTAL"
    camera.data.sensor_width = camera.data.sensor_height = 36.0
    camera.data.lens = view.lens
    camera.matrix_world = Matrix(view.pose.tolist())
    scene.render.resolution_x, scene.render.resolution_y = view.width, view.height
    scene.render.resolution_percentage = 100
    scene.cycles.samples = samples
    partial = target.with_name(f"_{target.name}")
    scene.render.filepath = str(partial)
    with quiet():
        bpy.ops.render.render(write_still=True)
    os.replace(partial, target)


def take_all(jobs: list[tuple[View, Path]], camera: bpy.types.Object) -> None:
    """Render the photos that don't exist yet, with a progress line for each."""
    missing = [(view, path) for view, path in jobs if not path.exists()]
    print(f"{len(jobs) - len(missing)} photos are there, {len(missing)} to take", flush=True)
    start = time.monotonic()
    for k, (view, path) in enumerate(missing, 1):
        before = time.monotonic()
        take(view, path, camera, SAMPLES[path.parent.name])
        now = time.monotonic()
        left = (now - start) / k * (len(missing) - k)
        print(
            f"{path.parent.name}/{path.name} {now - before:.1f} s, {k}/{len(missing)}, {left / 60:.1f} min left",
            flush=True,
        )


def lens_of(modification: str) -> tuple[int, int, float]:
    """Return upright width and height (px) and focal length of a held-out photo."""
    if modification == "portrait":
        return cameras.SHORT_SIDE, cameras.LONG_SIDE, cameras.LENS
    lens = cameras.WIDE_LENS if modification == "wide" else cameras.LENS
    return cameras.LONG_SIDE, cameras.SHORT_SIDE, lens


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description="Make the photos of the studio scene.")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "build", help="work folder")
    parser.add_argument("--only", choices=("all", "train", "heldout"), default="all")
    options = parser.parse_args()
    out: Path = options.out
    start = time.monotonic()
    model()
    camera = set_up_renderer()
    space = cameras.Room()
    rng = np.random.default_rng(SEED + 1)
    training = cameras.training_views(space, rng, TRAINING)
    heldout = cameras.heldout_views(space, rng, training, [lens_of(m) for m in MODIFICATIONS])
    print(f"modelled and planned in {time.monotonic() - start:.0f} s", flush=True)
    for folder in ("train", "heldout_original", "photos"):
        (out / folder).mkdir(parents=True, exist_ok=True)
    jobs = []
    if options.only != "train":
        jobs += [(view, out / "heldout_original" / f"{view.name}.png") for view in heldout]
    if options.only != "heldout":
        jobs += [(view, out / "train" / f"{view.name}.png") for view in training]
    take_all(jobs, camera)
    outputs.write_transforms(out, training, heldout)
    if options.only != "train":
        outputs.write_heldout(out, heldout, MODIFICATIONS)
    if options.only != "heldout":
        points = outputs.write_points(out, space, training, np.random.default_rng(SEED + 2))
        outputs.check_poses(out, space, training, points)


if __name__ == "__main__":
    main()
