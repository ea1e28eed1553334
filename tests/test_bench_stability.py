"""The bench of stability: its changes against photographs of changed scenes, its distances against closed forms."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest
import torch

from dl_core.backends.diffusers_painter import DiffusersPainter
from dl_core.backends.mini import MiniModel
from dl_core.bench.cameras import Camera, take
from dl_core.bench.map_distance import map_distance
from dl_core.bench.painters import PAINTERS, Studio
from dl_core.bench.perfect import PerfectPainter
from dl_core.bench.stability import command, measure
from dl_core.bench.stability.changes import INVARIANCES, Change
from dl_core.bench.stability.failures import FAILURES
from dl_core.bench.stability.measure import Grid, Panorama, mean_distance
from dl_core.bench.stability.precision import precision_rows
from dl_core.cli import main
from dl_core.confidence import FLOOR
from dl_core.estimate import Settings
from dl_core.exposure import decode_display, expose
from dl_core.geometry import latlong_directions
from dl_core.imageio import write_exr
from dl_core.iterative import Rounds

CHANGES = {f"{change.family}, {change.variant}": change for change in INVARIANCES}
HARD = {f"{failure.family}, {failure.variant}": failure for failure in FAILURES}
ROUNDS = Rounds(3, 1, 0.8, 2, final=False)


def scene() -> torch.Tensor:
    """(1, 64, 128, 3): another colour in each direction, none above white at EV 0 on any side."""
    directions = latlong_directions(64)
    return (0.4 + 0.3 * directions + 0.05 * torch.sin(4 * directions.flip(-1)))[None]


def by_name(family: str, part: str) -> Change:
    return next(change for name, change in CHANGES.items() if name.startswith(family) and part in name)


@pytest.fixture
def panoramas(tmp_path: Path) -> Path:
    folder = tmp_path / "maps"
    folder.mkdir()
    write_exr(folder / "sides.exr", scene()[0], metadata={})
    return folder


def perfect(files: object) -> Studio:
    return Studio(lambda variant, shot: PerfectPainter(shot.truth_hdr), 128, 64)


@pytest.mark.parametrize("change", CHANGES.values(), ids=list(CHANGES))
def test_a_change_undone_is_the_scene_again(change: Change) -> None:
    again = change.back(change.forth(scene()))
    assert map_distance(again, scene()) < 0.01
    if change.family not in ("shift",):  # a turned map is sampled twice
        assert torch.allclose(again, scene(), atol=1e-5)


def test_the_mirrored_photograph_is_that_of_the_mirrored_scene() -> None:
    shot, change = take(scene(), Camera()), by_name("mirroring", "")
    assert (take(change.forth(scene()), Camera()).photo_ldr - change.of(shot).photo_ldr).abs().max() < 1e-4


@pytest.mark.parametrize("part", ["2%", "5%", "10%"])
def test_the_window_at_the_side_is_what_a_turned_camera_sees(part: str) -> None:
    """At its centre exactly; the unmoved window shows something else there."""
    change = by_name("shift", part)
    shot = take(scene(), Camera())
    moved, turned = change.of(shot).photo_ldr, expose(take(change.forth(shot.truth_hdr), Camera()).truth_hdr, 0.0)

    def middle(picture: torch.Tensor) -> torch.Tensor:
        rows, columns = picture.shape[1:3]
        return picture[0, rows // 2 - 1 : rows // 2 + 1, columns // 2 - 1 : columns // 2 + 1].mean(dim=(0, 1))

    # A turned map has its centre straight ahead; both exposures are set on nearly the same picture.
    ratio = decode_display(middle(moved)) / decode_display(middle(turned))
    still = decode_display(middle(shot.photo_ldr)) / decode_display(middle(turned))
    assert (ratio / ratio.mean() - 1).abs().max() < 0.02
    assert (still / still.mean() - 1).abs().max() > (ratio / ratio.mean() - 1).abs().max()


@pytest.mark.parametrize("change", [c for c in INVARIANCES if c.family in ("exposure", "white balance")])
def test_gains_are_those_of_light_up_to_white(change: Change) -> None:
    shot = take(scene(), Camera())
    expected = change.forth(decode_display(shot.photo_ldr)).clamp(max=1)
    assert (decode_display(change.of(shot).photo_ldr) - expected).abs().max() < 0.02  # 8 bits of a gamma of 2.4


def test_distances_are_stops() -> None:
    dark = torch.full((1, 16, 32, 3), 0.25)
    expected = math.log2((0.5 + FLOOR) / (0.25 + FLOOR))
    assert map_distance(2 * dark, dark) == pytest.approx(expected, rel=1e-5)
    half = dark.clone()
    half[:, :8] *= 2
    assert map_distance(half, dark) == pytest.approx(expected / 2, rel=1e-4)
    assert mean_distance([dark, 2 * dark, 2 * dark]) == pytest.approx(expected * 2 / 3, rel=1e-5)


def test_hard_photographs_show_what_they_say() -> None:
    floor = scene()
    floor[:, 56:] = torch.tensor([0.5, 0.05, 0.05])  # the lowest 22 degrees are red
    overhead = HARD["overhead, elevation -90"].of(floor)
    assert (overhead.photo_ldr[0, 90:102, 120:136, 0] > 2 * overhead.photo_ldr[0, 90:102, 120:136, 1]).all()
    ordinary = HARD["ordinary, level, 60 degrees high"].of(scene())
    assert len(HARD["style, 2 levels a channel"].of(scene()).photo_ldr.unique()) == 2
    grey = HARD["style, grey"].of(scene()).photo_ldr
    assert torch.equal(grey[..., :1].expand_as(grey), grey)
    drawing = HARD["style, line drawing"].of(torch.full((1, 64, 128, 3), 0.3)).photo_ldr
    assert (drawing == 1).all()  # nothing to draw
    for name in ("white", "black"):
        empty = HARD[f"empty background, {name}"].of(scene()).photo_ldr
        assert len(empty.unique()) == 1
        assert torch.equal(HARD[f"empty background, {name}"].of(scene()).truth_hdr, ordinary.truth_hdr)


def test_the_shaded_object_is_lit_by_the_scene() -> None:
    """In even light L a diffuse sphere has radiance albedo times L all over."""
    even = HARD["empty background, black, with a shaded object"].of(torch.full((1, 64, 128, 3), 0.3))
    inside = even.photo_ldr[even.photo_ldr > 0.1]
    level = 0.9**2.4 * 0.8  # an even scene is exposed to 0.9 on display
    assert inside.median() == pytest.approx(level ** (1 / 2.4), abs=0.01)
    assert 0.03 < len(inside) / even.photo_ldr.numel() < 0.09


def test_rounding_is_small_and_slopes_are_right() -> None:
    rows = {(row["family"], row["variant"]): row["distance"] for row in precision_rows()}
    assert len(rows) == 14
    assert all(value < 1e-5 for (family, _), value in rows.items() if family == "round-off")
    assert all(value < 1e-6 for (family, name), value in rows.items() if family == "gradient" and "unwrap" in name)
    # Where one exposure takes over from another their measured ratio is a constant to the gradient.
    assert all(math.isfinite(value) for value in rows.values())
    assert rows["gradient", "merge, blacks"] < 1e-6


def test_behind_a_perfect_painter_nothing_matters_and_runs_go_on(
    panoramas: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(PAINTERS, "true", perfect)
    monkeypatch.setitem(command.GRIDS, "small", Grid(2, 2, ((1, 0), (3, 1)), (2,), 2))
    out = tmp_path / "out"
    asked = ["bench", "stability", "--panoramas", str(panoramas), "--painter", "true", "--out", str(out), "--json"]
    assert main(asked) == 0
    report = json.loads(capsys.readouterr().out)
    rows = {(row["family"], row["variant"]): row for row in report["rows"]}
    assert {"family", "variant", "distance", "seed_distance", "ratio"} <= set(report["rows"][0])
    for change in INVARIANCES:
        row = rows[change.family, change.variant]
        assert row["distance"] < 0.05, change  # the ball's own resolution, and a map turned twice
        assert row["seed_distance"] == 0
        assert row["ratio"] is None
    for failure in FAILURES:
        assert rows[failure.family, failure.variant]["distance"] < 0.1, failure
    page = (out / "stability.html").read_text(encoding="utf-8")
    assert all(change.variant in page for change in INVARIANCES)
    links = [part.split('"')[0] for part in page.split('src="')[1:]]
    assert len(links) == len(INVARIANCES) + len(FAILURES)
    assert all((out / link).is_file() for link in links)

    lines = (out / "rows.jsonl").read_text(encoding="utf-8").splitlines()
    (out / "rows.jsonl").write_text("\n".join(lines[:-2]) + "\n" + lines[-2][:40], encoding="utf-8")
    counted = []
    own = measure.estimate
    monkeypatch.setattr(measure, "estimate", lambda *given, **named: counted.append(1) or own(*given, **named))
    assert main(asked) == 0
    again = json.loads(capsys.readouterr().out)
    assert again["summary"] == report["summary"]
    assert 0 < len(counted) < 10


def test_samplers_and_precisions_of_a_diffusion_model(panoramas: Path) -> None:
    torch.manual_seed(1)
    model = MiniModel.untrained()
    painter = DiffusersPainter.from_mini(model, batch=2)
    studio = Studio(lambda variant, shot: painter, 128, 64)
    settings = Settings(rounds=ROUNDS, evs=(0.0,), canvas=128, diameter=64, height=32)
    panorama = Panorama(panoramas / "sides.exr", studio, settings, Grid(2, 2, (), (2,), 2), None)
    found = {}
    for section in ("samplers", "numerics"):
        for _, variant, measured in measure.SECTIONS[section](panorama):
            found[variant] = measured()
    assert set(found) >= {"bfloat16", "float16 weights", "batch 1", "batch 16"}
    assert any(name.startswith("ddpm") for name in found)
    for name in ("batch 1", "batch 16"):
        assert found[name]["distance"] < 1e-3
    assert found["bfloat16"]["distance"] > 0
    assert 0 < found["float16 weights"]["distance"] < found["bfloat16"]["distance"]  # 11 bits against 8
    assert all(row["evaluations"] > 0 for row in found.values())


def test_what_is_not_accepted_is_named(panoramas: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for option, value, said in (
        ("--grid", "huge", "small, full"),
        ("--only", "weather", "invariances, failures, seeds"),
        ("--preset", "none", "draft"),
        ("--painter", "none", "mini"),
        ("--workers", "0", "1 to"),
    ):
        assert main(["bench", "stability", "--panoramas", str(panoramas), option, value]) == 2
        error = capsys.readouterr().err
        assert option.removeprefix("--") in error
        assert said in error


def test_ratios_are_of_the_means() -> None:
    head = {"family": "f", "variant": "v", "unit": "stops"}
    rows = [
        {**head, "distance": 1.0, "seed_distance": 1.0, "panorama": "a"},
        {**head, "distance": 5.0, "seed_distance": 2.0, "panorama": "b"},
    ]
    (line,) = command.summarize([replace_none(row) for row in rows])
    assert line["ratio"] == pytest.approx(2.0)
    assert line["panoramas"] == 2


def replace_none(row: dict[str, object]) -> dict[str, object]:
    return {"error": None, "expected_error": None, "ball_score": None, **row}
