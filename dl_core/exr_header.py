"""What an OpenEXR file declares about itself, read before any pixel is, and without trusting it.

The library that decodes pixels allocates what the header asks for, so the header is read here first: a few bytes for
each attribute, none of them believed beyond the file's own length.

Source: OpenEXR, "OpenEXR file layout" (magic number, version field, attributes, offset tables) and "Technical
introduction" (scan lines per chunk of each compression).
"""

from __future__ import annotations

import os
import struct
from dataclasses import dataclass
from typing import BinaryIO, Final

__all__ = ["MAGIC", "Channel", "ExrFormatError", "Part", "parse_parts"]

MAGIC: Final = b"v/1\x01"
_DEEP: Final = 0x800
_MULTIPART: Final = 0x1000
_VERSION: Final = 2

_NAME_LIMIT: Final = 255
_CHUNK_ROWS: Final = (1, 1, 1, 16, 32, 16, 32, 32, 32, 256, 256, 32)
"""Scan lines in a chunk by compression: none, RLE, ZIPS, ZIP, PIZ, PXR24, B44, B44A, DWAA, DWAB, HTJ2K256, HTJ2K32."""
_TALLEST_CHUNK: Final = 256
"""For a compression that came later: fewer chunks are then demanded than there are."""

KINDS: Final = {0: ("uint", 4), 1: ("half", 2), 2: ("float", 4)}
"""Pixel types by number: name and bytes."""

_ATTRIBUTES: Final = ("channels", "compression", "dataWindow", "envmap", "tiles", "type")
"""Attributes that are read; of the others only the names are."""


class ExrFormatError(ValueError):
    """Bytes that are no OpenEXR file, or a damaged one; says why."""


@dataclass(frozen=True)
class Channel:
    """A channel of a part.

    Attributes:
        name: such as "R" or "diffuse.R".
        kind: half, float or uint.
        sampling: every how many columns and rows it has a pixel.
    """

    name: str
    kind: str
    sampling: tuple[int, int]


@dataclass(frozen=True)
class Part:
    """One picture of a file.

    Attributes:
        width: columns of the data window.
        height: rows of the data window.
        channels: in the file's order.
        deep: several samples a pixel.
        cube: declared to be a cube map.
        decoded_bytes: what all channels take when they are decoded.
    """

    width: int
    height: int
    channels: tuple[Channel, ...]
    deep: bool
    cube: bool
    decoded_bytes: int


def parse_parts(file: BinaryIO) -> tuple[Part, ...]:
    """Read the headers of all parts of a file that is open at its start.

    Raises:
        ExrFormatError: no OpenEXR file, a damaged header, or a file too short for the pictures it declares.
    """
    size = os.fstat(file.fileno()).st_size
    if file.read(4) != MAGIC:
        raise ExrFormatError("is no EXR file")
    (version,) = _unpack("<I", _read(file, 4))
    if version & 0xFF != _VERSION:
        raise ExrFormatError(f"states version {version & 0xFF} of the format; {_VERSION} is read")
    headers = _headers(file, size, several=bool(version & _MULTIPART))
    parts = tuple(_part(header, deep=bool(version & _DEEP)) for header in headers)
    table = 8 * sum(_chunks(header, part) for header, part in zip(headers, parts, strict=True))
    if file.tell() + table > size:
        raise ExrFormatError(
            f"is truncated: {size} bytes cannot hold the {parts[0].width} x {parts[0].height} it declares"
        )
    return parts


def _headers(file: BinaryIO, size: int, *, several: bool) -> list[dict[str, bytes]]:
    headers = [_attributes(file, size)]
    while several and (header := _attributes(file, size)):
        headers.append(header)
    return headers


def _attributes(file: BinaryIO, size: int) -> dict[str, bytes]:
    """The attributes of one header up to its closing zero; none for the header that closes several."""
    found: dict[str, bytes] = {}
    while name := _string(file):
        _string(file)
        (length,) = _unpack("<i", _read(file, 4))
        if not 0 <= length <= size - file.tell():
            raise ExrFormatError(f"is truncated or damaged: its attribute {name!r} states {length} bytes")
        found[name] = file.read(length) if name in _ATTRIBUTES else _pass_over(file, length)
    return found


def _pass_over(file: BinaryIO, length: int) -> bytes:
    file.seek(length, os.SEEK_CUR)
    return b""


def _string(file: BinaryIO) -> str:
    letters = bytearray()
    while (letter := _read(file, 1)) != b"\0":
        letters += letter
        if len(letters) > _NAME_LIMIT:
            raise ExrFormatError(f"has a damaged header: a name of more than {_NAME_LIMIT} bytes")
    return letters.decode("utf-8", "replace")


def _read(file: BinaryIO, count: int) -> bytes:
    data = file.read(count)
    if len(data) < count:
        raise ExrFormatError("is truncated: it ends inside its header")
    return data


def _unpack(form: str, data: bytes) -> tuple[int, ...]:
    try:
        return struct.unpack(form, data)
    except struct.error as error:
        raise ExrFormatError("has a damaged header: an attribute of the wrong size") from error


def _part(header: dict[str, bytes], *, deep: bool) -> Part:
    for name in ("channels", "compression", "dataWindow"):
        if name not in header:
            raise ExrFormatError(f"has a damaged header: the attribute {name!r} is missing")
    left, top, right, bottom = _unpack("<4i", header["dataWindow"])
    width, height = right - left + 1, bottom - top + 1
    if width < 1 or height < 1:
        raise ExrFormatError(f"has a damaged header: a data window of {width} x {height} pixels")
    channels = _channels(header["channels"])
    return Part(
        width=width,
        height=height,
        channels=channels,
        deep=deep or header.get("type", b"").startswith(b"deep"),
        cube=header.get("envmap") == b"\1",
        decoded_bytes=sum(_plane_bytes(channel, width, height) for channel in channels),
    )


def _channels(data: bytes) -> tuple[Channel, ...]:
    found: list[Channel] = []
    at = 0
    while at < len(data) and data[at] != 0:
        end = data.find(b"\0", at)
        if end < 0 or end + 17 > len(data):
            raise ExrFormatError("has a damaged header: its list of channels ends early")
        kind, _, across, down = struct.unpack_from("<4i", data, end + 1)
        if kind not in KINDS or across < 1 or down < 1:
            raise ExrFormatError("has a damaged header: a channel of no known type")
        found.append(Channel(data[at:end].decode("utf-8", "replace"), KINDS[kind][0], (across, down)))
        at = end + 17
    return tuple(found)


def _plane_bytes(channel: Channel, width: int, height: int) -> int:
    each = next(size for name, size in KINDS.values() if name == channel.kind)
    return each * -(-width // channel.sampling[0]) * -(-height // channel.sampling[1])


def _chunks(header: dict[str, bytes], part: Part) -> int:
    """Chunks that the largest level of a part is stored in; its offset table has eight bytes for each."""
    if "tiles" in header and not header.get("type", b"tiled").endswith(b"scanlineimage"):
        across, down, _ = _unpack("<IIB", header["tiles"])
        if not across or not down:
            raise ExrFormatError("has a damaged header: tiles without pixels")
        return -(-part.width // across) * -(-part.height // down)
    (compression,) = _unpack("<B", header["compression"])
    rows = _CHUNK_ROWS[compression] if compression < len(_CHUNK_ROWS) else _TALLEST_CHUNK
    return -(-part.height // rows)
