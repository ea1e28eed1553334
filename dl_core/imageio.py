"""Photographs in; EXR, Radiance and PNG files out and in.

Every file is written under a temporary name in its own folder and then renamed: a reader sees the old file or the
whole new one, and a run that stops leaves nothing behind.

No file is trusted: what it declares is compared with its length and with limits before anything of that size is
allocated, and whatever is damaged, truncated or not a picture of linear light becomes an `ImageError`. Nothing is
repaired silently; channels beside R, G, B and A are left out.

Sources: OpenEXR, "Standard attributes" (`chromaticities`, `envmap`); Rec. ITU-R BT.709 (primaries and white).
"""

from __future__ import annotations

import secrets
import struct
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import OpenEXR
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from PIL import Image as PILImage
from PIL import ImageOps
from torch import Tensor

from . import exr_header, radiance
from .errors import ImageError, OptionError, OutputError
from .exposure import auto_exposure, encode_display
from .shapes import Image, Latlong

__all__ = [
    "HALF_MAX",
    "Render",
    "atomic",
    "exr_channels",
    "is_envmap",
    "is_exr",
    "open_photograph",
    "read_envmap",
    "read_exr_header",
    "read_photograph",
    "read_render",
    "require_writable",
    "tone_map_preview",
    "write_exr",
    "write_hdr",
    "write_png",
]

HALF_MAX: Final = 65504.0
"""Largest finite half float."""

REC709: Final = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290)
"""Chromaticities x, y of red, green, blue and white."""

PHOTOGRAPH_FORMATS: Final = ("JPEG", "MPO", "PNG", "WEBP", "TIFF", "AVIF", "JPEG2000", "BMP", "GIF", "PPM")
PIXEL_LIMIT: Final = 175_000_000
"""Pixels a photograph may declare; Pillow itself refuses 179 million."""
KEPT_SIDE: Final = 2048
"""Pixels of the longer side that reading keeps at least unless told otherwise: twice the canvas of SDXL."""
ROWS_LIMIT: Final = 8192
"""Rows an environment map may declare."""
RENDER_LIMIT: Final = 2 * ROWS_LIMIT**2
"""Pixels a rendered picture may declare: those of the largest environment map."""
DECODED_LIMIT: Final = 1 << 32
"""Bytes that all channels of an EXR file may take once decoded: 4 GiB."""
UNDERSHOOT: Final = 0.01
"""Share of a map's light that values below 0 may take away and still be taken for ringing."""
CONFIDENCE_CHANNEL: Final = "confidence.Y"
"""Of the layer that says how far each direction can be trusted (`confidence.Confidence.map`)."""
_HEADER_BYTES: Final = 1 << 16
_NAME_LIMIT: Final = 31
"""Longest attribute name that every EXR reader takes."""


# --- writing -----------------------------------------------------------------------------------------------------


@contextmanager
def atomic(path: str | Path) -> Iterator[Path]:
    """Give a temporary name beside `path`; rename it to `path` when the block ends well, remove it otherwise.

    Args:
        path: of the file to write. The temporary name keeps its suffix.

    Raises:
        OutputError: the folder is missing or the file cannot be written there.
    """
    path = Path(path)
    _require_place(path)
    temporary = path.with_name(f".{path.stem}.{secrets.token_hex(4)}{path.suffix}")
    try:
        yield temporary
        temporary.replace(path)
    except OutputError:
        raise
    except OSError as error:
        raise _unwritable(path, error) from error
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)


def _require_place(path: Path) -> None:
    try:
        folder_is_there, is_folder = path.parent.is_dir(), path.is_dir()
    except OSError as error:
        raise _unwritable(path, error) from error
    if not folder_is_there:
        raise OutputError(path, f"the folder {path.parent} does not exist or is no folder")
    if is_folder:
        raise OutputError(path, "is a folder; give the name of a file")


def _unwritable(path: Path, error: OSError) -> OutputError:
    return OutputError(path, f"cannot be written ({_reason(error)})")


