"""The header reader against the OpenEXR package, and on files that lie or end early."""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from dl_core import imageio
from dl_core.errors import ImageError
from dl_core.exr_header import ExrFormatError, parse_parts

COMPRESSIONS = ("NO", "RLE", "ZIPS", "ZIP", "PIZ", "PXR24", "B44", "DWAA", "DWAB")
PIXELS = np.exp(np.random.default_rng(5).normal(size=(40, 80, 4))).astype(np.float32)


def write(path: Path, channels: dict[str, np.ndarray], **header: object) -> Path:
    OpenEXR.File({"type": OpenEXR.scanlineimage, **header}, channels).write(str(path))
    return path


def parts(path: Path) -> tuple:
    with path.open("rb") as file:
        return parse_parts(file)


@pytest.mark.parametrize("compression", COMPRESSIONS)
def test_headers_are_read_as_the_library_reads_them(tmp_path: Path, compression: str) -> None:
    path = write(tmp_path / "a.exr", {"RGBA": PIXELS}, compression=getattr(OpenEXR, f"{compression}_COMPRESSION"))
    (part,) = parts(path)
    (low, high), declared = (
        OpenEXR.File(str(path), header_only=True).header()[key] for key in ("dataWindow", "channels")
    )
    assert (part.width, part.height) == tuple(int(end - start) + 1 for start, end in zip(low, high, strict=True))
    assert [channel.name for channel in part.channels] == [channel.name for channel in declared] == list("ABGR")
    assert {channel.kind for channel in part.channels} == {"float"}
    assert part.decoded_bytes == PIXELS.nbytes
    assert not part.deep
    assert not part.cube
    # The offset table is accounted for exactly enough that the whole file passes and its header alone does not.
    with pytest.raises(ImageError, match="truncated"):
        imageio.read_render(cut(path, header_length(path)))


def header_length(path: Path) -> int:
    """Where the offset table starts: the first offset in it is the end of the table."""
    data = path.read_bytes()
    chunks = 0
    while True:
        chunks += 1
        for at in range(8, len(data) - 8):
            if struct.unpack_from("<Q", data, at)[0] == at + 8 * chunks:
                return at


def cut(path: Path, length: int) -> Path:
    shorter = path.with_name("cut" + path.suffix)
    shorter.write_bytes(path.read_bytes()[:length])
    return shorter


def test_tiles_and_several_parts(tmp_path: Path) -> None:
    tiled = {"type": OpenEXR.tiledimage, "tiles": OpenEXR.TileDescription()}
    path = tmp_path / "tiled.exr"
    OpenEXR.File(tiled, {"RGB": PIXELS[..., :3].copy()}).write(str(path))
    assert torch.equal(imageio.read_envmap(path)[0], torch.from_numpy(PIXELS[..., :3].copy()))
    first = OpenEXR.Part({"type": OpenEXR.scanlineimage}, {"RGB": PIXELS[..., :3].copy()}, "first")
    second = OpenEXR.Part({"type": OpenEXR.scanlineimage}, {"Z": PIXELS[..., 0].copy()}, "second")
    OpenEXR.File([first, second]).write(str(path))
    assert [(part.width, part.height) for part in parts(path)] == [(80, 40), (80, 40)]
    assert torch.equal(imageio.read_envmap(path)[0], torch.from_numpy(PIXELS[..., :3].copy()))


# --- lies --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("window", "reason"),
    [
        ((0, 0, 2 * 10**6 - 1, 10**6 - 1), "truncated"),
        ((-(2**31), -(2**31), 2**31 - 1, 2**31 - 1), "truncated"),
        ((0, 0, -1, -1), "0 x 0 pixels"),
        ((9, 0, 3, 1), "-5 x 2 pixels"),
        ((0, 0, 2**20 - 1, 1), "twice as wide"),
    ],
)
def test_windows_that_lie_are_refused(tmp_path: Path, window: tuple[int, ...], reason: str) -> None:
    path = imageio.write_exr(tmp_path / "a.exr", torch.ones(2, 4, 3), metadata={})
    path.write_bytes(path.read_bytes().replace(struct.pack("<4i", 0, 0, 3, 1), struct.pack("<4i", *window)))
    for read in (imageio.read_envmap, imageio.read_exr_header) if "twice" not in reason else (imageio.read_envmap,):
        with pytest.raises(ImageError, match=reason):
            read(path)


