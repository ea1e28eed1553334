"""Schedules that the chart of speed against accuracy compares.

Source: DiffusionLight, the appendix on running time and Sec. 4.3: N of 5, 15 and 30 with k of 1 and 2 are the paper's
own points between speed and quality.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from itertools import product
from typing import Final, Protocol, runtime_checkable

from ...iterative import Rounds
from ...painter import Painter
from ...presets import PAPER_EVS, PRESETS, Preset
from ..report import Row

__all__ = ["GRIDS", "Schedule", "Varied"]


@dataclass(frozen=True)
class Schedule:
    """A way to spend evaluations.

    Attributes:
        name: tells it from the others.
        kind: `preset`, `paper` for the paper's own points, or `swept`.
        preset: what is run.
        bracket: of `bracket.BRACKETS`.
        sampler: another than the painter's own.
        guidance: another scale than the painter's own.
    """

    name: str
    kind: str
    preset: Preset
    bracket: str = "fixed"
    sampler: str | None = None
    guidance: float | None = None

    @property
    def settings(self) -> Row:
        """What is run, flat."""
        return {
            **asdict(self.preset.rounds),
            "evs": ",".join(f"{ev:g}" for ev in self.preset.evs),
            **{name: getattr(self, name) for name in ("bracket", "sampler", "guidance")},
        }

    def painter(self, painter: Painter) -> Painter | None:
        """The painter as this schedule wants it; None for one that cannot be had so."""
        if self.sampler is None and self.guidance is None:
            return painter
        return painter.varied(sampler=self.sampler, guidance=self.guidance) if isinstance(painter, Varied) else None


@runtime_checkable
class Varied(Protocol):
    """A painter that has a sampler and a scale of guidance."""

    def varied(self, *, sampler: str | None, guidance: float | None) -> Painter:
        """The same model with others."""


_PAPER: Final = PRESETS["paper"]
_VARIED: Final = Rounds(5, 1, 0.8, 10, final=False)
"""Sampled and exposed in other ways."""


def _presets() -> Iterator[Schedule]:
    for name, preset in PRESETS.items():
        yield Schedule(name, "preset", preset)


def _papers_own() -> Iterator[Schedule]:
    for balls, rounds in product((5, 15, 30), (1, 2)):
        schedule = replace(_PAPER.rounds, balls=balls, rounds=rounds)
        if schedule != _PAPER.rounds:
            yield Schedule(f"N={balls} k={rounds}", "paper", replace(_PAPER, rounds=schedule))


def _swept(schedules: Iterator[tuple[Rounds, tuple[float, ...]]]) -> Iterator[Schedule]:
    for rounds, evs in schedules:
        yield Schedule(_name(rounds, evs), "swept", Preset(rounds, evs, ""))


def _name(rounds: Rounds, evs: tuple[float, ...]) -> str:
    last = "" if rounds.final else " median"
    until = "" if rounds.until == 1 else f" until={rounds.until:g}"
    tolerance = "" if rounds.tolerance is None else f" tolerance={rounds.tolerance:g}"
    schedule = f"N={rounds.balls} k={rounds.rounds} steps={rounds.steps} strength={rounds.strength:g}"
    return f"{schedule}{last}{until}{tolerance} EVs={len(evs)}"


def _variants(rounds: Rounds) -> Iterator[Schedule]:
    """A schedule sampled and exposed in other ways."""
    name, preset = _name(rounds, PAPER_EVS), Preset(rounds, PAPER_EVS, "")
    for sampler in ("ddim", "euler"):
        yield Schedule(f"{name} {sampler}", "swept", preset, sampler=sampler)
    for guidance in (1.0, 3.0):
        yield Schedule(f"{name} guidance={guidance:g}", "swept", preset, guidance=guidance)
    yield Schedule(f"{name} scene", "swept", preset, bracket="scene")


def _small() -> Iterator[tuple[Rounds, tuple[float, ...]]]:
    """Cheap ones: few balls, few steps, early answers."""
    for balls, steps in ((1, 6), (3, 4), (3, 6), (5, 10), (9, 10)):
        yield Rounds(balls, 1, 0.8, steps, final=False), PAPER_EVS
    for until, balls in product((0.3, 0.5), (3, 5, 9, 15, 30)):
        yield Rounds(balls, 1, 0.8, 10, final=False, until=until), PAPER_EVS
    for until in (0.3, 1.0):
        yield Rounds(5, 1, 0.8, 10, until=until), PAPER_EVS
    for name in ("fast", "balanced", "best"):  # with a last ball, or without the one they have
        rounds = PRESETS[name].rounds
        yield replace(rounds, final=not rounds.final), PAPER_EVS
    for evs in (PAPER_EVS[:1], PAPER_EVS[::2]):
        yield Rounds(5, 1, 0.8, 10, final=False), evs
    for tolerance in (0.03, 0.06):
        yield Rounds(30, 1, 0.8, 10, final=False, until=0.5, tolerance=tolerance), PAPER_EVS


def _full() -> Iterator[tuple[Rounds, tuple[float, ...]]]:
    """Every combination that makes sense."""
    brackets = (PAPER_EVS[:1], PAPER_EVS[::2], PAPER_EVS, (0.0, -1.25, -2.5, -3.75, -5.0))
    for balls, steps, evs in product((1, 3, 5, 9, 15, 30), (4, 6, 10, 20, 30), brackets):
        yield Rounds(balls, 1, 0.8, steps, final=False), evs
    for balls, rounds, steps, strength in product((3, 5, 15, 30), (1, 2, 3), (10, 20, 30), (0.5, 0.65, 0.8, 0.95)):
        yield Rounds(balls, rounds, strength, steps), PAPER_EVS
    for until, steps in product((0.3, 0.5, 0.75), (10, 20, 30)):
        yield Rounds(15, 1, 0.8, steps, until=until), PAPER_EVS
    for tolerance, steps in product((0.015, 0.03, 0.06), (10, 30)):
        yield Rounds(30, 1, 0.8, steps, final=False, tolerance=tolerance), PAPER_EVS


def _grid(swept: Callable[[], Iterator[tuple[Rounds, tuple[float, ...]]]]) -> Callable[[], list[Schedule]]:
    def schedules() -> list[Schedule]:
        named = [*_presets(), *_papers_own()]
        known = {(schedule.preset.rounds, schedule.preset.evs) for schedule in named}
        fresh = [s for s in _swept(swept()) if (s.preset.rounds, s.preset.evs) not in known]
        return [*named, *fresh, *_variants(_VARIED)]

    return schedules


GRIDS: Final[dict[str, Callable[[], list[Schedule]]]] = {"small": _grid(_small), "full": _grid(_full)}
"""Schedules by the name of a grid: the presets, the paper's own, and combinations."""
