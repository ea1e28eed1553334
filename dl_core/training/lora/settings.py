"""What decides a training of the exposure LoRA. No torch here, so that help comes at once.

Source: DiffusionLight, Sec. 5 (implementation details) and the appendix "Ablation on LoRA training".
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from typing import Final

from ...errors import OptionError

__all__ = [
    "LORA_SETTINGS",
    "PRECISIONS",
    "SCHEDULES",
    "SEPARATE_PROMPT",
    "LoraSettings",
    "parse_evs",
    "parse_timesteps",
]

PRECISIONS: Final = ("no", "fp16", "bf16")
SCHEDULES: Final = ("constant", "cosine")

SEPARATE_PROMPT: Final = "a perfect sks mirrored reflective chrome ball sphere"
"""The paper's ablation: a LoRA for one exposure alone learns it under a token of its own."""

WARMUP: Final = 50
"""Steps over which the rate of the schedule `cosine` rises."""

LAST_TIMESTEP: Final = 999


@dataclass(frozen=True)
class LoraSettings:
    """How the exposure LoRA is trained; the defaults are the paper's.

    Attributes:
        rank: of the low-rank products.
        steps: optimizer steps in all.
        batch: pictures a process denoises at once.
        accumulation: batches to a step.
        learning_rate: of AdamW, at its highest.
        schedule: `constant`, or `cosine`: a short rise, then down to 0 along a cosine.
        timesteps: first and last noise level drawn, both included.
        ev_min: EV at which the dark prompt stands alone; the darkest exposure of the bracket.
        precision: of `PRECISIONS`, of the frozen networks and of what is computed with them; the LoRA itself is in
            single precision.
        gradient_checkpointing: compute the UNet's blocks a second time on the way back, to hold less in memory.
        seed: of the LoRA's start, and of the order of pairs, timesteps and noise.
        checkpoint_minutes: time between checkpoints.
        validate_every: steps between pictures painted for people to look at; 0 for none.

    Raises:
        OptionError: a value that is not accepted.
    """

    rank: int = 4
    steps: int = 2500
    batch: int = 4
    accumulation: int = 1
    learning_rate: float = 1e-5
    schedule: str = "constant"
    timesteps: tuple[int, int] = (900, 999)
    ev_min: float = -5.0
    precision: str = "no"
    gradient_checkpointing: bool = False
    seed: int = 1
    checkpoint_minutes: float = 10.0
    validate_every: int = 0

    def __post_init__(self) -> None:
        for name in ("rank", "steps", "batch", "accumulation"):
            if getattr(self, name) < 1:
                raise OptionError(_option(name), getattr(self, name), "1 or more")
        if not self.learning_rate > 0:
            raise OptionError("--learning-rate", self.learning_rate, "above 0")
        if not -20 <= self.ev_min < 0:
            raise OptionError("--ev-min", self.ev_min, "below 0, down to -20")
        first, last = self.timesteps
        if not 0 <= first <= last <= LAST_TIMESTEP:
            raise OptionError("--timesteps", f"{first}-{last}", f"FIRST-LAST within 0-{LAST_TIMESTEP}")
        for name in ("checkpoint_minutes", "validate_every", "seed"):
            if not getattr(self, name) >= 0:
                raise OptionError(_option(name), getattr(self, name), "0 or more")
        for name, accepted in (("precision", PRECISIONS), ("schedule", SCHEDULES)):
            if getattr(self, name) not in accepted:
                raise OptionError(_option(name), getattr(self, name), ", ".join(accepted))

    def rate(self, step: int) -> float:
        """Learning rate of a step, from 0."""
        if self.schedule == "constant":
            return self.learning_rate
        if step < WARMUP:
            return self.learning_rate * (step + 1) / WARMUP
        progress = (step - WARMUP) / max(1, self.steps - WARMUP)
        return self.learning_rate * 0.5 * (1 + math.cos(math.pi * min(1.0, progress)))

    def decisive(self) -> dict[str, str]:
        """By option, what the LoRA depends on and a checkpoint must agree with.

        More steps may be asked for later, unless the rate depends on their number.
        """
        decisive = {
            "--rank": self.rank,
            "--timesteps": "{}-{}".format(*self.timesteps),
            "--ev-min": self.ev_min,
            "--batch": self.batch,
            "--gradient-accumulation": self.accumulation,
            "--learning-rate": self.learning_rate,
            "--schedule": self.schedule,
            "--mixed-precision": self.precision,
            "--seed": self.seed,
        }
        if self.schedule != "constant":
            decisive["--steps"] = self.steps
        return {option: str(value) for option, value in decisive.items()}


def _option(name: str) -> str:
    spoken = {"accumulation": "gradient-accumulation", "precision": "mixed-precision"}
    return "--" + spoken.get(name, name.replace("_", "-"))


LORA_SETTINGS: Final = {
    "sdxl": LoraSettings(gradient_checkpointing=True),
    "mini": LoraSettings(steps=400, batch=8, learning_rate=1e-3, schedule="cosine", timesteps=(0, 999)),
}
"""Defaults by kind of model. The mini model is small, trained for minutes, and decides on light at more levels."""


def parse_timesteps(text: str) -> tuple[int, int]:
    """`FIRST-LAST` as two numbers.

    Raises:
        OptionError: another form.
    """
    match = re.fullmatch(r"\s*(\d{1,4})\s*-\s*(\d{1,4})\s*", text)
    if not match:
        raise OptionError("--timesteps", text, f"FIRST-LAST within 0-{LAST_TIMESTEP}, as 900-999")
    return int(match[1]), int(match[2])


def parse_evs(text: str) -> tuple[float, ...]:
    """Exposure values between commas.

    Raises:
        OptionError: something else, an EV twice, or one above 0.
    """
    try:
        evs = tuple(float(part) for part in text.split(","))
    except ValueError:
        evs = ()
    if not evs or len(set(evs)) < len(evs) or not all(math.isfinite(ev) and ev <= 0 for ev in evs):
        raise OptionError("--separate", text, "different EVs of 0 or below between commas, as 0,-2.5,-5")
    return evs
