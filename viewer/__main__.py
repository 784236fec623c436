"""`python -m viewer --service URL --port N`: serve the viewer of a running service."""

from __future__ import annotations

import argparse
import io
import logging
import os
import signal
import threading
from contextlib import redirect_stdout
from functools import partial

from service.client import Client
from viewer.viewer_server import Viewer

log = logging.getLogger("viewer")


def main() -> None:
    """Serve until SIGTERM or SIGINT or, if that is asked for, the end of standard input."""
    parser = argparse.ArgumentParser(prog="viewer", description=__doc__)
    parser.add_argument("--service", required=True, help="base URL of the splatfix service")
    parser.add_argument("--port", type=int, required=True, help="port to serve browsers on")
    parser.add_argument("--host", default="127.0.0.1", help="address to serve browsers on (default: %(default)s)")
    parser.add_argument("--certificate", help="PEM file of the service's certificate, if it serves HTTPS")
    parser.add_argument("--end-with-stdin", action="store_true", help="end when standard input does")
    arguments = parser.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(levelname)s %(name)s: %(message)s")
    for chatty in ("httpx", "websockets"):  # they log every request and connection
        logging.getLogger(chatty).setLevel(logging.WARNING)
    ended = threading.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: ended.set())
    # No proxy from the environment, since the service is on loopback; a render takes seconds on a busy machine.
    certificate = arguments.certificate
    connect = partial(Client, arguments.service, timeout_s=30.0, use_proxy=False, certificate=certificate)
    with redirect_stdout(io.StringIO()):  # viser prints its address, which only the relay uses
        viewer = Viewer(connect, arguments.host, arguments.port)
    log.info("the viewer listens on port %s", viewer.server.get_port())
    if arguments.end_with_stdin:
        threading.Thread(target=_wait_for_end_of_stdin, args=[ended], daemon=True).start()
    # With a timeout: on Windows a wait without one keeps Ctrl+C from being noticed.
    while not ended.wait(1.0):
        pass
    with redirect_stdout(io.StringIO()):
        viewer.stop()


def _wait_for_end_of_stdin(ended: threading.Event) -> None:
    # A pipe ends with the process that holds its other end, on every system, however that process goes. Not by way of
    # sys.stdin, whose lock a thread would still hold while the interpreter ends.
    while os.read(0, 4096):
        pass
    ended.set()


if __name__ == "__main__":
    main()
