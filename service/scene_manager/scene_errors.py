"""The errors of requests that name a scene: every engine answers with the same."""

from __future__ import annotations

from service.errors import (
    BadInput,
    SceneInUse,
    SceneNotFound,
    SceneNotReady,
    SceneTooLarge,
    SceneUnloaded,
)


def unnamed_scene() -> SceneNotFound:
    """Return the error for no name, where there isn't exactly one scene."""
    return SceneNotFound("name a scene.", where="scene")


def unknown_scene(scene_id: str) -> SceneNotFound:
    """Return the error for a name that no scene has; it names no other scene, which the caller may not see."""
    return SceneNotFound(f"unknown scene '{scene_id}'.", where="scene")


def nothing_to_search() -> SceneNotFound:
    """Return the error for `auto` where no scene can be used."""
    return SceneNotFound("no scene can be searched: none is there, or all failed or were unloaded.", where="scene")


def scene_not_ready(scene_id: str, state: str) -> SceneNotReady:
    """Return the error for a scene that is on its way into memory."""
    return SceneNotReady(f"scene '{scene_id}' is {state}.", where="scene", hint="Try again later.")


def scene_unloaded(scene_id: str) -> SceneUnloaded:
    """Return the error for a scene that was unloaded by request."""
    hint = f"Load it: POST /scenes/{scene_id}/load."
    return SceneUnloaded(f"scene '{scene_id}' was unloaded.", where="scene", hint=hint)


def scene_in_use(jobs: int) -> SceneInUse:
    """Return the error for removing a scene that so many jobs use."""
    return SceneInUse(f"{jobs} jobs use the scene.", where="scene", hint="Unload it, and wait for them.")


def scene_without_file() -> BadInput:
    """Return the error for unloading a scene that could not be loaded again."""
    return BadInput("the scene has no file to reload it from.", where="scene")


def too_large(what: str, needed: int, most: int, otherwise: str) -> SceneTooLarge:
    """Return the error for scenes that take more bytes than all may; `otherwise`: what helps beside more memory."""
    return SceneTooLarge(
        f"{what} {needed / 1e6:.1f} MB, and all scenes together may take {most / 1e6:.1f} MB.",
        where="scene",
        hint=f"Raise SPLATFIX_SCENE_MEMORY_BYTES, or {otherwise}.",
    )