def require_writable(path: str | Path) -> None:
    """Make sure, before long work, that a file can be written: a file is created beside it and removed.

    Raises:
        OutputError: it cannot.
    """
    path = Path(path)
    _require_place(path)
    trial = path.with_name(f".{path.stem}.{secrets.token_hex(4)}{path.suffix}")
    try:
        trial.touch(exist_ok=False)
        trial.unlink()
    except OSError as error:
        raise _unwritable(path, error) from error


def _require_radiance(source: object, pixels: NDArray[Any]) -> None:
    """Reject what is no radiance: NaN, infinite or negative values."""
    for fault, found in (("NaN", np.isnan(pixels)), ("infinite", np.isinf(pixels)), ("negative", pixels < 0)):
        count = int(found.sum())
        if count:
            row, column = (int(index) for index in np.argwhere(found)[0][:2])
            raise ImageError(source, f"holds {count} {fault} values, the first at row {row}, column {column}")


def _without_undershoot(path: object, pixels: NDArray[np.float32]) -> NDArray[np.float32]:
    """A map with its few slightly negative values raised to 0; one with more of them is no radiance and stays as it is.

    Filters with negative lobes and lossy compression (DWA) leave such values around lights.
    """
    below = pixels < 0
    missing = -float(pixels[below].sum(dtype=np.float64))
    if not 0 < missing <= UNDERSHOOT * float(pixels[pixels > 0].sum(dtype=np.float64)):
        return pixels
    warnings.warn(
        f"{path}: {int(below.sum())} values down to {float(pixels[below].min()):.3g} are below 0, as ringing leaves "
        "them, and were raised to 0",
        stacklevel=3,
    )
    return np.maximum(pixels, np.float32(0))


def _latlong_array(latlong_hdr: Tensor) -> NDArray[np.float32]:
    pixels = latlong_hdr.detach().cpu().float().numpy()
    if pixels.ndim != 3 or pixels.shape[2] != 3 or pixels.shape[1] != 2 * pixels.shape[0] or not pixels.size:
        raise ImageError("latlong", f"has shape {pixels.shape}, (height, 2 x height, 3) is accepted")
    _require_radiance("latlong", pixels)
    return np.ascontiguousarray(pixels)


def write_exr(
    path: str | Path,
    latlong_hdr: Float[Tensor, "h w 3"],
    *,
    metadata: Mapping[str, str],
    half: bool = True,
    confidence: Float[Tensor, "rows columns"] | None = None,
) -> Path:
    """Write a map as an EXR light probe: RGB, ZIP, Rec.709 chromaticities, `envmap` latlong.

    Args:
        path: of the file.
        latlong_hdr: (H, 2H, 3) linear radiance, finite, 0 or above.
        metadata: string attributes by name (1 to 31 characters; none that EXR itself defines).
        half: 16-bit floats; otherwise 32-bit. Half keeps 11 bits: steps of 0.05 to 0.1%.
        confidence: (H, 2H) in [0, 1], kept as the channel `confidence.Y`, of the same type.

    Returns:
        The path.

    Raises:
        ImageError: NaN, infinite or negative pixels, or another shape; confidence of another size or outside [0, 1].
        OptionError: an attribute name that cannot be used.
        OutputError: the file cannot be written.

    Warnings:
        Values above 65504 become 65504 in half floats, and a `UserWarning` says how many. OpenEXR calls the centre of
        a latlong +Z; this package calls it -Z, where the camera looks. The picture is the same, the axes differ by
        half a turn about +Y.
    """
    pixels = _latlong_array(latlong_hdr)
    header = _exr_header(metadata)
    kind = np.float16 if half else np.float32
    pixels = _clamp_half(path, pixels).astype(kind) if half else pixels
    channels = {"RGB": pixels}
    if confidence is not None:
        channels[CONFIDENCE_CHANNEL] = _confidence_array(confidence, pixels.shape[:2]).astype(kind)
    with atomic(path) as temporary:
        try:
            OpenEXR.File(header, channels).write(str(temporary))
        except RuntimeError as error:
            raise OutputError(path, f"cannot be written ({error})") from error
    return Path(path)


