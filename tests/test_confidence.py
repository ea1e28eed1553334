"""The expected error: spreads of known laws, evidence that turns with the map, and the bench that judges it."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
import torch
from analytic_painter import AnalyticPainter, Flaws
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import nnls
from scipy.stats import spearmanr

from dl_core.bench.confidence_fit import fit_weights, held_by_least_trusted, rank_correlation
from dl_core.bench.painters import PAINTERS, Studio
from dl_core.cli import main
from dl_core.confidence import (
    EVIDENCE,
    FLOOR,
    Calibration,
    bracket_spread,
    confidence_of,
    evidence,
    shipped_calibration,
)
from dl_core.errors import ImageError, ModelError, OptionError
from dl_core.estimate import Settings, confidence_remark, estimate
from dl_core.exposure import encode_display
from dl_core.geometry import latlong_directions
from dl_core.imageio import exr_channels, read_envmap, write_exr
from dl_core.iterative import Rounds

LIGHT = torch.exp(latlong_directions(64))[None] / 4
EVEN = Calibration((0.0, 1.0, 0.0, 0.0, 0.0, 0.0), "the spread alone")


def opinions(stops: float, count: int = 200, level: float = 0.3, side: int = 24, seed: int = 0) -> torch.Tensor:
    """Grey balls whose luminance differs by a normal law in stops."""
    generator = torch.Generator().manual_seed(seed)
    light = level * 2 ** (stops * torch.randn(count, 1, 1, 1, generator=generator))
    return encode_display(light.expand(-1, side, side, 3))


# --- the spread --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("stops", [0.05, 0.3, 0.6])
def test_a_normal_spread_in_stops_is_found(stops: float) -> None:
    spread = bracket_spread([opinions(stops, 4000, side=2)], (0.0,))
    # What lies below the floor shrinks the spread by as much as the floor adds to the light.
    assert float(spread.stops.mean()) == pytest.approx(stops * 0.3 / (0.3 + FLOOR), rel=0.06)
    assert float(spread.degrees.max()) < 1e-4


def test_balls_of_different_colours_spread_in_degrees_alone() -> None:
    generator = torch.Generator().manual_seed(0)
    grey = torch.full((4000, 2, 2, 3), 0.4, dtype=torch.float64)
    across = torch.linalg.qr(torch.tensor([[1.0, 1, 0], [1, -1, 0], [1, 0, 1]], dtype=torch.float64)).Q[:, 1:]
    tilt = math.radians(2.0) * 0.4 * math.sqrt(3) * torch.randn(4000, 1, 1, 2, generator=generator).double()
    spread = bracket_spread([encode_display(grey + tilt @ across.T)], (0.0,))
    assert float(spread.degrees.mean()) == pytest.approx(2.0, rel=0.06)


def test_lights_are_judged_by_the_exposure_that_shows_them() -> None:
    bright = torch.ones(30, 24, 24, 3)
    bright[:, :, :12] = opinions(0.1, 30)[:, :, :12]
    spread = bracket_spread([bright, opinions(0.5, 30)], (0.0, -2.5))
    assert float(spread.stops[:, :, :12].max()) < 0.2
    assert float(spread.stops[:, :, 12:].min()) > 0.3


def test_a_few_disco_balls_do_not_move_it_and_many_do() -> None:
    def spread_of(disco: float) -> float:
        painter = AnalyticPainter(LIGHT, Flaws(noise=0.02, disco=disco))
        settings = Settings(Rounds(30, 1, 0.8, 2, final=False), (0.0,), canvas=96, diameter=48, height=32)
        probe = estimate(torch.full((1, 48, 64, 3), 0.5), painter, settings)
        assert probe.confidence is not None
        return probe.confidence.expected_error

    none, few, many = (spread_of(share) for share in (0.0, 0.1, 0.7))
    assert few < none * 1.3
    assert many > few


@pytest.mark.parametrize("count", [1, 2])
def test_fewer_than_three_balls_have_no_spread(count: int) -> None:
    with pytest.raises(OptionError, match="3 or more"):
        bracket_spread([opinions(0.1, count)], (0.0,))
    settings = Settings(Rounds(count, 1, 0.8, 2, final=False), (0.0, -2.5), canvas=96, diameter=48, height=32)
    probe = estimate(torch.full((1, 48, 64, 3), 0.5), AnalyticPainter(LIGHT), settings)
    assert probe.confidence is None
    assert f"{count} balls have no spread" in confidence_remark(probe)


def test_batches_and_evs_have_to_match() -> None:
    with pytest.raises(OptionError, match="one batch"):
        bracket_spread([opinions(0.1, 5)], (0.0, -2.5))


# --- the evidence ------------------------------------------------------------------------------------------------


@given(seed=st.integers(0, 99))
@settings(max_examples=10, deadline=None)
def test_mirrored_balls_have_mirrored_confidence(seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    balls = torch.rand(5, 24, 24, 3, generator=generator)
    light = torch.rand(1, 16, 32, 3, generator=generator) * 3
    one = confidence_of(bracket_spread([balls], (0.0,)), light)
    other = confidence_of(bracket_spread([balls.flip(2)], (0.0,)), light.flip(2))
    assert torch.allclose(one.map, other.map.flip(2), atol=2e-3)
    assert one.expected_error == pytest.approx(other.expected_error, rel=1e-3)


def test_evidence_is_what_it_says() -> None:
    height = 32
    planes = dict(zip(EVIDENCE, evidence(bracket_spread([opinions(0.2, 50)], (0.0,)), LIGHT[:, ::2, ::2]), strict=True))
    middle, behind = (height // 2, height), (height // 2, 0)
    assert set(planes) == set(EVIDENCE)
    assert planes["constant"].eq(1).all()
    assert planes["unseen"][middle] < 0.01
    assert planes["unseen"][behind] > 0.99
    # 24 pixels across: straight behind the camera is the ball's middle, 12 pixels inside its rim.
    assert planes["rim"][behind] == pytest.approx(1 / 13, rel=0.05)
    assert planes["rim"][middle] > 0.9
    assert planes["stops"].std() < 1e-3
    even = evidence(bracket_spread([opinions(0.2, 50)], (0.0,)), torch.full((1, 16, 32, 3), 0.7))
    assert even[EVIDENCE.index("contrast")].abs().max() < 1e-5


def test_expected_error_of_an_even_spread_is_that_spread() -> None:
    spread = bracket_spread([opinions(0.4, 400)], (0.0,))
    found = confidence_of(spread, LIGHT, EVEN)
    level = float(spread.stops.mean())
    assert found.expected_error == pytest.approx(level, rel=1e-3)
    assert torch.allclose(found.map, torch.full_like(found.map, 2**-level), rtol=1e-3)
    assert "400 balls" in found.line()
    assert "the spread alone" in found.line()


# --- calibrations ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "content",
    [
        "[]",
        "{}",
        '{"weights": [1, 2], "measured_on": "x"}',
        '{"weights": [1, 1, 1, 1, 1, -1], "measured_on": "x"}',
        "{",
    ],
)
def test_damaged_calibrations_are_refused(content: str, tmp_path: Path) -> None:
    (tmp_path / "c.json").write_text(content)
    with pytest.raises((ModelError, OptionError)):
        Calibration.read(tmp_path / "c.json")


def test_the_shipped_calibration_says_where_it_is_from() -> None:
    calibration = shipped_calibration()
    assert "photographs" in calibration.measured_on
    assert calibration.correlation is not None
    assert any(calibration.weights)


@given(seed=st.integers(0, 200), planes=st.integers(1, 5))
@settings(max_examples=40, deadline=None)
def test_weights_are_the_least_squares_without_negative_ones(seed: int, planes: int) -> None:
    draw = np.random.default_rng(seed)
    found, errors, shares = draw.random((planes, 60)), draw.random(60) + draw.random((planes, 60))[0], draw.random(60)
    root = np.sqrt(shares)
    reference, _ = nnls((found * root).T, errors * root)
    assert np.allclose(fit_weights(found, errors, shares), reference, atol=1e-8)


@given(st.lists(st.tuples(st.integers(0, 9), st.integers(0, 9)), min_size=3, max_size=30))
def test_rank_correlation_is_spearmans(pairs: list[tuple[int, int]]) -> None:
    first, second = zip(*pairs, strict=True)
    if len(set(first)) == 1 or len(set(second)) == 1:
        assert math.isnan(rank_correlation(first, second))
    else:
        assert rank_correlation(first, second) == pytest.approx(spearmanr(first, second).statistic, abs=1e-9)


def test_the_least_trusted_fifth_holds_all_half_or_a_fifth() -> None:
    errors = np.arange(100.0)
    shares = np.full(100, 0.01)
    assert held_by_least_trusted(errors, errors, shares) == pytest.approx(1)
    assert held_by_least_trusted(-errors, errors, shares) == pytest.approx(0)
    half = np.where(errors >= 95, 1000.0, -errors)
    assert held_by_least_trusted(half, errors, shares) == pytest.approx(0.5)
    # Directions of different sizes: one that makes up two fifths counts by the half that is in the fifth.
    assert held_by_least_trusted(np.array([2.0, 1.0]), np.array([2.0, 1.0]), np.array([0.4, 0.6])) == pytest.approx(0.5)


# --- files and the bench -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("half", [True, False])
def test_the_layer_rides_along_and_disturbs_nothing(half: bool, tmp_path: Path) -> None:
    trust = torch.rand(16, 32, generator=torch.Generator().manual_seed(0))
    light = torch.rand(16, 32, 3, generator=torch.Generator().manual_seed(1))
    plain = write_exr(tmp_path / "plain.exr", light, metadata={}, half=half)
    layered = write_exr(tmp_path / "layered.exr", light, metadata={}, half=half, confidence=trust)
    assert torch.equal(read_envmap(plain), read_envmap(layered))
    assert set(exr_channels(layered)) == {"R", "G", "B", "confidence.Y"}
    kept = OpenEXR.File(str(layered), separate_channels=True).channels()["confidence.Y"].pixels
    assert np.allclose(kept, trust.numpy(), atol=1e-3 if half else 0)


@pytest.mark.parametrize("bad", [torch.ones(16, 30), torch.full((16, 32), 1.5), torch.full((16, 32), math.nan)])
def test_layers_that_are_none_are_refused(bad: torch.Tensor, tmp_path: Path) -> None:
    with pytest.raises(ImageError, match="confidence"):
        write_exr(tmp_path / "map.exr", torch.ones(16, 32, 3), metadata={}, confidence=bad)
    assert not (tmp_path / "map.exr").exists()


@pytest.fixture
def maps(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Maps that a painter is more or less sure of: its error is what it spreads by."""
    folder = tmp_path / "maps"
    folder.mkdir()
    for number in range(3):
        write_exr(folder / f"map{number}.exr", LIGHT[0] * (1 + number), metadata={})
    unsure = Studio(lambda variant, shot: AnalyticPainter(shot.truth_hdr, Flaws(uneven=0.15)), 96, 48)
    monkeypatch.setitem(PAINTERS, "unsure", lambda files: unsure)
    return folder


