"""When is a median settled? A confidence bound on the error of what the merge will make of it.

What is bounded is the root mean square, over the solid angle that will be used and the colour channels, of the error of
the ball's low-pass: means of the median's display values over the cells of an 8 x 8 grid, those on the disc. The ball
maps directions to pixels of equal solid angle, so an area mean is a mean over directions. A cell is some 28 degrees
wide: irradiance, which nine coefficients describe, and matte reflection follow from such means; sharper detail is not
waited for. Display values are what the merge decodes, and weigh errors in darks and lights as a viewer does.

The bound, for N balls x_j with pixelwise median m:

1. To first order the median's error is a mean over the balls, (1/N) Σ_j s · sign(x_j - m), with s = 1 / (2 f(m)) and f
   the density at the median (Bahadur 1966). Its low-pass u_j is taken ball by ball, so that errors which pixels of a
   ball share are counted as shared.
2. s is √N times the standard error of the pixel's median, from two of its order statistics (Price and Bonett 2001);
   no law of the balls' errors is assumed.
3. The mean square of the low-pass error is trace Σ for Σ = Σ_j u_j u_jᵀ, and its law is near that of trace Σ · χ²_ν / ν
   with ν = (trace Σ)² / trace Σ² (Box 1954). As Σ is estimated, from N - 1 differences, χ² becomes F(ν, ν(N - 1))
   (Brunner, Dette and Munk 1997).
4. N is looked at several times. All bounds hold at once with the confidence asked for, because the looks share the
   error probability evenly (Bonferroni); they are the repeated confidence intervals of Jennison and Turnbull (1989),
   and painting until one is short enough is the fixed-width rule of Chow and Robbins (1965).

Measured on balls of known errors, a fifth of them disco balls, with a tolerance of 0.02 (`PYTHONPATH=. python
tests/bench_settling.py`, 200 trials a level): smooth errors of 0.01, 0.02, 0.03, 0.04 and 0.06 took 6.3, 6.4, 8.4,
12.2 and 23.2 balls, and every median was within. The smallest fixed number whose plain median is within in 95% of
trials is 5, 7, 9, 11 and 19 if the error is known beforehand; over scenes of all five together it is 13, against
11.3 on average. So the bound is wider than it need be, which costs up to a fifth where much is painted, and what it
saves is that nobody has to know the error.

Sources: Bahadur, A note on quantiles in large samples (Annals of Mathematical Statistics 37, 1966); Price and Bonett,
Estimating the variance of the sample median (Journal of Statistical Computation and Simulation 68, 2001); Box, Some
theorems on quadratic forms (Annals of Mathematical Statistics 25, 1954); Brunner, Dette and Munk, Box-type
approximations in nonparametric factorial designs (JASA 92, 1997); Bai and Saranadasa, Effect of high dimension
(Statistica Sinica 6, 1996), for trace Σ²; Paulson, An approximate normalization of the analysis of variance
distribution (Annals of Mathematical Statistics 13, 1942); Jennison and Turnbull, Interim analyses: the repeated
confidence interval approach (JRSS B 51, 1989); Chow and Robbins, On the asymptotic theory of fixed-width sequential
confidence intervals (Annals of Mathematical Statistics 36, 1965); Ramamoorthi and Hanrahan, An efficient
representation for irradiance environment maps (SIGGRAPH 2001).
"""

from __future__ import annotations

import math
from statistics import NormalDist
from typing import Final

import torch
from jaxtyping import Float
from torch import Tensor

from .errors import OptionError
from .median import BAND
from .shapes import BallImage

__all__ = ["CONFIDENCE", "error_bound", "f_quantile", "looks", "low_pass"]

CELLS: Final = 8
"""Cells along each side of the ball's square."""
CONFIDENCE: Final = 0.95
"""With which a median that is called settled is within its tolerance."""
GROWTH: Final = 4
"""A look follows once a fourth more balls are there: fewer looks cost confidence less, more stop sooner."""


