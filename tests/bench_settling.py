"""How many balls the sequential median paints, beside a fixed number that reaches the same error: run by hand.

    PYTHONPATH=. python tests/bench_settling.py

Balls of a painter that knows the truth, a fifth of them disco balls, with a smooth error of several strengths. The
sequential median is given a tolerance and a maximum. The fixed number is the smallest whose plain median, outliers
included, is within the tolerance of the truth in as many trials as the rule promises: for each strength by itself, as
if it were known beforehand, and for scenes of all strengths together, as it is not.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from statistics import mean

import torch
from analytic_painter import Flaws
from test_settling import REQUEST, TRUTH, error_of, painter_with

from dl_core.iterative import Rounds, iterative_inpaint
from dl_core.median import pixelwise_median
from dl_core.painter import SilentObserver
from dl_core.settling import CONFIDENCE

STRENGTHS = (0.01, 0.02, 0.03, 0.04, 0.06)


def smallest(errors: list[list[float]], tolerance: float) -> str:
    """The smallest fixed number of balls within the tolerance in enough trials; errors by trial, then by number."""
    for number, of_number in enumerate(zip(*errors, strict=True), 1):
        if mean(error <= tolerance for error in of_number) >= CONFIDENCE:
            return str(number)
    return f"over {len(errors[0])}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trials", type=int, default=200)
    parser.add_argument("--tolerance", type=float, default=0.02)
    parser.add_argument("--most", type=int, default=60)
    args = parser.parse_args()
    torch.set_num_threads(1)
    rounds = Rounds(balls=args.most, rounds=1, steps=1, final=False, tolerance=args.tolerance)
    everything, spent = list[list[float]](), list[int]()
    sys.stdout.write("error    sequential: balls, within   fixed number for the same error\n")
    for strength in STRENGTHS:
        painter = painter_with(Flaws(noise=0.03, uneven=strength, disco=0.2))
        counts, within, errors = list[int](), 0, list[list[float]]()
        for trial in range(args.trials):
            request = replace(REQUEST, seeds=tuple(range(1000 * trial, 1000 * trial + args.most)))
            result = iterative_inpaint(painter, request, rounds)
            counts.append(result.tallies[0].painted)
            within += error_of(result.median, TRUTH) <= args.tolerance
            balls = painter.paint(request, SilentObserver()).balls
            errors.append([error_of(pixelwise_median(balls[:n]), TRUTH) for n in range(1, args.most + 1)])
        fixed = smallest(errors, args.tolerance)
        sys.stdout.write(f"{strength:<9g}{mean(counts):>11.1f}{within / args.trials:>14.3f}{fixed:>14}\n")
        sys.stdout.flush()
        everything += errors
        spent += counts
    sys.stdout.write(f"together {mean(spent):>11.1f}{'':>14}{smallest(everything, args.tolerance):>14}\n")


if __name__ == "__main__":
    main()