def test_a_window_too_large_is_refused_though_its_offset_table_is_there(tmp_path: Path) -> None:
    path = imageio.write_exr(tmp_path / "a.exr", torch.ones(2, 4, 3), metadata={})
    window = struct.pack("<4i", 0, 0, 2 * 9000 - 1, 9000 - 1)
    path.write_bytes(path.read_bytes().replace(struct.pack("<4i", 0, 0, 3, 1), window) + bytes(8 * 9000))
    for read, reason in ((imageio.read_envmap, "up to 8192 rows"), (imageio.read_render, "up to 134,217,728")):
        with pytest.raises(ImageError, match=reason):
            read(path)


def test_channels_count_towards_what_is_decoded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    plane = PIXELS[..., 0].copy()
    path = write(tmp_path / "a.exr", dict.fromkeys(("R", "G", "B", "N.X", "N.Y", "Z"), plane))
    assert imageio.read_envmap(path).shape == (1, 40, 80, 3)
    monkeypatch.setattr(imageio, "DECODED_LIMIT", 6 * plane.nbytes - 1)
    with pytest.raises(ImageError, match="76,800 bytes of pixels in all channels"):
        imageio.read_envmap(path)


@pytest.mark.parametrize("names", [["Y"], ["R", "G"], ["ViewLayer.Combined.R", "ViewLayer.Combined.G", "Z"]])
def test_pictures_without_colour_say_which_channels_they_have(tmp_path: Path, names: list[str]) -> None:
    path = write(tmp_path / "a.exr", {name: PIXELS[..., 0].copy() for name in names})
    for read in (imageio.read_envmap, imageio.read_render):
        with pytest.raises(ImageError, match=rf"a\.exr: has the channels {', '.join(sorted(names))}; R, G and B"):
            read(path)


def test_whole_numbers_are_no_radiance(tmp_path: Path) -> None:
    path = write(tmp_path / "a.exr", dict.fromkeys("RGB", np.ones((4, 8), np.uint32)))
    with pytest.raises(ImageError, match="uint32 pixels; half or float"):
        imageio.read_envmap(path)


def test_other_versions_are_refused(tmp_path: Path) -> None:
    (tmp_path / "a.exr").write_bytes(b"v/1\x01" + struct.pack("<I", 3) + bytes(40))
    with pytest.raises(ExrFormatError, match="version 3"):
        parts(tmp_path / "a.exr")


# --- damage ------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def good_files(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """A map in every compression, in tiles, and as Radiance."""
    folder = tmp_path_factory.mktemp("good")
    rgb = PIXELS[..., :3].copy()
    files = [
        write(folder / f"{name}.exr", {"RGB": rgb}, compression=getattr(OpenEXR, f"{name}_COMPRESSION"))
        for name in COMPRESSIONS
    ]
    files.append(write(folder / "tiled.exr", {"RGB": rgb}, type=OpenEXR.tiledimage, tiles=OpenEXR.TileDescription()))
    return [*files, imageio.write_hdr(folder / "a.hdr", torch.from_numpy(rgb))]


READERS: tuple[Callable[[Path], object], ...] = (imageio.read_envmap, imageio.read_render)


