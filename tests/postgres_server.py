"""A PostgreSQL server of the tests' own: Debian's package, in a temporary folder, on a free port of loopback."""

from __future__ import annotations

import os
import shutil
import socket
import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from uuid import uuid4

import pytest

POSTGRES = pytest.param("postgres", marks=pytest.mark.ci)
"""Of fixtures of stores."""


def programs() -> Path | None:
    """Return the folder of initdb and pg_ctl, which Debian keeps out of PATH."""
    folders = sorted(Path("/usr/lib/postgresql").glob("*/bin"), key=lambda path: int(path.parent.name))
    found = folders[-1] if folders else Path(shutil.which("pg_ctl") or "/none").parent
    return found if (found / "initdb").exists() else None


class Server:
    """Started and stopped by `pg_ctl`; as root by the user `nobody`, since PostgreSQL refuses root."""

    def __init__(self, folder: Path) -> None:
        self._programs, self._data = programs(), folder / "data"
        self._as: dict = {}
        if os.geteuid() == 0:
            import pwd  # Windows has none, and collects the tests of stores, too

            nobody = pwd.getpwnam("nobody")
            os.chown(folder, nobody.pw_uid, nobody.pw_gid)
            self._as = {"user": nobody.pw_uid, "group": nobody.pw_gid, "extra_groups": []}
        with socket.create_server(("127.0.0.1", 0)) as free:
            self.port = free.getsockname()[1]
        self._run(
            "initdb", "--auth=trust", "--username=splatfix", "--encoding=UTF8", "--no-sync", f"--pgdata={self._data}"
        )

    def start(self) -> None:
        options = f"-c listen_addresses=127.0.0.1 -c port={self.port} -c unix_socket_directories=''"
        self._run(
            "pg_ctl", f"--pgdata={self._data}", f"--log={self._data}/log", f"--options={options}", "--wait", "start"
        )

    def stop(self, mode: str = "fast") -> None:
        self._run("pg_ctl", f"--pgdata={self._data}", f"--mode={mode}", "--wait", "stop")

    def database(self) -> str:
        """Make a database; return its address."""
        name = f"t{uuid4().hex}"
        self._run("createdb", "--host=127.0.0.1", f"--port={self.port}", "--username=splatfix", name)
        return f"postgresql://splatfix@127.0.0.1:{self.port}/{name}"

    def _run(self, program: str, *arguments: str) -> None:
        assert self._programs
        done = subprocess.run(
            [self._programs / program, *arguments],
            **self._as,
            # To a file it would be the server's own; a pipe stays open as long as the server runs.
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            cwd="/",
            env={"PATH": os.environ["PATH"], "LC_ALL": "C"},
            timeout=60,
        )
        assert done.returncode == 0, f"{program} failed; see {self._data}/log"


@contextmanager
def postgres_server() -> Iterator[Server]:
    """Run a server; skip the test where there is none."""
    if not find_spec("psycopg"):
        pytest.skip("psycopg isn't installed: pip install 'splatfix[postgres]'")
    if programs() is None:
        pytest.skip("no PostgreSQL server: apt-get install postgresql")
    with tempfile.TemporaryDirectory(prefix="splatfix-postgres-", ignore_cleanup_errors=True) as folder:
        server = Server(Path(folder))
        server.start()
        try:
            yield server
        finally:
            server.stop("immediate")
