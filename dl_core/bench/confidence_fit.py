"""Statistics of predicted and actual errors: fits, ranks, and what the least trusted directions hold."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import combinations
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from ..geometry import latlong_solid_angles
from ..misplaced import ROWS

__all__ = ["direction_shares", "fit_shares", "fit_weights", "held_by_least_trusted", "rank_correlation"]

LEAST_TRUSTED: Final = 0.2
WORST: Final = 0.1
PENALTIES: Final = (0.03, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0)
"""Of a ridge regression, in units of one row each."""


def direction_shares() -> NDArray[np.float64]:
    """Solid angles of the directions, as shares of the sphere."""
    angles = latlong_solid_angles(ROWS).double().expand(ROWS, 2 * ROWS).flatten().numpy()
    return np.asarray(angles / angles.sum())


def fit_weights(
    found: NDArray[np.float64], errors: NDArray[np.float64], shares: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Weights, none below 0, whose sum over the evidence is nearest the errors in the mean square.

    Args:
        found: (k, n) the evidence.
        errors: (n,) stops.
        shares: (n,) how much each counts.

    Returns:
        (k,). Exact: the least squares without bounds on some of the evidence is the least squares with bounds if no
        weight is below 0 there, and of all subsets with that the best is taken.
    """
    root = np.sqrt(shares)
    design, target = (found * root).T, errors * root
    best, least = np.zeros(len(found)), float(target @ target)
    for count in range(1, len(found) + 1):
        for chosen in combinations(range(len(found)), count):
            weights, *_ = np.linalg.lstsq(design[:, chosen], target, rcond=None)
            rest = target - design[:, chosen] @ weights
            if (weights >= 0).all() and rest @ rest < least:
                least, best = float(rest @ rest), np.zeros(len(found))
                best[list(chosen)] = weights
    return best


def rank_correlation(first: Sequence[float], second: Sequence[float]) -> float:
    """Spearman's rank correlation; NaN where one of the two is all alike or there are fewer than two values.

    Source: Spearman, The proof and measurement of association between two things (American Journal of Psychology 15,
    1904); ties get their mean rank.
    """
    ranks = [_ranks(np.asarray(values)) for values in (first, second)]
    if len(first) < 2 or any(np.ptp(rank) == 0 for rank in ranks):
        return math.nan
    return float(np.corrcoef(ranks[0], ranks[1])[0, 1])


def _ranks(values: NDArray[Any]) -> NDArray[np.float64]:
    _, places, counts = np.unique(values, return_inverse=True, return_counts=True)
    last = np.cumsum(counts)
    return np.asarray((last - (counts - 1) / 2)[places], dtype=np.float64)


def held_by_least_trusted(
    expected: NDArray[np.float64], errors: NDArray[np.float64], shares: NDArray[np.float64]
) -> float:
    """Share of the worst tenth of directions that lies in the fifth that is trusted least; 0.2 by chance.

    Args:
        expected: (n,) errors expected.
        errors: (n,) errors there are.
        shares: (n,) of the sphere, that sum to 1.
    """
    doubted, worst = _top(expected, shares, LEAST_TRUSTED), _top(errors, shares, WORST)
    return float((doubted * worst * shares).sum() / (worst * shares).sum())


def _top(values: NDArray[np.float64], shares: NDArray[np.float64], share: float) -> NDArray[np.float64]:
    """1 on the highest values that make up so much of the sphere; the one at the edge counts in part."""
    order = np.argsort(-values, kind="stable")
    before = np.cumsum(shares[order]) - shares[order]
    inside = np.empty(len(values))
    inside[order] = np.clip((share - before) / shares[order], 0, 1)
    return inside


def fit_shares(found: NDArray[np.float64], targets: NDArray[np.float64], groups: Sequence[str]) -> NDArray[np.float64]:
    """Weights whose sum over the evidence is nearest the targets, held back so that they carry over to other groups.

    Ridge regression on standardized evidence; how far it is held back is what leaves the least error on groups that
    were left out of the fit, one after the other.

    Args:
        found: (n, k) the evidence, its first column constant.
        targets: (n,) to predict.
        groups: of the rows: panoramas. With one alone nothing can be left out, and the most is held back.

    Returns:
        (k,) weights of the evidence as it is, the constant's first.

    Source: Hoerl and Kennard, Ridge regression (Technometrics 12, 1970); Stone, Cross-validatory choice (JRSS B, 1974).
    """
    names = np.asarray(groups)
    best, least = PENALTIES[-1], math.inf
    if len(set(groups)) > 1:
        for penalty in PENALTIES:
            missed = 0.0
            for name in dict.fromkeys(groups):
                weights = _ridge(found[names != name], targets[names != name], penalty)
                missed += float(np.square(found[names == name] @ weights - targets[names == name]).sum())
            if missed < least:
                best, least = penalty, missed
    return _ridge(found, targets, best)


def _ridge(found: NDArray[np.float64], targets: NDArray[np.float64], penalty: float) -> NDArray[np.float64]:
    varying = found[:, 1:]
    mean, width = varying.mean(axis=0), varying.std(axis=0)
    width = np.where(width > 0, width, 1.0)
    design = (varying - mean) / width
    normal = design.T @ design + penalty * np.eye(design.shape[1])
    slopes = np.linalg.solve(normal, design.T @ (targets - targets.mean())) / width
    return np.concatenate(([targets.mean() - mean @ slopes], slopes))
