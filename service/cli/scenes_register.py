"""`splatfix scenes register`: where a scene is on Earth or in a frame in metres, how large, and which way is up."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.progress import track

from service.cli.terminal import (
    MatcherOption,
    err,
    loaded_scene,
    parsed_option,
    print_json,
    read_file,
    registrations_folder,
    say,
)
from service.errors import InvalidRequest, RegistrationFailed

if TYPE_CHECKING:
    from service.loaded_scene import LoadedScene
    from service.registration.gathering import GatherOptions, LocalizedPhoto
    from service.registration.known_places.known_place import KnownPlace, KnownPlaces
    from service.registration.known_places.scene_points import ScenePoints
    from service.registration.registration import Registration
    from service.registration.registration_file import RegistrationFile


def register_scene(
    scene: Annotated[Path, typer.Argument(help="Scene folder or scene file.")],
    photos: Annotated[
        list[Path] | None, typer.Argument(help="Photos whose places are known. Default: those that --places names.")
    ] = None,
    places: Annotated[
        Path | None,
        typer.Option(
            help="Where they were taken: CSV or JSON table, transforms.json of an AR recorder, Record3D's metadata, "
            "TUM trajectory, folder of a COLMAP model. Default: GPS in the photos' EXIF."
        ),
    ] = None,
    onto: Annotated[
        Path | None, typer.Option(help="Another scene of the same place, registered or with a known unit.")
    ] = None,
    points: Annotated[str, typer.Option(help="Points, lengths and floor points of the scene: JSON or a file.")] = "",
    times: Annotated[str, typer.Option(help="For a trajectory: JSON list of the photos' times, or a file.")] = "",
    up: Annotated[str, typer.Option(help="What is up in the frame of the places: JSON list, e.g. [0, 0, 1].")] = "",
    metres_per_unit: Annotated[float | None, typer.Option(min=1e-9, help="Of the scene, where it is certain.")] = None,
    drift: Annotated[float | None, typer.Option(min=0, max=1, help="Of the places, as a share of the path.")] = None,
    geoid_m: Annotated[float | None, typer.Option(help="Height of the geoid, added to EXIF's altitudes.")] = None,
    count: Annotated[int, typer.Option(min=1, max=100, help="Photos to localize at most, evenly chosen.")] = 20,
    matcher: MatcherOption = "",
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Don't keep the registration.")] = False,
    undo: Annotated[bool, typer.Option("--undo", help="Drop the latest registration.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print it as the API has it.")] = False,
) -> None:
    """Register a scene by photos with known places, points, a length, or a floor.

    Photos are localized in the scene; outliers are rejected. The registration is kept in registration.json beside the
    scene, or in the data folder where that can't be written.
    """
    from service.registration.registration_file import RegistrationFile

    file = RegistrationFile(scene, registrations_folder())
    if undo:
        _undo(file)
        return
    from service.registration.gathering import GatherOptions
    from service.registration.known_places import scene_points
    from service.registration.known_places.place_table import unit_vector

    axis = unit_vector(parsed_option(up, "--up"), "--up") if up else None
    options = GatherOptions(axis, metres_per_unit, drift)
    picked = scene_points.read(parsed_option(points, "--points"), "--points") if points else None
    if onto is not None and (photos or places or picked):
        raise InvalidRequest("needs no photos, places or points.", where="--onto")
    if onto is not None:
        found = _by_scene(scene, onto, matcher, count, options)
    else:
        known, chosen = _known_photos(photos or [], places, parsed_option(times, "--times"), geoid_m)
        found = _by_photos(scene, known, chosen, picked, count, matcher, options)
    if not dry_run:
        found = file.add(found)
    _show(found, None if dry_run else file.path, as_json=as_json)


def _by_photos(
    scene: Path,
    known: KnownPlaces,
    chosen: Sequence[tuple[KnownPlace, Path]],
    picked: ScenePoints | None,
    count: int,
    matcher: str,
    options: GatherOptions,
) -> Registration:
    """Register the scene by picked points and by photos, of which it localizes `count`. Raises InvalidRequest."""
    if not chosen and picked is None:
        raise InvalidRequest(
            "nothing to register by.", where="photos", hint="Name photos, --places with photos, or --points."
        )
    chosen = chosen[:: max(1, -(-len(chosen) // count))]
    # Points that are picked by hand need no view index, which takes the longest.
    loaded = loaded_scene(scene, "view_index" if chosen else None, matcher)
    localized, missed = _localized(chosen, loaded)
    found = _registered(loaded, known, localized, picked, options)
    return replace(found, warnings=(*known.warnings, *missed, *found.warnings))


def _by_scene(scene: Path, onto: Path, matcher: str, count: int, options: GatherOptions) -> Registration:
    """Register the scene in another one's world, and from there in its target frame."""
    from service.cli.scenes_onto import renders_in, target_of

    other, target = target_of(onto, matcher)
    loaded = loaded_scene(scene)
    known, localized, missed = renders_in(other, loaded, count)
    found = _registered(loaded, known, localized, None, options)
    found = replace(found, warnings=(*missed, *found.warnings))
    # A part of it would be in units of the other scene's world, which are no metres.
    if not found.is_complete:
        raise RegistrationFailed(found.reason, where="--onto", hint="Render more of it: --count.")
    return found.onto(target)


