"""`bench protocol`: pairing, reduction and compression of maps, scores, and going on where a run stopped."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from dl_core.bench import scoring
from dl_core.bench.protocol import command as protocol
from dl_core.bench.protocol.command import given_maps
from dl_core.errors import ImageError, OptionError, OutputError
from dl_core.imageio import write_exr, write_hdr
from dl_core.picture_errors import CONVENTIONS
from dl_core.sphere_scene import AUTHORS_VIEW, View, view_coverage


@pytest.fixture(autouse=True)
def small_spheres(monkeypatch: pytest.MonkeyPatch) -> None:
    """Spheres of 16 pixels under maps of 16 rows: what is tested here does not depend on their size."""
    monkeypatch.setattr(scoring, "VIEW", View(31, 55, 8.0, AUTHORS_VIEW.distance, AUTHORS_VIEW.elevation))
    monkeypatch.setattr(scoring, "MAP_ROWS", 16)


@pytest.fixture
def folders(tmp_path: Path) -> tuple[Path, Path]:
    """Three pairs of maps; one pair has another size and format than its partner."""
    predicted, truth = tmp_path / "predicted", tmp_path / "truth"
    generator = torch.Generator().manual_seed(9)
    for folder in (predicted, truth):
        folder.mkdir()
        for name in ("a", "b"):
            write_exr(folder / f"{name}.exr", torch.rand(16, 32, 3, generator=generator) + 0.1, metadata={})
    write_exr(predicted / "c.exr", torch.full((24, 48, 3), 2.0), metadata={})
    write_hdr(truth / "c.hdr", torch.full((16, 32, 3), 1.0))
    return predicted, truth


def run(folders: tuple[Path, Path], *options: object, name: str = "three-spheres") -> None:
    parser = argparse.ArgumentParser()
    protocol.add_arguments(parser)
    words = [name, "--maps", folders[0], "--truth", folders[1], *options]
    assert not protocol.run(parser.parse_args([str(word) for word in words]))


# --- maps --------------------------------------------------------------------------------------------------------


@given(scale=st.floats(1e-3, 1e3), seed=st.integers(0, 99))
def test_compression_puts_the_median_of_the_light_at_one_half(scale: float, seed: int) -> None:
    latlong = torch.rand(1, 8, 16, 3, generator=torch.Generator().manual_seed(seed)) + 0.1
    latlong[:, :3] = 0  # left out of the median
    latlong[0, 5, 5] = 1e4  # not clipped
    compressed = scoring.compress(latlong * scale)
    lit = compressed[compressed > 0].double().numpy()
    assert np.median(lit) == pytest.approx(0.5, rel=1e-6)
    ratio = float(compressed[0, 5, 5, 0] / compressed[0, 6, 6, 0])
    assert ratio == pytest.approx((1e4 / float(latlong[0, 6, 6, 0])) ** (1 / 2.4), rel=1e-5)
    assert not scoring.compress(torch.zeros(1, 8, 16, 3)).any()


def test_the_sphere_covers_its_share_of_the_public_frame(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.undo()
    # The public renders have 61,451 pixels of 540 x 960 on the ball. Theirs is a polygon, ours a circle: 2% more.
    coverage = view_coverage(scoring.VIEW)
    assert coverage.shape == (540, 960)
    assert int((coverage > 0).sum()) == pytest.approx(61451 * 1.02, rel=0.01)


# --- scores ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("convention", ["published", "radiance"])
def test_a_map_has_no_error_against_itself_at_any_exposure(convention: str) -> None:
    latlong = torch.rand(1, 16, 32, 3, generator=torch.Generator().manual_seed(4)) + 0.1
    rows = given_maps.score_maps(latlong * 4, latlong, "three-spheres", convention)
    assert [row["sphere"] for row in rows] == list(scoring.SPHERES)
    for row in rows:
        for key in ("si_rmse", "angular_error_deg", "normalized_rmse"):
            # Rounding of float32 renders; the angle is the most sensitive: 1e-7 of a radian times a few.
            assert row[key] == pytest.approx(0, abs=1e-4)
        # Compression sets the exposure by itself, so even the plain error is nought.
        assert (row["rmse"] < 1e-4) == CONVENTIONS[convention].compressed


# --- runs --------------------------------------------------------------------------------------------------------


def test_a_run_reports_every_sphere_of_every_map(
    folders: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    run(folders, "--convention", "published", "--out", out, "--json")
    result = json.loads(capsys.readouterr().out)
    assert result == json.loads((out / "report.json").read_text(encoding="utf-8"))
    assert {(row["panorama"], row["sphere"]) for row in result["rows"]} == {
        (name, sphere) for name in "abc" for sphere in scoring.SPHERES
    }
    assert {"panorama", "sphere", "si_rmse", "angular_error_deg", "normalized_rmse"} <= set(result["rows"][0])
    assert [line["sphere"] for line in result["summary"]] == list(scoring.SPHERES)
    assert result["protocol"]["convention"] == "published"
    assert str(tmp_path) not in json.dumps(result)
    assert str(tmp_path) not in (out / "rows.jsonl").read_text(encoding="utf-8")
    # The last pair differs in exposure alone.
    assert all(row["si_rmse"] < 1e-4 for row in result["rows"] if row["panorama"] == "c")


def test_the_array_is_scored_whole_and_its_medians_are_printed(
    folders: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run(folders, "--convention", "published-array", "--out", tmp_path / "out", name="array")
    assert "median si-RMSE" in capsys.readouterr().out
    report = json.loads((tmp_path / "out" / "report.json").read_text(encoding="utf-8"))
    errors = {row["panorama"]: row for row in report["rows"]}
    assert {row["sphere"] for row in report["rows"]} == {"array"}
    (line,) = report["summary"]
    assert line["si_rmse_median"] == sorted(row["si_rmse"] for row in report["rows"])[1]
    # The last pair is twice as bright, everywhere: nothing of the frame is masked, and nothing is compressed.
    assert errors["c"]["si_rmse"] < 1e-4
    picture = scoring.render_nine(torch.ones(1, 16, 32, 3))["array"].pictures
    assert errors["c"]["rmse"] == pytest.approx(float(picture.square().mean().sqrt()), rel=1e-4)


@pytest.mark.parametrize(("name", "convention"), [("array", "published"), ("three-spheres", "published-array")])
def test_a_convention_of_another_protocol_is_refused(name: str, convention: str, folders: tuple[Path, Path]) -> None:
    with pytest.raises(
        OptionError, match=rf"--convention is '{convention}'; accepted: .*radiance with protocol {name}"
    ):
        run(folders, "--convention", convention, name=name)


def untimed(*records: dict[str, Any]) -> list[dict[str, Any]]:
    return [{key: value for key, value in record.items() if key != "score_seconds"} for record in records]


def test_a_stopped_run_goes_on_and_loses_one_image_at_most(
    folders: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out, journal = tmp_path / "out", tmp_path / "out" / "rows.jsonl"
    run(folders, "--out", out)
    whole, report = journal.read_text(encoding="utf-8"), json.loads((out / "report.json").read_text(encoding="utf-8"))
    (out / "report.json").unlink()
    scored: list[Path] = []
    read = given_maps.read_envmap
    monkeypatch.setattr(given_maps, "read_envmap", lambda path: scored.append(path) or read(path))
    journal.write_text(whole[:-40], encoding="utf-8")  # killed while the last line was written
    run(folders, "--out", out)
    assert [path.stem for path in scored] == ["c", "c"]
    assert untimed(*map(json.loads, journal.read_text(encoding="utf-8").splitlines())) == untimed(
        *map(json.loads, whole.splitlines())
    )
    again = json.loads((out / "report.json").read_text(encoding="utf-8"))
    assert untimed(*again["rows"]) == untimed(*report["rows"])


def test_a_run_with_other_options_is_refused_and_touches_nothing(folders: tuple[Path, Path], tmp_path: Path) -> None:
    out = tmp_path / "out"
    run(folders, "--out", out)
    before = (out / "rows.jsonl").read_text(encoding="utf-8")
    with pytest.raises(OutputError, match=r"rows\.jsonl: was begun with other options \(convention 'radiance'\)"):
        run(folders, "--out", out, "--convention", "published")
    with pytest.raises(OutputError, match="folders"):
        run((folders[1], folders[0]), "--out", out)
    assert (out / "rows.jsonl").read_text(encoding="utf-8") == before


def test_maps_without_a_partner_are_named(folders: tuple[Path, Path]) -> None:
    (folders[1] / "b.exr").unlink()
    with pytest.raises(ImageError, match="--truth: has no partner for 1 maps of the other folder: b"):
        run(folders)
    with pytest.raises(ImageError, match="--maps: has no partner for 1 maps of the other folder: b"):
        run((folders[1], folders[0]))


def test_folders_are_checked(folders: tuple[Path, Path], tmp_path: Path) -> None:
    with pytest.raises(OptionError, match="--truth"):
        run((folders[0], tmp_path / "none"))
    write_hdr(folders[0] / "a.hdr", torch.ones(4, 8, 3))
    with pytest.raises(OptionError, match=r"--maps.*in another format too"):
        run(folders)
