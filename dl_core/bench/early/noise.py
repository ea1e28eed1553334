"""Noise that has proved good: whether a seed near the median, or near the truth, on some photographs is so on others.

Balls of the same seeds are painted once into every photograph at EV 0. Seeds are ranked on each; ranks of two
photographs that have nothing in common correlate by 0 on average. Then seeds are chosen for each photograph by their
mean rank on all others, and their median is held against medians of as many seeds drawn at random.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations
from pathlib import Path
from statistics import fmean
from typing import Final

import torch
from jaxtyping import Float
from safetensors.torch import load_file
from torch import Tensor

from ...errors import OptionError
from ...median import pixelwise_median
from ...painter import SilentObserver
from ...shapes import BallImage
from ...training.tensor_files import write_tensors
from ..painters import Studio
from ..paintings import VARIANTS
from ..report import Column, Row
from .section import Options, Scene, Section, ball_rmse

__all__ = ["NoiseSection", "rank_correlation", "ranks"]

DRAWS: Final = 200
"""Random choices of seeds, and random orders of them, that chosen ones are held against."""


class NoiseSection(Section):
    """Rank correlation of seeds over photographs, and the error of medians of chosen seeds."""

    summary = "whether noise that has proved good stays good"
    rows = ()
    columns = (
        Column("judged by", "judged_by"),
        Column("rank correlation", "correlation", "+.3f"),
        Column("by chance up to", "by_chance", ".3f"),
        Column("balls", "balls"),
        Column("error, chosen", "chosen_rmse", ".4f"),
        Column("random", "random_rmse", ".4f"),
        Column("ratio", "ratio", ".3f"),
        Column("better on", "better"),
        Column("of", "panoramas"),
    )

    def __init__(self, studio: Studio, options: Options) -> None:
        """Take the painters and what to paint.

        Raises:
            OptionError: too few seeds to choose from.
        """
        super().__init__(studio, options)
        if options.seeds <= options.balls:
            raise OptionError("--seeds", options.seeds, f"more than the {options.balls} of --balls")
        self._seeds = tuple(range(options.seed, options.seed + options.seeds))
        self._painted: dict[str, tuple[Tensor, Tensor]] = {}

    @property
    def each(self) -> int:
        """A row for each seed."""
        return len(self._seeds)

    @torch.no_grad()
    def measure(self, path: Path) -> list[Row]:
        """How far each seed's ball is from the median of the others, and from the truth."""
        scene = Scene.of(path, self._studio)
        painter = self._studio.painter_of(VARIANTS["both"], scene.shot)
        asked = replace(scene.request, seeds=self._seeds, steps=self._options.steps)
        result, truth = painter.paint(asked, SilentObserver()), scene.true_ball(0.0)
        self._keep(path.stem, result.balls, truth)
        return [
            {
                "panorama": path.stem,
                "seed": seed,
                "median": ball_rmse(ball, pixelwise_median(torch.cat((result.balls[:j], result.balls[j + 1 :])))),
                "truth": ball_rmse(ball, truth),
                "evaluations": result.evaluations // len(self._seeds),
            }
            for j, (seed, ball) in enumerate(zip(self._seeds, result.balls.split(1), strict=True))
        ]

    def summarize(self, rows: list[Row]) -> list[Row]:
        """A record for each way to judge a seed."""
        names = list(dict.fromkeys(row["panorama"] for row in rows))
        return [self._judged(names, rows, key) for key in ("median", "truth")]

    def protocol(self) -> Row:
        """What was measured how."""
        return {
            "judged by": "distance of a seed's ball from the median of the other seeds' balls, or from the truth",
            "rank correlation": "Spearman's, mean over pairs of photographs",
            "by chance up to": f"97.5th percentile of it over {DRAWS} random orders of the seeds of each photograph",
            "chosen": "RMSE from the truth of the median of the seeds of the best mean rank on all other photographs",
            "random": f"the same of as many seeds drawn at random, mean of {DRAWS} draws",
        }

    def _judged(self, names: list[str], rows: list[Row], key: str) -> Row:
        table = torch.stack(
            [ranks(torch.tensor([row[key] for row in rows if row["panorama"] == name])) for name in names]
        )
        generator = torch.Generator().manual_seed(0)
        drawn = [torch.stack([_shuffled(line, generator) for line in table]) for _ in range(DRAWS)]
        by_chance = torch.tensor([rank_correlation(order) for order in drawn]).quantile(0.975)
        chosen, random = list[float](), list[float]()
        for i, name in enumerate(names):
            balls, truth = self._found(name)
            others = torch.cat((table[:i], table[i + 1 :])).mean(dim=0)
            best = others.argsort()[: self._options.balls]
            chosen.append(ball_rmse(pixelwise_median(balls[best]), truth))
            random.append(_random_error(balls, truth, self._options.balls, generator))
        return {
            "judged_by": key,
            "correlation": rank_correlation(table),
            "by_chance": float(by_chance),
            "balls": self._options.balls,
            "chosen_rmse": fmean(chosen),
            "random_rmse": fmean(random),
            "ratio": fmean(a / b for a, b in zip(chosen, random, strict=True)),
            "better": sum(a < b for a, b in zip(chosen, random, strict=True)),
            "panoramas": len(names),
        }

    def _place(self, name: str) -> Path | None:
        return None if self._options.out is None else self._options.out / "balls" / f"{name}.safetensors"

    def _keep(self, name: str, balls: BallImage, truth: Float[Tensor, "1 d d c"]) -> None:
        """Before the rows are: they say that the balls are there."""
        self._painted[name], place = (balls, truth), self._place(name)
        if place is not None:
            place.parent.mkdir(parents=True, exist_ok=True)
            write_tensors(place, {"balls": balls, "truth": truth}, {})

    def _found(self, name: str) -> tuple[Tensor, Tensor]:
        place = self._place(name)
        if name not in self._painted and place is not None:
            kept = load_file(place)
            self._painted[name] = kept["balls"], kept["truth"]
        return self._painted[name]


def ranks(values: Float[Tensor, "n"]) -> Float[Tensor, "n"]:
    """Place of each value in ascending order, from 0."""
    return values.argsort().argsort().float()


def rank_correlation(table: Float[Tensor, "p n"]) -> float:
    """Spearman's rank correlation, mean over the pairs of rows: ranks without ties of n items in p rankings.

    Source: Spearman, The proof and measurement of association between two things (American Journal of Psychology,
    1904).
    """
    correlations = torch.corrcoef(table)
    return fmean(float(correlations[i, j]) for i, j in combinations(range(len(table)), 2))


def _shuffled(line: Tensor, generator: torch.Generator) -> Tensor:
    return line[torch.randperm(len(line), generator=generator)]


def _random_error(balls: BallImage, truth: Float[Tensor, "1 d d c"], count: int, generator: torch.Generator) -> float:
    draws = [torch.randperm(len(balls), generator=generator)[:count] for _ in range(DRAWS)]
    return fmean(ball_rmse(pixelwise_median(balls[draw]), truth) for draw in draws)
