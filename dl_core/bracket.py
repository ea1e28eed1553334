"""Which exposures a scene needs: a bracket that goes on as long as its darkest exposure clips, and no further.

An exposure is painted only if the merge could take something from it. How much that could be is asked of the merge
itself: it is given a further exposure that is white wherever the last one clips, at the EV of the darkest one that may
follow. Nothing that is painted later can be brighter than that, so the energy it would add bounds what stopping loses.

Measured behind a painter without error (`lightprobe bench bracket --panoramas DIR`, photographs straight ahead): of
eight panoramas with suns and bare lamps the fixed bracket keeps 0.42 of the energy at the median and 0.08 at worst, one
sized to the scene between 0.999 and 1.001, with five to eight exposures in place of three.

Sources: DiffusionLight, Sec. 4.2 (bracket) and Algorithm 2 (merge); Debevec and Malik, Recovering high dynamic range
radiance maps from photographs (SIGGRAPH 1997), for exposures taken until the brightest light does not clip.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from .errors import OptionError
from .exposure import CLIP_THRESHOLD, check_evs, decode_display, expose, merge_bracket
from .shapes import BallImage

__all__ = ["BRACKETS", "DARKEST", "ExposureLimited", "check_bracket", "darkest_of", "hidden_radiance", "ladder"]

BRACKETS: Final[dict[str, str]] = {
    "fixed": "every EV, whatever the scene",
    "scene": "the next darker EV only while the last one clips",
}
"""Policies by name, the default first."""

DARKEST: Final = -20.0
"""EV at which a scene-sized bracket ends for a painter without a limit: white is then a million times that of EV 0. Of
33 panoramas, each exposed for the photograph straight ahead, the one of the brightest lamp goes on to EV -17.5."""
GAP: Final = 2.5
"""EVs from one exposure to the next where the bracket given has only one: the paper's."""


@runtime_checkable
class ExposureLimited(Protocol):
    """A painter that paints no darker than a certain exposure."""

    @property
    def darkest_ev(self) -> float:
        """Lowest EV it was made for, below 0."""


def darkest_of(painter: object) -> float:
    """The lowest EV to ask of a painter that nobody has asked for by name: its own limit, or `DARKEST`."""
    return max(painter.darkest_ev, DARKEST) if isinstance(painter, ExposureLimited) else DARKEST


def check_bracket(policy: str) -> str:
    """The name of a policy, checked.

    Raises:
        OptionError: an unknown one.
    """
    if policy not in BRACKETS:
        raise OptionError("bracket", policy, ", ".join(BRACKETS))
    return policy


def ladder(evs: Sequence[float], darkest: float) -> tuple[float, ...]:
    """Exposures of a scene-sized bracket, should it need all of them.

    Args:
        evs: exposures to begin with, descending from 0.
        darkest: EV at which the ladder ends. EVs given below it stay.

    Returns:
        Those given, and further ones at the distance of the last two, the last one at `darkest` itself.

    Raises:
        OptionError: EVs as `exposure.check_evs` rejects them, or a darkest one of 0 or more or below -40.
    """
    values = list(check_evs(evs))
    if not -40 <= darkest < 0:
        raise OptionError("darkest", darkest, "-40 up to, but not, 0")
    gap = values[-2] - values[-1] if len(values) > 1 else GAP
    while values[-1] > darkest:
        values.append(max(values[-1] - gap, darkest))
    return tuple(values)


def hidden_radiance(
    balls: Sequence[BallImage], evs: Sequence[float], darkest: float, merge: str
) -> Float[Tensor, "b d d c"]:
    """The most that exposures yet to be painted could add to the merged ball.

    Args:
        balls: (1, D, D, 3) display-encoded, one per EV painted.
        evs: exposure values, descending from 0.
        darkest: EV of the darkest exposure that may follow; below the last of `evs`.
        merge: method of `exposure.MERGES`.

    Returns:
        (1, D, D, 3) linear radiance, 0 or more: above 0 where the merge would take from a darker exposure.

    Warnings:
        Holds for exposures that are as bright as their EVs say; `merge_robust` undoes errors of up to 2 stops, and what
        is painted too dark could add as much more.
    """
    known = merge_bracket(balls, evs, merge)
    # Where the last exposure does not clip, a picture that agrees with it: the merge measures exposures by that.
    white = torch.where(decode_display(balls[-1]) >= CLIP_THRESHOLD, 1.0, expose(known, darkest))
    return (merge_bracket([*balls, white], [*evs, darkest], merge) - known).clamp(min=0)
