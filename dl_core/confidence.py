"""How far an estimate can be trusted: N balls are N opinions, and where they differ the light is not known.

The spread of the balls is taken where the merge takes its light: at each pixel from the brightest exposure that does
not clip there. It is a robust standard deviation, in stops of luminance and in degrees of colour, and is unwrapped as
the ball is. Balls that agree may all be wrong, so the spread alone is no error. What error to expect follows from it
and from three things that need no second look at the scene: how far a direction lies from what the photograph shows,
how near the rim it was seen, and how far its luminance lies from the map's mean. The weights of the five are measured
(`Calibration`), on maps whose truth is known. How much of the light is misplaced in all is predicted beside it, from
the map as a whole (`misplaced`).

Sources: DiffusionLight, Sec. 4.1 (balls of different noise show different light); Iglewicz and Hoaglin, How to detect
and handle outliers (ASQC 1993), for the median absolute deviation as a standard deviation.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import Final

import torch
from jaxtyping import Float
from torch import Tensor

from .errors import ModelError, OptionError
from .exposure import CLIP_THRESHOLD, decode_display, luminance
from .geometry import ball_to_latlong, latlong_directions, latlong_solid_angles
from .json_text import read_json
from .median import pixelwise_median, pixelwise_spread
from .metrics import rgb_angles
from .misplaced import OVERALL, overall_evidence
from .outliers import NORMAL_MAD
from .shapes import BallImage, Latlong

__all__ = [
    "CALIBRATION_FILE",
    "EVIDENCE",
    "FEWEST",
    "FLOOR",
    "Calibration",
    "Confidence",
    "Spread",
    "bracket_spread",
    "confidence_of",
    "evidence",
    "shipped_calibration",
]

FEWEST: Final = 3
"""Balls below which a median absolute deviation says nothing: of two it is half their distance, of one 0."""
FLOOR: Final = 0.01
"""Linear value, white being 1, below which stops are not told apart: 6.6 stops below white."""
COLOUR_UNIT: Final = 10.0
"""Degrees of colour that count as one stop does, so that weights are of one size."""
EVIDENCE: Final = ("constant", "stops", "colour", "unseen", "rim", "contrast")
"""What an error is predicted from, in the order of `evidence`."""
CALIBRATION_FILE: Final = Path(__file__).parent / "data" / "confidence.json"


@dataclass(frozen=True)
class Spread:
    """How the balls of a bracket differ, pixel by pixel, as standard deviations.

    Attributes:
        stops: (1, D, D, 1) of luminance.
        degrees: (1, D, D, 1) of colour: angles between RGB vectors.
        balls: fewest that any exposure had.
        clipped: share of the ball that the median at EV 0 shows clipped.
    """

    stops: Float[Tensor, "1 d d 1"]
    degrees: Float[Tensor, "1 d d 1"]
    balls: int
    clipped: float = 0.0


@dataclass(frozen=True)
class Calibration:
    """Weights of the evidence, and where they were measured.

    Attributes:
        weights: expected error in stops for a unit of each of `EVIDENCE`, 0 or more.
        measured_on: what was painted, by what, one sentence.
        overall: log2 of the expected share of light misplaced for a unit of each of `misplaced.OVERALL`; None where no
            share is predicted.
        correlation: rank correlation of predicted and actual share of light misplaced over photographs it was not
            calibrated on; None where that was not measured.
    """

    weights: tuple[float, ...]
    measured_on: str
    overall: tuple[float, ...] | None = None
    correlation: float | None = None

    def __post_init__(self) -> None:
        if self.overall is not None and len(self.overall) != len(OVERALL):
            raise OptionError("overall", self.overall, f"{len(OVERALL)} numbers: {', '.join(OVERALL)}")
        if len(self.weights) != len(EVIDENCE) or not all(weight >= 0 for weight in self.weights):
            raise OptionError("weights", self.weights, f"{len(EVIDENCE)} numbers, 0 or more: {', '.join(EVIDENCE)}")

    @staticmethod
    def read(path: Path) -> Calibration:
        """A calibration from a file.

        Raises:
            ModelError: it cannot be read, or is none.
        """
        try:
            content = dict(read_json(path))
            overall = content.get("overall")
            listed = {"weights": tuple(content["weights"]), "overall": None if overall is None else tuple(overall)}
            return Calibration(**{**content, **listed})
        except (OSError, ValueError, TypeError, KeyError) as error:
            raise ModelError(path, f"cannot be used as a calibration of confidence ({error})") from error

    def document(self) -> dict[str, object]:
        """As JSON has it."""
        return asdict(self)


@dataclass(frozen=True)
class Confidence:
    """What error to expect of a map, by direction and in all.

    Attributes:
        error_stops: (1, H, 2H, 1) expected error of radiance, stops.
        calibration: that says so.
        balls: fewest that any exposure had.
        misplaced: expected share of the light that is in the wrong place (`misplaced`); None where the calibration has
            no say.
    """

    error_stops: Float[Tensor, "1 h w 1"]
    calibration: Calibration
    balls: int
    misplaced: float | None = None

    @property
    def map(self) -> Float[Tensor, "1 h w 1"]:
        """(1, H, 2H, 1) in (0, 1]: the ratio of smaller to larger, estimate to truth, to expect; 0.5 is a stop."""
        return torch.exp2(-self.error_stops)

    @property
    def expected_error(self) -> float:
        """Stops, the mean over the sphere: the number that says how far the map can be trusted."""
        angles = latlong_solid_angles(self.error_stops.shape[1]).to(self.error_stops)[None, ..., None]
        return float((self.error_stops * angles).sum() / (angles.sum() * self.error_stops.shape[2]))

    def line(self) -> str:
        """One sentence for people."""
        held = self.calibration.correlation
        share = "" if self.misplaced is None else f", {self.misplaced:.0%} of the light misplaced"
        ranked = "" if held is None else f"; the share's rank correlation over other photographs is {held:.2f}"
        return (
            f"expected error {self.expected_error:.2f} stops{share} (spread of {self.balls} balls; calibrated on "
            f"{self.calibration.measured_on}{ranked})"
        )


def bracket_spread(balls: Sequence[Float[Tensor, "_ d d 3"]], evs: Sequence[float]) -> Spread:
    """How the balls of a bracket differ where the merge takes its light.

    Args:
        balls: (N, D, D, 3) display-encoded for each EV; N may differ from EV to EV.
        evs: exposure values, descending from 0.

    Returns:
        The spread: of each pixel on the scale of its own exposure, so that lights are judged as finely as shades.

    Raises:
        OptionError: not one batch per EV, or fewer than `FEWEST` balls in one.
    """
    if len(balls) != len(evs) or not balls:
        raise OptionError("balls", len(balls), f"one batch of balls for each EV, that is {len(evs)}")
    for batch, ev in zip(balls, evs, strict=True):
        if len(batch) < FEWEST:
            raise OptionError(f"balls at EV {ev:g}", len(batch), f"{FEWEST} or more: fewer have no spread")
    medians = [pixelwise_median(batch) for batch in balls]
    stops, degrees = _spread(balls[0], medians[0])
    clipped = _clips(medians[0])
    share = float(clipped.float().mean()) * 4 / math.pi  # a crop's corners are beside the ball, and black
    for batch, median in zip(balls[1:], medians[1:], strict=True):
        darker = _spread(batch, median)
        stops, degrees = (torch.where(clipped, new, old) for new, old in zip(darker, (stops, degrees), strict=True))
        clipped = clipped & _clips(median)
    return Spread(stops, degrees, min(map(len, balls)), share)


def _clips(median: BallImage) -> Tensor:
    return (median >= CLIP_THRESHOLD).any(dim=-1, keepdim=True)


def _spread(balls: BallImage, median: Float[Tensor, "1 d d c"]) -> tuple[Tensor, Tensor]:
    """Robust standard deviations of luminance, stops, and of colour, degrees, of one exposure."""
    light = decode_display(balls)
    stops = pixelwise_spread((luminance(light) + FLOOR).log2()) / NORMAL_MAD
    angles = rgb_angles(light + FLOOR, (decode_display(median) + FLOOR).expand_as(light)).rad2deg().to(light)
    # An angle from the median is already a deviation, and of two dimensions: half of a Gaussian's lie within 1.18 sd.
    return stops, pixelwise_median(angles[..., None]) / 1.1774


def evidence(spread: Spread, latlong_hdr: Latlong) -> Float[Tensor, "k h w"]:
    """What an error is predicted from, by direction.

    Args:
        spread: of the balls.
        latlong_hdr: (1, H, 2H, 3) the map made of them, white at EV 0 being 1.

    Returns:
        (6, H, 2H) in the order of `EVIDENCE`: 1; the spread in stops; that of colour in `COLOUR_UNIT` degrees; how far
        the direction is from where the camera looks, 0 ahead and 1 behind; how near the rim it was seen, 1 there and
        1 / (1 + p) p pixels inside; how many stops its luminance is from the map's mean.
    """
    height = latlong_hdr.shape[1]
    both = torch.cat((spread.stops, spread.degrees / COLOUR_UNIT), dim=-1)
    unwrapped = ball_to_latlong(both, height, painted=True)[0].clamp(min=0)
    ahead = -latlong_directions(height).to(unwrapped)[..., 2]
    # A mirror ball shows the direction at angle α from straight ahead at cos(α / 2) of its radius.
    pixels = (1 - ((1 + ahead.clamp(-1, 1)) / 2).sqrt()) * spread.stops.shape[1] / 2
    level = (luminance(latlong_hdr)[0, ..., 0] + FLOOR).log2()
    angles = latlong_solid_angles(height).to(level).expand_as(level)
    contrast = (level - (level * angles).sum() / angles.sum()).abs()
    return torch.stack(
        (
            torch.ones_like(level),
            unwrapped[..., 0],
            unwrapped[..., 1],
            (1 - ahead) / 2,
            1 / (1 + pixels),
            contrast,
        )
    )


def confidence_of(spread: Spread, latlong_hdr: Latlong, calibration: Calibration | None = None) -> Confidence:
    """What error to expect of a map.

    Args:
        spread: of the balls it was made of.
        latlong_hdr: (1, H, 2H, 3) the map, as it was unwrapped: not turned.
        calibration: weights of the evidence; the shipped ones when not given.
    """
    calibration = calibration or shipped_calibration()
    found = evidence(spread, latlong_hdr)
    weights = torch.tensor(calibration.weights).to(found)
    error = torch.einsum("k,khw->hw", weights, found)[None, ..., None]
    share = None
    if calibration.overall is not None:
        seen = overall_evidence(latlong_hdr, spread.stops, spread.clipped)
        share = float(torch.exp2(seen.double() @ torch.tensor(calibration.overall, dtype=torch.float64)))
    return Confidence(error, calibration, spread.balls, share)


@cache
def shipped_calibration() -> Calibration:
    """The calibration that comes along.

    Raises:
        ModelError: its file is damaged.
    """
    return Calibration.read(CALIBRATION_FILE)
