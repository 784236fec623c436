"""`splatfix render`: an image of a scene at a pose."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from service.cli.terminal import IntrinsicsOption, loaded_scene, parsed_option
from service.errors import InvalidRequest


def render(
    scene: Annotated[Path, typer.Option("--scene", help="Scene folder or scene file.")],
    pose: Annotated[str, typer.Option(help="Pose in the API's format of a prior: JSON, or a file.")],
    out_file: Annotated[Path, typer.Option("--out", help="A .png or .jpg to write.")],
    intrinsics: IntrinsicsOption = "",
) -> None:
    """Render a scene; without intrinsics as its first training camera sees, or 640 x 480."""
    from service.scene_manager.scene_images import picture
    from service.scene_manager.status import PictureSpec
    from service.web.schemas.job_spec import checked_intrinsics, pose_from, read_fields

    # `truth` is the field of the API that is a pose and nothing else.
    fields = read_fields({"truth": parsed_option(pose, "truth")})
    if fields.truth is None:
        raise InvalidRequest("a pose is required.", where="--pose")
    kind = out_file.suffix.lower().removeprefix(".").replace("jpeg", "jpg")
    if kind not in ("png", "jpg"):
        raise InvalidRequest("must end with .png or .jpg.", where="--out")
    given = parsed_option(intrinsics, "intrinsics")
    camera = None if given is None else checked_intrinsics(given)
    wanted = PictureSpec(pose_from(fields.truth, "pose"), camera, "png" if kind == "png" else "jpeg")
    out_file.write_bytes(picture(loaded_scene(scene), wanted))
