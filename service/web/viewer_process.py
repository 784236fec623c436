"""The viewer as a child process: kept alive while the service lives, and no longer.

Started as `python -m viewer --service URL --port N` on loopback; it watches its parent process, and ends
when that is gone, however it went. A crash of the viewer costs the browsers their connection and nothing
else: it is started again, later each time if it does not stay up.
"""

from __future__ import annotations

import asyncio
import logging
import os
import socket
import sys
import time

_log = logging.getLogger(__name__)

_FIRST_PAUSE_S, _LONGEST_PAUSE_S = 0.5, 30.0
_STAYED_UP_S = 60.0
_GRACE_S = 3.0


class ViewerChild:
    """Supervises one viewer; `supervise` runs until it is cancelled."""

    def __init__(self, service_url: str, key: str) -> None:
        """`key` lets the viewer in; it goes by the environment, since everybody can see a process's arguments."""
        # Each browser has threads of its own there: with an arena for each, what they free is lost to the others.
        self._environment = {"MALLOC_ARENA_MAX": "2"} | os.environ | {"SPLATFIX_VIEWER_KEY": key}
        self.port = _free_port()
        self.command = [sys.executable, "-m", "viewer", "--service", service_url]
        self.command += ["--port", str(self.port), "--parent", str(os.getpid())]

    async def supervise(self) -> None:
        pause = _FIRST_PAUSE_S
        while True:
            began = time.monotonic()
            await self._run_once()
            stayed_up = time.monotonic() - began > _STAYED_UP_S
            pause = _FIRST_PAUSE_S if stayed_up else min(2 * pause, _LONGEST_PAUSE_S)
            await asyncio.sleep(pause)

    async def _run_once(self) -> None:
        # Its log goes to stderr; on stdout is viser's banner with an address that is not for people.
        nothing = asyncio.subprocess.DEVNULL
        child = await asyncio.create_subprocess_exec(
            *self.command, stdin=nothing, stdout=nothing, env=self._environment
        )
        try:
            code = await child.wait()
            _log.warning("the viewer ended with code %s; it is started again", code)
        finally:
            if child.returncode is None:
                await _end(child)


async def _end(child: asyncio.subprocess.Process) -> None:
    child.terminate()
    try:
        async with asyncio.timeout(_GRACE_S):
            await child.wait()
    except TimeoutError:
        child.kill()
        await child.wait()


def _free_port() -> int:
    """Return a port that was free a moment ago; the viewer, started again, comes back on the same one."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        return listener.getsockname()[1]
