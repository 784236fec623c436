"""`splatfix scenes align`: where the cameras are of a scene that was turned, moved or scaled after training."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from service.cli.terminal import counter, loaded_scene, progress_bar, say


def align_cameras(scene: Annotated[Path, typer.Argument(help="Scene folder with its camera file and photos.")]) -> None:
    """Localize training photos, and store in which frame of the scene the camera file is."""
    from service.errors import RegistrationFailed
    from service.loaded_scene import DEFAULT_ESTIMATOR
    from service.scene_manager.camera_frame import CAMERA_FRAME_CONFIG, found_camera_frame, is_sought

    loaded = loaded_scene(scene, DEFAULT_ESTIMATOR)
    if loaded.scene.cameras:
        frame = next((frame for frame in loaded.scene.info.frames if frame.name == "cameras"), None)
        say(f"nothing to do: the cameras fit the scene {frame.decided_by if frame else ''}".rstrip())
        return
    if not is_sought(loaded, scene):
        raise RegistrationFailed(
            f"fewer than {CAMERA_FRAME_CONFIG.least} photos of a camera file lie there.",
            where=str(scene),
            hint="Put them where the camera file says, or in a folder 'images' beside it.",
        )
    with progress_bar() as progress:
        found = found_camera_frame(loaded, scene, progress=counter(progress, "photos"))
    if found is None:
        raise RegistrationFailed(
            "the localized photos agree on no rotation, shift and scale of the cameras.",
            where=str(scene),
            hint="Check that camera file and photos are of this scene.",
        )
    found.write(scene)
    say(
        f"{found.agreeing} of {found.localized} localized photos agree, within {found.median_error:.3g} units of the "
        f"camera file and {found.median_deg:.2g} deg; {found.tried} were tried"
    )
