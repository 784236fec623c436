"""The film of `splatfix bench live`: what a hand-held camera sees on a walk through a scene, with its true poses.

The walk is that of `bench track`, cut into parts, with the tremor of a hand on it. Frames are rendered by the
program's own renderer, so the scene has no errors; the camera has: noise, JPEG, steps of the exposure, motion blur, and
things that the scene doesn't have in front of it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float32, Float64

from service.bench.pose_metrics import Units
from service.bench.track import SequenceConfig, smooth_path
from service.geometry import moved, se3_log
from service.interfaces import Rasterizer
from service.photos.images import encode_image
from service.types import Camera, Intrinsics, Pose

Part = Literal["steady", "exposure", "occluded", "dark", "blurred", "jumped", "unlocked"]
"""What happens: nothing else, steps of the exposure, 20 % occluded, a covered lens, motion blur, another place at once,
nothing sent for a while before."""


@dataclass(frozen=True, slots=True)
class FilmConfig:
    """What the camera and its carrier do."""

    fps: float = 30.0
    parts: tuple[tuple[Part, float], ...] = (
        ("steady", 0.16), ("exposure", 0.16), ("occluded", 0.16), ("dark", 0.1), ("blurred", 0.16), ("jumped", 0.13),
        ("unlocked", 0.13),
    )  # fmt: skip
    """Each part's share of the film."""
    locked_s: float = 30.0
    """Before `unlocked` nothing is sent for so long."""
    tremor_deg: float = 0.25
    """Standard deviation of a hand's rotation about each axis."""
    tremor_units: float = 0.006
    """Of its translation, normalized units."""
    tremor_hz: tuple[float, float] = (1.0, 7.0)
    """Frequencies of both."""
    noise_sigma: float = 0.02
    """Of values 0..1."""
    gains: tuple[float, ...] = (1.0, 0.6, 1.5, 0.8)
    """Of the exposure, for a second each."""
    occluded_share: float = 0.2
    """Of the image."""
    shutter: float = 0.5
    """Of the time between frames, in which a blurred frame is exposed."""
    blur_samples: int = 3
    """Renders that make a blurred frame."""
    jpeg_quality: int = 80


FILM = FilmConfig()


@dataclass(frozen=True, slots=True)
class Shot:
    """One frame of the film."""

    part: Part
    time_s: float
    """Since the film's start, when it is taken and sent."""
    jpeg: bytes
    pose: Pose
    """Where it is taken."""
    odom: Pose | None = None
    """odom_from_camera, in metres; None without odometry."""

    @property
    def truth(self) -> Pose | None:
        """The pose; None where the scene can't explain the frame: a covered lens."""
        return None if self.part == "dark" else self.pose


def make_film(
    stations: Sequence[Pose],
    camera: Intrinsics,
    rasterizer: Rasterizer,
    units: Units,
    seconds: float,
    seed: int = 0,
    progress: Callable[[int, int], None] | None = None,
    config: FilmConfig = FILM,
) -> list[Shot]:
    """Render a film of so many seconds (without the time in which nothing is sent) through a scene.

    `stations` are the training cameras' poses, which the walk leads through.
    """
    rng = np.random.default_rng(seed)
    count = round(seconds * config.fps)
    path = smooth_path(stations, units, count, SequenceConfig())
    tremor = _tremor(count, units, rng, config)
    path = [moved(pose, twist) for pose, twist in zip(path, tremor, strict=True)]
    shots: list[Shot] = []
    later_s, where = 0.0, 0
    for part, share in config.parts:
        # Back: the way ahead may lead through what nobody captured.
        where -= count // 2 if part == "jumped" else 0
        later_s += config.locked_s if part == "unlocked" else 0.0
        for number in range(round(share * count)):
            time_s = len(shots) / config.fps + later_s
            rgb = _seen(part, path, where, camera, rasterizer, config)
            rgb = _altered(part, rgb, number, rng, config)
            noise = rng.standard_normal(rgb.shape, np.float32) * np.float32(config.noise_sigma)
            shots.append(Shot(part, time_s, encode_image(rgb + noise, quality=config.jpeg_quality), path[where]))
            where += 1
            if progress:
                progress(len(shots), count)
    return shots


def _tremor(count: int, units: Units, rng: np.random.Generator, config: FilmConfig) -> Float64[np.ndarray, "count 6"]:
    """Return twists of a hand's tremor: sums of sines of random frequencies and phases."""
    waves = 8
    time_s = np.arange(count)[:, None, None] / config.fps
    hertz, phase = rng.uniform(*config.tremor_hz, (6, waves)), rng.uniform(0, 2 * np.pi, (6, waves))
    unit = np.sin(2 * np.pi * hertz * time_s + phase).sum(2) * np.sqrt(2 / waves)
    sigma = [np.radians(config.tremor_deg)] * 3 + [config.tremor_units / units.units_per_scene_unit] * 3
    return unit * sigma


def _seen(
    part: Part, path: Sequence[Pose], where: int, camera: Intrinsics, rasterizer: Rasterizer, config: FilmConfig
) -> Float32[np.ndarray, "h w 3"]:
    """Return the render at a place of the path; of a blurred frame the mean over its exposure, around that place."""
    pose = path[where]
    if part == "dark":
        return np.zeros((camera.height, camera.width, 3), np.float32)
    if part != "blurred":
        return rasterizer.render([Camera(camera, pose)])[0].rgb
    ahead = path[min(where + 1, len(path) - 1)]
    motion = se3_log(pose.camera_from_world @ ahead.world_from_camera)
    shares = config.shutter * (np.arange(config.blur_samples) / (config.blur_samples - 1) - 0.5)
    frames = rasterizer.render([Camera(camera, moved(pose, share * motion)) for share in shares])
    return np.stack([frame.rgb for frame in frames]).mean(0, dtype=np.float32)


def _altered(
    part: Part, rgb: Float32[np.ndarray, "h w 3"], number: int, rng: np.random.Generator, config: FilmConfig
) -> Float32[np.ndarray, "h w 3"]:
    """Return a frame as the camera's exposure, or somebody who walks through the picture, leaves it."""
    height, width = rgb.shape[:2]
    if part == "exposure":
        return rgb * np.float32(config.gains[int(number / config.fps) % len(config.gains)])
    if part == "occluded":
        rgb = rgb.copy()
        across = round(config.occluded_share * width / 0.9)
        # From left to right and back, in six seconds; striped, so that it has edges of its own.
        left = round((0.5 - 0.5 * np.cos(2 * np.pi * number / (6 * config.fps))) * (width - across))
        stripes = 0.25 + 0.15 * np.sign(np.sin(np.arange(height) / 9))[:, None, None]
        rgb[height // 10 :, left : left + across] = stripes[height // 10 :] * np.array([1.0, 0.7, 0.5])
    return rgb
