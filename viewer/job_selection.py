"""Which job one browser shows: a chosen one, always the newest, or none but a scene."""

from __future__ import annotations

from viewer.controls import NO_JOB, NO_SCENE, Controls
from viewer.job_display import JobDisplay
from viewer.panel_html import headline_html, job_label
from viewer.scene_display import SceneDisplay
from viewer.service_lists import ServiceLists


class JobSelection:
    """All methods are called from the session's thread; they raise ServiceError or ValueError."""

    def __init__(
        self, controls: Controls, lists: ServiceLists, job: JobDisplay, scene: SceneDisplay, job_id: str | None
    ) -> None:
        """`job_id`: the job in the page's path; None: follow the newest."""
        self._controls, self._lists, self._job, self._scene = controls, lists, job, scene
        self._follows_newest = job_id is None
        self._chosen = job_id
        """The job to show unless the newest is followed; None: a scene without a job."""
        controls.newest.value = self._follows_newest

    def sync(self) -> None:
        """Update the lists of jobs and scenes, and open the newest job if it is followed."""
        jobs = self._lists.jobs or ()
        if jobs:
            self._controls.jobs.options = tuple(job_label(job) for job in jobs)
        if self._lists.scenes:
            self._controls.scenes.options = self._lists.scenes
        wanted = self._chosen if not self._follows_newest else jobs[0].id if jobs else None
        if wanted is not None and (self._job.stream is None or self._job.stream.id != wanted):
            self._job.open(wanted)
        # The first scene, until there is a job.
        elif wanted is None and self._scene.scene_id is None and self._lists.jobs is not None:
            self._scene.show(next(iter(self._lists.scenes), None), None)
            self._controls.headline.content = headline_html(None, 0, "")
        if self._job.stream is not None:
            shown = self._job.stream.id
            label = next((job_label(job) for job in jobs if job.id == shown), None)
            if label is not None:
                self._controls.jobs.value = label

    def choose_job(self, label: str) -> None:
        """Show the job with this line in the list of jobs."""
        chosen = next((job.id for job in self._lists.jobs or () if job_label(job) == label), None)
        if label != NO_JOB and chosen is not None:
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
