"""Train a 3D Gaussian scene on the CPU with the gradients of splatfix's renderer.

    python scenes/train.py FOLDER --out scene.compressed.ply [--gaussians 240000] [--iterations 14000]

FOLDER holds `transforms.json` (nerfstudio layout; only `train_filenames` are used) and, if there is one, `points.npy`
(float32 n x 6: position, sRGB colour) to start from. Loss: 0.8 L1 + 0.2 (1 - SSIM). The number of Gaussians is fixed:
those with little opacity are moved to those with the largest position gradients, which are split (after 3DGS-MCMC,
Kheradmand et al. 2024). Two photos a step, one on each of two threads.
"""

from __future__ import annotations

import argparse
import json
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import cv2
import gsply
import numpy as np
from PIL import Image
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from service.interfaces import SceneGradients
from service.jit import kernel
from service.render.cpu import CpuRasterizer
from service.render.pack import morton_order
from service.scene_formats import load_scene
from service.types import Camera, GaussianScene, Intrinsics, Pose, SceneInfo

SH_C0 = 0.28209479177387814
SH_DEGREE = 2
"""Degree 3 enlarges the file more than it improves the renders."""
SH_EVERY = 500
"""Iterations after which the next SH degree is added."""
RELOCATE_EVERY = 100
RELOCATE_UNTIL, DECAY_FROM = 0.7, 0.7
"""Shares of the iterations: end of relocation, begin of the decay of all learning rates."""
MIN_OPACITY = 0.02
"""Gaussians below it are relocated."""
SSIM_SHARE = 0.2
OPACITY_DECAY = 1e-7
"""Gradient added to the opacity of every visible Gaussian, so that those the photos don't need can be relocated."""


