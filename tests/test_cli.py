from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import pytest
import torch
from analytic_painter import AnalyticPainter, Flaws
from depth_models import save_depth_anything
from PIL import Image as PILImage

from dl_core import __version__, cli
from dl_core.backends.loading import BACKENDS, Backend, LoadedPainter
from dl_core.ball import paint_depth
from dl_core.commands import estimate
from dl_core.depth import load_depth_model
from dl_core.errors import Interrupted, ModelError
from dl_core.exposure import MERGES, encode_display
from dl_core.geometry import latlong_directions, latlong_energy, latlong_to_ball
from dl_core.imageio import read_envmap, write_exr, write_hdr
from dl_core.painter import Observer, Painter, PaintRequest, PaintResult, SilentObserver
from dl_core.presets import PRESETS

EVALUATIONS = 2 * PRESETS["draft"].guided_steps
"""What a draft costs, with and without the prompt."""


def sun_and_sky() -> torch.Tensor:
    """(1, 64, 128, 3): a gradient, and a lamp of radiance 8 to the right, two stops above what EV 0 shows."""
    directions = latlong_directions(64)
    lamp = (directions @ torch.tensor([0.8, 0.6, 0.0]) > 0.95).float()[..., None] * 8
    return (0.3 + 0.2 * directions[..., 1:2] + lamp).expand(-1, -1, 3)[None] * torch.tensor([1.0, 0.8, 0.6])


class StoppingObserver(SilentObserver):
    """Passes progress on, and stops the run when so many evaluations are done."""

    def __init__(self, told: Observer, after: int, event: BaseException) -> None:
        self.told, self.left, self.event = told, after, event

    def evaluated(self, count: int) -> None:
        self.told.evaluated(count)
        self.left -= count
        if self.left <= 0:
            raise self.event


@dataclass
class StoppedPainter(AnalyticPainter):
    """An AnalyticPainter that somebody stops."""

    after: int = 0
    event: BaseException = field(default_factory=KeyboardInterrupt)
    done: int = 0

    def paint(self, request: PaintRequest, observer: Observer) -> PaintResult:
        result = super().paint(request, StoppingObserver(observer, self.after - self.done, self.event))
        self.done += result.evaluations
        return result


@pytest.fixture
def backend(monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """Adds a row `true` to the table of backends: a painter without error on a 256 pixel canvas."""

    def add(painter: Painter | None = None, load_error: BaseException | None = None) -> None:
        def load(files: object, impute: str) -> LoadedPainter:
            if load_error is not None:
                raise load_error
            return LoadedPainter(painter or AnalyticPainter(sun_and_sky()), 256, 128)

        monkeypatch.setitem(BACKENDS, "true", Backend("paints the truth", load))

    return add


@pytest.fixture
def photo(tmp_path: Path) -> Path:
    path = tmp_path / "in" / "photo.png"
    path.parent.mkdir()
    PILImage.fromarray(np.full((30, 40, 3), 90, np.uint8)).save(path)
    return path


@pytest.fixture
def out(tmp_path: Path) -> Path:
    folder = tmp_path / "out"
    folder.mkdir()
    return folder


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def run(photo: Path, out: Path, *options: str) -> int:
    return cli.main(
        ["estimate", str(photo), "-o", str(out / "a.exr"), "--preset", "draft", "--backend", "true", *options]
    )


# --- estimate ---


def test_a_budget_chooses_the_preset(
    backend: Callable[..., None], photo: Path, out: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    backend()
    argv = ["estimate", str(photo), "-o", str(out / "a.exr"), "--backend", "true", "--evs", "0", "--json"]
    assert cli.main([*argv, "--budget", "3600"]) == 0
    report = json.loads(capsys.readouterr().out)
    measured = {name: preset.error_deg for name, preset in PRESETS.items() if preset.error_deg is not None}
    assert measured[report["preset"]] == min(measured.values())
    assert report["evaluations"] == 2 * replace(PRESETS[report["preset"]], evs=(0.0,)).guided_steps
    assert any(note.startswith(f"budget 3600 s: preset {report['preset']}") for note in report["notes"])


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--budget", "0"], "budget is 0.0; accepted: seconds, above 0"),
        (["--budget", "nan"], "budget is nan"),
        (["--budget", "60", "--preset", "draft"], "nothing beside --preset"),
        (["--budget", "1e-6"], "the cheapest preset, draft"),
    ],
)
def test_a_budget_that_nothing_fits_in_is_refused(
    backend: Callable[..., None],
    photo: Path,
    out: Path,
    options: list[str],
    said: str,
    capsys: pytest.CaptureFixture[str],
) -> None:
    backend()
    assert cli.main(["estimate", str(photo), "-o", str(out / "a.exr"), "--backend", "true", *options]) == 2
    assert said in capsys.readouterr().err
    assert names(out) == []