def _confidence_array(confidence: Tensor, size: tuple[int, ...]) -> NDArray[np.float32]:
    values = confidence.detach().cpu().float().numpy()
    if values.shape != size:
        raise ImageError("confidence", f"has shape {values.shape}, {size} as the map is accepted")
    if not (np.isfinite(values).all() and values.min() >= 0 and values.max() <= 1):
        raise ImageError("confidence", "holds values outside [0, 1]")
    return np.ascontiguousarray(values)


def _exr_header(metadata: Mapping[str, str]) -> dict[str, object]:
    header: dict[str, object] = {
        "type": OpenEXR.scanlineimage,
        "compression": OpenEXR.ZIP_COMPRESSION,
        "chromaticities": REC709,
        "envmap": OpenEXR.ENVMAP_LATLONG,
    }
    reserved = {*header, "channels", "dataWindow", "displayWindow", "lineOrder", "pixelAspectRatio", "version",
                "screenWindowCenter", "screenWindowWidth", "name", "tiles", "view", "chunkCount"}  # fmt: skip
    for name, value in metadata.items():
        if not 1 <= len(name.encode()) <= _NAME_LIMIT or "\0" in name or name in reserved:
            raise OptionError("metadata name", name, f"1 to {_NAME_LIMIT} bytes, not an attribute EXR itself defines")
        header[name] = value
    return header


def _clamp_half(path: object, pixels: NDArray[np.float32]) -> NDArray[np.float32]:
    above = int((pixels > HALF_MAX).sum())
    if above:
        highest = float(pixels.max())
        warnings.warn(
            f"{path}: {above} values up to {highest:g} are above {HALF_MAX:g}, what half floats hold, and were clamped",
            stacklevel=3,
        )
    return np.minimum(pixels, np.float32(HALF_MAX))


def write_hdr(path: str | Path, latlong_hdr: Float[Tensor, "h w 3"]) -> Path:
    """Write a map as a Radiance picture.

    Args:
        path: of the file.
        latlong_hdr: (H, 2H, 3) linear radiance, finite, 0 or above. RGBE keeps each channel within 1/256 of the
            largest of its pixel.

    Returns:
        The path.

    Raises:
        ImageError: NaN, infinite or negative pixels, values above 1e38, or another shape.
        OutputError: the file cannot be written.
    """
    pixels = _latlong_array(latlong_hdr)
    if pixels.max() > 1e38:
        raise ImageError("latlong", f"reaches {float(pixels.max()):g}; Radiance pictures hold up to 1e38")
    with atomic(path) as temporary:
        temporary.write_bytes(radiance.encode_picture(pixels))
    return Path(path)


def write_png(path: str | Path, image_ldr: Float[Tensor, "h w 3"]) -> Path:
    """Write a picture as an 8-bit PNG.

    Args:
        path: of the file.
        image_ldr: (H, W, 3) display-encoded; what lies outside [0, 1] clips.

    Returns:
        The path.

    Raises:
        ImageError: NaN.
        OutputError: the file cannot be written.
    """
    if torch.isnan(image_ldr).any():
        raise ImageError("image", "holds NaN values")
    codes = (image_ldr.detach().cpu().clamp(0, 1) * 255).round().to(torch.uint8).numpy()
    with atomic(path) as temporary:
        PILImage.fromarray(codes).save(temporary, format="PNG")
    return Path(path)


def tone_map_preview(latlong_hdr: Float[Tensor, "h w 3"]) -> Float[Tensor, "h w 3"]:
    """A map as a screen shows it: 99th percentile of intensity to 0.9, γ-2.4.

    Args:
        latlong_hdr: (H, W, 3) linear radiance, 0 or above.

    Returns:
        (H, W, 3) display-encoded in [0, 1].

    Source: DiffusionLight, Sec. 4.2.
    """
    return encode_display(latlong_hdr * auto_exposure(latlong_hdr))


# --- photographs -------------------------------------------------------------------------------------------------


