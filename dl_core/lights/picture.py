"""A decision as a picture: spheres under the full map and under the light chosen, and the error of every candidate."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image as PILImage
from PIL import ImageDraw, ImageFont
from torch import Tensor

from ..exposure import auto_exposure, encode_display
from ..geometry import ball_coverage
from ..resize import resize_latlong
from ..shapes import BallImage, Latlong
from .choose import LEVELS, Decision
from .search import Candidate
from .shading import ROWS, model_pictures, shade_map, shade_model

__all__ = ["decision_picture"]

_SIZE: Final = 160
"""Side of a sphere's picture in pixels."""
_GAP: Final = 16
_LABEL: Final = 24
_STEP: Final = _SIZE + _LABEL + _GAP
_HEIGHT: Final = 2 * _STEP + _GAP
_CHART: Final = 440
"""Width of the chart."""
_GREY: Final = 33
_INK: Final = (200, 200, 200)
_FAINT: Final = (90, 90, 90)
_DOT: Final = (120, 160, 220)
_CHOSEN: Final = (255, 190, 60)
_DECADES: Final = (0.001, 1.0)
"""Least and largest error on the chart's axis; what lies outside is drawn at its end."""


def decision_picture(latlong_hdr: Latlong, decision: Decision) -> Float[Tensor, "rows columns 3"]:
    """One picture for people.

    Above the spheres under the full map, below those under the light that was chosen; where that is the full map, the
    closest of the others. Both at one exposure for each material. The chart shows every candidate by price and
    error, a line at each tolerance, and the chosen one in colour.

    Args:
        latlong_hdr: (1, H, 2H, 3) linear radiance, the map that was decided.
        decision: of `choose_light`.

    Returns:
        (416, width, 3) display-encoded in [0, 1]; the width depends on the number of materials alone.
    """
    shown = _shown(decision)
    truth = model_pictures(shade_map(resize_latlong(latlong_hdr.float().cpu(), ROWS), decision.materials, _SIZE), _SIZE)
    model = shown.model
    below = truth if model is None else model_pictures(shade_model(model, decision.materials, _SIZE), _SIZE)
    width = _GAP + len(decision.materials) * (_SIZE + _GAP)
    codes = np.full((_HEIGHT, width + _CHART, 3), _GREY, np.uint8)
    for row, spheres in enumerate((truth, below)):
        for column, name in enumerate(decision.materials):
            top, left = _GAP + row * _STEP + _LABEL, _GAP + column * (_SIZE + _GAP)
            codes[top : top + _SIZE, left : left + _SIZE] = _developed(spheres[name], auto_exposure(truth[name]))
    sheet = PILImage.fromarray(codes)
    draw = ImageDraw.Draw(sheet)
    font = ImageFont.load_default(13)
    for column, name in enumerate(decision.materials):
        left = _GAP + column * (_SIZE + _GAP)
        draw.text((left, _GAP), f"{name}, full map", fill=_INK, font=font)
        draw.text((left, _GAP + _STEP), _caption(shown, name, decision), fill=_INK, font=font)
    _Chart(draw, font, width).draw_candidates(decision)
    return torch.from_numpy(np.asarray(sheet).astype(np.float32) / 255)


def _shown(decision: Decision) -> Candidate:
    """The candidate whose spheres are worth looking at."""
    if decision.chosen.model is not None:
        return decision.chosen
    return min(decision.candidates[:-1], key=lambda one: one.relative_error)


def _caption(shown: Candidate, material: str, decision: Decision) -> str:
    kind = "chosen" if shown is decision.chosen else "closest"
    return f"{kind}, {_percent(shown.errors[material])} off"


def _percent(value: float) -> str:
    return f"{100 * value:.0f}%" if value >= 0.1 else f"{100 * value:.2g}%"


def _developed(ball: BallImage, scale: float) -> np.ndarray:
    """A sphere as codes of 8 bits on the background."""
    coverage = ball_coverage(_SIZE)[..., None]
    display = encode_display(ball[0] * scale) * coverage + _GREY / 255 * (1 - coverage)
    return np.asarray((display * 255).round().to(torch.uint8))


class _Chart:
    """Candidates by price (across) and error (up, logarithmic); the full map, too dear for the axis, at its right end.

    Args:
        draw: what is drawn on.
        font: of the labels.
        left: where the chart begins.
    """

    def __init__(self, draw: ImageDraw.ImageDraw, font: ImageFont.ImageFont | ImageFont.FreeTypeFont, left: int):
        self.draw, self.font = draw, font
        self.left, self.right = left + 48, left + _CHART - _GAP
        self.top, self.bottom = _GAP + _LABEL, _HEIGHT - 3 * _LABEL

    def draw_candidates(self, decision: Decision) -> None:
        """The whole chart."""
        chosen, full = decision.chosen, decision.candidates[-1]
        dearest = decision.candidates[-2].parameters
        self._text(self.left, _GAP, "error of the worst sphere by numbers needed")
        for level in sorted({*LEVELS, decision.tolerance, _DECADES[1]}):
            self._line_at(level, _CHOSEN if level == decision.tolerance else _FAINT)
        for price in sorted({*_MARKED, dearest} if dearest > _MARKED[-1] + 10 else _MARKED):
            self._text(self._across(price, dearest) - 7, self.bottom + 6, f"{price}")
        self._text(self.right - _FULL + 4, self.bottom + 6, f"{full.parameters:,}")
        for candidate in decision.candidates:
            self._dot(candidate, dearest, 3, _DOT)
        self._dot(chosen, dearest, 6, _CHOSEN)
        self._text(self.left, self.bottom + _LABEL, f"{chosen.name}: {chosen.parameters:,} numbers")
        error = f"{_percent(chosen.relative_error)} of {_percent(decision.tolerance)} allowed"
        self._text(self.left, self.bottom + 2 * _LABEL - 6, error)

    def _across(self, price: int, dearest: int) -> float:
        if price > dearest:
            return self.right - _FULL / 2
        return self.left + 12 + (price / dearest) * (self.right - _FULL - 24 - self.left)

    def _down(self, error: float) -> float:
        least, largest = (math.log(edge) for edge in _DECADES)
        share = (math.log(min(max(error, _DECADES[0]), _DECADES[1])) - least) / (largest - least)
        return self.bottom - share * (self.bottom - self.top)

    def _line_at(self, level: float, ink: tuple[int, int, int]) -> None:
        height = self._down(level)
        self.draw.line((self.left, height, self.right, height), fill=ink)
        self._text(self.left - 40, height - 8, _percent(level))

    def _dot(self, candidate: Candidate, dearest: int, radius: int, ink: tuple[int, int, int]) -> None:
        x, y = self._across(candidate.parameters, dearest), self._down(candidate.relative_error)
        self.draw.ellipse((x - radius, y - radius, x + radius, y + radius), fill=ink)

    def _text(self, left: float, top: float, text: str) -> None:
        self.draw.text((left, top), text, fill=_INK, font=self.font)


_MARKED: Final = (3, 12, 27)
"""Prices of ambient light and harmonics, which are on the axis of every chart."""
_FULL: Final = 72
"""Width kept for the full map."""
