from __future__ import annotations

import os
import struct
import tempfile
import warnings
import zlib
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image as PILImage
from tolerances import assert_close

from dl_core import imageio
from dl_core.errors import ImageError, OptionError, OutputError
from dl_core.geometry import latlong_energy

ORIENTATION = 0x0112
# What undoes each EXIF orientation, in numpy's words; written from the EXIF 2.3 table, not from Pillow.
ORIENTED = {
    1: lambda a: a,
    2: lambda a: a[:, ::-1],
    3: lambda a: a[::-1, ::-1],
    4: lambda a: a[::-1],
    5: lambda a: a.swapaxes(0, 1),
    6: lambda a: np.rot90(a, -1),
    7: lambda a: a[::-1, ::-1].swapaxes(0, 1),
    8: lambda a: np.rot90(a),
}


def random_map(generator: torch.Generator, height: int = 8) -> torch.Tensor:
    """Radiance over eight decades."""
    return torch.exp(torch.randn(height, 2 * height, 3, generator=generator) * 3)


@pytest.fixture
def codes() -> np.ndarray:
    return np.random.default_rng(3).integers(0, 256, (6, 9, 3), dtype=np.uint8)


def save(path: Path, picture: PILImage.Image, **options: object) -> Path:
    picture.save(path, **options)
    return path


# --- photographs ---


def test_png_is_read_exactly(tmp_path: Path, codes: np.ndarray) -> None:
    photo = imageio.read_photograph(save(tmp_path / "a.png", PILImage.fromarray(codes)))
    assert photo.dtype == torch.float32
    assert_close(photo, torch.from_numpy(codes)[None] / 255)


@pytest.mark.parametrize("orientation", ORIENTED)
@pytest.mark.parametrize("suffix", ["png", "tif", "webp"])
def test_orientation_is_applied(tmp_path: Path, codes: np.ndarray, orientation: int, suffix: str) -> None:
    exif = PILImage.Exif()
    exif[ORIENTATION] = orientation
    options = {"lossless": True, "exact": True} if suffix == "webp" else {}
    path = save(tmp_path / f"a.{suffix}", PILImage.fromarray(codes), exif=exif, **options)
    expected = np.ascontiguousarray(ORIENTED[orientation](codes))
    assert_close(imageio.read_photograph(path), torch.from_numpy(expected)[None] / 255)


def test_orientation_survives_reduction(tmp_path: Path) -> None:
    exif = PILImage.Exif()
    exif[ORIENTATION] = 6
    wide = PILImage.new("RGB", (8192, 16))
    wide.paste((255, 0, 0), (0, 0, 4096, 16))
    for suffix in ("png", "jpg"):
        photo = imageio.read_photograph(save(tmp_path / f"wide.{suffix}", wide, exif=exif))
        assert photo.shape[1] == 2048
        assert photo.shape[2] == 4
        assert photo[0, 0, 0, 0] > 0.99  # the left end turned to the top
        assert photo[0, -1, 0, 0] < 0.01


@pytest.mark.parametrize("suffix", ["png", "tif"])
def test_sixteen_bit_grey_keeps_its_bits(tmp_path: Path, suffix: str) -> None:
    ramp = np.arange(0, 65536, 257, dtype=np.uint16).reshape(16, 16)
    photo = imageio.read_photograph(save(tmp_path / f"a.{suffix}", PILImage.fromarray(ramp)))
    expected = torch.from_numpy(ramp.astype(np.float32) / 65535)
    assert_close(photo, expected[None, :, :, None].expand(1, 16, 16, 3))


