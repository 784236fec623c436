"""Photograph the studio on another day, from places far from the training cameras.

    python scenes/studio/another_day.py [--only night] [--count 24]

Writes `../studio_another_day/<condition>/`: photos, and a truth.json of their poses and intrinsics (OpenCV axes,
upright image). The conditions:

    same_light   as in the training photos
    evening      a low red sun; exposed for it
    night        one lamp; exposed for it, noise
    furniture    a third of the things moved, two new, one gone
    people       one to three people cover 14 to 40 % of the photo
    phone        a phone's lens, rolling shutter and processing (phone.py)

Needs what build.py needs. Renders are kept in `build/another_day/` as linear EXR files, and not made again.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import bpy
import build
import cameras
import conditions
import furniture
import numpy as np
import outputs
import people
import phone
import photos
import room
import shapes
from cameras import Room, View

Array = np.ndarray
Rng = np.random.Generator

HERE = Path(__file__).parent
SEED = 21
COUNT = 24
LONG_SIDE, SHORT_SIDE = 480, 360
LENS = 26.0  # 35 mm equivalent, the usual one of phones
SAMPLES = {"phone": 3}
"""Per pixel of the render, where it isn't 4; several of a phone's make one of the photo."""
QUALITY = 72
FAR = 0.35
"""Metres from every training camera."""
FAR_ALIKE, ALIKE_DEG = 0.8, 30.0
"""Metres from every training camera that looks in the same direction to so many degrees."""


def model(condition: str, rng: Rng) -> None:
    """Build the room as build.py does, with the condition's changes."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    same = np.random.default_rng(build.SEED)
    room.build(same)
    furniture.build(same)
    conditions.CHANGES[condition](rng)
    shapes.merge(spare=room.OUTSIDE)


def training_poses() -> Array:
    """Return the poses of the scene's training cameras, OpenGL axes."""
    transforms = json.loads((HERE / "transforms.json").read_text())
    return np.array([frame["transform_matrix"] for frame in transforms["frames"]])


def distances(pose: Array, training: Array) -> tuple[float, float]:
    """Return metres to the nearest training camera, and to the nearest one that looks in the same direction."""
    far = np.linalg.norm(training[:, :3, 3] - pose[:3, 3], axis=1)
    alike = training[:, :3, 2] @ pose[:3, 2] > np.cos(np.radians(ALIKE_DEG))
    return float(far.min()), float(far[alike].min(initial=np.inf))


def far_poses(space: Room, rng: Rng, training: Array, count: int) -> list[Array]:
    """Return poses in free space far from the training cameras and, the first ones most, from each other."""
    pool: list[Array] = []
    while len(pool) < 4 * count:
        pitch = float(np.clip(rng.normal(-0.15, 0.22), -0.8, 0.5))
        eye, yaw = cameras.free_position(space, rng), rng.random() * 2 * np.pi
        pose = cameras.look(eye, yaw, pitch, rng.normal() * 0.05)
        nearest, alike = distances(pose, training)
        candidate = View("candidate", LONG_SIDE, SHORT_SIDE, LENS, pose)
        if nearest >= FAR and FAR_ALIKE <= alike < np.inf and cameras.open_view(space, candidate):
            pool.append(pose)
    keys = np.array([np.concatenate([p[:3, 3], 1.2 * p[:3, 2]]) for p in pool])
    picks = [0]
    while len(picks) < count:
        gaps = np.linalg.norm(keys[:, None] - keys[picks][None], axis=2).min(axis=1)
        picks.append(int(np.argmax(gaps)))
    return [pool[pick] for pick in picks]


def view_of(condition: str, k: int, pose: Array) -> View:
    """Return the condition's photo number k; every fourth is upright."""
    size = (SHORT_SIDE, LONG_SIDE) if k % 4 == 3 else (LONG_SIDE, SHORT_SIDE)
    return View(f"{condition}_{k:02d}", *size, LENS, pose)


def rendered_view(view: View, condition: str) -> View:
    """Return the pinhole view to render for a photo: larger and finer where a lens is to distort it."""
    if condition != "phone":
        return view
    width, height = phone.pinhole_size(view.width, view.height)
    lens = view.focal * phone.DENSITY / max(width, height) * 36
    return replace(view, width=width, height=height, lens=lens)


def take(views: list[View], condition: str, work: Path, before: Callable[[int], None]) -> None:
    """Render what isn't there yet; `before` prepares the scene for photo number k."""
    camera = build.set_up_renderer()
    bpy.context.scene.render.image_settings.file_format = "OPEN_EXR"
    for k, view in enumerate(views):
        target = work / f"{view.name}.exr"
        if not target.exists():
            before(k)
            build.take(rendered_view(view, condition), target, camera, SAMPLES.get(condition, 4))
            print(f"{target.name}, {k + 1}/{len(views)}", flush=True)


