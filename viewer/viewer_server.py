"""The viewer's server: one session for each browser tab."""

from __future__ import annotations

import logging
import threading

import viser

from viewer.browser_session import BrowserSession
from viewer.requested_page import requested_page
from viewer.shared_data import Connect, SharedByToken
from viewer.viser_internals import disable_public_tunnels, requested_path, sent_token

log = logging.getLogger(__name__)


class Viewer:
    """Serves browsers from construction until `stop`."""

    def __init__(self, connect: Connect, host: str, port: int) -> None:
        """Listen on `port`, 0 for any free one. Raises OSError if the port is taken.

        Each browser's requests are made by the client that `connect` returns for the token that its socket was opened
        with.
        """
        self._shared = SharedByToken(connect)
        self._sessions: dict[int, tuple[BrowserSession, str]] = {}
        """With the token."""
        self._lock = threading.Lock()
        self.server = viser.ViserServer(host=host, port=port, label="splatfix", verbose=False)
        if port not in (0, self.server.get_port()):  # viser silently takes the next free port
            self.server.stop()
            raise OSError(f"port {port} is taken")
        disable_public_tunnels(self.server)
        self.server.gui.configure_theme(
            dark_mode=True, show_logo=False, show_share_button=False, brand_color=(230, 126, 20)
        )
        self.server.on_client_connect(self._open)
        self.server.on_client_disconnect(self._close)

    def stop(self) -> None:
        """End all sessions, and close the port."""
        with self._lock:
            sessions = list(self._sessions.values())
            self._sessions.clear()
        for session, token in sessions:
            session.close()
            self._shared.give_back(token)
        self.server.stop()

    def _open(self, client: viser.ClientHandle) -> None:
        token = sent_token(self.server, client.client_id)
        page = requested_page(requested_path(self.server, client.client_id))
        shared = self._shared.take(token)
        try:
            session = BrowserSession(client, shared, page)
        except BaseException:  # the browser has left already
            self._shared.give_back(token)
            raise
        with self._lock:
            self._sessions[client.client_id] = session, token
        session.start()

    def _close(self, client: viser.ClientHandle) -> None:
        with self._lock:
            session, token = self._sessions.pop(client.client_id, (None, ""))
        if session is not None:
            session.close()
            self._shared.give_back(token)
