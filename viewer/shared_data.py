"""What the sessions of all browsers share."""

from __future__ import annotations

from service.client import Client
from viewer.job_stream import JobStreams
from viewer.scene_cache import SceneCache
from viewer.service_lists import ServiceLists


class SharedData:
    """The service's client, and everything that is requested once for all browsers."""

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
