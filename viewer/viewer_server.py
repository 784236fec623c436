"""The viewer's server: one session for each browser tab."""

from __future__ import annotations

import logging
import threading

import viser

from service.client import Client
from viewer.browser_session import BrowserSession
from viewer.requested_page import requested_page
from viewer.shared_data import SharedData
from viewer.viser_internals import disable_public_tunnels, requested_path

log = logging.getLogger(__name__)


class Viewer:
    """Serves browsers from construction until `stop`."""

    def __init__(self, client: Client, host: str, port: int) -> None:
        """Listen on `port`, 0 for any free one. Raises OSError if the port is taken."""
        self._shared = SharedData(client)
        self._sessions: dict[int, BrowserSession] = {}
        self._lock = threading.Lock()
        self.server = viser.ViserServer(host=host, port=port, label="splatfix", verbose=False)
        if port not in (0, self.server.get_port()):  # viser silently takes the next free port
            self.server.stop()
            raise OSError(f"port {port} is taken")
        disable_public_tunnels(self.server)
        self.server.gui.configure_theme(
            dark_mode=True, show_logo=False, show_share_button=False, brand_color=(230, 126, 20)
        )
        # Only now, as the constructor may have raised before.
        self._shared.start()
        self.server.on_client_connect(self._open)
        self.server.on_client_disconnect(self._close)

    def stop(self) -> None:
        """End all sessions, and close the port."""
        with self._lock:
            sessions = list(self._sessions.values())
        for session in sessions:
            session.close()
        self._shared.close()
        self.server.stop()

    def _open(self, client: viser.ClientHandle) -> None:
        session = BrowserSession(client, self._shared, requested_page(requested_path(self.server, client.client_id)))
        with self._lock:
            self._sessions[client.client_id] = session
        session.start()

    def _close(self, client: viser.ClientHandle) -> None:
        with self._lock:
            session = self._sessions.pop(client.client_id, None)
        if session is not None:
            session.close()
