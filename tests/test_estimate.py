"""The whole method with a painter that knows the light: it comes back, and bad input is refused before it costs."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from analytic_painter import AnalyticPainter, Flaws

from dl_core.ball import crop_ball, disc_mask, fit_canvas, paint_depth
from dl_core.bench.skies import SunAndSky, sun_direction
from dl_core.errors import ImageError, Interrupted, OptionError
from dl_core.estimate import Settings, check_photograph, estimate, planned_evaluations
from dl_core.exposure import auto_exposure, expose
from dl_core.geometry import latlong_directions, latlong_solid_angles, latlong_to_perspective
from dl_core.iterative import Rounds
from dl_core.metrics import angular_error, energy_kept, irradiance, si_rmse, spread_directions
from dl_core.painter import Observer, PaintRequest, PaintResult

SETTINGS = Settings(rounds=Rounds(balls=3, rounds=1, strength=0.8, steps=5), canvas=128, diameter=64, height=32)
PHOTO = torch.full((1, 24, 32, 3), 0.5)
NORMALS = spread_directions(200)


def light(elevation: float = 35.0, azimuth: float = 120.0) -> torch.Tensor:
    """A sky with a large soft sun whose radiance, 11, the paper's bracket holds."""
    sky = SunAndSky(sun=sun_direction(elevation, azimuth), sun_radius=12.0, sun_irradiance=(1.5, 1.4, 1.2))
    return sky.latlong(32)


def photograph(latlong: torch.Tensor) -> torch.Tensor:
    return expose(latlong_to_perspective(latlong, 24, 32, fov=60.0), 0.0)


@pytest.mark.parametrize(("elevation", "azimuth"), [(35.0, 120.0), (60.0, -60.0), (10.0, 180.0)])
def test_a_perfect_painter_gives_the_light_back(elevation: float, azimuth: float) -> None:
    truth = light(elevation, azimuth)
    probe = estimate(photograph(truth), AnalyticPainter(truth), SETTINGS)
    assert probe.latlong_hdr.shape == (1, 32, 64, 3)
    # 64 pixels across: a pixel of the ball is 3.6 degrees at the centre and 20 at the rim.
    assert energy_kept(probe.latlong_hdr, truth) == pytest.approx(1, abs=0.01)
    assert si_rmse(irradiance(probe.latlong_hdr, NORMALS), irradiance(truth, NORMALS)) < 0.02
    assert angular_error(irradiance(probe.latlong_hdr, NORMALS), irradiance(truth, NORMALS)) < 0.2
    cosine = torch.nn.functional.cosine_similarity(sun_centroid(probe.latlong_hdr), sun_centroid(truth), dim=0)
    assert math.degrees(math.acos(min(1.0, float(cosine)))) < 180 / 32 / 4  # a quarter of a pixel of the map


def sun_centroid(latlong: torch.Tensor) -> torch.Tensor:
    """Where the light that is brighter than any of the sky's comes from on average."""
    excess = (latlong[0].sum(-1) - 3).clamp(min=0) * latlong_solid_angles(32)
    return (latlong_directions(32) * excess[..., None]).sum(dim=(0, 1))


def test_a_median_is_nearer_the_light_than_flawed_balls_are() -> None:
    truth = light()
    flaws = Flaws(noise=0.02, disco=0.3)

    def error(rounds: Rounds, seed: int) -> float:
        found = estimate(PHOTO, AnalyticPainter(truth, flaws), replace(SETTINGS, rounds=rounds, seed=seed)).latlong_hdr
        return si_rmse(irradiance(found, NORMALS), irradiance(truth, NORMALS))

    singles = [error(Rounds(rounds=0), seed) for seed in range(9)]
    assert error(Rounds(balls=9, rounds=1, final=False), 0) < 0.75 * sum(singles) / len(singles)


def test_exposures_that_disagree_cost_the_paper_merge_no_colour() -> None:
    # What the paper keeps EV 0's chroma for: darker exposures that drift must not tint what EV 0 shows unclipped.
    truth = light()
    drifting = AnalyticPainter(truth, Flaws(drift=4.0))
    probe = estimate(PHOTO, drifting, replace(SETTINGS, merge="paper"))
    shown = probe.exposures[0].ball ** 2.4
    cross = torch.linalg.cross(probe.ball_hdr, shown).norm(dim=-1)
    assert float(cross.max()) <= 1e-4 * float(probe.ball_hdr.norm(dim=-1).max())


def test_a_bright_background_is_no_lamp() -> None:
    # The photograph shines through beside the rim at every EV: merged, it would be 32 times as bright as white.
    class OnWhite(AnalyticPainter):
        def paint(self, request: PaintRequest, observer: Observer) -> PaintResult:
            result = super().paint(request, observer)
            disc = crop_ball(disc_mask(request.ball)[..., None], request.ball)
            return replace(result, balls=torch.where(disc == 1, result.balls, torch.ones(())))

    truth = light()
    plain, on_white = (estimate(PHOTO, kind(truth), SETTINGS).latlong_hdr for kind in (AnalyticPainter, OnWhite))
    assert torch.equal(plain, on_white)


