"""The button that saves a job as a replay file."""

from __future__ import annotations

import logging
import threading

import viser

from viewer.action_queue import ActionQueue
from viewer.controls import Controls
from viewer.job_stream import JobStream
from viewer.replay import replay_html
from viewer.scene_cache import SceneContent

log = logging.getLogger(__name__)


class ReplayDownload:
    """Makes one file at a time, on a thread of its own, and sends it to the browser."""

    def __init__(self, client: viser.ClientHandle, controls: Controls, queue: ActionQueue) -> None:
        self._client, self._controls, self._queue = client, controls, queue

    def start(self, stream: JobStream, content: SceneContent) -> None:
        """Start making the file, unless one is being made."""
        if self._controls.saving_replay:
            return
        self._controls.set_saving_replay(True)
        name = f"replay-{self._client.client_id}"
        threading.Thread(target=self._make, args=(stream, content), name=name, daemon=True).start()

    def _make(self, stream: JobStream, content: SceneContent) -> None:
        try:
            page = replay_html(stream, content).encode()
            self._client.send_file_download(f"splatfix-{stream.id}.html", page, save_immediately=True)
        except Exception as error:  # reported to the user, whatever it is
            log.warning("no replay of job %s: %s", stream.id, error)
            self._client.add_notification("No replay file", str(error), color="red")
        self._queue.post(lambda: self._controls.set_saving_replay(False))
