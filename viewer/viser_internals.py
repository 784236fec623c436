"""All uses of viser's private attributes, as they are in viser 1.1."""

from __future__ import annotations

import logging

import viser
from viser import _messages

log = logging.getLogger(__name__)


def requested_path(server: viser.ViserServer, client_id: int) -> str:
    """Return the path of a browser's WebSocket request; "/" if viser no longer exposes it."""
    try:
        return server._websock_server._live_connections[client_id].request.path  # type: ignore[union-attr]
    except (AttributeError, KeyError):
        log.warning("no path is known of client %s; it is shown the newest job", client_id)
        return "/"


def sent_token(server: viser.ViserServer, client_id: int) -> str:
    """Return the token of a browser's WebSocket request, in whose name to ask the service; "" if there is none."""
    try:
        headers = server._websock_server._live_connections[client_id].request.headers  # type: ignore[union-attr]
    except (AttributeError, KeyError):
        log.warning("no token is known of client %s; it is shown what needs no key", client_id)
        return ""
    return headers.get("Authorization", "").removeprefix("Bearer ")


def disable_public_tunnels(server: viser.ViserServer) -> None:
    """Remove viser's handler by which any browser could open a public tunnel to this server.

    Raises RuntimeError, after stopping the server, if the handler isn't found.
    """
    handlers = getattr(server._websock_server, "_incoming_handlers", {})
    if handlers.pop(_messages.ShareUrlRequest, None) is None:
        server.stop()
        raise RuntimeError("this version of viser may open public tunnels: its handler was not found")
