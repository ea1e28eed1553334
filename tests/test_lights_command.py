"""`lightprobe lights` and `lightprobe bench lights`: what they print, write and refuse."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest
import torch

from dl_core.bench import lights as bench
from dl_core.cli import main
from dl_core.geometry import latlong_directions
from dl_core.imageio import write_exr
from dl_core.lights.model import LightModel
from dl_core.lights.search import Candidate


def sun_and_sky() -> torch.Tensor:
    """(64, 128, 3): brighter upwards, and a lamp of 5 degrees to the upper right that sends 6, 5 and 4."""
    directions = latlong_directions(64)
    lamp = (directions @ torch.tensor([0.8, 0.6, 0.0]) > math.cos(math.radians(5))).float()[..., None]
    radiance = torch.tensor([6.0, 5.0, 4.0]) / (math.pi * math.sin(math.radians(5)) ** 2)
    return 0.5 + 0.2 * directions[..., 1:2] + lamp * radiance


@pytest.fixture
def latlong(tmp_path: Path) -> Path:
    return write_exr(tmp_path / "map.exr", sun_and_sky(), metadata={}, half=False)


# --- lights ------------------------------------------------------------------------------------------------------


def test_json_keeps_the_contract(latlong: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["lights", str(latlong), "--tolerance", "0.05", "--materials", "diffuse,matte", "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["model"] == "sh2 + 1 area"
    assert facts["parameters"] == 33
    assert 0 < facts["relative_error"] <= 0.05
    (lamp,) = facts["lights"]
    assert math.hypot(*lamp["direction"]) == pytest.approx(1)
    assert lamp["direction"] == pytest.approx([0.8, 0.6, 0.0], abs=0.01)
    # A disc of pixels of 2.8 degrees, each in or out by its centre: its area is a tenth off.
    assert lamp["irradiance"] == pytest.approx([6, 5, 4], rel=0.12)
    assert lamp["angular_radius_deg"] == pytest.approx(5, abs=0.5)
    assert set(facts["levels"]) == {"0.01", "0.05"}
    for level, choice in facts["levels"].items():
        assert choice["relative_error"] <= float(level)
        assert choice["parameters"] >= facts["parameters"] or float(level) == 0.05
    assert set(facts["errors"]) == set(facts["map_errors"]) == {"diffuse", "matte"}


def test_a_table_is_printed_and_files_are_written(
    latlong: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("a.json", "a.gltf", "a.usda"):
        assert main(["lights", str(latlong), "--materials", "diffuse", "--export", str(tmp_path / name)]) == 0
        printed = capsys.readouterr().out
        assert str(tmp_path / name) in printed
        assert (tmp_path / name).stat().st_size > 0
    chosen = next(line for line in printed.splitlines() if "<- chosen" in line)
    assert chosen.startswith("sh2 + 1 directional")
    assert "light 89.8 degrees right" in printed or "light 90" in printed
    assert (tmp_path / "a.dome.exr").is_file()
    assert not [path for path in tmp_path.iterdir() if path.name.startswith(".")]


@pytest.mark.parametrize(
    ("options", "code", "message"),
    [
        (("--tolerance", "0"), 2, "tolerance is 0.0; accepted: above 0, below 1"),
        (("--tolerance", "nan"), 2, "tolerance is nan"),
        (("--materials", "diffuse,chrome"), 2, "materials is 'chrome'; accepted: diffuse, matte, mirror"),
        (("--materials", ","), 2, "one or more of diffuse, matte, mirror"),
        (("--export", "a.fbx"), 2, "a.fbx"),
        (("--export", "missing/a.json"), 1, "does not exist"),
    ],
)
def test_options_that_do_not_serve_are_named(
    latlong: Path, options: tuple[str, str], code: int, message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["lights", str(latlong), *options]) == code
    printed = capsys.readouterr()
    assert message in printed.err
    assert not printed.out


def test_maps_that_do_not_serve_are_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "text.exr").write_text("no map")
    dark = write_exr(tmp_path / "dark.exr", torch.zeros(8, 16, 3), metadata={})
    for path, message in ((tmp_path / "text.exr", "neither an EXR"), (dark, "no light"), (tmp_path / "gone", "gone")):
        assert main(["lights", str(path)]) == 1
        assert message in capsys.readouterr().err


# --- bench -------------------------------------------------------------------------------------------------------


@pytest.fixture
def panoramas(tmp_path: Path) -> Path:
    folder = tmp_path / "maps"
    folder.mkdir()
    write_exr(folder / "even.exr", torch.ones(32, 64, 3), metadata={})
    write_exr(folder / "sun.exr", sun_and_sky(), metadata={}, half=False)
    noise = torch.rand(32, 64, 3, generator=torch.Generator().manual_seed(0)) ** 8
    write_exr(folder / "noise.exr", noise, metadata={})
    return folder


def test_the_bench_counts_what_maps_need_and_goes_on(
    panoramas: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["bench", "lights", "--panoramas", str(panoramas), "--out", str(tmp_path / "out"), "--json"]
    assert main(command) == 0
    first = json.loads(capsys.readouterr().out)
    assert len(first["rows"]) == 3 * 4 * 2
    lines = {(line["materials"], line["level"]): line for line in first["summary"]}
    assert lines["mirror", 0.05]["full_map"] == 2  # the lamp is of pixels that a mirror shows
    assert lines["mirror", 0.05]["ambient"] == 1
    assert lines["diffuse", 0.05]["full_map"] == 0
    assert lines["diffuse", 0.05]["sh2_and_one_light"] == 3
    for line in lines.values():
        assert sum(line[kind] for kind in bench.CLASSES) == line["panoramas"] == 3
        assert line["seconds_worst"] >= line["seconds_median"] > 0
    assert first["prepare_seconds"] > 0
    assert first["prepare_cpu_seconds"] > 0
    monkeypatch.setattr(bench, "_decide", None)  # all is there
    assert main(command) == 0
    assert json.loads(capsys.readouterr().out)["rows"] == first["rows"]
    (panoramas / "even.exr").unlink()
    assert main(command) == 1
    assert "other options" in capsys.readouterr().err


def test_kinds_of_light_are_told_apart() -> None:
    harmonics = torch.zeros(9, 3, dtype=torch.float64)
    assert bench._class(Candidate(None, 10, {"diffuse": 0.0})) == "full_map"
    assert bench._class(Candidate(LightModel(harmonics[:4]), 12, {"diffuse": 0.0})) == "sh1"
