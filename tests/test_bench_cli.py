"""The contract of the benches: options, the report's layout, and that nothing is imported before it is asked for."""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import torch

from dl_core.bench import cli, report
from dl_core.errors import OptionError, OutputError
from dl_core.geometry import latlong_directions
from dl_core.imageio import write_exr, write_hdr


@pytest.fixture(scope="module")
def panoramas(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of two smooth maps, of two sizes and formats, and a file that is none."""
    folder = tmp_path_factory.mktemp("panoramas")
    write_exr(folder / "a.exr", torch.exp(latlong_directions(32)), metadata={})
    write_hdr(folder / "b.HDR", torch.exp(latlong_directions(24)))
    (folder / "notes.txt").write_text("no map")
    return folder


def parse(*options: str) -> argparse.Namespace:
    parser = argparse.ArgumentParser()
    cli.add_arguments(parser)
    return parser.parse_args(options)


def geometry(panoramas: Path, *options: str) -> argparse.Namespace:
    return parse("geometry", "--panoramas", str(panoramas), "--balls", "32", "64", *options)


def is_flat(record: dict[str, Any]) -> bool:
    return all(value is None or isinstance(value, str | int | float) for value in record.values())


def test_out_receives_what_json_prints(panoramas: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    target = tmp_path / "made" / "here"
    assert not cli.run(geometry(panoramas, "--out", str(target), "--json"))
    text = (target / "report.json").read_text(encoding="utf-8")
    assert text == capsys.readouterr().out
    result = json.loads(text)
    assert set(result) == {
        "bench", "protocol", "options", "environment", "seeds", "evaluations", "seconds", "summary", "rows",
    }  # fmt: skip
    assert {"lightprobe", "python", "torch", "commit", "threads"} <= set(result["environment"])
    assert (result["bench"], result["options"]) == (
        "geometry",
        {"balls": [32, 64], "unwrap": ["footprint"], "space": ["linear"]},
    )
    assert [(row["panorama"], row["ball_px"]) for row in result["rows"]] == [
        ("a", 32), ("a", 64), ("b", 32), ("b", 64),
    ]  # fmt: skip
    assert [line["ball_px"] for line in result["summary"]] == [32, 64]
    assert all(is_flat(record) for record in (*result["rows"], *result["summary"]))
    assert str(panoramas) not in text


def test_tables_are_printed_and_nothing_is_written(panoramas: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert not cli.run(geometry(panoramas))
    printed = capsys.readouterr().out
    assert "energy kept" in printed
    assert "geometry: 4 rows" in printed


@pytest.mark.parametrize("name", cli.BENCHES)
def test_every_bench_has_what_the_contract_names(name: str) -> None:
    module = cli.BENCHES[name].load()
    parser = argparse.ArgumentParser()
    module.add_arguments(parser)
    options = {option for action in parser._actions for option in action.option_strings}
    assert {"--out", "--json"} <= options
    assert callable(module.run)


@pytest.mark.parametrize("name", ["geometry", "oracle"])
def test_a_folder_without_maps_is_named(name: str, tmp_path: Path) -> None:
    for folder in (tmp_path, tmp_path / "missing"):
        with pytest.raises(OptionError, match="--panoramas"):
            cli.run(parse(name, "--panoramas", str(folder)))


def test_a_file_in_place_of_the_folder_is_named_before_anything_is_measured(panoramas: Path, tmp_path: Path) -> None:
    (tmp_path / "taken").write_text("")
    with pytest.raises(OutputError, match="taken"):
        cli.run(geometry(panoramas, "--out", str(tmp_path / "taken")))


def test_help_on_the_benches_imports_none_of_them() -> None:
    script = (
        "import sys; from dl_core.cli import main\n"
        "try: main(['bench', '--help'])\n"
        "except SystemExit as left: assert left.code == 0\n"
        "assert not {'torch', 'numpy', 'matplotlib'} & set(sys.modules)"
    )
    root = Path(cli.__file__).parents[2]
    done = subprocess.run([sys.executable, "-c", script], cwd=root, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    for name, bench in cli.BENCHES.items():
        assert name in done.stdout
        assert bench.summary[:20] in done.stdout


def test_the_worst_is_furthest_from_the_ideal() -> None:
    rows = [{"kept": kept} for kept in (1.02, 0.9, 1.0)]
    assert report.median_and_worst(rows, "kept", ideal=1.0) == {"kept_median": 1.0, "kept_worst": 0.9}
    assert report.median_and_worst(rows, "kept") == {"kept_median": 1.0, "kept_worst": 1.02}


def test_tables_are_aligned() -> None:
    columns = (report.Column("name", "a"), report.Column("value", "b", ".1f"))
    text = report.table([{"a": "long name", "b_median": 1.0, "b_worst": 2.0}, {"a": "x", "b": 3.0}], columns)
    heading, first, second = text.split("\n")
    assert heading.index("value") == first.index("1.0 / 2.0") == second.index("3.0")
