"""The whole method: one photograph in, a light probe out.

Source: DiffusionLight, Fig. 2 (overview) and Sec. 4.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import torch
from jaxtyping import Float
from torch import Tensor

from .ball import Ball, fit_canvas, paint_depth, paste_ball, place_ball
from .errors import ImageError, OptionError
from .exposure import check_evs, check_merge, merge_bracket
from .geometry import ball_to_latlong
from .iterative import IterativeResult, Rounds, iterative_inpaint, rounds_evaluations
from .painter import Observer, Painter, PaintRequest
from .presets import PAPER_EVS
from .shapes import BallImage, Image, Latlong

__all__ = ["Probe", "Settings", "check_photograph", "estimate", "planned_evaluations"]


@dataclass(frozen=True)
class Settings:
    """What to estimate and how.

    Attributes:
        rounds: schedule of iterative inpainting, run at every EV.
        evs: exposure values, descending from 0.
        seed: of the first ball; the same at every EV, so that exposures share their noise.
        merge: method of `exposure.MERGES`.
        canvas: side of the square the photograph is fitted in, pixels.
        diameter: of the ball on it, pixels.
        x: column of the ball's centre on the canvas; the middle when None.
        y: row of the ball's centre; the middle when None.
        height: rows of the latlong map.
        depth_disc: of `ball.DEPTH_DISCS`, what the depth map shows of the ball.
    """

    rounds: Rounds = field(default_factory=Rounds)
    evs: tuple[float, ...] = PAPER_EVS
    seed: int = 0
    merge: str = "robust"
    canvas: int = 1024
    diameter: int = 256
    x: float | None = None
    y: float | None = None
    height: int = 256
    depth_disc: str = "ball"


@dataclass(frozen=True)
class Probe:
    """A light probe and what it came from.

    Attributes:
        latlong_hdr: (1, H, 2H, 3) linear radiance; EV 0 white is 1.
        ball_hdr: (1, D, D, 3) linear radiance.
        exposures: the result at each EV, in the order of `settings.evs`.
        composite_ldr: (1, S, S, 3) the photograph with the EV 0 ball, display-encoded.
        ball: where the ball sits.
        settings: what was asked for.
        evaluations: denoiser evaluations spent.
    """

    latlong_hdr: Latlong
    ball_hdr: BallImage
    exposures: tuple[IterativeResult, ...]
    composite_ldr: Float[Tensor, "b s s c"]
    ball: Ball
    settings: Settings
    evaluations: int


def check_photograph(photo_ldr: Image, source: str = "photograph") -> Image:
    """A photograph as (1, H, W, 3) floats in [0, 1].

    Args:
        photo_ldr: what should be one.
        source: what an error calls it.

    Raises:
        ImageError: another layout, NaN, or values outside [0, 1].
    """
    if photo_ldr.ndim != 4 or photo_ldr.shape[0] != 1 or photo_ldr.shape[3] != 3:
        raise ImageError(source, f"has shape {tuple(photo_ldr.shape)}, (1, height, width, 3) is accepted")
    if photo_ldr.numel() == 0:
        raise ImageError(source, f"is empty ({photo_ldr.shape[2]} x {photo_ldr.shape[1]})")
    if not torch.isfinite(photo_ldr).all():
        raise ImageError(source, "holds NaN or infinite values")
    low, high = float(photo_ldr.min()), float(photo_ldr.max())
    if low < 0 or high > 1:
        raise ImageError(source, f"holds values from {low:g} to {high:g}; display values in [0, 1] are accepted")
    return photo_ldr


def planned_evaluations(painter: Painter, settings: Settings) -> int:
    """Denoiser evaluations that `estimate` will spend, exactly."""
    return rounds_evaluations(painter, settings.rounds) * len(settings.evs)


def estimate(
    photo_ldr: Image,
    painter: Painter,
    settings: Settings,
    *,
    depth: Float[Tensor, "1 y x k"] | None = None,
    depth_of: Callable[[Image], Image] | None = None,
    observer: Observer | None = None,
) -> Probe:
    """Estimate the light of a photograph.

    Args:
        photo_ldr: (1, H, W, 3) display-encoded in [0, 1], any size.
        painter: paints the balls.
        settings: schedule, bracket, seed and sizes.
        depth: (1, h, w, 1 or 3) depth of the photograph, near is bright; without it the scene counts as far away, or is
            as far as `depth_of` finds it.
        depth_of: depth of a canvas, as `depth.DepthModel` gives it. With it depth is estimated again for every round,
            on the composite with the last median, as in the authors' code.
        observer: hears of progress; may stop the run by raising `Interrupted`.

    Raises:
        ImageError: a photograph or depth that cannot be used.
        OptionError: an option out of range, named.
        ModelError: what the painter raises about its model.
    """
    photo_ldr = check_photograph(photo_ldr)
    evs = check_evs(settings.evs)
    check_merge(settings.merge)
    if settings.height < 2:
        raise OptionError("height", settings.height, "2 or more rows")
    ball = place_ball(settings.canvas, settings.diameter, x=settings.x, y=settings.y, depth_disc=settings.depth_disc)
    canvas = fit_canvas(photo_ldr, settings.canvas)
    if depth is None and depth_of is not None:
        depth = depth_of(canvas)
    control = paint_depth(depth, ball)
    requests = [PaintRequest(canvas, control, ball, ev, (settings.seed,)) for ev in evs]
    exposures = tuple(
        iterative_inpaint(painter, request, settings.rounds, observer, depth_of=depth_of) for request in requests
    )
    ball_hdr = merge_bracket([exposure.ball for exposure in exposures], evs, settings.merge)
    return Probe(
        latlong_hdr=ball_to_latlong(ball_hdr, settings.height, painted=True),
        ball_hdr=ball_hdr,
        exposures=exposures,
        composite_ldr=paste_ball(canvas, exposures[0].ball, ball),
        ball=ball,
        settings=settings,
        evaluations=sum(exposure.evaluations for exposure in exposures),
    )
