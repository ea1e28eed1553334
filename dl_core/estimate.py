"""The whole method: one photograph in, a light probe out.

Source: DiffusionLight, Fig. 2 (overview) and Sec. 4.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Final

import torch
from jaxtyping import Float
from torch import Tensor

from .ball import Ball, crop_disc, fit_canvas, paint_depth, paste_ball, place_ball
from .bracket import check_bracket, darkest_of, hidden_radiance, ladder
from .confidence import FEWEST, Confidence, bracket_spread, confidence_of
from .errors import ImageError, OptionError
from .exposure import brackets_of, check_evs, check_merge, merge_batches, merge_bracket
from .geometry import ball_to_latlong
from .iterative import IterativeResult, Rounds, iterative_inpaint, rounds_evaluations, tell_spared
from .painter import Observer, Painter, PaintRequest, SilentObserver
from .presets import PAPER_EVS
from .restored_lights import restore_lights
from .shapes import BallImage, Image, Latlong

__all__ = [
    "Probe",
    "Settings",
    "bracket_remarks",
    "check_photograph",
    "confidence_remark",
    "estimate",
    "planned_evaluations",
    "planned_evs",
]

HIDDEN_SHARE: Final = 0.01
"""Share of the energy known that a scene-sized bracket may leave hidden: 0.014 stops."""


@dataclass(frozen=True)
class Settings:
    """What to estimate and how.

    Attributes:
        rounds: schedule of iterative inpainting, run at every EV.
        evs: exposure values, descending from 0.
        bracket: of `bracket.BRACKETS`. `fixed` paints every EV. `scene` paints EV 0, and the next darker one only where
            the last one clips so much that darker ones could add over 1% of the energy known (`HIDDEN_SHARE`); after
            the last of `evs` it goes on at the same distance down to `darkest`.
        darkest: EV at which a scene-sized bracket ends. When None, that which the painter was made for
            (`bracket.darkest_of`); a lower one asks a model for what it was not trained on.
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
    bracket: str = "fixed"
    darkest: float | None = None


@dataclass(frozen=True)
class Probe:
    """A light probe and what it came from.

    Attributes:
        latlong_hdr: (1, H, 2H, 3) linear radiance; EV 0 white is 1.
        ball_hdr: (1, D, D, 3) linear radiance, its lights restored if the schedule has light balls.
        evs: exposure values painted, descending from 0.
        exposures: the result at each of them.
        composite_ldr: (1, S, S, 3) the photograph with the EV 0 ball, display-encoded.
        ball: where the ball sits.
        settings: what was asked for.
        evaluations: denoiser evaluations spent.
        clipped: share of the ball that the darkest exposure still shows clipped, where lights end at its white.
        confidence: what error to expect; None where an exposure has too few balls to differ.
    """

    latlong_hdr: Latlong
    ball_hdr: BallImage
    evs: tuple[float, ...]
    exposures: tuple[IterativeResult, ...]
    composite_ldr: Float[Tensor, "b s s c"]
    ball: Ball
    settings: Settings
    evaluations: int
    clipped: float
    confidence: Confidence | None = None


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


def planned_evs(settings: Settings, painter: Painter | None = None) -> tuple[float, ...]:
    """Exposures that `estimate` will paint: all of them, or with a scene-sized bracket the first so many as it needs.

    Args:
        settings: bracket and its darkest EV.
        painter: may have a darkest EV of its own, which counts where the settings name none.

    Raises:
        OptionError: EVs, a bracket or a darkest EV that are not accepted.
    """
    if check_bracket(settings.bracket) == "fixed":
        return check_evs(settings.evs)
    return ladder(settings.evs, darkest_of(painter) if settings.darkest is None else settings.darkest)


def planned_evaluations(painter: Painter, settings: Settings) -> int:
    """Denoiser evaluations that `estimate` will spend.

    Exactly, with a fixed bracket, no tolerance and no balls left out; otherwise at most. An
    `iterative.SparingObserver` hears of those that turn out not to be needed, so that the two together are what was
    planned.
    """
    return rounds_evaluations(painter, settings.rounds) * len(planned_evs(settings, painter))


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
    observer = observer or SilentObserver()
    photo_ldr = check_photograph(photo_ldr)
    evs = planned_evs(settings, painter)
    check_merge(settings.merge)
    if settings.height < 2:
        raise OptionError("height", settings.height, "2 or more rows")
    ball = place_ball(settings.canvas, settings.diameter, x=settings.x, y=settings.y, depth_disc=settings.depth_disc)
    canvas = fit_canvas(photo_ldr, settings.canvas)
    if depth is None and depth_of is not None:
        depth = depth_of(canvas)
    request = PaintRequest(canvas, paint_depth(depth, ball), ball, 0.0, (settings.seed,))
    exposures = _paint_bracket(painter, request, settings, evs, observer, depth_of)
    painted = evs[: len(exposures)]
    ball_hdr = merge_bracket([exposure.ball for exposure in exposures], painted, settings.merge)
    if settings.rounds.light_balls:
        whole = [exposure.whole_balls for exposure in exposures]
        ball_hdr = restore_lights(ball_hdr, merge_batches(whole, painted, settings.merge))
    latlong_hdr = ball_to_latlong(ball_hdr, settings.height, painted=True)
    return Probe(
        latlong_hdr=latlong_hdr,
        ball_hdr=ball_hdr,
        evs=painted,
        exposures=exposures,
        composite_ldr=paste_ball(canvas, exposures[0].ball, ball),
        ball=ball,
        settings=settings,
        evaluations=sum(exposure.evaluations for exposure in exposures),
        clipped=_clipped_share(exposures, painted, settings.merge, ball),
        confidence=_confidence(exposures, painted, latlong_hdr),
    )


