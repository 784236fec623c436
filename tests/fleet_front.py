"""One front of a run of a fleet: real but for the estimator. Its replicas are on a Ray cluster that runs already.

python tests/fleet_front.py DATABASE RAY_ADDRESS PORT FOLDER

FOLDER has the scene, `room`, and what the front itself needs. While there is a file `full` in it, no replica can
write to its cache. With `embedded` as address the engine is that of the front's own process. `service` may be that
of an earlier release, by PYTHONPATH.
"""

from __future__ import annotations

import errno
import os
import socket
import sys
from functools import partial
from pathlib import Path

import numpy as np
from api_server import GO_ON, fake_estimators, settings
from stand_ins import set_up_engine

from service.cli import server
from service.jobs.embedded_engine import EmbeddedEngine
from service.jobs.engine import Engine
from service.web.app import create_app
from service.web.settings import Settings

EMBEDDED = "embedded"


def set_up(folder: Path, engine: EmbeddedEngine) -> None:
    """Prepare a replica: the tests' estimators, and a disk that may be full."""
    set_up_engine({}, GO_ON, engine)
    save = np.save

    def save_if_there_is_room(file, array, **options) -> None:
        if (folder / "full").exists():
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(file))
        save(file, array, **options)

    np.save = save_if_there_is_room


def chosen_settings(database: str, address: str, port: int, folder: Path) -> Settings:
    ray = {} if address == EMBEDDED else {"engine": "ray", "ray_address": address}
    if "object_store" in Settings.model_fields:
        ray |= {"object_store": str(folder / "objects")}
    return settings(
        **ray,
        database=database,
        rate_limit="",
        crashes=25,
        workers=2,
        queue_size=16,
        scenes=[folder / "room"],
        port=port,
        matcher="sift",
        rasterizer="cpu",
        data_dir=folder / f"data{port}",
        cache_dir=folder / "cache",
        shutdown_s=4,
        live_sessions_of_client=16,
    )


def engine_of(chosen: Settings, folder: Path) -> Engine:
    if chosen.engine == "embedded":
        engine = EmbeddedEngine(chosen.engine_config)
        set_up(folder, engine)
        return engine
    # Not above: an embedded engine needs no Ray.
    from service.jobs.ray_engine import RayConfig, RayEngine

    config = RayConfig(chosen.ray_address, replicas=2, cpus=1.0)
    return RayEngine(chosen.engine_config, config, partial(set_up, folder))


def main() -> None:
    database, address, port, folder = sys.argv[1], sys.argv[2], int(sys.argv[3]), Path(sys.argv[4])
    chosen = chosen_settings(database, address, port, folder)
    with fake_estimators(), socket.socket() as listener:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind(("127.0.0.1", port))
        app = create_app(chosen, engine_of(chosen, folder))
        # Of an earlier release it had another name.
        make = getattr(server, "http_server", None) or vars(server)["_server"]
        make(app, chosen).run(sockets=[listener])


if __name__ == "__main__":
    main()
