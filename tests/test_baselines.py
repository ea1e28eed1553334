"""What methods are compared with: the mean light, the stretched photograph, the regressor."""

from __future__ import annotations

import re
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import pytest
import torch
from torch import Tensor

from dl_core.backends import mini
from dl_core.backends.mini import MiniModel
from dl_core.ball import disc_mask, place_ball
from dl_core.bench.cameras import Shot
from dl_core.bench.paintings import planned
from dl_core.bench.perfect import PerfectPainter, RoundTripPainter
from dl_core.bench.protocol.baselines import BASELINES, answer_maps, open_baselines
from dl_core.errors import ModelError, OptionError
from dl_core.estimate import Settings
from dl_core.exposure import encode_display
from dl_core.geometry import ball_coverage, rotate_latlong
from dl_core.imageio import read_envmap, read_exr_header, write_exr
from dl_core.painter import PaintRequest, SilentObserver
from dl_core.training.mini.export import write_networks
from dl_core.training.mini.feed import Feed
from dl_core.training.mini.loop import Budget
from dl_core.training.mini.mean_light import mean_light, write_mean_light
from dl_core.training.mini.regressor import train_regressor
from dl_core.training.mini.regressor_painter import RegressorPainter
from dl_core.training.mini.scene_sampler import SceneSampler

SETTINGS = Settings(canvas=128, diameter=64, height=32, evs=(0.0, -2.5, -5.0))
LEVEL = torch.tensor([0.1, 0.3, 0.5])


@pytest.fixture(scope="module")
def bank() -> Tensor:
    return torch.rand(3, 32, 64, 3, generator=torch.Generator().manual_seed(0)) + 0.1


