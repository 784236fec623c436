"""Two facts about a scene, computed from its view index: how does it repeat itself, and is it like its mirror image?

A photo that fits one pose fits another one, too, if a rigid motion carries what it shows onto something that looks the
same. Only where a scene is like its mirror image can a mirrored photo pass for a photo of the scene.

A view finds such a motion among the other views as a photo would: many of its matches agree on another pose, and a
render there looks like the view. What a room that is the same upside down shows to a level camera it also shows to one
held upside down, of which the index has none, and descriptors tolerate but little rotation: so views are turned by
quarters, too.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float32, Float64

from service.geometry import pose_distance, project, transformed
from service.interfaces import Features, Frame, Matcher, Rasterizer
from service.pose.absolute_pose.pnp import estimate_absolute_pose
from service.pose.features.image_sizes import scaled_px
from service.pose.features.mirrored_query import mirrored_intrinsics
from service.pose.features.query_images import QueryImages
from service.pose.features.rendered_views import VIEWS, View, camera_of, to_uint8
from service.pose.matching.correspondences import MATCH_ERROR_PX, correspondences
from service.pose.refinement.photometric import refine_photometric
from service.pose.retrieval.ambiguous_hypotheses import AMBIGUITY, AmbiguityConfig, PoseAtDistance, ambiguous_hypotheses
from service.pose.retrieval.inverted_views import InvertedViews, view_scores
from service.pose.retrieval.scores import top_indices
from service.types import Camera, Pose


@dataclass(frozen=True, slots=True)
class SymmetryConfig:
    """How much of the index is examined, and how many matches decide."""

    max_views: int = 128
    """A larger scene is taken to repeat itself: examining it takes 10 ms a view, and more the more views there are."""
    every: int = 2
    """Of the views, every second one is compared with the others..."""
    max_turned: int = 24
    """...of which at most so many are turned, too; of a larger scene only these are compared."""
    compared_px: int = 256
    """Long side of the render from where a view is seen elsewhere..."""
    compared_levels: int = 3
    max_residual: float = 0.03
    """...and the mean residual, 0..1, after refinement on it, up to which that looks like the view: planted repetitions
    have 0.001 to 0.017, what is but similar in fountain 0.032 and more, in chair 0.081 and more."""
    turned_share: float = 0.77
    """Size of turned images, relative to the views: features tolerate it, and take two thirds of the time."""
    min_repeated_inliers: int = 30
    """Matches of a view that agree on another pose, in a scene that repeats itself: chair, materials, templeRing and
    fountain have views with 35 to 124, studio, fox and fern none with more than 24."""
    mirror_probes: int = 4
    mirror_tries: int = 2
    """Views whose mirror images are looked for, and the views that each is matched with."""
    mirror_trials: int = 500
    """Of RANSAC."""
    min_mirror_inliers: int = 60
    """Matches on which the median mirrored view must agree: of the test scenes chair, materials and fountain have 130
    to 250, templeRing has 42, those without a symmetry 10 to 20."""

    part_points: int = 32
    """Points that stand for what a view shows."""
    min_seen_share: float = 0.3
    """Share of them in an image, from which on it shows the same part."""
    max_twins: int = 4
    """Poses beside an answer that are compared with it, by a small render each..."""
    same_twin_deg: float = 10.0
    same_twin_share: float = 0.1
    """...of which none are nearer to each other (degrees; share of the distance to what is seen): several views find
    the same motion."""


SYMMETRY = SymmetryConfig()
ANYWHERE = replace(AMBIGUITY, same_view_deg=-1.0)
"""A turned view has not the pose that its features seem to be seen from: no view shows the same."""


@dataclass(frozen=True, slots=True)
class Repetitions:
    """Rigid motions that carry some part of a scene onto another that looks like it."""

    motions: Float64[np.ndarray, "k 4 4"]
    points_in_world: Float32[np.ndarray, "k n 3"]
    """Points of the part that each of them carries."""

    @classmethod
    def of(cls, motions: Sequence[np.ndarray], parts: Sequence[np.ndarray]) -> Repetitions:
        """Return the motions and their inverses, which carry the parts back."""
        if not motions:
            return NO_REPETITIONS
        there, back = np.stack(motions), np.linalg.inv(np.stack(motions))
        points = np.stack(parts)
        carried = np.stack([transformed(m, p) for m, p in zip(there, points, strict=True)])
        return cls(np.concatenate([there, back]), np.concatenate([points, carried]).astype(np.float32))

    def twins(self, camera: Camera, distance: float, config: SymmetryConfig = SYMMETRY) -> list[Pose]:
        """Return the poses from which the scene may look as it does from this camera; those first whose parts it sees
        the most of. `distance`: the median one to what it sees."""
        seen = np.array([_share_in_image(points, camera) for points in self.points_in_world])
        # A motion that leads back to the camera is none.
        found = [camera.pose]
        for i in np.argsort(-seen, kind="stable"):
            if seen[i] < config.min_seen_share or len(found) > config.max_twins:
                break
            twin = Pose(self.motions[i] @ camera.pose.world_from_camera)
            if not any(_is_near(twin, known, distance, config) for known in found):
                found.append(twin)
        return found[1:]


NO_REPETITIONS = Repetitions(np.empty((0, 4, 4)), np.empty((0, 0, 3), np.float32))


def _share_in_image(points: Float32[np.ndarray, "n 3"], camera: Camera) -> float:
    in_camera = transformed(camera.pose.camera_from_world, points)
    ahead = in_camera[in_camera[:, 2] > 0]
    px, size = project(ahead, camera.intrinsics), camera.intrinsics
    return float(((px > 0) & (px < [size.width, size.height])).all(1).sum() / len(points))


def _is_near(pose: Pose, other: Pose, distance: float, config: SymmetryConfig) -> bool:
    angle, way = pose_distance(pose, other)
    return angle < config.same_twin_deg and way < config.same_twin_share * distance


def is_examined(number: int, count: int, config: SymmetryConfig = SYMMETRY) -> bool:
    """Return whether the view of this number, of so many, is compared with the others."""
    # Repetition is mutual: of two views that look alike at least one is likely among them.
    every = config.every if count <= config.max_views else -(-count // config.max_turned)
    return number % every == 0


def _is_turned(number: int, count: int, config: SymmetryConfig) -> bool:
    """Return whether an examined view is turned, too."""
    return count > config.max_views or number % (config.every * -(-count // (config.every * config.max_turned))) == 0


def find_repetitions(
    views: Sequence[View],
    words: InvertedViews | None,
    pictures: Sequence[QueryImages | None],
    rasterizer: Rasterizer,
    matcher: Matcher,
    pool: Executor,
    config: SymmetryConfig = SYMMETRY,
) -> tuple[Repetitions, bool]:
    """Return the motions that repeat the scene, and whether it repeats itself: what some view shows is seen elsewhere.

    `pictures` are the renders of the views that are examined (`is_examined`). A scene of too many views is taken to
    repeat itself.
    """
    are_many = len(views) > config.max_views

    def examined(number: int, view: View, images: QueryImages | None) -> tuple[list[np.ndarray], bool]:
        if images is None or len(view.points_in_world) == 0:
            return [], False
        # In a large scene a photo's own matches tell where it is seen as it is.
        upright = (
            [] if are_many else _seen_from_elsewhere(view, view.features, views, words, matcher, AMBIGUITY, config)
        )
        turned = [
            pose
            for features in (_turned(images, config) if _is_turned(number, len(views), config) else ())
            for pose in _seen_from_elsewhere(view, features, views, words, matcher, ANYWHERE, config)
        ]
        alike = [_if_alike(images, pose, rasterizer, config) for pose in (*upright, *turned)]
        own = view.camera.pose.camera_from_world
        return [pose.world_from_camera @ own for pose in alike if pose], bool(upright)

    found = list(pool.map(examined, range(len(views)), views, pictures))
    motions = [(motion, _sample(view, config)) for view, (some, _) in zip(views, found, strict=True) for motion in some]
    repetitions = Repetitions.of([motion for motion, _ in motions], [part for _, part in motions])
    return repetitions, are_many or bool(motions) or any(is_repeated for _, is_repeated in found)


def _turned(images: QueryImages, config: SymmetryConfig) -> Iterator[Features]:
    """Yield a view's features as its image turned by one, two and three quarters has them, in pixels of the view."""
    size = round(config.turned_share * images.query.intrinsics.long_side)
    return (images.features(size, 2 * quarters) for quarters in (1, 2, 3))


