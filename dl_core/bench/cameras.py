"""Photographs taken inside panoramas, as the paper's protocols take them, each with its truth.

Sources: DiffusionLight, Sec. 5.1 (three spheres: 192 x 256 pixels, 60 degrees high, the 99th percentile at 0.9, gamma
2.4; array of spheres: ten azimuths, 50 degrees), Sec. 5.2 (random camera).
"""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

from jaxtyping import Float
from torch import Tensor

from ..errors import OptionError
from ..exposure import auto_exposure, expose
from ..geometry import camera_rotation, latlong_to_perspective, rotate_latlong
from ..shapes import Latlong

__all__ = ["CAMERAS", "Camera", "Shot", "cameras_of", "random_camera", "take"]

ROWS: Final = 192
COLUMNS: Final = 256


@dataclass(frozen=True)
class Camera:
    """A camera in the middle of a panorama.

    Attributes:
        yaw: degrees to the right of the panorama's centre.
        pitch: degrees up.
        fov: vertical field of view, degrees.
        rows: height of the picture, pixels.
        columns: width of the picture, pixels.
    """

    yaw: float = 0.0
    pitch: float = 0.0
    fov: float = 60.0
    rows: int = ROWS
    columns: int = COLUMNS

    @property
    def name(self) -> str:
        """Short and fit for a file name; cameras that see different things have different names."""
        return f"y{self.yaw:g}_p{self.pitch:g}_f{self.fov:g}"

    @property
    def longer_fov(self) -> float:
        """Field of view across the longer side, degrees."""
        longer = max(self.rows, self.columns) / self.rows
        return math.degrees(2 * math.atan(longer * math.tan(math.radians(self.fov) / 2)))


@dataclass(frozen=True)
class Shot:
    """A photograph and the light it was taken in.

    Attributes:
        photo_ldr: (1, rows, columns, 3) display-encoded at EV 0.
        truth_hdr: (1, H, 2H, 3) linear radiance as the camera stands, on the scale of the photograph's EV 0.
    """

    photo_ldr: Float[Tensor, "b rows columns c"]
    truth_hdr: Latlong


def take(latlong_hdr: Latlong, camera: Camera) -> Shot:
    """Take a photograph inside a panorama.

    Args:
        latlong_hdr: (1, H, 2H, 3) linear radiance of any scale.
        camera: where it looks and what it sees.
    """
    rotation = camera_rotation(camera.yaw, camera.pitch)
    seen = latlong_to_perspective(latlong_hdr, camera.rows, camera.columns, fov=camera.longer_fov, rotation=rotation)
    scale = auto_exposure(seen)
    level = camera.yaw == 0 and camera.pitch == 0
    truth = latlong_hdr if level else rotate_latlong(latlong_hdr, rotation.T)
    return Shot(expose(seen * scale, 0.0), truth * scale)


def random_camera(key: str, seed: int = 0) -> Camera:
    """A camera drawn as Sec. 5.2 draws: field of view in [30, 150], elevation in [-45, 45], any azimuth.

    Args:
        key: of the panorama; it has the same camera in every run, whatever else is in the folder.
        seed: of the whole draw.
    """
    draw = random.Random(f"{seed}/{key}")
    yaw, pitch, fov = (round(draw.uniform(*span), 1) for span in ((-180.0, 180.0), (-45.0, 45.0), (30.0, 150.0)))
    return Camera(yaw, pitch, fov)


def _around(count: int) -> list[Camera]:
    """Level cameras at equal azimuths, the first to the panorama's centre."""
    return [Camera(yaw=360.0 * number / count) for number in range(count)]


def _drawn(key: str, seed: int, count: int) -> list[Camera]:
    return [random_camera(key if number == 0 else f"{key}/{number}", seed) for number in range(count)]


CAMERAS: Final[dict[str, Callable[[str, int, int], Sequence[Camera]]]] = {
    "three-spheres": lambda key, seed, count: _around(count),
    "array": lambda key, seed, count: [Camera(yaw=36.0 * i, fov=50.0, rows=COLUMNS) for i in range(10)],
    "random-camera": _drawn,
    "ldr": lambda key, seed, count: _around(count),
}
"""Cameras by protocol: (key of the panorama, seed, how many where the protocol leaves it open) -> cameras."""


def cameras_of(protocol: str, key: str, seed: int, photographs: int = 1) -> Sequence[Camera]:
    """Cameras of a protocol in one panorama.

    Args:
        protocol: of `CAMERAS`.
        key: of the panorama.
        seed: of cameras that are drawn.
        photographs: how many; the paper takes one. Level cameras stand at equal azimuths, random ones are drawn anew.

    Raises:
        OptionError: none, or other than one where the protocol has a number of its own.
    """
    if photographs < 1 or (protocol == "array" and photographs > 1):
        raise OptionError("--photographs", photographs, "1 or more; 1 for array, which looks around in ten steps")
    return CAMERAS[protocol](key, seed, photographs)