def _undo(file: RegistrationFile) -> None:
    before = file.undo()
    say("not registered any more" if before is None else f"revision {before.revision} is in force again")


def _known_photos(
    photos: Sequence[Path], places: Path | None, times: object, geoid_m: float | None
) -> tuple[KnownPlaces, list[tuple[KnownPlace, Path]]]:
    """Return what is known of places, and the photos with theirs. Raises InvalidRequest for a photo without one."""
    from service.photos.images import open_photo
    from service.registration.known_places import exif_places, trajectory_places
    from service.registration.known_places.known_place import KnownPlaces
    from service.registration.known_places.reading import read_places

    if places is None:
        known = exif_places.read([(str(p), open_photo(read_file(p)).gps) for p in photos], geoid_m)
        if photos and not known.places:
            raise InvalidRequest("no photo has a GPS position in its EXIF.", where="photos", hint="Give --places.")
        by_name = {place.name: place for place in known.places}
        found = [(by_name[str(p)], p) for p in photos if str(p) in by_name]
        return known if photos else KnownPlaces("points", ()), found
    known = read_places(places)
    if known.kind == "trajectory":
        if not isinstance(times, list) or len(times) != len(photos):
            raise InvalidRequest(f"needs the times of the {len(photos)} photos.", where="--times")
        timed = zip(photos, times, strict=True)
        return known, [(trajectory_places.at_time(known, float(time), str(p)), p) for p, time in timed]
    if not photos:
        return known, _beside(known, places)
    return known, [(_place_of(photo, known, places), photo) for photo in photos]


def _beside(known: KnownPlaces, places: Path) -> list[tuple[KnownPlace, Path]]:
    """Return the places whose photos lie beside their file, or in its folder of pictures."""
    folder = (places if places.is_dir() else places.parent).resolve()
    folders = [folder, *(folder / name for name in ("images", "rgb", "rgbd", "photos"))]
    found = []
    for place in known.places:
        tried = [f / (place.name + suffix) for f in folders for suffix in ("", ".jpg", ".png")]
        # A path out of the folder isn't followed.
        there = (p for p in tried if p.is_file() and p.resolve().is_relative_to(folder))
        if path := next(there, None):
            found.append((place, path))
    if not found:
        raise InvalidRequest("none of the photos that it names lies beside it.", where=str(places))
    return found


def _place_of(photo: Path, known: KnownPlaces, places: Path) -> KnownPlace:
    from service.scene_formats.training_files import same_photo

    named = [place for place in known.places if same_photo(place.name, photo.as_posix())]
    if len(named) != 1:
        problem = "has no place" if not named else f"has {len(named)} places"
        raise InvalidRequest(f"{problem} in {places.name}.", where=str(photo))
    return named[0]