def test_sixteen_bit_colour_png(tmp_path: Path) -> None:
    """Pillow cannot write one, so it is put together here."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    pixels = np.array([[[65535, 0, 32768], [257, 65535, 0]]], dtype=">u2")
    data = b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", struct.pack(">IIBBBBB", 2, 1, 16, 2, 0, 0, 0))
    data += chunk(b"IDAT", zlib.compress(b"\0" + pixels.tobytes())) + chunk(b"IEND", b"")
    (tmp_path / "a.png").write_bytes(data)
    photo = imageio.read_photograph(tmp_path / "a.png")
    # Pillow keeps the upper eight bits.
    torch.testing.assert_close(photo, torch.from_numpy(pixels.astype(np.float32) / 65535)[None], rtol=0, atol=1 / 255)


@pytest.mark.parametrize("mode", ["L", "P", "1", "CMYK", "LAB"])
def test_other_layouts_show_what_pillow_shows(tmp_path: Path, codes: np.ndarray, mode: str) -> None:
    picture = PILImage.fromarray(codes).convert(mode)
    path = save(tmp_path / "a.tif", picture)
    assert_close(imageio.read_photograph(path), torch.from_numpy(np.array(picture.convert("RGB")))[None] / 255)


@pytest.mark.parametrize("mode", ["RGBA", "LA", "PA"])
def test_transparency_lies_on_black(tmp_path: Path, mode: str) -> None:
    picture = PILImage.new("RGBA", (4, 2), (200, 200, 200, 255))
    picture.paste((200, 200, 200, 0), (0, 0, 2, 2))
    if mode == "PA":
        path = save(tmp_path / "a.png", picture.quantize(4))
    else:
        path = save(tmp_path / "a.png", picture.convert(mode))
    photo = imageio.read_photograph(path)
    assert_close(photo[:, :, :2], 0.0)
    assert_close(photo[:, :, 2:], 200 / 255)


def test_one_pixel(tmp_path: Path) -> None:
    photo = imageio.read_photograph(save(tmp_path / "a.png", PILImage.new("RGB", (1, 1), (255, 0, 51))))
    assert_close(photo, torch.tensor([[[[1, 0, 0.2]]]]))


def test_twenty_thousand_pixels_wide(tmp_path: Path) -> None:
    """Averaged over blocks of nine: a checkerboard of single pixels turns into its mean, not one of its colours."""
    board = np.indices((18, 20000)).sum(axis=0) % 2 * np.uint8(255)
    photo = imageio.read_photograph(save(tmp_path / "a.png", PILImage.fromarray(board.astype(np.uint8))))
    assert photo.shape == (1, 2, 2223, 3)
    # 41 or 40 of 81 pixels are white, and the mean is rounded to 8 bits.
    assert (photo[:, :, :2222] - 0.5).abs().max() < 0.5 / 81 + 1 / 255


def test_too_many_pixels_are_refused_before_decoding(tmp_path: Path) -> None:
    for width, height in ((20000, 20000), (17600, 10000)):
        header = PILImage.new("1", (1, 1))
        path = save(tmp_path / "a.png", header)
        data = bytearray(path.read_bytes())
        data[16:24] = struct.pack(">II", width, height)
        data[29:33] = struct.pack(">I", zlib.crc32(bytes(data[12:29])))
        path.write_bytes(bytes(data))
        with pytest.raises(ImageError, match=r"a\.png: declares"):
            imageio.read_photograph(path)


@pytest.mark.parametrize("suffix", ["jpg", "png", "webp", "tif", "gif", "bmp"])
def test_truncated_photographs_are_refused(tmp_path: Path, suffix: str) -> None:
    noise = np.random.default_rng(1).integers(0, 256, (64, 64, 3), dtype=np.uint8)
    path = save(tmp_path / f"a.{suffix}", PILImage.fromarray(noise))
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(ImageError, match=f"a.{suffix}"):
        imageio.read_photograph(path)


@pytest.mark.parametrize("content", [b"", b"no picture", b"\x89PNG\r\n\x1a\n"])
def test_other_files_are_no_photographs(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "a.png").write_bytes(content)
    with pytest.raises(ImageError, match=r"a\.png"):
        imageio.read_photograph(tmp_path / "a.png")


def test_missing_photographs_and_folders(tmp_path: Path) -> None:
    with pytest.raises(ImageError, match=r"gone\.jpg.*No such file"):
        imageio.read_photograph(tmp_path / "gone.jpg")
    with pytest.raises(ImageError, match="directory"):
        imageio.read_photograph(tmp_path)


def test_floats_outside_display_range_are_refused(tmp_path: Path) -> None:
    path = save(tmp_path / "a.tif", PILImage.fromarray(np.full((2, 2), 3.0, np.float32)))
    with pytest.raises(ImageError, match="3 of full scale"):
        imageio.read_photograph(path)


# --- EXR ---


def test_exr_header_is_that_of_a_light_probe(tmp_path: Path, generator: torch.Generator) -> None:
    path = imageio.write_exr(tmp_path / "a.exr", random_map(generator), metadata={"lightprobe:evs": "0, -2.5 é"})
    header = OpenEXR.File(str(path), header_only=True).header()
    assert header["envmap"] == OpenEXR.ENVMAP_LATLONG
    assert isinstance(header["envmap"], OpenEXR.Envmap)
    assert header["chromaticities"] == pytest.approx((0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290), abs=1e-6)
    assert header["lightprobe:evs"] == "0, -2.5 é"
    # The attribute is stored under EXR's own type, not as a number or string.
    assert b"envmap\0envmap\0\1\0\0\0\0" in path.read_bytes()
    channels = OpenEXR.File(str(path), separate_channels=True).channels()
    assert {name: channel.pixels.dtype for name, channel in channels.items()} == dict.fromkeys("BGR", np.float16)


def test_exr_round_trip_keeps_every_bit(tmp_path: Path, generator: torch.Generator) -> None:
    radiance = random_map(generator)
    full = imageio.read_envmap(imageio.write_exr(tmp_path / "f.exr", radiance, metadata={}, half=False))
    assert torch.equal(full[0], radiance)
    half = imageio.read_envmap(imageio.write_exr(tmp_path / "h.exr", radiance, metadata={}))
    assert torch.equal(half[0], radiance.half().float())


def test_channel_order(tmp_path: Path) -> None:
    red = torch.zeros(2, 4, 3)
    red[..., 0] = 1
    for name in ("a.exr", "a.hdr"):
        path = tmp_path / name
        imageio.write_hdr(path, red) if name.endswith("hdr") else imageio.write_exr(path, red, metadata={})
        assert torch.equal(imageio.read_envmap(path)[0], red)


def test_half_clamps_and_says_so(tmp_path: Path) -> None:
    sun = torch.ones(2, 4, 3)
    sun[0, 0] = 1e6
    with pytest.warns(UserWarning, match=r"3 values up to 1e\+06"):
        path = imageio.write_exr(tmp_path / "a.exr", sun, metadata={})
    assert imageio.read_envmap(path).max() == imageio.HALF_MAX
    assert imageio.read_envmap(imageio.write_exr(path, sun, metadata={}, half=False)).max() == 1e6


@pytest.mark.parametrize(("value", "word"), [(float("nan"), "NaN"), (float("inf"), "infinite"), (-2.0, "negative")])
def test_what_is_no_radiance_is_not_written_and_not_read(tmp_path: Path, value: float, word: str) -> None:
    broken = torch.ones(4, 8, 3)
    broken[2, 5, 1] = value
    where = rf"1 {word} values, the first at row 2, column 5"
    with pytest.raises(ImageError, match=where):
        imageio.write_exr(tmp_path / "a.exr", broken, metadata={})
    with pytest.raises(ImageError, match=where):
        imageio.write_hdr(tmp_path / "a.hdr", broken)
    assert list(tmp_path.iterdir()) == []
    OpenEXR.File({"type": OpenEXR.scanlineimage}, {"RGB": broken.numpy()}).write(str(tmp_path / "b.exr"))
    with pytest.raises(ImageError, match=where):
        imageio.read_envmap(tmp_path / "b.exr")


@pytest.mark.parametrize("suffix", ["exr", "hdr"])
def test_a_map_without_undershoot_is_read_in_silence(tmp_path: Path, suffix: str) -> None:
    write = imageio.write_exr if suffix == "exr" else lambda path, light, metadata: imageio.write_hdr(path, light)
    dark = torch.zeros(4, 8, 3)
    dark[0, 0] = 1
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        imageio.read_envmap(write(tmp_path / f"a.{suffix}", dark, metadata={}))


@given(st.floats(1e-6, 0.0099), st.integers(1, 8))
def test_ringing_around_a_light_is_raised_to_zero_and_said(share: float, count: int) -> None:
    """Lossy EXRs and resampled ones undershoot a little beside a sun; nothing else of the map changes."""
    ringing = torch.ones(4, 8, 3)
    ringing[1, 2] = 500
    light = float(ringing.sum()) - count  # of the pixels that stay above 0
    ringing[3, :count, 0] = -share * light / count
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.exr"
        OpenEXR.File({"type": OpenEXR.scanlineimage}, {"RGB": ringing.numpy()}).write(str(path))
        with pytest.warns(UserWarning, match=rf"a.exr: {count} values down to -.*raised to 0"):
            read = imageio.read_envmap(path)[0]
    assert torch.equal(read, ringing.clamp(min=0))


@pytest.mark.parametrize("name", ["", "envmap", "dataWindow", "x" * 32, "a\0b"])
def test_attribute_names_are_checked(tmp_path: Path, name: str) -> None:
    with pytest.raises(OptionError, match="metadata name"):
        imageio.write_exr(tmp_path / "a.exr", torch.ones(2, 4, 3), metadata={name: "x"})


def test_wrong_shapes_are_not_written(tmp_path: Path) -> None:
    with pytest.raises(ImageError, match="2 x height"):
        imageio.write_exr(tmp_path / "a.exr", torch.ones(4, 4, 3), metadata={})


def write_channels(path: Path, **channels: np.ndarray) -> Path:
    OpenEXR.File({"type": OpenEXR.scanlineimage}, channels).write(str(path))
    return path


def test_maps_with_other_channels_beside_rgb_are_read(tmp_path: Path) -> None:
    plane = np.ones((2, 4), np.float32)
    path = write_channels(tmp_path / "a.exr", R=plane, G=plane * 2, B=plane * 3, A=plane, Z=plane * 9)
    assert torch.equal(imageio.read_envmap(path), torch.tensor([1.0, 2, 3]).expand(1, 2, 4, 3))
    path = write_channels(path, RGBA=np.full((2, 4, 4), 2, np.float16))
    assert torch.equal(imageio.read_envmap(path), torch.full((1, 2, 4, 3), 2.0))


def test_maps_that_cannot_be_used_say_why(tmp_path: Path) -> None:
    plane = np.ones((2, 4), np.float32)
    with pytest.raises(ImageError, match="channels Y; R, G and B"):
        imageio.read_envmap(write_channels(tmp_path / "a.exr", Y=plane))
    with pytest.raises(ImageError, match="4 x 4 pixels; a latlong map is twice"):
        imageio.read_envmap(write_channels(tmp_path / "a.exr", RGB=np.ones((4, 4, 3), np.float32)))
    (tmp_path / "a.exr").write_bytes(b"GIF89a")
    with pytest.raises(ImageError, match="neither an EXR nor"):
        imageio.read_envmap(tmp_path / "a.exr")
    with pytest.raises(ImageError, match="No such file"):
        imageio.read_envmap(tmp_path / "gone.exr")
    with pytest.raises(ImageError, match="directory"):
        imageio.read_envmap(tmp_path)


def test_declared_size_is_checked_before_it_is_allocated(tmp_path: Path) -> None:
    path = imageio.write_exr(tmp_path / "a.exr", torch.ones(2, 4, 3), metadata={})
    window = struct.pack("<4i", 0, 0, 3, 1)
    huge = struct.pack("<4i", 0, 0, 2 * 10**6 - 1, 10**6 - 1)
    path.write_bytes(path.read_bytes().replace(window, huge))
    with pytest.raises(ImageError):
        imageio.read_envmap(path)
    (tmp_path / "a.hdr").write_bytes(b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 1000000 +X 2000000\n")
    with pytest.raises(ImageError, match="up to 8192 rows"):
        imageio.read_envmap(tmp_path / "a.hdr")


@pytest.mark.parametrize("share", [0.1, 0.5, 0.9, 0.999])
@pytest.mark.parametrize("name", ["a.exr", "a.hdr"])
def test_truncated_maps_are_refused(tmp_path: Path, generator: torch.Generator, name: str, share: float) -> None:
    path, radiance = tmp_path / name, random_map(generator, 16)
    imageio.write_hdr(path, radiance) if name == "a.hdr" else imageio.write_exr(path, radiance, metadata={})
    path.write_bytes(path.read_bytes()[: int(path.stat().st_size * share)])
    with pytest.raises(ImageError, match=name):
        imageio.read_envmap(path)


# --- Radiance ---


@given(
    height=st.integers(1, 8),
    seed=st.integers(0, 2**16),
    spread=st.floats(0, 8),
    run=st.integers(1, 20),
)
def test_radiance_round_trip(
    tmp_path_factory: pytest.TempPathFactory, height: int, seed: int, spread: float, run: int
) -> None:
    """Flat and run-length encoded widths, long runs and none: each channel within 1/256 of the pixel's largest."""
    noise = torch.randn(height, 2 * height, 3, generator=torch.Generator().manual_seed(seed))
    radiance = torch.exp(noise * spread).repeat_interleave(run, 0).repeat_interleave(run, 1)
    path = imageio.write_hdr(tmp_path_factory.mktemp("hdr") / "a.hdr", radiance)
    back = imageio.read_envmap(path)[0]
    largest = radiance.amax(-1, keepdim=True)
    # Mantissas are 128 to 255 and round to the nearest: half a step in 128, and a rounding of float32 itself.
    assert ((back - radiance).abs() <= largest * (0.5 / 128 + 1e-6)).all()


