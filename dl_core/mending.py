"""Options around an estimate that mend what the painter cannot know: front fill, levelling, white balance.

What each gains is measured by `lightprobe bench mend`.

Source: DiffusionLight, Sec. 4, for the estimate they go around; the parts name their own.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Final

import torch
from jaxtyping import Float
from torch import Tensor

from .ball import fit_canvas, paste_ball
from .confidence import Confidence
from .errors import OptionError
from .estimate import Probe, Settings, check_photograph, estimate
from .front_fill import FEATHER, check_fov, check_tilt, front_fill
from .geometry import camera_rotation, rotate_latlong
from .painter import Observer, Painter
from .shapes import Image, Latlong
from .white_balance import balance, cast_gains, check_white_balance

__all__ = ["SHOWN_STOPS", "Mending", "estimate_mended", "level", "mend_map", "mending_metadata", "mending_remarks"]


SHOWN_STOPS: Final = 0.05
"""Error to expect of radiance that the photograph shows: photographs of 18 cameras in the six validation panoramas, 8
bits, are 0.045 stops from the panoramas' light in the mean, and 0.11 at most."""


@dataclass(frozen=True)
class Mending:
    """What to do around an estimate.

    Attributes:
        front_fill: fill the directions that the photograph shows with the photograph.
        fov: field of view across the photograph's longer side, degrees, 5 to 170; for front fill.
        pitch: degrees up that the camera looked; the map is levelled by it.
        roll: degrees clockwise that the camera was turned; likewise.
        white_balance: of `white_balance.WHITE_BALANCES`.
        feather: degrees, as `front_fill.front_fill` takes them.
    """

    front_fill: bool = False
    fov: float | None = None
    pitch: float = 0.0
    roll: float = 0.0
    white_balance: str = "none"
    feather: float = FEATHER

    def check(self) -> Mending:
        """Itself, if all of it can be done.

        Raises:
            OptionError: an option out of range, or front fill without a field of view.
        """
        check_white_balance(self.white_balance)
        check_tilt(self.pitch, self.roll)
        if self.fov is not None:
            check_fov(self.fov)
        elif self.front_fill:
            accepted = (
                "the degrees that the photograph spans along its longer side, 5 to 170, to fill the front with it"
            )
            raise OptionError("fov", None, accepted)
        return self

    @property
    def levels(self) -> bool:
        """Whether the map is turned."""
        return bool(self.pitch or self.roll)


def level(latlong: Latlong, pitch: float, roll: float) -> Latlong:
    """Turn a map from the camera's axes to level ones: its horizon is the world's, its centre the camera's azimuth.

    Args:
        latlong: (B, H, 2H, C), straight ahead in its centre.
        pitch: degrees up that the camera looked.
        roll: degrees clockwise that it was turned.

    Raises:
        OptionError: a map that is not 2:1, or an angle out of range.
    """
    check_tilt(pitch, roll)
    return rotate_latlong(latlong, camera_rotation(0.0, pitch, roll)) if pitch or roll else latlong


def estimate_mended(
    photo_ldr: Image,
    painter: Painter,
    settings: Settings,
    mending: Mending,
    *,
    depth: Float[Tensor, "1 y x k"] | None = None,
    depth_of: Callable[[Image], Image] | None = None,
    observer: Observer | None = None,
) -> Probe:
    """Estimate the light of a photograph, and mend around it.

    The photograph is balanced before it is painted in; map and ball are given its cast back, the map's front is filled,
    and the map is levelled, in this order. `Probe.exposures` are as they were painted. The expected error falls to
    `SHOWN_STOPS` where the photograph gives the light; the share of light misplaced stays that of the balls. Without
    any option this is `estimate.estimate`, bit for bit.

    Args, Raises: as `estimate.estimate`; and what `Mending.check` raises, before anything is painted.
    """
    mending.check()
    photo_ldr = check_photograph(photo_ldr)
    gains = cast_gains(photo_ldr, mending.white_balance)
    seen = balance(photo_ldr, gains)
    probe = estimate(seen, painter, settings, depth=depth, depth_of=depth_of, observer=observer)
    if bool((gains != 1).any()):
        probe = _with_cast(probe, photo_ldr, gains)
    return mend_map(probe, photo_ldr, mending)


def mend_map(probe: Probe, photo_ldr: Image, mending: Mending) -> Probe:
    """What can be mended of an estimate that is there: its front filled and its map levelled.

    Args:
        probe: as `estimate.estimate` gives it, and not mended yet.
        photo_ldr: (1, Y, X, 3) the photograph it is of.
        mending: its white balance, which goes before the painting, has no say here.

    Raises:
        OptionError: as `Mending.check`.
    """
    mending.check()
    latlong, confidence = probe.latlong_hdr, probe.confidence
    if mending.front_fill and mending.fov is not None:
        filled = front_fill(latlong, photo_ldr, mending.fov, feather=mending.feather)
        latlong, confidence = filled.latlong_hdr, _shown(confidence, filled.known)
    return replace(
        probe,
        latlong_hdr=level(latlong, mending.pitch, mending.roll),
        confidence=_levelled(confidence, mending),
    )


def _shown(confidence: Confidence | None, known: Float[Tensor, "1 h w"]) -> Confidence | None:
    """What error to expect where the photograph gives the light: its own, unless less was expected."""
    if confidence is None:
        return None
    error = confidence.error_stops
    return replace(confidence, error_stops=torch.lerp(error, error.clamp(max=SHOWN_STOPS), known[..., None].to(error)))


def _levelled(confidence: Confidence | None, mending: Mending) -> Confidence | None:
    """What error to expect, turned as the map is."""
    if confidence is None or not mending.levels:
        return confidence
    return replace(confidence, error_stops=level(confidence.error_stops, mending.pitch, mending.roll))


def _with_cast(probe: Probe, photo_ldr: Image, gains: Float[Tensor, "3"]) -> Probe:
    """A probe of a balanced photograph as one of the photograph itself."""
    painted = balance(probe.exposures[0].ball, 1 / gains)
    return replace(
        probe,
        latlong_hdr=probe.latlong_hdr / gains.to(probe.latlong_hdr),
        ball_hdr=probe.ball_hdr / gains.to(probe.ball_hdr),
        composite_ldr=paste_ball(fit_canvas(photo_ldr, probe.ball.canvas), painted, probe.ball),
    )


def mending_remarks(mending: Mending) -> list[str]:
    """What a report should say of it, one sentence each."""
    remarks = []
    if mending.white_balance != "none":
        remarks.append(f"cast of the photograph taken out by {mending.white_balance} and given back to the light")
    if mending.front_fill:
        remarks.append(f"front filled with the photograph, {mending.fov:g} degrees across its longer side")
    if mending.levels:
        remarks.append(f"levelled from a camera at pitch {mending.pitch:g}, roll {mending.roll:g} degrees")
    return remarks


def mending_metadata(mending: Mending) -> dict[str, str]:
    """What a file should say of it: EXR string attributes by name."""
    metadata = {}
    if mending.white_balance != "none":
        metadata["lightprobe:white_balance"] = mending.white_balance
    if mending.front_fill:
        metadata["lightprobe:front_fill"] = f"photograph, {mending.fov:g} degrees across its longer side"
    if mending.levels:
        metadata["lightprobe:level"] = f"turned by pitch {mending.pitch:g}, roll {mending.roll:g} degrees"
        metadata["lightprobe:axes"] = "centre -Z (level, where the camera looked), right of it +X, up +Y (the world's)"
    return metadata