def test_estimate_writes_a_probe_a_ball_and_a_sheet(
    backend: Callable[..., None], photo: Path, out: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    backend()
    assert run(photo, out, "--seed", "7") == 0
    assert names(out) == ["a.ball.png", "a.exr", "a.spheres.png"]
    printed = capsys.readouterr()
    for name in names(out):
        assert str(out / name) in printed.out
    assert f"{EVALUATIONS} denoiser evaluations" in printed.out
    assert f"{EVALUATIONS}/{EVALUATIONS}" in printed.err  # the bar ended at the planned total

    header = OpenEXR.File(str(out / "a.exr"), header_only=True).header()
    assert header["envmap"] == OpenEXR.ENVMAP_LATLONG
    assert header["lightprobe:software"] == f"ComfyUI-LightProbe {__version__}"
    assert header["lightprobe:evs"] == "0, -2.5, -5"
    assert header["lightprobe:seed"] == "7"
    assert header["lightprobe:nfe"] == str(EVALUATIONS)
    assert header["lightprobe:preset"] == "draft"
    assert "merge robust" in header["lightprobe:method"]


def test_the_map_is_the_light_that_was_painted(backend: Callable[..., None], photo: Path, out: Path) -> None:
    """A painter that makes no mistake: the written map holds the truth's energy, and its lamp on the right."""
    backend()
    assert run(photo, out) == 0
    written, truth = read_envmap(out / "a.exr"), sun_and_sky()
    assert written.shape == (1, 256, 512, 3)
    # A 128 pixel ball: 1.8 degrees a pixel, and the outer two pixels hold a sixteenth of the sphere.
    torch.testing.assert_close(latlong_energy(written), latlong_energy(truth), rtol=0.01, atol=0)
    brightest = latlong_directions(256).reshape(-1, 3)[written.sum(-1).argmax()]
    assert brightest @ torch.tensor([0.8, 0.6, 0]) > 0.94
    ball = np.array(PILImage.open(out / "a.ball.png"))
    assert ball.shape == (128, 128, 3)
    expected = encode_display(latlong_to_ball(truth, 128))[0].numpy()
    assert np.abs(ball / 255 - expected).max() <= 0.5 / 255 + 1e-6


def test_options_reach_the_estimate(backend: Callable[..., None], photo: Path, out: Path) -> None:
    backend()
    assert run(photo, out, "--evs", "0,-4", "--merge", "paper", "--height", "32", "--diameter", "64", "--x", "50") == 0
    assert read_envmap(out / "a.exr").shape == (1, 32, 64, 3)
    header = OpenEXR.File(str(out / "a.exr"), header_only=True).header()
    assert header["lightprobe:evs"] == "0, -4"
    assert "merge paper" in header["lightprobe:method"]
    assert PILImage.open(out / "a.ball.png").size == (64, 64)


def test_radiance_output_and_depth(backend: Callable[..., None], photo: Path, out: Path) -> None:
    backend()
    argv = ["estimate", str(photo), "-o", str(out / "a.hdr"), "--preset", "draft", "--backend", "true"]
    assert cli.main([*argv, "--depth", str(photo)]) == 0
    assert names(out) == ["a.ball.png", "a.hdr", "a.spheres.png"]
    assert read_envmap(out / "a.hdr").shape == (1, 256, 512, 3)


def test_depth_from_a_models_folder_is_that_of_each_round(
    backend: Callable[..., None], photo: Path, out: Path, tmp_path: Path
) -> None:
    painter = AnalyticPainter(sun_and_sky(), Flaws(noise=0.05))
    backend(painter)
    folder = save_depth_anything(tmp_path / "depth")
    assert run(photo, out, "--depth", str(folder), "--preset", "best") == 0
    first, last = painter.requests[:2]
    depth = load_depth_model(folder)
    for request in (first, last):
        torch.testing.assert_close(request.depth, paint_depth(depth(request.canvas), request.ball), rtol=0, atol=1e-5)
    assert not torch.equal(first.depth, last.depth)


def test_a_folder_without_a_depth_model_is_named(
    backend: Callable[..., None], photo: Path, out: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    backend()
    assert run(photo, out, "--depth", str(photo.parent)) == 1
    assert f"{photo.parent}: holds no config.json" in capsys.readouterr().err
    assert names(out) == []


def test_what_the_painter_notes_is_reported_by_exposure(
    backend: Callable[..., None], photo: Path, out: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    class ShortOfMemory(AnalyticPainter):
        def paint(self, request: PaintRequest, observer: Observer) -> PaintResult:
            notes = ("out of memory with 4 balls at once: went on with 2",) if request.ev == 0 else ()
            return replace(super().paint(request, observer), notes=notes)

    backend(ShortOfMemory(sun_and_sky()))
    assert run(photo, out) == 0
    assert "EV 0: out of memory with 4 balls at once: went on with 2\n" in capsys.readouterr().out
    assert run(photo, out, "--json") == 0
    first, *others = json.loads(capsys.readouterr().out)["notes"]
    assert first == "EV 0: out of memory with 4 balls at once: went on with 2"
    assert not any("memory" in note for note in others)


@pytest.mark.parametrize(
    ("options", "disc"),
    [
        ((), "ball"),
        (("--preset", "paper"), "authors"),
        (("--preset", "turbo"), "authors"),
        (("--preset", "paper", "--depth-disc", "ball"), "ball"),
    ],
)
def test_the_authors_presets_use_their_depth_disc(
    backend: Callable[..., None], photo: Path, out: Path, options: tuple[str, ...], disc: str
) -> None:
    seen = set()

    class Watching(AnalyticPainter):
        def paint(self, request: PaintRequest, observer: Observer) -> PaintResult:
            seen.add(request.ball.depth_disc)
            return super().paint(replace(request, seeds=request.seeds[:1]), observer)

    backend(Watching(sun_and_sky()))
    assert run(photo, out, *options) == 0
    assert seen == {disc}


def test_turbo_without_its_lora_is_remarked(
    backend: Callable[..., None], photo: Path, out: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    backend()
    assert run(photo, out, "--preset", "turbo") == 0
    assert "without a Turbo LoRA (--turbo-lora)" in capsys.readouterr().out
    assert run(photo, out, "--preset", "turbo", "--turbo-lora", "turbo.safetensors") == 0
    assert "without a Turbo LoRA" not in capsys.readouterr().out


def test_a_bracket_sized_to_the_scene(
    backend: Callable[..., None], photo: Path, out: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A lamp of radiance 8 clips at EV 0 and not at EV -5, where 3 stops of it are left below white."""
    backend()
    assert run(photo, out, "--evs", "0,-2,-4,-6", "--bracket", "scene") == 0
    printed = capsys.readouterr()
    spent = EVALUATIONS  # three of the exposures: 8 is clipped at EV -2 too, and not at EV -4
    assert "bracket sized to the scene: 3 exposures, EV 0, -2, -4\n" in printed.out
    assert f"{spent}/{spent}" in printed.err  # the bar ended
    header = OpenEXR.File(str(out / "a.exr"), header_only=True).header()
    assert header["lightprobe:evs"] == "0, -2, -4"
    assert run(photo, out, "--bracket", "scene", "--darkest", "-2.5", "--evs", "0,-1", "--json") == 0
    report = json.loads(capsys.readouterr().out)
    assert report["evs"] == [0, -1, -2, -2.5]
    assert report["clipped"] > 0
    assert any("EV -2.5 still clips" in note for note in report["notes"])


def test_a_tolerance_ends_rounds_sooner(
    backend: Callable[..., None], photo: Path, out: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    backend(AnalyticPainter(sun_and_sky(), Flaws(noise=0.01, disco=0.2)))
    options = ("--preset", "paper", "--tolerance", "0.02", "--min-balls", "8", "--evs", "0")
    assert run(photo, out, *options, "--json") == 0
    printed = capsys.readouterr()
    report = json.loads(printed.out)
    first, second = report["rounds"][0]
    assert 8 <= first["painted"] < 30
    assert first["error"] <= 0.02
    spent = report["evaluations"]
    assert spent == 2 * (30 * first["painted"] + 24 * second["painted"] + 24)
    assert f"{spent}/{spent}" in printed.err
    assert any(note.startswith("EV 0: round 1: settled after") for note in report["notes"])
    header = OpenEXR.File(str(out / "a.exr"), header_only=True).header()
    assert "N=8-30 tolerance=0.02 k=2" in header["lightprobe:method"]


def test_json_report(backend: Callable[..., None], photo: Path, out: Path, capsys: pytest.CaptureFixture[str]) -> None:
    backend()
    assert run(photo, out, "--json") == 0
    report = json.loads(capsys.readouterr().out)
    assert report["written"] == [str(out / name) for name in ("a.exr", "a.ball.png", "a.spheres.png")]
    assert report["evaluations"] == EVALUATIONS
    assert report["seconds"]["total"] >= report["seconds"]["painting"] > 0
    assert report["evs"] == [0, -2.5, -5]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--preset", "quick"], "preset is 'quick'; accepted: draft, fast, balanced, best, turbo, paper"),
        (["--evs", "0,-2,-2"], "evs is"),
        (["--evs", "-1,-2"], "evs"),
        (["--evs=1,0"], "evs is"),
        (["--evs", "0;-2"], "evs is '0;-2'; accepted: numbers and commas"),
        (["--evs", "0,nan"], "evs is"),
        (["--evs", ""], "evs is ''"),
        (["--bracket", "auto"], "bracket is 'auto'; accepted: fixed, scene"),
        (["--darkest", "-10"], "darkest is -10.0; accepted: nothing with a fixed bracket"),
        (["--bracket", "scene", "--darkest", "0"], "darkest is 0.0; accepted: -40 up to"),
        (["--tolerance", "0"], "tolerance is 0.0"),
        (["--tolerance", "0.1", "--min-balls", "2"], "min_balls is 2"),
        (["--merge", "mean"], "merge is 'mean'; accepted: robust, channel, paper"),
        (["--backend", "flux"], "backend is 'flux'; accepted: mini, diffusers"),
        (["--precision", "int8"], "--precision is 'int8'; accepted: float32, bfloat16, float16"),
        (["--seed", "-1"], "seed is -1; accepted: 0 to 4294967295"),
        (["--height", "0"], "height is 0"),
        (["--diameter", "300"], "diameter is 300; accepted: 16 to 256"),
        (["--x", "10"], "x is 10.0; accepted: 64 to 192"),
        (["--seed", "one"], "--seed"),
        (["--impute", "none"], "impute is 'none'; accepted: initial, predicted"),
        (["--depth-disc", "wide"], "depth_disc is 'wide'; accepted: ball, authors"),
        (["-o", "a.png"], "output is 'a.png'; accepted: a name that ends in .exr or .hdr"),
        (["--backend", "diffusers"], "model is None; accepted: a local file"),
        (["--backend", "mini", "--turbo-lora", "x"], "turbo_lora is 'x'; accepted: nothing with the backend mini"),
        (["--backend", "mini", "--lora", "x"], "lora is 'x'; accepted: nothing with the backend mini"),
    ],
)
def test_options_that_are_not_accepted_exit_with_2(
    backend: Callable[..., None],
    photo: Path,
    out: Path,
    capsys: pytest.CaptureFixture[str],
    options: list[str],
    message: str,
) -> None:
    backend()
    try:
        code = run(photo, out, *options)
    except SystemExit as left:  # argparse's own
        code = left.code
    assert code == 2
    assert message in capsys.readouterr().err
    assert names(out) == []


def test_faults_exit_with_1(
    backend: Callable[..., None], photo: Path, out: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    backend(load_error=ModelError("unet.safetensors", "no such model file"))
    assert run(photo, out) == 1
    assert "unet.safetensors: no such model file" in capsys.readouterr().err
    assert run(tmp_path / "gone.jpg", out) == 1
    assert "gone.jpg" in capsys.readouterr().err
    assert names(out) == []


def test_the_output_is_checked_before_anything_is_loaded(
    backend: Callable[..., None], photo: Path, out: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    backend(load_error=AssertionError("loaded"))
    assert run(photo, out / "gone") == 1
    assert f"the folder {out / 'gone'} does not exist" in capsys.readouterr().err
    (out / "a.spheres.png").mkdir()
    assert run(photo, out) == 1
    assert "a.spheres.png: is a folder" in capsys.readouterr().err


def test_the_input_is_not_overwritten(
    backend: Callable[..., None], photo: Path, out: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    backend()
    before = photo.rename(photo.with_name("a.ball.png")).read_bytes()
    assert run(photo.with_name("a.ball.png"), photo.parent) == 2
    assert "does not overwrite the input" in capsys.readouterr().err
    assert photo.with_name("a.ball.png").read_bytes() == before


@pytest.mark.parametrize("after", [1, EVALUATIONS // 2, EVALUATIONS])
@pytest.mark.parametrize("event", [KeyboardInterrupt(), Interrupted("stopped")])
def test_interruption_leaves_nothing_half_written(
    backend: Callable[..., None], photo: Path, out: Path, after: int, event: BaseException
) -> None:
    backend(StoppedPainter(sun_and_sky(), after=after, event=event))
    (out / "a.exr").write_text("an earlier result")
    assert run(photo, out) == 130
    assert names(out) == ["a.exr"]
    assert (out / "a.exr").read_text() == "an earlier result"


# --- spheres and inspect ---


@pytest.mark.parametrize("ctrl_c", [signal.default_int_handler, signal.SIG_IGN])
def test_a_request_to_end_interrupts(
    ctrl_c: Any, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Also in the background, where shells have commands ignore Ctrl-C."""

    def work(arguments: list[str]) -> int:
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(60)
        return 0

    monkeypatch.setattr(cli, "_dispatch", work)
    by_default = signal.getsignal(signal.SIGTERM)
    before = signal.signal(signal.SIGINT, ctrl_c)
    try:
        assert cli.main([]) == 130
    finally:
        signal.signal(signal.SIGINT, before)
    assert signal.getsignal(signal.SIGTERM) == by_default
    assert "interrupted" in capsys.readouterr().err


def test_spheres(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source, picture = tmp_path / "map.exr", tmp_path / "spheres.png"
    write_exr(source, sun_and_sky()[0], metadata={})
    assert cli.main(["spheres", str(source), "-o", str(picture), "--size", "64"]) == 0
    assert capsys.readouterr().out.strip() == str(picture)
    assert PILImage.open(picture).size == (4 * 64 + 4 * 16, 64 + 24 + 2 * 16)
    assert cli.main(["spheres", str(source), "-o", str(picture), "--albedo", "2"]) == 2
    assert cli.main(["spheres", str(source), "-o", str(picture), "--size", "1"]) == 2
    assert cli.main(["spheres", str(tmp_path / "gone.exr"), "-o", str(picture)]) == 1


def test_inspect_tells_energy_and_where_the_light_is(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A uniform map of radiance (1, 2, 3) holds 4π times that; one brighter pixel is found where it was put."""
    uniform = torch.tensor([1.0, 2, 3]).expand(16, 32, 3).clone()
    uniform[3, 24] *= 1 + 1e-3
    write_exr(tmp_path / "a.exr", uniform, metadata={"lightprobe:seed": "5"}, half=False)
    assert cli.main(["inspect", str(tmp_path / "a.exr"), "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["channels"] == ["B float", "G float", "R float"]
    assert facts["envmap"] == "latlong"
    assert facts["lightprobe:seed"] == "5"
    assert facts["energy"] == pytest.approx([4 * np.pi, 8 * np.pi, 12 * np.pi], rel=1e-4)
    assert facts["mean radiance"] == pytest.approx([1, 2, 3], rel=1e-4)
    right, up = facts["brightest, degrees right and up"]
    assert right == pytest.approx((24.5 / 32 - 0.5) * 360, abs=1e-3)
    assert up == pytest.approx(90 - 3.5 / 16 * 180, abs=1e-3)
    assert cli.main(["inspect", str(tmp_path / "a.exr")]) == 0
    assert "size" in capsys.readouterr().out


def test_inspect_radiance_and_what_is_no_map(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_hdr(tmp_path / "a.hdr", sun_and_sky()[0])
    assert cli.main(["inspect", str(tmp_path / "a.hdr")]) == 0
    assert "Radiance RGBE" in capsys.readouterr().out
    (tmp_path / "a.txt").write_text("no map")
    assert cli.main(["inspect", str(tmp_path / "a.txt")]) == 1
    assert "cannot be read as a photograph" in capsys.readouterr().err


# --- the command line itself ---


def test_help_comes_without_torch() -> None:
    script = (
        "import sys; from dl_core.cli import main\n"
        "for command in ([], ['estimate'], ['spheres'], ['inspect']):\n"
        "    try: main([*command, '--help'])\n"
        "    except SystemExit as left: assert left.code == 0\n"
        "assert not {'torch', 'numpy', 'diffusers', 'OpenEXR'} & set(sys.modules)"
    )
    root = Path(cli.__file__).parent.parent
    done = subprocess.run([sys.executable, "-c", script], cwd=root, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_help_names_what_the_tables_hold(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        cli.main(["estimate", "--help"])
    text = " ".join(capsys.readouterr().out.split())
    for name in (*PRESETS, *MERGES, *BACKENDS):
        assert name in text
    assert next(iter(MERGES)) == "robust"
    assert next(iter(BACKENDS)) == "mini"


@pytest.mark.parametrize("name", cli.COMMANDS)
def test_every_command_declares_and_runs(name: str) -> None:
    if not cli._is_there(cli.COMMANDS[name]):
        pytest.skip(f"{name} is not part of this installation")
    module = cli._load(cli.COMMANDS[name])
    assert callable(module.add_arguments)
    assert callable(module.run)
    with pytest.raises(SystemExit) as left:
        cli.main([name, "--help"])
    assert left.value.code == 0


def test_version(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        cli.main(["--version"])
    assert capsys.readouterr().out.strip() == f"lightprobe {__version__}"


def test_no_command_and_unknown_commands_exit_with_2(capsys: pytest.CaptureFixture[str]) -> None:
    for argv in ([], ["paint"]):
        with pytest.raises(SystemExit) as left:
            cli.main(argv)
        assert left.value.code == 2


def test_estimate_module_only_holds_options() -> None:
    assert estimate.__all__ == ["add_arguments", "run"]
