"""Settings of the service: arguments of `splatfix serve`, `SPLATFIX_*` in the environment, or a TOML file."""

from __future__ import annotations

import difflib
import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

from pydantic import Field, SecretStr
from pydantic_settings import BaseSettings, SettingsConfigDict, TomlConfigSettingsSource

from service.jobs.config import JobsConfig
from service.jobs.embedded_engine import EngineConfig
from service.jobs.ray_config import RayConfig
from service.jobs.read_photo import MAX_FRAMES
from service.loaded_scene import DEFAULT_ESTIMATOR, DEFAULT_MATCHER
from service.operating_system import available_cores

_PREFIX = "SPLATFIX_"

DATA_HOME = Path(os.environ.get("XDG_DATA_HOME") or Path.home() / ".local" / "share") / "splatfix"
"""Folder in which `splatfix serve` keeps its jobs, in a subfolder for each port."""

CONFIG_HOME = Path(os.environ.get("XDG_CONFIG_HOME") or Path.home() / ".config") / "splatfix"
"""Folder of the settings' file and of the API keys."""

_OTHER_VARIABLES = frozenset({"config", "plugins_dir", "weights_dir", "key"})
"""Of the environment, in lower case: read elsewhere, or by the commands that we print."""


def unknown_variables(environment: Mapping[str, str]) -> list[str]:
    """Return a sentence for each variable SPLATFIX_* that is no setting, with the name that may be meant."""
    known = {*Settings.model_fields, *_OTHER_VARIABLES}
    found = []
    for variable in sorted(environment):
        prefix, name = variable[: len(_PREFIX)], variable[len(_PREFIX) :].lower()
        # Kubernetes adds SPLATFIX_SERVICE_HOST, SPLATFIX_PORT_8000_TCP, ... for a service of that name.
        if prefix.upper() != _PREFIX or name in known or re.match(r"(service|port|test)_", name):
            continue
        near = difflib.get_close_matches(name, sorted(known), 1)
        meant = f"; is {_PREFIX}{near[0].upper()} meant?" if near else "; `splatfix doctor` lists them."
        found.append(f"unknown setting {variable}, ignored{meant}")
    return found


def is_loopback(host: str) -> bool:
    """Return whether only this machine reaches an address to listen on."""
    return host in ("localhost", "::1") or host.startswith("127.")


