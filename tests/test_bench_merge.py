"""The benches: that they measure what they say, over maps whose answers are known, and write it down whole."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import pytest
import torch

from dl_core.bench import cli, geometry, merge
from dl_core.bench.reference import reference_merge, reference_unwrap
from dl_core.bench.skies import SunAndSky
from dl_core.errors import OptionError
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
    records = merge.bench_merge(cli.panorama_files(panoramas))
    found = {(record["panorama"], record["row"]): record for record in records}
    assert len(found) == 2 * len(merge.ROWS)
    smooth = {row: found["smooth", row] for row in merge.ROWS}
    # Within the bracket 8-bit merging by channel costs next to nothing against the true HDR ball.
    assert smooth["channel"]["energy_kept"] == pytest.approx(smooth["hdr"]["energy_kept"], abs=2e-3)
    assert smooth["channel"]["si_rmse"] < 0.01
    assert smooth["channel"]["si_rmse"] <= smooth["reference"]["si_rmse"]
    assert smooth["channel"]["angular_error"] < 0.1
    # A sun above the ceiling is lost by any merge of the short bracket, less of it by the long one's.
    sun = {row: found["sun", row]["energy_kept"] for row in merge.ROWS}
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
        {"panorama": str(i), "row": row, "energy_kept": kept, "si_rmse": i / 10, "angular_error": float(i)}
        for row in merge.ROWS
        for i, kept in enumerate((1.02, 0.9, 1.0))
    ]
    first = merge.summarize(records)[0]
    assert first["energy_kept"] == {"median": 1.0, "worst": 0.9}
    assert first["si_rmse"] == {"median": 0.1, "worst": 0.2}
    assert first["panoramas"] == 3


# --- geometry ----------------------------------------------------------------------------------------------------


def test_round_trips_of_a_smooth_map_cost_nothing_much(panoramas: Path) -> None:
    small, large = geometry.bench_geometry([panoramas / "smooth.exr"], balls=(64, 256))
    for record in (small, large):
        assert record["ball_energy"] == pytest.approx(1, abs=2e-3)
        assert record["map_energy"] == pytest.approx(1, abs=2e-3)
    assert large["display_rmse"] < small["display_rmse"]


# --- the command -------------------------------------------------------------------------------------------------


def test_the_command_prints_tables_and_writes_json(
    panoramas: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    target = tmp_path / "result.json"
    assert cli.run(parse("merge", "--panoramas", str(panoramas), "--json", str(target))) == 0
    printed = capsys.readouterr().out
    for row in merge.ROWS.values():
        assert row.label in printed
    result = json.loads(target.read_text(encoding="utf-8"))
    assert set(result) == {
        "bench", "protocol", "options", "environment", "seeds", "evaluations", "seconds", "summary", "records",
    }  # fmt: skip
    assert {"lightprobe", "python", "torch", "commit", "threads"} <= set(result["environment"])
    assert result["options"] == {"exposure": "map"}
    assert len(result["records"]) == 2 * len(merge.ROWS)
    assert str(panoramas) not in target.read_text(encoding="utf-8")


def test_json_without_a_file_is_all_that_is_printed(panoramas: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.run(parse("geometry", "--panoramas", str(panoramas), "--balls", "32", "64", "--json")) == 0
    result = json.loads(capsys.readouterr().out)
    assert (result["bench"], result["options"]) == ("geometry", {"balls": [32, 64]})
    assert [line["ball"] for line in result["summary"]] == [32, 64]


@pytest.mark.parametrize("name", cli.BENCHES)
def test_a_folder_without_maps_is_named(name: str, tmp_path: Path) -> None:
    for folder in (tmp_path, tmp_path / "missing"):
        with pytest.raises(OptionError, match="--panoramas"):
            cli.run(parse(name, "--panoramas", str(folder)))


def test_tables_are_aligned() -> None:
    columns = (cli.Column("name", "a"), cli.Column("value", "b", ".1f"))
    text = cli.table([{"a": "long name", "b": {"median": 1.0, "worst": 2.0}}, {"a": "x", "b": 3.0}], columns)
    heading, first, second = text.split("\n")
    assert heading.index("value") == first.index("1.0 / 2.0") == second.index("3.0")
