"""What `lightprobe estimate` does; its options are in `estimate.py`."""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Final

import torch
from tqdm import tqdm

from .. import __version__
from ..backends.loading import LoadedPainter, ModelFiles, choose_backend
from ..ball import DEPTH_DISCS
from ..bracket import check_bracket, ladder
from ..budget import check_budget, choose
from ..depth import load_depth_model
from ..errors import OptionError
from ..estimate import Probe, Settings, bracket_remarks, confidence_remark, planned_evaluations
from ..exposure import check_merge, parse_evs
from ..imageio import read_photograph, require_writable, write_exr, write_hdr, write_png
from ..iterative import Rounds, Tally, tally_lines
from ..mending import Mending, estimate_mended, mending_metadata, mending_remarks
from ..painter import IMPUTINGS, Painter, SilentObserver
from ..photo_exif import choose_fov, read_camera
from ..presets import DEFAULT_PRESET, Preset, preset, presets_taking
from ..shapes import Image
from ..spheres import sphere_sheet

__all__ = ["probe_metadata", "run"]

_WRITERS: Final[dict[str, Callable[[Path, Probe, dict[str, str]], Path]]] = {
    ".exr": lambda path, probe, metadata: write_exr(
        path,
        probe.latlong_hdr[0],
        metadata=metadata,
        confidence=None if probe.confidence is None else probe.confidence.map[0, ..., 0],
    ),
    ".hdr": lambda path, probe, metadata: write_hdr(path, probe.latlong_hdr[0]),
}


@dataclass(frozen=True)
class _Outputs:
    """The files of one run: the map, and what is named after it."""

    map: Path
    ball: Path
    spheres: Path

    @staticmethod
    def beside(name: str) -> _Outputs:
        path = Path(name)
        if path.suffix.lower() not in _WRITERS:
            raise OptionError("output", name, "a name that ends in " + " or ".join(_WRITERS))
        return _Outputs(path, path.with_suffix(".ball.png"), path.with_suffix(".spheres.png"))

    def require_writable(self, sources: Iterable[Path]) -> None:
        """Make sure all can be written, and that none is a file the run reads."""
        for path in (self.map, self.ball, self.spheres):
            if path.resolve() in {source.resolve() for source in sources}:
                raise OptionError("output", str(self.map), f"a name that does not overwrite the input {path}")
            require_writable(path)


class _Progress(SilentObserver):
    """Counts denoiser evaluations on a progress bar."""

    def __init__(self, bar: tqdm[Any]) -> None:
        self.bar = bar

    def evaluated(self, count: int) -> None:
        """Move the bar."""
        self.bar.update(count)

    def spared(self, count: int) -> None:
        """Bring the bar's end nearer (`iterative.SparingObserver`)."""
        self.bar.total -= count
        self.bar.refresh()


def run(args: argparse.Namespace) -> None:
    """Estimate, write, report. Everything that can be refused is refused before the model is loaded.

    Raises:
        ProbeError: see its tree; an option is named as on the command line.
    """
    start = time.perf_counter()
    outputs = _Outputs.beside(args.output)
    if args.budget is not None:
        check_budget(args.budget)
        if args.preset is not None:
            raise OptionError("budget", args.budget, "nothing beside --preset: it chooses one")
    chosen = _preset(args, args.preset or DEFAULT_PRESET)
    evs = chosen.evs
    backend = choose_backend(args.backend)
    check_merge(args.merge)
    check_bracket(args.bracket)
    if args.darkest is not None:
        if args.bracket == "fixed":
            raise OptionError("darkest", args.darkest, "nothing with a fixed bracket; or --bracket scene")
        ladder(evs, args.darkest)  # refuses what no bracket ends at
    if args.impute not in IMPUTINGS:
        raise OptionError("impute", args.impute, ", ".join(IMPUTINGS))
    if args.depth_disc is not None and args.depth_disc not in DEPTH_DISCS:
        raise OptionError("depth_disc", args.depth_disc, ", ".join(DEPTH_DISCS))
    if not 0 <= args.seed < 2**32:
        raise OptionError("seed", args.seed, "0 to 4294967295")
    if not 2 <= args.height <= 4096:
        raise OptionError("height", args.height, "2 to 4096 rows")
    outputs.require_writable([Path(name) for name in (args.photo, args.depth) if name is not None])
    mending, remarks = _mending(args)
    photo = read_photograph(args.photo)
    depth, depth_of = _depth(args.depth)
    loaded = backend.load(ModelFiles.of(args), args.impute)
    args.preset, told = _choose(args, loaded)
    chosen = _preset(args, args.preset)
    settings = Settings(
        rounds=chosen.rounds,
        evs=chosen.evs,
        seed=args.seed,
        merge=args.merge,
        canvas=loaded.canvas,
        diameter=loaded.diameter if args.diameter is None else args.diameter,
        x=args.x,
        y=args.y,
        height=args.height,
        depth_disc=chosen.depth_disc if args.depth_disc is None else args.depth_disc,
        bracket=args.bracket,
        darkest=args.darkest,
    )
    painting = time.perf_counter()
    probe = _paint(photo, loaded.painter, settings, mending, depth, depth_of)
    painted = time.perf_counter()
    extra = {"lightprobe:preset": args.preset, "lightprobe:backend": args.backend, **mending_metadata(mending)}
    written = _write(outputs, probe, extra)
    told = [*told, *remarks, *mending_remarks(mending)]
    _report(args, probe, written, told, {"total": time.perf_counter() - start, "painting": painted - painting})


