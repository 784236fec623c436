"""Plain words for the names of stages, estimators, reasons and sources of intrinsics: what people are shown of them.

Pages and viewer show these; API, trace and files have the names. A plug-in's names, which are not listed, are shown
with spaces for their underscores.
"""

from __future__ import annotations

from typing import Literal, get_args

Kind = Literal["stage", "estimator", "reason", "source"]

STAGES = {
    # Around the search.
    "decode": "Read the photo",
    "scene_ranking": "Choose among the scenes",
    "other_scenes": "Search in other scenes",
    "localize": "Search the whole scene",
    "track": "Follow from the previous photo",
    "verify": "Check the pose",
    "fuse_readings": "Combine with the device's readings",
    # The default method.
    "retrieve": "Search among the scene's views",
    "retrieve_rotated": "Search with the photo turned",
    "retrieve_full_size": "Search with the photo in full size",
    "retrieve_more_views": "Search among further views",
    "await_index": "Wait for the whole view index",
    "retrieve_free_views": "Search among views from new places",
    "retrieve_by_readings": "Search where the device's readings say",
    "match": "Match with a view",
    "match_pooled": "Match with several views together",
    "rematch": "Match with a render at the pose",
    "refine": "Refine the pose by pixels",
    "refine_by_patches": "Refine the pose by the scene's photos",
    "sample_poses": "Try sampled poses",
    "check_readings": "Compare with the device's readings",
    "check_lens": "Check the lens",
    "check_shutter": "Check for a moving camera",
    "check_mirror": "Check for a mirrored photo",
    "check_rivals": "Check places that look alike",
    "check_ambiguity": "Check for other poses that fit",
    # Methods that move a given pose.
    "start": "Start from the given pose",
    "descend": "Move the pose step by step",
    "compare": "Compare with the render",
    "hypothesis": "Try a pose",
    "decouple": "Solve rotation and position apart",
    # Several photos of one rig.
    "rig": "Localize the photos together",
    "match_rig": "Match all photos",
    "rematch_rig": "Match all photos with renders",
    "refine_rig": "Refine the pose of all photos",
    "verify_rig": "Check the pose of all photos",
}
ESTIMATORS = {
    "view_index": "Search of the whole scene",
    "mc_do": "MC + DO: sampled poses, then matches",
    "icomma": "iComMa: matches and pixels from a given pose",
    "inerf": "iNeRF: some pixels from a given pose",
    "inerf_dagger": "iNeRF†: all pixels from a given pose",
    "pnerf": "pNeRF: many poses around a given one",
}
REASONS = {
    "verified": "Verified",
    "few_features": "Almost no texture in the photo",
    "no_matching_view": "Not found in the scene",
    "render_mismatch": "The scene looks different at the best guess",
    "few_inliers": "Too few matches agree",
    "low_coverage": "Little of the scene in view",
    "focal_uncertain": "Focal length uncertain",
    "intrinsics_contradicted": "The intrinsics do not fit the photo",
    "lens_unmodelled": "Unknown kind of lens",
    "position_uncertain": "Position uncertain",
    "outside_captured_volume": "Outside of what was captured",
    "outside_prior": "Outside of the prior",
    "ambiguous": "Several places fit",
    "mirrored": "Mirrored photo",
    "budget_exhausted": "Out of time",
}
SOURCES = {
    "given": "sent with the photo",
    "exif": "from EXIF",
    "guessed": "guessed",
    "memory": "from earlier photos of the camera",
    "fisheye": "a fisheye, by the photo itself",
}
TABLES: dict[Kind, dict[str, str]] = dict(zip(get_args(Kind), (STAGES, ESTIMATORS, REASONS, SOURCES), strict=True))


def label(kind: Kind, name: str) -> str:
    """Return the words for a name; of an unknown one, as of a plug-in, the name with spaces for its underscores."""
    return TABLES[kind].get(name) or name.replace("_", " ")