def looks(minimum: int, maximum: int) -> tuple[int, ...]:
    """Numbers of balls at which the median is looked at: from the minimum, a fourth more each time, to the maximum."""
    counts = [min(minimum, maximum)]
    while counts[-1] < maximum:
        counts.append(min(maximum, counts[-1] + max(1, counts[-1] // GROWTH)))
    return tuple(counts)


def low_pass(
    balls: BallImage, weight: Float[Tensor, "d d"]
) -> tuple[Float[Tensor, "n cells c"], Float[Tensor, "cells"]]:
    """Means of balls over cells, and the share of the weight that each cell has.

    Args:
        balls: (N, D, D, C).
        weight: (D, D) how much a pixel counts, 0 or more; not all 0.

    Returns:
        (N, cells, C), and (cells,) that sums to 1. Cells without weight are left out.
    """
    rows = _membership(balls.shape[1]).to(balls)
    weight = weight.to(balls)
    shares = rows @ weight @ rows.T
    sums = torch.einsum("ki,nijc,lj->nklc", rows, balls * weight[..., None], rows)
    there = shares > 0
    return sums[:, there] / shares[there][:, None], shares[there] / shares.sum()


def _membership(side: int) -> Float[Tensor, "cells d"]:
    """Which row of cells each row of pixels belongs to, as ones."""
    cell = torch.arange(side) * CELLS // side
    return (cell == torch.arange(CELLS)[:, None]).float()


def error_bound(balls: BallImage, weight: Float[Tensor, "d d"], confidence: float = CONFIDENCE) -> float:
    """Upper confidence bound on the RMS error of the low-pass of the balls' median, in display values.

    Args:
        balls: (N, D, D, C) display-encoded.
        weight: (D, D) how much the merge will use a pixel, 0 or more; with weight nowhere no error matters.
        confidence: between 0 and 1; see `looks` for how several looks share what is left of 1.

    Returns:
        0 or more; infinite for fewer than three balls, whose spread says too little.

    Warnings:
        The error is that of the median about what infinitely many balls would give. What all balls have in common is
        not seen here.
    """
    if not bool((weight > 0).any()):
        return 0.0
    count = len(balls)
    if count < 3:
        return math.inf
    influences, shares = low_pass(_influences(balls), weight)
    scaled = (influences * (shares / balls.shape[-1]).sqrt()[:, None]).flatten(1).double() / count
    gram = scaled @ scaled.T * (count / (count - 1))
    mean_square = float(gram.trace())
    if mean_square == 0:
        return 0.0
    freedom = _freedom(gram, scaled.shape[1])
    return math.sqrt(mean_square * f_quantile(confidence, freedom, freedom * (count - 1)))


def _influences(balls: BallImage) -> BallImage:
    """s · sign(x_j - m) of each ball, (N, D, D, C)."""
    return torch.cat([_band_influences(band) for band in balls.split(BAND, dim=1)], dim=1)


def _band_influences(band: Tensor) -> Tensor:
    count = len(band)
    ordered = band.sort(dim=0).values
    median = (ordered[(count - 1) // 2] + ordered[count // 2]) / 2
    rank = max(1, round((count + 1) / 2 - math.sqrt(count)))
    beyond = sum(math.comb(count, i) for i in range(rank)) / 2**count
    error = (ordered[count - rank] - ordered[rank - 1]) / (2 * NormalDist().inv_cdf(1 - beyond))
    return (band - median).sign() * error * math.sqrt(count)


def _freedom(gram: Tensor, dimensions: int) -> float:
    """ν = (trace Σ)² / trace Σ², with the latter estimated without bias (Bai and Saranadasa 1996, Eq. 3.10)."""
    n = len(gram) - 1
    trace, square = float(gram.trace()), float(gram.square().sum())
    unbiased = n * n / ((n + 2) * (n - 1)) * (square - trace * trace / n)
    return min(float(dimensions), max(1.0, trace * trace / unbiased)) if unbiased > 0 else float(dimensions)


def f_quantile(probability: float, numerator: float, denominator: float) -> float:
    """Quantile of the F distribution, by the cube root's near normality.

    Args:
        probability: above 0.5, below 1.
        numerator: degrees of freedom, above 0.
        denominator: degrees of freedom, 3 or more.

    Raises:
        OptionError: another probability.

    Source: Paulson (1942), Eq. 1: ((1 - b) F^⅓ - (1 - a)) / √(a + b F^⅔) is near a standard normal variable, with
    a = 2 / (9 numerator) and b = 2 / (9 denominator).
    """
    if not 0.5 <= probability < 1:
        raise OptionError("probability", probability, "0.5 up to 1")
    z = NormalDist().inv_cdf(probability)
    a, b = 2 / (9 * numerator), 2 / (9 * denominator)
    # (1 - b) r - (1 - a) = z √(a + b r²), squared and solved for the larger r.
    lead, middle = (1 - b) ** 2 - z * z * b, (1 - a) * (1 - b)
    rest = (1 - a) ** 2 - z * z * a
    if lead <= 0:
        return math.inf
    return ((middle + math.sqrt(max(0.0, middle * middle - lead * rest))) / lead) ** 3