@given(which=st.integers(0, 10), share=st.floats(0, 1, exclude_max=True), reader=st.sampled_from(READERS))
def test_a_file_cut_anywhere_is_an_image_error(
    good_files: list[Path], which: int, share: float, reader: Callable[[Path], object]
) -> None:
    path = good_files[which]
    shorter = cut(path, int(share * path.stat().st_size))
    with pytest.raises(ImageError, match="cut"):
        reader(shorter)


@given(which=st.integers(0, 10), flips=st.lists(st.tuples(st.integers(0, 500), st.integers(0, 255)), max_size=4))
def test_a_damaged_file_is_read_or_an_image_error(
    good_files: list[Path], which: int, flips: list[tuple[int, int]]
) -> None:
    """Bytes changed near the start, where the header is: pixels carry no checksum, so some damage cannot be seen."""
    path = good_files[which]
    data = bytearray(path.read_bytes())
    for at, value in flips:
        data[at] = value
    damaged = path.with_name("damaged" + path.suffix)
    damaged.write_bytes(bytes(data))
    try:
        found = imageio.read_envmap(damaged)
    except ImageError:
        return
    assert torch.isfinite(found).all()
    assert (found >= 0).all()


# --- renders -----------------------------------------------------------------------------------------------------


def test_renders_keep_their_alpha_and_any_size(tmp_path: Path) -> None:
    path = write(tmp_path / "a.exr", {"RGBA": PIXELS[:7, :5].copy()})
    render = imageio.read_render(path)
    assert torch.equal(render.pixels, torch.from_numpy(PIXELS[:7, :5, :3].copy()))
    assert render.alpha is not None
    assert torch.equal(render.alpha, torch.from_numpy(PIXELS[:7, :5, 3].copy()))
    assert imageio.read_render(write(path, {"RGB": PIXELS[:7, :5, :3].copy()})).alpha is None
    radiance = imageio.write_hdr(tmp_path / "a.hdr", torch.ones(4, 8, 3))
    assert torch.equal(imageio.read_render(radiance).pixels, torch.ones(4, 8, 3))


@pytest.mark.parametrize(("value", "reason"), [(np.nan, "NaN"), (np.inf, "infinite"), (-1.0, "negative")])
def test_renders_hold_radiance(tmp_path: Path, value: float, reason: str) -> None:
    broken = PIXELS.copy()
    broken[3, 4, 1] = value
    with pytest.raises(ImageError, match=f"1 {reason} values, the first at row 3, column 4"):
        imageio.read_render(write(tmp_path / "a.exr", {"RGBA": broken}))
    broken = PIXELS.copy()
    broken[0, 0, 3] = np.nan
    with pytest.raises(ImageError, match="NaN in its alpha"):
        imageio.read_render(write(tmp_path / "a.exr", {"RGBA": broken}))


def test_a_pipe_is_refused_not_waited_for(tmp_path: Path) -> None:
    os = pytest.importorskip("os")
    if not hasattr(os, "mkfifo"):
        pytest.skip("no pipes with names here")
    os.mkfifo(tmp_path / "a.exr")
    with pytest.raises(ImageError, match="no regular file"):
        imageio.read_envmap(tmp_path / "a.exr")


@pytest.mark.parametrize("stated", ["x", "1e99", "nan", "1e-40"])
def test_exposures_that_are_none_are_refused(tmp_path: Path, stated: str) -> None:
    (tmp_path / "a.hdr").write_bytes(f"#?RADIANCE\nEXPOSURE={stated}\n\n-Y 1 +X 2\n".encode() + bytes(8))
    with pytest.raises(ImageError, match="states an exposure"):
        imageio.read_envmap(tmp_path / "a.hdr")


def test_a_radiance_picture_must_be_long_enough_for_its_rows(tmp_path: Path) -> None:
    (tmp_path / "a.hdr").write_bytes(b"#?RADIANCE\n\n-Y 8192 +X 16384\n" + bytes((2, 2, 64, 0)) * 10)
    with pytest.raises(ImageError, match="ends early"):
        imageio.read_envmap(tmp_path / "a.hdr")
