"""One painter per exposure behind one port, held against a single painter that takes any."""

from __future__ import annotations

import pytest
import torch
from analytic_painter import AnalyticPainter

from dl_core.bench.skies import SunAndSky, sun_direction
from dl_core.bracket_painter import BracketPainter
from dl_core.errors import OptionError
from dl_core.estimate import Settings, estimate, planned_evaluations
from dl_core.iterative import Rounds
from dl_core.painter import Painter

SETTINGS = Settings(rounds=Rounds(balls=3, rounds=2, strength=0.8, steps=5), canvas=128, diameter=64, height=16)
PHOTO = torch.full((1, 24, 32, 3), 0.5)
LIGHT = SunAndSky(sun=sun_direction(35.0, 120.0), sun_radius=12.0, sun_irradiance=(1.5, 1.4, 1.2)).latlong(16)


def test_each_exposure_has_a_painter_of_its_own() -> None:
    painters = {ev: AnalyticPainter(LIGHT) for ev in SETTINGS.evs}
    bracket = BracketPainter(painters)
    assert isinstance(bracket, Painter)
    probe = estimate(PHOTO, bracket, SETTINGS)
    for ev, painter in painters.items():
        assert [request.ev for request in painter.requests] == [ev] * 3
    single = AnalyticPainter(LIGHT)
    assert torch.equal(probe.latlong_hdr, estimate(PHOTO, single, SETTINGS).latlong_hdr)
    assert planned_evaluations(bracket, SETTINGS) == planned_evaluations(single, SETTINGS) == probe.evaluations
    assert list(bracket.seconds) == list(SETTINGS.evs)
    assert all(seconds > 0 for seconds in bracket.seconds.values())


def test_an_exposure_without_a_painter_is_named() -> None:
    with pytest.raises(OptionError, match=r"ev is -2\.5; accepted: 0, -5"):
        estimate(PHOTO, BracketPainter({ev: AnalyticPainter(LIGHT) for ev in (0.0, -5.0)}), SETTINGS)
    with pytest.raises(OptionError, match="one painter per EV"):
        BracketPainter({})