def _paint_bracket(
    painter: Painter,
    request: PaintRequest,
    settings: Settings,
    evs: tuple[float, ...],
    observer: Observer,
    depth_of: Callable[[Image], Image] | None,
) -> tuple[IterativeResult, ...]:
    """Paint exposures from the brightest on: all of them, or as many as the scene needs.

    Where a median is to keep a tolerance it does so where the merge will use it: at EV 0 on the whole ball, further
    down where all brighter exposures clip.
    """
    exposures: list[IterativeResult] = []
    used = None
    looks_at_clipping = settings.bracket == "scene" or settings.rounds.tolerance is not None
    for ev in evs:
        if exposures and looks_at_clipping:
            balls, brighter = [exposure.ball for exposure in exposures], evs[: len(exposures)]
            if settings.bracket == "scene" and not _matters(exposures, brighter, evs[-1], settings.merge, request.ball):
                break
            used = (hidden_radiance(balls, brighter, evs[-1], settings.merge) > 0).any(dim=-1).to(balls[0])
        asked = replace(request, ev=ev)
        exposures.append(iterative_inpaint(painter, asked, settings.rounds, observer, depth_of=depth_of, used=used))
    tell_spared(observer, rounds_evaluations(painter, settings.rounds) * (len(evs) - len(exposures)))
    return tuple(exposures)


def _whole_brackets(exposures: Sequence[IterativeResult]) -> list[tuple[BallImage, ...]]:
    """The balls that show how bright lights are, each with its own exposures: of one seed, so of one scene."""
    return brackets_of([exposure.whole_balls for exposure in exposures])


def _matters(
    exposures: Sequence[IterativeResult], evs: tuple[float, ...], darkest: float, merge: str, ball: Ball
) -> bool:
    """Whether what further exposures could add is more than the share of the energy that may stay hidden.

    Sums over the ball's pixels are energies: each covers the same solid angle.
    """
    disc = crop_disc(ball)[None, ..., None]
    hidden, known = 0.0, 0.0
    for balls in _whole_brackets(exposures):
        hidden += float((hidden_radiance(balls, evs, darkest, merge) * disc).sum())
        known += float((merge_bracket(balls, evs, merge) * disc).sum())
    return hidden > HIDDEN_SHARE * known


def _confidence(
    exposures: tuple[IterativeResult, ...], evs: tuple[float, ...], latlong_hdr: Latlong
) -> Confidence | None:
    opinions = [exposure.balls for exposure in exposures]
    if min(map(len, opinions)) < FEWEST:
        return None
    return confidence_of(bracket_spread(opinions, evs), latlong_hdr)


def _clipped_share(exposures: Sequence[IterativeResult], evs: tuple[float, ...], merge: str, ball: Ball) -> float:
    """Share of the ball where the merge would take from a further exposure: the mean over the balls with lights."""
    disc = crop_disc(ball)[None]
    hidden = [hidden_radiance(balls, evs, evs[-1] - 1, merge) for balls in _whole_brackets(exposures)]
    return sum(float(((part > 0).any(dim=-1) * disc).sum() / disc.sum()) for part in hidden) / len(hidden)


def bracket_remarks(probe: Probe) -> list[str]:
    """What a report should say of a scene-sized bracket, one sentence each; nothing of a fixed one."""
    if probe.settings.bracket == "fixed":
        return []
    remarks = [f"bracket sized to the scene: {len(probe.evs)} exposures, EV {', '.join(f'{ev:g}' for ev in probe.evs)}"]
    if probe.clipped:
        remarks.append(
            f"EV {probe.evs[-1]:g} still clips on {probe.clipped:.2%} of the ball: lights there may be brighter than "
            f"{2.0 ** -probe.evs[-1]:g}, where the map ends"
        )
    return remarks


def confidence_remark(probe: Probe) -> str:
    """What a report should say of how far the map can be trusted, one sentence."""
    if probe.confidence is None:
        fewest = min(len(exposure.balls) for exposure in probe.exposures)
        return f"no expected error: {fewest} balls have no spread, {FEWEST} or more are needed"
    return probe.confidence.line()
