"""The Radiance picture format: shared-exponent pixels (RGBE) in run-length encoded scanlines.

A pixel is three mantissas and one exponent e, and stands for mantissa * 2^(e - 136): 0.4% steps over 76 decades.

Source: Ward, "Real Pixels", Graphics Gems II (1991); run lengths as in Radiance's `color.c`.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

__all__ = [
    "PictureHeader",
    "RadianceFormatError",
    "decode_pixels",
    "decode_rgbe",
    "encode_picture",
    "encode_rgbe",
    "longest_file",
    "parse_header",
]

_SHORTEST_RUN: Final = 4
_LONGEST_RUN: Final = 127
_LONGEST_LITERAL: Final = 128
_LEAST_EXPOSURE: Final = 1e-30
_ENCODED_WIDTHS: Final = range(8, 32768)
"""Widths that run-length encoded scanlines can state; others are stored flat."""


class RadianceFormatError(ValueError):
    """Bytes that are no Radiance picture, or one of a kind that is not read here; says why."""


@dataclass(frozen=True)
class PictureHeader:
    """What the text at the head of a picture says.

    Attributes:
        height: rows.
        width: columns.
        exposure: product of all EXPOSURE lines; radiance is the pixel divided by it.
        start: offset of the first scanline.
    """

    height: int
    width: int
    exposure: float
    start: int


def encode_rgbe(radiance: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Radiance as shared-exponent pixels, rounded to the nearest.

    Args:
        radiance: (..., 3), finite, 0 or above, at most 1e38.

    Returns:
        (..., 4) bytes. Each channel is within 1/256 of the largest of the three; what is below 1e-38 becomes black.
    """
    largest = radiance.max(axis=-1)
    exponent = np.frexp(largest)[1]
    # A mantissa that rounds up to 256 needs the next exponent.
    exponent += np.rint(np.ldexp(largest, 8 - exponent)) > 255
    mantissas = np.rint(np.ldexp(radiance, (8 - exponent)[..., None]))
    pixels = np.concatenate((mantissas, (exponent + 128)[..., None]), axis=-1)
    pixels[largest < 1e-38] = 0
    return pixels.astype(np.uint8)


