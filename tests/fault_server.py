"""A service for the fault run: real but for its engine. SIGUSR1 fills its disk, SIGUSR2 makes room again.

python tests/fault_server.py DATA_DIR PORT
"""

from __future__ import annotations

import errno
import signal
import sys
from pathlib import Path

import uvicorn
from api_server import create_app, fake_estimators, settings
from stand_ins import make_scene

import service.jobs.photo_store

_write = service.jobs.photo_store.write_durably


def full(path: Path, data: bytes) -> None:
    path.write_bytes(data[: len(data) // 2])
    raise OSError(errno.ENOSPC, "No space left on device")


def main() -> None:
    data_dir, port = Path(sys.argv[1]), int(sys.argv[2])
    with fake_estimators():
        changes = {"data_dir": data_dir, "port": port, "workers": 2, "queue_size": 16, "rate_limit": "", "crashes": 25}
        app = create_app(settings(**changes), {"room": make_scene()})

        def fill(*_: object) -> None:
            service.jobs.photo_store.write_durably = full
            writer = app.state.app_state.jobs._store._database._writer
            (pages,) = writer.execute("PRAGMA page_count").fetchone()
            writer.execute(f"PRAGMA max_page_count = {pages}")

        def free(*_: object) -> None:
            service.jobs.photo_store.write_durably = _write
            app.state.app_state.jobs._store._database._writer.execute("PRAGMA max_page_count = 1000000")

        signal.signal(signal.SIGUSR1, fill)
        signal.signal(signal.SIGUSR2, free)
        uvicorn.Server(uvicorn.Config(app, port=port, log_level="error", timeout_graceful_shutdown=1)).run()


if __name__ == "__main__":
    main()