def test_the_probe_tells_what_it_cost() -> None:
    painter = AnalyticPainter(light())
    probe = estimate(PHOTO, painter, SETTINGS)
    assert probe.evaluations == painter.spent == planned_evaluations(painter, SETTINGS)
    assert len(probe.exposures) == len(SETTINGS.evs)
    assert {call.seeds[0] for call in painter.requests} == {SETTINGS.seed}
    assert probe.composite_ldr.shape == (1, 128, 128, 3)


def test_the_composite_is_the_photograph_with_the_ball_of_ev_0() -> None:
    probe = estimate(PHOTO, AnalyticPainter(light()), SETTINGS)
    middle = probe.composite_ldr[0, 64, 64]
    assert torch.equal(middle, probe.exposures[0].ball[0, 32, 32])
    assert float((probe.composite_ldr[0, 30, 5] - 0.5).abs().max()) < 1e-6


@pytest.mark.parametrize(
    ("photo", "reason"),
    [
        (torch.full((1, 4, 4, 3), math.nan), "NaN"),
        (torch.full((1, 4, 4, 3), math.inf), "NaN or infinite"),
        (torch.full((1, 4, 4, 3), -0.1), "from -0.1"),
        (torch.full((1, 4, 4, 3), 255.0), "to 255"),
        (torch.ones(2, 4, 4, 3), "shape"),
        (torch.ones(1, 4, 4, 4), "shape"),
        (torch.ones(1, 0, 4, 3), "empty"),
    ],
)
def test_a_bad_photograph_is_named_before_anything_is_painted(photo: torch.Tensor, reason: str) -> None:
    painter = AnalyticPainter(light())
    with pytest.raises(ImageError, match=reason) as raised:
        estimate(photo, painter, SETTINGS)
    assert raised.value.source == "photograph"
    assert painter.requests == []


@pytest.mark.parametrize(("height", "width"), [(1, 1), (1, 400), (400, 1)])
def test_photographs_of_odd_sizes_work(height: int, width: int) -> None:
    photo = torch.full((1, height, width, 3), 0.3)
    assert torch.equal(check_photograph(photo), photo)
    assert bool(torch.isfinite(estimate(photo, AnalyticPainter(light()), SETTINGS).latlong_hdr).all())


@pytest.mark.parametrize(
    ("options", "name"),
    [
        ({"evs": (-2.5, 0.0)}, "evs"),
        ({"evs": ()}, "evs"),
        ({"merge": "median"}, "merge"),
        ({"height": 1}, "height"),
        ({"diameter": 200}, "diameter"),
        ({"canvas": 100}, "canvas"),
        ({"x": 10.0}, "x"),
        ({"y": math.nan}, "y"),
    ],
)
def test_a_wrong_option_is_named_before_anything_is_painted(options: dict[str, object], name: str) -> None:
    painter = AnalyticPainter(light())
    with pytest.raises(OptionError) as raised:
        estimate(PHOTO, painter, replace(SETTINGS, **options))  # type: ignore[arg-type]
    assert raised.value.name == name
    assert painter.requests == []


def test_depth_is_estimated_of_the_canvas_and_again_of_each_composite() -> None:
    painter, seen = AnalyticPainter(light()), list[torch.Tensor]()

    def depth_of(canvas: torch.Tensor) -> torch.Tensor:
        seen.append(canvas)
        return canvas[..., :1]

    estimate(PHOTO, painter, replace(SETTINGS, evs=(0.0, -2.5)), depth_of=depth_of)
    # The photograph's own once; then, at each EV, that of the median the last ball is painted from.
    assert [bool(torch.equal(canvas, fit_canvas(PHOTO, 128))) for canvas in seen] == [True, False, False]
    depths = [request.depth for request in painter.requests]
    assert torch.equal(depths[0], depths[2])
    assert torch.equal(depths[0], paint_depth(seen[0][..., :1], painter.requests[0].ball))


def test_bad_depth_is_named() -> None:
    with pytest.raises(ImageError, match="depth"):
        estimate(PHOTO, AnalyticPainter(light()), SETTINGS, depth=torch.full((1, 8, 8, 1), math.nan))


def test_an_interrupted_run_can_be_repeated() -> None:
    class Stop:
        def evaluated(self, count: int) -> None:
            raise Interrupted("stopped by the test")

        def painted(self, ev: float, round_index: int, balls: torch.Tensor) -> None:
            raise AssertionError("nothing was painted")

    painter = AnalyticPainter(light(), Flaws(noise=0.05))
    with pytest.raises(Interrupted):
        estimate(PHOTO, painter, SETTINGS, observer=Stop())
    fresh = estimate(PHOTO, AnalyticPainter(light(), Flaws(noise=0.05)), SETTINGS)
    assert torch.equal(estimate(PHOTO, painter, SETTINGS).latlong_hdr, fresh.latlong_hdr)


def test_exposure_of_the_scene_is_the_painters_business() -> None:
    # EV 0 white is radiance 1, whatever scale the panorama was stored in.
    truth = light() * 100
    scaled = truth * auto_exposure(truth)
    probe = estimate(PHOTO, AnalyticPainter(scaled), SETTINGS)
    assert energy_kept(probe.latlong_hdr, scaled) == pytest.approx(1, abs=0.02)
