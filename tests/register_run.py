"""50 seeds of each layout: errors against least squares without the outlier, and how often the truth is in the region.

PYTHONPATH=.:tests python tests/register_run.py [SEEDS]
"""

from __future__ import annotations

import sys

import numpy as np
from registration_layouts import evidence

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
    """Return median errors (degrees, share of the scale, metres at the centre) of both, and what share is covered."""
    mine, ideal, inside, found, whole = [], [], [], [], []
    for seed in range(seeds):
        bad, without, truth = evidence(kind, what, count, np.random.default_rng(seed))
        done = register(bad, np.random.default_rng(0))
        error = errors(done.target_from_world, done.centre_in_world, truth)
        inside.append(error @ np.linalg.solve(done.covariance, error) <= chi_square_quantile(0.95, 7))
        mine.append(error)
        start, _ = agreeing(without, np.random.default_rng(0))
        plain = fit_similarity(without, range(count - 1), start.similarity, unknown_noise(without.observations))
        ideal.append(errors(plain.similarity.matrix, plain.similarity.centre_in_world, truth))
        rejected = [r.name for r in done.residuals if not r.used]
        found.append(len(rejected))
        whole.append(done.is_complete)
    return summary(mine), summary(ideal), np.mean(inside), np.bincount(found).tolist(), np.mean(whole)


def summary(all_errors):
    e = np.array(all_errors)
    turn, shift = np.linalg.norm(e[:, :3], axis=1), np.linalg.norm(e[:, 3:6], axis=1)
    return np.array([np.degrees(np.sqrt(np.mean(turn**2))), np.sqrt(np.mean(shift**2)), np.sqrt(np.mean(e[:, 6] ** 2))])


if __name__ == "__main__":
    seeds = int(sys.argv[1]) if len(sys.argv) > 1 else 50
    for kind, what, count in ROWS:
        mine, ideal, inside, found, whole = row(kind, what, count, seeds)
        ratio = mine / ideal
        print(
            f"{kind:8}{what:10}{count:3} | rms {mine[0]:.3f} deg {mine[1]:.4f} m {mine[2]:.2%} scale | over ideal "
            f"{ratio[0]:.2f} {ratio[1]:.2f} {ratio[2]:.2f} | in region {inside:.0%} | complete {whole:.0%} | "
            f"rejected {found}",
            flush=True,
        )
