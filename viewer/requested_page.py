"""What a browser has opened: the job, and what its page reports of the browser (`service/web/static/viewer.js`)."""

from __future__ import annotations

import re
from dataclasses import dataclass
from urllib.parse import parse_qs
from zoneinfo import ZoneInfo

_JOB_PATH = re.compile(r"/jobs/([A-Za-z0-9_-]{1,64})/?")


@dataclass(frozen=True, slots=True)
class RequestedPage:
    """The path and query of a browser's WebSocket request."""

    job_id: str | None
    """None: the path has none, and the newest job is shown."""
    software: bool
    """The page draws WebGL in software, where splats would take seconds a frame."""
    zone: ZoneInfo | None
    """The browser's time zone; None: unknown, and this machine's is taken."""


def requested_page(path: str) -> RequestedPage:
    """Parse `/jobs/ID/?gl=software&zone=Europe/Berlin`; what can't be understood counts as not given."""
    path, _, query = path.partition("?")
    values = parse_qs(query)
    match = _JOB_PATH.fullmatch(path)
    software = values.get("gl") == ["software"]
    return RequestedPage(match.group(1) if match else None, software, _zone(values.get("zone", [""])[0]))


def _zone(name: str) -> ZoneInfo | None:
    try:
        return ZoneInfo(name) if name else None
    except (KeyError, ValueError, OSError):  # unknown, malformed, or the name of a folder of zones
        return None
