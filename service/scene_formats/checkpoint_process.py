"""Write the Gaussians of a checkpoint as plain arrays, in a process of its own, since the file is pickled.

    python -I checkpoint_process.py FILE FOLDER MAX_GAUSSIANS

Writes FOLDER/NAME.npy and a line of JSON: {"error"}, {"unsupported"}, or {"rgb_logits"}: whether colours are logits of
RGB. Started by `checkpoint` only, within limits that a hostile file can't lift; imports nothing of the service.
"""

from __future__ import annotations

import json
import sys
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import torch

_MINIMUM = (2, 10)
"""PyTorch before has a heap corruption in `weights_only` loading."""
_GSPLAT = {name: name for name in ("means", "quats", "scales", "opacities", "sh0", "shN")}
_NERFSTUDIO = {**{name: name for name in ("means", "quats", "scales", "opacities")},
               "sh0": "features_dc", "shN": "features_rest"}  # fmt: skip
_PREFIXES = ("_model.gauss_params.", "_model.")


def main() -> None:
    """Load the file and print what was found."""
    path, folder, most = Path(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3])
    warnings.simplefilter("ignore")
    sys.stdout.write(json.dumps(extracted(path, folder, most)))


def extracted(path: Path, folder: Path, most: int) -> dict[str, object]:
    """Write the arrays and return what is printed."""
    version = tuple(int(part) for part in torch.__version__.split(".")[:2])
    if version < _MINIMUM:
        return {"unsupported": f"checkpoints need PyTorch 2.10 or later; this is {torch.__version__}."}
    try:
        # Not memory-mapped, so that the limit of memory holds.
        data = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # a broken or hostile file raises almost anything
        # The first sentence: PyTorch goes on with how to load it in spite of all, and some errors have no text.
        said = str(error).strip().split("\n")[0].split(". ")[0][:200] or type(error).__name__
        return {"error": f"the checkpoint can't be loaded: {said.rstrip('.')}."}
    tensors, names = _tensors(data)
    missing = [names[name] for name in _GSPLAT if name != "shN" and name not in tensors]
    if missing:
        return {"unsupported": f"a checkpoint of another method: it has no {', '.join(missing[:3])}."}
    for name, tensor in tensors.items():
        # Sparse, nested and quantized tensors, and those without values (meta), are of no trainer of Gaussians.
        if tensor.layout != torch.strided or tensor.is_nested or tensor.is_meta or not tensor.is_floating_point():
            return {"error": f"'{names[name]}' is no plain tensor of floats, but {tensor.dtype}, {tensor.layout}."}
        if len(tensor) > most or tensor.numel() > most * 75:
            return {"error": f"'{names[name]}' has the shape {tuple(tensor.shape)}."}
        # Detached: parameters may be saved as they were trained.
        np.save(folder / f"{name}.npy", tensor.detach().float().contiguous().numpy(), allow_pickle=False)
    flat = "shN" not in tensors or 0 in tensors["shN"].shape
    return {"rgb_logits": names is _NERFSTUDIO and flat}


def _tensors(data: Any) -> tuple[dict[str, torch.Tensor], dict[str, str]]:
    """Return the tensors by gsplat's names, and the names that they have in the file."""
    splats = data.get("splats") if isinstance(data, dict) else None
    if isinstance(splats, dict):
        return _named(splats, _GSPLAT, ""), _GSPLAT
    pipeline = data.get("pipeline") if isinstance(data, dict) else None
    if not isinstance(pipeline, dict):
        return {}, _GSPLAT
    prefix = next((p for p in _PREFIXES if f"{p}means" in pipeline), _PREFIXES[0])
    return _named(pipeline, _NERFSTUDIO, prefix), _NERFSTUDIO


def _named(values: dict[str, Any], names: dict[str, str], prefix: str) -> dict[str, torch.Tensor]:
    found = {name: values.get(prefix + stored) for name, stored in names.items()}
    return {name: value for name, value in found.items() if isinstance(value, torch.Tensor) and value.ndim}


if __name__ == "__main__":
    main()
