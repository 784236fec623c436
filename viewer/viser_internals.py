"""viser's private parts, all of them that are used, as they were in viser 1.1."""

from __future__ import annotations

import logging

import viser
from viser import _messages

log = logging.getLogger(__name__)


def requested_path(server: viser.ViserServer, client_id: int) -> str:
    """Return the path of a browser's websocket, which viser keeps private; "/" where it can't be told."""
    try:
        return server._websock_server._live_connections[client_id].request.path  # type: ignore[union-attr]
    except (AttributeError, KeyError):
        log.warning("viser does not tell the path of client %s; it is shown the newest job", client_id)
        return "/"


def forbid_sharing(server: viser.ViserServer) -> None:
    """Take away viser's handler by which any browser could open a public tunnel to this server.

    Raises RuntimeError if it isn't where it was: better no viewer than an open one.
    """
    handlers = getattr(server._websock_server, "_incoming_handlers", {})
    if handlers.pop(_messages.ShareUrlRequest, None) is None:
        server.stop()
        raise RuntimeError("this version of viser may open public tunnels: its handler was not found")


def disconnect_all(server: viser.ViserServer) -> None:
    """Close all connections: viser's own stop() leaves that to callbacks that it has just switched off."""
    server._websock_server.disconnect_all_clients()
