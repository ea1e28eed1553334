"""The benches: that they measure what they say, over maps whose answers are known, and write it down whole."""

from __future__ import annotations

import argparse
from pathlib import Path

import pytest
import torch

from dl_core.bench import cli, geometry, merge, report
from dl_core.bench.reference import reference_merge, reference_unwrap
from dl_core.bench.skies import SunAndSky
from dl_core.exposure import quantize
from dl_core.geometry import ball_to_latlong, latlong_directions, latlong_to_ball
from dl_core.imageio import write_exr


@pytest.fixture(scope="module")
def panoramas(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of two maps: one within the bracket, one whose sun is far above it."""
    folder = tmp_path_factory.mktemp("panoramas")
    write_exr(folder / "smooth.exr", torch.exp(latlong_directions(32)), metadata={})
    write_exr(folder / "sun.exr", SunAndSky(sun_radius=1.5, sun_irradiance=(9.0, 7.0, 5.0)).latlong(32)[0], metadata={})
    return folder


def parse(*options: str) -> argparse.Namespace:
    parser = argparse.ArgumentParser()
    cli.add_arguments(parser)
    return parser.parse_args(options)


# --- the reference -----------------------------------------------------------------------------------------------


def test_the_references_map_doubles_the_seam_and_the_poles() -> None:
    # Supersampling 4 and a resize: the first and last column are averages of mirror-image neighbourhoods of one
    # direction, so for a map symmetric about the seam they agree to rounding.
    symmetric = torch.exp(latlong_directions(64)[..., 1:])[None]
    found = reference_unwrap(latlong_to_ball(symmetric, 128), 32)
    torch.testing.assert_close(found[:, :, 0], found[:, :, -1], rtol=1e-4, atol=1e-4)


def test_the_reference_finds_the_light_but_less_well() -> None:
    latlong = torch.exp(3 * latlong_directions(64))[None]
    ball = latlong_to_ball(latlong, 256)
    errors = [
        float((unwrap(ball, 64) - latlong).square().mean().sqrt() / latlong.square().mean().sqrt())
        for unwrap in (reference_unwrap, ball_to_latlong)
    ]
    # Half a pixel of radius and half a column of the grid; the description measured 0.037 on real maps.
    assert 0.005 < errors[0] < 0.08
    assert errors[1] < errors[0]


def test_the_reference_rounds_to_8_bits_before_and_after_unwrapping() -> None:
    ball = torch.full((1, 32, 32, 3), 0.5)
    found = reference_merge([ball], (0.0,), 16)
    torch.testing.assert_close(found, quantize(torch.full_like(found, 0.5)) ** 2.4, rtol=1e-4, atol=1e-6)


# --- merge -------------------------------------------------------------------------------------------------------


def test_the_channel_merge_is_limited_by_the_bracket_alone(panoramas: Path) -> None:
    records = merge.bench_merge(report.panorama_files(panoramas))
    found = {(record["panorama"], record["way"]): record for record in records}
    assert len(found) == 2 * len(merge.WAYS)
    smooth = {row: found["smooth", row] for row in merge.WAYS}
    # Within the bracket 8-bit merging by channel costs next to nothing against the true HDR ball.
    assert smooth["channel"]["energy_kept"] == pytest.approx(smooth["hdr"]["energy_kept"], abs=2e-3)
    assert smooth["channel"]["irradiance_si_rmse"] < 0.01
    assert smooth["channel"]["irradiance_si_rmse"] <= smooth["reference"]["irradiance_si_rmse"]
    assert smooth["channel"]["irradiance_angular_error_deg"] < 0.1
    # A sun above the ceiling is lost by any merge of the short bracket, less of it by the long one's.
    sun = {row: found["sun", row]["energy_kept"] for row in merge.WAYS}
    assert sun["channel"] < 0.9
    assert sun["channel"] == pytest.approx(sun["ceiling"], abs=5e-3)
    assert sun["channel"] < sun["channel-long"] <= 1.01
    assert sun["hdr"] == pytest.approx(1, abs=5e-3)


def test_exposure_may_be_set_on_the_papers_crop(panoramas: Path) -> None:
    files = [panoramas / "smooth.exr"]
    on_map, on_crop = (merge.bench_merge(files, exposure)[0] for exposure in merge.EXPOSURES)
    assert on_map["energy_kept"] != on_crop["energy_kept"]


def test_the_summary_is_median_and_worst() -> None:
    records = [
        {
            "panorama": str(i),
            "way": way,
            "energy_kept": kept,
            "irradiance_si_rmse": i / 10,
            "irradiance_angular_error_deg": float(i),
        }
        for way in merge.WAYS
        for i, kept in enumerate((1.02, 0.9, 1.0))
    ]
    first = merge.summarize(records)[0]
    assert (first["energy_kept_median"], first["energy_kept_worst"]) == (1.0, 0.9)
    assert (first["irradiance_si_rmse_median"], first["irradiance_si_rmse_worst"]) == (0.1, 0.2)
    assert first["panoramas"] == 3


# --- geometry ----------------------------------------------------------------------------------------------------


def test_round_trips_of_a_smooth_map_cost_nothing_much(panoramas: Path) -> None:
    small, large = geometry.bench_geometry([panoramas / "smooth.exr"], balls=(64, 256))
    for record in (small, large):
        assert record["ball_energy"] == pytest.approx(1, abs=2e-3)
        assert record["energy_kept"] == pytest.approx(1, abs=2e-3)
    assert large["ldr_rmse"] < small["ldr_rmse"]
