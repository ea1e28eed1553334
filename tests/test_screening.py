"""Panoramas to train on: found, sorted out with a reason, and each scene only once."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
import torch.nn.functional as F
from hypothesis import given
from hypothesis import strategies as st

from dl_core.bench.blender_maps import environment
from dl_core.errors import OptionError
from dl_core.geometry import camera_rotation, rotate_latlong
from dl_core.imageio import write_exr, write_hdr
from dl_core.training.data.duplicates import ALIKE, find_duplicates, likeness, signature
from dl_core.training.data.screening import screen, unfit
from dl_core.training.panoramas import find_panoramas, reduce_panorama
from dl_core.training.scenes.procedural import draw_panorama

SHIPPED = ("apartment", "dancing_hall", "drachenfels_cellar", "kloppenheim_05", "narrow_moonlit_road")


def shipped(name: str) -> torch.Tensor:
    return torch.from_numpy(environment(name, 128))[None]


def alike(one: torch.Tensor, other: torch.Tensor) -> float:
    return float(likeness(signature(one), signature(other)[None]))


def noisy(latlong: torch.Tensor) -> torch.Tensor:
    return latlong * torch.exp(0.1 * torch.randn(latlong.shape, generator=torch.Generator().manual_seed(1)))


SAME: dict[str, Callable[[torch.Tensor], torch.Tensor]] = {
    "rescaled": lambda latlong: reduce_panorama(latlong, 70),
    "enlarged": lambda latlong: F.interpolate(latlong.permute(0, 3, 1, 2), scale_factor=2).permute(0, 2, 3, 1),
    "exposed anew": lambda latlong: latlong * 0.01,
    "noisy": noisy,
    "turned": lambda latlong: rotate_latlong(latlong, camera_rotation(yaw=33.3)),
    "all at once": lambda latlong: noisy(reduce_panorama(rotate_latlong(latlong, camera_rotation(yaw=200)), 70)) * 30,
}


@pytest.mark.parametrize("change", SAME)
@pytest.mark.parametrize("name", SHIPPED)
def test_the_same_panorama_is_found_again(name: str, change: str) -> None:
    assert alike(shipped(name), SAME[change](shipped(name))) > ALIKE


@given(columns=st.integers(1, 255), name=st.sampled_from(SHIPPED))
def test_any_turn_is_found(columns: int, name: str) -> None:
    assert alike(shipped(name), torch.roll(shipped(name), columns, dims=2)) > ALIKE


def test_different_panoramas_are_not_the_same() -> None:
    signatures = {name: signature(shipped(name)) for name in SHIPPED}
    assert find_duplicates(signatures) == {}
    # A mirrored scene is no turned one, unless it is symmetrical.
    assert alike(shipped("apartment"), shipped("apartment").flip(2)) < ALIKE


def test_each_duplicate_names_the_one_that_is_kept() -> None:
    maps = {
        "first": shipped("apartment"),
        "other": shipped("dancing_hall"),
        "again": shipped("apartment").roll(9, 2),
        "and again": shipped("apartment") * 4,
    }
    found = find_duplicates({name: signature(latlong) for name, latlong in maps.items()})
    assert found == {"again": "first", "and again": "first"}


def test_maps_without_features_are_alike_and_unlike_others() -> None:
    even, dim = torch.full((1, 64, 128, 3), 2.0), torch.full((1, 128, 256, 3), 0.3)
    assert alike(even, dim) > ALIKE
    assert alike(even, shipped("apartment")) < 0.5
    black = torch.zeros(1, 64, 128, 3)
    assert alike(black, black) > ALIKE


def test_the_largest_of_the_same_maps_is_kept(tmp_path: Path) -> None:
    write_exr(tmp_path / "a_small.exr", reduce_panorama(shipped("apartment"), 64)[0], metadata={})
    write_exr(tmp_path / "b_large.exr", shipped("apartment")[0], metadata={})
    said: list[str] = []
    found = screen(find_panoramas([tmp_path], None), said.append)
    assert found.used == {"b_large.exr": 128}
    assert found.duplicates == {"a_small.exr": "b_large.exr"}
    assert said == ["left out a_small.exr: shows what b_large.exr shows"]


# --- what is not fit -----------------------------------------------------------------------------------------------


def bright(rows: int) -> torch.Tensor:
    return draw_panorama(1, 64).repeat_interleave(2, 1).repeat_interleave(2, 2)[:, :rows, : 2 * rows] * 10


def with_value(value: float) -> torch.Tensor:
    pixels = bright(64)[0].clone()
    pixels[3, 5, 1] = value
    return pixels


def write_raw(path: Path, pixels: torch.Tensor) -> None:
    """An EXR of anything, past the checks of this package's own writer."""
    import OpenEXR

    header = {"type": OpenEXR.scanlineimage, "compression": OpenEXR.ZIP_COMPRESSION}
    OpenEXR.File(header, {"RGB": pixels.contiguous().numpy()}).write(str(path))