def read_photograph(path: str | Path, *, kept_side: int = KEPT_SIDE) -> Image:
    """Read a photograph of any layout as display-encoded RGB.

    Grey, palette, CMYK and 16-bit pictures are converted, EXIF orientation is applied, transparency is laid on black
    (as the bars beside a photograph on its canvas are), and the first frame of several counts. Pictures at least twice
    as large as `kept_side` are averaged over whole blocks down to no less than that, JPEGs while they are decoded, so
    that size costs little memory. Colour profiles are not applied.

    Args:
        path: of the file, in one of `PHOTOGRAPH_FORMATS`.
        kept_side: pixels of the longer side that are kept at least, 1 or more.

    Returns:
        (1, H, W, 3) float32 in [0, 1].

    Raises:
        ImageError: missing, unreadable or truncated, more than 175 million pixels, or floats outside [0, 1].
    """
    path = Path(path)
    try:
        with open_photograph(path) as picture:
            factor = max(1, max(picture.size) // kept_side)
            picture.draft(None, (picture.width // factor, picture.height // factor))
            oriented = ImageOps.exif_transpose(_reduce(_displayable(path, picture), kept_side))
            return _picture_tensor(oriented)
    except ImageError:
        raise
    except (OSError, SyntaxError, ValueError, EOFError, TypeError, IndexError, struct.error) as error:
        raise ImageError(path, f"cannot be read as a photograph ({_reason(error)})") from error


def _reason(error: Exception) -> str:
    return getattr(error, "strerror", None) or str(error) or type(error).__name__


def open_photograph(path: Path) -> PILImage.Image:
    """Open lazily, to be closed by the caller: size, mode and metadata are known, no pixel is decoded.

    Raises:
        ImageError: more than 175 million pixels; what Pillow raises of a missing or damaged file passes.
    """
    PILImage.init()
    with warnings.catch_warnings():
        # The limit below is this package's own, and an error.
        warnings.simplefilter("ignore", PILImage.DecompressionBombWarning)
        try:
            picture = PILImage.open(path, formats=[name for name in PHOTOGRAPH_FORMATS if name in PILImage.OPEN])
        except PILImage.DecompressionBombError as error:
            raise ImageError(path, f"declares too many pixels, up to {PIXEL_LIMIT:,} are read ({error})") from error
    width, height = picture.size
    if width * height > PIXEL_LIMIT:
        picture.close()
        raise ImageError(path, f"declares {width} x {height} pixels; up to {PIXEL_LIMIT:,} are read")
    return picture


def _displayable(path: Path, picture: PILImage.Image) -> PILImage.Image:
    """The picture in a mode of one (F, in [0, 1]), three (RGB) or four (RGBa, premultiplied: on black) channels."""
    if picture.mode == "F" or picture.mode.startswith("I"):
        scale = 1 if picture.mode == "F" else 65535
        values = np.asarray(picture).astype(np.float32) / np.float32(scale)
        low, high = float(values.min()), float(values.max())
        if not (low >= 0 and high <= 1):
            raise ImageError(path, f"holds values from {low:g} to {high:g} of full scale; display values are read")
        grey = PILImage.fromarray(values)
        grey.getexif().update(picture.getexif())
        return grey
    if picture.has_transparency_data:
        return picture.convert("RGBA").convert("RGBa")
    return picture if picture.mode == "RGB" else picture.convert("RGB")


def _reduce(picture: PILImage.Image, kept_side: int) -> PILImage.Image:
    factor = max(picture.size) // kept_side
    if factor < 2:
        return picture
    reduced = picture.reduce(factor)
    reduced.info = picture.info
    return reduced


def _picture_tensor(picture: PILImage.Image) -> Image:
    values = torch.from_numpy(np.array(picture, dtype=np.float32))
    if picture.mode == "F":
        return values[None, :, :, None].expand(-1, -1, -1, 3).contiguous()
    return (values[..., :3] / 255)[None].contiguous()


# --- environment maps --------------------------------------------------------------------------------------------


def read_envmap(path: str | Path) -> Latlong:
    """Read an environment map: EXR or Radiance, told apart by the file's first bytes.

    Args:
        path: of the file: EXR with R, G and B in half or float (others, such as A, are left out), or Radiance RGBE.

    Returns:
        (1, H, 2H, 3) float32 linear radiance.

    Raises:
        ImageError: missing, truncated, not a 2:1 map, more than 8,192 rows, no RGB, NaN or infinite pixels, or negative
            ones that take away more than `UNDERSHOOT` of the light; where they take less they are raised to 0, with a
            warning.
    """
    path = Path(path)
    if is_exr(path):
        planes = _read_exr(path, _require_map)
        pixels = np.stack([planes[name] for name in "RGB"], axis=-1)
    elif _is_radiance(path):
        pixels = _read_radiance(path, _require_map_size)
    else:
        raise ImageError(path, "is neither an EXR nor a Radiance (.hdr) file")
    pixels = _without_undershoot(path, pixels)
    _require_radiance(path, pixels)
    return torch.from_numpy(pixels)[None]


@dataclass(frozen=True)
class Render:
    """A rendered picture of linear light.

    Attributes:
        pixels: (H, W, 3) float32, finite, 0 or above; as stored, not divided by alpha.
        alpha: (H, W) float32; None where the file has none.
    """

    pixels: Float[Tensor, "h w 3"]
    alpha: Float[Tensor, "h w"] | None


def read_render(path: str | Path) -> Render:
    """Read a rendered picture of any size: EXR or Radiance, told apart by the file's first bytes.

    Args:
        path: of the file: EXR with R, G and B in half or float, and A if there is one (channels beside these are left
            out), or Radiance RGBE.

    Raises:
        ImageError: missing, truncated, no RGB, more than 134 million pixels, NaN, infinite or negative pixels, or NaN
            in alpha.
    """
    path = Path(path)
    if is_exr(path):
        planes = _read_exr(path, _require_render)
        pixels, alpha = np.stack([planes[name] for name in "RGB"], axis=-1), planes.get("A")
    elif _is_radiance(path):
        pixels, alpha = _read_radiance(path, _require_render_size), None
    else:
        raise ImageError(path, "is neither an EXR nor a Radiance (.hdr) file")
    _require_radiance(path, pixels)
    if alpha is not None and np.isnan(alpha).any():
        raise ImageError(path, "holds NaN in its alpha channel")
    return Render(torch.from_numpy(pixels), None if alpha is None else torch.from_numpy(alpha))


def is_exr(path: str | Path) -> bool:
    """Whether a file starts as EXR files do.

    Raises:
        ImageError: it cannot be read.
    """
    return _first_bytes(Path(path), 4) == exr_header.MAGIC


def is_envmap(path: str | Path) -> bool:
    """Whether a file begins as environment maps do: EXR or Radiance.

    Raises:
        ImageError: it cannot be read.
    """
    return is_exr(path) or _is_radiance(Path(path))


def _is_radiance(path: Path) -> bool:
    return _first_bytes(path, 2) == b"#?"


def _first_bytes(path: Path, count: int) -> bytes:
    try:
        if path.exists() and not (path.is_file() or path.is_dir()):
            raise ImageError(path, "is no regular file")  # reading a pipe would wait for its writer
        with path.open("rb") as file:
            return file.read(count)
    except (OSError, ValueError) as error:
        if isinstance(error, ImageError):
            raise
        raise ImageError(path, f"cannot be read ({_reason(error)})") from error


def _require_map_size(path: Path, height: int, width: int) -> None:
    """Reject a declared size before anything of that size is allocated."""
    if height < 1 or width != 2 * height:
        raise ImageError(path, f"is {width} x {height} pixels; a latlong map is twice as wide as high")
    if height > ROWS_LIMIT:
        raise ImageError(path, f"declares {width} x {height} pixels; up to {ROWS_LIMIT} rows are read")


def _require_render_size(path: Path, height: int, width: int) -> None:
    if height < 1 or width < 1:
        raise ImageError(path, f"is {width} x {height} pixels")
    if height * width > RENDER_LIMIT:
        raise ImageError(path, f"declares {width} x {height} pixels; up to {RENDER_LIMIT:,} are read")


def read_exr_header(path: str | Path) -> dict[str, Any]:
    """The attributes of an EXR file's first part, by name, as the OpenEXR package gives them.

    Raises:
        ImageError: missing, truncated, damaged, or no EXR file.
    """
    path = Path(path)
    _exr_parts(path)
    try:
        return dict(OpenEXR.File(str(path), header_only=True).header())
    except _EXR_FAULTS as error:
        raise ImageError(path, f"is a damaged EXR file ({error})") from error


def exr_channels(path: str | Path) -> dict[str, str]:
    """Channels of an EXR file's first part and what they are stored in: half, float or uint.

    Raises:
        ImageError: missing, damaged, or no EXR file.
    """
    return {channel.name: channel.kind for channel in _exr_parts(Path(path))[0].channels}


_EXR_FAULTS: Final = (RuntimeError, ValueError, TypeError, KeyError, IndexError, OverflowError, MemoryError)
"""What the OpenEXR package raises on damaged files."""


def _exr_parts(path: Path) -> tuple[exr_header.Part, ...]:
    """What a file declares, checked against its length and against what will be decoded."""
    if not is_exr(path):
        raise ImageError(path, "is no EXR file")
    try:
        with path.open("rb") as file:
            parts = exr_header.parse_parts(file)
    except exr_header.ExrFormatError as error:
        raise ImageError(path, str(error)) from error
    except OSError as error:
        raise ImageError(path, f"cannot be read ({_reason(error)})") from error
    return parts


def _read_exr(path: Path, require: Callable[[Path, exr_header.Part], None]) -> dict[str, NDArray[np.float32]]:
    """The planes R, G, B and, if there is one, A of a file's first part, once its header is found acceptable."""
    parts = _exr_parts(path)
    require(path, parts[0])
    _require_colour(path, parts[0])
    decoded = sum(part.decoded_bytes for part in parts)
    if decoded > DECODED_LIMIT:
        raise ImageError(
            path, f"declares {decoded:,} bytes of pixels in all channels; up to {DECODED_LIMIT:,} are read"
        )
    planes = _exr_planes(path)
    if not planes.keys() >= set("RGB"):
        raise ImageError(path, "is a damaged EXR file (channels that its header lists are missing)")
    return {name: planes[name].astype(np.float32) for name in "RGBA" if name in planes}


def _exr_planes(path: Path) -> dict[str, NDArray[Any]]:
    try:
        channels = OpenEXR.File(str(path), separate_channels=True).channels()
        return {name: channel.pixels for name, channel in channels.items()}
    except _EXR_FAULTS as error:
        raise ImageError(path, f"is a damaged or truncated EXR file ({error})") from error


def _require_map(path: Path, part: exr_header.Part) -> None:
    _require_map_size(path, part.height, part.width)
    if part.cube:
        raise ImageError(path, "is a cube map; a latlong map is accepted")


def _require_render(path: Path, part: exr_header.Part) -> None:
    _require_render_size(path, part.height, part.width)


def _require_colour(path: Path, part: exr_header.Part) -> None:
    """Reject what holds no full planes of R, G and B."""
    if part.deep:
        raise ImageError(path, "is a deep image; a flat one is accepted")
    channels = {channel.name: channel for channel in part.channels}
    if not channels.keys() >= set("RGB"):
        raise ImageError(path, f"has the channels {', '.join(sorted(channels))}; R, G and B are needed")
    used = [channels[name] for name in "RGBA" if name in channels]
    if any(channel.kind == "uint" for channel in used):
        raise ImageError(path, "holds uint32 pixels; half or float are accepted")
    if any(channel.sampling != (1, 1) for channel in used):
        raise ImageError(path, "has subsampled channels; full resolution is accepted")


def _read_radiance(path: Path, require_size: Callable[[Path, int, int], None]) -> NDArray[np.float32]:
    try:
        header = radiance.parse_header(_first_bytes(path, _HEADER_BYTES))
        require_size(path, header.height, header.width)
        pixels = radiance.decode_pixels(_first_bytes(path, radiance.longest_file(header)), header)
    except radiance.RadianceFormatError as error:
        raise ImageError(path, str(error)) from error
    return radiance.decode_rgbe(pixels) / np.float32(header.exposure)
