"""Good balls and bad ones: features that follow from the geometry, checks that tell, files that are inspected."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from dl_core.ball import crop_ball, paste_ball, place_ball
from dl_core.bench.cameras import Camera, take
from dl_core.bench.faulty_balls import FAULTS, examples
from dl_core.bench.pareto.shipped_chart import CHART_FILE
from dl_core.bench.quality import auc, fit_logistic
from dl_core.cli import main
from dl_core.errors import ImageError, ModelError, OptionError
from dl_core.exposure import expose
from dl_core.geometry import camera_rotation, latlong_directions, latlong_to_ball, rotate_latlong
from dl_core.imageio import read_envmap, write_exr, write_png
from dl_core.quality.features import ball_features
from dl_core.quality.inspection import inspect_map, inspect_picture, parse_ball
from dl_core.quality.judge import CHECKS, OVERALL, Judge, Range, shipped_judge
from dl_core.quality.surroundings import contrast_of, cue_check, exposures_check, horizon_check, rim_difference

MAPS = CHART_FILE.parent / "hdri"


def isotropic(height: int = 128, seed: int = 0) -> torch.Tensor:
    """Light whose detail runs every way: waves of random direction over the sphere."""
    generator = torch.Generator().manual_seed(seed)
    axes = 9 * torch.randn(60, 3, generator=generator)
    phases = 2 * math.pi * torch.rand(60, generator=generator)
    waves = torch.cos(latlong_directions(height) @ axes.T + phases).sum(dim=-1) / math.sqrt(30)
    return (0.25 + 0.1 * waves).clamp(0.01, 0.9)[None, ..., None].expand(-1, -1, -1, 3)


def ball(light: torch.Tensor, side: int = 64) -> torch.Tensor:
    return expose(latlong_to_ball(light, side, samples=4), 0.0)


# --- features ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_mirror_ball_in_its_place_explains_its_gradients_best(seed: int) -> None:
    found = ball_features(ball(isotropic(seed=seed)))
    assert found.squeeze > 0.03
    assert found.elsewhere < -0.02
    assert found.cut < 0.05
    # A picture of the same kind of detail without a ball: gradients run every way.
    flat = expose(isotropic(seed=seed)[:, 32:96, 64:128], 0.0)
    assert ball_features(flat).squeeze < 0


@given(turn=st.floats(-180, 180), pitch=st.floats(-90, 90))
@settings(max_examples=8, deadline=None)
def test_turning_the_light_leaves_the_geometry(turn: float, pitch: float) -> None:
    turned = rotate_latlong(isotropic(64), camera_rotation(turn, pitch))
    found = ball_features(ball(turned))
    assert found.squeeze > 0.01
    assert found.elsewhere < 0


def test_features_are_those_of_the_mirrored_ball() -> None:
    one, other = (ball_features(picture).values() for picture in (ball(isotropic()), ball(isotropic()).flip(2)))
    assert one == pytest.approx(other, abs=1e-2)


@given(stops=st.floats(-2, 0))
@settings(max_examples=10, deadline=None)
def test_exposure_changes_the_squeeze_little(stops: float) -> None:
    light = isotropic(64)
    full, darker = (ball_features(ball(light * 2**s)).squeeze for s in (0.0, stops))
    assert darker == pytest.approx(full, abs=0.06)


def test_colour_and_upright_in_closed_form() -> None:
    red = torch.zeros(1, 64, 64, 3)
    red[..., 0] = 1.0
    assert ball_features(red).colour == pytest.approx(math.degrees(math.acos(1 / math.sqrt(3))), abs=1.0)
    assert ball_features(torch.full((1, 64, 64, 3), 0.5)).colour < 0.1
    halves = expose(torch.full((1, 64, 64, 3), 0.8), 0.0)
    halves[:, 32:] = expose(torch.full((1, 32, 64, 3), 0.2), 0.0)
    assert ball_features(halves).upright == pytest.approx(math.log2(0.81 / 0.21), abs=0.02)
    assert ball_features(halves.flip(1)).upright == pytest.approx(-math.log2(0.81 / 0.21), abs=0.02)


@pytest.mark.parametrize(
    ("bad", "word"),
    [
        (torch.ones(1, 8, 8, 3), "8 pixels"),
        (torch.ones(1, 64, 32, 3), "shape"),
        (torch.full((1, 64, 64, 3), math.nan), "NaN"),
        (torch.full((1, 64, 64, 3), 1.5), "outside"),
    ],
)
def test_pictures_that_are_no_ball_are_refused(bad: torch.Tensor, word: str) -> None:
    with pytest.raises(ImageError, match=word):
        ball_features(bad)


# --- checks ------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def scored() -> dict[str, list[dict[str, float]]]:
    """Scores of all checks, by fault, of balls in photographs of panoramas that the checks were not fitted to."""
    judge, found = shipped_judge(), dict[str, list[dict[str, float]]]()
    for name in ("kloppenheim_05", "dancing_hall", "drachenfels_cellar"):
        light = read_envmap(MAPS / f"{name}.exr")
        for yaw in (0, 120):
            shot = take(light, Camera(yaw=yaw))
            for example in examples(shot, yaw):
                score, checks = judge.judge(example.crop)
                row = {"score": score, **{check.name: check.score for check in checks}}
                found.setdefault(example.fault, []).append(row)
    return found


def test_bad_balls_score_below_good_ones(scored: dict[str, list[dict[str, float]]]) -> None:
    good = [row["score"] for row in scored["good"]]
    bad = [row["score"] for fault in FAULTS if fault != "tinted" for row in scored[fault]]
    assert auc(good, bad) > 0.93


@pytest.mark.parametrize("name", [*OVERALL, "tint"])
def test_each_check_tells_its_fault(name: str, scored: dict[str, list[dict[str, float]]]) -> None:
    good = [row[name] for row in scored["good"]]
    bad = [row[name] for fault in CHECKS[name].faults for row in scored[fault]]
    assert auc(good, bad) > 0.8


def test_the_score_is_the_worst_of_its_checks(scored: dict[str, list[dict[str, float]]]) -> None:
    for rows in scored.values():
        for row in rows:
            assert row["score"] == min(row[name] for name in OVERALL)


def test_checks_speak_and_suggest_only_where_something_is_wrong() -> None:
    judge = shipped_judge()
    for picture in (ball(isotropic()), torch.full((1, 64, 64, 3), 0.5)):
        for check in judge.judge(picture)[1]:
            assert 0 <= check.score <= 1
            assert bool(check.suggestion) == (check.score < 0.5)
            assert check.message in check.line()


def test_a_ball_beside_its_place_is_told() -> None:
    judge, light = shipped_judge(), isotropic()
    canvas = expose(isotropic(seed=5)[:, :, :128].repeat(1, 2, 2, 1), 0.0)[:, :256, :256]
    nominal, scores = place_ball(256, 64), []
    for away in (0, 8, 16, 24):
        place = place_ball(256, 64, x=128 + away)
        picture = canvas.clone()
        disc = (torch.arange(64) + 0.5 - 32).square()
        inside = (disc[:, None] + disc[None] < 32**2)[None, ..., None]
        crop_ball(picture, place).copy_(torch.where(inside, ball(light), crop_ball(picture, place)))
        features = ball_features(crop_ball(picture, nominal))
        scores.append(judge.checks["place"](features.values()))
    assert scores[0] > 0.5 > max(scores[1:])


def test_exposures_that_agree_and_ones_that_do_not() -> None:
    light = isotropic() * 4
    bracket = [expose(latlong_to_ball(light, 64, samples=4), ev) for ev in (0.0, -2.5, -5.0)]
    assert exposures_check(bracket, (0.0, -2.5, -5.0)).score > 0.9
    bracket[1] = expose(latlong_to_ball(light, 64, samples=4), -1.0)
    wrong = exposures_check(bracket, (0.0, -2.5, -5.0))
    assert wrong.score < 0.1
    assert "1.5" in wrong.message
    with pytest.raises(OptionError, match="two EVs"):
        exposures_check(bracket[:1], (0.0,))


def test_contrast_in_closed_form_and_empty_photographs() -> None:
    judge = shipped_judge()
    halves = torch.cat((torch.full((1, 64, 32, 3), 0.08), torch.full((1, 64, 32, 3), 0.64)), dim=2)
    photo = expose(halves, 0.0)
    assert contrast_of(photo) == pytest.approx(math.log2(0.65 / 0.09) / 2, abs=0.02)
    for level, word in ((1.0, "white"), (0.0, "black"), (0.5, "flat")):
        check = cue_check(torch.full((1, 48, 64, 3), level), judge)
        assert check.score < 0.5
        assert word in check.message


def test_the_rims_distance_from_its_surroundings_in_closed_form() -> None:
    place = place_ball(256, 64)
    even = expose(torch.full((1, 256, 256, 3), 0.2), 0.0)
    assert rim_difference(even, place) == pytest.approx(0, abs=1e-4)
    strange = paste_ball(even, expose(torch.full((1, 64, 64, 3), 0.8), 0.0), place)
    # Pixels on the edge are mixtures and lie in both rings.
    assert rim_difference(strange, place) == pytest.approx(math.log2(0.81 / 0.21), abs=0.3)


def test_upside_down_light_is_told() -> None:
    judge = shipped_judge()
    up = 0.02 + latlong_directions(64)[None, ..., 1:2].clamp(min=0).expand(-1, -1, -1, 3)
    right, wrong = (horizon_check(ball_features(ball(light)), judge) for light in (up, up.flip(1)))
    assert right.score > 0.5 > wrong.score
    assert "lower half" in wrong.message


# --- fitting -----------------------------------------------------------------------------------------------------


def test_the_area_under_the_curve_by_counting() -> None:
    assert auc([1.0, 2.0], [0.0, 0.5]) == 1
    assert auc([0.0], [1.0]) == 0
    assert auc([1.0, 1.0], [1.0]) == 0.5
    assert auc([1.0, 3.0], [2.0, 0.0]) == 0.75


def test_a_logistic_finds_the_law_that_balls_follow() -> None:
    draw = np.random.default_rng(0)
    good, bad = draw.normal((1, 0), 1, (20_000, 2)), draw.normal((0, 0), 1, (5_000, 2))
    weights, offset = fit_logistic(good, bad, ridge=0.0)
    # Of two normal laws a unit apart the log odds are x - 1/2, however many there are of each.
    assert weights == pytest.approx([1.0, 0.0], abs=0.06)
    assert offset == pytest.approx(-0.5, abs=0.06)


def test_a_range_is_half_at_its_limit_and_nine_tenths_where_typical() -> None:
    for values in (Range(2.0, 0.5), Range(0.2, 1.0)):
        assert values.score(values.limit) == pytest.approx(0.5)
        assert values.score(values.typical) == pytest.approx(0.9)


@pytest.mark.parametrize("content", ["[]", "{}", "{", '{"checks": {}, "ranges": {}, "measured_on": ""}'])
def test_damaged_judges_are_refused(content: str, tmp_path: Path) -> None:
    (tmp_path / "judge.json").write_text(content)
    with pytest.raises(ModelError):
        Judge.read(tmp_path / "judge.json")


# --- files -------------------------------------------------------------------------------------------------------


def report(capsys: pytest.CaptureFixture[str], *words: object) -> dict[str, Any]:
    assert main(["inspect", *map(str, words), "--json"]) == 0
    found: dict[str, Any] = json.loads(capsys.readouterr().out)
    return found


def test_balls_canvases_and_maps_are_inspected(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shot = take(read_envmap(MAPS / "dancing_hall.exr"), Camera())
    by_fault = {example.fault: example for example in examples(shot, 0)}
    scores = {}
    for fault, example in by_fault.items():
        path = write_png(tmp_path / f"{fault}.png", example.crop[0])
        found = report(capsys, path)
        scores[fault] = found["score"]
        assert {check["name"] for check in found["checks"]} >= set(CHECKS) | {"horizon"}
        assert all(set(check) == {"name", "score", "message", "suggestion"} for check in found["checks"])
    assert scores["good"] > max(scores[fault] for fault in ("disco", "matte", "off-centre"))
    good = by_fault["good"]
    canvas = write_png(tmp_path / "canvas.png", good.canvas_ldr[0])
    found = report(capsys, canvas, "--ball", "128,128,64")
    assert found["score"] == pytest.approx(scores["good"], abs=1e-6)
    assert "rim" in {check["name"] for check in found["checks"]}
    light = write_exr(tmp_path / "map.exr", isotropic()[0], metadata={})
    found = report(capsys, light)
    assert found["score"] > 0.5
    assert found["format"] == "OpenEXR"
    assert main(["inspect", str(light)]) == 0
    assert "of 1 as a mirror ball" in capsys.readouterr().out


def test_what_cannot_be_inspected_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    wide = write_png(tmp_path / "wide.png", torch.rand(40, 60, 3))
    tiny = write_png(tmp_path / "tiny.png", torch.rand(8, 8, 3))
    light = write_exr(tmp_path / "map.exr", torch.ones(16, 32, 3), metadata={})
    for words, word in (
        ((wide,), "square crop"),
        ((tiny,), "8 pixels"),
        ((wide, "--ball", "1,2"), "X,Y,DIAMETER"),
        ((wide, "--ball", "50,20,30"), "lies on"),
        ((light, "--ball", "1,2,3"), "--ball"),
        ((tmp_path / "none.png",), "none.png"),
    ):
        assert main(["inspect", *map(str, words)]) != 0
        assert word in capsys.readouterr().err


def test_maps_of_any_scale_are_judged_alike() -> None:
    light = isotropic()
    assert inspect_map(light).score == pytest.approx(inspect_map(light * 100).score, abs=1e-3)
    assert inspect_picture(ball(light)).score > 0.5


def test_a_place_is_read() -> None:
    place = parse_ball("100,60,40", 200, 120)
    assert (place.left, place.top, place.diameter) == (80, 40, 40)
