"""A job as one HTML file that plays without a service: the scene with fewer splats, and each step with its render."""

from __future__ import annotations

import html
from types import SimpleNamespace

import viser

from service.labels import label
from service.results import IterationRecord
from viewer.camera_views import Viewpoint, view_from_behind
from viewer.colours import match_colours
from viewer.comparison_images import shrink
from viewer.job_stream import JobStream
from viewer.match_geometry import matches_at_pose
from viewer.scene_3d import Scene3D
from viewer.scene_cache import SceneContent
from viewer.service_values import Job, Splats
from viewer.viser_internals import disable_public_tunnels

MAX_SPLATS = 120_000
"""4 MB of the file."""
_MAX_STEPS = 60
_STEP_S, _END_S = 0.6, 2.0
_FRUSTUM_IMAGE_PX = 384


def replay_html(stream: JobStream, content: SceneContent) -> str:
    """Return the file's text: viser's page with a recording of at most 60 steps, evenly spaced, and the last.

    Requests a render of each step, which takes a while. Raises ServiceError, ValueError.
    """
    job, records = stream.job, stream.records[:]
    if job is None or not records:
        raise ValueError("the job has no steps yet")
    # viser records what a server shows, so a server on loopback runs for as long as the recording takes.
    server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
    try:
        disable_public_tunnels(server)
        scene = Scene3D(_RecordingCanvas(server))
        scene.show_scene(_with_fewer_splats(content), None)
        scene.splats.send()
        _set_initial_view(server, view_from_behind(records[-1].pose, content.extent, content.splats.centres))
        scene.trajectory.show(records, job)
        recording = server.get_scene_serializer()
        every = -(-len(records) // _MAX_STEPS)
        # The last record is the result and always included.
        shown = records[::every] if (len(records) - 1) % every == 0 else [*records[::every], records[-1]]
        for record in shown:
            _show_step(scene, stream, job, record)
            scene.trajectory.show_label(record.pose, _label(record, len(records), job))
            recording.insert_sleep(_STEP_S)
        recording.insert_sleep(_END_S)
        page = recording.as_html(dark_mode=True)
    finally:
        server.stop()
    # viser has no option for the title.
    return page.replace("<title>Viser</title>", f"<title>{html.escape(job.photo_name)} – splatfix</title>", 1)


class _RecordingCanvas:
    """A canvas for `Scene3D` without a browser, whose camera is set but not used."""

    def __init__(self, server: viser.ViserServer) -> None:
        self.scene, self.camera = server.scene, SimpleNamespace()
        self.atomic, self.flush = server.atomic, server.flush


def _label(record: IterationRecord, count: int, job: Job) -> str:
    text = f"step {record.index} of {count - 1}: {label('stage', record.stage)}"
    if record.index < count - 1 or job.outcome is None:
        return text
    return f"{text}, {job.outcome.status.replace('_', ' ')}"


def _show_step(scene: Scene3D, stream: JobStream, job: Job, record: IterationRecord) -> None:
    camera = job.camera(record)
    scene.trajectory.show_current(camera, shrink(stream.render(record.index, matched=False), _FRUSTUM_IMAGE_PX))
    scored = (r.candidates for r in reversed(stream.records[: record.index + 1]) if r.candidates)
    scene.candidates.show(next(scored, None), job.photo)
    source = stream.matches(record.index)
    view = matches_at_pose(source, camera, record.index) if source else None
    scene.matches.show(view, None if view is None else match_colours(view, "inlier"))


def _set_initial_view(server: viser.ViserServer, view: Viewpoint) -> None:
    camera = server.initial_camera
    camera.position, camera.look_at, camera.up, camera.fov = view.position, view.look_at, view.up, view.fov_rad


def _with_fewer_splats(content: SceneContent) -> SceneContent:
    splats, n = content.splats, MAX_SPLATS  # in order of importance, so the first ones are kept
    fewer = Splats(splats.centres[:n], splats.covariances[:n], splats.rgba[:n], splats.total)
    return SceneContent(content.description, fewer, content.extent)
