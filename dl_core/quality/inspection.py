"""Score and checks of a file: the picture of a ball, a canvas with one in it, or an environment map.

A map is judged by the mirror ball that it would show.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from ..ball import Ball, crop_ball
from ..errors import ImageError, OptionError
from ..exposure import auto_exposure, expose
from ..geometry import latlong_to_ball
from ..resize import resize_latlong
from ..shapes import Image, Latlong
from .features import SIDE, SMALLEST, ball_features
from .judge import Check, Judge, shipped_judge
from .surroundings import horizon_check, rim_check

__all__ = ["Inspection", "inspect_map", "inspect_picture", "parse_ball"]


@dataclass(frozen=True)
class Inspection:
    """What was found.

    Attributes:
        score: 0 to 1; 1 is a good mirror ball.
        checks: what it rests on, and what else was looked at.
        notes: what could not be looked at, and why; a sentence each.
    """

    score: float
    checks: tuple[Check, ...]
    notes: tuple[str, ...] = ()

    def document(self) -> dict[str, Any]:
        """As JSON has it."""
        return {
            "score": self.score,
            "checks": [check.document() for check in self.checks],
            "notes": list(self.notes),
        }


def parse_ball(text: str, width: int, height: int) -> Ball:
    """A ball from `X,Y,DIAMETER`, centre and size in pixels of a picture.

    Raises:
        OptionError: not three whole numbers, or a ball that is not on the picture.
    """
    try:
        x, y, diameter = (int(part) for part in text.split(","))
    except ValueError as error:
        raise OptionError("--ball", text, "three whole numbers X,Y,DIAMETER in pixels") from error
    left, top = x - diameter // 2, y - diameter // 2
    fits = diameter >= SMALLEST and left >= 0 and top >= 0 and left + diameter <= width and top + diameter <= height
    if not fits:
        raise OptionError(
            "--ball", text, f"a ball of {SMALLEST} pixels or more that lies on the {width} x {height} picture"
        )
    return Ball(left, top, diameter, max(width, height), 0)


def inspect_picture(picture_ldr: Image, ball: Ball | None = None, judge: Judge | None = None) -> Inspection:
    """Judge the picture of a ball.

    Args:
        picture_ldr: (1, H, W, 3) display-encoded: a square crop that the ball fills, or with `ball` a whole picture.
        ball: where it is in the picture.
        judge: the shipped one when not given.

    Raises:
        ImageError: a crop that is not square, or too small.
    """
    judge = judge or shipped_judge()
    height, width = picture_ldr.shape[1:3]
    if ball is None:
        if height != width:
            raise ImageError("picture", f"is {width} x {height}: a square crop of the ball, or --ball X,Y,DIAMETER")
        crop, notes = picture_ldr, ["the picture around the ball is not there: its rim is not compared with it"]
    else:
        crop = crop_ball(picture_ldr, ball)
        notes = []
    features = ball_features(crop)
    checks = judge.ball_checks(features)
    if ball is not None and height == width:
        checks.append(rim_check(picture_ldr, ball, judge))
    elif ball is not None:
        notes.append("the picture is not square, as a canvas is: its rim is not compared with it")
    checks.append(horizon_check(features, judge))
    notes.append("one exposure: whether exposures agree is not known")
    return Inspection(judge.score(features), tuple(checks), tuple(notes))


def inspect_map(latlong_hdr: Latlong, judge: Judge | None = None) -> Inspection:
    """Judge an environment map by the mirror ball it would show at EV 0.

    Args:
        latlong_hdr: (1, H, 2H, 3) linear radiance, as the ball was unwrapped: not turned. Shown with its own 99th
            percentile at 0.9, so that maps of any scale can be judged.
        judge: the shipped one when not given.
    """
    judge = judge or shipped_judge()
    small = resize_latlong(latlong_hdr, min(2 * SIDE, latlong_hdr.shape[1]))
    scale = auto_exposure(small)
    ball = expose(latlong_to_ball(small * scale, SIDE, samples=2), 0.0)
    features = ball_features(ball)
    notes = ("the painted balls are not in the file: their agreement and their surroundings are not known",)
    return Inspection(judge.score(features), (*judge.ball_checks(features), horizon_check(features, judge)), notes)