def _mending(args: argparse.Namespace) -> tuple[Mending, list[str]]:
    """What to do around the estimate, checked, and what to say of the camera.

    Raises:
        OptionError: an option out of range, or a field of view that is missing or not wanted.
    """
    if args.fov is not None and not args.front_fill:
        raise OptionError("fov", args.fov, "nothing without --front-fill")
    tilt = {"pitch": args.pitch or 0.0, "roll": args.roll or 0.0}
    asked = Mending(args.front_fill, args.fov, **tilt, white_balance=args.white_balance)
    if not args.front_fill:
        return asked.check(), []
    replace(asked, fov=60.0 if args.fov is None else args.fov).check()  # all but whether there is a field of view
    camera = read_camera(args.photo)
    fov, remarks = choose_fov(args.fov, camera)
    if fov is None:
        why = camera.remarks[0] if camera.remarks else "the photograph's EXIF data do not tell it"
        raise OptionError("fov", None, f"degrees across the longer side, by --fov: {why}")
    return replace(asked, fov=fov).check(), remarks


def _preset(args: argparse.Namespace, name: str) -> Preset:
    """A preset with what the command line replaces of it."""
    chosen = preset(name)
    rounds = replace(
        chosen.rounds,
        tolerance=args.tolerance,
        min_balls=args.min_balls,
        reject=args.reject,
        light_balls=args.light_balls,
    )
    return replace(chosen, rounds=rounds, evs=chosen.evs if args.evs is None else parse_evs(args.evs))


def _choose(args: argparse.Namespace, loaded: LoadedPainter) -> tuple[str, list[str]]:
    """The preset asked for, or the best one in the time budget, and what to say of it."""
    if args.budget is None:
        return args.preset or DEFAULT_PRESET, []
    presets = {name: _preset(args, name) for name in presets_taking(args.light_balls)}
    choice = choose(args.budget, loaded.painter, loaded.canvas, args.diameter or loaded.diameter, presets)
    return choice.name, [choice.line(args.budget)]


def _depth(name: str | None) -> tuple[Image | None, Callable[[Image], Image] | None]:
    """A depth map from a picture, or what estimates it from a model's folder."""
    if name is None:
        return None, None
    if Path(name).is_dir():
        return None, load_depth_model(name, device="cuda" if torch.cuda.is_available() else "cpu")
    return read_photograph(name), None


def _paint(
    photo: Image,
    painter: Painter,
    settings: Settings,
    mending: Mending,
    depth: Image | None,
    depth_of: Callable[[Image], Image] | None,
) -> Probe:
    with tqdm(total=planned_evaluations(painter, settings), unit="eval", desc="denoising", file=sys.stderr) as bar:
        return estimate_mended(
            photo, painter, settings, mending, depth=depth, depth_of=depth_of, observer=_Progress(bar)
        )