def test_radiance_known_pixels(tmp_path: Path) -> None:
    """White is mantissa 128, exponent 129: 128 * 2^(129 - 136) = 1 (Ward 1991)."""
    imageio.write_hdr(tmp_path / "a.hdr", torch.tensor([[[1.0, 0.5, 0.25], [0, 0, 0]]]))
    assert (tmp_path / "a.hdr").read_bytes().endswith(b"-Y 1 +X 2\n" + bytes((128, 64, 32, 129, 0, 0, 0, 0)))


def test_radiance_rounding_up_to_the_next_exponent(tmp_path: Path) -> None:
    almost = torch.full((1, 2, 3), 1 - 2**-12)
    assert_close(imageio.read_envmap(imageio.write_hdr(tmp_path / "a.hdr", almost)), 1.0)


def test_radiance_energy(tmp_path: Path, generator: torch.Generator) -> None:
    radiance = random_map(generator, 64)
    back = imageio.read_envmap(imageio.write_hdr(tmp_path / "a.hdr", radiance))
    # Rounding errors are unbiased, so energy is kept far better than a pixel.
    torch.testing.assert_close(latlong_energy(back), latlong_energy(radiance[None]), rtol=1e-3, atol=0)


def test_radiance_exposure_is_undone(tmp_path: Path) -> None:
    head = b"#?RADIANCE\nEXPOSURE=2\nEXPOSURE= 4.0\nFORMAT=32-bit_rle_rgbe\n\n-Y 1 +X 2\n"
    (tmp_path / "a.hdr").write_bytes(head + bytes((128, 128, 128, 129)) * 2)
    assert_close(imageio.read_envmap(tmp_path / "a.hdr"), 1 / 8)


