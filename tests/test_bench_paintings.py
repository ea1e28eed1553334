"""Protocols' photographs and maps: truth stands as the camera stood, runs resume, variants differ as Table 1 says."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from dl_core import cli
from dl_core.bench.cameras import CAMERAS, Camera, cameras_of, random_camera, take
from dl_core.bench.paintings import VARIANTS, Painting, Variant, paint_maps, planned
from dl_core.bench.perfect import PerfectPainter
from dl_core.errors import OptionError
from dl_core.estimate import Settings
from dl_core.geometry import latlong_directions, latlong_energy, latlong_to_perspective
from dl_core.imageio import read_envmap, write_exr
from dl_core.iterative import Rounds
from dl_core.painter import Observer, Painter, PaintRequest, PaintResult
from dl_core.presets import PRESETS, Preset

PRESET = Preset(Rounds(balls=2, rounds=1, steps=2, final=False), (0.0, -2.5, -5.0), "short")
SETTINGS = Settings(canvas=256, diameter=128, height=64)


def smooth(height: int = 64) -> torch.Tensor:
    """A map without detail, brighter than white in one direction, of another colour in each."""
    return (0.6 + 0.5 * latlong_directions(height))[None] ** 3


@given(st.text(min_size=1, max_size=8), st.integers(0, 5))
def test_random_cameras_stay_within_the_papers_ranges_and_repeat(key: str, seed: int) -> None:
    camera = random_camera(key, seed)
    assert 30 <= camera.fov <= 150
    assert -45 <= camera.pitch <= 45
    assert -180 <= camera.yaw <= 180
    assert camera == random_camera(key, seed)


def test_a_vertical_field_of_view_of_60_degrees_is_75_wide_at_4_to_3() -> None:
    assert Camera().longer_fov == pytest.approx(75.178, abs=1e-3)


@pytest.mark.parametrize("camera", [Camera(), Camera(yaw=70, pitch=-30, fov=80), Camera(yaw=-150, pitch=45, fov=40)])
def test_the_truth_stands_as_the_camera_stood(camera: Camera) -> None:
    shot = take(smooth(), camera)
    ahead = latlong_to_perspective(shot.truth_hdr, camera.rows, camera.columns, fov=camera.longer_fov)
    # Turning the map interpolates it once more; it has no detail to lose but its row and column steps.
    torch.testing.assert_close(ahead.clamp(0, 1) ** (1 / 2.4), shot.photo_ldr, atol=4e-3, rtol=0)


def test_the_99th_percentile_of_a_photograph_is_nine_tenths() -> None:
    assert float(take(smooth(), Camera()).photo_ldr.quantile(0.99)) == pytest.approx(0.9, abs=2e-3)


def test_the_array_protocol_looks_around_in_ten_steps() -> None:
    assert sorted(camera.yaw % 360 for camera in cameras_of("array", "x", 0)) == [36.0 * i for i in range(10)]


@pytest.mark.parametrize("protocol", ["three-spheres", "ldr"])
@given(st.integers(1, 12))
def test_level_photographs_look_around_evenly_from_the_papers_own(protocol: str, count: int) -> None:
    yaws = [camera.yaw for camera in cameras_of(protocol, "x", 0, count)]
    assert yaws[0] == 0
    assert yaws == pytest.approx([360 * i / count for i in range(count)])


@given(st.text(min_size=1, max_size=8), st.integers(2, 6))
def test_more_random_photographs_begin_with_the_same_ones(key: str, count: int) -> None:
    cameras = list(cameras_of("random-camera", key, 0, count))
    assert cameras[0] == random_camera(key)
    assert cameras[:-1] == list(cameras_of("random-camera", key, 0, count - 1))
    assert len(set(cameras)) == count


@pytest.mark.parametrize(("protocol", "count"), [("three-spheres", 0), ("random-camera", -1), ("array", 2)])
def test_numbers_of_photographs_that_cannot_be_are_refused(protocol: str, count: int) -> None:
    with pytest.raises(OptionError, match=f"--photographs.*{count}"):
        cameras_of(protocol, "x", 0, count)


@pytest.fixture
def panorama(tmp_path: Path) -> Path:
    return write_exr(tmp_path / "smooth.exr", smooth()[0], metadata={})


def perfect(variant: Variant, shot: object) -> Painter:
    return PerfectPainter(shot.truth_hdr)  # type: ignore[attr-defined]


def test_a_painter_without_error_gives_back_the_light(panorama: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    said: list[str] = []
    paintings = list(planned([panorama], "three-spheres", list(VARIANTS), 0))
    paint_maps(paintings, lambda: perfect, PRESET, SETTINGS, out, painter="perfect", report=said.append)
    assert len(said) == len(VARIANTS)
    truth = read_envmap(out / "truth" / f"{paintings[0].shot}.exr")
    light = {name: read_envmap(out / "maps" / name / f"{paintings[0].shot}.exr") for name in VARIANTS}
    for name in ("lora", "both"):
        # Half floats and 8 bits: energy is kept within a percent.
        torch.testing.assert_close(latlong_energy(light[name]), latlong_energy(truth), rtol=0.01, atol=0)
    assert float(truth.max()) > 1.1
    assert float(light["base"].max()) <= 1.0  # one exposure ends at white
    towards = latlong_directions(truth.shape[1])[..., 2]
    ahead, behind = towards < -0.95, towards > 0
    off = {name: (light[name] - truth).abs().mean(dim=-1)[0] for name in ("both", "filled")}
    assert off["filled"][ahead].mean() < 0.5 * off["both"][ahead].mean()  # the ball's rim against the photograph
    assert torch.equal(light["filled"][0, behind], light["both"][0, behind])


class Listening(PerfectPainter):
    """Notes which seeds it is asked for."""

    def __init__(self, truth_hdr: torch.Tensor, heard: set[int]) -> None:
        super().__init__(truth_hdr)
        self.heard = heard

    def paint(self, request: PaintRequest, observer: Observer) -> PaintResult:
        self.heard.add(request.seeds[0])
        return super().paint(request, observer)


def test_each_photograph_has_noise_of_its_own(panorama: Path, tmp_path: Path) -> None:
    """Another for every photograph, the same for all rows of one, and whatever else is in the run."""
    other = write_exr(tmp_path / "other.exr", smooth()[0], metadata={})

    def heard_in(files: list[Path], folder: str, variants: list[str]) -> set[int]:
        heard: set[int] = set()
        paintings = list(planned(files, "three-spheres", variants, 0, 2))
        paint_maps(
            paintings,
            lambda: lambda variant, shot: Listening(shot.truth_hdr, heard),
            PRESET,
            replace(SETTINGS, seed=7),
            tmp_path / folder,
            painter="perfect",
            report=lambda line: None,
        )
        assert heard == {painting.seed(7) for painting in paintings}
        return heard

    both = heard_in([panorama, other], "both", ["base", "lora"])
    alone = heard_in([other], "alone", ["base"])
    assert (len(both), len(alone)) == (4, 2)
    assert alone < both


def test_what_is_there_is_not_painted_again(panorama: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    said: list[str] = []
    paintings = list(planned([panorama], "three-spheres", ["base", "both"], 0))
    paint_maps(paintings, lambda: perfect, PRESET, SETTINGS, out, painter="perfect", report=said.append)
    (out / "maps" / "base" / f"{paintings[0].shot}.exr").unlink()
    paint_maps(paintings, lambda: perfect, PRESET, SETTINGS, out, painter="perfect", report=said.append)
    assert len(said) == 3
    assert "base:" in said[-1]


def test_what_variants_share_is_painted_once(panorama: Path, tmp_path: Path) -> None:
    asked: list[str] = []

    def painter_of(variant: Variant, shot: object) -> Painter:
        asked.append(variant.label)
        return perfect(variant, shot)

    paintings = list(planned([panorama], "three-spheres", ["both", "filled"], 0, photographs=2))
    paint_maps(paintings, lambda: painter_of, PRESET, SETTINGS, tmp_path, painter="perfect", report=lambda line: None)
    assert asked == [VARIANTS["both"].label] * 2
    assert all(painting.map_in(tmp_path).is_file() for painting in paintings)


@pytest.mark.parametrize(("painter", "seed"), [("perfect", 1), ("mini", SETTINGS.seed)])
def test_a_folder_of_another_run_is_refused(painter: str, seed: int, tmp_path: Path) -> None:
    def begin(painter: str, seed: int) -> None:
        settings = replace(SETTINGS, seed=seed)
        paint_maps([], lambda: perfect, PRESET, settings, tmp_path / "out", painter=painter, report=lambda line: None)

    begin("perfect", SETTINGS.seed)
    with pytest.raises(OptionError, match="--out"):
        begin(painter, seed)


def test_every_photograph_of_a_run_has_its_own_name(panorama: Path) -> None:
    shots = [painting.shot for painting in planned([panorama], "array", ["base"], 0)]
    assert len(set(shots)) == len(shots) == 10
    assert Painting(panorama, Camera(), "base").shot.startswith("smooth.")


def protocol(capsys: pytest.CaptureFixture[str], *words: object) -> dict[str, Any]:
    assert cli.main(["bench", "protocol", *(str(word) for word in words), "--json"]) == 0
    return dict(json.loads(capsys.readouterr().out))


def lamp(tmp_path: Path) -> Path:
    """A grey room with a warm lamp of radiance 8 behind the camera: above white, below what EV -5 shows."""
    directions = latlong_directions(64)
    lit = (directions @ torch.tensor([0.6, 0.0, 0.8]) > 0.95).float()[..., None] * torch.tensor([8.0, 6.0, 3.0])
    return write_exr(tmp_path / "lamp.exr", 0.3 + 0.2 * directions[..., 1:2] + lit, metadata={})


def test_the_command_paints_and_scores_and_a_bracket_beats_one_exposure(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = lamp(tmp_path).parent
    words = ("three-spheres", "--panoramas", folder, "--painter", "perfect", "--variants", "base,both")
    report = protocol(capsys, *words, "--out", tmp_path / "out")
    rows = {(row["variant"], row["sphere"]): row for row in report["rows"]}
    for sphere in ("diffuse", "mirror"):
        assert rows["both", sphere]["si_rmse"] < 0.5 * rows["base", sphere]["si_rmse"]
        assert rows["both", sphere]["angular_error_deg"] < 0.5 * rows["base", sphere]["angular_error_deg"]
    draft = PRESETS["draft"]
    # Two evaluations a guided step; the base paints one ball of one exposure.
    assert report["evaluations"] == 2 * (draft.guided_steps + draft.rounds.steps)
    assert {row["data"] for row in report["protocol"]["published"]} == {"Laval Indoor (289)", "Poly Haven (500)"}
    assert (tmp_path / "out" / "report.json").is_file()


def test_maps_compared_as_pictures_are_toned_by_their_own_light(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = lamp(tmp_path).parent
    words = ("ldr", "--panoramas", folder, "--painter", "perfect", "--variants", "base,both", "--out", tmp_path / "out")
    base, both = protocol(capsys, *words)["rows"]
    # The lamp holds the 99th percentile: a map without it is toned too bright everywhere.
    assert both["rmse"] < 0.2 * base["rmse"]


def test_a_last_ball_is_painted_where_the_preset_has_none(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = lamp(tmp_path).parent
    words = ("three-spheres", "--panoramas", folder, "--painter", "perfect", "--preset", "draft", "--out")
    without, ending = (
        protocol(capsys, *words, tmp_path / name, *more) for name, more in (("a", ()), ("b", ("--last-ball",)))
    )
    assert (without["protocol"]["last_ball"], ending["protocol"]["last_ball"]) == (False, True)
    rounds = PRESETS["draft"].rounds
    # One ball an exposure, two evaluations for each step of SDEdit.
    assert ending["evaluations"] - without["evaluations"] == 3 * 2 * round(rounds.strength * rounds.steps)


def test_the_papers_merge_leaves_clipped_lamps_neutral(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = (
        "ldr",
        "--panoramas",
        lamp(tmp_path).parent,
        "--painter",
        "perfect",
        "--variants",
        "both",
        "--photographs",
        1,
    )
    light = {}
    for merge in ("robust", "paper"):
        out = tmp_path / merge
        assert protocol(capsys, *words, "--merge", merge, "--out", out)["protocol"]["merge"] == merge
        light[merge] = read_envmap(out / "maps" / "both" / "lamp.y0_p0_f60.exr").amax(dim=(0, 1, 2))
    assert float(light["robust"][0] / light["robust"][2]) == pytest.approx(8 / 3, rel=0.1)
    assert float(light["paper"][0] / light["paper"][2]) < 1.2


def test_two_processes_paint_the_same_maps(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scenes = tmp_path / "scenes"
    scenes.mkdir()
    for name in ("a", "b"):
        write_exr(scenes / f"{name}.exr", smooth()[0], metadata={})
    words = ("ldr", "--panoramas", scenes, "--painter", "perfect", "--variants", "lora", "--photographs", 2)
    one, two = (
        protocol(capsys, *words, "--out", tmp_path / str(workers), "--workers", workers)["rows"] for workers in (1, 2)
    )
    assert one == two
    assert len({row["shot"] for row in one}) == 4


def test_the_array_stands_beside_the_papers_table_and_a_bracket_beats_one_exposure(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    cameras = CAMERAS["array"]
    monkeypatch.setitem(CAMERAS, "array", lambda *asked: cameras(*asked)[:1])
    folder = lamp(tmp_path).parent
    words = ("array", "--panoramas", folder, "--painter", "perfect", "--variants", "base,both")
    report = protocol(capsys, *words, "--convention", "published-array", "--out", tmp_path / "out")
    base, both = report["rows"]
    assert {base["shot"], both["shot"]} == {"lamp.y0_p0_f50"}
    assert {base["sphere"], both["sphere"]} == {"array"}
    # One exposure ends at white; the bracket reaches the lamp.
    assert both["si_rmse"] < 0.3 * base["si_rmse"]
    assert (tmp_path / "out" / "sheets" / "both" / "lamp.y0_p0_f50.png").is_file()
    published = {row["method"]: (row["si_rmse"], row["angular_error_deg"]) for row in report["protocol"]["published"]}
    assert published["Weber et al."] == (0.081, 4.13)
    assert len(published) == 5


@pytest.mark.parametrize(
    ("words", "named"),
    [
        ((), "--panoramas"),
        (("--panoramas", "x", "--maps", "y", "--out", "z"), "--panoramas"),
        (("--panoramas", "x"), "--out"),
        (("--panoramas", "x", "--out", "z", "--variants", "best"), "--variants"),
        (("--panoramas", "x", "--out", "z", "--merge", "mean"), "merge"),
    ],
)
def test_options_that_do_not_go_together_are_named(
    words: tuple[str, ...], named: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["bench", "protocol", "three-spheres", *words]) == 2
    assert named in capsys.readouterr().err
