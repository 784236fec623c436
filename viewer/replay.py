"""A job as one HTML file that plays from disk: the scene decimated, each step's render in its camera."""

from __future__ import annotations

import html
from types import SimpleNamespace

import viser

from service.results import IterationRecord
from viewer import frusta
from viewer.comparison_images import match_colours, reduced
from viewer.job_stream import JobStream, SceneContent
from viewer.match_geometry import matches_at_pose
from viewer.scene_3d import Scene3D
from viewer.service_client import JobView, Splats
from viewer.viser_internals import forbid_sharing

MAX_SPLATS = 120_000
"""4 MB of the file."""
_STEPS = 60
_STEP_S, _END_S = 0.6, 2.0
_TEXTURE_PX = 384


def replay_html(feed: JobStream, content: SceneContent) -> str:
    """Return the file's text; renders every step, which takes a while. Raises ServiceError, ValueError."""
    job, records = feed.job, feed.records[:]
    if job is None or not records:
        raise ValueError("the job has no steps yet")
    # viser records what a server shows: one of its own, on loopback, for as long as that takes.
    server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
    try:
        forbid_sharing(server)
        stage = Scene3D(_Tape(server))
        stage.show_scene(_decimated(content), None)
        stage.add_splats()
        _look(server, frusta.behind(records[-1].pose, content.extent, content.splats.centres))
        stage.show_trajectory(records, job)
        tape = server.get_scene_serializer()
        every = -(-len(records) // _STEPS)
        shown = records[::every] if (len(records) - 1) % every == 0 else [*records[::every], records[-1]]
        for record in shown:
            _show(stage, feed, record.index)
            stage.label(record.pose, _said(record, len(records), job))
            tape.insert_sleep(_STEP_S)
        tape.insert_sleep(_END_S)
        page = tape.as_html(dark_mode=True)
    finally:
        server.stop()
    return page.replace("<title>Viser</title>", f"<title>{html.escape(job.photo_name)} – splatfix</title>", 1)


class _Tape:
    """What `Scene3D` draws on; its camera is nobody's."""

    def __init__(self, server: viser.ViserServer) -> None:
        self.scene, self.camera = server.scene, SimpleNamespace()
        self.atomic, self.flush = server.atomic, server.flush


def _said(record: IterationRecord, count: int, job: JobView) -> str:
    text = f"step {record.index} of {count - 1}: {record.stage}"
    ended = record.index == count - 1 and job.answer is not None
    return f"{text}, {job.answer.status.replace('_', ' ')}" if ended and job.answer else text


def _show(stage: Scene3D, feed: JobStream, index: int) -> None:
    record, job = feed.records[index], feed.job
    if job is None:
        return
    render = reduced(feed.render(index, matched=False), _TEXTURE_PX)
    stage.show_current(job.camera(record), render)
    weighed = (r.candidates for r in reversed(feed.records[: index + 1]) if r.candidates)
    stage.show_candidates(next(weighed, None), job.photo)
    source = feed.matches(index)
    view = matches_at_pose(source, job.camera(record), index) if source else None
    stage.show_matches(view, None if view is None else match_colours(view, "inlier"))


def _look(server: viser.ViserServer, view: frusta.Viewpoint) -> None:
    camera = server.initial_camera
    camera.position, camera.look_at, camera.up, camera.fov = view.position, view.look_at, view.up, view.fov_rad


def _decimated(content: SceneContent) -> SceneContent:
    splats = content.splats  # the most important ones first
    n = MAX_SPLATS
    few = Splats(splats.centres[:n], splats.covariances[:n], splats.rgba[:n], splats.total)
    return SceneContent(content.view, few, content.extent)
