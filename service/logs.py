"""Logs with the ids of what they are about, as JSON lines for machines. The only file with structlog."""

from __future__ import annotations

import logging
import sys
from contextlib import AbstractContextManager
from typing import Any

import structlog


def bound(**ids: Any) -> AbstractContextManager:
    """Put ids (request_id, job_id) on every line that this task or thread logs."""
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