def test_radiance_headers_may_end_their_lines_as_on_windows(tmp_path: Path) -> None:
    head = b"#?RADIANCE\r\nEXPOSURE=2\r\nFORMAT=32-bit_rle_rgbe\r\n\r\n-Y 1 +X 2\r\n"
    # The first pixel is a line end itself: no byte of it may be taken for the header's.
    (tmp_path / "a.hdr").write_bytes(head + bytes((13, 10, 13, 129, 128, 128, 128, 129)))
    expected = torch.tensor([[13.0, 10.0, 13.0], [128.0, 128.0, 128.0]]) / 128 / 2
    assert_close(imageio.read_envmap(tmp_path / "a.hdr")[0, 0], expected)


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (b"#?RADIANCE\n", "ends inside its header"),
        (b"#?RADIANCE\nFORMAT=32-bit_rle_xyze\n\n-Y 1 +X 2\n", "XYZE"),
        (b"#?RADIANCE\n\n+Y 1 +X 2\n", "resolution line"),
        (b"#?RADIANCE\n\n-Y 1 +X 2\n" + bytes(7), "7 of 8 bytes"),
        (b"#?RADIANCE\n\n-Y 4 +X 8\n" + bytes((2, 2, 0, 8, 0, 0)), "broken run"),
        (b"#?RADIANCE\n\n-Y 4 +X 8\n" + bytes((2, 2, 0, 8, 137, 0)), "broken run"),
        (b"#?RADIANCE\n\n-Y 1 +X 2\n" + bytes((9, 9, 9, 129, 1, 1, 1, 1)), "before 1991"),
        (b"#?RADIANCE\nEXPOSURE=0\n\n-Y 1 +X 2\n" + bytes(8), "exposure of 0"),
    ],
)
def test_broken_radiance_pictures_say_why(tmp_path: Path, data: bytes, reason: str) -> None:
    (tmp_path / "a.hdr").write_bytes(data)
    with pytest.raises(ImageError, match=rf"a\.hdr: .*{reason}"):
        imageio.read_envmap(tmp_path / "a.hdr")


