"""The JSON messages of a live session."""

from __future__ import annotations

import json
import math
from typing import Any, Literal

from pydantic import Field, ValidationError
from pydantic.json_schema import JsonSchemaMode, models_json_schema

from service.accuracy import DEFAULT_ACCURACY, Accuracy
from service.errors import InvalidRequest
from service.live.live_values import LiveAnswer, LiveTask, Mode, OdometryFacts
from service.live.pace import Hint
from service.results import Status
from service.web.api_model import Model
from service.web.problems import field_and_message
from service.web.schemas.conversion import intrinsics_out, rows
from service.web.schemas.job_spec import checked_intrinsics, prior_from
from service.web.schemas.poses import IntrinsicsOut, Matrix
from service.web.schemas.requests import FIELD_ERRORS, AccuracyIn, PriorIn

PROTOCOL = 1
"""Version of the messages."""


class LiveOdometryIn(Model):
    """What holds for the odometry of all frames; see docs/live.md."""

    metric: bool = True
    """Its unit is the metre. Then a scene whose manifest has `metres_per_unit` needs no baseline to know the scale."""
    up_in_odom: list[float] | None = Field(default=None, min_length=3, max_length=3)
    """Up by gravity in its frame, of any length: [0, 1, 0] for ARKit, ARCore and WebXR. Used in scenes that know what
    is up, and tested against the frames' poses."""
    up_sigma_deg: float = Field(default=1.0, gt=0, le=45, allow_inf_nan=False)
    """Standard deviation of that, and of the frames' own `up_in_camera`."""
    smooth: bool = True
    """`world_from_odom` changes by at most 1 cm and 0.2 degrees a frame at the camera, unless odometry began anew."""


class LiveHello(Model):
    """The client's first message, and its only one in JSON."""

    type: Literal["hello"]
    version: Literal[1]
    intrinsics: dict[str, Any] | None = None
    """Of the frames, as in a request to localize; for frames of another size and the same shape they are resized.
    Default: what EXIF data or a guess says, estimated with the first pose, and kept. A frame may bring its own."""
    prior: PriorIn | None = None
    """Of the first frame; a box or a Gaussian holds for all."""
    accuracy: AccuracyIn | None = None
    odometry: LiveOdometryIn | None = None
    """Of frames that bring some; default: metric, without gravity."""
    seed: int = Field(default=0, ge=0, lt=2**63)


class LiveLimits(Model):
    """What ends a session that exceeds it."""

    frame_bytes: int
    """Of a message with its header: close code 4413."""
    frames_per_s: int
    """On average over two seconds: 4429."""
    idle_s: float
    """Time without a frame: 4408."""


class LiveHint(Model):
    """What the client had better send; sent whenever that changes."""

    type: Literal["hint"] = "hint"
    max_fps: int | None = None
    """More frames a second would be dropped. None: all are used, or could be."""
    long_side_px: int | None = None
    """A better long side of the frames. None: it is fine."""


class LiveWelcome(Model):
    """The answer to the hello: the session begins."""

    type: Literal["welcome"] = "welcome"
    version: Literal[1] = 1
    scene: str
    limits: LiveLimits


class LiveAnswerOut(Model):
    """The answer for a frame that was used."""

    type: Literal["answer"] = "answer"
    id: int
    """The frame's."""
    time_s: float
    """The frame's."""
    mode: Mode
    """`tracking`: with a pose of its own. `carried`: with a pose by odometry since frames that had one. `relocalizing`:
    without one, the first search goes on. `lost`: searches found nothing; they go on."""
    status: Status
    """`localized` and `uncertain` as in results; `uncertain` for carried poses; `not_localized` without a pose."""
    reason: str | None = None
    """What decided the status; None without a pose of its own."""
    score: float | None = None
    """Probability that the pose is as accurate as was asked for."""
    world_from_camera: Matrix | None = None
    """4x4, row-major, in OpenCV camera axes and scene units."""
    covariance: Matrix | None = None
    """6x6, of the twist (rotation in rad, translation in units) in the camera frame: true = pose @ exp(twist)."""
    intrinsics: IntrinsicsOut | None = None
    """That the pose belongs to."""
    world_from_odom: Matrix | None = None
    """4x4, row-major: the similarity that takes points of the odometry's frame to the scene, and its camera at this
    frame to where it is, by all frames so far. None without odometry; after it began anew until a frame is found."""
    units_per_odom: float | None = None
    """The similarity's scale: scene units per unit of the odometry."""
    odom_covariance: Matrix | None = None
    """7x7, of the twist (rotation in rad, translation in units) in this frame's camera, as `covariance`, and the
    scale's logarithm: of the camera where `world_from_odom` puts this frame's odometry."""
    odom_offset_s: float | None = None
    """By how much the odometry's poses are late: they belong to a time that is this much after the frame's."""
    odom_resets: int | None = None
    """How often the odometry began anew: a higher number says that `world_from_odom` has jumped."""
    waited_ms: float
    """From the frame's arrival to its use."""
    used_ms: float
    """From then to the answer."""
    dropped: list[int]
    """Ids of the frames since the last answer that a newer one replaced before they were used."""