def test_the_bench_calibrates_judges_and_goes_on(
    maps: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    options = ["bench", "confidence", "--panoramas", str(maps), "--painter", "unsure", "--cameras", "2", "--json"]
    weights = tmp_path / "weights.json"
    assert main([*options, "--out", str(tmp_path / "out"), "--calibrate", str(weights)]) == 0
    report = json.loads(capsys.readouterr().out)
    assert len(report["rows"]) == 6
    assert report["summary"][0]["expected_error_stops_mean"] == pytest.approx(
        report["summary"][0]["error_stops_mean"], rel=0.05
    )
    assert "6 photographs in 3 panoramas, painter unsure" in Calibration.read(weights).measured_on
    before = (tmp_path / "out" / "rows.jsonl").read_text()
    assert main([*options, "--out", str(tmp_path / "out"), "--calibration", str(weights)]) == 0
    again = json.loads(capsys.readouterr().out)
    assert (tmp_path / "out" / "rows.jsonl").read_text() == before
    for mine, theirs in zip(again["rows"], report["rows"], strict=True):
        assert mine["error_stops"] == theirs["error_stops"]
        assert mine["expected_misplaced"] == pytest.approx(theirs["expected_misplaced"], rel=1e-2)
        assert mine["expected_error_stops"] == pytest.approx(theirs["expected_error_stops"], rel=1e-2)


@pytest.mark.parametrize(
    ("options", "named"),
    [
        (("--cameras", "0"), "--cameras"),
        (("--calibrate", "a.json", "--calibration", "b.json"), "--calibration"),
        (("--preset", "slow"), "preset"),
        (("--calibration", "missing.json"), "missing.json"),
    ],
)
def test_bad_options_are_named(
    maps: Path, options: tuple[str, ...], named: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["bench", "confidence", "--panoramas", str(maps), "--painter", "unsure", *options]) != 0
    assert named in capsys.readouterr().err


def test_a_probe_tells_its_error_and_a_turned_seed_changes_it_little() -> None:
    settings = Settings(Rounds(9, 1, 0.8, 2, final=False), (0.0, -2.5), canvas=96, diameter=48, height=32)
    photo = torch.full((1, 48, 64, 3), 0.5)
    painter = AnalyticPainter(LIGHT, Flaws(uneven=0.1))
    probes = [estimate(photo, painter, replace(settings, seed=seed)) for seed in (0, 100)]
    errors = [probe.confidence.expected_error for probe in probes if probe.confidence is not None]
    assert len(errors) == 2
    assert errors[0] == pytest.approx(errors[1], rel=0.25)
