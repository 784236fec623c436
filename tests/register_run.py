"""50 seeds of each layout: errors against least squares without the outlier, and how often the truth is in the region.

    PYTHONPATH=.:tests python tests/register_run.py [SEEDS [SCENE ...]]

With scene folders: their test photos (at most ten) are localized once, each seed has other noise and another frame.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
from registration_layouts import Photos, evidence, evidence_of, planted

from service.geometry import so3_log
from service.registration.consensus import agreeing
from service.registration.quantiles import chi_square_quantile
from service.registration.register import register
from service.registration.similarity_fit import fit_similarity, unknown_noise

ROWS = [
    ("around", "positions", 8),
    ("around", "poses", 8),
    ("walk", "drift", 20),
    ("walk", "gps", 20),
    ("planar", "positions", 8),
    ("short", "positions", 10),
    ("around", "positions", 5),
    ("short", "poses", 6),
]


def errors(matrix, centre, truth):
    """Twist of the truth against an estimate, as the covariance has it."""
    scale = np.cbrt(np.linalg.det(matrix[:3, :3]))
    turn = so3_log(truth.rotation @ (matrix[:3, :3] / scale).T)
    at = np.append(centre, 1.0)
    shift = truth.matrix[:3] @ at - matrix[:3] @ at
    return np.array([*turn, *shift, np.log(truth.scale / scale)])


def row(kind, what, count, seeds):
    """Return errors (degrees, metres at the centre, share of the scale) of both, what share is in the region, how many
    were rejected how often, and what share was determined whole."""
    return judged(evidence(kind, what, count, np.random.default_rng(seed)) for seed in range(seeds))


def real_row(photos, what, seeds):
    """The same of the photos of a real scene; GPS as on a walk of 40 m."""
    return judged(_real(photos, what, np.random.default_rng(seed)) for seed in range(seeds))


def _real(photos, what, rng):
    truth = planted(rng)
    if what == "gps":
        places = np.array([pose[:3, 3] for pose in photos.true])
        truth = replace(truth, scale=40 / np.linalg.norm(np.diff(places, axis=0), axis=1).sum())
    return *evidence_of(photos, what, truth, rng), truth


def judged(cases):
    mine, ideal, inside, found, whole = [], [], [], [], []
    for bad, without, truth in cases:
        done = register(bad, np.random.default_rng(0))
        error = errors(done.target_from_world, done.centre_in_world, truth)
        inside.append(error @ np.linalg.solve(done.covariance, error) <= chi_square_quantile(0.95, 7))
        mine.append(error)
        start, _ = agreeing(without, np.random.default_rng(0))
        everyone = range(len(without.observations))
        plain = fit_similarity(without, everyone, start.similarity, unknown_noise(without.observations))
        ideal.append(errors(plain.similarity.matrix, plain.similarity.centre_in_world, truth))
        found.append(sum(not r.used for r in done.residuals))
        whole.append(done.is_complete)
    return summary(mine), summary(ideal), np.mean(inside), np.bincount(found).tolist(), np.mean(whole)


def localized(folder: Path, count: int) -> Photos:
    """Return a scene's test photos with their true poses, and as they are localized."""
    # Here: tests/test_registration.py uses the rest, and needn't wait for the engine.
    from service.bench.bench_photos import find_photos
    from service.loaded_scene import LoadedScene
    from service.localize import localize
    from service.photos.images import read_query
    from service.results import Status
    from service.scene_formats import load_scene

    chosen = find_photos(folder)
    chosen = chosen[:: max(1, len(chosen) // count)][:count]
    loaded = LoadedScene.of(load_scene(folder, without_photos=[name for photo in chosen for name in photo.names]))
    true, found, covariances = [], [], []
    for photo in chosen:
        query = read_query(photo.path.read_bytes(), intrinsics=photo.camera.intrinsics)
        answer = localize(query, loaded)
        if answer.verdict.status is Status.LOCALIZED and answer.verdict.covariance is not None:
            true.append(photo.camera.pose.world_from_camera)
            found.append(answer.pose.world_from_camera)
            covariances.append(answer.verdict.covariance)
    return Photos(true, found, covariances)


def summary(all_errors):
    e = np.array(all_errors)
    turn, shift = np.linalg.norm(e[:, :3], axis=1), np.linalg.norm(e[:, 3:6], axis=1)
    return np.array([np.degrees(np.sqrt(np.mean(turn**2))), np.sqrt(np.mean(shift**2)), np.sqrt(np.mean(e[:, 6] ** 2))])


def show(name, count, figures):
    mine, ideal, inside, found, whole = figures
    ratio = mine / ideal
    print(
        f"{name:18}{count:3} | rms {mine[0]:.3f} deg {mine[1]:.4f} m {mine[2]:.2%} scale | over ideal "
        f"{ratio[0]:.2f} {ratio[1]:.2f} {ratio[2]:.2f} | in region {inside:.0%} | complete {whole:.0%} | "
        f"rejected {found}",
        flush=True,
    )


if __name__ == "__main__":
    seeds = int(sys.argv[1]) if len(sys.argv) > 1 else 50
    for folder in sys.argv[2:]:
        photos = localized(Path(folder), 10)
        for what in ("positions", "poses", "drift", "gps"):
            show(f"{Path(folder).name} {what}", len(photos.true), real_row(photos, what, seeds))
    for kind, what, count in ROWS if len(sys.argv) < 3 else ():
        show(f"{kind} {what}", count, row(kind, what, count, seeds))
