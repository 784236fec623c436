"""A live session from Python: send a moving camera's frames, read where it is.

    from service.live_client import Live
    with Live("http://127.0.0.1:8000", "studio") as live:
        live.send(jpeg)
        answer = live.answer()
        print(answer.mode, answer.status, answer.world_from_camera)

One file that applications copy: Python 3.10 and the package websockets, nothing else of ours. Frames may be sent from
one thread while another reads the answers. docs/live.md has the protocol.
"""

from __future__ import annotations

import json
import struct
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any
from urllib.parse import quote

from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

# Magic, version, flags, length of the header, id, zero, time: docs/live.md.
_HEAD = struct.Struct("<4sBBHIId")


class LiveRefused(Exception):
    """The handshake was refused: key, role, rate or address."""

    def __init__(self, status: int, problem: Mapping[str, Any]) -> None:
        super().__init__(f"HTTP {status}: {problem.get('detail', '')} {problem.get('hint', '')}".strip())
        self.status = status
        self.problem = problem
        """The problem document; empty if something else answered."""


class LiveClosed(Exception):
    """The session ended; docs/live.md lists the codes."""

    def __init__(self, code: int, reason: str) -> None:
        super().__init__(f"{code} {reason}".strip())
        self.code = code
        self.reason = reason


@dataclass(frozen=True)
class LiveAnswer:
    """What a frame led to."""

    id: int
    """The frame's, as `send` returned it."""
    time_s: float
    mode: str
    """tracking, carried (by odometry), relocalizing or lost."""
    status: str
    """localized, uncertain or not_localized."""
    reason: str | None
    score: float | None
    world_from_camera: list[list[float]] | None
    """4x4, OpenCV camera axes, scene units; None without a pose."""
    covariance: list[list[float]] | None
    """6x6, of the twist (rotation in rad, translation in units) in the camera frame: true = pose @ exp(twist)."""
    intrinsics: dict[str, Any] | None
    waited_ms: float
    used_ms: float
    dropped: list[int]
    """Ids of the frames since the last answer that were not used."""
    world_from_odom: list[list[float]] | None = None
    """4x4 similarity from the odometry's frame to the scene; None without odometry, or while it isn't known."""
    units_per_odom: float | None = None
    """Its scale: scene units per unit of the odometry."""
    odom_covariance: list[list[float]] | None = None
    """7x7, of (rotation in rad, translation in units) in this frame's camera and the scale's logarithm."""
    odom_offset_s: float | None = None
    """By how much the odometry's poses are late."""
    odom_resets: int | None = None
    """How often the odometry began anew."""


