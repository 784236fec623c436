"""Converts jobs, scenes and capabilities to the models of the API. `root` is the sub-path, which links begin with."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime

from service.errors import JobNotReady, NoPose
from service.estimators import ESTIMATORS
from service.jobs.model import JobRecord, JobResult, StoredJob
from service.loaded_scene import choose_rasterizer
from service.matchers import MATCHERS
from service.plugins import PluginRegistry
from service.render import RASTERIZERS
from service.results import Status
from service.scene_formats import SCENE_FORMATS
from service.scene_manager.anchor_store import Anchor
from service.scene_manager.status import SceneContents, SceneStatus
from service.web.problems import problem_of_failure
from service.web.schemas.conversion import (
    intrinsics_out,
    job_lens_out,
    named_camera_out,
    pose_out,
    record_out,
    region_out,
    result_out,
    scene_frame_out,
)
from service.web.schemas.job_spec import needs_prior, options_adapter
from service.web.schemas.jobs import JobLinks, JobOut, JobSummary, PhotoOut, Trace
from service.web.schemas.scenes import IndexOut, SceneLinks, SceneOut, SceneSummary
from service.web.schemas.system import Capabilities, Capability, EstimatorCapability
from service.web.settings import Settings


def job_summary_out(job: StoredJob, root: str) -> JobSummary:
    """Convert a job for the list of jobs."""
    return JobSummary(**_summary(job, root))


def job_out(job: StoredJob, result: JobResult | None, root: str, anchors: Sequence[Anchor] = ()) -> JobOut:
    """Convert a job, with its result or its error; `anchors` are those of its scene."""
    summary, spec = _summary(job, root), job.spec
    return JobOut(
        **summary,
        requested_scene=list(spec.scene) if isinstance(spec.scene, tuple) else spec.scene,
        seed=spec.seed,
        budget_s=spec.budget_s,
        deadline=_time(job.deadline) if job.deadline else None,
        options=dict(spec.options),
        camera_id=spec.camera_id,
        lens=spec.lens and spec.lens.recalled and job_lens_out(spec.lens.recalled),
        prior=spec.prior and pose_out(spec.prior),
        prior_region=spec.region and region_out(spec.region),
        truth=spec.truth and pose_out(spec.truth),
        result=result and result_out(result, anchors),
        error=job.failure and problem_of_failure(job.failure, summary["links"].self),
    )


def _summary(job: StoredJob, root: str) -> dict:
    self = f"{root}/jobs/{job.id}"
    photo = job.photo
    return {
        "id": job.id,
        "state": job.state,
        "scene": job.scene,
        "estimator": job.estimator,
        "photo": PhotoOut(name=photo.name, sha256=photo.sha256, intrinsics=intrinsics_out(photo.intrinsics)),
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


def require_pose(job: StoredJob) -> None:
    """Check that a job ended with a pose that may be used. Raises JobNotReady, NoPose."""
    if not job.ended:
        raise JobNotReady(f"the job is {job.state}.", where="job")
    # An uncertain pose is exported: whoever asks for it has seen its status.
    if job.state != "succeeded" or job.status == Status.NOT_LOCALIZED:
        raise NoPose("the job found no pose that could be used.", where="job", hint="See its reason: GET /jobs/ID.")


def _time(seconds: float) -> datetime:
    return datetime.fromtimestamp(seconds, UTC)


def trace_out(job: StoredJob, records: list[JobRecord]) -> Trace:
    """Convert the records of a job's latest attempt."""
    converted = [record_out(record.step, record.frame) for record in records]
    return Trace(job=job.id, state=job.state, attempt=job.attempt, records=converted)


def scene_summary_out(scene: SceneStatus, root: str) -> SceneSummary:
    """Convert a scene for the list of scenes."""
    return SceneSummary(**_scene(scene, root))


def scene_out(scene: SceneStatus, contents: SceneContents | None, root: str) -> SceneOut:
    """Convert a scene with its training cameras; `contents` is None until it is in memory."""
    info = scene.info
    bounds = contents and contents.bounds_in_world
    return SceneOut(
        **_scene(scene, root),
        sha256=info and info.sha256,
        format=info and info.format,
        background_rgb=list(info.background_rgb) if info else None,
        background_is_known=info and info.background_is_known,
        up_in_world=list(info.up_in_world) if info and info.up_in_world else None,
        metres_per_unit=info and info.metres_per_unit,
        render_mode=info and info.render_mode,
        bounds_in_world=None if bounds is None else bounds.tolist(),
        frames=[scene_frame_out(frame) for frame in info.frames] if info else [],
        warnings=[*(info.warnings if info else ()), *scene.warnings],
        training_cameras=[named_camera_out(c) for c in contents.cameras] if contents else [],
    )


def _scene(scene: SceneStatus, root: str) -> dict:
    self = f"{root}/scenes/{scene.id}"
    return {
        "id": scene.id,
        "name": scene.info.name if scene.info else scene.id,
        "state": scene.state,
        "gaussians": scene.gaussians,
        "sh_degree": scene.sh_degree,
        "cameras": scene.cameras,
        "memory_bytes": scene.memory_bytes,
        "index": scene.index and IndexOut(views=scene.index.views, planned_views=scene.index.planned_views),
        "jobs": scene.jobs,
        "uploaded": scene.uploaded,
        "error": scene.failure and problem_of_failure(scene.failure, self),
        "links": SceneLinks(self=self, splats=f"{self}/splats", thumbnail=f"{self}/thumbnail.jpg"),
    }


def capabilities(settings: Settings) -> Capabilities:
    """List all plug-ins and the limits of requests. Imports every plug-in: slow the first time."""
    return Capabilities(
        estimators=[_estimator(plugin) for plugin in plugins(ESTIMATORS, settings.estimator)],
        matchers=plugins(MATCHERS, settings.matcher),
        rasterizers=plugins(RASTERIZERS, settings.rasterizer or choose_rasterizer()[0]),
        scene_formats=plugins(SCENE_FORMATS),
        max_upload_bytes=settings.upload_limit,
        max_wait_s=settings.max_wait_s,
    )


def _estimator(plugin: Capability) -> EstimatorCapability:
    schema = None
    if plugin.available:
        try:
            schema = options_adapter(ESTIMATORS.load(plugin.name).Options).json_schema()
        except Exception as error:  # any error of a plug-in's code; the others must still be listed
            reason = f"its Options have no JSON schema: {error}"
            plugin = plugin.model_copy(update={"available": False, "reason": reason})
    needed = plugin.available and needs_prior(plugin.name)
    return EstimatorCapability(**plugin.model_dump(), options_schema=schema, needs_prior=needed)


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