def _localized(
    chosen: Sequence[tuple[KnownPlace, Path]], loaded: LoadedScene
) -> tuple[list[LocalizedPhoto], list[str]]:
    """Localize the photos; return those that were found, and a line for each other one."""
    from service.localize import localize
    from service.photos.images import open_photo
    from service.photos.intrinsics import ORIENTATIONS, oriented
    from service.registration.gathering import LocalizedPhoto
    from service.results import Status

    found, missed = [], []
    for place, path in track(chosen, "photos", console=err, transient=True):
        opened = open_photo(read_file(path))
        camera, stated = opened.camera, place.intrinsics
        # A photo that was resized or turned after its intrinsics were written has others.
        if stated is not None and (stated.width, stated.height) != (camera.width, camera.height):
            stated = None
        intrinsics = stated and oriented(stated, *ORIENTATIONS[camera.orientation])
        query = opened.query(intrinsics=intrinsics, background_rgb=loaded.scene.info.background_rgb)
        estimate = localize(query, loaded)
        if estimate.verdict.status is Status.LOCALIZED:
            pose, covariance = estimate.pose, estimate.verdict.covariance
            found.append(LocalizedPhoto(path.name, place, pose, covariance, camera.orientation))
        else:
            missed.append(f"{path.name} was not localized: {estimate.verdict.reason}.")
    return found, missed


def _registered(
    loaded: LoadedScene,
    known: KnownPlaces,
    localized: Sequence[LocalizedPhoto],
    picked: ScenePoints | None,
    options: GatherOptions,
) -> Registration:
    import time

    import numpy as np

    from service.registration.gathering import gathered
    from service.registration.register import register

    scene = loaded.scene
    cameras = [c.camera.pose.position_in_world for c in scene.cameras]
    above = np.mean(cameras, axis=0) if cameras else np.median(scene.means, axis=0).astype(np.float64)
    above = above + scene.info.origin_in_world
    evidence, origin = gathered(known, localized, picked, scene.info, above, options)
    # A fixed seed: the same places lead to the same registration.
    found = register(evidence, np.random.default_rng(0))
    return replace(found, origin=origin, source=known.kind, scene_sha256=scene.info.sha256, created=time.time())


def _show(found: Registration, path: Path | None, *, as_json: bool) -> None:
    if as_json:
        from service.web.schemas.registrations import registration_out

        print_json(registration_out(found, applies=True).model_dump(mode="json"))
        return
    for residual in found.residuals:
        parts = [residual.name, "used" if residual.used else "REJECTED"]
        parts += [f"{residual.metres:.3f} m"] if residual.metres is not None else []
        parts += [f"{residual.degrees:.2f} degrees"] if residual.degrees is not None else []
        say("  ".join(parts))
    say(f"determined: {', '.join(found.determined)}")
    for line in _uncertainty(found):
        say(line)
    for warning in found.warnings:
        say(f"warning: {warning}")
    say(f"revision {found.revision}, {path}" if path else "not kept (--dry-run)")


def _uncertainty(found: Registration) -> list[str]:
    import numpy as np

    sigma = np.sqrt(np.diag(found.covariance))
    lines = []
    if found.metres_per_unit is not None:
        lines.append(f"metres per unit: {found.metres_per_unit:.6g} +- {found.metres_per_unit_sigma:.2g}")
    if found.up_in_world is not None:
        lines.append(f"up in the scene: {' '.join(f'{v:.4f}' for v in found.up_in_world)}")
    if "heading" in found.determined:
        lines.append(f"rotation: +- {np.degrees(np.linalg.norm(sigma[:3])):.2g} degrees")
    if found.is_complete:
        lines.append(f"position: +- {np.linalg.norm(sigma[3:6]):.2g} m at the places' centre")
    if found.origin:
        place = found.origin
        lines.append(f"origin: {place.latitude_deg:.7f} {place.longitude_deg:.7f}, {place.height_m:.2f} m")
    return lines
