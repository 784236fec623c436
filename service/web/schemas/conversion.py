"""Converts domain values to the models of the API."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, replace
from datetime import UTC, datetime

import numpy as np

from service.geodesy import geographic
from service.geometry import quat_from_rotation
from service.jobs.model import JobResult, SequenceFrame
from service.lenses.lens_memory import RecalledLens
from service.lenses.lens_store import StoredLens
from service.registration.registration import Registration
from service.results import HINTS, IterationRecord, StageTiming, Status
from service.scene_formats.similarity import moved_pose
from service.scene_manager.anchor_store import Anchor
from service.types import BoxPrior, Camera, GeoAnchor, Intrinsics, NamedCamera, Pose, PriorRegion, SceneFrame
from service.web.schemas.anchors import seen_anchors
from service.web.schemas.job_results import (
    Alternative,
    AskedOut,
    CandidatesOut,
    FrameOut,
    MatchesOut,
    RankedScene,
    Record,
    Result,
    SceneRef,
    Timing,
)
from service.web.schemas.jobs import JobLensOut
from service.web.schemas.lenses import LensOut
from service.web.schemas.poses import (
    Axes,
    CameraOut,
    Covariance,
    GeoPose,
    GeoPosition,
    GeoQuaternion,
    IntrinsicsCorrectionOut,
    IntrinsicsOut,
    Matrix,
    NamedCameraOut,
    PoseInFrame,
    PoseOut,
    RegionOut,
    ResultPose,
    SceneFrameOut,
    Transform,
)
from service.web.schemas.registrations import RegisteredOut

OPENCV_FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
"""Changes camera axes: OpenGL's y points up and its z backwards. It is its own inverse."""


def rows(matrix: np.ndarray) -> Matrix:
    """Return nested lists of Python floats."""
    return np.asarray(matrix, np.float64).tolist()


def transform_out(target_from_source: np.ndarray) -> Transform:
    """Convert a 4x4 target_from_source."""
    return Transform(
        matrix=rows(target_from_source),
        translation=target_from_source[:3, 3].tolist(),
        quaternion_wxyz=quat_from_rotation(target_from_source[:3, :3]).tolist(),
    )


def pose_out(pose: Pose) -> PoseOut:
    """Convert a pose, to both conventions of camera axes."""
    opengl = Pose(pose.world_from_camera @ OPENCV_FROM_OPENGL)
    return PoseOut(
        position=pose.position_in_world.tolist(),
        world_from_camera=transform_out(pose.world_from_camera),
        camera_from_world=transform_out(pose.camera_from_world),
        opengl=Axes(
            world_from_camera=transform_out(opengl.world_from_camera),
            camera_from_world=transform_out(opengl.camera_from_world),
        ),
    )


def scene_frame_out(frame: SceneFrame) -> SceneFrameOut:
    """Convert a frame of a scene."""
    return SceneFrameOut(
        name=frame.name,
        frame_from_world=frame.frame_from_world.tolist(),
        decided_by=frame.decided_by,
        verified=frame.verified,
    )


def result_pose_out(pose: Pose, frames: Sequence[SceneFrame]) -> ResultPose:
    """Convert a result's pose, in the world and in each frame."""
    found = []
    for frame in frames:
        moved = pose_out(moved_pose(pose, frame.frame_from_world))
        found.append(PoseInFrame(**dict(moved), frame=scene_frame_out(frame)))
    return ResultPose(**dict(pose_out(pose)), frames=found)


def geopose_out(anchor: GeoAnchor, pose: Pose) -> GeoPose:
    """Convert a pose to latitude, longitude, height and orientation on Earth."""
    (latitude, longitude, height), (w, x, y, z) = geographic(anchor, pose)
    position = GeoPosition(lat=latitude, lon=longitude, h=height)
    return GeoPose(position=position, quaternion=GeoQuaternion(x=x, y=y, z=z, w=w))


