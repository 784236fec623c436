"""A browser without a screen: speaks viser's protocol, keeps what it is told to show."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any

import msgspec
import viser
import zstandard
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect
from websockets.typing import Subprotocol

CAMERA = {
    "type": "ViewerCameraMessage",
    "wxyz": [1.0, 0.0, 0.0, 0.0],
    "position": [3.0, 3.0, 3.0],
    "fov": 1.3,
    "near": 0.01,
    "far": 1000.0,
    "image_height": 600,
    "image_width": 800,
    "look_at": [0.0, 0.0, 0.0],
    "up_direction": [0.0, 0.0, 1.0],
}


class FakeBrowser:
    """Connected while used as a context."""

    def __init__(self, port: int, path: str = "/", key: str = "") -> None:
        protocol = Subprotocol(f"viser-v{viser.__version__}")
        header = {"Authorization": f"Bearer {key}"} if key else None
        address = f"ws://127.0.0.1:{port}{path}"
        self._socket = connect(
            address, subprotocols=[protocol], additional_headers=header, max_size=None, compression=None, proxy=None
        )
        self.nodes: dict[str, dict[str, Any]] = {}
        """Scene nodes by name, as they are now."""
        self.widgets: dict[str, dict[str, Any]] = {}
        """GUI elements by uuid, as they are now; input elements have a `value`."""
        self.background: dict[str, Any] = {}
        """What lies behind the scene."""
        self.types: set[str] = set()
        """Of all messages so far."""
        self.frames: list[list[dict[str, Any]]] = []
        """The messages as they came: what comes in one frame is shown together."""
        self._changed = threading.Condition()
        self._reader = threading.Thread(target=self._read)

    def __enter__(self) -> FakeBrowser:
        self._reader.start()
        self.send(**CAMERA)  # a browser counts as connected once it has told its camera
        return self

    def __exit__(self, *_: object) -> None:
        self._socket.close()
        self._reader.join()

    def send(self, **message: Any) -> None:
        self._socket.send(msgspec.msgpack.encode(message))

    def widget(self, label: str) -> dict[str, Any]:
        return next(w for w in self.widgets.values() if w.get("label") == label)

    def set(self, label: str, value: Any) -> None:
        """What a user does: click a button (True), one of a group (its text), move a slider."""
        widget = self.widget(label)
        if widget["type"] not in ("GuiButtonMessage", "GuiButtonGroupMessage"):
            widget["value"] = value
        self.send(type="GuiUpdateMessage", uuid=widget["uuid"], updates={"value": value})

    def text(self) -> str:
        """Everything that is written in HTML widgets."""
        with self._changed:
            return " ".join(w.get("content") or "" for w in self.widgets.values())

    def wait(self, condition: Callable[[], object], what: str, seconds: float = 20.0) -> None:
        with self._changed:
            deadline = time.monotonic() + seconds
            while not self._holds(condition):
                assert time.monotonic() < deadline, f"waited in vain: {what}; nodes {sorted(self.nodes)}; {self.text()}"
                self._changed.wait(0.1)

    @staticmethod
    def _holds(condition: Callable[[], object]) -> bool:
        try:
            return bool(condition())
        except (StopIteration, KeyError):  # asks for what has not come yet
            return False

    def _read(self) -> None:
        try:
            for frame in self._socket:
                assert isinstance(frame, bytes)
                size = int.from_bytes(frame[8:16], "little")
                inner = zstandard.ZstdDecompressor().decompress(frame[16 : 16 + size])
                with self._changed:
                    self.frames.append(msgspec.msgpack.decode(inner)["messages"])
                    for message in self.frames[-1]:
                        self._take(message)
                    self._changed.notify_all()
        except ConnectionClosed:
            pass

    def _take(self, message: dict[str, Any]) -> None:
        kind = message["type"]
        self.types.add(kind)
        if kind.startswith("Gui") and "props" in message:
            extra = {"value": message["value"]} if "value" in message else {}
            self.widgets[message["uuid"]] = {**message["props"], **extra, "uuid": message["uuid"], "type": kind}
        elif kind == "BackgroundImageMessage":
            self.background = message
        elif kind == "GuiUpdateMessage" and message["uuid"] in self.widgets:
            self.widgets[message["uuid"]].update(message["updates"])
        elif kind == "RemoveSceneNodeMessage":
            self.nodes.pop(message["name"], None)  # its creation may have been merged away
        elif kind == "SceneNodeUpdateMessage":
            self.nodes[message["name"]]["props"].update(message["updates"])
        elif "name" in message and "props" in message:
            self.nodes[message["name"]] = message
        elif kind == "SetPositionMessage" and message["name"] in self.nodes:
            self.nodes[message["name"]]["position"] = message["position"]
