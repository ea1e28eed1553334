"""What decoding the ball's neighbourhood alone loses and saves, by its margin, with any painter's autoencoder."""

from __future__ import annotations

from pathlib import Path
from statistics import fmean, median
from time import perf_counter
from typing import Final

import torch

from ...ball import paste_ball
from ...decoding import decode_ball, decode_margin
from ..paintings import VARIANTS
from ..report import Column, Row
from .section import Scene, Section, latents_of, require_latents

__all__ = ["MARGINS", "DecodingSection"]

MARGINS: Final = (0, 2, 4, 8, 16)
"""Latent cells around the ball."""


class DecodingSection(Section):
    """Latents of the photograph with its true ball, decoded whole and in part."""

    summary = "decoding the ball's neighbourhood against decoding the canvas"
    rows = ()
    columns = (
        Column("margin", "margin"),
        Column("in use", "in_use"),
        Column("panoramas", "panoramas"),
        Column("worst (codes)", "worst_codes", ".3f"),
        Column("mean (codes)", "mean_codes", ".4f"),
        Column("contrast (codes)", "contrast_codes", ".1f"),
        Column("s", "seconds", ".3f"),
        Column("whole, s", "whole_seconds", ".3f"),
    )

    @property
    def each(self) -> int:
        """A row for each margin."""
        return len(MARGINS)

    @torch.no_grad()
    def measure(self, path: Path) -> list[Row]:
        """Differences from the whole canvas' decoding, in codes of 8 bits.

        Raises:
            OptionError: a painter without latents.
        """
        scene = Scene.of(path, self._studio)
        painter = require_latents(self._studio.painter_of(VARIANTS["both"], scene.shot))
        ball, used = scene.request.ball, decode_margin(painter.pipeline.vae)
        latents = latents_of(painter, paste_ball(scene.request.canvas, scene.true_ball(0.0), ball))
        started = perf_counter()
        whole = decode_ball(painter.decode, latents, ball, None)
        whole_seconds, rows = perf_counter() - started, list[Row]()
        for margin in MARGINS:
            started = perf_counter()
            part = decode_ball(painter.decode, latents, ball, margin)
            seconds, difference = perf_counter() - started, 255 * (part - whole).abs()
            rows.append(
                {
                    "panorama": path.stem,
                    "margin": margin,
                    "in_use": margin == used,
                    "worst_codes": float(difference.max()),
                    "mean_codes": float(difference.mean()),
                    "contrast_codes": 255 * float(whole.std()),
                    "seconds": seconds,
                    "whole_seconds": whole_seconds,
                }
            )
        return rows

    def summarize(self, rows: list[Row]) -> list[Row]:
        """The worst and the mean difference over panoramas, median times."""
        summary = []
        for margin in MARGINS:
            own = [row for row in rows if row["margin"] == margin]
            line: Row = {"margin": margin, "in_use": own[0]["in_use"], "panoramas": len(own)}
            line |= {"worst_codes": max(row["worst_codes"] for row in own)}
            line |= {key: fmean(row[key] for row in own) for key in ("mean_codes", "contrast_codes")}
            summary.append(line | {key: median(row[key] for row in own) for key in ("seconds", "whole_seconds")})
        return summary

    def protocol(self) -> Row:
        """What was measured how."""
        return {
            "latents": "of the photograph with its true ball at EV 0, encoded",
            "in use": "the margin that painters take for this autoencoder; none where they decode the whole canvas",
            "codes": "differences from the ball cut out of the whole canvas' decoding, of 255",
        }
