"""Objects in an S3-compatible bucket. The only file with obstore.

Endpoint, region and credentials are those of the environment: `AWS_ENDPOINT_URL`, `AWS_REGION`, `AWS_ACCESS_KEY_ID`,
`AWS_SECRET_ACCESS_KEY`, or what the machine's role gives.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import timedelta
from pathlib import Path
from typing import Any

import obstore  # pyright: ignore[reportMissingImports]
from obstore.exceptions import AlreadyExistsError, BaseError  # pyright: ignore[reportMissingImports]
from obstore.store import S3Store  # pyright: ignore[reportMissingImports]

from service.errors import StorageFailed

_CONNECT, _REQUEST = "5s", "600s"
"""A scene of 2 GB at 4 MB/s takes 500 s."""
_RETRY: Any = {"max_retries": 3, "retry_timeout": timedelta(seconds=10)}
_PIECE_BYTES = 8 << 20


class S3Objects:
    """Implements `ObjectStore`."""

    def __init__(self, address: str) -> None:
        """Use `s3://bucket/prefix`. Raises StorageFailed."""
        # Whoever names an address without TLS means it; `splatfix doctor` warns.
        plain = os.environ.get("AWS_ENDPOINT_URL", "").startswith("http://")
        client: Any = {"connect_timeout": _CONNECT, "timeout": _REQUEST, "allow_http": plain}
        with _storing("open"):
            self._store = S3Store.from_url(address, client_options=client, retry_config=_RETRY)

    def get(self, key: str) -> bytes | None:
        with _storing("read"):
            try:
                return bytes(obstore.get(self._store, key).bytes())
            except FileNotFoundError:
                return None

    def put(self, key: str, data: bytes) -> None:
        with _storing("write"):
            obstore.put(self._store, key, data)

    def create(self, key: str, data: bytes) -> bool:
        with _storing("write"):
            try:
                obstore.put(self._store, key, data, mode="create")
            except AlreadyExistsError:
                return False
        return True

    def get_file(self, key: str, path: Path) -> bool:
        with _storing("read"):
            try:
                found = obstore.get(self._store, key)
            except FileNotFoundError:
                return False
            with path.open("wb") as file:
                for piece in found.stream(_PIECE_BYTES):
                    file.write(piece)
        return True

    def put_file(self, key: str, path: Path) -> None:
        with _storing("write"):
            obstore.put(self._store, key, path, chunk_size=_PIECE_BYTES)

    def delete(self, key: str) -> None:
        with _storing("write"):
            obstore.delete(self._store, key)

    def versions(self, prefix: str) -> dict[str, str]:
        with _storing("read"):
            listed = [found for some in obstore.list(self._store, prefix) for found in some]
        return {found["path"]: f"{found['e_tag']}.{found['last_modified'].isoformat()}" for found in listed}


@contextmanager
def _storing(what: str) -> Iterator[None]:
    try:
        yield
    except (BaseError, OSError, ValueError) as error:
        # Of several lines only the first says what is wrong.
        told = str(error).strip().partition("\n")[0]
        raise StorageFailed(f"the service can't {what} its object store: {told[:300]}.") from error
