"""nginx, as docker/nginx configures it, before one front or several."""

from __future__ import annotations

import re
import shutil
import socket
import subprocess
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        return listener.getsockname()[1]


@contextmanager
def behind_nginx(ports: Sequence[int], folder: Path) -> Iterator[str]:
    """Run nginx, as docker/nginx configures it, before the fronts at some ports, which may come and go; gives its URL.

    It takes them in turn.
    """
    nginx = shutil.which("nginx")
    if nginx is None:
        pytest.skip("there is no nginx on this machine")
    folder.mkdir()
    given, front = ROOT / "docker" / "nginx", free_port()
    gateway = (given / "gateway.conf").read_text("utf-8")
    gateway = re.sub(r"/etc/nginx(/[\w./-]*)", lambda found: f'"{given}{found[1]}"', gateway)  # may have spaces
    gateway = gateway.replace("listen 8080", f"listen 127.0.0.1:{front}").replace("splatfix:8000", "fronts")
    servers = " ".join(f"server 127.0.0.1:{port} max_fails=0;" for port in ports)
    kinds = ("client_body", "proxy", "fastcgi", "uwsgi", "scgi")
    paths = " ".join(f'{kind}_temp_path "{folder}/{kind}";' for kind in kinds)
    main = f'daemon off; master_process off; pid "{folder}/pid"; error_log "{folder}/log"; events {{}}'
    (folder / "nginx.conf").write_text(
        f"{main} http {{ access_log off; {paths} upstream fronts {{ {servers} }} {gateway} }}"
    )
    child = subprocess.Popen([nginx, "-p", folder, "-c", folder / "nginx.conf", "-e", folder / "log"])
    try:
        while True:
            assert child.poll() is None, (folder / "log").read_text()
            with suppress(OSError), socket.create_connection(("127.0.0.1", front), 1):
                break
            time.sleep(0.02)
        yield f"http://127.0.0.1:{front}"
    finally:
        child.terminate()
        child.wait(10)