def _seen_from_elsewhere(
    view: View,
    features: Features,
    views: Sequence[View],
    words: InvertedViews | None,
    matcher: Matcher,
    ambiguity: AmbiguityConfig,
    config: SymmetryConfig,
) -> list[Pose]:
    """Return the other poses that many of a view's matches agree on, with these features of it."""
    # The view's own pose is the answer that others are compared with.
    own, intrinsics = PoseAtDistance(view.camera.pose, view.distance), view.camera.intrinsics
    scores = view_scores(features.descriptors, views, words)
    error_px, least = scaled_px(MATCH_ERROR_PX, intrinsics), config.min_repeated_inliers
    found = ambiguous_hypotheses(features, intrinsics, own, views, scores, matcher, error_px, least, ambiguity)
    return [other.pose for other in found]


def _if_alike(images: QueryImages, pose: Pose, rasterizer: Rasterizer, config: SymmetryConfig) -> Pose | None:
    """Return a pose from which the scene looks as in a view, refined; None if it looks otherwise from there."""
    camera = camera_of(images.query, pose, config.compared_px)
    (frame,) = rasterizer.render([camera])
    found = refine_photometric(images.resized(camera.intrinsics), frame, camera, camera, config.compared_levels)
    return found.pose if found.loss <= config.max_residual else None


