"""The scene's own origin: float32 Gaussians keep their precision where a file has coordinates as large as UTM's.

Inside of a scene positions are relative to `SceneInfo.origin_in_world`, with the world's axes and unit:
x_in_world = x_in_scene + origin. What enters and leaves (`localize`, pictures, lists of cameras) is in the world.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float64

from service.results import Candidates, IterationRecord, PoseEstimate
from service.types import BoxPrior, Camera, NamedCamera, Pose, PriorRegion, Query

Origin = tuple[float, float, float]


def shifted(pose: Pose, by: np.ndarray | Origin) -> Pose:
    """Return the pose with its position moved by a vector."""
    matrix = pose.world_from_camera.copy()
    matrix[:3, 3] += np.asarray(by, np.float64)
    return Pose(matrix)


def shifted_camera(named: NamedCamera, by: np.ndarray | Origin) -> NamedCamera:
    """Return the camera with its position moved by a vector."""
    return replace(named, camera=replace(named.camera, pose=shifted(named.camera.pose, by)))


def query_in_scene(query: Query, origin: Origin) -> Query:
    """Return the query with prior and region relative to the scene's origin."""
    back = -np.array(origin)
    prior = query.prior and shifted(query.prior, back)
    return replace(query, prior=prior, region=query.region and _shifted_region(query.region, back))


def record_in_world(record: IterationRecord, origin: Origin) -> IterationRecord:
    """Return the record with all of its poses in the world."""
    matches = record.matches
    if matches is not None:
        camera = matches.render_camera
        # Matches are pixels; only the camera that they refer to has a position.
        matches = replace(matches, render_camera=Camera(camera.intrinsics, shifted(camera.pose, origin)))
    return replace(
        record,
        pose=shifted(record.pose, origin),
        matches=matches,
        candidates=_shifted_candidates(record.candidates, origin),
        alternatives=_shifted_candidates(record.alternatives, origin),
    )


def estimate_in_world(estimate: PoseEstimate, origin: Origin) -> PoseEstimate:
    """Return the estimate with all of its poses in the world."""
    records = tuple(record_in_world(record, origin) for record in estimate.records)
    return replace(estimate, pose=shifted(estimate.pose, origin), records=records)


def _shifted_region(region: PriorRegion, by: Float64[np.ndarray, "3"]) -> PriorRegion:
    if isinstance(region, BoxPrior):
        return BoxPrior(region.lower_in_world + by, region.upper_in_world + by)
    return replace(region, pose=shifted(region.pose, by))


def _shifted_candidates(candidates: Candidates | None, by: Origin) -> Candidates | None:
    if candidates is None:
        return None
    # In double precision, like every pose: the sum of a large origin and a small offset is exact to nanometres.
    moved = candidates.world_from_camera.copy()
    moved[:, :3, 3] += by
    return replace(candidates, world_from_camera=moved)
