"""All errors that are reported to callers.

    SplatfixError
      |-- BadInput           the caller's mistake
      |     |-- InvalidImage, InvalidIntrinsics, InvalidPrior, InvalidAccuracy, InvalidOptions, InvalidRequest
      |     |-- RegistrationFailed  (what is known of a scene's place determines nothing)
      |     `-- UnknownName  (a plug-in, scene or modification that does not exist; lists what does)
      |-- SceneError
      |     |-- SceneNotFound, UnsupportedFormat, CorruptScene
      |     |-- SceneExists
      |     |-- SceneUnloaded, SceneInUse, SceneTooLarge  (in memory, or not)
      |     `-- SceneNotReady  (still loading; try again later)
      |-- JobNotFound, RecordNotFound, JobNotReady
      |-- NoPose, NoGeoAnchor  what an export needs isn't there
      |-- PhotoGone          deleted after the job
      |-- LensNotFound       no such lens is remembered
      |-- AnchorNotFound     the scene has no anchor of that name
      |-- RegistrationNotFound  the scene isn't registered
      |-- IdempotencyConflict  a key was used for another request
      |-- DeadlineExceeded, Interrupted  why a job ended without a result
      |-- StorageFailed      the disk is full or broken; nothing was accepted
      |-- QueueFull, RateLimited  too much work is waiting, or too much of it is yours; try again later
      |-- Unauthorized, Forbidden, NoKeys
      |-- BackendMissing     a package or device that a plug-in needs is not here
      |-- DeviceMemoryFull   the GPU has too little memory left for a render
      `-- EstimatorFault     an estimator broke its contract (our mistake)

"Not localized" is a result, never an exception. Each class has a stable `code`, which is part of the API.
"""

from __future__ import annotations

from dataclasses import dataclass


class SplatfixError(Exception):
    """An error with a stable code, the place it concerns and a way to mend it."""

    code = "error"

    def __init__(self, message: str, *, where: str = "", hint: str = "", retry_after_s: int | None = None) -> None:
        super().__init__(message)
        self.message = message
        self.where = where
        """Field, file or element the error is about; empty if there is no such place."""
        self.hint = hint
        """What the caller can do; empty if the message says it."""
        self.retry_after_s = retry_after_s
        """Seconds until a retry may succeed; None: unknown."""

    def __str__(self) -> str:
        text = f"{self.where}: {self.message}" if self.where else self.message
        return f"{text} {self.hint}" if self.hint else text


class BadInput(SplatfixError):
    """Something that was sent can't be used."""

    code = "bad_input"


class InvalidRequest(BadInput):
    """A request, or an argument of a command, that is malformed."""

    code = "invalid_request"


class InvalidImage(BadInput):
    """A photo or a video that can't be decoded, or is too large."""

    code = "invalid_image"


class InvalidIntrinsics(BadInput):
    """A camera model that no camera has, or that doesn't belong to the photo."""

    code = "invalid_intrinsics"


class InvalidPrior(BadInput):
    """A pose, Gaussian or box that is none."""

    code = "invalid_prior"


class InvalidAccuracy(BadInput):
    """Bounds that no pose can have, or that mean nothing in the scene."""

    code = "invalid_accuracy"


class InvalidOptions(BadInput):
    """Options that an estimator doesn't have."""

    code = "invalid_options"


class UnknownName(BadInput):
    """A name that nothing has: of a plug-in, a modification, a row of a bench."""

    code = "unknown_name"


class RegistrationFailed(BadInput):
    """Known places that determine no registration, or contradict each other."""

    code = "registration_failed"


class SceneError(SplatfixError):
    """A scene that can't be used."""

    code = "scene_error"


class SceneNotFound(SceneError):
    """No scene of that name, or none at that path."""

    code = "scene_not_found"


class UnsupportedFormat(SceneError):
    """A file of a kind that no reader takes."""

    code = "unsupported_format"