def _sample(view: View, config: SymmetryConfig) -> Float32[np.ndarray, "n 3"]:
    points = view.points_in_world
    return points[np.linspace(0, len(points) - 1, config.part_points).astype(int)]


def like_its_mirror_image(
    views: Sequence[View],
    words: InvertedViews | None,
    rasterizer: Rasterizer,
    matcher: Matcher,
    pool: Executor,
    config: SymmetryConfig = SYMMETRY,
) -> bool:
    """Return whether mirrored renders of the scene are localized in it."""
    if not views:
        return False
    # Spread over the index, whose views are spread over the scene.
    probes = np.unique(np.linspace(0, len(views) - 1, config.mirror_probes).astype(int))
    frames = rasterizer.render([views[i].camera for i in probes])
    inliers = pool.map(
        lambda i, frame: _mirrored_inliers(views[i], frame, views, words, matcher, config), probes, frames
    )
    return float(np.median(list(inliers))) >= config.min_mirror_inliers


def _mirrored_inliers(
    view: View,
    frame: Frame,
    views: Sequence[View],
    words: InvertedViews | None,
    matcher: Matcher,
    config: SymmetryConfig,
) -> int:
    """Return how many matches of a mirrored view with one of the others agree on a pose, at most."""
    intrinsics = mirrored_intrinsics(view.camera.intrinsics)
    # Mirroring the image changes its features, so they can't be taken from the index.
    features = matcher.extract(np.ascontiguousarray(to_uint8(frame.rgb)[:, ::-1]), VIEWS.max_features)
    scores = view_scores(features.descriptors, views, words)
    error_px = scaled_px(MATCH_ERROR_PX, intrinsics)
    most = 0
    for i in top_indices(scores, config.mirror_tries):
        found = correspondences(features, views[i], matcher)
        pose = estimate_absolute_pose(found.photo_px, found.points_in_world, intrinsics, error_px, config.mirror_trials)
        most = max(most, pose.num_inliers if pose else 0)
    return most
