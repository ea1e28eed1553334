"""Medians as training pairs: true to the painter and the photograph, kept, and painted once."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from analytic_painter import AnalyticPainter, Flaws
from PIL import Image as PILImage
from torch import Tensor

from dl_core.backends.diffusers_lora import add_lora
from dl_core.backends.loading import LoadedPainter
from dl_core.backends.mini import load_mini, read_weights
from dl_core.ball import crop_ball, disc_mask, fit_canvas
from dl_core.cli import main
from dl_core.errors import ImageError, OptionError
from dl_core.exposure import expose
from dl_core.imageio import read_photograph
from dl_core.iterative import Rounds
from dl_core.training.data.pairs import PairShards
from dl_core.training.lora.base import LoraBase
from dl_core.training.turbo.median_pairs import MedianPainting, paint_medians

CANVAS, DIAMETER = 64, 32
PAINTING = MedianPainting(Rounds(balls=9, rounds=2, steps=4, final=False), (0.0, -2.5), 3, {"--model": "a"})


@pytest.fixture
def photographs(tmp_path: Path) -> Path:
    folder = tmp_path / "photographs"
    folder.mkdir()
    generator = torch.Generator().manual_seed(1)
    for name, (height, width) in {"a.png": (48, 64), "b.png": (64, 40)}.items():
        codes = (torch.rand(height, width, 3, generator=generator) * 255).to(torch.uint8)
        PILImage.fromarray(codes.numpy()).save(folder / name)
    (folder / "notes.txt").write_text("no photograph")
    return folder


def paint(
    photographs: Path, painter: AnalyticPainter, painting: MedianPainting = PAINTING
) -> tuple[PairShards, list[str]]:
    said: list[str] = []
    loaded = LoadedPainter(painter, CANVAS, DIAMETER)
    out = photographs.parent / "medians"
    return paint_medians(photographs, lambda: loaded, painting, out, report=said.append), said


def test_a_pair_is_the_photograph_with_the_median_of_its_exposure(photographs: Path, smooth_map: Tensor) -> None:
    painter = AnalyticPainter(smooth_map, Flaws(noise=0.02))
    pairs, said = paint(photographs, painter)
    assert [(pairs[i].panorama, pairs[i].ev) for i in range(len(pairs))] == [
        ("a.png", 0.0),
        ("a.png", -2.5),
        ("b.png", 0.0),
        ("b.png", -2.5),
    ]
    assert any("notes.txt is left out" in line for line in said)
    for i in range(len(pairs)):
        pair = pairs[i]
        photograph = fit_canvas(read_photograph(photographs / pair.panorama), CANVAS)
        off = disc_mask(pair.ball)[0] == 0
        assert ((pair.image - photograph)[0, off].abs() <= 0.5 / 255 + 1e-6).all()
        true = expose(painter._true_ball(DIAMETER, 0.0), pair.ev)
        inside = crop_ball(disc_mask(pair.ball)[..., None], pair.ball)[0, ..., 0] == 1
        error = (crop_ball(pair.image, pair.ball) - true)[0, inside]
        # The median of nine draws of deviation 0.02 has about 0.02 * 1.25 / 3 = 0.008, with rounding a little more.
        assert error.square().mean().sqrt() < 0.012
    assert {request.ev for request in painter.requests} == {0.0, -2.5}


def test_what_is_there_is_not_painted_again(photographs: Path, smooth_map: Tensor) -> None:
    first, _ = paint(photographs, AnalyticPainter(smooth_map))
    before = [first[i].image for i in range(len(first))]
    out = photographs.parent / "medians"
    (out / "training-000002.tar").unlink()
    (out / ".training-000002.0123abcd.tar").write_bytes(b"half")  # as a killed run leaves it
    painter = AnalyticPainter(smooth_map)
    again, said = paint(photographs, painter)
    assert len(painter.requests) == PAINTING.rounds.rounds  # of the one that was missing
    assert said[-1] == "median 3 of 4: b.png at EV 0"
    assert not list(out.glob(".training*"))
    assert all(torch.equal(again[i].image, before[i]) for i in range(len(again)))
    with_all = AnalyticPainter(smooth_map)
    paint(photographs, with_all)
    assert not with_all.requests


def test_medians_painted_otherwise_are_refused(photographs: Path, smooth_map: Tensor) -> None:
    painter = AnalyticPainter(smooth_map)
    paint(photographs, painter)
    for changed, named in (
        ({"seed": 4}, "--seed is 4.*accepted: 3"),
        ({"made_with": {"--model": "b"}}, "--model is 'b'"),
        ({"evs": (0.0, -5.0)}, "evs is"),
    ):
        with pytest.raises(OptionError, match=named):
            paint(photographs, painter, replace(PAINTING, **changed))
    (photographs / "b.png").unlink()
    with pytest.raises(OptionError, match="photographs is"):
        paint(photographs, painter)


def test_a_folder_without_photographs_is_refused(tmp_path: Path, smooth_map: Tensor) -> None:
    folder = tmp_path / "photographs"
    folder.mkdir()
    (folder / "notes.txt").write_text("no photograph")
    with pytest.raises(ImageError, match="no photograph"):
        paint(folder, AnalyticPainter(smooth_map))


def test_from_photographs_to_a_lora(photographs: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """With the mini model, which loads what comes out into its UNet."""
    (photographs / "b.png").unlink()
    out = photographs.parent / "turbo.safetensors"
    words = ["train", "turbo", "--model", "mini", "--photographs", str(photographs), "--preset", "draft"]
    words += ["--work", str(photographs.parent / "work"), "--out", str(out), "--steps", "2", "--batch", "2"]
    assert main(words) == 0
    said = capsys.readouterr()
    assert "median 3 of 3: a.png at EV -5" in said.err
    assert f"wrote {out}" in said.out
    pipeline = LoraBase.from_mini(load_mini()).pipeline
    add_lora(pipeline, read_weights(out), "turbo", out)
    assert pipeline.get_active_adapters() == ["turbo"]
    assert main([*words, "--preset", "turbo"]) == 2
    assert "--preset is 'turbo'" in capsys.readouterr().err