def read_hello(text: str) -> LiveHello:
    """Validate the first message. Raises BadInput."""
    try:
        return LiveHello.model_validate(json.loads(text))
    except ValidationError as error:
        where, message = field_and_message(error.errors(), LiveHello)
        raise FIELD_ERRORS.get(where.partition(".")[0], InvalidRequest)(message, where=where) from error
    except ValueError as error:  # JSON's, of which pydantic's is a kind
        raise InvalidRequest(f"the first message is not JSON: {error}.", where="hello") from error


def live_task(hello: LiveHello, held: str, estimator: str) -> LiveTask:
    """Convert a hello to what an engine is to do in the scene that is held. Raises BadInput."""
    prior, region = (None, None) if hello.prior is None else prior_from(hello.prior)
    return LiveTask(
        held=held,
        estimator=estimator,
        seed=hello.seed,
        intrinsics=None if hello.intrinsics is None else checked_intrinsics(hello.intrinsics),
        prior=prior,
        region=region,
        accuracy=DEFAULT_ACCURACY if hello.accuracy is None else Accuracy(**hello.accuracy.model_dump()),
        odometry=OdometryFacts() if hello.odometry is None else _odometry_facts(hello.odometry),
    )


def _odometry_facts(given: LiveOdometryIn) -> OdometryFacts:
    up = given.up_in_odom
    if up is None:
        return OdometryFacts(given.metric, None, given.up_sigma_deg, given.smooth)
    x, y, z = up
    # `not`: NaN compares false.
    if not 1e-6 < math.hypot(x, y, z) < 1e6:
        raise InvalidRequest(f"is no direction: {x:g}, {y:g}, {z:g}.", where="odometry.up_in_odom")
    return OdometryFacts(given.metric, (x, y, z), given.up_sigma_deg, given.smooth)


def live_answer_out(answer: LiveAnswer, waited_s: float, dropped: tuple[int, ...]) -> LiveAnswerOut:
    """Convert an answer."""
    pose, verdict, odometry = answer.pose, answer.verdict, answer.odometry
    covariance = answer.covariance if verdict is None else verdict.covariance
    without = Status.NOT_LOCALIZED if pose is None else Status.UNCERTAIN
    return LiveAnswerOut(
        id=answer.id,
        time_s=answer.time_s,
        mode=answer.mode,
        status=without if verdict is None else verdict.status,
        reason=None if verdict is None else str(verdict.reason),
        score=None if verdict is None else verdict.score,
        world_from_camera=None if pose is None else rows(pose.world_from_camera),
        covariance=None if covariance is None else rows(covariance),
        intrinsics=None if answer.intrinsics is None else intrinsics_out(answer.intrinsics),
        world_from_odom=None if odometry is None else rows(odometry.world_from_odom),
        units_per_odom=None if odometry is None else odometry.scale,
        odom_covariance=None if odometry is None else rows(odometry.covariance),
        odom_offset_s=None if odometry is None else odometry.offset_s,
        odom_resets=None if odometry is None else odometry.resets,
        waited_ms=1e3 * waited_s,
        used_ms=1e3 * answer.used_s,
        dropped=list(dropped),
    )


def live_hint_out(hint: Hint) -> LiveHint:
    """Convert advice."""
    return LiveHint(max_fps=hint.max_fps, long_side_px=hint.long_side_px)


def live_schema() -> str:
    """Return the text of docs/live.schema.json: each JSON message is one of its definitions."""
    messages: list[tuple[type[Model], JsonSchemaMode]] = [
        *((model, "serialization") for model in (LiveWelcome, LiveAnswerOut, LiveHint)),
        (LiveHello, "validation"),
    ]
    _, schema = models_json_schema(messages, ref_template="#/$defs/{model}")
    schema = {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": f"JSON messages of a live session, version {PROTOCOL}",
        "oneOf": [{"$ref": f"#/$defs/{model.__name__}"} for model, _ in messages],
        **schema,
    }
    return json.dumps(schema, indent=1) + "\n"
