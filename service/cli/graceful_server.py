"""uvicorn's server, ended in a way that no client behind a gateway notices.

A gateway goes on connecting until it is refused: only then, nothing having been sent, it may try another front. So
who has connected is answered, be it that nobody has accepted the connection yet, or that its request is on its way.
"""

from __future__ import annotations

import asyncio
import logging
import socket
import sys
from collections.abc import Callable
from functools import partial
from typing import Any

import uvicorn

_log = logging.getLogger(__name__)
_ON_THE_WAY_S = 1.0
"""From a connection to its request."""


class GracefulServer(uvicorn.Server):
    """`dismiss` is called once no more connections are accepted: it ends what lasts, e.g. streams of events."""

    def __init__(self, config: uvicorn.Config, dismiss: Callable[[], None]) -> None:
        super().__init__(config)
        self._dismiss = dismiss

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """As uvicorn's; ends the process where another one has begun to listen there since the sockets were bound."""
        try:
            await super().startup(sockets)
        except OSError as error:
            _log.error("can't listen there: %s", error.strerror)
            await self.lifespan.shutdown()
            sys.exit(1)

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        waiting = [connection for listener in sockets or () for connection in _connected(listener)]
        # At once: connections that come in between are reset.
        for server in self.servers:
            server.close()
        protocol: Any = self.config.http_protocol_class
        make = partial(protocol, self.config, self.server_state, self.lifespan.state)
        for connection in waiting:
            await asyncio.get_running_loop().connect_accepted_socket(make, connection, ssl=self.config.ssl)
        self._dismiss()
        await asyncio.sleep(_ON_THE_WAY_S)
        await super().shutdown(sockets)


def _connected(listener: socket.socket) -> list[socket.socket]:
    """Return the connections that nobody has accepted yet."""
    found: list[socket.socket] = []
    while True:
        try:
            connection, _ = listener.accept()
        except OSError:  # none is left, or this one is broken
            return found
        connection.setblocking(False)
        found.append(connection)