def take_people(space: Room, rng: Rng, count: int, work: Path) -> tuple[list[View], list[dict]]:
    """Render photos with people, from the first far poses in which there is room for some; return views and shares."""
    gathering = people.Gathering(space, people.crowd(rng))
    views, places, told = [], [], []
    for pose in far_poses(space, rng, training_poses(), 3 * count):
        view = view_of("people", len(views), pose)
        arranged = gathering.arrange(view, rng)
        if arranged is not None:
            views.append(view)
            places.append(arranged[0])
            told.append({"covered": round(arranged[1], 3)})
        if len(views) == count:
            break
    if len(views) < count:
        raise RuntimeError(f"there is room for people in {len(views)} of {3 * count} views; choose another SEED")
    take(views, "people", work, lambda k: gathering.stand(places[k]))
    return views, told


def read_linear(path: Path) -> Array:
    """Return an EXR file's linear RGB, top row first."""
    image = bpy.data.images.load(str(path))
    width, height = image.size
    pixels = np.empty(width * height * 4, np.float32)
    image.pixels.foreach_get(pixels)
    bpy.data.images.remove(image)
    return pixels.reshape(height, width, 4)[::-1, :, :3].astype(np.float64)


def developed(view: View, condition: str, linear: Array, rng: Rng) -> tuple[Array, dict]:
    """Return the photo (sRGB 0..1) of a render, and what there is to tell of it."""
    if condition == "phone":
        turn = phone.hand_shake(rng)
        lens = phone.Lens(view.width, view.height, view.focal, phone.K1, turn)
        photo = phone.through_lens(linear, view.focal * phone.DENSITY, lens)
        degrees = [round(float(angle), 4) for angle in np.degrees(turn)]
        return phone.develop(photo, rng), {"turn_deg": degrees}
    if condition == "night":
        return phone.develop_dark(linear, rng), {}
    return phone.srgb(phone.metered(linear, 0.09) if condition == "evening" else linear), {}


def intrinsics(view: View, condition: str) -> dict:
    """Return the photo's true intrinsics as truth.json has them."""
    pinhole = {
        "width": view.width,
        "height": view.height,
        "fx": view.focal,
        "fy": view.focal,
        "cx": view.width / 2,
        "cy": view.height / 2,
    }
    return pinhole | ({"model": "SIMPLE_RADIAL", "distortion": [phone.K1]} if condition == "phone" else {})


def entries(views: list[View], condition: str, told: list[dict], work: Path, out: Path) -> Iterator[dict]:
    """Write the photos; yield their entries of truth.json."""
    training = training_poses()
    for k, (view, known) in enumerate(zip(views, told, strict=True)):
        rng = np.random.default_rng((SEED + 1, k))
        photo, more = developed(view, condition, read_linear(work / f"{view.name}.exr"), rng)
        orientation = (6, 8)[k // 4 % 2] if view.height > view.width else 1
        path = out / f"{view.name}.jpg"
        photos.write_jpeg(photo, view, orientation, path, QUALITY, subsampling=2, device="Another Day")
        nearest, alike = distances(view.pose, training)
        yield {
            "photo": path.name,
            "modification": condition,
            "intrinsics": intrinsics(view, condition),
            "world_from_camera": (view.pose @ outputs.OPENCV).tolist(),
            "nearest_training_camera_m": round(nearest, 3),
            "nearest_alike_m": round(alike, 3),
        } | known | more  # fmt: skip


def photograph(condition: str, count: int, work: Path, out: Path) -> None:
    """Make one condition's photos and truth.json."""
    for folder in (work, out):
        folder.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng((SEED, list(conditions.CHANGES).index(condition)))
    model(condition, rng)
    space = Room()
    if condition == "people":
        views, told = take_people(space, rng, count, work)
    else:
        poses = far_poses(space, rng, training_poses(), count)
        views, told = [view_of(condition, k, pose) for k, pose in enumerate(poses)], [{}] * count
        take(views, condition, work, lambda k: None)
    truth = list(entries(views, condition, told, work, out))
    (out / "truth.json").write_text("[\n" + ",\n".join(json.dumps(entry) for entry in truth) + "\n]\n")
    size = sum(path.stat().st_size for path in out.glob("*.jpg"))
    print(f"{condition}: {count} photos, {size / 1e6:.2f} MB", flush=True)


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description="Photograph the studio on another day.")
    parser.add_argument("--out", type=Path, default=HERE.parent / "studio_another_day")
    parser.add_argument("--work", type=Path, default=HERE / "build" / "another_day", help="folder of the renders")
    parser.add_argument("--only", choices=tuple(conditions.CHANGES), action="append")
    parser.add_argument("--count", type=int, default=COUNT, help="photos a condition")
    options = parser.parse_args()
    for condition in options.only or conditions.CHANGES:
        photograph(condition, options.count, options.work / condition, options.out / condition)


if __name__ == "__main__":
    main()