@pytest.fixture(scope="module")
def folder(bank: Tensor, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A regressor after two steps of training."""
    folder = tmp_path_factory.mktemp("regressor")
    torch.manual_seed(0)
    model = MiniModel.untrained()
    sampler = SceneSampler(bank, 64, 32, 0, bracket=True)
    weights = train_regressor(model, sampler, Budget(2, 1e-3, warmup=1), folder, feed=Feed(2), report=lambda line: None)
    write_networks(folder, weights)
    return folder


@pytest.fixture(scope="module")
def request_() -> PaintRequest:
    canvas = torch.rand(1, 128, 128, 3, generator=torch.Generator().manual_seed(1))
    return PaintRequest(canvas, torch.zeros_like(canvas), place_ball(128, 64), 0.0, (0, 1))


def even_shot() -> Shot:
    photo = encode_display(LEVEL).expand(1, 12, 16, 3)
    return Shot(photo, LEVEL.expand(1, 32, 64, 3))


def test_light_around_a_picture_is_what_its_camera_sees(bank: Tensor) -> None:
    """Scenes of one colour: the light is that colour on the scale of the photograph, whose 99th percentile is known."""
    sampler = SceneSampler(LEVEL.expand(1, 16, 32, 3), 64, 32, 0)
    for index in range(4):
        light, rotation = sampler.light(index)
        corner = sampler.draw(index).canvas_ldr[0, 32, :, :].amax(dim=0)
        torch.testing.assert_close(light, light[:, :1, :1].expand_as(light))
        torch.testing.assert_close(encode_display(light[0, 0, 0].clamp(max=1)), corner, atol=1e-3, rtol=0)
        torch.testing.assert_close(rotation @ rotation.T, torch.eye(3), atol=1e-5, rtol=0)


def test_mean_light_is_the_mean_as_cameras_stand_with_suns_cut(tmp_path: Path) -> None:
    bank = torch.full((1, 32, 64, 3), 0.2)
    bank[:, 4, 10] = 1e6
    sampler = SceneSampler(bank, 64, 32, 0)
    expected = torch.zeros(1, 32, 64, 3)
    for index in range(3):
        light, rotation = sampler.light(index)
        expected += rotate_latlong(light.clamp(max=32), rotation) / 3
    light = mean_light(sampler, 3)
    torch.testing.assert_close(light, expected)
    assert light.max() <= 32
    torch.testing.assert_close(read_envmap(write_mean_light(tmp_path, light, 3)), light, rtol=2**-10, atol=1e-6)


def test_the_stretched_photograph_keeps_its_radiance() -> None:
    answer = open_baselines(["stretched"], None, SETTINGS)["stretched"](even_shot())
    torch.testing.assert_close(answer.latlong_hdr, LEVEL.expand(1, 32, 64, 3), atol=1e-5, rtol=0)
    left = torch.zeros(1, 12, 16, 3)
    left[:, :, :8] = 1
    light = open_baselines(["stretched"], None, SETTINGS)["stretched"](Shot(left, left)).latlong_hdr
    assert light[:, :, :28].min() == 1
    assert light[:, :, 36:].max() == 0


def test_the_regressor_gives_one_ball_whatever_the_seed_and_what_stood_there(
    folder: Path, request_: PaintRequest
) -> None:
    painter = RegressorPainter(folder)
    result = painter.paint(request_, SilentObserver())
    assert result.evaluations == painter.evaluations(2, 30, 1.0) == 2
    torch.testing.assert_close(result.balls[0], result.balls[1], atol=1e-5, rtol=0)
    inside = disc_mask(request_.ball)[..., None]
    hidden = request_.canvas * (1 - inside) + 0.3 * inside
    other = painter.paint(replace(request_, canvas=hidden), SilentObserver()).balls
    # Where the rim of the disc meets the photograph, both show through; the middle is the network's alone.
    middle = slice(24, 40)
    torch.testing.assert_close(other[:, middle, middle], result.balls[:, middle, middle], atol=2e-3, rtol=0)
    darker = painter.paint(replace(request_, ev=-5.0), SilentObserver()).balls
    assert (darker - result.balls).abs().max() > 1e-4


def test_training_lowers_the_regressors_error(bank: Tensor, tmp_path: Path) -> None:
    torch.manual_seed(0)
    sampler = SceneSampler(bank[:1], 64, 32, 0, bracket=True, centred=1.0)

    def mean_loss(steps: int) -> float:
        """Over all steps; a report tells the mean since the last one, which comes when ten seconds are over."""
        told: list[tuple[int, float]] = [(0, 0.0)]

        def heard(line: str) -> None:
            step, loss = re.fullmatch(r"step (\d+)/.* loss (.*)", line).groups()  # type: ignore[union-attr]
            told.append((int(step), float(loss)))

        budget = Budget(steps, 3e-4, warmup=1)
        train_regressor(MiniModel.untrained(), sampler, budget, tmp_path / str(steps), feed=Feed(2), report=heard)
        assert told[-1][0] == steps
        return sum(loss * (step - before) for (before, _), (step, loss) in pairwise(told)) / steps

    assert mean_loss(12) < mean_loss(1)


def test_answers_are_written_once_with_their_cost(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_mean_light(tmp_path, torch.full((1, 32, 64, 3), 0.5), 1)
    monkeypatch.setattr(mini, "MINI_FOLDER", tmp_path)
    scene = write_exr(tmp_path / "scene.exr", torch.rand(32, 64, 3) + 0.1, metadata={})
    opened = open_baselines(list(BASELINES), folder, replace(SETTINGS, canvas=256, diameter=128))
    asked = list(planned([scene], "three-spheres", list(BASELINES), 0))
    said: list[str] = []
    for _ in range(2):
        answer_maps(asked, opened, tmp_path / "out", report=said.append)
    assert len(said) == len(BASELINES)
    costs = {item.variant: int(read_exr_header(item.map_in(tmp_path / "out"))["lightprobe:nfe"]) for item in asked}
    assert costs == {"vae-floor": 0, "mean": 0, "stretched": 0, "regressor": 3}
    maps = {item.variant: read_envmap(item.map_in(tmp_path / "out")) for item in asked}
    assert torch.equal(maps["mean"], torch.full((1, 32, 64, 3), 0.5))
    assert read_envmap(asked[0].truth_in(tmp_path / "out")).shape == (1, 32, 64, 3)


def test_a_round_trip_without_loss_is_the_truth(request_: PaintRequest) -> None:
    truth = PerfectPainter(LEVEL.expand(1, 32, 64, 3))
    expected = truth.paint(request_, SilentObserver()).balls
    found = RoundTripPainter(truth, lambda canvas: canvas).paint(request_, SilentObserver())
    inside = ball_coverage(64)[..., None] == 1
    torch.testing.assert_close(found.balls * inside, expected * inside)
    assert (found.evaluations, len(found.balls)) == (0, 2)
    halved = RoundTripPainter(truth, lambda canvas: canvas / 2).paint(request_, SilentObserver()).balls
    torch.testing.assert_close(halved * inside, expected * inside / 2)


def test_a_regressor_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(OptionError, match="--regressor is None; accepted: the folder"):
        open_baselines(["regressor"], None, SETTINGS)
    with pytest.raises(ModelError, match=r"unet\.safetensors: no such model file"):
        open_baselines(["regressor"], tmp_path, SETTINGS)
