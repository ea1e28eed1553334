"""`bench metrics`: a pair of pictures, its mask, and what is refused."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
import torch

from dl_core.bench import pairs
from dl_core.errors import ImageError
from dl_core.picture_errors import CONVENTIONS, picture_errors


def write(path: Path, **channels: np.ndarray) -> Path:
    OpenEXR.File({"type": OpenEXR.scanlineimage}, channels).write(str(path))
    return path


@pytest.fixture
def pair(tmp_path: Path) -> tuple[Path, Path]:
    pixels = np.random.default_rng(2).random((2, 6, 9, 4)).astype(np.float32)
    pixels[..., 3] = np.where(pixels[0, ..., 3] > 0.5, pixels[0, ..., 3], 0)
    return write(tmp_path / "predicted.exr", RGBA=pixels[0]), write(tmp_path / "truth.exr", RGBA=pixels[1])


def run(capsys: pytest.CaptureFixture[str], *options: object) -> str:
    parser = argparse.ArgumentParser()
    pairs.add_arguments(parser)
    assert not pairs.run(parser.parse_args([str(option) for option in options]))
    return capsys.readouterr().out


@pytest.mark.parametrize("convention", CONVENTIONS)
def test_json_has_the_errors_under_the_alpha_of_the_truth(
    pair: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str], convention: str
) -> None:
    options = ("--pred", pair[0], "--truth", pair[1], "--convention", convention, "--json", "--out", tmp_path / "out")
    result = json.loads(run(capsys, *options))
    planes = [OpenEXR.File(str(path)).channels()["RGBA"].pixels for path in pair]
    predicted, truth = (torch.from_numpy(plane[..., :3].copy()) for plane in planes)
    expected = picture_errors(predicted, truth, torch.from_numpy(planes[1][..., 3] > 0), convention)
    for name in ("rmse", "si_rmse", "angular_error_deg", "normalized_rmse"):
        assert result[name] == result["rows"][0][name] == getattr(expected, name)
    assert result["mask_pixels"] == int((planes[1][..., 3] > 0).sum())
    assert (result["convention"], result["protocol"]["convention"]) == (convention, convention)
    assert json.loads((tmp_path / "out" / "report.json").read_text(encoding="utf-8")) == result
    assert str(tmp_path) not in json.dumps(result)


def test_a_table_is_printed_for_people(pair: tuple[Path, Path], capsys: pytest.CaptureFixture[str]) -> None:
    printed = run(capsys, "--pred", pair[0], "--truth", pair[1])
    assert "si-RMSE" in printed
    assert "alpha of the truth" in printed


def test_without_alpha_the_whole_frame_counts(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = write(tmp_path / "a.exr", RGB=np.ones((4, 5, 3), np.float32))
    result = json.loads(run(capsys, "--pred", path, "--truth", path, "--json"))
    assert (result["mask"], result["mask_pixels"], result["pixels"]) == ("whole frame", 20, 20)
    assert result["si_rmse"] == 0


def test_pairs_that_do_not_match_say_how(pair: tuple[Path, Path], tmp_path: Path) -> None:
    small = write(tmp_path / "small.exr", RGB=np.ones((4, 5, 3), np.float32))
    with pytest.raises(ImageError, match=r"small\.exr: is 5 x 4 pixels, truth\.exr 9 x 6"):
        pairs.score(small, pair[1], "radiance")
    hidden = write(tmp_path / "hidden.exr", RGBA=np.zeros((6, 9, 4), np.float32))
    with pytest.raises(ImageError, match=r"hidden\.exr: is transparent throughout"):
        pairs.score(pair[0], hidden, "radiance")
