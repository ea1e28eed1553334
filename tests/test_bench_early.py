"""The sections of `bench early` on painters whose errors are known."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

from dl_core.backends.loading import ModelFiles
from dl_core.bench.early.decoding import DecodingSection
from dl_core.bench.early.latents import LatentsSection, latent_median
from dl_core.bench.early.noise import NoiseSection, rank_correlation, ranks
from dl_core.bench.early.section import Options, Scene, Section, ball_rmse
from dl_core.bench.early.until import UntilSection
from dl_core.bench.painters import PAINTERS, Studio, open_studio
from dl_core.bench.perfect import PerfectPainter
from dl_core.cli import main
from dl_core.errors import OptionError
from dl_core.geometry import latlong_directions
from dl_core.imageio import write_exr
from dl_core.painter import Observer, PaintRequest, PaintResult, SilentObserver

OPTIONS = Options(balls=3, rounds=1, steps=10, strength=0.8, untils=(0.5, 1.0), seeds=8, seed=0)


def light(turn: int) -> Tensor:
    """Brighter upwards and to one side."""
    directions = latlong_directions(32).roll(turn, dims=1)
    return (0.15 + 0.4 * (directions[..., 1:2] + 1) ** 2 * (1.2 + directions[..., :1])).expand(-1, -1, 3)[None]


@pytest.fixture
def panoramas(tmp_path: Path) -> list[Path]:
    folder = tmp_path / "maps"
    folder.mkdir()
    return [write_exr(folder / f"turned_{turn}.exr", light(turn)[0], metadata={}) for turn in (0, 9, 30)]


class Noisy(PerfectPainter):
    """True balls under white noise of a level for each ball."""

    def level(self, request: PaintRequest, seed: int) -> float:
        raise NotImplementedError

    def paint(self, request: PaintRequest, observer: Observer) -> PaintResult:
        result = super().paint(request, observer)
        noise = [
            self.level(request, seed)
            * torch.randn(result.balls.shape[1:], generator=torch.Generator().manual_seed(seed))
            for seed in request.seeds
        ]
        return replace(result, balls=(result.balls + torch.stack(noise)).clamp(0, 1))


class Settling(Noisy):
    """Noisier the earlier it is stopped, and a little noisy in the end."""

    def level(self, request: PaintRequest, seed: int) -> float:
        return 0.02 + 0.2 * (1 - request.until)


class Faithful(Noisy):
    """Each seed is as good everywhere."""

    def level(self, request: PaintRequest, seed: int) -> float:
        return 0.02 * (1 + 3 * seed % 8)


class Fickle(Noisy):
    """A seed is as good as the photograph and chance have it."""

    def level(self, request: PaintRequest, seed: int) -> float:
        drawn = torch.Generator().manual_seed(int(1e4 * request.canvas.sum()) % 1000)
        return 0.02 * (1 + int(torch.randperm(8, generator=drawn)[seed]))


def studio(kind: type[PerfectPainter]) -> Studio:
    return Studio(lambda variant, shot: kind(shot.truth_hdr), 256, 64)


# --- until -------------------------------------------------------------------------------------------------------


def test_cost_and_error_of_medians_that_stop_early(panoramas: list[Path]) -> None:
    section = UntilSection(studio(Settling), OPTIONS)
    rows = section.measure(panoramas[0])
    assert section.each == len(rows) == 4
    found = {(row["until"], row["final"]): row for row in rows}
    assert {key: row["evaluations"] for key, row in found.items()} == {
        (0.5, True): 3 * 2 * (3 * 5 + 8),
        (0.5, False): 3 * 2 * 3 * 5,
        (1.0, True): 3 * 2 * (3 * 10 + 8),
        (1.0, False): 3 * 2 * 3 * 10,
    }
    assert found[0.5, False]["ball_rmse"] > 2 * found[1.0, False]["ball_rmse"]
    assert found[0.5, True]["ball_rmse"] == found[1.0, True]["ball_rmse"]  # the last ball runs to the end
    assert found[0.5, False]["spread"] > 2 * found[1.0, False]["spread"]
    summary = {(line["until"], line["final"]): line["ball_rmse_ratio"] for line in section.summarize(rows)}
    assert summary[1.0, True] == summary[1.0, False] == summary[0.5, True] == 1
    assert summary[0.5, False] > 2


# --- latents -----------------------------------------------------------------------------------------------------


def test_the_median_of_latents_is_taken_by_element() -> None:
    latents = torch.randn(5, 4, 6, 6, generator=torch.Generator().manual_seed(0))
    assert torch.equal(latent_median(latents), latents.median(dim=0, keepdim=True).values)


def test_medians_of_a_single_ball_are_that_ball_both_ways(panoramas: list[Path]) -> None:
    """So the two starts differ by what decoding and encoding loses, and by nothing else."""
    options = replace(OPTIONS, balls=1, steps=2)
    (row,) = LatentsSection(open_studio("mini", ModelFiles()), options).measure(panoramas[0])
    assert row["medians_differ"] == 0
    assert row["latents_differ"] == row["there_and_back"] > 0
    assert row["pixel_median_rmse"] == row["latent_median_rmse"]
    assert row["evaluations"] == 2 * (2 + 3 * 1)
    assert 0 < row["saved"] < row["saved_early"] < 1


@pytest.mark.parametrize("section", [LatentsSection, DecodingSection])
def test_a_painter_without_latents_is_refused(panoramas: list[Path], section: type[Section]) -> None:
    with pytest.raises(OptionError, match="a painter on diffusers"):
        section(studio(PerfectPainter), OPTIONS).measure(panoramas[0])


def test_the_margin_in_use_loses_less_than_half_a_code(panoramas: list[Path]) -> None:
    section = DecodingSection(open_studio("mini", ModelFiles()), OPTIONS)
    rows = section.measure(panoramas[0])
    worst = [row["worst_codes"] for row in rows]
    assert [row["margin"] for row in rows if row["in_use"]] == [4]
    assert worst == sorted(worst, reverse=True)
    assert worst[2] < 0.5 < 1 < worst[0]
    assert section.each == len(rows) == len(section.summarize(rows))


# --- noise -------------------------------------------------------------------------------------------------------


def test_rank_correlation_of_known_rankings() -> None:
    up = ranks(torch.tensor([0.3, 0.1, 0.7, 0.5]))
    assert up.tolist() == [1, 0, 3, 2]
    assert rank_correlation(torch.stack((up, up))) == pytest.approx(1)
    assert rank_correlation(torch.stack((up, 3 - up))) == pytest.approx(-1)
    # One swap of neighbours: 1 - 6 * 2 / (4 * 15).
    assert rank_correlation(torch.stack((up, torch.tensor([0.0, 1, 3, 2])))) == pytest.approx(0.8)


@pytest.mark.parametrize("kind", [Faithful, Fickle])
def test_noise_that_stays_good_is_told_from_noise_that_does_not(panoramas: list[Path], kind: type[Noisy]) -> None:
    section = NoiseSection(studio(kind), OPTIONS)
    rows = [row for path in panoramas for row in section.measure(path)]
    assert len(rows) == section.each * 3
    for line in section.summarize(rows):
        assert line["panoramas"] == 3
        assert 0 < line["by_chance"] < 0.7
        if kind is Faithful:
            assert line["correlation"] > 0.9
            assert line["ratio"] < 0.7
            assert line["better"] == 3
        else:
            assert line["correlation"] < line["by_chance"]
            assert line["ratio"] > 0.7


def test_too_few_seeds_to_choose_from_are_refused() -> None:
    with pytest.raises(OptionError, match="--seeds is 3; accepted: more than the 3"):
        NoiseSection(studio(Faithful), replace(OPTIONS, seeds=3))


# --- command -----------------------------------------------------------------------------------------------------


def test_balls_differ_by_what_lies_inside_the_disc() -> None:
    ball = torch.full((1, 32, 32, 3), 0.5)
    other = ball + 0.25
    other[:, 0, 0] = 9.0
    assert ball_rmse(ball, other) == pytest.approx(0.25, abs=1e-6)


def test_a_scene_holds_the_truth(panoramas: list[Path]) -> None:
    scene = Scene.of(panoramas[0], studio(PerfectPainter))
    painted = PerfectPainter(scene.shot.truth_hdr).paint(scene.request, SilentObserver()).balls
    assert ball_rmse(painted, scene.true_ball(0.0)) < 0.5 / 255


def test_the_command_prints_and_goes_on(
    panoramas: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(PAINTERS, "faithful", lambda files: studio(Faithful))
    command = ["bench", "early", "--section", "noise", "--panoramas", str(panoramas[0].parent), "--painter", "faithful"]
    command += ["--balls", "3", "--seeds", "8", "--steps", "4", "--out", str(tmp_path / "out"), "--json"]
    assert main(command) == 0
    first = json.loads(capsys.readouterr().out)
    assert len(first["rows"]) == 3 * 8
    assert first["evaluations"] == 3 * 8 * 2 * 4
    monkeypatch.setattr(NoiseSection, "measure", None)  # all is there
    assert main(command) == 0
    again = json.loads(capsys.readouterr().out)
    assert (again["rows"], again["summary"]) == (first["rows"], first["summary"])
    assert main([*command, "--section", "none"]) == 2
    assert "--section is 'none'; accepted: until, latents, decoding, noise" in capsys.readouterr().err
    assert main([*command, "--steps", "2", "--untils", "0.3"]) == 2
    assert "until is 0.3; accepted: at least 0.5 with 2 steps" in capsys.readouterr().err
