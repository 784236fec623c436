"""The viewer's server: one session per browser."""

from __future__ import annotations

import logging
import re
import threading
import time

import viser

from viewer.browser_session import BrowserSession
from viewer.job_stream import Library
from viewer.service_client import ServiceClient
from viewer.viser_internals import disconnect_all, forbid_sharing, requested_path

log = logging.getLogger(__name__)

_JOB_PATH = re.compile(r"/jobs/([A-Za-z0-9_-]{1,64})/?")


class Viewer:
    """Serves browsers from its construction until `stop`."""

    def __init__(self, service: ServiceClient, host: str, port: int) -> None:
        """`port` 0 takes any free one. Raises OSError if the port is taken."""
        self._library = Library(service)
        self._sessions: dict[int, BrowserSession] = {}
        self._lock = threading.Lock()
        self.server = viser.ViserServer(host=host, port=port, label="splatfix", verbose=False)
        if port not in (0, self.server.get_port()):  # viser moves on to the next free port by itself
            self.server.stop()
            raise OSError(f"port {port} is taken")
        forbid_sharing(self.server)
        self.server.gui.configure_theme(
            dark_mode=True, show_logo=False, show_share_button=False, brand_color=(230, 126, 20)
        )
        self._library.start()
        self.server.on_client_connect(self._open)
        self.server.on_client_disconnect(self._close)

    def stop(self) -> None:
        with self._lock:
            sessions = list(self._sessions.values())
        for session in sessions:
            session.close()
        self._library.close()
        disconnect_all(self.server)
        deadline = time.monotonic() + 1.0
        while self.server.get_clients() and time.monotonic() < deadline:
            time.sleep(0.01)
        self.server.stop()

    def _open(self, client: viser.ClientHandle) -> None:
        path = requested_path(self.server, client.client_id)
        session = BrowserSession(client, self._library, job_of(path), splats=not path.endswith("?gl=software"))
        with self._lock:
            self._sessions[client.client_id] = session
        session.start()

    def _close(self, client: viser.ClientHandle) -> None:
        with self._lock:
            session = self._sessions.pop(client.client_id, None)
        if session is not None:
            session.close()


def job_of(path: str) -> str | None:
    """Return the job that an address asks for; None: whichever is the newest."""
    match = _JOB_PATH.fullmatch(path.partition("?")[0])
    return match.group(1) if match else None
