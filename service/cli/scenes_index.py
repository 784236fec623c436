"""`splatfix scenes index`: what localizing in a scene needs beside it, made before the first photo comes."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from service.cli.terminal import counter, loaded_scene, print_json, progress_bar, say

if TYPE_CHECKING:
    from service.pose.training_photos.digest import PhotoDigest


def index_scene(
    scene: Annotated[Path, typer.Argument(help="Scene folder or scene file.")],
    photos: Annotated[
        bool, typer.Option("--photos", help="Make a digest of the training photos, too, and store it in the folder.")
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print what was made as JSON.")] = False,
) -> None:
    """Make a scene's view index, which the first photo would wait for, and a digest of its training photos."""
    from service.loaded_scene import DEFAULT_ESTIMATOR

    loaded = loaded_scene(scene, DEFAULT_ESTIMATOR)
    # Prepared just now: this returns the index that is in memory.
    facts: dict[str, Any] = {"views": len(loaded.prepare(DEFAULT_ESTIMATOR).views)}
    if photos:
        from service.pose.training_photos.digest_file import DIGEST_FILE, write_digest

        with progress_bar() as progress:
            digest = loaded.digest_photos(scene, counter(progress, "photos"))
        write_digest(digest, scene / DIGEST_FILE)
        facts["training_photos"] = digest_facts(digest)
    if as_json:
        print_json(facts)
        return
    say(f"views              {facts['views']}")
    if photos:
        say(f"training photos    {digest_line(facts['training_photos'])}")


def digest_facts(digest: PhotoDigest) -> dict[str, Any]:
    """Return a digest's size, quality and effect; lengths in scene units."""
    without, with_digest = digest.effect or (None, None)
    return {
        "photos": len(digest.names),
        "points": len(digest.points.photo),
        "bytes": digest.nbytes,
        "reprojection_px": digest.reprojection_px,
        "depth_ratio": digest.depth_ratio,
        "poses_refined": digest.is_aligned,
        "distance_without": without,
        "distance_with": with_digest,
    }


def digest_line(facts: dict[str, Any]) -> str:
    """Return the facts in words."""
    size = f"{facts['points']:,} points of {facts['photos']} photos, {facts['bytes'] / 1e6:.1f} MB"
    size += f"; they agree within {facts['reprojection_px']:.2f} px"
    if facts["poses_refined"]:
        return f"{size}; the camera file's poses are not those of the scene: they were refined against it"
    if facts["distance_with"] is None:
        return f"{size}; no photo was localized by them"
    effect = f"{facts['distance_without']:.2g} units off without them, {facts['distance_with']:.2g} with them"
    return f"{size}; training photos are localized {effect}"