def registered_out(registration: Registration, pose: Pose, covariance: np.ndarray | None) -> RegisteredOut:
    """Convert a pose to the frame of its scene's registration; `covariance` is the pose's own, as a verdict's."""
    placed = registration.placed(pose, covariance)
    scale, own = registration.metres_per_unit, covariance
    sigma_m = sigma_deg = None
    # Without its own covariance a pose has no uncertainty that would mean anything.
    if own is not None:
        whole = own if placed is None else placed.covariance
        metres = scale if placed is None else 1.0
        sigma_m = None if metres is None else metres * float(np.sqrt(np.trace(whole[3:, 3:])))
        sigma_deg = float(np.degrees(np.sqrt(np.trace(whole[:3, :3]))))
    return RegisteredOut(
        revision=registration.revision,
        determined=list(registration.determined),
        frame="local" if registration.origin is None else "enu",
        metres_per_unit=scale,
        metres_per_unit_sigma=registration.metres_per_unit_sigma,
        target_from_camera=placed and transform_out(placed.pose.world_from_camera),
        position_covariance=rows(placed.position_covariance) if placed and own is not None else None,
        sigma_m=sigma_m,
        sigma_deg=sigma_deg,
    )


def intrinsics_out(intrinsics: Intrinsics) -> IntrinsicsOut:
    """Convert a camera model."""
    return IntrinsicsOut(
        model=intrinsics.model,
        width=intrinsics.width,
        height=intrinsics.height,
        fx=intrinsics.fx,
        fy=intrinsics.fy,
        cx=intrinsics.cx,
        cy=intrinsics.cy,
        distortion=list(intrinsics.distortion),
        trust=intrinsics.trust,
    )


def camera_out(camera: Camera) -> CameraOut:
    """Convert a camera."""
    return CameraOut(
        intrinsics=intrinsics_out(camera.intrinsics), world_from_camera=rows(camera.pose.world_from_camera)
    )


def named_camera_out(named: NamedCamera) -> NamedCameraOut:
    """Convert a training camera."""
    return NamedCameraOut(name=named.name, **camera_out(named.camera).model_dump())


def record_out(record: IterationRecord, frame: SequenceFrame | None = None) -> Record:
    """Convert one step of a job."""
    matches, candidates = record.matches, record.candidates
    return Record(
        index=record.index,
        stage=record.stage,
        world_from_camera=rows(record.pose.world_from_camera),
        intrinsics_correction=IntrinsicsCorrectionOut(**asdict(record.correction)),
        elapsed_s=record.elapsed_s,
        cpu_s=record.cpu_s,
        loss=record.loss,
        num_matches=record.num_matches,
        num_inliers=record.num_inliers,
        step_deg=record.step_deg,
        step_units=record.step_units,
        matches=matches
        and MatchesOut(
            photo_px=rows(matches.photo_px),
            render_px=rows(matches.render_px),
            inlier=matches.inlier.tolist(),
            render_camera=camera_out(matches.render_camera),
        ),
        candidates=candidates
        and CandidatesOut(world_from_camera=candidates.world_from_camera.tolist(), scores=candidates.scores.tolist()),
        frame=frame and frame_out(frame),
    )


def frame_out(frame: SequenceFrame) -> FrameOut:
    """Convert the answer of one photo of a sequence."""
    return FrameOut(
        index=frame.index,
        name=frame.name,
        time_s=frame.time_s,
        status=frame.status,
        reason=frame.reason,
        score=frame.score,
        right_place=frame.right_place,
        precise=frame.precise,
        tracked=frame.tracked,
        world_from_camera=transform_out(frame.pose.world_from_camera),
        covariance=None if frame.covariance is None else covariance_out(frame.covariance),
    )


def record_camera(record: IterationRecord, photo: Intrinsics, *, of_matches: bool) -> Camera:
    """Return a record's camera: its pose in the photo's size, or the camera that its matches refer to."""
    # A match refers to a render, which may have another size and pose than the photo.
    if of_matches and record.matches is not None:
        return record.matches.render_camera
    return Camera(photo.corrected(record.correction), record.pose)


def covariance_out(matrix: np.ndarray) -> Covariance:
    """Convert the covariance of a pose (see `Verdict.covariance`), and add its two standard deviations."""
    return Covariance(
        matrix=rows(matrix),
        # The root of the trace is the root mean square of the error's length, whatever its direction.
        sigma_deg=float(np.degrees(np.sqrt(np.trace(matrix[:3, :3])))),
        sigma_units=float(np.sqrt(np.trace(matrix[3:, 3:]))),
    )


def region_out(region: PriorRegion) -> RegionOut:
    """Convert the region of a prior."""
    if isinstance(region, BoxPrior):
        return RegionOut(box=[region.lower_in_world.tolist(), region.upper_in_world.tolist()])
    return RegionOut(covariance=covariance_out(region.covariance))


