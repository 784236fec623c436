"""Log records as JSON lines, with the ids of the request and job they belong to. The only file with structlog."""

from __future__ import annotations

import logging
import sys
from contextlib import AbstractContextManager
from typing import Any

import structlog


def bound(**ids: Any) -> AbstractContextManager:
    """Return a context in which every line that this task or thread logs has these ids (request_id, job_id)."""
    return structlog.contextvars.bound_contextvars(**ids)


def json_handler() -> logging.Handler:
    """Return a handler that writes each record of the standard library's logging as a line of JSON to stderr."""
    handler = logging.StreamHandler(sys.stderr)
    shared = [
        structlog.contextvars.merge_contextvars,
        structlog.stdlib.add_log_level,
        structlog.stdlib.add_logger_name,
        structlog.processors.TimeStamper(fmt="iso", utc=True),
    ]
    # Records of other libraries come through the standard library, so structlog formats those ("foreign") only.
    handler.setFormatter(
        structlog.stdlib.ProcessorFormatter(
            foreign_pre_chain=shared,
            processors=[
                structlog.stdlib.ProcessorFormatter.remove_processors_meta,
                structlog.processors.format_exc_info,
                structlog.processors.JSONRenderer(),
            ],
        )
    )
    return handler
