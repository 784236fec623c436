"""Compile gsplat's CUDA kernels for one machine: only those that `service/render/gsplat_cuda.py` calls.

    python tests/gpu_kernels_run.py [ARCHITECTURE]

The sources come from the installed gsplat, whose `csrc` is tried before it compiles everything by itself: half an hour
of one core for kernels of 2D splats, of other camera models and of up to 513 channels. Without an argument the
architecture is that of the first GPU. Exit code 1, with the reason, where it can't be done.
"""

from __future__ import annotations

import importlib.util
import os
import re
import shutil
import sys
import sysconfig
import tempfile
import time
from pathlib import Path

CHANNELS = 4
"""Red, green, blue and depth."""
SOURCES = (
    "Intersect.cpp", "IntersectTile.cu", "Projection.cpp", "ProjectionEWA3DGSFused.cu", "Rasterization.cpp",
    "RasterizeToIndices3DGS.cu", "RasterizeToPixels3DGSBwd.cu", "RasterizeToPixels3DGSFwd.cu",
    "SphericalHarmonics.cpp", "SphericalHarmonicsCUDA.cu",
)  # fmt: skip
FUNCTIONS = (
    "intersect_tile", "intersect_offset", "projection_ewa_3dgs_fused_fwd", "projection_ewa_3dgs_fused_bwd",
    "rasterize_to_indices_3dgs", "rasterize_to_pixels_3dgs_fwd", "rasterize_to_pixels_3dgs_bwd",
    "spherical_harmonics_fwd", "spherical_harmonics_bwd",
)  # fmt: skip
"""Of gsplat 1.5: what `rasterization` and `rasterize_to_indices_in_range` reach with the arguments that are passed."""
INSTANCE = re.compile(r"\s*__(?:INS|LAUNCH_KERNEL)__\((\d+)\)\s*")
"""A line of gsplat's sources that instantiates, or calls, a kernel for so many channels."""


def copy_sources(gsplat: Path, work: Path) -> list[Path]:
    """Copy the sources without the instances for other numbers of channels, and write the module that exports them."""
    copied = []
    for name in SOURCES:
        lines = (gsplat / "cuda" / "csrc" / name).read_text("utf-8").splitlines()
        counts = [int(match[1]) for line in lines if (match := INSTANCE.fullmatch(line))]
        if counts and CHANNELS not in counts:
            raise SystemExit(f"{name} of this gsplat has no kernel for {CHANNELS} channels.")
        kept = [line for line in lines if not (match := INSTANCE.fullmatch(line)) or int(match[1]) == CHANNELS]
        copied.append(work / name)
        copied[-1].write_text("\n".join(kept) + "\n", "utf-8")
    exports = "".join(f'    m.def("{name}", &gsplat::{name});\n' for name in FUNCTIONS)
    module = (
        '#include <torch/extension.h>\n#include "Ops.h"\nPYBIND11_MODULE(TORCH_EXTENSION_NAME, m) {\n'
        '    py::enum_<gsplat::CameraModelType>(m, "CameraModelType")'
        '.value("PINHOLE", gsplat::CameraModelType::PINHOLE);\n'
    )
    copied.append(work / "module.cpp")
    copied[-1].write_text(module + exports + "}\n", "utf-8")
    return copied


def compile_module(gsplat: Path, work: Path) -> Path:
    """Compile in `work`; return the module's file there."""
    from torch.utils.cpp_extension import load

    cuda = gsplat / "cuda"
    # The files call functions of kernels that aren't compiled. Hidden and in sections of their own, these functions
    # are dropped by the linker, as nothing that is exported leads to them.
    host = ["-O3", "-std=c++20", "-Wno-attributes", "-ffunction-sections", "-fvisibility=hidden"]
    load(
        name="csrc",
        sources=[str(path) for path in copy_sources(gsplat, work)],
        extra_cflags=host,
        # As gsplat compiles them: what is measured must be what users get.
        extra_cuda_cflags=["-O3", "-std=c++20", "-use_fast_math", "-Xcompiler", ",".join(host[3:])],
        extra_ldflags=["-Wl,--gc-sections", "-Wl,-z,now"],
        extra_include_paths=[str(cuda / "include"), str(cuda / "csrc"), str(cuda / "csrc" / "third_party" / "glm")],
        build_directory=str(work),
        is_python_module=True,
        verbose=True,
    )
    return work / "csrc.so"


def main() -> None:
    import torch

    found = importlib.util.find_spec("gsplat")
    if found is None or found.origin is None:
        raise SystemExit("gsplat is not installed.")
    if len(sys.argv) > 1:
        architecture = sys.argv[1]
    elif torch.cuda.is_available():
        architecture = "{}.{}".format(*torch.cuda.get_device_capability())
    else:
        raise SystemExit("there is no GPU whose architecture could be taken; name one, e.g. 9.0.")
    os.environ["TORCH_CUDA_ARCH_LIST"] = architecture
    gsplat, began = Path(found.origin).parent, time.perf_counter()
    with tempfile.TemporaryDirectory() as work:
        module = compile_module(gsplat, Path(work))
        target = gsplat / f"csrc{sysconfig.get_config_var('EXT_SUFFIX')}"
        shutil.copy(module, target)
    size_mb, seconds = target.stat().st_size / 1e6, time.perf_counter() - began
    print(f"{target.name} for {architecture}: {size_mb:.1f} MB, {seconds:.0f} s")


if __name__ == "__main__":
    main()