class CorruptScene(SceneError):
    """A damaged file of a scene; `where` is the place of the damage."""

    code = "corrupt_scene"


class SceneExists(SceneError):
    """An upload under a name that another scene has."""

    code = "scene_exists"


class SceneUnloaded(SceneError):
    """A scene that was unloaded by request."""

    code = "scene_unloaded"


class SceneInUse(SceneError):
    """A scene that can't be removed: jobs use it, or the settings name it."""

    code = "scene_in_use"


class SceneTooLarge(SceneError):
    """A scene that takes more memory than all may."""

    code = "scene_too_large"


class SceneNotReady(SceneError):
    """A scene that is still being loaded."""

    code = "scene_not_ready"


class JobNotFound(SplatfixError):
    """No job of that id, not any more, or one that the caller may not see."""

    code = "job_not_found"


class RecordNotFound(SplatfixError):
    """A job that has fewer records."""

    code = "record_not_found"


class KeyNotFound(SplatfixError):
    """No API key of that name."""

    code = "key_not_found"


class LensNotFound(SplatfixError):
    """No lens of that id is remembered for the caller."""

    code = "lens_not_found"


class AnchorNotFound(SplatfixError):
    """The scene has no anchor of that name."""

    code = "anchor_not_found"


class RegistrationNotFound(SplatfixError):
    """The scene isn't registered."""

    code = "registration_not_found"


class JobNotReady(SplatfixError):
    """A job that has not come so far yet, or has ended otherwise."""

    code = "job_not_ready"


class NoPose(SplatfixError):
    """A job that found no pose that may be used."""

    code = "no_pose"


class NoGeoAnchor(SplatfixError):
    """A scene whose place on Earth isn't known."""

    code = "no_geo_anchor"


class PhotoGone(SplatfixError):
    """A photo that was deleted after its job."""

    code = "photo_gone"


class IdempotencyConflict(SplatfixError):
    """An idempotency key that was used for another request."""

    code = "idempotency_conflict"


class DeadlineExceeded(SplatfixError):
    """A job that could not start, or an answer that did not come, in time."""

    code = "deadline_exceeded"


class Interrupted(SplatfixError):
    """A job that ended without its fault: the service ended, or its thread was stuck."""

    code = "interrupted"


class StorageFailed(SplatfixError):
    """A disk or a database that can't be written or read; nothing was accepted."""

    code = "storage_failed"


class QueueFull(SplatfixError):
    """Too much work is waiting."""

    code = "queue_full"


class RateLimited(SplatfixError):
    """Too many requests of one client."""

    code = "rate_limited"


class Unauthorized(SplatfixError):
    """No key, or one that isn't valid."""

    code = "unauthorized"


class Forbidden(SplatfixError):
    """A key whose role doesn't suffice, or a request from another site's page."""

    code = "forbidden"


class NoKeys(SplatfixError):
    """An operation on keys where the service has none."""

    code = "no_keys"


class BackendMissing(SplatfixError):
    """A package, weights or a device that a plug-in needs isn't there."""

    code = "backend_missing"


class DeviceMemoryFull(SplatfixError):
    code = "device_memory_full"


class EstimatorFault(SplatfixError):
    """An estimator that broke its contract."""

    code = "estimator_fault"


@dataclass(frozen=True, slots=True)
class Failure:
    """An error as plain data: what a stored job and the status of a scene keep of it."""

    code: str
    """A SplatfixError's, or `internal_error` for any other exception."""
    message: str
    where: str = ""
    hint: str = ""

    @classmethod
    def of(cls, error: Exception) -> Failure:
        """Describe an exception; the message of one that isn't a SplatfixError stays in the log."""
        if isinstance(error, SplatfixError):
            return cls(error.code, error.message, error.where, error.hint)
        # Messages of other exceptions may hold the operator's paths.
        return cls("internal_error", "The service failed; the reason is in its log.")
