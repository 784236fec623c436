"""How the Ray engine is spread out; apart from it, so that settings need no Ray."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class RayConfig:
    """Where the cluster is, and what each of its replicas takes."""

    address: str | None = None
    """Of a Ray cluster, e.g. `auto`; None: one of this process, that ends with it."""
    replicas: int = 2
    """Processes that have scenes and run jobs."""
    cpus: float = 1.0
    """Of each replica."""
    gpus: float = 0.0
    """Of each replica: a share of a GPU, or several."""
