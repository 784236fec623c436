"""What an operator can set: arguments of `splatfix serve`, `SPLATFIX_*` in the environment, or a TOML file."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from pydantic import Field
from pydantic_settings import BaseSettings, SettingsConfigDict, TomlConfigSettingsSource

from service.localize import DEFAULT_ESTIMATOR, DEFAULT_MATCHER
from service.web.schemas.parsing import MAX_FRAMES

DATA_HOME = Path(os.environ.get("XDG_DATA_HOME") or Path.home() / ".local" / "share") / "splatfix"
"""Where `splatfix serve` keeps its jobs, a folder for each port."""


CONFIG_HOME = Path(os.environ.get("XDG_CONFIG_HOME") or Path.home() / ".config") / "splatfix"


_CPU_QUOTA = Path("/sys/fs/cgroup/cpu.max")


def _cores() -> int:
    """Count the processors that this process may use; a container's limit is a quota of their time."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    try:
        quota, period = _CPU_QUOTA.read_text().split()
    except (OSError, ValueError):
        return cores
    return cores if quota == "max" else max(1, min(cores, round(int(quota) / int(period))))


class Settings(BaseSettings):
    model_config = SettingsConfigDict(env_prefix="SPLATFIX_", use_attribute_docstrings=True, extra="forbid")

    @classmethod
    def settings_customise_sources(
        cls,
        settings_cls: type[BaseSettings],
        init_settings: Any,
        env_settings: Any,
        dotenv_settings: Any,
        file_secret_settings: Any,
    ) -> tuple[Any, ...]:
        """Arguments win over the environment, and that over the file."""
        file = Path(os.environ.get("SPLATFIX_CONFIG") or CONFIG_HOME / "splatfix.toml")
        return init_settings, env_settings, TomlConfigSettingsSource(settings_cls, file)

    scenes: list[Path] = []
    """Scene folders, scene files, or folders of scene folders. In the environment: a JSON list."""
    preload: list[str] | None = None
    """Scenes to load at start, by id; None: all. The others are loaded when they are asked for."""
    scene_memory_bytes: int | None = Field(default=None, ge=1)
    """What scenes may take; the one not asked for longest is dropped for another. None: no limit."""
    max_scene_bytes: int = Field(default=2_000_000_000, ge=1)
    """Of an uploaded scene; what an archive holds may be as large in all."""
    host: str = "127.0.0.1"
    port: int = Field(default=8000, ge=0, lt=65536)
    """0: any free one."""
    root_path: str = ""
    """The sub-path under which a proxy shows the service, e.g. /fix; `X-Forwarded-Prefix` wins."""
    estimator: str = DEFAULT_ESTIMATOR
    """Of jobs that name none; what it prepares for a scene is made at start."""
    matcher: str = DEFAULT_MATCHER
    """Of local features, for all scenes; some need weights in the folder that SPLATFIX_WEIGHTS_DIR names."""
    rasterizer: str | None = None
    """Renderer; None: the GPU's where there is one that it can use, else the CPU's."""
    workers: int = Field(default_factory=_cores, ge=1)
    """Jobs that run at once; each has one thread."""
    queue_size: int = Field(default=32, ge=1)
    """Jobs that may wait; one more is refused with 503."""
    queue_bytes: int = Field(default=500_000_000, ge=1)
    """Decoded photos that may wait in memory."""
    max_job_s: float = Field(default=300.0, gt=0)
    """The longest budget of a job; also of one that sets none."""
    stuck_s: float = Field(default=120.0, gt=0)
    """A job that tells nothing for so long is given up, and its worker replaced."""
    shutdown_s: float = Field(default=10.0, ge=0)
    """What running jobs get to finish after SIGTERM; what doesn't is run again after the restart."""
    data_dir: Path | None = None
    """Where jobs are kept; None: in a temporary folder that goes with the process. `splatfix serve` names one."""
    keep_jobs: int = Field(default=10_000, ge=1)
    """Ended jobs that are remembered."""
    keep_days: float = Field(default=30.0, gt=0)
    """How long ended jobs are remembered."""
    keep_bytes: int = Field(default=2_000_000_000, ge=0)
    """What ended jobs may take on disk, with their records and photos."""
    photo_grace_s: float = Field(default=900.0, ge=0)
    """How long after its job a photo can be looked at, unless the request says `keep_photo`; 0: not at all."""
    crashes: int = Field(default=3, ge=1)
    """A job that was running in so many crashes is not run again."""
    max_upload_bytes: int = Field(default=50_000_000, ge=1)
    """Of a photo, a video, or several photos together."""
    max_frames: int = Field(default=MAX_FRAMES, ge=1)
    """Photos, or frames of a video, in one job."""
    max_uploads: int = Field(default=8, ge=1)
    """Requests whose bodies come in at once."""
    upload_s: float = Field(default=60.0, gt=0)
    """How long a body may take to come in, and a second more for each megabyte that it may have."""
    send_s: float = Field(default=30.0, gt=0)
    """A client that takes nothing of its answer for so long is dropped."""
    rate_limit: str = "30/second"
    """Requests of one client that make work, e.g. 10/second or 600/minute; empty: any number."""
    max_wait_s: float = Field(default=60.0, gt=0, le=3600)
    """The longest `Prefer: wait=N` that is honoured."""
    cache_dir: Path | None = Path.home() / ".cache" / "splatfix"
    """Where view indexes are kept between runs; None: nowhere."""
    keys_file: Path | None = CONFIG_HOME / "keys.json"
    """API keys, as `splatfix keys add` stores them. If it has any, everybody needs one."""
    open: bool = False
    """Listen beyond this machine without keys."""
    allowed_hosts: list[str] = []
    """Names under which the service may be called, e.g. of a proxy; empty: any, except while there are no keys."""
    cors_origins: list[str] = []
    """Origins of other sites whose pages may use the service, e.g. https://example.org."""
    log_json: bool | None = None
    """Log lines of JSON; None: unless a person watches."""
    viewer: bool = True
    """Start the viewer and relay it under /viewer."""

    @property
    def loopback_url(self) -> str:
        """Where this machine reaches the service."""
        everywhere = self.host in ("0.0.0.0", "::", "")
        host = "127.0.0.1" if everywhere else f"[{self.host}]" if ":" in self.host else self.host
        return f"http://{host}:{self.port}"
