"""Brackets sized to the scene: no exposure that the merge would not use, and none missing that it would."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import pytest
import torch
from analytic_painter import AnalyticPainter, Flaws
from hypothesis import given
from hypothesis import strategies as st
from test_iterative import Sparing
from tolerances import assert_close

import dl_core
from dl_core.ball import crop_disc
from dl_core.bench.cameras import Camera, take
from dl_core.bench.perfect import PerfectPainter
from dl_core.bench.skies import SunAndSky, sun_direction
from dl_core.bracket import DARKEST, darkest_of, hidden_radiance, ladder
from dl_core.errors import OptionError
from dl_core.estimate import Settings, bracket_remarks, estimate, planned_evaluations, planned_evs
from dl_core.exposure import MERGES, expose, merge_bracket
from dl_core.geometry import latlong_to_ball
from dl_core.imageio import read_envmap
from dl_core.iterative import Rounds
from dl_core.metrics import energy_kept

HDRI = Path(dl_core.__file__).parent / "data" / "hdri"
ROUNDS = Rounds(balls=1, rounds=0, steps=1)
FIXED = Settings(rounds=ROUNDS, canvas=256, diameter=128, height=64)
SCENE = replace(FIXED, bracket="scene")
GREY = torch.full((1, 24, 32, 3), 0.5)


def overcast(level: float = 0.4) -> torch.Tensor:
    """A map without anything near white."""
    directions = torch.linspace(0.1, 1, 32)[None, :, None, None]
    return (directions * level).expand(1, 32, 64, 3) * torch.tensor([1.0, 0.9, 0.8])


def sunny(elevation: float = 40.0, azimuth: float = 120.0, radius: float = 0.266) -> torch.Tensor:
    return SunAndSky(sun=sun_direction(elevation, azimuth), sun_radius=radius).latlong(128)


# --- the ladder --------------------------------------------------------------------------------------------------


def test_a_ladder_goes_on_at_its_last_distance() -> None:
    assert ladder((0, -2.5, -5), -12.5) == (0, -2.5, -5, -7.5, -10, -12.5)
    assert ladder((0, -1, -4), -8) == (0, -1, -4, -7, -8)
    assert ladder((0,), -5) == (0, -2.5, -5)
    assert ladder((0, -2.5, -5), -5) == ladder((0, -2.5, -5), -3) == (0, -2.5, -5)


@given(st.lists(st.floats(0.1, 5), max_size=4), st.floats(-40, -0.1))
def test_a_ladder_descends_from_what_is_given_to_the_darkest(gaps: list[float], darkest: float) -> None:
    evs = [0.0]
    for gap in gaps:
        evs.append(evs[-1] - gap)
    found = ladder(evs, darkest)
    assert found[: len(evs)] == tuple(evs)
    assert found[-1] == min(darkest, evs[-1])
    assert all(a > b for a, b in pairwise(found))


@pytest.mark.parametrize("darkest", [0.0, 1.0, -40.5, float("nan")])
def test_a_darkest_exposure_that_is_none_is_refused(darkest: float) -> None:
    with pytest.raises(OptionError, match="darkest"):
        ladder((0, -2.5), darkest)


def test_a_painter_may_have_a_darkest_exposure() -> None:
    @dataclass
    class Trained(AnalyticPainter):
        darkest_ev: float = -5.0

    trained, free = Trained(sunny()), AnalyticPainter(sunny())
    assert (darkest_of(trained), darkest_of(free)) == (-5.0, DARKEST)
    assert planned_evs(SCENE, trained) == (0, -2.5, -5)
    assert planned_evs(replace(SCENE, darkest=-10.0), trained)[-1] == -10  # the user says so
    assert planned_evs(FIXED, trained) == FIXED.evs
    assert estimate(GREY, trained, SCENE).evs == (0, -2.5, -5)
    assert {call.ev for call in trained.requests} == {0, -2.5, -5}


# --- what is hidden ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("merge", MERGES)
@given(seed=st.integers(0, 2**31), brightest=st.floats(-2, 8), evs=st.sampled_from([(0,), (0, -2.5), (0, -1.5, -3)]))
def test_what_is_hidden_bounds_what_darker_exposures_add(
    merge: str, seed: int, brightest: float, evs: tuple[float, ...]
) -> None:
    """Whatever radiance a true ball has, up to what the darkest exposure shows."""
    generator = torch.Generator().manual_seed(seed)
    stops = torch.rand(1, 16, 16, 3, generator=generator) * 8
    truth = 2.0 ** (brightest - stops)
    darker = ladder(evs, -8.0)
    balls = [expose(truth, ev) for ev in darker]
    known = merge_bracket(balls[: len(evs)], evs, merge)
    hidden = hidden_radiance(balls[: len(evs)], evs, -8.0, merge)
    added = merge_bracket(balls, darker, merge) - known
    assert bool((added <= hidden * (1 + 1e-4) + 1e-4 * known).all())
    unclipped = (balls[len(evs) - 1] ** 2.4 < 0.9).all(dim=-1)
    assert not (hidden[unclipped] > 1e-6 * known[unclipped]).any()


# --- the bars ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("merge", MERGES)
def test_nothing_darker_is_painted_where_nothing_clips_and_nothing_is_lost(merge: str) -> None:
    light, observer = overcast(), Sparing()
    painter = PerfectPainter(light)
    full = estimate(GREY, painter, replace(FIXED, merge=merge))
    sized = estimate(GREY, painter, replace(SCENE, merge=merge), observer=observer)
    assert sized.evs == (0,)
    assert_close(sized.latlong_hdr, full.latlong_hdr)
    assert sized.evaluations == full.evaluations / 3 == observer.done
    assert observer.done + observer.spared_in_all == planned_evaluations(painter, SCENE)
    assert sized.clipped == 0


def shipped(name: str) -> torch.Tensor:
    """A panorama that comes along, on the scale of a photograph taken straight ahead."""
    return take(read_envmap(HDRI / f"{name}.exr"), Camera()).truth_hdr


@pytest.mark.parametrize("merge", ["robust", "channel"])
@pytest.mark.parametrize(
    "light",
    [sunny(), sunny(70, -30), sunny(55, 175, 0.4), shipped("kloppenheim_05"), shipped("narrow_moonlit_road")],
    ids=["sun", "high sun", "sun behind", "kloppenheim_05", "narrow_moonlit_road"],
)
def test_the_sun_is_kept(light: torch.Tensor, merge: str) -> None:
    painter = PerfectPainter(light)
    full = estimate(GREY, painter, replace(FIXED, merge=merge, height=light.shape[1]))
    sized = estimate(GREY, painter, replace(SCENE, merge=merge, height=light.shape[1]))
    assert energy_kept(full.latlong_hdr, light) <= 0.55
    assert 0.97 <= energy_kept(sized.latlong_hdr, light) <= 1.03
    assert sized.evs[:3] == FIXED.evs
    assert sized.evs[-1] > DARKEST  # it stopped because nothing clips any more
    assert full.clipped > 0 == sized.clipped


@given(st.floats(5, 85), st.floats(-180, 180), st.floats(0.2, 15), st.floats(-4, 2))
def test_no_exposure_too_many_and_none_too_few(elevation: float, azimuth: float, radius: float, stops: float) -> None:
    """Every exposure but the first was needed: what it adds is there. And a full bracket has 1% more at most."""
    light = SunAndSky(sun=sun_direction(elevation, azimuth), sun_radius=radius).latlong(32) * 2.0**stops
    settings = replace(SCENE, canvas=64, diameter=32, height=16)
    painter = PerfectPainter(light)
    sized = estimate(GREY, painter, settings)
    full = estimate(GREY, painter, replace(settings, bracket="fixed", evs=planned_evs(settings, painter)))
    disc = crop_disc(sized.ball)[..., None]
    kept, whole = (float((probe.ball_hdr * disc).sum()) for probe in (sized, full))
    assert whole / 1.01 <= kept <= whole * (1 + 1e-5)
    true = latlong_to_ball(light, 32)
    for ev in sized.evs[:-1]:
        assert float((expose(true, ev) * disc).max()) ** 2.4 > 0.9 - 0.02  # 8 bits


def test_a_tolerance_is_kept_where_exposures_clip() -> None:
    """The dark exposures of a scene without lights are settled at once, however their balls differ elsewhere."""
    settings = replace(FIXED, rounds=Rounds(12, 1, 0.8, 2, final=False, tolerance=0.005, min_balls=4))
    painter = AnalyticPainter(overcast(), Flaws(uneven=0.02))
    probe = estimate(GREY, painter, settings)
    assert [exposure.tallies[0].painted for exposure in probe.exposures] == [12, 4, 4]


# --- reports and refusals ----------------------------------------------------------------------------------------


def test_a_report_says_which_exposures_there_are_and_what_still_clips() -> None:
    painter = PerfectPainter(sunny())
    whole, cut = (estimate(GREY, painter, replace(SCENE, darkest=darkest)) for darkest in (None, -7.5))
    assert bracket_remarks(estimate(GREY, painter, FIXED)) == []
    (line,) = bracket_remarks(whole)
    assert f"{len(whole.evs)} exposures" in line
    _, doubt = bracket_remarks(cut)
    assert doubt.startswith("EV -7.5 still clips on ")
    assert doubt.endswith("brighter than 181.019, where the map ends")


def test_an_unknown_bracket_is_refused_with_the_known_ones() -> None:
    painter = AnalyticPainter(overcast())
    with pytest.raises(OptionError, match="bracket is 'all'; accepted: fixed, scene"):
        estimate(GREY, painter, replace(FIXED, bracket="all"))
    with pytest.raises(OptionError, match="darkest is 3"):
        estimate(GREY, painter, replace(SCENE, darkest=3.0))
    assert painter.requests == []
