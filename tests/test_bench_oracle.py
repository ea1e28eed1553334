"""The benches: that they measure what they say, over maps whose answers are known, and write it down whole."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import pytest
import torch

from dl_core.bench import cli, geometry, oracle, report
from dl_core.bench.reference import reference_merge, reference_unwrap
from dl_core.bench.skies import SunAndSky
from dl_core.errors import ImageError, OptionError, OutputError
from dl_core.exposure import MERGES, quantize
from dl_core.geometry import ball_to_latlong, latlong_directions, latlong_to_ball
from dl_core.imageio import write_exr
from dl_core.presets import PAPER_EVS
from dl_core.radiance import encode_picture


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


# --- oracle ------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def aligned(panoramas: Path) -> dict[tuple[str, str, str, str], dict[str, Any]]:
    """Rows of both brackets and all merges on aligned exposures, by panorama, EVs, merge and unwrap."""
    cases = list(oracle._cases([oracle.ALIGNED], [PAPER_EVS, oracle.LONG_EVS], oracle.WAYS, list(oracle.UNWRAPS)))
    rows = oracle.bench_oracle(report.panorama_files(panoramas), cases, ball=128)
    return {(row["panorama"], row["evs"], row["merge"], row["unwrap"]): row for row in rows}


SHORT, LONG = "0,-2.5,-5", "0,-2.5,-5,-7.5,-10"


def test_within_the_bracket_merging_costs_next_to_nothing(aligned: dict[Any, dict[str, Any]]) -> None:
    smooth = {merge: aligned["smooth", SHORT, merge, "footprint"] for merge in (*MERGES, "hdr")}
    for merge in ("robust", "channel"):
        # 8 bits are within 1.1% of each value, and average out over the sphere.
        assert smooth[merge]["energy_kept"] == pytest.approx(smooth["hdr"]["energy_kept"], abs=2e-3)
        assert smooth[merge]["irradiance_si_rmse"] < 0.01
        assert smooth[merge]["irradiance_angular_error_deg"] < 0.1
        authors = aligned["smooth", SHORT, "reference", "reference"]
        assert smooth[merge]["irradiance_si_rmse"] <= authors["irradiance_si_rmse"]


def test_robust_is_no_worse_than_channel_when_aligned(aligned: dict[Any, dict[str, Any]]) -> None:
    for panorama in ("smooth", "sun"):
        for evs in (SHORT, LONG):
            for unwrap in oracle.UNWRAPS:
                robust, channel = (aligned[panorama, evs, merge, unwrap] for merge in ("robust", "channel"))
                for key in oracle.IDEALS:
                    # The same values but for float32 roundings.
                    assert robust[key] == pytest.approx(channel[key], rel=1e-4, abs=1e-6)


def test_a_sun_above_the_ceiling_is_lost_less_of_it_by_a_longer_bracket(aligned: dict[Any, dict[str, Any]]) -> None:
    kept = {evs: aligned["sun", evs, "robust", "footprint"]["energy_kept"] for evs in (SHORT, LONG)}
    assert kept[SHORT] < 0.9
    assert kept[SHORT] < kept[LONG] <= 1.02
    # Nothing but the bracket limits the merge: 8-bit codes average out.
    assert kept[SHORT] == pytest.approx(aligned["sun", SHORT, "ceiling", "footprint"]["energy_kept"], abs=5e-3)
    # A ball of 128 pixels and a sun of 1.5 degrees: its rim straddles pixels of 1.8 degrees.
    assert aligned["sun", SHORT, "hdr", "footprint"]["energy_kept"] == pytest.approx(1, abs=0.01)


def test_nothing_but_the_ceiling_limits_the_merge(aligned: dict[Any, dict[str, Any]]) -> None:
    for panorama in ("smooth", "sun"):
        for evs in (SHORT, LONG):
            merged, ceiling = (aligned[panorama, evs, way, "footprint"] for way in ("robust", "ceiling"))
            # 8-bit codes are within 1.1% of each value of a light, 0.4% in the mean square.
            assert merged["irradiance_si_rmse"] <= ceiling["irradiance_si_rmse"] + 0.004


def test_exposure_may_be_set_on_the_papers_crop(panoramas: Path) -> None:
    cases = [oracle.Case(oracle.ALIGNED, PAPER_EVS, "robust", "footprint")]
    files = [panoramas / "smooth.exr"]
    on_map, on_crop = (oracle.bench_oracle(files, cases, ball=64, exposure=name)[0] for name in oracle.EXPOSURES)
    assert on_map["energy_kept"] != on_crop["energy_kept"]


def test_the_command_reports_and_draws(panoramas: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    options = ["--panoramas", str(panoramas), "--evs", "0,-2.5,-5", "--merge", "robust", "paper", "--ball", "32"]
    options += ["--unwrap", "footprint", "--misaligned", "shift-2", "--out", str(tmp_path), "--json"]
    assert not cli.run(parse("oracle", *options))
    result = json.loads(capsys.readouterr().out)
    assert json.loads((tmp_path / "report.json").read_text(encoding="utf-8")) == result
    assert [(row["panorama"], row["merge"], row["misaligned"]) for row in result["rows"]] == [
        (panorama, merge, "shift-2") for panorama in ("smooth", "sun") for merge in ("robust", "paper")
    ]
    for row in result["rows"]:
        assert row.keys() >= {"evs", "ball_px", *oracle.IDEALS}
    assert len(result["summary"]) == 2
    assert (tmp_path / "oracle.png").read_bytes().startswith(b"\x89PNG")
    assert b"<svg" in (tmp_path / "oracle.svg").read_bytes()


def test_a_stopped_run_goes_on_and_another_is_refused(panoramas: Path, tmp_path: Path) -> None:
    options = ["--panoramas", str(panoramas), "--evs", "0,-2.5", "--merge", "robust", "--ball", "32"]
    options += ["--out", str(tmp_path), "--json"]
    cli.run(parse("oracle", *options))
    whole, journal = (tmp_path / "report.json"), tmp_path / "rows.jsonl"
    rows = json.loads(whole.read_text(encoding="utf-8"))["rows"]
    # Stopped while the second panorama was written; the first one's rows are marked, to see that they are kept.
    lines = journal.read_text(encoding="utf-8").replace('"ball_px": 32', '"ball_px": 32.5').splitlines()
    journal.write_text("\n".join(lines[:-1]) + '\n{"panorama": "su', encoding="utf-8")
    cli.run(parse("oracle", *options))
    again = json.loads(whole.read_text(encoding="utf-8"))["rows"]
    assert [row.pop("ball_px") for row in again] == [32.5, 32.5, 32, 32]
    for row in rows:
        del row["ball_px"]
    assert again == rows
    with pytest.raises(OutputError, match="seed 0"):
        cli.run(parse("oracle", *options, "--seed", "1"))


def test_two_maps_of_one_name_are_refused(panoramas: Path, tmp_path: Path) -> None:
    for name in ("a.exr", "a.hdr"):
        (tmp_path / name).write_bytes((panoramas / "smooth.exr").read_bytes())
    with pytest.raises(OptionError, match="one map of a name"):
        cli.run(parse("oracle", "--panoramas", str(tmp_path)))


def test_a_map_that_is_not_2_to_1_is_named(tmp_path: Path) -> None:
    (tmp_path / "square.hdr").write_bytes(encode_picture(torch.ones(16, 16, 3).numpy()))
    with pytest.raises(ImageError, match=r"square\.hdr"):
        cli.run(parse("oracle", "--panoramas", str(tmp_path)))


@pytest.mark.parametrize(
    ("options", "name"),
    [(["--evs", "0;-2"], "evs"), (["--evs", "0,-2,-2"], "evs"), (["--ball", "2"], "--ball")],
)
def test_options_out_of_range_are_named(options: list[str], name: str, panoramas: Path) -> None:
    with pytest.raises(OptionError) as raised:
        cli.run(parse("oracle", "--panoramas", str(panoramas), *options))
    assert raised.value.name == name


# --- geometry ----------------------------------------------------------------------------------------------------


def test_round_trips_of_a_smooth_map_cost_nothing_much(panoramas: Path) -> None:
    small, large = geometry.bench_geometry([panoramas / "smooth.exr"], balls=(64, 256))
    for record in (small, large):
        assert record["ball_energy"] == pytest.approx(1, abs=2e-3)
        assert record["energy_kept"] == pytest.approx(1, abs=2e-3)
    assert large["ldr_rmse"] < small["ldr_rmse"]


def test_spaces_trade_light_for_what_a_display_shows(panoramas: Path) -> None:
    """Encoded means of bright and dark values are darker than linear ones (Jensen); split ones lie between."""
    rows = geometry.bench_geometry([panoramas / "sun.exr"], balls=(64,), spaces=tuple(geometry.SPACES))
    linear, encoded, split = rows
    assert encoded["energy_kept"] < split["energy_kept"] < linear["energy_kept"] + 1e-4
    assert linear["energy_kept"] == pytest.approx(1, abs=3e-3)  # as geometry keeps a light of one map pixel
    assert linear["highlight_energy"] > encoded["highlight_energy"]


def test_a_map_without_highlights_has_none_to_keep(tmp_path: Path) -> None:
    write_exr(tmp_path / "grey.exr", torch.ones(16, 32, 3), metadata={})
    rows = geometry.bench_geometry([tmp_path / "grey.exr"], balls=(32,))
    assert rows[0]["highlight_energy"] is None  # the whole map lies at 0.9 on display
    assert geometry.summarize(rows)[0]["highlight_energy"] is None
