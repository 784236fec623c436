"""One front of the fleet fault run: real but for the estimator. Its replicas are on a Ray cluster that runs already.

python tests/fleet_front.py DATABASE RAY_ADDRESS PORT FOLDER

FOLDER has the scene, `room`, and what the front itself needs. While there is a file `full` in it, no replica can
write to its cache.
"""

from __future__ import annotations

import errno
import os
import sys
from functools import partial
from pathlib import Path

import numpy as np
import uvicorn
from api_server import GO_ON, fake_estimators, settings
from stand_ins import set_up_engine

from service.jobs.embedded_engine import EmbeddedEngine
from service.jobs.ray_engine import RayConfig, RayEngine
from service.web.app import create_app


def set_up(folder: Path, engine: EmbeddedEngine) -> None:
    """Prepare a replica: the tests' estimators, and a disk that may be full."""
    set_up_engine({}, GO_ON, engine)
    save = np.save

    def save_if_there_is_room(file, array, **options) -> None:
        if (folder / "full").exists():
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(file))
        save(file, array, **options)

    np.save = save_if_there_is_room


def main() -> None:
    database, address, port, folder = sys.argv[1], sys.argv[2], int(sys.argv[3]), Path(sys.argv[4])
    shared = {"database": database, "rate_limit": "", "crashes": 25, "workers": 2, "queue_size": 16}
    chosen = settings(
        **shared,
        scenes=[folder / "room"],
        port=port,
        engine="ray",
        ray_address=address,
        matcher="sift",
        rasterizer="cpu",
        data_dir=folder / f"data{port}",
        cache_dir=folder / "cache",
    )
    with fake_estimators():
        engine = RayEngine(chosen.engine_config, RayConfig(address, replicas=2, cpus=1.0), partial(set_up, folder))
        app = create_app(chosen, engine)
        uvicorn.Server(uvicorn.Config(app, port=port, log_level="error", timeout_graceful_shutdown=1)).run()


if __name__ == "__main__":
    main()