class Live:
    """One session. Raises LiveRefused when it can't begin, LiveClosed once it has ended."""

    def __init__(
        self,
        url: str,
        scene: str,
        *,
        key: str = "",
        intrinsics: Mapping[str, Any] | None = None,
        prior: Mapping[str, Any] | None = None,
        accuracy: Mapping[str, Any] | None = None,
        odometry: Mapping[str, Any] | None = None,
        timeout_s: float = 60.0,
        **connection: Any,
    ) -> None:
        """Connect to the service at `url` (http or https) and begin; a scene may have to be loaded for that.

        `intrinsics`, `prior` and `accuracy` are those of a request to localize. `odometry` describes that of the
        frames: metric, up_in_odom, up_sigma_deg, smooth. `connection` goes to `websockets.sync.client.connect`, e.g.
        `ssl=` for a certificate of your own.
        """
        address = f"ws{url.removeprefix('http').rstrip('/')}/scenes/{quote(scene, safe='')}/live"
        headers = {"Authorization": f"Bearer {key}"} if key else {}
        try:
            # JPEG doesn't get smaller by compression, which would cost both sides time for each frame.
            self._socket = connect(
                address, additional_headers=headers, compression=None, open_timeout=timeout_s, **connection
            )
        except InvalidStatus as error:
            raise LiveRefused(error.response.status_code, _problem(error.response.body)) from None
        self.hint: dict[str, Any] = {}
        """What the service advises: `max_fps`, `long_side_px`; empty while there is no advice."""
        self._next_id = 0
        hello = {"type": "hello", "version": 1, "intrinsics": intrinsics, "prior": prior, "accuracy": accuracy}
        hello["odometry"] = odometry
        self._send(json.dumps({name: value for name, value in hello.items() if value is not None}))
        self.welcome: dict[str, Any] = json.loads(self._receive(timeout_s))
        """The service's first message, with the session's limits."""

    def __enter__(self) -> Live:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __iter__(self) -> Iterator[LiveAnswer]:
        """Yield the answers until the session ends by itself or by `close`."""
        while True:
            try:
                answer = self.answer()
            except LiveClosed as closed:
                # The code of a session that was ended on purpose.
                if closed.code == 1000:
                    return
                raise
            if answer:
                yield answer

    def send(
        self,
        jpeg: bytes,
        time_s: float | None = None,
        fx_fy_cx_cy: Sequence[float] | None = None,
        odom_from_camera: Sequence[Sequence[float]] | None = None,
        up_in_camera: Sequence[float] | None = None,
    ) -> int:
        """Send a frame, return its id. It may be dropped for a newer one.

        `time_s` is when it was taken, by any clock that doesn't go back; default: now. `fx_fy_cx_cy` are this frame's
        intrinsics in its pixels, for lenses that change. `odom_from_camera` is the 4x4 pose by the device's odometry
        and `up_in_camera` up by gravity, both in OpenCV camera axes (+x right, +y down, +z forward).
        """
        # By the client: the answer to a frame may come before `send` could learn an id from the service.
        number, self._next_id = self._next_id, self._next_id + 1
        odometry = None if odom_from_camera is None else [value for row in odom_from_camera[:3] for value in row]
        parts = {1: (4, fx_fy_cx_cy), 2: (12, odometry), 4: (3, up_in_camera)}
        more = b"".join(struct.pack(f"<{count}d", *part) for count, part in parts.values() if part is not None)
        flags = sum(flag for flag, (_, part) in parts.items() if part is not None)
        taken = time.monotonic() if time_s is None else time_s
        head = _HEAD.pack(b"SFLV", 1, flags, _HEAD.size + len(more), number, 0, taken)
        self._send(head + more + jpeg)
        return number

    def answer(self, timeout_s: float | None = None) -> LiveAnswer | None:
        """Wait for the next answer; None if none came in that time."""
        until = None if timeout_s is None else time.monotonic() + timeout_s
        while True:
            try:
                message = json.loads(self._receive(None if until is None else max(0.0, until - time.monotonic())))
            except TimeoutError:
                return None
            if message["type"] == "hint":
                # Kept, not returned: who waits for an answer must not be given something else.
                self.hint = {name: message[name] for name in ("max_fps", "long_side_px") if message[name]}
            elif message["type"] == "answer":
                # By our own fields: a newer service may send more.
                return LiveAnswer(**{field.name: message[field.name] for field in fields(LiveAnswer)})

    def close(self) -> None:
        """End the session; without effect on one that has ended."""
        self._socket.close()

    def _send(self, message: str | bytes) -> None:
        try:
            self._socket.send(message)
        except ConnectionClosed as error:
            raise _closed(error) from None

    def _receive(self, timeout_s: float | None) -> str | bytes:
        try:
            return self._socket.recv(timeout_s)
        except ConnectionClosed as error:
            raise _closed(error) from None


def _closed(error: ConnectionClosed) -> LiveClosed:
    # 1006: the connection broke without a close frame.
    return LiveClosed(error.rcvd.code, error.rcvd.reason) if error.rcvd else LiveClosed(1006, "connection lost")


def _problem(body: bytes | bytearray | None) -> Mapping[str, Any]:
    try:
        problem = json.loads(body or b"")
    except ValueError:  # a proxy's answer, which need not be JSON
        return {}
    return problem if isinstance(problem, dict) else {}
