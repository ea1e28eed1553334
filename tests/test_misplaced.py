"""The share of light misplaced: closed forms, the fit that predicts it, and a painter that is now sure and now not."""

from __future__ import annotations

import json
import math
from itertools import count
from pathlib import Path

import numpy as np
import pytest
import torch
from analytic_painter import AnalyticPainter, Flaws
from hypothesis import given
from hypothesis import strategies as st

from dl_core.bench.confidence_fit import fit_shares
from dl_core.bench.painters import PAINTERS, Studio
from dl_core.cli import main
from dl_core.confidence import Calibration
from dl_core.geometry import latlong_directions, rotate_latlong
from dl_core.imageio import write_exr
from dl_core.misplaced import OVERALL, light_misplaced, overall_evidence

EVEN = torch.full((1, 32, 64, 3), 0.25)


def test_shares_of_light_that_are_known() -> None:
    assert light_misplaced(EVEN, EVEN) == 0
    assert light_misplaced(0 * EVEN, EVEN) == pytest.approx(1)
    assert light_misplaced(3 * EVEN, EVEN) == pytest.approx(2, rel=1e-5)
    left, right = EVEN.clone(), EVEN.clone()
    left[:, :, 32:], right[:, :, :32] = 0, 0
    assert light_misplaced(left, right) == pytest.approx(2, rel=1e-5)  # gone from here, and there too much
    assert light_misplaced(left, EVEN) == pytest.approx(0.5, rel=1e-4)


@given(st.floats(0.01, 100), st.integers(0, 2**31))
def test_the_share_is_of_no_unit(scale: float, seed: int) -> None:
    one, other = torch.rand(2, 1, 16, 32, 3, generator=torch.Generator().manual_seed(seed))
    assert light_misplaced(scale * one, scale * other) == pytest.approx(light_misplaced(one, other), rel=1e-4)


def test_evidence_of_maps_that_are_known() -> None:
    spread = torch.full((1, 8, 8, 1), 0.5)
    known = dict(zip(OVERALL, overall_evidence(EVEN, spread, 0.1).tolist(), strict=True))
    assert known == pytest.approx(
        {"constant": 1, "level": -2, "peak": 0, "contrast": 0, "spread": 0.5, "clipped": 0.1}, abs=1e-4
    )
    half = EVEN.clone()
    half[:, :, 32:] = 0
    known = dict(zip(OVERALL, overall_evidence(half, spread, 0.1).tolist(), strict=True))
    assert known["level"] == pytest.approx(-3, abs=0.01)
    assert known["peak"] == pytest.approx(1, abs=0.01)
    assert known["contrast"] == pytest.approx(0.5, abs=0.01)


def test_a_law_is_found_and_chance_is_not() -> None:
    generator = np.random.default_rng(3)
    found = np.concatenate((np.ones((60, 1)), generator.normal(size=(60, 4)) * (0.1, 1, 10, 1) + 2), axis=1)
    groups = [str(row // 3) for row in range(60)]
    law = np.array([0.5, 3.0, -1.0, 0.05, 0.0])
    weights = fit_shares(found, found @ law, groups)
    assert np.abs(found @ weights - found @ law).max() < 0.01
    chance = generator.normal(size=60)
    held_back = fit_shares(found, chance, groups)
    assert (found @ held_back).std() < 0.35 * chance.std()
    assert np.isfinite(fit_shares(found, chance, ["one"] * 60)).all()


def test_a_calibration_of_another_length_is_refused() -> None:
    with pytest.raises(ValueError, match="overall"):
        Calibration((0.0,) * 6, "nothing", (1.0, 2.0))


def test_how_sure_a_painter_is_carries_over_to_other_scenes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Balls that differ by more are further off: calibrated on some scenes, told of others."""
    numbers = count()

    def painter_of(variant: object, shot: object) -> AnalyticPainter:
        uneven = 0.02 + 0.3 * ((7 * next(numbers)) % 11) / 11
        return AnalyticPainter(shot.truth_hdr, Flaws(uneven=uneven))  # type: ignore[attr-defined]

    monkeypatch.setitem(PAINTERS, "moody", lambda files: Studio(painter_of, 96, 48))
    light = torch.exp(1.5 * latlong_directions(32))[None] / 4
    for split, angles in (("known", range(0, 300, 60)), ("other", range(30, 330, 60))):
        (tmp_path / split).mkdir()
        for angle in angles:
            turn = math.radians(angle)
            rotation = torch.tensor(
                [[1, 0, 0], [0, math.cos(turn), -math.sin(turn)], [0, math.sin(turn), math.cos(turn)]]
            )
            write_exr(tmp_path / split / f"{angle}.exr", rotate_latlong(light, rotation)[0], metadata={})
    options = ["bench", "confidence", "--painter", "moody", "--cameras", "3", "--preset", "draft", "--json"]
    weights = str(tmp_path / "weights.json")
    assert main([*options, "--panoramas", str(tmp_path / "known"), "--calibrate", weights]) == 0
    capsys.readouterr()
    assert main([*options, "--panoramas", str(tmp_path / "other"), "--calibration", weights]) == 0
    (summary,) = json.loads(capsys.readouterr().out)["summary"]
    assert summary["photographs"] == 15
    assert summary["rank_correlation"] > 0.6
    assert summary["rank_correlation_radiance"] > 0.6
    # By direction an error is one draw, of which only the deviation can be known.
    assert summary["rank_correlation_directions"] > 0.5
    assert summary["worst_tenth_in_least_trusted_fifth_directions"] > 0.4  # 0.2 by chance
