"""Schedules that the chart of speed against accuracy compares.

Source: DiffusionLight, the appendix on running time and Sec. 4.3: N of 5, 15 and 30 with k of 1 and 2 are the paper's
own points between speed and quality.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from itertools import product
from typing import Final

from ..iterative import Rounds
from ..presets import PAPER_EVS, PRESETS, Preset
from .report import Row

__all__ = ["GRIDS", "Schedule"]


@dataclass(frozen=True)
class Schedule:
    """A way to spend evaluations.

    Attributes:
        name: tells it from the others.
        kind: `preset`, `paper` for the paper's own points, or `swept`.
        preset: what is run.
    """

    name: str
    kind: str
    preset: Preset

    @property
    def settings(self) -> Row:
        """What is run, flat."""
        return {**asdict(self.preset.rounds), "evs": ",".join(f"{ev:g}" for ev in self.preset.evs)}


_PAPER: Final = PRESETS["paper"]


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
        last = "" if rounds.final else " median"
        name = f"N={rounds.balls} k={rounds.rounds} steps={rounds.steps} strength={rounds.strength:g}{last}"
        yield Schedule(f"{name} EVs={len(evs)}", "swept", Preset(rounds, evs, name))


def _small() -> Iterator[tuple[Rounds, tuple[float, ...]]]:
    """Cheap ones: few balls, few steps."""
    for balls, steps in product((1, 3, 5, 9), (4, 6, 10)):
        yield Rounds(balls, 1, 0.8, steps, final=False), PAPER_EVS
    for balls, steps in ((5, 10), (9, 10), (5, 20)):
        yield Rounds(balls, 1, 0.8, steps), PAPER_EVS
    for evs in (PAPER_EVS[:1], PAPER_EVS[::2]):
        yield Rounds(5, 1, 0.8, 10, final=False), evs


def _full() -> Iterator[tuple[Rounds, tuple[float, ...]]]:
    """Every combination that makes sense."""
    brackets = (PAPER_EVS[:1], PAPER_EVS[::2], PAPER_EVS, (0.0, -1.25, -2.5, -3.75, -5.0))
    for balls, steps, evs in product((1, 3, 5, 9, 15, 30), (4, 6, 10, 20, 30), brackets):
        yield Rounds(balls, 1, 0.8, steps, final=False), evs
    for balls, rounds, steps, strength in product((3, 5, 15, 30), (1, 2, 3), (10, 20, 30), (0.5, 0.65, 0.8, 0.95)):
        yield Rounds(balls, rounds, strength, steps), PAPER_EVS


def _grid(swept: Callable[[], Iterator[tuple[Rounds, tuple[float, ...]]]]) -> Callable[[], list[Schedule]]:
    def schedules() -> list[Schedule]:
        named = [*_presets(), *_papers_own()]
        known = {(schedule.preset.rounds, schedule.preset.evs) for schedule in named}
        return [*named, *(s for s in _swept(swept()) if (s.preset.rounds, s.preset.evs) not in known)]

    return schedules


GRIDS: Final[dict[str, Callable[[], list[Schedule]]]] = {"small": _grid(_small), "full": _grid(_full)}
"""Schedules by the name of a grid: the presets, the paper's own, and combinations."""
