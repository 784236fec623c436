"""Runs the viewer as a child process for as long as the service runs.

It is started as `python -m viewer --service URL --port N` on loopback, and exits by itself when this process is gone,
since its standard input ends then. After a crash it is started again, with a growing pause if it crashes repeatedly;
browsers only lose their connection.
"""

from __future__ import annotations

import asyncio
import logging
import os
import socket
import sys
import time
from pathlib import Path

_log = logging.getLogger(__name__)

_FIRST_PAUSE_S, _LONGEST_PAUSE_S = 0.5, 30.0
_STAYED_UP_S = 60.0
_GRACE_S = 3.0


class ViewerChild:
    """Supervises one viewer process."""

    def __init__(self, service_url: str, certificate: Path | None = None) -> None:
        """`certificate` is the service's, if it serves HTTPS.

        The viewer has no key of its own: with each browser the relay sends it a token to ask the service with.
        """
        # The viewer has threads for each browser; with a malloc arena each, they couldn't reuse each other's memory.
        # It finds modules where this process does, and not (-P) in a working directory that has a `viewer` of its own.
        self._environment = {"MALLOC_ARENA_MAX": "2"} | os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
        self.port = _free_port()
        self.started = 0.0
        self.command = [sys.executable, "-P", "-m", "viewer", "--service", service_url]
        self.command += ["--port", str(self.port), "--end-with-stdin"]
        self.command += ["--certificate", str(certificate)] if certificate else []

    async def supervise(self) -> None:
        """Start the viewer, and start it again whenever it ends, until this is cancelled."""
        pause = _FIRST_PAUSE_S
        while True:
            began = time.monotonic()
            await self._run_once()
            # A viewer that ran for a while crashed by chance; one that ends at once will do so again.
            stayed_up = time.monotonic() - began > _STAYED_UP_S
            pause = _FIRST_PAUSE_S if stayed_up else min(2 * pause, _LONGEST_PAUSE_S)
            await asyncio.sleep(pause)

    async def _run_once(self) -> None:
        # The log goes to stderr. On stdout viser prints its own address, which users shouldn't open.
        child = await asyncio.create_subprocess_exec(
            *self.command,
            # Held open: by its end the viewer notices that this process is gone, however it ended.
            stdin=asyncio.subprocess.PIPE,
            stdout=asyncio.subprocess.DEVNULL,
            env=self._environment,
        )
        self.started = time.monotonic()
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
    """Return a free port. It is chosen once, so that the relay finds the viewer after a restart."""
    # It is free again after the block: another process could take it, but hardly does within seconds.
    with socket.create_server(("127.0.0.1", 0)) as listener:
        return listener.getsockname()[1]