# --- writing in general ---


def test_png_rounds_and_clips(tmp_path: Path) -> None:
    path = imageio.write_png(tmp_path / "a.png", torch.tensor([[[0.0, 0.5, 1.0], [-3, 7, 100.4 / 255]]]))
    assert np.array(PILImage.open(path)).tolist() == [[[0, 128, 255], [0, 255, 100]]]
    with pytest.raises(ImageError, match="NaN"):
        imageio.write_png(path, torch.full((1, 1, 3), float("nan")))


def test_preview_puts_the_99th_percentile_at_nine_tenths() -> None:
    ramp = torch.linspace(0, 50, 1000).reshape(10, 100, 1).expand(10, 100, 3)
    shown = imageio.tone_map_preview(ramp)
    level = shown.flatten().sort().values[int(0.99 * shown.numel()) - 1]
    assert_close(level, 0.9)
    assert shown.max() <= 1


def fail_half_way(target: Path, stop: type[BaseException]) -> None:
    with imageio.atomic(target) as temporary:
        assert temporary.parent == target.parent
        assert temporary.suffix == target.suffix
        temporary.write_text("half")
        raise stop


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_a_failure_leaves_the_old_file_and_nothing_else(tmp_path: Path) -> None:
    target = tmp_path / "a.txt"
    target.write_text("old")
    for stop in (ValueError, KeyboardInterrupt):
        with pytest.raises(stop):
            fail_half_way(target, stop)
        assert target.read_text() == "old"
        assert names(tmp_path) == ["a.txt"]
    with imageio.atomic(target) as temporary:
        temporary.write_text("new")
    assert target.read_text() == "new"
    assert names(tmp_path) == ["a.txt"]


