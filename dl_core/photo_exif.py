"""Field of view of a photograph from what its camera wrote into it.

The focal length that 35 mm film would have is, by its definition, that of the same angle across the diagonal, 43.27 mm.
The focal length itself needs the sensor's size, which follows from the focal plane's resolution and the picture's
size as it was taken.

Sources: JEITA CP-3451 (Exif 2.32), tags FocalLength, FocalLengthIn35mmFilm, FocalPlaneXResolution,
FocalPlaneYResolution, FocalPlaneResolutionUnit, PixelXDimension, PixelYDimension; CIPA DCG-001, for the diagonal.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from PIL import ExifTags

from .errors import ImageError
from .imageio import open_photograph

__all__ = ["CameraData", "choose_fov", "read_camera"]

FILM_DIAGONAL: Final = math.hypot(36, 24)
"""Millimetres."""
_UNITS: Final = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}
"""Millimetres of a FocalPlaneResolutionUnit; inches where it is not given."""
_AGREE: Final = 1.1
"""Ratio of focal lengths up to which two sources agree: lenses are labelled in round numbers."""
_SAME_ASPECT: Final = 1.02


@dataclass(frozen=True)
class CameraData:
    """What a photograph says of its camera.

    Attributes:
        fov: across the longer side, degrees; None where it does not say.
        remarks: what in it is doubtful, one sentence each.
    """

    fov: float | None = None
    remarks: tuple[str, ...] = ()


def read_camera(path: str | Path) -> CameraData:
    """Field of view of a photograph by its EXIF data, which may be absent, incomplete or damaged.

    The focal length for 35 mm film counts first, then the focal length with the sensor's size.

    Raises:
        ImageError: the file is missing or no picture.
    """
    path = Path(path)
    try:
        with open_photograph(path) as picture:
            size = picture.size
            try:
                tags = dict(picture.getexif().get_ifd(ExifTags.IFD.Exif))
            except Exception as error:  # Pillow lets whatever damaged bytes cause pass, of half a dozen types
                return CameraData(remarks=(f"EXIF data of the photograph cannot be read ({type(error).__name__})",))
    except ImageError:
        raise
    except (OSError, SyntaxError, ValueError) as error:
        raise ImageError(path, f"cannot be read as a photograph ({error})") from error
    return _camera(tags, size)


def _camera(tags: Mapping[int, Any], size: tuple[int, int]) -> CameraData:
    aspect = max(size) / min(size)
    film = _number(tags, ExifTags.Base.FocalLengthIn35mmFilm)
    # In longer sides of the picture, of which its diagonal is hypot(1, 1 / aspect).
    by_film = None if film is None else film / FILM_DIAGONAL * math.hypot(1, 1 / aspect)
    by_sensor = _focal_by_sensor(tags)
    focal = by_film if by_film is not None else by_sensor
    remarks = []
    if by_film is not None and by_sensor is not None and not _agree(by_film, by_sensor):
        remarks.append(
            f"EXIF data contradict themselves: {_fov(by_film):.1f} degrees by the focal length for 35 mm film, "
            f"{_fov(by_sensor):.1f} by the focal length and the sensor; the first is taken"
        )
    taken = _size(tags)
    change = 1.0 if taken is None else max(taken) / min(taken) / aspect
    if focal is not None and taken is not None and max(change, 1 / change) > _SAME_ASPECT:
        remarks.append(
            f"taken at {taken[0]:g} x {taken[1]:g} pixels by its EXIF data and cropped to {size[0]} x {size[1]} since: "
            "its field of view is narrower than they say"
        )
    return CameraData(None if focal is None else _fov(focal), tuple(remarks))


def _focal_by_sensor(tags: Mapping[int, Any]) -> float | None:
    """Focal length in sides of the sensor, the longer one; None where something is missing."""
    focal, size = _number(tags, ExifTags.Base.FocalLength), _size(tags)
    resolutions = [
        _number(tags, tag) for tag in (ExifTags.Base.FocalPlaneXResolution, ExifTags.Base.FocalPlaneYResolution)
    ]
    unit = _UNITS.get(int(_number(tags, ExifTags.Base.FocalPlaneResolutionUnit) or 2))
    if focal is None or size is None or unit is None or resolutions[0] is None:
        return None
    x, y = resolutions[0], resolutions[1] or resolutions[0]
    return focal / max(size[0] / x * unit, size[1] / y * unit)


def _size(tags: Mapping[int, Any]) -> tuple[float, float] | None:
    """Pixels of the picture as it was taken."""
    width, height = (_number(tags, tag) for tag in (ExifTags.Base.ExifImageWidth, ExifTags.Base.ExifImageHeight))
    return None if width is None or height is None else (width, height)


def _number(tags: Mapping[int, Any], tag: int) -> float | None:
    """A value above 0, or None: cameras write 0, or 0/0, for what they do not know."""
    try:
        value = float(tags[tag])
    except (KeyError, TypeError, ValueError, ZeroDivisionError, OverflowError):
        return None
    return value if math.isfinite(value) and value > 0 else None


def _fov(focal: float) -> float:
    """Degrees across the longer side for a focal length in such sides."""
    return math.degrees(2 * math.atan(0.5 / focal))


def _agree(one: float, other: float) -> bool:
    return max(one / other, other / one) <= _AGREE


def choose_fov(given: float | None, camera: CameraData) -> tuple[float | None, list[str]]:
    """The field of view to use, and what to say of where it is from. One that is given wins.

    Args:
        given: degrees across the longer side, above 0 and below 180.
        camera: what the photograph says.
    """
    if given is None:
        if camera.fov is None:
            return None, []
        return camera.fov, [f"field of view by EXIF: {camera.fov:.1f} degrees", *camera.remarks]
    if camera.fov is not None and not _agree(*(0.5 / math.tan(math.radians(f) / 2) for f in (given, camera.fov))):
        return given, [f"field of view given, {given:g} degrees, against {camera.fov:.1f} by EXIF"]
    return given, []