@pytest.mark.parametrize(
    ("make", "reason"),
    [
        (
            lambda path: write_exr(path, bright(64)[0] / bright(64).max(), metadata={}),
            "its values end at 1, display white",
        ),
        (lambda path: write_exr(path, (bright(64)[0] * 9).clamp(max=255).round(), metadata={}), "8-bit codes"),
        (lambda path: write_exr(path, bright(32)[0], metadata={}), "has 32 rows; 64 or more"),
        (lambda path: write_raw(path, with_value(float("nan"))), "holds 1 NaN values, the first at row 3, column 5"),
        (lambda path: write_raw(path, with_value(-1e6)), "holds 1 negative values"),
        (lambda path: write_raw(path, bright(64)[0, :, :100]), "is 100 x 64 pixels; a latlong map is twice as wide"),
        (lambda path: path.write_bytes(b"nothing of the kind"), "is neither an EXR nor a Radiance"),
        (lambda path: path.write_bytes(struct.pack("<II", 20000630, 2) + b"comp"), "is truncated"),
        (lambda path: path.mkdir(), "cannot be read"),
    ],
)
def test_what_is_not_fit_is_skipped_with_its_reason(
    tmp_path: Path, make: Callable[[Path], object], reason: str
) -> None:
    write_hdr(tmp_path / "good.HDR", bright(64)[0])
    make(tmp_path / "bad.exr")
    said: list[str] = []
    found = screen(find_panoramas([tmp_path], None), said.append)
    assert list(found.used) == ["good.HDR"]
    assert reason in found.skipped["bad.exr"]
    assert said == [f"skipped bad.exr: {found.skipped['bad.exr']}"]


@given(st.floats(1.001, 1e4))
def test_what_is_brighter_than_white_is_hdr(highest: float) -> None:
    latlong = bright(64) / bright(64).max() * highest
    assert unfit(latlong) is None


# --- where they are ------------------------------------------------------------------------------------------------


def test_a_manifest_decides_which_files_count(tmp_path: Path) -> None:
    for name in ("a.exr", "b.exr", "c.exr"):
        (tmp_path / name).touch()
    assert list(find_panoramas([tmp_path], None)) == ["a.exr", "b.exr", "c.exr"]
    entries = [{"file": "b.exr", "split": "training"}, {"file": "a.exr", "split": "validation"}]
    (tmp_path / "manifest.json").write_text(json.dumps(entries))
    assert list(find_panoramas([tmp_path], None)) == ["b.exr"]
    assert list(find_panoramas([tmp_path], "validation")) == ["a.exr"]
    for broken in ("{", "[1]", '[{"file": "a.exr"}]'):
        (tmp_path / "manifest.json").write_text(broken)
        with pytest.raises(OptionError, match=r"manifest is .* a JSON list"):
            find_panoramas([tmp_path], None)


def test_files_of_one_name_keep_as_much_of_their_path_as_they_need(tmp_path: Path) -> None:
    for folder in ("x/night", "y/night", "day"):
        (tmp_path / folder).mkdir(parents=True)
        (tmp_path / folder / "sky.hdr").touch()
    (tmp_path / "day" / "sea.exr").touch()
    folders = [tmp_path / name for name in ("x/night", "y/night", "day", "day")]
    assert list(find_panoramas(folders, None)) == ["day/sky.hdr", "sea.exr", "x/night/sky.hdr", "y/night/sky.hdr"]


def test_folders_without_maps_are_refused(tmp_path: Path) -> None:
    with pytest.raises(OptionError, match="this one holds none"):
        find_panoramas([tmp_path], None)
    with pytest.raises(OptionError, match=r"a folder of \.exr or \.hdr maps"):
        find_panoramas([tmp_path / "missing"], None)
    (tmp_path / "a.exr").touch()
    with pytest.raises(OptionError, match=r"manifest\.json"):
        find_panoramas([tmp_path], "training")