def probe_metadata(probe: Probe) -> dict[str, str]:
    """What a file should say about how its light was estimated: EXR string attributes by name."""
    settings, rounds = probe.settings, probe.settings.rounds
    return {
        "lightprobe:software": f"ComfyUI-LightProbe {__version__}",
        "lightprobe:method": f"DiffusionLight iterative inpainting, {_schedule(rounds)}, merge {settings.merge}",
        "lightprobe:evs": ", ".join(f"{ev:g}" for ev in probe.evs),
        "lightprobe:seed": str(settings.seed),
        "lightprobe:nfe": str(probe.evaluations),
        "lightprobe:confidence": confidence_remark(probe),
        "lightprobe:axes": "centre -Z (where the camera looked), right of it +X, up +Y",
    }


def _schedule(rounds: Rounds) -> str:
    """A schedule in the letters of Algorithm 1."""
    balls = f"N={rounds.balls}"
    if rounds.tolerance is not None:
        balls = f"N={rounds.counts[0]}-{rounds.balls} tolerance={rounds.tolerance:g}"
    until = "" if rounds.until == 1 else f" until={rounds.until:g}"
    lights = f", lights of {rounds.light_balls} whole balls" if rounds.light_balls else ""
    return f"{balls} k={rounds.rounds} strength={rounds.strength:g} steps={rounds.steps}{until}{lights}"


def _write(outputs: _Outputs, probe: Probe, extra: dict[str, str]) -> list[Path]:
    balls = [exposure.ball for exposure in probe.exposures]
    confidence = None if probe.confidence is None else probe.confidence.map
    sheet = sphere_sheet(
        probe.latlong_hdr, composite_ldr=probe.composite_ldr, balls_ldr=balls, evs=probe.evs, confidence=confidence
    )
    write_map = _WRITERS[outputs.map.suffix.lower()]
    return [
        write_map(outputs.map, probe, probe_metadata(probe) | extra),
        write_png(outputs.ball, balls[0][0]),
        write_png(outputs.spheres, sheet),
    ]


def _report(
    args: argparse.Namespace, probe: Probe, written: list[Path], told: list[str], seconds: dict[str, float]
) -> None:
    memory = _peak_memory()
    notes = [
        *told,
        *_doubts(args),
        *(
            f"EV {ev:g}: {note}"
            for ev, exposure in zip(probe.evs, probe.exposures, strict=True)
            for note in (*exposure.notes, *tally_lines(exposure, probe.settings.rounds))
        ),
        *bracket_remarks(probe),
        confidence_remark(probe),
    ]
    if probe.confidence is not None and Path(args.output).suffix.lower() == ".hdr":
        notes.append("a Radiance file has no layers: the confidence map goes with an .exr")
    if args.json:
        report = {
            "written": [str(path) for path in written],
            "evaluations": probe.evaluations,
            "seconds": {name: round(value, 3) for name, value in seconds.items()},
            "peak_memory_bytes": memory,
            "preset": args.preset,
            "backend": args.backend,
            "merge": args.merge,
            "evs": list(probe.evs),
            "rounds": [[_tally(tally) for tally in exposure.tallies] for exposure in probe.exposures],
            "clipped": probe.clipped,
            "expected_error_stops": None if probe.confidence is None else probe.confidence.expected_error,
            "expected_misplaced": None if probe.confidence is None else probe.confidence.misplaced,
            "seed": args.seed,
            "version": __version__,
            "notes": notes,
        }
        print(json.dumps(report, indent=2))
        return
    for path, what in zip(written, ("environment map", "ball at EV 0", "ball, map and spheres"), strict=True):
        print(f"{path}  ({what}, {path.stat().st_size / 1e3:.0f} kB)")
    for note in notes:
        print(note)
    peak = "" if memory is None else f", {memory / 2**30:.2f} GiB at the peak"
    took = f"{seconds['painting']:.1f} s, {seconds['total']:.1f} s in all"
    print(f"{probe.evaluations} denoiser evaluations in {took}{peak}")


def _tally(tally: Tally) -> dict[str, Any]:
    """As JSON has it, which knows no infinity."""
    error = None if tally.error is None or math.isinf(tally.error) else tally.error
    return {**asdict(tally), "error": error}


def _doubts(args: argparse.Namespace) -> list[str]:
    """Choices that run, but hardly give what was wanted."""
    if args.preset == "turbo" and args.turbo_lora is None:
        return [
            "preset turbo without a Turbo LoRA (--turbo-lora): each exposure is one ball of one pass, taken as it is"
        ]
    return []


def _peak_memory() -> int | None:
    """Largest resident size of this process so far, bytes; None where the system does not tell (Windows)."""
    try:
        import resource
    except ImportError:
        return None
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024
