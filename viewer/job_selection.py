"""Which job one browser shows: a chosen one, always the newest, or none but a scene."""

from __future__ import annotations

from collections.abc import Sequence

from viewer.controls import NO_SCENE, Controls
from viewer.job_display import JobDisplay
from viewer.panel_html import headline_html, job_label
from viewer.requested_page import RequestedPage
from viewer.scene_display import SceneDisplay
from viewer.service_lists import ServiceLists
from viewer.service_values import ListedJob


class JobSelection:
    """All methods are called from the session's thread; they raise ServiceError or ValueError."""

    def __init__(
        self, controls: Controls, lists: ServiceLists, job: JobDisplay, scene: SceneDisplay, page: RequestedPage
    ) -> None:
        """`page`: what the browser has opened; without a job, the newest is followed."""
        job_id = page.job_id
        self._zone = page.zone
        self._named: dict[str, str] = {}
        """Ids of the listed jobs by their line in the list."""
        self._controls, self._lists, self._job, self._scene = controls, lists, job, scene
        self._follows_newest = job_id is None
        self._chosen = job_id
        """The job to show unless the newest is followed; None: a scene without a job."""
        controls.newest.value = self._follows_newest

    def sync(self) -> None:
        """Update the lists of jobs and scenes, and open the newest job if it is followed."""
        jobs = self._lists.jobs or ()
        if self._lists.scenes:
            self._controls.scenes.options = self._lists.scenes
        wanted = self._chosen if not self._follows_newest else jobs[0].id if jobs else None
        if wanted is not None and (self._job.stream is None or self._job.stream.id != wanted):
            self._job.open(wanted)
        # The first scene, until there is a job.
        elif wanted is None and self._scene.scene_id is None and self._lists.jobs is not None:
            self._scene.show(next(iter(self._lists.scenes), None), None)
            self._controls.headline.content = headline_html(None, 0, "")
        self._job.show_awaited_scene(self._lists.scenes)
        self._name_jobs(jobs)

    def _name_jobs(self, jobs: Sequence[ListedJob]) -> None:
        """Show the list of jobs, with the one that is shown, be it older than those of the list."""
        stream = self._job.stream
        shown = next((job for job in jobs if stream and job.id == stream.id), None)
        if shown is None and stream is not None and stream.job is not None:
            shown = stream.job.listed()
            jobs = [shown, *jobs]
        self._named = {job_label(job, self._zone): job.id for job in jobs}
        if self._named:
            self._controls.jobs.options = tuple(self._named)
        if shown is not None:
            self._controls.jobs.value = job_label(shown, self._zone)

    def choose_job(self, label: str) -> None:
        """Show the job with this line in the list of jobs."""
        chosen = self._named.get(label)
        if chosen is not None:
            self._chosen, self._follows_newest = chosen, False
            self._controls.newest.value = False
            self.sync()

    def choose_newest(self, follow: bool) -> None:
        """Follow the newest job, or stay with the one that is shown."""
        self._follows_newest = follow
        self._chosen = self._job.stream.id if self._job.stream is not None else None
        self.sync()

    def choose_scene(self, scene_id: str) -> None:
        """Show a scene without a job."""
        if scene_id in (NO_SCENE, self._scene.scene_id):
            return
        self._controls.newest.value = self._follows_newest = False
        self._chosen = None
        self._job.leave()
        self._controls.set_step_count(0)
        self._scene.show(scene_id, None)
        self._controls.headline.content = headline_html(None, 0, "")
