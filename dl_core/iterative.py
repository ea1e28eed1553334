"""Iterative inpainting: N balls, their median, and again from there.

With a tolerance a round ends once its median is settled (`settling`), N being the most that it paints. Balls that are
not like the others (`outliers`) are then left out of the median. Without a tolerance that is done where it is asked
for, and others are painted in their place: a median of 21 balls is √(30 / 21) times as far off as one of 30.

Source: DiffusionLight, Algorithm 1 and Sec. 4.1.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from .ball import crop_disc, paint_depth, paste_ball
from .errors import OptionError
from .median import pixelwise_median, pixelwise_spread
from .outliers import find_outliers
from .painter import Observer, Painter, PaintRequest, SilentObserver, check_schedule, steps_run
from .settling import CONFIDENCE, error_bound, looks
from .shapes import BallImage, Image, Mask

__all__ = [
    "IterativeResult",
    "Rounds",
    "SparingObserver",
    "Tally",
    "iterative_inpaint",
    "rounds_evaluations",
    "rounds_steps",
    "tally_lines",
    "tell_spared",
]


@dataclass(frozen=True)
class Rounds:
    """The schedule of Algorithm 1.

    Attributes:
        balls: N, balls in a median; the most, where there is a tolerance.
        rounds: k, medians taken. With 0 one ball is painted from noise and that is all (the paper's base model).
        strength: γ, share of the schedule that later rounds and the last ball run.
        steps: denoising steps of a full schedule.
        final: whether one more ball is painted from the last median (the paper does); without it the last median is
            the answer, at no more cost, but softer.
        until: share of the schedule after which the balls of a median stop (`painter.PaintRequest`); the last ball runs
            to the end. Without one the answer is a median of clean images predicted that early, softer still.
        tolerance: error that a median may have, as `settling.error_bound` bounds it, in display values; a round ends
            once its median is within. Without one every round paints N balls.
        min_balls: fewest balls of a round with a tolerance, N being the most in any case.
        reject: whether balls unlike the others are left out of medians without a tolerance, too, and replaced, up to
            half as many as N.
        light_balls: balls painted to the end besides, from noise alone, with the lights of which the merged answer is
            given back what medians lose (`restored_lights`); 0 leaves a median as it is. A last ball has lights.
    """

    balls: int = 30
    rounds: int = 2
    strength: float = 0.8
    steps: int = 30
    final: bool = True
    until: float = 1.0
    tolerance: float | None = None
    min_balls: int = 6
    reject: bool = False
    light_balls: int = 0

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
        if self.tolerance is not None and not 0 < self.tolerance < 1:
            raise OptionError("tolerance", self.tolerance, "above 0, below 1, in display values; or none")
        if not 3 <= self.min_balls <= 1000:
            raise OptionError("min_balls", self.min_balls, "3 to 1000 balls")
        if not 0 <= self.light_balls <= 1000:
            raise OptionError("light_balls", self.light_balls, "0 to 1000")
        if self.light_balls and not self.ends_in_median:
            accepted = "0 where the answer is a ball painted to the end rather than a median"
            raise OptionError("light_balls", self.light_balls, accepted)

    @property
    def ends_in_median(self) -> bool:
        """Whether the answer is a median rather than a ball painted to the end."""
        return self.rounds > 0 and not self.final

    @property
    def counts(self) -> tuple[int, ...]:
        """Numbers of balls after which a round's median is looked at; N alone without a tolerance."""
        return (self.balls,) if self.tolerance is None else looks(self.min_balls, self.balls)

    @property
    def most(self) -> int:
        """Balls that a round paints at most."""
        return self.balls + (self.balls // 2 if self.reject and self.tolerance is None else 0)


@dataclass(frozen=True)
class Tally:
    """What became of a round.

    Attributes:
        painted: balls painted.
        left_out: seeds of those that are not in the median, being unlike the others; none where nothing is rejected.
        error: bound on the median's error when the round ended, see `settling.error_bound`; None without a tolerance.
    """

    painted: int
    left_out: tuple[int, ...] = ()
    error: float | None = None


@runtime_checkable
class SparingObserver(Observer, Protocol):
    """An observer that also hears of evaluations that were planned and are not needed."""

    def spared(self, count: int) -> None:
        """`count` denoiser evaluations of those planned will not be done."""


def tell_spared(observer: Observer, count: int) -> None:
    """Tell an observer of evaluations that are not needed, if it wants to hear."""
    if count and isinstance(observer, SparingObserver):
        observer.spared(count)


@dataclass(frozen=True)
class IterativeResult:
    """What iterative inpainting found at one exposure.

    Attributes:
        ball: (1, D, D, 3) the answer, display-encoded.
        median: (1, D, D, 3) the last median it was painted from; the ball itself if no median was taken.
        spread: (1, D, D, 3) median absolute deviation of the balls in the last median.
        balls: (N, D, D, 3) the balls in the last median.
        evaluations: denoiser evaluations spent.
        tallies: what became of each round.
        notes: what the painter had to say (`painter.PaintResult`), in order.
        light_balls: (M, D, D, 3) balls painted to the end for their lights; None where none were.
    """

    ball: BallImage
    median: BallImage
    spread: BallImage
    balls: Float[Tensor, "n d d c"]
    evaluations: int
    notes: tuple[str, ...] = ()
    tallies: tuple[Tally, ...] = ()
    light_balls: Float[Tensor, "m d d c"] | None = None

    @property
    def whole_balls(self) -> Float[Tensor, "m d d c"]:
        """Balls that show how bright lights are: those painted for it, or else the answer."""
        return self.ball if self.light_balls is None else self.light_balls


def iterative_inpaint(
    painter: Painter,
    request: PaintRequest,
    rounds: Rounds,
    observer: Observer | None = None,
    *,
    depth_of: Callable[[Image], Image] | None = None,
    used: Mask | None = None,
) -> IterativeResult:
    """Paint a ball by iterative inpainting (Algorithm 1).

    Args:
        painter: paints balls.
        request: canvas, depth, ball, EV and first seed; ball j of every round uses the first seed + j. Its strength
            and steps are replaced by those of `rounds`.
        rounds: N, k, γ and steps, and the tolerance if N is to depend on the balls.
        observer: hears of progress; may stop the run by raising.
        depth_of: depth of a canvas, (1, S, S, 3) -> (1, h, w, 1 or 3), near is bright. With it every median's composite
            gets a depth map of its own, as in the authors' code; without it all rounds use the request's, which the
            first round uses in any case.
        used: (1, D, D) how much of each pixel the merge will use, 0 or more: where a tolerance is to be kept. All of
            the disc alike when not given.

    Returns:
        The ball with the median, the spread and the cost. Each median is pasted on the original photograph, not on
        the previous composite, as the authors' code does; the two are equal inside the disc.
    """
    observer = observer or SilentObserver()
    seed = request.seeds[0]
    scene, spent, notes, tallies = request, list[int](), list[str](), list[Tally]()

    def inpaint_balls(wanted: tuple[int, ...], strength: float, until: float = 1.0) -> BallImage:
        asked = replace(scene, seeds=wanted, strength=strength, steps=rounds.steps, until=until)
        result = painter.paint(asked, observer)
        spent.append(result.evaluations)
        notes.extend(result.notes)
        return result.balls

    def inpaint_round(i: int) -> BallImage:
        """The balls that the median of a round is taken of."""
        strength = rounds.strength if i > 0 else 1.0

        def paint(wanted: range) -> BallImage:
            return inpaint_balls(tuple(wanted), strength, rounds.until)

        def heard(balls: BallImage) -> None:
            observer.painted(request.ev, i, balls)

        balls, tally = _settle(paint, heard, seed, rounds, crop_disc(request.ball), used)
        tallies.append(tally)
        unpainted = rounds.most - tally.painted
        tell_spared(observer, painter.evaluations(unpainted, rounds.steps, strength, rounds.until))
        return balls

    def found(
        ball: BallImage, median: BallImage, balls: Float[Tensor, "n d d c"], light_balls: Tensor | None = None
    ) -> IterativeResult:
        spread = pixelwise_spread(balls)
        return IterativeResult(ball, median, spread, balls, sum(spent), tuple(notes), tuple(tallies), light_balls)

    if rounds.rounds == 0:
        ball = inpaint_balls((seed,), 1.0)
        observer.painted(request.ev, 0, ball)
        return found(ball, ball, ball)

    for i in range(rounds.rounds):
        balls = inpaint_round(i)
        median = pixelwise_median(balls)
        scene = _with_median(request, median, depth_of)
    ball = inpaint_balls((seed,), rounds.strength) if rounds.final else median
    if not rounds.light_balls:
        return found(ball, median, balls)
    scene = request  # from noise alone: a ball painted from the median would be as soft as it
    return found(ball, median, balls, inpaint_balls(tuple(range(seed, seed + rounds.light_balls)), 1.0))


def _settle(
    paint: Callable[[range], BallImage],
    heard: Callable[[BallImage], None],
    seed: int,
    rounds: Rounds,
    disc: Float[Tensor, "d d"],
    used: Mask | None,
) -> tuple[Float[Tensor, "n d d c"], Tally]:
    """Paint the balls of a round until their median is settled, or all of them.

    Args:
        paint: paints the balls of seeds.
        heard: hears of all balls so far.
        seed: of the first ball.
        rounds: numbers of balls and the tolerance.
        disc: (D, D) where the ball is.
        used: as `iterative_inpaint` takes it.

    Returns:
        The balls of the median, and what became of the round.
    """
    painted, count = list[Tensor](), 0
    for wanted in rounds.counts:
        painted.append(paint(range(seed + count, seed + wanted)))
        balls, count = torch.cat(painted), wanted
        heard(balls)
        if rounds.tolerance is None:
            break
        kept, left_out = _alike(balls, disc, seed)
        weight = disc if used is None else disc * used[0].to(disc)
        error = error_bound(kept, weight, 1 - (1 - CONFIDENCE) / len(rounds.counts))
        if error <= rounds.tolerance or wanted == rounds.balls:
            return kept, Tally(count, left_out, error)
    if not rounds.reject:
        return balls, Tally(count)
    kept, left_out = _alike(balls, disc, seed)
    while (wanting := min(rounds.balls - len(kept), rounds.most - count)) > 0:
        balls, count = torch.cat((balls, paint(range(seed + count, seed + count + wanting)))), count + wanting
        heard(balls)
        kept, left_out = _alike(balls, disc, seed)
    return kept, Tally(count, left_out)


def _alike(
    balls: BallImage, disc: Float[Tensor, "d d"], seed: int
) -> tuple[Float[Tensor, "kept d d c"], tuple[int, ...]]:
    """The balls that are like the others, and the seeds of those that are not, the first one's being `seed`."""
    strange = find_outliers(balls, disc)
    return balls[~strange], tuple(seed + j for j in strange.nonzero()[:, 0].tolist())


def _with_median(request: PaintRequest, median: BallImage, depth_of: Callable[[Image], Image] | None) -> PaintRequest:
    """The request on the photograph with a median pasted in, and with that composite's depth where one is asked for."""
    canvas = paste_ball(request.canvas, median, request.ball)
    depth = request.depth if depth_of is None else paint_depth(depth_of(canvas), request.ball)
    return replace(request, canvas=canvas, depth=depth)


def rounds_evaluations(painter: Painter, rounds: Rounds) -> int:
    """Denoiser evaluations that `iterative_inpaint` will spend at one exposure.

    Exactly, with neither a tolerance nor balls to be left out; otherwise at most.
    """
    return _counted(painter.evaluations, rounds)


def rounds_steps(rounds: Rounds) -> int:
    """Denoising steps of all balls that `iterative_inpaint` will run at one exposure; at most, as for evaluations."""
    return _counted(lambda balls, steps, strength, until: balls * len(steps_run(steps, strength, until)), rounds)


def _counted(cost: Callable[[int, int, float, float], int], rounds: Rounds) -> int:
    if rounds.rounds == 0:
        return cost(1, rounds.steps, 1.0, 1.0)
    first = cost(rounds.most, rounds.steps, 1.0, rounds.until)
    again = cost(rounds.most, rounds.steps, rounds.strength, rounds.until) * (rounds.rounds - 1)
    last = cost(1, rounds.steps, rounds.strength, 1.0) if rounds.final else 0
    lights = cost(rounds.light_balls, rounds.steps, 1.0, 1.0) if rounds.light_balls else 0
    return first + again + last + lights


def tally_lines(result: IterativeResult, rounds: Rounds) -> list[str]:
    """What a report should say of rounds that end by themselves or leave balls out, one sentence a round."""
    lines = []
    for number, tally in enumerate(result.tallies, 1):
        seeds = ", ".join(map(str, tally.left_out))
        if rounds.tolerance is None or tally.error is None:
            if seeds:
                count = f"{tally.painted} balls painted for a median of {tally.painted - len(tally.left_out)}"
                lines.append(f"round {number}: {count}; left out as unlike the others: seeds {seeds}")
            continue
        verdict = "settled" if tally.error <= rounds.tolerance else "not settled"
        line = (
            f"round {number}: {verdict} after {tally.painted} of at most {rounds.balls} balls, median within "
            f"{tally.error:.3f} for a tolerance of {rounds.tolerance:g}"
        )
        lines.append(f"{line}; left out as unlike the others: seeds {seeds}" if seeds else line)
    return lines