def decode_rgbe(pixels: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Radiance of shared-exponent pixels: (..., 4) bytes -> (..., 3)."""
    exponent = pixels[..., 3:].astype(np.int32)
    radiance = np.ldexp(pixels[..., :3].astype(np.float32), exponent - 136)
    return np.where(exponent == 0, np.float32(0), radiance)


def encode_picture(radiance: NDArray[np.float32]) -> bytes:
    """A whole Radiance picture: (H, W, 3) radiance, as `encode_rgbe` takes it, with the first row on top."""
    height, width = radiance.shape[:2]
    header = f"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y {height} +X {width}\n".encode()
    pixels = encode_rgbe(radiance)
    if width not in _ENCODED_WIDTHS:
        return header + pixels.tobytes()
    prefix = bytes((2, 2, width >> 8, width & 255))
    scanlines = (prefix + b"".join(_encode_runs(component) for component in row.T) for row in pixels)
    return header + b"".join(scanlines)


def _encode_runs(values: NDArray[np.uint8]) -> bytes:
    """One component of a scanline: runs of at least four equal bytes, and what lies between them as it is."""
    edges = np.flatnonzero(np.diff(values)) + 1
    starts = np.concatenate(([0], edges)).tolist()
    ends = np.concatenate((edges, [len(values)])).tolist()
    encoded, literal = bytearray(), 0
    for start, end in zip(starts, ends, strict=True):
        if end - start < _SHORTEST_RUN:
            continue
        encoded += _encode_literal(values[literal:start].tobytes())
        for length in _split(end - start, _LONGEST_RUN):
            encoded += bytes((128 + length, int(values[start])))
        literal = end
    return bytes(encoded + _encode_literal(values[literal:].tobytes()))


def _encode_literal(values: bytes) -> bytes:
    pieces = (values[at : at + _LONGEST_LITERAL] for at in range(0, len(values), _LONGEST_LITERAL))
    return b"".join(bytes((len(piece),)) + piece for piece in pieces)


def _split(length: int, most: int) -> list[int]:
    return [min(most, length - at) for at in range(0, length, most)]


def parse_header(data: bytes) -> PictureHeader:
    """Read the text at the head of a picture; `data` may be its first kilobytes only. Lines may end as on Windows.

    Raises:
        RadianceFormatError: no Radiance picture, XYZE pixels, or an orientation other than top row first.
    """
    if not data.startswith(b"#?"):
        raise RadianceFormatError("is no Radiance picture (it does not start with '#?')")
    head = re.match(rb"(.*?)\r?\n\r?\n(.*?)\r?\n", data, flags=re.DOTALL)
    if head is None:
        raise RadianceFormatError("ends inside its header")
    text, resolution = head.groups()
    if b"FORMAT=32-bit_rle_xyze" in text:
        raise RadianceFormatError("holds XYZE pixels; RGBE is accepted")
    size = re.fullmatch(rb"-Y (\d{1,9}) \+X (\d{1,9})", resolution)
    if size is None:
        raise RadianceFormatError(f"has the resolution line {resolution!r}; '-Y height +X width' is accepted")
    return PictureHeader(int(size[1]), int(size[2]), _exposure(text), head.end())


def _exposure(text: bytes) -> float:
    """Product of the EXPOSURE lines; radiance divided by it has to stay within float32."""
    exposure = 1.0
    for stated in re.findall(rb"^EXPOSURE=(.*)$", text, flags=re.MULTILINE):
        try:
            exposure *= float(stated)
        except ValueError as error:
            raise RadianceFormatError(f"states an exposure of {stated.decode('latin-1')!r}, no number") from error
    if not _LEAST_EXPOSURE <= exposure <= 1 / _LEAST_EXPOSURE:
        raise RadianceFormatError(f"states an exposure of {exposure:g}; 1e-30 to 1e30 is accepted")
    return exposure


def longest_file(header: PictureHeader) -> int:
    """Bytes up to the end of a picture at the most: each byte of each component on its own costs two."""
    return header.start + header.height * (4 + 8 * header.width)


def decode_pixels(data: bytes, header: PictureHeader) -> NDArray[np.uint8]:
    """The shared-exponent pixels of a picture: (H, W, 4).

    Raises:
        RadianceFormatError: data that ends early, a broken scanline, or the run lengths of before 1991.
    """
    encoded = data[header.start : header.start + 2] == b"\x02\x02" and header.width in _ENCODED_WIDTHS
    return _decode_scanlines(data, header) if encoded else _flat_pixels(data, header)


def _flat_pixels(data: bytes, header: PictureHeader) -> NDArray[np.uint8]:
    count = header.height * header.width * 4
    values = np.frombuffer(data, np.uint8, offset=header.start)
    pixels = values[: len(values) // 4 * 4].reshape(-1, 4)
    if (pixels[:, :3] == 1).all(axis=1).any():
        raise RadianceFormatError("uses the run lengths of before 1991, which are not read")
    if values.size < count:
        raise RadianceFormatError(f"ends early: {values.size} of {count} bytes of pixels are there")
    return values[:count].reshape(header.height, header.width, 4)


def _decode_scanlines(data: bytes, header: PictureHeader) -> NDArray[np.uint8]:
    shortest = 4 + 8 * -(-header.width // _LONGEST_RUN)
    if len(data) - header.start < header.height * shortest:
        raise RadianceFormatError(f"ends early or holds a broken run: a row takes {shortest} bytes or more")
    pixels = np.empty((header.height, 4, header.width), np.uint8)
    at, prefix = header.start, bytes((2, 2, header.width >> 8, header.width & 255))
    for row in range(header.height):
        if data[at : at + 4] != prefix:
            raise RadianceFormatError(f"ends early or is broken at row {row} of {header.height}")
        at += 4
        for component in range(4):
            values, at = _decode_runs(data, at, header.width)
            pixels[row, component] = np.frombuffer(values, np.uint8)
    return pixels.transpose(0, 2, 1)


def _decode_runs(data: bytes, at: int, width: int) -> tuple[bytes, int]:
    """One component of a scanline and the offset behind it."""
    values = bytearray()
    while len(values) < width:
        code = data[at] if at < len(data) else 0
        if code > 128:
            values += data[at + 1 : at + 2] * (code - 128)
            at += 2
        else:
            values += data[at + 1 : at + 1 + code]
            at += 1 + code
        if code == 0 or at > len(data) or len(values) > width:
            raise RadianceFormatError("ends early or holds a broken run")
    return bytes(values), at
