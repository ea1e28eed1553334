"""The bench of brackets: what it keeps of a sun with a painter without error, and how darker exposures are started."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch
from analytic_painter import AnalyticPainter, Flaws

from dl_core import cli
from dl_core.ball import crop_ball, crop_disc, paint_depth, place_ball
from dl_core.bench.bracket import DarkenedPainter
from dl_core.bench.skies import SunAndSky
from dl_core.exposure import decode_display, expose
from dl_core.imageio import write_exr
from dl_core.median import pixelwise_median
from dl_core.painter import PaintRequest, SilentObserver
from dl_core.presets import PRESETS

BALL = place_ball(64, 32)


EACH = 2 * PRESETS["draft"].guided_steps // 3
"""Evaluations of an exposure of the bench's default preset."""


def test_a_sun_and_a_sky_without_one(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "maps"
    folder.mkdir()
    overcast = (1 - 0.7 * torch.linspace(-1, 1, 64).abs())[:, None, None].expand(64, 128, 3)  # brightest where it looks
    write_exr(folder / "sun.exr", SunAndSky(sun=(0.0, 0.5, 0.75**0.5)).latlong(64)[0], metadata={}, half=False)
    write_exr(folder / "overcast.exr", overcast, metadata={}, half=False)
    assert cli.main(["bench", "bracket", "--panoramas", str(folder), "--json"]) == 0
    rows = {(row["panorama"], row["way"]): row for row in json.loads(capsys.readouterr().out)["rows"]}
    assert rows["sun", "fixed"]["energy_kept"] < 0.65
    assert rows["sun", "scene"]["energy_kept"] == pytest.approx(1, abs=0.01)
    assert rows["sun", "scene"]["evaluations"] > rows["sun", "fixed"]["evaluations"] == 3 * EACH
    fixed, sized = rows["overcast", "fixed"], rows["overcast", "scene"]
    assert (sized["evs"], sized["evaluations"]) == ("0", EACH)
    same = ("energy_kept", "irradiance_si_rmse", "irradiance_angular_error_deg")
    assert [sized[key] for key in same] == [fixed[key] for key in same]
    assert fixed["darker_rmse"] < 1 / 255  # 8 bits
    assert fixed["highlight_stops"] == pytest.approx(0, abs=0.1)
    assert sized["darker_rmse"] is None


def test_darker_exposures_start_from_the_brighter_median_in_linear_light() -> None:
    painter = AnalyticPainter(SunAndSky(sun_radius=10.0).latlong(32), Flaws(noise=0.02))
    darkened = DarkenedPainter(painter, 0.6)
    canvas = torch.full((1, 64, 64, 3), 0.3)
    requests = [
        PaintRequest(canvas, paint_depth(None, BALL), BALL, ev, (0, 1, 2), steps=10) for ev in (0.0, -2.0, -5.0)
    ]
    for _ in range(2):  # the second photograph does not start from the first one's balls
        painter.requests.clear()
        medians = [pixelwise_median(darkened.paint(request, SilentObserver()).balls) for request in requests]
        assert torch.equal(painter.requests[0].canvas, canvas)
        assert [call.strength for call in painter.requests] == [1, 0.6, 0.6]
        disc = crop_disc(BALL) > 0
        for call, median, step in zip(painter.requests[1:], medians, (-2.0, -3.0), strict=False):
            shown, expected = crop_ball(call.canvas, BALL)[0][disc], expose(decode_display(median), step)[0][disc]
            torch.testing.assert_close(shown, expected)
    assert darkened.evaluations(3, 10, 1.0) == painter.evaluations(3, 10, 1.0)
