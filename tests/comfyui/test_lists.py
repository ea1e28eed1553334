"""BallGrid and LoadPhotoFolder: lists that the nodes behind them run over."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from comfy_host import pack_module
from PIL import Image as PILImage

Nodes = Callable[[str], Any]
GRID = {"canvas": 256, "diameter": 64, "rows": 3, "columns": 2, "margin": -1}


def errors() -> Any:
    return pack_module("dl_core.errors")


# --- BallGrid ----------------------------------------------------------------------------------------------------


def test_places_are_the_librarys(node: Nodes) -> None:
    across, down, names = node("BallGrid").execute(**GRID).args
    places = pack_module("dl_core.ball_grid").ball_grid(256, 64, 3, 2)
    assert [*zip(across, down, names, strict=True)] == [(place.x, place.y, place.name) for place in places]
    assert (across[0], down[0]) == (34, 34)  # half of 64, and 2 of dilation


def test_with_a_photograph_places_lie_on_it(node: Nodes) -> None:
    """40 x 20 pixels fill the middle half of the canvas."""
    _, down, _ = node("BallGrid").execute(**GRID, image=torch.rand(1, 20, 40, 1)).args
    assert (min(down), max(down)) == (64 + 34, 192 - 34)
    _, down, _ = node("BallGrid").execute(**(GRID | {"margin": 10}), image=torch.rand(1, 20, 40, 3)).args
    assert (min(down), max(down)) == (64 + 42, 192 - 42)


def test_every_place_is_one_that_depth_ball_mask_takes(node: Nodes) -> None:
    across, down, _ = node("BallGrid").execute(**GRID).args
    for x, y in zip(across, down, strict=True):
        ball = node("DepthBallMask").execute(torch.rand(1, 9, 9, 3), 256, 64, x, y, -1).args[3]
        assert ball.centre == (x, y)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"diameter": 256}, r"diameter is 256; accepted: up to 252 pixels"),
        ({"rows": 0}, r"rows is 0; accepted: 1 to 189"),
        ({"margin": 120}, r"diameter is 64; accepted: up to 16 pixels, so that a ball and 120 pixels around it"),
        ({"image": torch.rand(1, 2, 10, 3)}, r"diameter is 64; accepted: up to 47 pixels.* into 256 x 51 pixels"),
    ],
)
def test_a_grid_that_does_not_fit_is_refused(node: Nodes, change: dict[str, Any], message: str) -> None:
    with pytest.raises(errors().OptionError, match=message):
        node("BallGrid").execute(**(GRID | change))


# --- LoadPhotoFolder ---------------------------------------------------------------------------------------------


@pytest.fixture
def photographs(folders: Path) -> Path:
    """Two photographs and a text in a folder of ComfyUI's input folder."""
    folder = folders / "input" / "holiday"
    folder.mkdir()
    PILImage.new("RGB", (8, 6), (255, 0, 0)).save(folder / "b.png")
    exif = PILImage.Exif()
    exif[0x0112] = 8  # held on its other side
    PILImage.new("RGB", (8, 6), (0, 0, 255)).save(folder / "a.png", exif=exif)
    (folder / "list.txt").write_text("a, b")
    return folder


@pytest.mark.parametrize("absolute", [False, True])
def test_photographs_and_names_are_lists(node: Nodes, photographs: Path, absolute: bool) -> None:
    images, names, report = node("LoadPhotoFolder").execute(str(photographs) if absolute else " holiday ", 1024).args
    assert names == ["a", "b"]
    assert [tuple(image.shape) for image in images] == [(1, 8, 6, 3), (1, 6, 8, 3)]
    assert images[0][0, 0, 0].tolist() == [0, 0, 1]
    lines = report.splitlines()
    assert lines[0] == f"2 photographs in {photographs}."
    assert lines[1].startswith("Left out: list.txt cannot be read as a photograph")
    assert len(lines) == 2


