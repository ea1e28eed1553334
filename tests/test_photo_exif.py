"""Field of view from EXIF data: exact where they tell it, None where they do not, remarks where they contradict."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest
from PIL import ExifTags, Image
from PIL.TiffImagePlugin import IFDRational

from dl_core.errors import ImageError
from dl_core.photo_exif import CameraData, choose_fov, read_camera

BASE = ExifTags.Base


def photograph(
    folder: Path, tags: dict[int, Any], size: tuple[int, int] = (60, 40), orientation: int = 1, suffix: str = ".jpg"
) -> Path:
    picture, exif = Image.new("RGB", size), Image.Exif()
    exif[BASE.Orientation] = orientation
    exif.get_ifd(ExifTags.IFD.Exif).update(tags)
    path = folder / f"photo{suffix}"
    picture.save(path, exif=exif)
    return path


def sensor(focal: float, width_mm: float, pixels: tuple[int, int] = (6000, 4000), unit: int = 3) -> dict[int, Any]:
    """Tags of a sensor so wide, with square pixels."""
    millimetres = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}[unit]
    resolution = IFDRational(round(pixels[0] / width_mm * millimetres * 1000), 1000)
    return {
        BASE.FocalLength: IFDRational(round(focal * 100), 100),
        BASE.FocalPlaneXResolution: resolution,
        BASE.FocalPlaneYResolution: resolution,
        BASE.FocalPlaneResolutionUnit: unit,
        BASE.ExifImageWidth: pixels[0],
        BASE.ExifImageHeight: pixels[1],
    }


def across(focal: float, side: float = 36.0) -> float:
    return math.degrees(2 * math.atan(side / 2 / focal))


@pytest.mark.parametrize("focal", [14, 24, 50, 200])
@pytest.mark.parametrize("suffix", [".jpg", ".png", ".webp"])
def test_a_film_camera_of_3_to_2_has_36_millimetres(tmp_path: Path, focal: int, suffix: str) -> None:
    path = photograph(tmp_path, {BASE.FocalLengthIn35mmFilm: focal}, suffix=suffix)
    assert read_camera(path).fov == pytest.approx(across(focal), abs=1e-6)


def test_another_aspect_has_the_same_diagonal(tmp_path: Path) -> None:
    fov = read_camera(photograph(tmp_path, {BASE.FocalLengthIn35mmFilm: 28}, (80, 60))).fov
    assert fov == pytest.approx(across(28, math.hypot(36, 24) * 0.8))


@pytest.mark.parametrize("orientation", [1, 6, 8])
def test_the_longer_side_stays_the_longer_side(tmp_path: Path, orientation: int) -> None:
    tags = {BASE.FocalLengthIn35mmFilm: 35}
    assert read_camera(photograph(tmp_path, tags, (40, 60), orientation)).fov == pytest.approx(across(35))


@pytest.mark.parametrize("unit", [2, 3, 4])
def test_the_sensor_counts_where_there_is_no_film_length(tmp_path: Path, unit: int) -> None:
    camera = read_camera(photograph(tmp_path, sensor(23.0, 23.5, unit=unit)))
    assert camera.fov == pytest.approx(across(23.0, 23.5), rel=1e-3)
    assert camera.remarks == ()


@pytest.mark.parametrize(
    "tags",
    [
        {},
        {BASE.FocalLengthIn35mmFilm: 0},
        {BASE.FocalLength: IFDRational(50, 1)},
        {BASE.FocalLength: IFDRational(0, 0), BASE.FocalPlaneXResolution: IFDRational(1, 0)},
        {**sensor(50, 36), BASE.FocalPlaneResolutionUnit: 9},
    ],
)
def test_what_is_not_told_is_none(tmp_path: Path, tags: dict[int, Any]) -> None:
    assert read_camera(photograph(tmp_path, tags)) == CameraData()


def test_a_photograph_without_exif_has_no_field_of_view(tmp_path: Path) -> None:
    Image.new("RGB", (8, 8)).save(tmp_path / "plain.png")
    assert read_camera(tmp_path / "plain.png") == CameraData()


def test_sources_that_contradict_each_other_are_told_and_film_counts(tmp_path: Path) -> None:
    camera = read_camera(photograph(tmp_path, {**sensor(50, 36), BASE.FocalLengthIn35mmFilm: 75}))
    assert camera.fov == pytest.approx(across(75))
    assert "contradict" in camera.remarks[0]
    agreeing = read_camera(photograph(tmp_path, {**sensor(50, 23.5), BASE.FocalLengthIn35mmFilm: 75}))
    assert agreeing.remarks == ()


def test_a_crop_is_told(tmp_path: Path) -> None:
    tags = {BASE.FocalLengthIn35mmFilm: 50, BASE.ExifImageWidth: 6000, BASE.ExifImageHeight: 4000}
    assert "cropped" in read_camera(photograph(tmp_path, tags, (40, 40))).remarks[0]
    assert read_camera(photograph(tmp_path, tags, (300, 200))).remarks == ()


def test_damaged_exif_is_no_error_but_is_told(tmp_path: Path) -> None:
    path = photograph(tmp_path, {BASE.FocalLengthIn35mmFilm: 50})
    data = path.read_bytes()
    start = data.index(b"Exif\0\0") + 6
    path.write_bytes(data[:start] + b"XXXX" + data[start + 4 :])
    assert read_camera(path).fov is None


def test_no_picture_is_named(tmp_path: Path) -> None:
    (tmp_path / "text.jpg").write_text("no picture")
    for name in ("text.jpg", "missing.jpg"):
        with pytest.raises(ImageError, match=name):
            read_camera(tmp_path / name)


def test_the_given_field_of_view_wins() -> None:
    camera = CameraData(60.0, ("doubtful",))
    assert choose_fov(None, camera) == (60.0, ["field of view by EXIF: 60.0 degrees", "doubtful"])
    assert choose_fov(61.0, camera) == (61.0, [])
    fov, remarks = choose_fov(90.0, camera)
    assert fov == 90.0
    assert "against 60.0" in remarks[0]
    assert choose_fov(None, CameraData()) == (None, [])
    assert choose_fov(45.0, CameraData()) == (45.0, [])
