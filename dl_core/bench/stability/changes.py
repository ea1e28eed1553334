"""Changes of the input that must leave the light what it is, or change it in a known way.

Each change makes another photograph of the same scene, with the truth as that photograph has it, and says how to bring
its map back to the first one's axes and scale. What differs then is the method's fault.
"""

from __future__ import annotations

import io
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Final

import torch
import torch.nn.functional as F
from jaxtyping import Float
from PIL import Image as PILImage
from torch import Tensor

from ...estimate import Settings
from ...exposure import decode_display, encode_display, quantize
from ...geometry import camera_rotation, rotate_latlong
from ...shapes import Image, Latlong
from ..cameras import Camera, Shot

__all__ = ["INVARIANCES", "Change"]

CAMERA: Final = Camera()
"""That took the photograph which is changed."""


def _same(light_hdr: Latlong) -> Latlong:
    return light_hdr


def _as_asked(settings: Settings) -> Settings:
    return settings


@dataclass(frozen=True)
class Change:
    """A change of the input.

    Attributes:
        family: kind of change.
        variant: which one, for people.
        photo: (1, H, W, 3) display-encoded -> the same, changed.
        forth: what the change does to the true light.
        back: the inverse of `forth`.
        settings: what it does to the settings.
    """

    family: str
    variant: str
    photo: Callable[[Image], Image] = _same
    forth: Callable[[Latlong], Latlong] = _same
    back: Callable[[Latlong], Latlong] = _same
    settings: Callable[[Settings], Settings] = _as_asked

    def of(self, shot: Shot) -> Shot:
        """The changed photograph in the changed light."""
        return Shot(self.photo(shot.photo_ldr).clamp(0, 1), self.forth(shot.truth_hdr))


def _mirror(image: Image) -> Image:
    return image.flip(2)


def _crop(share: float, aside: float = 0.0) -> Callable[[Image], Any]:
    """A window of a share of each side, in the middle or moved to the right by a share of the width."""

    def cut(photo: Image) -> Float[Tensor, "b r k c"]:
        rows, columns = photo.shape[1:3]
        height, width = round(share * rows), round(share * columns)
        top, left = (rows - height) // 2, round((columns - width) / 2 + aside * columns)
        return photo[:, top : top + height, left : left + width]

    return cut


def _aside(share: float) -> Change:
    """A window moved to the side: the camera has turned so far, but for the perspective of its corners."""
    turn = math.degrees(math.atan(2 * share * math.tan(math.radians(CAMERA.longer_fov) / 2)))
    rotation = camera_rotation(yaw=turn)
    return Change(
        "shift",
        f"{share:.0%} to the right",
        _crop(1 - 2 * share, share),
        lambda light: rotate_latlong(light, rotation.T),
        lambda light: rotate_latlong(light, rotation),
    )


def _jpeg(quality: int) -> Callable[[Image], Image]:
    def coded(photo: Image) -> Image:
        file = io.BytesIO()
        pixels = (quantize(photo)[0] * 255).round().to(torch.uint8).numpy()
        PILImage.fromarray(pixels).save(file, "JPEG", quality=quality)
        decoded = torch.frombuffer(bytearray(PILImage.open(file).tobytes()), dtype=torch.uint8)
        return decoded.view(1, *pixels.shape).float() / 255

    return coded


def _resized(factor: float) -> Callable[[Image], Any]:
    def resize(photo: Image) -> Float[Tensor, "b r k c"]:
        rows, columns = (round(side * factor) for side in photo.shape[1:3])
        planes = photo.permute(0, 3, 1, 2)
        resized = F.interpolate(planes, (rows, columns), mode="bicubic", antialias=True)
        return resized.permute(0, 2, 3, 1).clamp(0, 1)

    return resize


def _gain(family: str, variant: str, gains: tuple[float, float, float]) -> Change:
    """Every channel of the linear light multiplied, and clipped again where that takes it above white."""

    def scaled(light: Latlong, by: Float[Tensor, "3"]) -> Latlong:
        return light * by.to(light)

    factors = torch.tensor(gains)
    return Change(
        family,
        variant,
        lambda photo: quantize(encode_display(scaled(decode_display(photo), factors).clamp(max=1))),
        lambda light: scaled(light, factors),
        lambda light: scaled(light, 1 / factors),
    )


def _diameter(share: float) -> Change:
    def sized(settings: Settings) -> Settings:
        return replace(settings, diameter=2 * round(settings.diameter * share / 2))

    return Change("ball size", f"{share:.0%} of the usual", settings=sized)


def _place(right: float, down: float, name: str) -> Change:
    """The ball's centre, in its diameters from the middle of the canvas."""

    def moved(settings: Settings) -> Settings:
        middle = settings.canvas / 2
        return replace(settings, x=middle + right * settings.diameter, y=middle + down * settings.diameter)

    return Change("ball place", name, settings=moved)


def _exposure(stops: float) -> Change:
    gain = 2.0**stops
    return _gain("exposure", f"{stops:+g} stops", (gain, gain, gain))


INVARIANCES: Final[tuple[Change, ...]] = (
    Change("mirroring", "left for right", _mirror, _mirror, _mirror),
    *(Change("crop", f"{share:.0%} of each side", _crop(share)) for share in (0.95, 0.9, 0.8)),
    *(_aside(share) for share in (0.025, 0.05, 0.1)),
    *(Change("JPEG", f"quality {quality}", _jpeg(quality)) for quality in (95, 75, 30)),
    *(Change("resizing", f"{factor:g} times the size", _resized(factor)) for factor in (0.5, 2.0, 4.0)),
    *(_exposure(stops) for stops in (-1.0, -0.5, 0.5, 1.0)),
    _gain("white balance", "warmer, 1.15 1 0.85", (1.15, 1.0, 0.85)),
    _gain("white balance", "cooler, 0.85 1 1.15", (0.85, 1.0, 1.15)),
    _gain("white balance", "tungsten left in, 1.5 1 0.55", (1.5, 1.0, 0.55)),
    *(_diameter(share) for share in (0.75, 0.9, 1.1, 1.25)),
    _place(0.25, 0.0, "a quarter ball right"),
    _place(0.0, 0.25, "a quarter ball down"),
    _place(-0.5, 0.25, "half a ball left, a quarter down"),
)
"""Changes that a user makes without a thought."""