def unwritable_places(folder: Path) -> list[Path]:
    (folder / "file").write_text("")
    (folder / "folder.exr").mkdir()
    return [folder / "gone" / "a.exr", folder / "file" / "a.exr", folder / "folder.exr", folder / ("x" * 300 + ".exr")]


def test_places_that_cannot_be_written_are_named(tmp_path: Path) -> None:
    for place in unwritable_places(tmp_path):
        before = names(tmp_path)
        with pytest.raises(OutputError) as caught:
            imageio.require_writable(place)
        assert str(place) in str(caught.value)
        with pytest.raises(OutputError):
            imageio.write_exr(place, torch.ones(2, 4, 3), metadata={})
        with pytest.raises(OutputError):
            imageio.write_png(place, torch.ones(2, 4, 3))
        assert names(tmp_path) == before


@pytest.mark.skipif(os.name == "nt" or os.geteuid() == 0, reason="root writes everywhere")
def test_a_folder_without_permission(tmp_path: Path) -> None:
    tmp_path.chmod(0o500)
    with pytest.raises(OutputError, match="Permission denied"):
        imageio.require_writable(tmp_path / "a.exr")


def test_a_writable_place_is_left_untouched(tmp_path: Path) -> None:
    imageio.require_writable(tmp_path / "a.exr")
    assert names(tmp_path) == []
