"""Read checkpoints of gsplat's trainer (.pt) and of nerfstudio's splatfacto (.ckpt), in a process of their own.

Such files are pickles: `checkpoint_process.py` loads them with `weights_only=True`, under limits of memory and time,
and writes plain arrays, which are read here.
"""

from __future__ import annotations

import json
import subprocess
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32

from service.errors import CorruptScene, UnsupportedFormat
from service.operating_system import child_environment, limited_command
from service.scene_formats.gaussians import MAX_GAUSSIANS, RawGaussians, cut_sh, require_count
from service.types import SH_C0

SUFFIXES = (".pt", ".ckpt")
UNPICKLES = True
"""Uploads of this format are refused unless a setting allows them."""
_PROGRAM = Path(__file__).with_name("checkpoint_process.py")
_MAX_S, _CPU_S = 300, 240
_LIBRARIES_BYTES = 24 << 30
"""Address space that PyTorch with CUDA reserves without using it."""
_WIDTHS = {"means": 3, "quats": 4, "scales": 3, "opacities": 1, "sh0": 3}


def accepts(head: bytes, suffix: str) -> bool:
    """Whether the suffix is that of a checkpoint."""
    return suffix in SUFFIXES


def read(path: Path) -> RawGaussians:
    """Return the activated Gaussians in the trainer's frame. Raises CorruptScene, UnsupportedFormat."""
    with path.open("rb") as file:
        # Before a process is started for it.
        if file.read(2) != b"PK":
            raise UnsupportedFormat(
                "not a checkpoint of PyTorch 1.6 or later (a ZIP inside).",
                where=path.name,
                hint="Export the scene as .ply: ns-export gaussian-splat, or gsplat's --save-ply.",
            )
    with tempfile.TemporaryDirectory() as folder:
        answer = _extracted(path, Path(folder))
        arrays = {file.stem: np.load(file, allow_pickle=False) for file in Path(folder).glob("*.npy")}
    return _gaussians(arrays, bool(answer.get("rgb_logits")), path.name)


def _extracted(path: Path, folder: Path) -> dict[str, Any]:
    """Have the other process write the arrays into the folder. Raises CorruptScene, UnsupportedFormat."""
    memory = _LIBRARIES_BYTES + 3 * path.stat().st_size
    arguments = (path.resolve(), folder, MAX_GAUSSIANS)
    command = limited_command(_PROGRAM, *arguments, memory_bytes=memory, cpu_s=_CPU_S)
    try:
        done = subprocess.run(
            command, capture_output=True, timeout=_MAX_S, check=True, env=child_environment(), cwd=folder
        )
    except (subprocess.CalledProcessError, subprocess.TimeoutExpired) as error:
        raise CorruptScene(
            f"its loader crashed or took too long or too much memory ({type(error).__name__}).", where=path.name
        ) from error
    return checked_answer(json.loads(done.stdout), path.name)


def checked_answer(answer: dict[str, Any], where: str) -> dict[str, Any]:
    """Return the other process' answer. Raises the error that it reports: CorruptScene, UnsupportedFormat."""
    if "unsupported" in answer:
        raise UnsupportedFormat(answer["unsupported"], where=where, hint="Export the scene as .ply.")
    if "error" in answer:
        raise CorruptScene(answer["error"], where=where)
    return answer


def _gaussians(arrays: dict[str, np.ndarray], rgb_logits: bool, where: str) -> RawGaussians:
    count = len(arrays["means"])
    require_count(count, where)
    for name, width in _WIDTHS.items():
        if arrays[name].size != count * width:
            raise CorruptScene(
                f"'{name}' has the shape {arrays[name].shape}; {count} x {width} are needed.", where=where
            )
    sh0 = arrays["sh0"].reshape(count, 1, 3)
    rest = arrays.get("shN", np.empty((count, 0, 3), np.float32))
    if rest.ndim != 3 or rest.shape[::2] != (count, 3) or rest.shape[1] not in (0, 3, 8, 15, 24):
        raise CorruptScene(f"'shN' has the shape {rest.shape}.", where=where)
    # Without view dependence splatfacto optimizes logits of colours instead of coefficients.
    if rgb_logits:
        sh0 = ((1 / (1 + np.exp(-sh0)) - 0.5) / SH_C0).astype(np.float32)
    sh, warnings = cut_sh(np.concatenate([sh0, rest], 1))
    with np.errstate(over="ignore"):  # what overflows is left out by `checked`
        return RawGaussians(
            means=arrays["means"].reshape(count, 3),
            quats=arrays["quats"].reshape(count, 4),
            scales=np.exp(arrays["scales"].reshape(count, 3)),
            opacities=_sigmoid(arrays["opacities"].reshape(count)),
            sh=sh,
            warnings=warnings,
        )


def _sigmoid(values: Float32[np.ndarray, "n"]) -> Float32[np.ndarray, "n"]:
    return (1 / (1 + np.exp(-values))).astype(np.float32)
