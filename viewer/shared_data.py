"""What browsers share that show the same user's jobs and scenes."""

from __future__ import annotations

import threading
from collections.abc import Callable

from service.client import Client
from viewer.job_stream import JobStreams
from viewer.scene_cache import SceneCache
from viewer.service_lists import ServiceLists


class SharedData:
    """The service's client with one user's token, and everything that is requested once for the user's browsers."""

    def __init__(self, client: Client) -> None:
        self.client = client
        self.lists = ServiceLists(client)
        self.streams = JobStreams(client)
        self.scenes = SceneCache(client)

    def start(self) -> None:
        """Start polling the lists of jobs and scenes."""
        self.lists.start()

    def close(self) -> None:
        """Stop all background threads."""
        self.lists.close()
        self.streams.close()
        # Threads that are still in a request end with an error of it.
        self.client.close()


Connect = Callable[[str], Client]
"""Makes a client of the service that asks with a token; an empty one where the service has no keys."""


class SharedByToken:
    """Data of each user whose browsers are open. They are never shared between users, who may see different things."""

    def __init__(self, connect: Connect) -> None:
        self._connect = connect
        self._taken: dict[str, tuple[SharedData, int]] = {}
        """By token, with the number of browsers."""
        self._lock = threading.Lock()

    def take(self, token: str) -> SharedData:
        """Return the data that are requested with a token, for one more browser."""
        with self._lock:
            shared, browsers = self._taken.get(token, (None, 0))
            if shared is None:
                shared = SharedData(self._connect(token))
                shared.start()
            self._taken[token] = shared, browsers + 1
            return shared

    def give_back(self, token: str) -> None:
        """Let one browser go; with the last one of a token its data are closed."""
        with self._lock:
            shared, browsers = self._taken[token]
            if browsers > 1:
                self._taken[token] = shared, browsers - 1
                return
            del self._taken[token]
        shared.close()

    def __len__(self) -> int:
        return len(self._taken)