def lens_out(lens: StoredLens) -> LensOut:
    """Convert what is remembered of a lens; its sigmas are those of the next photo's prior."""
    key, estimate = lens.key, lens.estimate
    log_focal, k1, shift_x, shift_y = estimate.mean
    focal_sigma, k1_sigma, *shift_sigmas = estimate.prior_sigma()
    described = {name: value for name, value in asdict(key).items() if name != "owner"}
    return LensOut(
        id=key.id,
        # Without the hash of the key.
        owner=key.owner.removeprefix("key:").rpartition(":")[0] if key.owner.startswith("key:") else key.owner,
        **described,
        focal_length=float(np.exp(log_focal)),
        focal_sigma=focal_sigma,
        k1=k1,
        k1_sigma=k1_sigma,
        principal_point=[shift_x, shift_y],
        principal_point_sigma=max(shift_sigmas),
        # Both counts, since certainty comes from other viewpoints, not from more photos of one.
        photos=estimate.photos,
        viewpoints=estimate.viewpoints,
        tested=estimate.is_tested(),
        updated=datetime.fromtimestamp(lens.updated, UTC),
    )


def job_lens_out(recalled: RecalledLens) -> JobLensOut:
    """Convert what was known of a photo's lens."""
    return JobLensOut(
        id=recalled.id,
        intrinsics=intrinsics_out(recalled.intrinsics),
        focal_sigma=recalled.prior.log_focal_scale,
        k1_sigma=recalled.prior.k1_sigma,
        principal_point_sigma=recalled.prior.principal_point_scale,
        photos=recalled.photos,
    )


def timing_out(timing: StageTiming) -> Timing:
    """Convert the time that a stage took."""
    return Timing(stage=timing.stage, wall_s=timing.wall_s, cpu_s=timing.cpu_s)


def result_out(result: JobResult, anchors: Sequence[Anchor] = ()) -> Result:
    """Convert a finished estimate; `anchors` are those of the scene that the photo was localized in."""
    estimate, anchor = result.estimate, result.geo_anchor
    verdict, fitting = estimate.verdict, estimate.verdict.fitting_correction
    # Of a pose that is not to be used there is nothing to see.
    seen = anchors if verdict.status is not Status.NOT_LOCALIZED else ()
    return Result(
        status=verdict.status,
        reason=verdict.reason,
        search_summary=estimate.search_summary,
        hint=HINTS[verdict.reason],
        advice=list(estimate.advice),
        score=verdict.score,
        right_place=verdict.right_place,
        precise=verdict.precise,
        asked=verdict.asked and AskedOut(deg=verdict.asked[0], units=verdict.asked[1]),
        pose=result_pose_out(estimate.pose, estimate.frames),
        alternatives=[Alternative(probability=p, pose=pose_out(pose)) for pose, p in estimate.alternatives],
        geopose=anchor and geopose_out(anchor, estimate.pose),
        registered=result.registration and registered_out(result.registration, estimate.pose, verdict.covariance),
        anchors=seen_anchors(seen, estimate.pose, estimate.intrinsics, anchor),
        intrinsics=intrinsics_out(estimate.intrinsics),
        intrinsics_source=estimate.intrinsics_source,
        # Sent back, they are a start of an estimate, not a calibration.
        fitting_intrinsics=(
            fitting and intrinsics_out(replace(estimate.intrinsics.distorted(fitting), trust="approximate"))
        ),
        focal_sigma_px=verdict.focal_sigma * estimate.intrinsics.fx if verdict.focal_sigma else None,
        inliers=verdict.inliers,
        gradient_correlation=verdict.gradient_correlation,
        coverage=verdict.coverage,
        signals=dict(verdict.signals),
        covariance=None if verdict.covariance is None else covariance_out(verdict.covariance),
        covariance_given_lens=(
            None if verdict.covariance_given_lens is None else covariance_out(verdict.covariance_given_lens)
        ),
        timings=[timing_out(timing) for timing in (result.decode, *estimate.timings)],
        budget_exhausted=estimate.budget_exhausted,
        seed=estimate.seed,
        estimator=estimate.estimator,
        matcher=estimate.matcher,
        rasterizer=estimate.rasterizer,
        scene=SceneRef(id=estimate.scene_id, sha256=estimate.scene_sha256),
        scene_ranking=[RankedScene(id=scene, inliers=inliers) for scene, inliers in estimate.scene_ranking],
        versions=dict(result.versions),
        warnings=list(estimate.warnings),
        frames=None if result.frames is None else [frame_out(frame) for frame in result.frames],
    )
