"""Iterative inpainting: N balls, their median, and again from there.

Source: DiffusionLight, Algorithm 1 and Sec. 4.1.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

from jaxtyping import Float
from torch import Tensor

from .ball import paint_depth, paste_ball
from .errors import OptionError
from .median import pixelwise_median, pixelwise_spread
from .painter import Observer, Painter, PaintRequest, SilentObserver, check_schedule
from .shapes import BallImage, Image

__all__ = ["IterativeResult", "Rounds", "iterative_inpaint", "rounds_evaluations"]


@dataclass(frozen=True)
class Rounds:
    """The schedule of Algorithm 1.

    Attributes:
        balls: N, balls in a median.
        rounds: k, medians taken. With 0 one ball is painted from noise and that is all (the paper's base model).
        strength: γ, share of the schedule that later rounds and the last ball run.
        steps: denoising steps of a full schedule.
        final: whether one more ball is painted from the last median (the paper does); without it the last median is
            the answer, at no more cost, but softer.
        until: share of the schedule after which the balls of a median stop (`painter.PaintRequest`); the last ball runs
            to the end. Without one the answer is a median of clean images predicted that early, softer still.
    """

    balls: int = 30
    rounds: int = 2
    strength: float = 0.8
    steps: int = 30
    final: bool = True
    until: float = 1.0

    def __post_init__(self) -> None:
        if not 1 <= self.balls <= 1000:
            raise OptionError("balls", self.balls, "1 to 1000")
        if not 0 <= self.rounds <= 100:
            raise OptionError("rounds", self.rounds, "0 to 100")
        if not 0 < self.strength <= 1:
            raise OptionError("strength", self.strength, "above 0, up to 1")
        if not 1 <= self.steps <= 1000:
            raise OptionError("steps", self.steps, "1 to 1000")
        if self.until != 1:
            check_schedule(self.steps, self.strength if self.rounds > 1 else 1.0, self.until)


@dataclass(frozen=True)
class IterativeResult:
    """What iterative inpainting found at one exposure.

    Attributes:
        ball: (1, D, D, 3) the answer, display-encoded.
        median: (1, D, D, 3) the last median it was painted from; the ball itself if no median was taken.
        spread: (1, D, D, 3) median absolute deviation of the last round's balls.
        balls: (N, D, D, 3) the last round's balls.
        evaluations: denoiser evaluations spent.
        notes: what the painter had to say (`painter.PaintResult`), in order.
    """

    ball: BallImage
    median: BallImage
    spread: BallImage
    balls: Float[Tensor, "n d d c"]
    evaluations: int
    notes: tuple[str, ...] = ()


def iterative_inpaint(
    painter: Painter,
    request: PaintRequest,
    rounds: Rounds,
    observer: Observer | None = None,
    *,
    depth_of: Callable[[Image], Image] | None = None,
) -> IterativeResult:
    """Paint a ball by iterative inpainting (Algorithm 1).

    Args:
        painter: paints balls.
        request: canvas, depth, ball, EV and first seed; ball j of every round uses the first seed + j. Its strength
            and steps are replaced by those of `rounds`.
        rounds: N, k, γ and steps.
        observer: hears of progress; may stop the run by raising.
        depth_of: depth of a canvas, (1, S, S, 3) -> (1, h, w, 1 or 3), near is bright. With it every median's composite
            gets a depth map of its own, as in the authors' code; without it all rounds use the request's, which the
            first round uses in any case.

    Returns:
        The ball with the median, the spread and the cost. Each median is pasted on the original photograph, not on
        the previous composite, as the authors' code does; the two are equal inside the disc.
    """
    observer = observer or SilentObserver()
    seed = request.seeds[0]
    seeds = tuple(seed + j for j in range(rounds.balls))
    scene, spent, notes = request, list[int](), list[str]()

    def inpaint_balls(wanted: tuple[int, ...], strength: float, until: float = 1.0) -> BallImage:
        asked = replace(scene, seeds=wanted, strength=strength, steps=rounds.steps, until=until)
        result = painter.paint(asked, observer)
        spent.append(result.evaluations)
        notes.extend(result.notes)
        return result.balls

    def found(ball: BallImage, median: BallImage, balls: Float[Tensor, "n d d c"]) -> IterativeResult:
        return IterativeResult(ball, median, pixelwise_spread(balls), balls, sum(spent), tuple(notes))

    if rounds.rounds == 0:
        ball = inpaint_balls((seed,), 1.0)
        observer.painted(request.ev, 0, ball)
        return found(ball, ball, ball)

    for i in range(rounds.rounds):
        balls = inpaint_balls(seeds, rounds.strength if i > 0 else 1.0, rounds.until)
        median = pixelwise_median(balls)
        observer.painted(request.ev, i, balls)
        scene = _with_median(request, median, depth_of)
    ball = inpaint_balls((seed,), rounds.strength) if rounds.final else median
    return found(ball, median, balls)


def _with_median(request: PaintRequest, median: BallImage, depth_of: Callable[[Image], Image] | None) -> PaintRequest:
    """The request on the photograph with a median pasted in, and with that composite's depth where one is asked for."""
    canvas = paste_ball(request.canvas, median, request.ball)
    depth = request.depth if depth_of is None else paint_depth(depth_of(canvas), request.ball)
    return replace(request, canvas=canvas, depth=depth)


def rounds_evaluations(painter: Painter, rounds: Rounds) -> int:
    """Denoiser evaluations that `iterative_inpaint` will spend at one exposure, exactly."""
    if rounds.rounds == 0:
        return painter.evaluations(1, rounds.steps, 1.0)
    first = painter.evaluations(rounds.balls, rounds.steps, 1.0, rounds.until)
    again = painter.evaluations(rounds.balls, rounds.steps, rounds.strength, rounds.until) * (rounds.rounds - 1)
    last = painter.evaluations(1, rounds.steps, rounds.strength) if rounds.final else 0
    return first + again + last
