"""What release 0.1.0 stored of a job, as JSON of its API, read as the values of `model`.

Written once, for version 1 of the database, and independent of today's API: an old request is read with its own rules.
Records of that release are not kept; a result's estimate has one record, with the pose.
"""

from __future__ import annotations

import json
from typing import Any

import numpy as np

from service.errors import Failure
from service.geometry import rotation_from_quat
from service.jobs.model import JobResult, JobSpec, PhotoInfo, SequenceFrame
from service.results import Candidates, IterationRecord, PoseEstimate, Reason, StageTiming, Status, Verdict
from service.types import BoxPrior, GaussianPosePrior, GeoAnchor, Intrinsics, Pose, PriorRegion

_OPENCV_FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
_RENAMED_REASONS = {
    "agrees": Reason.VERIFIED,
    "render_disagrees": Reason.RENDER_MISMATCH,
    "little_scene_in_view": Reason.LOW_COVERAGE,
    "place_uncertain": Reason.POSITION_UNCERTAIN,
}


def old_spec(text: str, estimator: str) -> JobSpec:
    """Read the column `fields`; `estimator` is the job's, which the request may have left out."""
    fields = json.loads(text)
    given = fields["prior"]
    prior = given and _given_pose(given)
    times, scene = fields["times_s"], fields["scene"]
    return JobSpec(
        estimator=estimator,
        scene=tuple(scene) if isinstance(scene, list) else scene,
        options=fields["options"],
        intrinsics=fields["intrinsics"] and _intrinsics(fields["intrinsics"]),
        prior=prior,
        region=_region(given, prior) if given else None,
        truth=fields["truth"] and _given_pose(fields["truth"]),
        every=fields["every"],
        times_s=tuple(times) if times else None,
        seed=fields["seed"],
        budget_s=fields["budget_s"],
        deadline_s=fields["deadline_s"],
        keep_photo=fields["keep_photo"],
    )


def old_photo(text: str) -> PhotoInfo:
    """Read the column `photo`."""
    photo = json.loads(text)
    return PhotoInfo(photo["name"], photo["sha256"], _intrinsics(photo["intrinsics"]))


def old_failure(text: str) -> Failure:
    """Read the column `error`, a problem document."""
    problem = json.loads(text)
    return Failure(problem["code"], problem["detail"], problem["where"], problem["hint"])


def old_result(text: str) -> JobResult:
    """Read the column `result`."""
    result = json.loads(text)
    pose, intrinsics = _pose(result["pose"]), _intrinsics(result["intrinsics"])
    # The first timing was always that of decoding.
    decode, *timings = (StageTiming(t["stage"], t["wall_s"], t["cpu_s"]) for t in result["timings"])
    others = result["alternatives"]
    alternatives = Candidates(
        np.array([other["pose"]["world_from_camera"]["matrix"] for other in others], np.float64).reshape(-1, 4, 4),
        np.array([other["probability"] for other in others], np.float64),
    )
    estimate = PoseEstimate(
        pose=pose,
        verdict=_verdict(result, intrinsics),
        intrinsics=intrinsics,
        intrinsics_source=result["intrinsics_source"],
        scene_id=result["scene"]["id"],
        scene_sha256=result["scene"]["sha256"],
        estimator=result["estimator"],
        rasterizer=result["rasterizer"],
        matcher=result["matcher"],
        seed=result["seed"],
        budget_exhausted=result["budget_exhausted"],
        renders=0,
        timings=tuple(timings),
        warnings=tuple(result["warnings"]),
        # Release 0.1.0 stored the other answers with the result; now they are in the last record.
        records=(IterationRecord(timings[-1].stage, pose, alternatives=alternatives if others else None),),
        scene_ranking=tuple((scene["id"], scene["matches"]) for scene in result["considered"]),
    )
    anchor = _anchor(result["geopose"], pose) if result["geopose"] else None
    frames = result["frames"]
    return JobResult(
        estimate, decode, anchor, result["versions"], None if frames is None else tuple(map(_frame, frames))
    )


def _verdict(result: dict[str, Any], intrinsics: Intrinsics) -> Verdict:
    return Verdict(
        Status(result["status"]),
        _reason(result["reason"]),
        result["score"],
        result["inliers"],
        result["agreement"],
        result["coverage"],
        _covariance(result["covariance"]),
        correction_sigma=((result["focal_sigma_px"] or 0.0) / intrinsics.fx, 0.0, 0.0, 0.0),
        signals=result["signals"],
    )


def _frame(frame: dict[str, Any]) -> SequenceFrame:
    return SequenceFrame(
        index=frame["index"],
        name=frame["name"],
        time_s=frame["time_s"],
        status=Status(frame["status"]),
        reason=_reason(frame["reason"]),
        score=frame["score"],
        tracked=frame["followed"],
        pose=_pose(frame),
        covariance=_covariance(frame["covariance"]),
    )


def _reason(name: str) -> Reason:
    return _RENAMED_REASONS.get(name) or Reason(name)


def _pose(spelled: dict[str, Any]) -> Pose:
    return Pose(np.array(spelled["world_from_camera"]["matrix"], np.float64))


def _covariance(given: dict[str, Any] | None) -> np.ndarray | None:
    return None if given is None else np.array(given["matrix"], np.float64)


def _intrinsics(given: dict[str, Any]) -> Intrinsics:
    values: dict[str, Any] = {**given, "distortion": tuple(given.get("distortion", ()))}
    return Intrinsics(**values)


def _anchor(geopose: dict[str, Any], pose: Pose) -> GeoAnchor:
    """Return an anchor at the camera that gives the same pose on Earth; the scene's own wasn't stored."""
    place, turn = geopose["position"], geopose["quaternion"]
    enu_from_camera = np.eye(4)
    enu_from_camera[:3, :3] = rotation_from_quat(np.array([turn[name] for name in "wxyz"]))
    enu_from_world = enu_from_camera @ _OPENCV_FROM_OPENGL @ pose.camera_from_world
    return GeoAnchor(place["lat"], place["lon"], place["h"], enu_from_world)


def _given_pose(given: dict[str, Any]) -> Pose | None:
    """Read a pose in any of the spellings that requests had; None if there is none."""
    if given["world_from_camera"]:
        matrix = np.array(given["world_from_camera"], np.float64)
    elif given["camera_from_world"]:
        matrix = Pose(np.array(given["camera_from_world"], np.float64)).camera_from_world
    elif given["position"]:
        matrix = np.eye(4)
        matrix[:3, :3] = rotation_from_quat(np.array(given["quaternion_wxyz"], np.float64))
        matrix[:3, 3] = given["position"]
    else:
        return None
    # The convention is that of the camera axes, so it is applied on the right.
    return Pose(matrix @ _OPENCV_FROM_OPENGL if given["convention"] == "opengl" else matrix)


def _region(given: dict[str, Any], prior: Pose | None) -> PriorRegion | None:
    if given["box"]:
        return BoxPrior(np.array(given["box"][0]), np.array(given["box"][1]))
    if prior is not None and given["covariance"]:
        return GaussianPosePrior(prior, np.array(given["covariance"], np.float64))
    if prior is not None and given["sigma_deg"]:
        # A twist is rotation first, then translation.
        spread = np.repeat([np.radians(given["sigma_deg"]), given["sigma_units"]], 3)
        return GaussianPosePrior(prior, np.diag(spread**2))
    return None
