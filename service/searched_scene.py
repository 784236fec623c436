"""The scene that photos are localized in, with its renderer; of a mapped scene both are kept beside it.

    CACHE/scenes/KEY/searched-KEY/       opacities.npy                            none, or without floaters
    CACHE/scenes/KEY/packed-KEY/         order.npy geometry.npy sh.npy ... (see `pack`)    of the CPU's renderer

Both depend on nothing but the scene in KEY and on how they are made, which is in their own keys. So the next load
looks at no Gaussian.
"""

from __future__ import annotations

import hashlib
import logging
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np

from service.interfaces import Rasterizer
from service.mapped_arrays import open_arrays, write_arrays
from service.pose.retrieval.floaters import FLOATERS, without_floaters
from service.pose.retrieval.free_space import SPACE
from service.render import RASTERIZERS, pack
from service.types import GaussianScene

_VERSION = 1
_log = logging.getLogger(__name__)


def searched_scene(scene: GaussianScene, entry: Path | None) -> GaussianScene:
    """Return the scene without floaters that veil it, and the scene itself if it has none.

    `entry` is the cache's folder of this very scene, in which it is kept which these are; None: nowhere.
    """
    if entry is None:
        return without_floaters(scene)
    folder = entry / f"searched-{_key()}"
    try:
        opacities = np.asarray(open_arrays(folder, ["opacities"])["opacities"])
        if len(opacities) in (0, scene.count):
            return replace(scene, opacities=opacities) if len(opacities) else scene
        _log.warning("%s is rebuilt: %d opacities of %d Gaussians", folder, len(opacities), scene.count)
    except FileNotFoundError:
        pass
    except (OSError, ValueError) as error:
        _log.warning("%s is rebuilt: %s", folder, error)
    searched = without_floaters(scene)
    kept = np.empty(0, np.float32) if searched is scene else searched.opacities
    try:
        shutil.rmtree(folder, ignore_errors=True)
        write_arrays(folder, {"opacities": kept})
    except OSError as error:
        _log.warning("what floaters the scene has is not cached: %s", error)
    return searched


def renderer_of(searched: GaussianScene, entry: Path | None, name: str) -> Rasterizer:
    """Return the named renderer of a scene that `searched_scene` gave, mapped from the entry if it can be.

    Raises UnknownName, BackendMissing.
    """
    module = RASTERIZERS.load(name)
    if entry is None or not hasattr(module, "create_mapped"):
        return module.create(searched)
    # With the opacities' key: without floaters another scene is packed.
    return module.create_mapped(searched, entry / f"packed-{_key(pack.VERSION)}")


def _key(*parts: object) -> str:
    return hashlib.sha256(repr((_VERSION, FLOATERS, SPACE, *parts)).encode()).hexdigest()[:16]
