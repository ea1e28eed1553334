"""A folder of photographs: order, names, what is left out, and when it counts as changed."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
import torch
from PIL import Image as PILImage

from dl_core.errors import ImageError, Interrupted
from dl_core.imageio import read_photograph
from dl_core.photo_folder import folder_files, folder_fingerprint, read_folder

RED, GREEN, BLUE = (255, 0, 0), (0, 255, 0), (0, 0, 255)


def picture(path: Path, colour: tuple[int, int, int], size: tuple[int, int] = (6, 4), **options: object) -> Path:
    PILImage.new("RGB", size, colour).save(path, **options)
    return path


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Three photographs, a text, and a folder with another photograph."""
    picture(tmp_path / "b.png", GREEN)
    picture(tmp_path / "C.webp", BLUE, lossless=True)
    picture(tmp_path / "a.png", RED)
    (tmp_path / "notes.jpg").write_text("bring a chrome ball")
    (tmp_path / "more").mkdir()
    picture(tmp_path / "more" / "d.png", RED)
    return tmp_path


def test_photographs_come_in_the_order_of_their_names(folder: Path) -> None:
    found = read_folder(folder)
    assert found.names == ("a", "b", "C")
    for image, colour in zip(found.images, (RED, GREEN, BLUE), strict=True):
        assert torch.equal(image, torch.tensor(colour).float().div(255).expand(1, 4, 6, 3))
    ((name, reason),) = found.skipped
    assert name == "notes.jpg"
    assert "cannot be read as a photograph" in reason


def test_a_picture_cut_short_does_not_hold_up_the_others(folder: Path) -> None:
    whole = picture(folder / "0.jpg", RED, (64, 64)).read_bytes()
    (folder / "0.jpg").write_bytes(whole[: len(whole) // 2])
    found = read_folder(folder)
    assert found.names == ("a", "b", "C")
    assert [name for name, _ in found.skipped] == ["0.jpg", "notes.jpg"]


def test_photographs_are_turned_upright(tmp_path: Path) -> None:
    exif = PILImage.Exif()
    exif[0x0112] = 6  # the camera was held on its side: the stored top row is the right column
    stored = PILImage.new("RGB", (6, 4), RED)
    stored.paste(BLUE, (0, 0, 6, 1))
    stored.save(tmp_path / "side.png", exif=exif)
    (image,) = read_folder(tmp_path).images
    assert image.shape == (1, 6, 4, 3)
    assert torch.equal(image[0, :, -1], torch.tensor(BLUE).float().div(255).expand(6, 3))
    assert torch.equal(image[0, :, 0], torch.tensor(RED).float().div(255).expand(6, 3))


def test_names_that_two_files_share_keep_their_suffix(tmp_path: Path) -> None:
    for name in ("a.png", "A.bmp", "b.png"):
        picture(tmp_path / name, RED)
    assert read_folder(tmp_path).names == ("A.bmp", "a.png", "b")


@pytest.mark.parametrize(("side", "kept"), [(1023, 1023), (1024, 512), (1600, 534), (2048, 512)])
def test_large_photographs_keep_as_many_pixels_as_asked_for(tmp_path: Path, side: int, kept: int) -> None:
    picture(tmp_path / "large.png", GREEN, (side, 100))
    (image,) = read_folder(tmp_path, kept_side=512).images
    assert image.shape[2] == kept
    assert torch.equal(image, read_photograph(tmp_path / "large.png", kept_side=512))
    assert torch.equal(image, torch.tensor(GREEN).float().div(255).expand_as(image))


def test_it_is_told_of_every_file_and_may_stop(folder: Path) -> None:
    heard = []
    read_folder(folder, on_file=lambda: heard.append(1))
    assert len(heard) == len(folder_files(folder)) == 4

    def stop() -> None:
        raise Interrupted

    with pytest.raises(Interrupted):
        read_folder(folder, on_file=stop)


def test_folders_that_give_nothing_are_refused(tmp_path: Path) -> None:
    (tmp_path / "file.txt").write_text("no folder")
    (tmp_path / "empty" / "sub").mkdir(parents=True)
    (tmp_path / "texts").mkdir()
    (tmp_path / "texts" / "a.txt").write_text("no photograph")
    for name, message in (
        ("gone", "there is no such folder"),
        ("file.txt", "is no folder"),
        ("empty", "holds no files"),
        ("texts", r"holds no photograph; a\.txt cannot be read as a photograph"),
    ):
        with pytest.raises(ImageError, match=message) as raised:
            read_folder(tmp_path / name)
        assert raised.value.source == tmp_path / name


@pytest.mark.skipif(os.name == "nt" or os.geteuid() == 0, reason="root may read anywhere")
def test_a_folder_without_permission_is_refused(folder: Path) -> None:
    folder.chmod(0o100)
    try:
        with pytest.raises(ImageError, match="cannot be read"):
            folder_files(folder)
    finally:
        folder.chmod(0o700)


def test_the_fingerprint_follows_the_files(folder: Path) -> None:
    before = folder_fingerprint(folder)
    picture(folder / "more" / "e.png", RED)  # of a subfolder, which is not read
    assert folder_fingerprint(folder) == before
    seen = {before}
    os.utime(folder / "a.png", (1, 1))
    seen.add(folder_fingerprint(folder))
    (folder / "a.png").rename(folder / "z.png")
    seen.add(folder_fingerprint(folder))
    (folder / "b.png").unlink()
    seen.add(folder_fingerprint(folder))
    picture(folder / "new.png", RED)
    seen.add(folder_fingerprint(folder))
    assert len(seen) == 5
