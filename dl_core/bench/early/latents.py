"""Medians of latents: whether they stand for medians of pictures, and what not decoding would save.

One round from noise at EV 0, its median taken both ways, and one ball painted from each by SDEdit.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from statistics import fmean, median
from time import perf_counter
from types import SimpleNamespace

import torch
from torch import Tensor

from ...ball import Ball, paste_ball
from ...median import pixelwise_median
from ...painter import PaintRequest
from ...shapes import BallImage
from ..paintings import VARIANTS
from ..report import Column, Row
from .section import LatentPainter, Scene, Section, ball_rmse, latents_of, require_latents

__all__ = ["LatentsSection", "latent_median"]


def latent_median(latents: Tensor) -> Tensor:
    """Median of N latents by element, (n, k, h, w) -> (1, k, h, w), as `pixelwise_median` takes it."""
    return pixelwise_median(latents.permute(0, 2, 3, 1)).permute(0, 3, 1, 2)


class LatentsSection(Section):
    """Medians of latents against medians of decoded balls."""

    summary = "medians of latents against medians of pictures"
    rows = (
        Column("panorama", "panorama"),
        Column("latents differ", "latents_differ", ".3f"),
        Column("medians differ", "medians_differ", ".4f"),
        Column("balls differ", "balls_differ", ".4f"),
        Column("error, pixels", "pixel_rmse", ".4f"),
        Column("error, latents", "latent_rmse", ".4f"),
        Column("saved", "saved", ".1%"),
    )
    columns = (
        Column("panoramas", "panoramas"),
        Column("latents differ", "latents_differ", ".3f"),
        Column("there and back", "there_and_back", ".3f"),
        Column("medians differ", "medians_differ", ".4f"),
        Column("seeds differ", "seeds_differ", ".4f"),
        Column("balls differ", "balls_differ", ".4f"),
        Column("median error, pixels", "pixel_median_rmse", ".4f"),
        Column("latents", "latent_median_rmse", ".4f"),
        Column("ball error, pixels", "pixel_rmse", ".4f"),
        Column("latents", "latent_rmse", ".4f"),
        Column("worse on", "worse"),
        Column("denoising s", "denoising_s", ".2f"),
        Column("decoding s", "decoding_s", ".3f"),
        Column("encoding s", "encoding_s", ".3f"),
        Column("saved", "saved", ".1%"),
        Column("of early", "saved_early", ".1%"),
    )

    @property
    def each(self) -> int:
        """One row a panorama."""
        return 1

    @torch.no_grad()
    def measure(self, path: Path) -> list[Row]:
        """Both medians and the balls painted from them.

        Raises:
            OptionError: a painter without latents.
        """
        scene, options = Scene.of(path, self._studio), self._options
        painter = require_latents(self._studio.painter_of(VARIANTS["both"], scene.shot))
        ball, seconds, spent = scene.request.ball, dict[str, float](), list[int]()

        def timed(what: str, work: Callable[[], Tensor]) -> Tensor:
            started = perf_counter()
            done = work()
            seconds[what] = perf_counter() - started
            return done

        seeds = tuple(range(options.seed, options.seed + options.balls))
        asked = replace(scene.request, seeds=seeds, steps=options.steps)
        photograph = painter.encode(asked.canvas)
        latents = timed("denoising", lambda: painter.inpaint(asked, photograph, spent.append))
        balls = timed("decoding", lambda: painter.decode_ball(latents, ball))
        canvas = timed("pixels", lambda: paste_ball(asked.canvas, pixelwise_median(balls), ball))
        known = timed("encoding", lambda: latents_of(painter, canvas))
        middle = timed("latents", lambda: latent_median(latents))

        again = replace(asked, seeds=seeds[:1], strength=options.strength)
        answers = [_sdedit(painter, again, clean, spent.append) for clean in (known, middle)]
        other = _sdedit(painter, replace(again, seeds=(seeds[0] + options.balls,)), known, spent.append)
        truth, medians = scene.true_ball(0.0), (pixelwise_median(balls), painter.decode_ball(middle, ball))
        saved = seconds["decoding"] + seconds["pixels"] + seconds["encoding"] - seconds["latents"]
        there_and_back = latents_of(painter, paste_ball(asked.canvas, medians[1], ball))
        early = min(options.untils)
        return [
            {
                "panorama": path.stem,
                "latents_differ": _differ(middle, known, ball),
                "there_and_back": _differ(middle, there_and_back, ball),
                "medians_differ": ball_rmse(*medians),
                "seeds_differ": ball_rmse(answers[0], other),
                "balls_differ": ball_rmse(*answers),
                "pixel_median_rmse": ball_rmse(medians[0], truth),
                "latent_median_rmse": ball_rmse(medians[1], truth),
                "pixel_rmse": ball_rmse(answers[0], truth),
                "latent_rmse": ball_rmse(answers[1], truth),
                **{f"{what}_s": value for what, value in seconds.items()},
                "saved": saved / (saved + seconds["denoising"]),
                "saved_early": saved / (saved + early * seconds["denoising"]),
                "evaluations": sum(spent),
            }
        ]

    def summarize(self, rows: list[Row]) -> list[Row]:
        """Mean errors, median times, and on how many panoramas the ball from latents is the worse one."""
        timed = [key for key in rows[0] if key.startswith("saved") or key.endswith("_s")]
        compared = [key for key in rows[0] if key not in {"panorama", "evaluations", *timed}]
        line: Row = {"panoramas": len(rows), "worse": sum(row["latent_rmse"] > row["pixel_rmse"] for row in rows)}
        line |= {key: fmean(row[key] for row in rows) for key in compared}
        return [line | {key: median(row[key] for row in rows) for key in timed}]

    def protocol(self) -> Row:
        """What was measured how."""
        return {
            "latents differ": "distance of SDEdit's two starts inside the disc, over the contrast of the pixels' one",
            "there and back": "the same of the median of latents and what decoding and encoding makes of it",
            "balls differ": "RMSE of the balls painted from them; seeds differ: of two seeds from one start",
            "error": "RMSE from the true ball, display-encoded",
            "saved": "share of a round's time that decoding, median of pictures and encoding take over that of latents",
            "of early": f"the same where medians stop after {min(self._options.untils):g} of the schedule",
        }


def _sdedit(painter: LatentPainter, request: PaintRequest, clean: Tensor, counted: Callable[[int], None]) -> BallImage:
    """The ball of a request, painted from clean latents of a canvas."""
    encoded = SimpleNamespace(latents=clean / painter.pipeline.vae.config.scaling_factor)
    return painter.decode_ball(painter.inpaint(request, encoded, counted), request.ball)


def _differ(one: Tensor, other: Tensor, ball: Ball) -> float:
    """Distance of two latents inside the ball's disc, over the other's contrast there."""
    from ...backends.diffusers_painter import ball_latent_mask

    inside = ball_latent_mask(replace(ball, dilation=0)).to(other) == 1
    first, second = (latents[inside.expand_as(latents)].view(latents.shape[1], -1) for latents in (one, other))
    return float((first - second).norm() / (second - second.mean(dim=1, keepdim=True)).norm())
