"""Presets: named points between speed and accuracy. One table, read by the command line and the nodes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

from .errors import OptionError
from .iterative import Rounds, rounds_steps

__all__ = ["DEFAULT_PRESET", "PRESETS", "Preset", "preset", "presets_taking"]


@dataclass(frozen=True)
class Preset:
    """A schedule and the bracket it paints.

    Attributes:
        rounds: schedule of iterative inpainting at each EV.
        evs: exposure values, descending from 0.
        summary: one line for people.
        depth_disc: of `ball.DEPTH_DISCS`; the authors' where a preset reproduces their runs.
        error_deg: measured angular error, degrees: the mean over the three spheres and the maps in `data/hdri`, of the
            mini model, as `lightprobe bench pareto --panoramas dl_core/data/hdri` prints it. None where the mini
            model has no say: what needs a LoRA that it has not.
    """

    rounds: Rounds
    evs: tuple[float, ...]
    summary: str
    depth_disc: str = "ball"
    error_deg: float | None = None

    @property
    def guided_steps(self) -> int:
        """Denoising steps over all balls and exposures; each costs two denoiser evaluations with guidance."""
        return rounds_steps(self.rounds) * len(self.evs)

    def row(self, name: str) -> dict[str, Any]:
        """What a table says of it."""
        return {
            "preset": name,
            "EVs": ", ".join(f"{ev:g}" for ev in self.evs),
            **{key: getattr(self.rounds, key) for key in ("balls", "rounds", "steps", "until")},
            "guided_steps": self.guided_steps,
            "error_deg": self.error_deg,
            "summary": self.summary,
        }


DEFAULT_PRESET: Final = "balanced"

PAPER_EVS: Final = (0.0, -2.5, -5.0)

PRESETS: Final[dict[str, Preset]] = {
    "draft": Preset(Rounds(5, 1, 0.8, 10, final=False, until=0.3), PAPER_EVS, "a first look", error_deg=2.86),
    "fast": Preset(Rounds(9, 1, 0.8, 10, final=False, until=0.5), PAPER_EVS, "a look at the light", error_deg=2.78),
    "balanced": Preset(Rounds(30, 1, 0.8, 10, final=False, until=0.5), PAPER_EVS, "a usable estimate", error_deg=2.75),
    "best": Preset(
        Rounds(15, 2, 0.8, 20, final=False, until=0.5), PAPER_EVS, "the smallest RMSEs of these", error_deg=3.07
    ),
    "turbo": Preset(
        Rounds(balls=1, rounds=0, steps=30, final=False),
        PAPER_EVS,
        "one pass an exposure, for the Turbo LoRA",
        depth_disc="authors",
    ),
    "paper": Preset(
        Rounds(balls=30, rounds=2, strength=0.8, steps=30),
        PAPER_EVS,
        "the paper's schedule, 4,932 steps",
        depth_disc="authors",
        error_deg=3.34,
    ),
}


def preset(name: str) -> Preset:
    """The preset of a name.

    Raises:
        OptionError: no such preset.
    """
    if name not in PRESETS:
        raise OptionError("preset", name, ", ".join(PRESETS))
    return PRESETS[name]


def presets_taking(light_balls: int) -> dict[str, Preset]:
    """The presets that so many light balls can be added to: with any at all, those that end in a median."""
    return {name: row for name, row in PRESETS.items() if row.rounds.ends_in_median or not light_balls}
