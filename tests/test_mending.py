"""Options around an estimate: nothing without them, the photograph in front, the horizon level, the cast given back."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from analytic_painter import AnalyticPainter, Flaws
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import ExifTags, Image

from dl_core import cli
from dl_core.backends.loading import BACKENDS, Backend, LoadedPainter
from dl_core.bench.cameras import Camera, take
from dl_core.bench.skies import SunAndSky
from dl_core.errors import OptionError
from dl_core.estimate import Settings, estimate
from dl_core.exposure import expose
from dl_core.geometry import camera_rotation, latlong_directions, latlong_to_perspective, rotate_latlong
from dl_core.imageio import read_envmap, read_exr_header
from dl_core.iterative import Rounds
from dl_core.mending import SHOWN_STOPS, Mending, estimate_mended, level, mending_metadata, mending_remarks
from dl_core.white_balance import cast_gains

SETTINGS = Settings(rounds=Rounds(balls=2, rounds=1, steps=4, final=False), canvas=128, diameter=64, height=32)
LIGHT = SunAndSky(sun=(0.5, 0.5, 0.5**0.5), sun_radius=12.0, sun_irradiance=(1.5, 1.4, 1.2)).latlong(32)
PHOTO = expose(latlong_to_perspective(LIGHT, 24, 32, fov=60.0), 0.0)


def test_without_options_it_is_the_estimate() -> None:
    plain, mended = (
        estimate(PHOTO, AnalyticPainter(LIGHT), SETTINGS),
        estimate_mended(PHOTO, AnalyticPainter(LIGHT), SETTINGS, Mending()),
    )
    for name in ("latlong_hdr", "ball_hdr", "composite_ldr"):
        assert torch.equal(getattr(plain, name), getattr(mended, name))
    assert mending_remarks(Mending()) == []
    assert mending_metadata(Mending()) == {}


@pytest.mark.parametrize("method", ["grey-world", "shades-of-grey"])
def test_a_painter_that_sees_neutral_light_gives_the_cast_back(method: str) -> None:
    # It paints the true light times the gains, as one who saw the balanced photograph; what comes back is the truth.
    cast = torch.tensor([1.8, 1.0, 0.4])
    photo = expose(latlong_to_perspective(LIGHT * cast, 24, 32, fov=60.0), 0.0)
    gains = cast_gains(photo, method)
    painter = AnalyticPainter(LIGHT * cast * gains)
    probe = estimate_mended(photo, painter, SETTINGS, Mending(white_balance=method))
    truth = estimate(photo, AnalyticPainter(LIGHT * cast), SETTINGS)
    # Both are read from balls of floats; only light above the darkest exposure's white could differ, and there is none.
    torch.testing.assert_close(probe.latlong_hdr, truth.latlong_hdr, rtol=1e-2, atol=1e-2)
    assert float((gains - 1).abs().max()) > 0.1


@given(st.floats(-90, 90), st.floats(-180, 180))
@settings(max_examples=15)
def test_levelling_and_tilting_back_is_the_map(pitch: float, roll: float) -> None:
    smooth = torch.exp(latlong_directions(64))[None]
    back = rotate_latlong(level(smooth, pitch, roll), camera_rotation(0.0, pitch, roll).T)
    # At the poles a pixel is a wedge from there to 2.8 degrees off, over which light changes by 0.05: its mean, twice
    # resampled, lies within a third of that. Elsewhere bilinear steps of 2.8 degrees err by a thousandth.
    torch.testing.assert_close(back, smooth, rtol=0.02, atol=0.0)


@pytest.mark.parametrize("pitch", [-40.0, 0.0, 30.0])
def test_a_levelled_map_is_the_worlds(pitch: float) -> None:
    world = torch.exp(latlong_directions(32))[None]
    shot = take(world, Camera(pitch=pitch))
    levelled = level(shot.truth_hdr, pitch, 0.0)
    # Up to the exposure of the photograph, and what two bilinear steps blur.
    scale = float(levelled.sum() / world.sum())
    torch.testing.assert_close(levelled, world * scale, rtol=0.02, atol=0.0)


def test_less_error_is_expected_where_the_photograph_shows_the_light() -> None:
    many = replace(SETTINGS, rounds=replace(SETTINGS.rounds, balls=3))
    dim = 0.2 * LIGHT  # nothing ahead clips
    photo = expose(latlong_to_perspective(dim, 24, 32, fov=60.0), 0.0)
    painter = AnalyticPainter(dim, Flaws(noise=0.2))
    plain = estimate(photo, painter, many).confidence
    filled = estimate_mended(photo, painter, many, Mending(front_fill=True, fov=60.0)).confidence
    assert plain is not None
    assert filled is not None
    ahead = latlong_directions(32)[..., 2]
    before, after = plain.error_stops[0, ..., 0], filled.error_stops[0, ..., 0]
    assert torch.equal(after[ahead > -0.7], before[ahead > -0.7])
    assert (after[ahead < -0.97] <= SHOWN_STOPS + 1e-6).all()
    assert before[ahead < -0.97].mean() > 2 * SHOWN_STOPS


def test_level_without_a_tilt_is_the_map_itself() -> None:
    assert level(LIGHT, 0.0, 0.0) is LIGHT


@pytest.mark.parametrize(
    ("mending", "name"),
    [
        (Mending(front_fill=True), "fov"),
        (Mending(fov=180.0), "fov"),
        (Mending(pitch=-100.0), "pitch"),
        (Mending(roll=float("nan")), "roll"),
        (Mending(white_balance="auto"), "white_balance"),
    ],
)
def test_what_cannot_be_done_is_refused_before_painting(mending: Mending, name: str) -> None:
    painter = AnalyticPainter(LIGHT)
    with pytest.raises(OptionError) as raised:
        estimate_mended(PHOTO, painter, SETTINGS, mending)
    assert raised.value.name == name
    assert painter.requests == []


def photograph(folder: Path, focal: int | None) -> Path:
    exif = Image.Exif()
    if focal is not None:
        exif.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.FocalLengthIn35mmFilm] = focal
    path = folder / "photo.jpg"
    Image.new("RGB", (36, 24), (200, 120, 60)).save(path, exif=exif, quality=95)
    return path


def test_the_command_fills_levels_and_says_so(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    backend = Backend("paints the truth", lambda files, impute: LoadedPainter(AnalyticPainter(LIGHT), 128, 64))
    monkeypatch.setitem(BACKENDS, "true", backend)
    photo, out = photograph(tmp_path, 18), tmp_path / "probe.exr"
    command = ["estimate", str(photo), "-o", str(out), "--backend", "true", "--preset", "draft", "--height", "32"]
    assert cli.main([*command, "--front-fill", "--pitch", "20", "--white-balance", "grey-world", "--json"]) == 0
    notes = " ".join(json.loads(capsys.readouterr().out)["notes"])
    assert "90.0 degrees" in notes
    assert "pitch 20" in notes
    header = read_exr_header(out)
    assert header["lightprobe:front_fill"].startswith("photograph, 90")
    assert "level" in header["lightprobe:axes"]
    assert header["lightprobe:white_balance"] == "grey-world"
    # 20 degrees up: row 32 x (90 - 20) / 180 shows the photograph, an even orange.
    row = read_envmap(out)[0, 12, 32]
    colour = (torch.tensor([200, 120, 60]) / 255) ** 2.4
    torch.testing.assert_close(row, colour, rtol=0.05, atol=0.005)


@pytest.mark.parametrize(
    ("focal", "options", "message"),
    [
        (None, ["--front-fill"], "fov is None"),
        (50, ["--fov", "60"], "nothing without --front-fill"),
        (50, ["--front-fill", "--fov", "4"], "5 to 170"),
        (50, ["--front-fill", "--pitch", "95"], "pitch is 95"),
        (50, ["--white-balance", "daylight"], "shades-of-grey"),
    ],
)
def test_the_command_refuses_before_it_loads(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], focal: int | None, options: list[str], message: str
) -> None:
    photo = photograph(tmp_path, focal)
    assert cli.main(["estimate", str(photo), "-o", str(tmp_path / "probe.exr"), *options]) != 0
    assert message in capsys.readouterr().err
    assert not (tmp_path / "probe.exr").exists()
