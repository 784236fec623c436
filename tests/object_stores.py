"""Object stores of the tests' own: a folder, and a bucket of moto's S3 server on loopback."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from unittest.mock import patch
from uuid import uuid4

import httpx
import pytest

S3 = pytest.param("s3", marks=pytest.mark.ci)
"""Of fixtures of stores."""


@contextmanager
def s3_server() -> Iterator[Callable[[], str]]:
    """Run a server; yield what makes a bucket and returns its address. Skip the test where there is none."""
    if not find_spec("obstore"):
        pytest.skip("obstore isn't installed: pip install 'splatfix[cloud]'")
    if not find_spec("moto"):
        pytest.skip("no S3 server: pip install 'moto[s3,server]'")
    from moto.server import ThreadedMotoServer  # pyright: ignore[reportMissingImports]

    server = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    host, port = server.get_host_and_port()
    access = {"AWS_ACCESS_KEY_ID": "key", "AWS_SECRET_ACCESS_KEY": "secret", "AWS_REGION": "us-east-1"}
    endpoint = {"AWS_ENDPOINT_URL": f"http://{host}:{port}"}

    def bucket() -> str:
        name = f"t{uuid4().hex}"
        httpx.put(f"http://{host}:{port}/{name}", trust_env=False).raise_for_status()
        return f"s3://{name}/splatfix"

    try:
        with patch.dict(os.environ, access | endpoint):
            yield bucket
    finally:
        server.stop()


def address_of(kind: str, request: pytest.FixtureRequest, folder: Path) -> str:
    """Return the address of an empty object store."""
    return request.getfixturevalue("s3")() if kind == "s3" else str(folder / "objects")