def test_the_input_folder_itself_is_a_dot(node: Nodes, photographs: Path) -> None:
    PILImage.new("RGB", (8, 6)).save(photographs.parent / "c.png")
    assert node("LoadPhotoFolder").execute(".", 1024).args[1] == ["c"]


def test_large_photographs_are_reduced_while_they_are_read(node: Nodes, photographs: Path) -> None:
    PILImage.new("RGB", (900, 400)).save(photographs / "large.png")
    images, _, _ = node("LoadPhotoFolder").execute("holiday", 128).args
    assert images[-1].shape == (1, 58, 129, 3)


@pytest.mark.parametrize(
    "name", ["..", "../elsewhere", "holiday/../../elsewhere", "", "  ", "holiday/../../input_of_another"]
)
def test_a_relative_folder_does_not_leave_the_input_folder(node: Nodes, photographs: Path, name: str) -> None:
    for place in ("elsewhere", "input_of_another"):
        (photographs.parent.parent / place).mkdir()
        PILImage.new("RGB", (8, 6)).save(photographs.parent.parent / place / "secret.png")
    kind = node("LoadPhotoFolder")
    with pytest.raises(errors().OptionError, match=r"folder is .*inside ComfyUI's input folder .* or an absolute path"):
        kind.execute(name, 1024)
    assert "LoadPhotoFolder, folder is" in kind.validate_inputs(name)


@pytest.mark.skipif(os.name == "nt", reason="links take a privilege there")
def test_a_link_does_not_lead_out_of_the_input_folder(node: Nodes, photographs: Path, tmp_path: Path) -> None:
    (tmp_path / "elsewhere").mkdir()
    PILImage.new("RGB", (8, 6)).save(tmp_path / "elsewhere" / "secret.png")
    (photographs / "link").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(errors().OptionError, match="folder is 'holiday/link'"):
        node("LoadPhotoFolder").execute("holiday/link", 1024)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("gone", "there is no such folder"),
        ("holiday/b.png", "is no folder"),
        ("empty", "holds no files"),
    ],
)
def test_folders_that_give_nothing_are_refused_before_the_graph_runs(
    node: Nodes, photographs: Path, name: str, message: str
) -> None:
    (photographs.parent / "empty").mkdir()
    kind = node("LoadPhotoFolder")
    with pytest.raises(errors().ImageError, match=message):
        kind.execute(name, 1024)
    answer = kind.validate_inputs(name)
    assert answer.startswith("LoadPhotoFolder, ")
    assert message in answer
    assert kind.validate_inputs("holiday") is True
    assert kind.validate_inputs(None) is True  # named by another node


def test_a_folder_without_photographs_is_refused(node: Nodes, folders: Path) -> None:
    (folders / "input" / "texts").mkdir()
    (folders / "input" / "texts" / "a.txt").write_text("no photograph")
    with pytest.raises(errors().ImageError, match=r"texts: holds no photograph; a\.txt"):
        node("LoadPhotoFolder").execute("texts", 1024)


def test_a_folder_that_changed_is_read_again(node: Nodes, photographs: Path) -> None:
    kind = node("LoadPhotoFolder")
    before = kind.fingerprint_inputs("holiday", 1024)
    assert kind.fingerprint_inputs(str(photographs), 1024) == before
    PILImage.new("RGB", (8, 6)).save(photographs / "c.png")
    assert kind.fingerprint_inputs("holiday", 1024) != before
    unknown = kind.fingerprint_inputs(None, 1024)  # named by another node
    assert unknown != unknown


def test_progress_counts_files_and_an_interrupt_stops_it(
    node: Nodes, photographs: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import comfy.utils

    calls: list[tuple[float, float]] = []
    monkeypatch.setattr(
        comfy.utils, "PROGRESS_BAR_HOOK", lambda value, total, preview, node_id=None: calls.append((value, total))
    )
    node("LoadPhotoFolder").execute("holiday", 1024)
    assert calls == [(1, 3), (2, 3), (3, 3)]
