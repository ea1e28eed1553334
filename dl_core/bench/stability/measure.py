"""Estimates of one panorama's light under everything that the bench changes, and how far their maps are apart."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import combinations
from pathlib import Path
from statistics import fmean
from typing import Any, Final

import torch
import torch.nn.functional as F
from torch import Tensor

from ...estimate import Probe, Settings, estimate
from ...exposure import expose
from ...imageio import read_envmap, write_png
from ...painter import Painter, SilentObserver
from ...quality.inspection import inspect_picture
from ...shapes import Latlong
from ..cameras import Camera, Shot, take
from ..map_distance import map_distance
from ..painters import Studio
from ..paintings import VARIANTS
from ..report import Row
from ..shared_balls import SharedBalls
from .changes import INVARIANCES, Change
from .failures import FAILURES, Failure

__all__ = ["SECTIONS", "Grid", "Panorama", "mean_distance", "picture_of"]

STEERED: Final = VARIANTS["both"]
APART: Final = 1000
"""Between first seeds, so that no two estimates share a ball."""


@dataclass(frozen=True)
class Grid:
    """How much is measured.

    Attributes:
        scale_seeds: estimates of the ordinary photograph that the distance of seeds is the mean of, pair by pair.
        seeds: estimates of every schedule whose spread is measured.
        schedules: numbers of balls and rounds, (N, k).
        steps: of the samplers that are compared.
        starts: balls from other seeds that each of them paints.
    """

    scale_seeds: int
    seeds: int
    schedules: tuple[tuple[int, int], ...]
    steps: tuple[int, ...]
    starts: int


class _Counter(SilentObserver):
    """Counts evaluations that are done, not those of balls that are there already."""

    def __init__(self) -> None:
        self.total = 0

    def evaluated(self, count: int) -> None:
        self.total += count


class Panorama:
    """A panorama, its ordinary photograph, and estimates of it.

    Args:
        path: file of the map.
        studio: gives painters.
        settings: of an ordinary estimate.
        grid: how much to measure.
        pictures: folder for a strip of pictures of each variant; none are drawn without one.
    """

    def __init__(self, path: Path, studio: Studio, settings: Settings, grid: Grid, pictures: Path | None) -> None:
        self.name = path.stem
        self.settings = settings
        self.grid = grid
        self._studio = studio
        self._pictures = pictures
        self.light_hdr = read_envmap(path)
        self.shot = take(self.light_hdr, Camera())

    def painter(self, shot: Shot | None = None) -> Painter:
        """The painter of a photograph; of the ordinary one when none is given."""
        return self._studio.painter_of(STEERED, self.shot if shot is None else shot)

    @cached_property
    def _shared(self) -> SharedBalls:
        return SharedBalls(self.painter())

    def probe(
        self,
        settings: Settings,
        *,
        shot: Shot | None = None,
        painter: Painter | None = None,
        counter: _Counter | None = None,
    ) -> Probe:
        """An estimate, of the ordinary photograph and by its own painter unless others are given."""
        shown = self.shot if shot is None else shot
        chosen = painter or (self._shared if shot is None else self.painter(shot))
        return estimate(shown.photo_ldr, chosen, settings, observer=counter)

    def with_seed(self, number: int, settings: Settings | None = None) -> Settings:
        """Settings whose balls are all others than those of another number."""
        chosen = self.settings if settings is None else settings
        return replace(chosen, seed=chosen.seed + APART * number)

    @cached_property
    def ordinary(self) -> list[Probe]:
        """Estimates of the ordinary photograph, each from other seeds."""
        return [self.probe(self.with_seed(number)) for number in range(self.grid.scale_seeds)]

    @cached_property
    def seed_distance(self) -> float:
        """Stops between two estimates of the ordinary photograph from other seeds."""
        return mean_distance([probe.latlong_hdr for probe in self.ordinary])

    def draw(self, row: Row, shot: Shot, probe: Probe) -> None:
        """Keep a strip of pictures of a row."""
        if self._pictures is not None:
            path = self._pictures / picture_of(row)
            path.parent.mkdir(parents=True, exist_ok=True)
            write_png(path, _strip(shot, probe))


def mean_distance(maps: Sequence[Latlong]) -> float:
    """Stops between two of several maps, the mean over all pairs; 0 of one."""
    return fmean(map_distance(first, second) for first, second in combinations(maps, 2)) if len(maps) > 1 else 0.0


def picture_of(row: Row) -> Path:
    """Where the strip of a row lies in the folder of pictures."""
    plain = "".join(letter if letter.isalnum() else "-" for letter in f"{row['family']} {row['variant']}")
    return Path(plain) / f"{row['panorama']}.png"


def _strip(shot: Shot, probe: Probe) -> Tensor:
    """The photograph with the ball, the ball, the map, the true map; all at EV 0 and of one height."""
    rows = probe.settings.height * 2
    pictures = [
        probe.composite_ldr,
        expose(probe.ball_hdr, 0.0),
        *(expose(light, 0.0) for light in (probe.latlong_hdr, shot.truth_hdr)),
    ]
    return torch.cat([_to_height(picture, rows) for picture in pictures], dim=2)[0]


def _to_height(picture: Tensor, rows: int) -> Tensor:
    size = (rows, round(picture.shape[2] * rows / picture.shape[1]))
    planes = picture.permute(0, 3, 1, 2)
    return F.interpolate(planes, size, mode="bilinear", antialias=True).permute(0, 2, 3, 1)


# --- sections ----------------------------------------------------------------------------------------------------

Measured = Callable[[], Row]
"""Measures one variant."""


def _row(panorama: Panorama, family: str, variant: str, distance: float, seed_distance: float, **more: Any) -> Row:
    return {
        "family": family,
        "variant": variant,
        "panorama": panorama.name,
        "distance": distance,
        "seed_distance": seed_distance,
        "unit": "stops",
        "error": None,
        "expected_error": None,
        "ball_score": None,
        **more,
    }


def _judged(probe: Probe, shot: Shot) -> Row:
    """What an estimate is worth, and what it says of itself."""
    return {
        "error": map_distance(probe.latlong_hdr, shot.truth_hdr),
        "expected_error": None if probe.confidence is None else probe.confidence.expected_error,
        "ball_score": inspect_picture(probe.composite_ldr, probe.ball).score,
    }


def _invariances(panorama: Panorama) -> Iterator[tuple[str, str, Measured]]:
    """Distance to the map of the unchanged photograph, from the same seeds."""

    def measured(change: Change) -> Row:
        shot, counter = change.of(panorama.shot), _Counter()
        probe = panorama.probe(change.settings(panorama.settings), shot=shot, counter=counter)
        distance = map_distance(change.back(probe.latlong_hdr), panorama.ordinary[0].latlong_hdr)
        row = _row(panorama, change.family, change.variant, distance, panorama.seed_distance, **_judged(probe, shot))
        panorama.draw(row, shot, probe)
        return {**row, "evaluations": counter.total}

    for change in INVARIANCES:
        yield change.family, change.variant, partial(measured, change)


def _failures(panorama: Panorama) -> Iterator[tuple[str, str, Measured]]:
    """Distance to the truth, against that of two estimates from other seeds."""

    def measured(failure: Failure) -> Row:
        shot, counter = failure.of(panorama.light_hdr), _Counter()
        probes = [panorama.probe(panorama.with_seed(number), shot=shot, counter=counter) for number in range(2)]
        judged = _judged(probes[0], shot)
        distance = fmean(map_distance(probe.latlong_hdr, shot.truth_hdr) for probe in probes)
        apart = mean_distance([probe.latlong_hdr for probe in probes])
        row = _row(panorama, failure.family, failure.variant, distance, apart, **{**judged, "error": distance})
        panorama.draw(row, shot, probes[0])
        return {**row, "evaluations": counter.total}

    for failure in FAILURES:
        yield failure.family, failure.variant, partial(measured, failure)


def _seeds(panorama: Panorama) -> Iterator[tuple[str, str, Measured]]:
    """Distance between two estimates of a schedule from other seeds, against that of the preset."""

    def measured(variant: str, balls: int, rounds: int) -> Row:
        schedule = replace(panorama.settings.rounds, balls=balls, rounds=rounds, tolerance=None)
        settings, counter = replace(panorama.settings, rounds=schedule), _Counter()
        probes = [
            panorama.probe(panorama.with_seed(number, settings), counter=counter)
            for number in range(panorama.grid.seeds)
        ]
        errors = [map_distance(probe.latlong_hdr, panorama.shot.truth_hdr) for probe in probes]
        distance = mean_distance([probe.latlong_hdr for probe in probes])
        more = {**_judged(probes[0], panorama.shot), "error": fmean(errors), "evaluations": counter.total}
        return _row(panorama, "seeds", variant, distance, panorama.seed_distance, **more)

    for balls, rounds in panorama.grid.schedules:
        variant = f"N = {balls}, k = {rounds}" if rounds else "one ball"
        yield "seeds", variant, partial(measured, variant, balls, rounds)


def _samplers(panorama: Panorama) -> Iterator[tuple[str, str, Measured]]:
    """One ball from each of several starts: a deterministic sampler against the preset's from the same starts, a
    stochastic one against other noise at its steps; beside the distance between starts."""
    from ...backends.diffusers_painter import SAMPLERS, STOCHASTIC, DiffusersPainter

    painter = panorama.painter()
    if not isinstance(painter, DiffusersPainter):
        return

    def measured(variant: str, sampler: str, steps: int) -> Row:
        schedule = replace(panorama.settings.rounds, rounds=0, steps=steps)
        first = replace(panorama.settings, rounds=schedule)
        starts = [panorama.with_seed(number, first) for number in range(panorama.grid.starts)]
        chosen, counter = painter.varied(sampler=sampler), _Counter()

        def lights(by: Painter) -> list[Latlong]:
            return [panorama.probe(start, painter=by, counter=counter).latlong_hdr for start in starts]

        own, other = lights(chosen), lights(chosen.varied(walk=1) if sampler in STOCHASTIC else painter)
        distance = fmean(map_distance(first, second) for first, second in zip(own, other, strict=True))
        error = fmean(map_distance(light, panorama.shot.truth_hdr) for light in own)
        more = {"error": error, "evaluations": counter.total}
        return _row(panorama, "samplers", variant, distance, mean_distance(own), **more)

    for steps in panorama.grid.steps:
        for sampler in SAMPLERS:
            if sampler == painter.sampler:
                continue
            against = "two walks from one start" if sampler in STOCHASTIC else f"against {painter.sampler}"
            variant = f"{sampler}, {steps} steps, {against}"
            yield "samplers", variant, partial(measured, variant, sampler, steps)


def _numerics(panorama: Panorama) -> Iterator[tuple[str, str, Measured]]:
    """Distance to the map of the same seeds in single precision and batches of the usual size."""
    from ...backends.diffusers_painter import DiffusersPainter

    painter = panorama.painter()
    if not isinstance(painter, DiffusersPainter):
        return

    def measured(variant: str, build: Callable[[], Painter]) -> Row:
        counter = _Counter()
        probe = panorama.probe(panorama.settings, painter=build(), counter=counter)
        distance = map_distance(probe.latlong_hdr, panorama.ordinary[0].latlong_hdr)
        more = {**_judged(probe, panorama.shot), "evaluations": counter.total}
        return _row(panorama, "numerics", variant, distance, panorama.seed_distance, **more)

    half = painter.pipeline.unet.device.type != "cpu"
    ways: dict[str, Callable[[], Painter]] = {
        "bfloat16": lambda: painter.in_precision(torch.bfloat16),
        # Processors convolve half floats some eighty times slower than single ones: there only weights are rounded.
        **(
            {"float16": lambda: painter.in_precision(torch.float16)}
            if half
            else {"float16 weights": lambda: painter.in_precision(torch.float16).in_precision(torch.float32)}
        ),
        "batch 1": lambda: painter.varied(batch=1),
        "batch 16": lambda: painter.varied(batch=16),
    }
    for variant, build in ways.items():
        yield "numerics", variant, partial(measured, variant, build)


SECTIONS: Final[dict[str, Callable[[Panorama], Iterator[tuple[str, str, Measured]]]]] = {
    "invariances": _invariances,
    "failures": _failures,
    "seeds": _seeds,
    "samplers": _samplers,
    "numerics": _numerics,
}
"""Parts of the bench: families, variants and what measures each."""
