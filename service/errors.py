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
    code = "bad_input"


class InvalidRequest(BadInput):
    code = "invalid_request"


class InvalidImage(BadInput):
    code = "invalid_image"


class InvalidIntrinsics(BadInput):
    code = "invalid_intrinsics"


class InvalidPrior(BadInput):
    code = "invalid_prior"


class InvalidAccuracy(BadInput):
    code = "invalid_accuracy"


class InvalidOptions(BadInput):
    code = "invalid_options"


class UnknownName(BadInput):
    code = "unknown_name"


class RegistrationFailed(BadInput):
    code = "registration_failed"


class SceneError(SplatfixError):
    code = "scene_error"


class SceneNotFound(SceneError):
    code = "scene_not_found"


class UnsupportedFormat(SceneError):
    code = "unsupported_format"


class CorruptScene(SceneError):
    code = "corrupt_scene"


class SceneExists(SceneError):
    code = "scene_exists"


class SceneUnloaded(SceneError):
    code = "scene_unloaded"


class SceneInUse(SceneError):
    code = "scene_in_use"


class SceneTooLarge(SceneError):
    code = "scene_too_large"


class SceneNotReady(SceneError):
    code = "scene_not_ready"


class JobNotFound(SplatfixError):
    code = "job_not_found"


class RecordNotFound(SplatfixError):
    code = "record_not_found"


class KeyNotFound(SplatfixError):
    code = "key_not_found"


class LensNotFound(SplatfixError):
    code = "lens_not_found"


class AnchorNotFound(SplatfixError):
    code = "anchor_not_found"


class RegistrationNotFound(SplatfixError):
    code = "registration_not_found"


class JobNotReady(SplatfixError):
    code = "job_not_ready"


class NoPose(SplatfixError):
    code = "no_pose"


class NoGeoAnchor(SplatfixError):
    code = "no_geo_anchor"


class PhotoGone(SplatfixError):
    code = "photo_gone"


class IdempotencyConflict(SplatfixError):
    code = "idempotency_conflict"


class DeadlineExceeded(SplatfixError):
    code = "deadline_exceeded"


class Interrupted(SplatfixError):
    code = "interrupted"


class StorageFailed(SplatfixError):
    code = "storage_failed"


class QueueFull(SplatfixError):
    code = "queue_full"


class RateLimited(SplatfixError):
    code = "rate_limited"


class Unauthorized(SplatfixError):
    code = "unauthorized"


class Forbidden(SplatfixError):
    code = "forbidden"


class NoKeys(SplatfixError):
    code = "no_keys"


class BackendMissing(SplatfixError):
    code = "backend_missing"


class DeviceMemoryFull(SplatfixError):
    code = "device_memory_full"


class EstimatorFault(SplatfixError):
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
        return cls("internal_error", "The service failed; the reason is in its log.")
