"""nginx, as docker/nginx configures it, before one front or several."""

from __future__ import annotations

import re
import shutil
import signal
import socket
import subprocess
import time
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        return listener.getsockname()[1]


class Gateway:
    """nginx, as docker/nginx configures it, before the fronts at some ports, which may come and go: one after another.

    `url` is its address, at a given port or, with 0, at any. A line of `access_log` is the address of the front
    that was asked, and the request.
    """

    def __init__(self, ports: Sequence[int], folder: Path, *, port: int = 0, access_log: Path | None = None) -> None:
        nginx = shutil.which("nginx")
        if nginx is None:
            pytest.skip("there is no nginx on this machine")
        folder.mkdir()
        self._folder, self._port, self._access_log = folder, port or free_port(), access_log
        self.url = f"http://127.0.0.1:{self._port}"
        self._configure(ports)
        command = [nginx, "-p", folder, "-c", folder / "nginx.conf", "-e", folder / "log"]
        self._process = subprocess.Popen(command)
        while True:
            assert self._process.poll() is None, (folder / "log").read_text()
            with suppress(OSError), socket.create_connection(("127.0.0.1", self._port), 1):
                break
            time.sleep(0.02)

    def _configure(self, ports: Sequence[int]) -> None:
        folder, given = self._folder, ROOT / "docker" / "nginx"
        gateway = (given / "gateway.conf").read_text("utf-8")
        gateway = re.sub(r"/etc/nginx(/[\w./-]*)", lambda found: f'"{given}{found[1]}"', gateway)  # may have spaces
        gateway = gateway.replace("listen 8080", f"listen 127.0.0.1:{self._port}").replace("splatfix:8000", "fronts")
        servers = " ".join(f"server 127.0.0.1:{port} max_fails=0;" for port in ports)
        kinds = ("client_body", "proxy", "fastcgi", "uwsgi", "scgi")
        paths = " ".join(f'{kind}_temp_path "{folder}/{kind}";' for kind in kinds)
        main = f'daemon off; worker_processes 1; pid "{folder}/pid"; error_log "{folder}/log"; events {{}}'
        log = f"log_format front '$upstream_addr $request'; access_log \"{self._access_log}\" front;"
        log = log if self._access_log else "access_log off;"
        (folder / "nginx.conf").write_text(f"{main} http {{ {log} {paths} upstream fronts {{ {servers} }} {gateway} }}")

    def take(self, ports: Sequence[int]) -> None:
        """Send new requests to these fronts; those under way stay where they are."""
        self._configure(ports)
        self._process.send_signal(signal.SIGHUP)
        time.sleep(1)  # nginx doesn't tell when its new worker has begun

    def close(self) -> None:
        self._process.terminate()
        self._process.wait(10)


@contextmanager
def behind_nginx(ports: Sequence[int], folder: Path, **options) -> Iterator[str]:
    """Run nginx before the fronts at some ports, with the options of `Gateway`; gives its URL."""
    with closing(Gateway(ports, folder, **options)) as gateway:
        yield gateway.url
