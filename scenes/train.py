"""Train a 3D Gaussian scene on the CPU, with the gradients of our own renderer.

    python scenes/train.py FOLDER --out scene.compressed.ply [--gaussians 60000] [--iterations 4000]

FOLDER holds `transforms.json` (nerfstudio layout; only `train_filenames` are used) and, if there is one, `points.npy`
(float32 n x 6: position, sRGB colour) to start from. Loss: 0.8 L1 + 0.2 (1 - SSIM). The number of Gaussians is fixed:
those that fade are moved onto those whose centres are pulled at most, which are split. Two photos a step, one a core.
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
from service.scene_formats import load_scene
from service.types import Camera, GaussianScene, Intrinsics, Pose, SceneInfo

SH_C0 = 0.28209479177387814
DEGREE = 3
SH_EVERY = 500
"""Iterations between two SH degrees."""
RELOCATE_EVERY = 100
FADED = 0.01
SSIM_SHARE = 0.2
OPACITY_DECAY, SCALE_DECAY = 2e-6, 2e-7
"""A gentle pull on what is seen: what the photos don't need fades, and can be moved."""


@dataclass(slots=True)
class Photo:
    name: str
    camera: Camera
    rgb: np.ndarray


class Model:
    """Raw parameters, with the scene's activated arrays beside them; views of those make the `GaussianScene`."""

    def __init__(self, points: np.ndarray, colours: np.ndarray, spacing: np.ndarray) -> None:
        n = len(points)
        self.means = points.astype(np.float32)
        self.quats = np.tile(np.float32([1, 0, 0, 0]), (n, 1))
        self.log_scales = np.log(np.repeat(spacing[:, None], 3, 1)).astype(np.float32)
        self.logits = np.full(n, np.log(0.3 / 0.7), np.float32)
        self.sh = np.zeros((n, (DEGREE + 1) ** 2, 3), np.float32)
        self.sh[:, 0] = (colours - 0.5) / SH_C0
        self.scales, self.opacities = np.empty_like(self.log_scales), np.empty_like(self.logits)
        self.moments = np.zeros((n, 2, 11 + self.sh[0].size), np.float32)
        self.steps = np.zeros(n, np.int32)
        self.pull = np.zeros(n, np.float32)
        self.activate()

    def activate(self) -> None:
        np.exp(self.log_scales, out=self.scales)
        self.opacities[:] = 1 / (1 + np.exp(-self.logits))

    def scene(self, info: SceneInfo) -> GaussianScene:
        """A scene that looks at this model's memory and changes with it."""
        views = []
        for array in (self.means, self.quats, self.scales, self.opacities, self.sh):
            view = array.view()
            view.flags.writeable = False
            views.append(view)
        return GaussianScene(*views, info)

    def relocate(self, rng: np.random.Generator) -> int:
        """Move the faded onto the most pulled and split those: same place, half the opacity, smaller."""
        faded = np.flatnonzero(self.opacities < FADED)
        weights = np.where(self.opacities < FADED, 0, self.pull)
        faded = faded[: np.count_nonzero(weights) // 2]
        if len(faded):
            chosen = rng.choice(len(weights), len(faded), replace=False, p=weights / weights.sum())
            offset = rng.normal(size=(len(chosen), 3)).astype(np.float32) * self.scales[chosen] * 0.7
            w, v = self.quats[chosen, :1], self.quats[chosen, 1:]
            turned = offset + 2 * np.cross(v, np.cross(v, offset) + w * offset)
            share = 1 - np.sqrt(1 - np.minimum(self.opacities[chosen], 0.99))
            self.logits[chosen] = np.log(share / (1 - share))
            self.log_scales[chosen] -= np.log(1.4)
            for array in (self.quats, self.log_scales, self.logits, self.sh):
                array[faded] = array[chosen]
            self.means[faded] = self.means[chosen] + turned
            self.means[chosen] -= turned
            both = np.concatenate([faded, chosen])
            self.moments[both] = 0
            self.steps[both] = 0
            self.activate()
        self.pull[:] = 0
        return len(faded)


@kernel
def adam_rows(index, gradients, values, moments, first, steps, rate, beta1, beta2, epsilon):
    """One step of Adam on the rows in view; `first` is the parameter's place in `moments`."""
    for v in range(index.shape[0]):
        i = index[v]
        fix1 = np.float32(1 / (1 - beta1 ** steps[i]))
        fix2 = np.float32(1 / (1 - beta2 ** steps[i]))
        for k in range(values.shape[1]):
            g = gradients[v, k]
            m = beta1 * moments[i, 0, first + k] + (np.float32(1) - beta1) * g
            s = beta2 * moments[i, 1, first + k] + (np.float32(1) - beta2) * g * g
            moments[i, 0, first + k], moments[i, 1, first + k] = m, s
            values[i, k] -= rate[k] * m * fix1 / (np.sqrt(s * fix2) + epsilon)


def step(model: Model, g: SceneGradients, means_rate: float, degree: int) -> None:
    """Adam on the Gaussians in view (rates of 3DGS), with the chain rule of the activations."""
    i = g.index
    model.steps[i] += 1
    model.pull[i] += np.linalg.norm(g.means, axis=1) * model.scales[i].max(1)
    opacity = model.opacities[i]
    d_logits = ((g.opacities + OPACITY_DECAY) * opacity * (1 - opacity))[:, None]
    d_scales = g.scales * model.scales[i] + SCALE_DECAY
    d_sh = g.sh.reshape(len(i), -1)
    sh_rate = np.full(model.sh[0].size, 2.5e-3 / 20, np.float32)
    sh_rate[:3] = 2.5e-3
    sh_rate[3 * (degree + 1) ** 2 :] = 0
    place = 0
    for values, gradients, rate in (
        (model.means, g.means, np.full(3, means_rate, np.float32)),
        (model.quats, g.quats, np.full(4, 1e-3, np.float32)),
        (model.log_scales, d_scales, np.full(3, 5e-3, np.float32)),
        (model.logits[:, None], d_logits, np.full(1, 5e-2, np.float32)),
        (model.sh.reshape(len(model.sh), -1), d_sh, sh_rate),
    ):
        adam_rows(
            i, np.ascontiguousarray(gradients, np.float32), values, model.moments, place, model.steps, rate,
            np.float32(0.9), np.float32(0.999), np.float32(1e-15),
        )  # fmt: skip
        place += values.shape[1]
    model.quats[i] /= np.linalg.norm(model.quats[i], axis=1, keepdims=True)
    model.scales[i] = np.exp(model.log_scales[i])
    model.opacities[i] = 1 / (1 + np.exp(-model.logits[i]))


def loss_gradient(picture: np.ndarray, photo: np.ndarray) -> tuple[float, np.ndarray]:
    """0.8 L1 + 0.2 (1 - SSIM) over the image, and its gradient by the picture.

    SSIM = A1 A2 / (B1 B2) with the 11-pixel Gaussian window (sigma 1.5) of Wang 2004; the window is symmetric, so its
    adjoint is itself.
    """

    def blur(image: np.ndarray) -> np.ndarray:
        return cv2.GaussianBlur(image, (11, 11), 1.5, borderType=cv2.BORDER_CONSTANT)

    c1, c2 = 0.01**2, 0.03**2
    mu1, mu2 = blur(picture), blur(photo)
    s11, s22 = blur(picture * picture) - mu1 * mu1, blur(photo * photo) - mu2 * mu2
    s12 = blur(picture * photo) - mu1 * mu2
    a1, a2 = 2 * mu1 * mu2 + c1, 2 * s12 + c2
    b1, b2 = mu1 * mu1 + mu2 * mu2 + c1, s11 + s22 + c2
    ssim = a1 * a2 / (b1 * b2)
    d_s12, d_s11 = 2 * a1 / (b1 * b2), -ssim / b2
    d_mu = 2 * (mu2 * a2 / (b1 * b2) - mu1 * ssim / b1 - mu1 * d_s11) - mu2 * d_s12
    d_ssim = blur(d_mu) + 2 * picture * blur(d_s11) + photo * blur(d_s12)
    error = picture - photo
    loss = (1 - SSIM_SHARE) * np.abs(error).mean() + SSIM_SHARE * (1 - ssim.mean())
    gradient = ((1 - SSIM_SHARE) * np.sign(error) - SSIM_SHARE * d_ssim) / error.size
    return float(loss), gradient.astype(np.float32)


def read_photos(folder: Path, key: str) -> list[Photo]:
    """Read the photos that `transforms.json` lists under the key."""
    transforms = json.loads((folder / "transforms.json").read_text())
    photos = []
    for frame in transforms["frames"]:
        if frame["file_path"] not in transforms[key]:
            continue
        pixels = Image.open(folder / frame["file_path"]).convert("RGB")
        lens = Intrinsics(*pixels.size, frame["fl_x"], frame["fl_y"], frame["cx"], frame["cy"])
        opencv = np.array(frame["transform_matrix"]) @ np.diag([1.0, -1, -1, 1])
        photos.append(Photo(frame["file_path"], Camera(lens, Pose(opencv)), np.asarray(pixels)))
    return photos


def starting_points(folder: Path, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Positions, colours, and the distance to the neighbours as a first size."""
    given = np.load(folder / "points.npy", allow_pickle=False)
    rows = given[rng.choice(len(given), count, replace=len(given) < count)]
    points, colours = rows[:, :3].astype(np.float32), rows[:, 3:]
    if len(given) < count:
        points = points + rng.normal(size=points.shape).astype(np.float32) * 0.01
    matcher = cv2.flann.Index(points, {"algorithm": 1, "trees": 4})
    _, squared = matcher.knnSearch(points, 4, params={"checks": 64})
    return points, colours, np.sqrt(np.maximum(squared[:, 1:].mean(1), 1e-8))


def psnr(rasterizer: CpuRasterizer, photos: list[Photo]) -> float:
    """Mean over the photos, in dB."""
    values = []
    for photo in photos:
        picture = np.clip(rasterizer.render([photo.camera])[0].rgb, 0, 1)
        values.append(-10 * np.log10(np.mean((picture - photo.rgb / 255.0) ** 2)))
    return float(np.mean(values))


def train(folder: Path, gaussians: int, iterations: int, seed: int = 0) -> GaussianScene:
    """Train on the training photos; the held-out ones only tell the PSNR at the end."""
    rng = np.random.default_rng(seed)
    photos, held_out = read_photos(folder, "train_filenames"), read_photos(folder, "test_filenames")
    background = tuple(json.loads((folder / "transforms.json").read_text()).get("background", (0, 0, 0)))
    lens = photos[0].camera.intrinsics
    info = SceneInfo(
        folder.name,
        folder.name,
        "",
        "ply",
        background,
        training_focal_px=lens.fx,
        training_long_side_px=lens.long_side,
    )
    model = Model(*starting_points(folder, gaussians, rng))
    rasterizer = CpuRasterizer(model.scene(info))
    places = np.array([p.camera.pose.position_in_world for p in photos])
    extent = float(np.linalg.norm(places - places.mean(0), axis=1).max())

    def gradients(photo: Photo) -> tuple[float, SceneGradients]:
        picture = rasterizer.render([photo.camera])[0].rgb
        loss, d_rgb = loss_gradient(picture, photo.rgb.astype(np.float32) / 255)
        return loss, rasterizer.scene_gradients(photo.camera, d_rgb)

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    start, order, average = time.perf_counter(), [], 0.1
    with Progress(*columns) as bar, ThreadPoolExecutor(2) as pool:
        task = bar.add_task("training", total=iterations)
        for iteration in range(0, iterations, 2):
            if len(order) < 2:
                order = list(rng.permutation(len(photos)))
            batch = [photos[order.pop()] for _ in range(2)]
            means_rate = 1.6e-4 * extent * 0.01 ** (iteration / iterations)
            for loss, g in pool.map(gradients, batch):
                step(model, g, means_rate, min(DEGREE, iteration // SH_EVERY))
                average += 0.01 * (loss - average)
            if iteration % RELOCATE_EVERY == 0 and 0 < iteration < 0.85 * iterations:
                model.relocate(rng)
                rasterizer = CpuRasterizer(model.scene(info))
            else:
                rasterizer.refresh()
            bar.update(task, advance=2, description=f"loss {average:.4f}")
    print(f"trained in {time.perf_counter() - start:.0f} s; held-out PSNR {psnr(rasterizer, held_out):.2f} dB")
    return model.scene(info)


def write(scene: GaussianScene, path: Path) -> None:
    """Write a PLY, compressed if the name ends in .compressed.ply."""
    visible = scene.opacities > 1 / 255
    raw = (
        scene.means, np.log(scene.scales), scene.quats, np.log(scene.opacities / (1 - scene.opacities)),
        scene.sh[:, 0], scene.sh[:, 1:],
    )  # fmt: skip
    arrays = [np.ascontiguousarray(a[visible]) for a in raw]
    gsply.plywrite(str(path), *arrays, compressed=path.name.endswith(".compressed.ply"))


def main() -> None:
    """Train, write, read back what was written, and tell its PSNR."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--gaussians", type=int, default=60_000)
    parser.add_argument("--iterations", type=int, default=4000)
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