class Settings(BaseSettings):
    """The settings, checked; their descriptions are shown by `splatfix doctor`."""

    model_config = SettingsConfigDict(env_prefix=_PREFIX, use_attribute_docstrings=True, extra="forbid")

    @classmethod
    def settings_customise_sources(
        cls,
        settings_cls: type[BaseSettings],
        init_settings: Any,
        env_settings: Any,
        dotenv_settings: Any,
        file_secret_settings: Any,
    ) -> tuple[Any, ...]:
        """Order the sources: arguments override the environment, which overrides the file."""
        file = Path(os.environ.get("SPLATFIX_CONFIG") or CONFIG_HOME / "splatfix.toml")
        return init_settings, env_settings, TomlConfigSettingsSource(settings_cls, file)

    scenes: list[Path] = []
    """Scene folders, scene files, or folders of scene folders. In the environment: a JSON list."""
    preload: list[str] | None = None
    """Ids of the scenes to load at start; None: all. The others are loaded when a request needs them."""
    scene_memory_bytes: int | None = Field(default=None, ge=1)
    """Memory limit of all loaded scenes; the least recently used one is unloaded to free memory. None: no limit."""
    gpu_memory_bytes: int | None = Field(default=None, ge=1)
    """Limit of the GPU memory that renders and features of all jobs take at once, beside the scenes; jobs wait for each
    other. None: four fifths of what the scenes leave."""
    max_scene_bytes: int = Field(default=2_000_000_000, ge=1)
    """Largest scene file or archive that can be uploaded; also the limit of an archive's unpacked files together."""
    upload_checkpoints: bool = False
    """Whether checkpoints of trainers (.pt, .ckpt) can be uploaded: pickles, loaded in a process of their own."""
    host: str = "127.0.0.1"
    """Address to listen on."""
    port: int = Field(default=8000, ge=0, lt=65536)
    """Port to listen on; 0: any free one."""
    https: bool = False
    """Serve HTTPS: with `certificate`, else with a local one that is made, which browsers ask about once."""
    certificate: Path | None = None
    """PEM file of the certificate, followed by those between it and its authority."""
    certificate_key: Path | None = None
    """PEM file of its private key."""
    root_path: str = ""
    """Sub-path under which a proxy serves the service, e.g. /fix; the header `X-Forwarded-Prefix` overrides it."""
    estimator: str = DEFAULT_ESTIMATOR
    """Default estimator of jobs; scenes are prepared for it when they are loaded."""
    matcher: str = DEFAULT_MATCHER
    """Matcher of local features, for all scenes; some need weights in the folder SPLATFIX_WEIGHTS_DIR."""
    rasterizer: str | None = None
    """Renderer; None: a GPU renderer if this machine has a suitable GPU, else the CPU renderer."""
    engine: Literal["embedded", "ray"] = "embedded"
    """Where scenes are and jobs run: threads of this process, or processes of a Ray cluster."""
    ray_address: str | None = None
    """Address of a Ray cluster, e.g. `auto`; None: a cluster on this machine, that ends with the service."""
    ray_replicas: int = Field(default_factory=available_cores, ge=1)
    """Processes of the Ray engine that have scenes and run jobs; `scene_memory_bytes` is the limit of each."""
    ray_gpus: float = Field(default=0.0, ge=0)
    """GPUs of each process of the Ray engine, e.g. 0.5 for two on one."""
    workers: int = Field(default_factory=available_cores, ge=1)
    """Number of jobs that run at once, each on one thread; with the Ray engine, unless set, one for each process."""
    queue_size: int = Field(default=32, ge=1)
    """Number of jobs that may be queued; further ones are refused with 503."""
    queue_bytes: int = Field(default=500_000_000, ge=1)
    """Memory limit of the decoded photos of queued jobs."""
    max_job_s: float = Field(default=300.0, gt=0)
    """Longest time budget of a job, and the budget of jobs that set none."""
    stuck_s: float = Field(default=120.0, gt=0)
    """A job without a new record for this long is failed, and its worker replaced."""
    shutdown_s: float = Field(default=10.0, ge=0)
    """Time for running jobs to finish after SIGTERM; unfinished ones are run again after the restart."""
    data_dir: Path | None = None
    """Folder of the stored jobs and uploaded scenes; None: a temporary one. `splatfix serve` has its own default."""
    database: SecretStr | None = None
    """PostgreSQL database of jobs, photos, lenses, rates and sessions that several fronts share, e.g. postgresql://splatfix@db/splatfix;
    None: files in `data_dir`, of this process alone."""
    object_store: str | None = None
    """Where photos and uploaded scenes are that several fronts share: s3://bucket/prefix, with AWS_ENDPOINT_URL and the
    other variables of S3, or a shared folder; None: photos where jobs are, scenes in `data_dir`."""
    keep_jobs: int = Field(default=10_000, ge=1)
    """Number of ended jobs that are kept."""
    keep_days: float = Field(default=30.0, gt=0)
    """How long ended jobs are kept."""
    keep_bytes: int = Field(default=2_000_000_000, ge=0)
    """Disk space of ended jobs, with their records and photos."""
    photo_grace_s: float = Field(default=900.0, ge=0)
    """How long a photo is kept after its job, unless the request has `keep_photo`; 0: deleted with the job's end."""
    keep_lenses: int = Field(default=10_000, ge=0)
    """Number of cameras' lenses that are remembered: estimates by earlier photos are the prior of the next photo. 0:
    none, and what was remembered is deleted at the start."""
    crashes: int = Field(default=3, ge=1)
    """A job whose attempts were lost this many times, by crashes of the service, is not run again."""
    max_upload_bytes: int | None = Field(default=None, ge=1)
    """Size limit of a photo, a video, or several photos together. None: 1 GB where only this machine is served, else
    50 MB."""
    max_frames: int = Field(default=MAX_FRAMES, ge=1)
    """Number of photos, or frames of a video, in one job."""
    max_uploads: int = Field(default=8, ge=1)
    """Number of request bodies that are received at once."""
    upload_s: float = Field(default=60.0, gt=0)
    """Time limit for receiving a request body, plus one second for each megabyte of its size limit."""
    send_s: float = Field(default=30.0, gt=0)
    """A client that reads nothing of its response for this long is disconnected."""
    rate_limit: str = "30/second"
    """Rate limit of each client, for requests other than GET, e.g. 10/second or 600/minute; empty: none."""
    live_sessions: int = Field(default=16, ge=0)
    """Live sessions at once; 0: none."""
    live_sessions_of_client: int = Field(default=4, ge=1)
    """Live sessions at once of one client."""
    live_frame_bytes: int = Field(default=2_000_000, ge=1000)
    """Size limit of a message of a live session."""
    live_fps: int = Field(default=60, ge=1)
    """Frames a second in a live session, on average over two seconds."""
    live_idle_s: float = Field(default=60.0, gt=0)
    """A live session without a frame for so long ends, and lets go of its scene."""
    max_wait_s: float = Field(default=60.0, gt=0, le=3600)
    """The longest `Prefer: wait=N` that is honoured."""
    cache_dir: Path | None = Path.home() / ".cache" / "splatfix"
    """Cache folder of view indexes and of scenes in mappable form; None: no cache."""
    cache_bytes: int = Field(default=10_000_000_000, ge=0)
    """Size limit of the cache folder: what was not used for longest is deleted when a scene has been loaded."""
    keys_file: Path | None = CONFIG_HOME / "keys.json"
    """File of API keys, as `splatfix keys add` writes it. If it has keys, every client needs one."""
    open: bool = False
    """Allow other machines to use the service without keys."""
    allowed_hosts: list[str] = []
    """Accepted host names, e.g. a proxy's; empty: any with API keys, only this machine's without."""
    cors_origins: list[str] = []
    """Origins of other sites whose pages may use the service (CORS), e.g. https://example.org."""
    embed_origins: list[str] = []
    """Origins of sites that may show the pages of share links in a frame, e.g. https://example.org; empty: none."""
    log_json: bool | None = None
    """Log in JSON; None: unless the log goes to a terminal."""
    viewer: bool = True
    """Start the viewer, and serve it under /viewer."""

    @property
    def upload_limit(self) -> int:
        """`max_upload_bytes`, or its default for the address that is listened on."""
        if self.max_upload_bytes is not None:
            return self.max_upload_bytes
        # On this machine nobody else's uploads compete for its memory and disk.
        return 1_000_000_000 if is_loopback(self.host) else 50_000_000

    @property
    def jobs_at_once(self) -> int:
        """`workers`, or its default for the engine."""
        return self.ray_replicas if self.engine == "ray" and "workers" not in self.model_fields_set else self.workers

    @property
    def ray(self) -> RayConfig:
        """The part of the settings for the Ray engine."""
        return RayConfig(self.ray_address, self.ray_replicas, gpus=self.ray_gpus)

    @property
    def jobs(self) -> JobsConfig:
        """The part of the settings for `service.jobs`."""
        return JobsConfig(
            workers=self.jobs_at_once,
            queue_size=self.queue_size,
            queue_bytes=self.queue_bytes,
            max_job_s=self.max_job_s,
            max_frames=self.max_frames,
            stuck_s=self.stuck_s,
            max_lost=self.crashes,
            shutdown_s=self.shutdown_s,
            keep_jobs=self.keep_jobs,
            keep_days=self.keep_days,
            keep_bytes=self.keep_bytes,
            photo_grace_s=self.photo_grace_s,
        )

    @property
    def engine_config(self) -> EngineConfig:
        """The part of the settings for the engine of a process."""
        return EngineConfig(
            self.estimator,
            self.matcher,
            self.rasterizer,
            self.cache_dir,
            self.cache_bytes,
            memory_bytes=self.scene_memory_bytes,
            gpu_memory_bytes=self.gpu_memory_bytes,
            data_folder=self.data_dir,
        )

    @property
    def loopback_url(self) -> str:
        """URL of the service for clients on this machine."""
        # Addresses that listen on all interfaces can't be connected to on every system.
        everywhere = self.host in ("0.0.0.0", "::", "")
        host = "127.0.0.1" if everywhere else f"[{self.host}]" if ":" in self.host else self.host
        return f"{'https' if self.https else 'http'}://{host}:{self.port}"
