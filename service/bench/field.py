"""`splatfix bench field`: what becomes of the lenses, photos and scenes that people have.

One factor at a time, over a written list of rows; every test photo of every scene in each. Each scene has a file of
its own, with one JSON line a query, so that several processes may run scenes of their own. A query that has a line is
not run again; an incomplete last line is dropped.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from zlib import crc32

import numpy as np
from jaxtyping import Float32

from service.bench.field_queries import FieldQuery, answer, decoded
from service.bench.field_random import random_row
from service.bench.field_rows import Row
from service.bench.localize import BenchScene, load_bench_scene, read_occluders, with_modified_scene
from service.bench.modified_photo import Photo
from service.bench.paper.runs import code_digest, read_lines
from service.errors import InvalidRequest
from service.loaded_scene import DEFAULT_ESTIMATOR
from service.localize import Request


@dataclass(frozen=True, slots=True)
class FieldSpec:
    """What a call of the bench runs."""

    scenes: Mapping[str, tuple[Path, Path | None]]
    """Name -> scene, and its photos where they are elsewhere."""
    rows: Sequence[Row]
    out: Path
    random: int = 0
    """Random combinations a scene."""
    photos: int | None = None
    """Test photos a scene, evenly spread; None: all."""
    seed: int = 0
    occluders: Path | None = None
    """Photos of another scene; without them rows that need some are left out."""
    cache_dir: Path | None = None
    request: Request = field(default_factory=Request)


def run(spec: FieldSpec, progress: Callable[[str, int, int], None] | None = None) -> list[dict[str, Any]]:
    """Run the queries that have no line yet; return all lines of the scenes. Raises SceneError, InvalidRequest.

    `progress` is called with scene, queries done and queries in all.
    """
    spec.out.mkdir(parents=True, exist_ok=True)
    occluders = read_occluders(spec.occluders) if spec.occluders else []
    lines = []
    for name, (folder, data) in spec.scenes.items():
        one = load_bench_scene(folder, data, cache_dir=spec.cache_dir)
        lines += _run_scene(name, one, spec, occluders, progress)
    return lines


def read_results(spec: FieldSpec) -> list[dict[str, Any]]:
    """Return the lines there are of the scenes. Raises InvalidRequest."""
    return [line for name in spec.scenes for line in read_lines(_file_of(spec, name))]


def _file_of(spec: FieldSpec, name: str) -> Path:
    return spec.out / f"{name}.jsonl"


def _run_scene(
    name: str,
    one: BenchScene,
    spec: FieldSpec,
    occluders: Sequence[Float32[np.ndarray, "_ _ 3"]],
    progress: Callable[[str, int, int], None] | None,
) -> list[dict[str, Any]]:
    file = _file_of(spec, name)
    lines = read_lines(file, repair=True)
    facts = {"scene": name, "scene_sha256": one.loaded.scene.info.sha256, "seed": spec.seed}
    _require_same(lines, facts, file)
    done = {(line["row"], line["photo"], line["number"]) for line in lines}
    todo = [query for query in queries(name, one, spec) if query.key not in done]
    # Each modified scene is made and indexed once.
    todo.sort(key=lambda query: query.row.modify_scene)
    photos: dict[str, Photo] = {}
    place, prepared = one, None
    with file.open("a", encoding="utf-8") as stream:
        for number, query in enumerate(todo):
            if query.photo.name not in photos:
                photos[query.photo.name] = decoded(query.photo, one.background_rgb, occluders)
            photo = photos[query.photo.name]
            if query.row.modify_scene != prepared:
                prepared = query.row.modify_scene
                place = with_modified_scene(one, prepared, spec.seed, cache_dir=spec.cache_dir)
                place.loaded.prepare(DEFAULT_ESTIMATOR)
                # Not kept: its time would include compilation.
                answer(place, photo, query, spec.seed, spec.request)
            line = facts | {"code": code_digest()} | answer(place, photo, query, spec.seed, spec.request)
            stream.write(json.dumps(line) + "\n")
            stream.flush()
            os.fsync(stream.fileno())
            lines.append(line)
            if progress:
                progress(name, number + 1, len(todo))
    return lines


def _require_same(lines: Sequence[Mapping[str, Any]], facts: Mapping[str, Any], file: Path) -> None:
    """Raise InvalidRequest where lines were made with another seed or another version of the scene."""
    for line in lines:
        for key, value in facts.items():
            if line[key] != value:
                raise InvalidRequest(
                    f"the results there have {key} {line[key]}, not {value}.",
                    where=str(file),
                    hint="Name another folder.",
                )


def queries(name: str, one: BenchScene, spec: FieldSpec) -> Iterator[FieldQuery]:
    """Yield the queries of a scene: row by row, then random combinations.

    A combination depends on the seed, the scene's name and its number, and on which photos there are.
    """
    photos = one.photos
    if spec.photos is not None and spec.photos < len(photos):
        photos = tuple(photos[int(i * len(photos) / spec.photos)] for i in range(spec.photos))
    for row in spec.rows:
        if not row.needs_occluders or spec.occluders:
            yield from (FieldQuery(row, photo) for photo in photos if row.fits(photo.camera.intrinsics))
    for number in range(spec.random):
        rng = np.random.default_rng([spec.seed, crc32(name.encode()), number])
        photo = one.photos[int(rng.integers(len(one.photos)))]
        row = random_row(rng, photo.camera.intrinsics)
        if not row.needs_occluders or spec.occluders:
            yield FieldQuery(row, photo, number)
