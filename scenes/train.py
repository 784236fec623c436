"""Train a 3D Gaussian scene on the CPU with the gradients of splatfix's renderer.

    python -m scenes.train FOLDER --out scene.compressed.ply [--gaussians 240000] [--iterations 14000]
                                  [--every 2] [--long-side 320] [--random] [--cameras]

FOLDER holds `transforms.json` (nerfstudio layout; only `train_filenames` are used) and, if there is one, `points.npy`
(float32 n x 6: position, sRGB colour) to start from. Without it, or with `--random`, training starts from random points
in the cameras' view. `--every` and `--long-side` train on fewer and smaller photos; `--cameras` writes those that were
used beside the scene file. Loss: 0.8 L1 + 0.2 (1 - SSIM). The number of Gaussians is fixed: those with little opacity
are moved to those with the largest position gradients, which are split (after 3DGS-MCMC,
Kheradmand et al. 2024). Two photos a step, one on each of two threads.
"""

from __future__ import annotations

import argparse
import json
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cv2
import gsply
import numpy as np
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from scenes.training_data import Photo, blur, extent_of, given_points, random_points, read_photos, write_cameras
from service.interfaces import SceneGradients
from service.jit import kernel
from service.render.cpu import CpuRasterizer
from service.render.pack import morton_order
from service.scene_formats import load_scene
from service.types import GaussianScene, SceneInfo

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
RANDOM_OPACITY = 0.1
"""Of random points to begin with: most of them are in free space."""


class Model:
    """Parameters before activation, Adam's state, and activated arrays, of which a `GaussianScene` has views."""

    def __init__(self, points: np.ndarray, colours: np.ndarray, opacity: float = 0.5) -> None:
        n, spacing = len(points), neighbour_distance(points)
        self.means = points.astype(np.float32)
        self.quats = np.tile(np.float32([1, 0, 0, 0]), (n, 1))
        self.log_scales = np.log(np.repeat(0.7 * spacing[:, None], 3, 1)).astype(np.float32)
        self.logits = np.full(n, np.log(opacity / (1 - opacity)), np.float32)
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


def neighbour_distance(points: np.ndarray) -> np.ndarray:
    """Return each point's distance to its three nearest neighbours, as the root of the mean of squares."""
    points = np.ascontiguousarray(points, np.float32)
    matcher = cv2.flann.Index(points, {"algorithm": 1, "trees": 4})
    _, squared = matcher.knnSearch(points, 4, params={"checks": 64})
    return np.sqrt(np.maximum(squared[:, 1:].mean(1), 1e-8))


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


def psnr(rasterizer: CpuRasterizer, photos: list[Photo]) -> float:
    """Return the mean PSNR of renders at the photos' cameras, in dB."""
    values = []
    for photo in photos:
        picture = np.clip(rasterizer.render([photo.camera])[0].rgb, 0, 1)
        values.append(-10 * np.log10(np.mean((picture - photo.rgb / 255.0) ** 2)))
    return float(np.mean(values))


def scene_info(folder: Path, photo: Photo) -> SceneInfo:
    """Return what the file will not tell: the background, and the size and lens of the photos trained on."""
    background = tuple(json.loads((folder / "transforms.json").read_text()).get("background", (0, 0, 0)))
    k = photo.camera.intrinsics
    name = folder.name
    return SceneInfo(name, name, "", "ply", background, training_focal_px=k.fx, training_long_side_px=k.long_side)


def train(
    model: Model, photos: list[Photo], info: SceneInfo, iterations: int, rng: np.random.Generator
) -> GaussianScene:
    """Return the scene that the model becomes by training on photos."""
    rasterizer = CpuRasterizer(model.scene(info))
    extent = extent_of(np.array([p.camera.pose.position_in_world for p in photos]))

    def gradients(photo: Photo) -> tuple[float, SceneGradients]:
        picture = rasterizer.render([photo.camera])[0].rgb
        loss, d_rgb = loss_gradient(picture, photo)
        return loss, rasterizer.scene_gradients(photo.camera, d_rgb)

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    start, cpu_start, order, average = time.perf_counter(), time.process_time(), [], 0.1
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
    print(f"trained in {time.perf_counter() - start:.0f} s, {time.process_time() - cpu_start:.0f} s of CPU time")
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
    parser.add_argument("--every", type=int, default=1, help="train on every second, third ... of the photos only")
    parser.add_argument("--long-side", type=int, help="reduce the photos to so many pixels")
    parser.add_argument("--random", action="store_true", help="start from random points, not from points.npy")
    parser.add_argument("--cameras", action="store_true", help="write transforms.json and scene.json beside the scene")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    folder, out, rng = arguments.folder, arguments.out, np.random.default_rng(0)
    photos = read_photos(folder, "train_filenames", arguments.every, arguments.long_side)
    if arguments.random or not (folder / "points.npy").is_file():
        model = Model(*random_points(photos, arguments.gaussians, rng), RANDOM_OPACITY)
    else:
        model = Model(*given_points(folder / "points.npy", arguments.gaussians, rng))
    info = scene_info(folder, photos[0])
    out.parent.mkdir(parents=True, exist_ok=True)
    write(train(model, photos, info, arguments.iterations, rng), out)
    if arguments.cameras:
        write_cameras(folder, out.parent, [photo.name for photo in photos], photos[0].camera.intrinsics)
    written = load_scene(out)
    again = CpuRasterizer(
        GaussianScene(written.means, written.quats, written.scales, written.opacities, written.sh, info)
    )
    held_out = read_photos(folder, "test_filenames", long_side=arguments.long_side)
    print(f"{out}: {written.count} Gaussians from {len(photos)} photos, held-out PSNR {psnr(again, held_out):.2f} dB")


if __name__ == "__main__":
    main()