@dataclass(slots=True)
class Photo:
    """A photo with its camera."""

    camera: Camera
    rgb: np.ndarray
    _blurred: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None

    def blurred(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the photo (0..1) with its local means and variances for SSIM; computed once."""
        if self._blurred is None:
            target = self.rgb.astype(np.float32) / np.float32(255)
            means = blur(target)
            self._blurred = target, means, blur(target * target) - means * means
        return self._blurred


class Model:
    """Parameters before activation, Adam's state, and activated arrays, of which a `GaussianScene` has views."""

    def __init__(self, points: np.ndarray, colours: np.ndarray, spacing: np.ndarray) -> None:
        n = len(points)
        self.means = points.astype(np.float32)
        self.quats = np.tile(np.float32([1, 0, 0, 0]), (n, 1))
        self.log_scales = np.log(np.repeat(0.7 * spacing[:, None], 3, 1)).astype(np.float32)
        self.logits = np.zeros(n, np.float32)
        self.sh = np.zeros((n, (SH_DEGREE + 1) ** 2, 3), np.float32)
        self.sh[:, 0] = (colours - 0.5) / SH_C0
        self.scales, self.opacities = np.empty_like(self.log_scales), np.empty_like(self.logits)
        self.moments = np.zeros((n, 2, 11 + self.sh[0].size), np.float32)
        self.steps = np.zeros(n, np.int32)
        self.gradient_sum = np.zeros(n, np.float32)
        self.sort()

    def sort(self) -> None:
        """Sort by Morton code: the renderer keeps the order, in which neighbours in space are neighbours in memory."""
        order = morton_order(self.means)
        for name in ("means", "quats", "log_scales", "logits", "sh", "moments", "steps", "gradient_sum"):
            setattr(self, name, getattr(self, name)[order])
        self.activate()

    def activate(self) -> None:
        """Compute scales and opacities from the parameters."""
        np.exp(self.log_scales, out=self.scales)
        self.opacities[:] = 1 / (1 + np.exp(-self.logits))

    def scene(self, info: SceneInfo) -> GaussianScene:
        """Return a scene that shares this model's memory and changes with it."""
        views = []
        for array in (self.means, self.quats, self.scales, self.opacities, self.sh):
            view = array.view()
            view.flags.writeable = False
            views.append(view)
        return GaussianScene(*views, info)

    def relocate(self, rng: np.random.Generator) -> int:
        """Move Gaussians of low opacity to ones drawn by their position gradients, and split those; return how many.

        The two parts are displaced from the common centre, smaller, and together as opaque as the whole was.
        """
        low = np.flatnonzero(self.opacities < MIN_OPACITY)
        weights = np.where(self.opacities < MIN_OPACITY, 0, self.gradient_sum)
        low = low[: np.count_nonzero(weights) // 2]
        if len(low):
            chosen = rng.choice(len(weights), len(low), replace=False, p=weights / weights.sum())
            offset = rng.normal(size=(len(chosen), 3)).astype(np.float32) * self.scales[chosen] * 0.7
            w, v = self.quats[chosen, :1], self.quats[chosen, 1:]
            # Rotated by the quaternion, from the Gaussian's axes to the world's.
            rotated = offset + 2 * np.cross(v, np.cross(v, offset) + w * offset)
            # Two layers of this opacity let through what one did before.
            share = 1 - np.sqrt(1 - np.minimum(self.opacities[chosen], 0.99))
            self.logits[chosen] = np.log(share / (1 - share))
            self.log_scales[chosen] -= np.log(1.4)
            for array in (self.quats, self.log_scales, self.logits, self.sh):
                array[low] = array[chosen]
            self.means[low] = self.means[chosen] + rotated
            self.means[chosen] -= rotated
            both = np.concatenate([low, chosen])
            self.moments[both] = 0
            self.steps[both] = 0
        self.gradient_sum[:] = 0
        self.sort()
        return len(low)


@kernel
def adam_rows(index, gradients, values, moments, first, steps, rate):
    """Do one step of Adam on the rows `index`; the parameter's moments begin at column `first`."""
    beta1, beta2 = np.float32(0.9), np.float32(0.999)
    rest1, rest2 = np.float32(0.1), np.float32(0.001)
    for v in range(np.uint64(index.shape[0])):
        i = np.uint64(index[v])
        # After 5000 steps both corrections are 1 to float32's precision.
        count = min(steps[i], 5000)
        fix1 = np.float32(1 / (1 - 0.9**count))
        fix2 = np.float32(1 / (1 - 0.999**count))
        for k in range(np.uint64(values.shape[1])):
            g = gradients[v, k]
            m = beta1 * moments[i, 0, first + k] + rest1 * g
            s = beta2 * moments[i, 1, first + k] + rest2 * g * g
            moments[i, 0, first + k], moments[i, 1, first + k] = m, s
            values[i, k] -= rate[k] * m * fix1 / (np.sqrt(s * fix2) + np.float32(1e-15))


def step(model: Model, g: SceneGradients, means_rate: float, rate: float, degree: int) -> None:
    """Do one step of Adam on the visible Gaussians, with the chain rule of the activations.

    Learning rates are those of 3DGS (Kerbl et al. 2023) times `rate`; `degree` is the highest SH degree trained.
    """
    i = g.index
    model.steps[i] += 1
    # In units of the Gaussian's size, as small ones have large gradients.
    model.gradient_sum[i] += np.linalg.norm(g.means, axis=1) * model.scales[i].max(1)
    opacity = model.opacities[i]
    d_logits = ((g.opacities + OPACITY_DECAY) * opacity * (1 - opacity))[:, None]
    d_scales = g.scales * model.scales[i]
    sh_rate = np.full(model.sh[0].size, 2.5e-3 / 4 * rate, np.float32)
    sh_rate[:3] = 2.5e-3 * rate
    active = 3 * (degree + 1) ** 2
    flat = model.sh.reshape(len(model.sh), -1)[:, :active]
    place = np.uint64(0)
    for values, gradients, rates in (
        (model.means, g.means, np.full(3, means_rate, np.float32)),
        (model.quats, g.quats, np.full(4, 1e-3 * rate, np.float32)),
        (model.log_scales, d_scales, np.full(3, 5e-3 * rate, np.float32)),
        (model.logits[:, None], d_logits, np.full(1, 5e-2 * rate, np.float32)),
        (flat, g.sh.reshape(len(i), -1)[:, :active], sh_rate[:active]),
    ):
        adam_rows(i, gradients, values, model.moments, place, model.steps, rates)
        place += np.uint64(values.shape[1])
    model.quats[i] /= np.linalg.norm(model.quats[i], axis=1, keepdims=True)
    model.scales[i] = np.exp(model.log_scales[i])
    model.opacities[i] = 1 / (1 + np.exp(-model.logits[i]))


def blur(image: np.ndarray) -> np.ndarray:
    """Return the image under SSIM's window (Wang et al. 2004): Gaussian, 11 pixels, sigma 1.5.

    The filter is symmetric, so it is its own adjoint.
    """
    return cv2.GaussianBlur(image, (11, 11), 1.5, borderType=cv2.BORDER_CONSTANT)


def loss_gradient(picture: np.ndarray, photo: Photo) -> tuple[float, np.ndarray]:
    """Return the loss 0.8 L1 + 0.2 (1 - SSIM) of a render, and its gradient with respect to the render."""
    d_mu, d_s11, d_s12, gradient = (np.empty_like(picture) for _ in range(4))
    target, mu2, s22 = photo.blurred()
    mu1, m11, m12 = blur(picture), blur(picture * picture), blur(picture * target)
    ssim = _ssim(
        mu1.ravel(), m11.ravel(), m12.ravel(), mu2.ravel(), s22.ravel(), d_mu.ravel(), d_s11.ravel(), d_s12.ravel()
    )
    parts = [blur(d).ravel() for d in (d_mu, d_s11, d_s12)]
    l1 = _gather_gradient(picture.ravel(), target.ravel(), *parts, np.float32(SSIM_SHARE), gradient.ravel())
    return (1 - SSIM_SHARE) * l1 + SSIM_SHARE * (1 - ssim), gradient


@kernel
def _ssim(mu1, m11, m12, mu2, s22, d_mu, d_s11, d_s12):
    """Return the mean of SSIM = A1 A2 / (B1 B2); write its derivatives with respect to the three blurred images."""
    one, two = np.float32(1), np.float32(2)
    c1, c2 = np.float32(0.01**2), np.float32(0.03**2)
    total = 0.0
    for i in range(np.uint64(mu1.shape[0])):
        a, b = mu1[i], mu2[i]
        a1, b1 = two * a * b + c1, a * a + b * b + c1
        a2, b2 = two * (m12[i] - a * b) + c2, m11[i] - a * a + s22[i] + c2
        scale = one / (b1 * b2)
        ssim = a1 * a2 * scale
        s12, s11 = two * a1 * scale, -ssim / b2
        d_s12[i], d_s11[i] = s12, s11
        d_mu[i] = two * (b * a2 * scale - a * ssim / b1 - a * s11) - b * s12
        total += ssim
    return total / mu1.shape[0]


@kernel
def _gather_gradient(picture, target, d_mu, d_s11, d_s12, share, gradient):
    """Return the mean absolute difference; write the loss's gradient from that of SSIM's blurred images."""
    scale = np.float32(1.0 / picture.shape[0])
    total = 0.0
    for i in range(np.uint64(picture.shape[0])):
        difference = picture[i] - target[i]
        total += abs(difference)
        sign = np.float32(1) if difference > 0 else np.float32(-1)
        d_ssim = d_mu[i] + np.float32(2) * picture[i] * d_s11[i] + target[i] * d_s12[i]
        gradient[i] = ((np.float32(1) - share) * sign - share * d_ssim) * scale
    return total / picture.shape[0]


def read_photos(folder: Path, key: str) -> list[Photo]:
    """Return the photos that `transforms.json` lists under the key."""
    transforms = json.loads((folder / "transforms.json").read_text())
    photos = []
    for frame in transforms["frames"]:
        if frame["file_path"] not in transforms[key]:
            continue
        pixels = Image.open(folder / frame["file_path"]).convert("RGB")
        intrinsics = Intrinsics(*pixels.size, frame["fl_x"], frame["fl_y"], frame["cx"], frame["cy"])
        opencv = np.array(frame["transform_matrix"]) @ np.diag([1.0, -1, -1, 1])
        photos.append(Photo(Camera(intrinsics, Pose(opencv)), np.asarray(pixels)))
    return photos


def starting_points(folder: Path, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return initial positions, colours, and distances to the nearest neighbours as sizes, from `points.npy`."""
    given = np.load(folder / "points.npy", allow_pickle=False)
    rows = given[rng.choice(len(given), count, replace=len(given) < count)]
    points, colours = rows[:, :3].astype(np.float32), rows[:, 3:]
    if len(given) < count:
        # Points drawn twice are moved apart by a centimetre, else their Gaussians would stay identical.
        points = points + rng.normal(size=points.shape).astype(np.float32) * 0.01
    matcher = cv2.flann.Index(points, {"algorithm": 1, "trees": 4})
    _, squared = matcher.knnSearch(points, 4, params={"checks": 64})
    return points, colours, np.sqrt(np.maximum(squared[:, 1:].mean(1), 1e-8))


def psnr(rasterizer: CpuRasterizer, photos: list[Photo]) -> float:
    """Return the mean PSNR of renders at the photos' cameras, in dB."""
    values = []
    for photo in photos:
        picture = np.clip(rasterizer.render([photo.camera])[0].rgb, 0, 1)
        values.append(-10 * np.log10(np.mean((picture - photo.rgb / 255.0) ** 2)))
    return float(np.mean(values))


def train(folder: Path, gaussians: int, iterations: int, seed: int = 0) -> GaussianScene:
    """Return a scene trained on a folder's training photos; print the PSNR of the held-out ones at the end."""
    rng = np.random.default_rng(seed)
    photos, held_out = read_photos(folder, "train_filenames"), read_photos(folder, "test_filenames")
    background = tuple(json.loads((folder / "transforms.json").read_text()).get("background", (0, 0, 0)))
    intrinsics = photos[0].camera.intrinsics
    info = SceneInfo(
        folder.name,
        folder.name,
        "",
        "ply",
        background,
        training_focal_px=intrinsics.fx,
        training_long_side_px=intrinsics.long_side,
    )
    model = Model(*starting_points(folder, gaussians, rng))
    rasterizer = CpuRasterizer(model.scene(info))
    places = np.array([p.camera.pose.position_in_world for p in photos])
    extent = float(np.linalg.norm(places - places.mean(0), axis=1).max())

    def gradients(photo: Photo) -> tuple[float, SceneGradients]:
        picture = rasterizer.render([photo.camera])[0].rgb
        loss, d_rgb = loss_gradient(picture, photo)
        return loss, rasterizer.scene_gradients(photo.camera, d_rgb)

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    start, order, average = time.perf_counter(), [], 0.1
    with Progress(*columns) as bar, ThreadPoolExecutor(2) as pool:
        task = bar.add_task("training", total=iterations)
        for iteration in range(0, iterations, 2):
            if len(order) < 2:
                order = list(rng.permutation(len(photos)))
            batch = [photos[order.pop()] for _ in range(2)]
            done = iteration / iterations
            means_rate = 1.6e-4 * extent * 0.01**done
            # With decayed rates the last steps average over the photos instead of following single ones.
            rate = 0.1 ** max(0.0, (done - DECAY_FROM) / (1 - DECAY_FROM))
            # Both gradients first, since a step changes the memory that they are computed from.
            for loss, g in list(pool.map(gradients, batch)):
                step(model, g, means_rate, rate, min(SH_DEGREE, iteration // SH_EVERY))
                average += 0.01 * (loss - average)
            if iteration % RELOCATE_EVERY == 0 and 0 < done < RELOCATE_UNTIL:
                model.relocate(rng)
                rasterizer = CpuRasterizer(model.scene(info))
            else:
                rasterizer.refresh()
            bar.update(task, advance=2, description=f"loss {average:.4f}")
    print(f"trained in {time.perf_counter() - start:.0f} s; held-out PSNR {psnr(rasterizer, held_out):.2f} dB")
    return model.scene(info)


def write(scene: GaussianScene, path: Path) -> None:
    """Write a PLY, compressed if the name ends in .compressed.ply."""
    # The renderer skips contributions below 1/255.
    visible = scene.opacities > 1 / 255
    raw = (
        scene.means, np.log(scene.scales), scene.quats, np.log(scene.opacities / (1 - scene.opacities)),
        scene.sh[:, 0], scene.sh[:, 1:],
    )  # fmt: skip
    arrays = [np.ascontiguousarray(a[visible]) for a in raw]
    gsply.plywrite(str(path), *arrays, compressed=path.name.endswith(".compressed.ply"))


def main() -> None:
    """Train, write the file, and print the PSNR of the file as it is read back."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--gaussians", type=int, default=240_000)
    parser.add_argument("--iterations", type=int, default=14_000)
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    scene = train(arguments.folder, arguments.gaussians, arguments.iterations)
    write(scene, arguments.out)
    written = load_scene(arguments.out)
    again = CpuRasterizer(
        GaussianScene(written.means, written.quats, written.scales, written.opacities, written.sh, scene.info)
    )
    held_out = read_photos(arguments.folder, "test_filenames")
    print(f"{arguments.out}: {written.count} Gaussians, held-out PSNR as written {psnr(again, held_out):.2f} dB")


if __name__ == "__main__":
    main()
