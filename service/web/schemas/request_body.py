"""Takes the body of a request to localize apart: a multipart form or JSON, to the photo and the fields beside it."""

from __future__ import annotations

import base64
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from anyio import to_thread
from pydantic_core import from_json
from starlette.datastructures import UploadFile
from starlette.exceptions import HTTPException
from starlette.requests import Request

from service.errors import InvalidImage, InvalidRequest
from service.jobs.read_photo import MAX_FRAMES
from service.photos.sequence import is_packed, is_sequence, packed
from service.web.schemas.requests import FIELD_ERRORS, LocalizeIn

_URL_SAFE = str.maketrans("-_", "+/")
_FIELDS = frozenset(LocalizeIn.model_fields)


@dataclass(frozen=True, slots=True)
class Body:
    """The parts of a body; the fields are not validated yet."""

    photo: bytes
    """A photo or a video; several photos are packed together."""
    name: str
    """Name of the file; empty if it has none."""
    fields: Mapping[str, Any]
    """Values by name, as JSON has them; of a form, text where a field is text."""


async def read_body(request: Request, max_frames: int = MAX_FRAMES) -> Body:
    """Read a multipart form or a JSON body. Raises InvalidRequest, InvalidImage; HTTPException 415 for other types."""
    # Nothing here unpacks a body: its size limit would hold for the packed bytes only.
    encoding = request.headers.get("content-encoding", "identity").strip().lower()
    if encoding != "identity":
        raise HTTPException(415, f"Send the body as it is: Content-Encoding '{encoding[:40]}' is not read.")
    media_type = request.headers.get("content-type", "").partition(";")[0].strip().lower()
    if media_type == "multipart/form-data":
        return await _form_body(request, max_frames)
    if media_type == "application/json":
        return await to_thread.run_sync(_json_body, await request.body())
    raise HTTPException(415, f"Send multipart/form-data or application/json, not '{media_type}'.")


async def _form_body(request: Request, max_frames: int) -> Body:
    async with request.form(max_files=max_frames, max_fields=24) as form:
        names = [name for name, _ in form.multi_items()]
        _refuse_unknown(names)
        repeated = sorted({name for name in names if name != "photo" and names.count(name) > 1})
        if repeated:
            raise InvalidRequest("given more than once.", where=repeated[0])
        photos = form.getlist("photo")
        if not photos or not all(isinstance(photo, UploadFile) for photo in photos):
            raise InvalidRequest("a file is required here.", where="photo", hint="With curl: -F photo=@photo.jpg")
        # Browsers send an empty text for each field that was left empty.
        texts = {name: str(value) for name, value in form.items() if name != "photo" and value != ""}
        # Ids of scenes can't begin with a bracket, so such a text is a list.
        as_json = {*FIELD_ERRORS, *(["scene"] if texts.get("scene", "").startswith("[") else [])}
        as_json -= {"gps"} if texts.get("gps") == "exif" else set()
        fields = {name: parsed_json(text, name) if name in as_json else text for name, text in texts.items()}
        files = [(p.filename or "", await p.read()) for p in photos if isinstance(p, UploadFile)]
        # Packing may take a second for many photos: not on the event loop.
        return await to_thread.run_sync(body_of, files, fields)


def _json_body(text: bytes) -> Body:
    value = parsed_json(text, "body")
    if not isinstance(value, dict):
        raise InvalidRequest("must be a JSON object.", where="body")
    _refuse_unknown(value)
    photo = value.pop("photo", None)
    if not isinstance(photo, str):
        raise InvalidRequest("the photo as base64 text is required here.", where="photo")
    return body_of([("", decoded_base64(photo, "photo"))], {name: v for name, v in value.items() if v is not None})


def decoded_base64(text: str, where: str) -> bytes:
    """Decode base64 in any of its forms: in lines (RFC 2045), URL-safe, unpadded, or as a data URI.

    Browsers, Android and command-line tools each write another one. Raises InvalidRequest.
    """
    if text.startswith("data:"):
        head, comma, text = text.partition(",")
        if not comma or not head.endswith(";base64"):
            raise InvalidRequest("a data URI that is not base64.", where=where)
    digits = "".join(text.split()).translate(_URL_SAFE).rstrip("=")
    try:
        return base64.b64decode(digits + "=" * (-len(digits) % 4), validate=True)
    except ValueError as error:
        raise InvalidRequest(f"not base64: {error}.", where=where) from error


def body_of(files: Sequence[tuple[str, bytes]], fields: Mapping[str, Any]) -> Body:
    """Combine files, as (name, content), to a body; several photos are packed. Raises InvalidImage, InvalidRequest."""
    for index, (_, data) in enumerate(files):
        # The service packs several photos as a ZIP of its own: a ZIP that was sent must not pass for one.
        if is_packed(data):
            raise InvalidImage("a ZIP is not a photo.", where="photo", hint="Send each photo as a part of its own.")
        if len(files) > 1 and is_sequence(data):
            raise InvalidRequest("a video is a job of its own.", where=f"photo.{index}")
    name, data = files[0]
    if len(files) == 1:
        return Body(data, name, fields)
    return Body(packed(files), f"{name} and {len(files) - 1} more", fields)


def _refuse_unknown(names: Iterable[str]) -> None:
    unknown = sorted(set(names) - _FIELDS)
    if unknown:
        known = ", ".join(sorted(_FIELDS))
        raise InvalidRequest("unknown field.", where=unknown[0], hint=f"Known: {known}.")


def parsed_json(text: str | bytes, where: str) -> Any:
    """Parse JSON of a request. Raises the error of `FIELD_ERRORS` for the field `where`."""
    try:
        return from_json(text)  # unlike json.loads, refuses unpaired surrogates and limits the depth
    except ValueError as error:
        raise FIELD_ERRORS.get(where, InvalidRequest)(f"not JSON: {error}.", where=where) from error
