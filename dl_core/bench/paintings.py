"""Paint the maps that a protocol scores: any panoramas, any painter, the paper's ablation rows.

A run's folder holds, for every variant and shot, `maps/VARIANT/SHOT.exr` and `sheets/VARIANT/SHOT.png`, and for every
shot `truth/SHOT.exr`. What is there already is not painted again, so a killed run loses one map at most.

Source: DiffusionLight, Table 1 (rows) and Sec. 5.1.
"""

from __future__ import annotations

import json
import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from itertools import groupby
from pathlib import Path
from typing import Any, Final

import torch
import torch.nn.functional as F
from torch import Tensor

from ..errors import OptionError
from ..estimate import Probe, Settings, estimate
from ..exposure import expose
from ..geometry import latlong_to_ball
from ..imageio import atomic, read_envmap, write_exr, write_png
from ..mending import Mending, mend_map
from ..painter import Painter
from ..presets import Preset
from .cameras import Camera, Shot, cameras_of, take
from .workers import results_of

__all__ = ["VARIANTS", "PainterOf", "Painting", "Variant", "paint_maps", "photographed", "planned"]


@dataclass(frozen=True)
class Variant:
    """A row of the paper's ablation.

    Attributes:
        label: as Table 1 has it.
        iterative: medians of many balls; one ball otherwise.
        lora: exposures steered by the LoRA; without it EV 0 is all there is, and lights end at its white.
        front_fill: the map's front filled with the photograph, whose field of view is known.
    """

    label: str
    iterative: bool
    lora: bool
    front_fill: bool = False

    def settings(self, preset: Preset, base: Settings) -> Settings:
        """What to estimate: the preset's schedule and bracket, less what this row goes without."""
        rounds = preset.rounds if self.iterative else replace(preset.rounds, rounds=0, light_balls=0)
        return replace(base, rounds=rounds, evs=preset.evs if self.lora else preset.evs[:1])


VARIANTS: Final[dict[str, Variant]] = {
    "base": Variant("base", iterative=False, lora=False),
    "iterative": Variant("base + iterative", iterative=True, lora=False),
    "lora": Variant("base + LoRA", iterative=False, lora=True),
    "both": Variant("base + iterative + LoRA", iterative=True, lora=True),
    "filled": Variant("base + iterative + LoRA, front filled", iterative=True, lora=True, front_fill=True),
}
"""The rows of Table 1, and what `front_fill` makes of the last."""

PainterOf = Callable[[Variant, Shot], Painter]
"""The painter of a variant; of a shot, too, for one that knows the truth."""


@dataclass(frozen=True)
class Painting:
    """One map to paint.

    Attributes:
        panorama: file of the light.
        camera: that takes the photograph.
        variant: key of `VARIANTS`.
    """

    panorama: Path
    camera: Camera
    variant: str

    @property
    def shot(self) -> str:
        """Name of the photograph, fit for a file."""
        return f"{self.panorama.stem}.{self.camera.name}"

    def seed(self, seed: int) -> int:
        """Seed of the photograph's first ball in a run of some seed.

        Balls that start from the same noise are alike in any photograph (DiffusionLight, Sec. 4.1). With one seed for
        all, a table would tell the luck of one noise; so each photograph has its own, whatever else is in the run.
        """
        return seed + zlib.crc32(self.shot.encode()) % 1_000_000

    def map_in(self, folder: Path) -> Path:
        """File of the painted map in a run's folder."""
        return folder / "maps" / self.variant / f"{self.shot}.exr"

    def truth_in(self, folder: Path) -> Path:
        """File of the true map, the same for every variant."""
        return folder / "truth" / f"{self.shot}.exr"

    def sheet_in(self, folder: Path) -> Path:
        """File of the picture sheet."""
        return folder / "sheets" / self.variant / f"{self.shot}.png"


def planned(
    panoramas: Sequence[Path], protocol: str, variants: Sequence[str], seed: int, photographs: int = 1
) -> Iterator[Painting]:
    """Every map of a run, panorama by panorama, so that a run cut short has whole panoramas.

    Raises:
        OptionError: as `cameras_of`.
    """
    for panorama in panoramas:
        for camera in cameras_of(protocol, panorama.stem, seed, photographs):
            yield from (Painting(panorama, camera, variant) for variant in variants)


def paint_maps(
    paintings: Sequence[Painting],
    painters: Callable[[], PainterOf],
    preset: Preset,
    settings: Settings,
    folder: Path,
    *,
    painter: str,
    workers: int = 1,
    report: Callable[[str], None],
) -> None:
    """Paint what a folder does not hold yet.

    Args:
        paintings: what to paint.
        painters: opens what gives the painters; with several workers it has to be one that can be pickled.
        preset: schedule and bracket of the full method.
        settings: all else: canvas, ball, merge, seed, rows of the map.
        folder: of the run.
        painter: what tells it from other painters; a folder holds maps of one.
        workers: processes, each with a panorama at a time.
        report: told of each map, once it is written.

    Raises:
        OptionError: the folder holds a run with other settings or of another painter.
        OutputError: the folder cannot be written.
    """
    _require_same_run(
        folder, {"painter": painter, "preset": asdict(preset), "settings": asdict(settings), "seeds": "photograph"}
    )
    wanted = [painting for painting in paintings if not painting.map_in(folder).is_file()]
    inside = [list(group) for _, group in groupby(wanted, key=lambda painting: painting.panorama)]
    task = partial(_paint_inside, painters=painters, preset=preset, settings=settings, folder=folder)
    for number, line in enumerate(results_of(task, inside, workers), 1):
        report(f"{number}/{len(wanted)} {line}")


def _paint_inside(
    paintings: Sequence[Painting],
    painters: Callable[[], PainterOf],
    preset: Preset,
    settings: Settings,
    folder: Path,
) -> Iterator[str]:
    """Paint maps of one panorama; a line on each, once it is written.

    What variants of a photograph share is painted once.
    """
    painter_of = painters()
    for shot, of_shot in photographed(paintings, folder):
        painted: dict[tuple[Settings, bool], Probe] = {}
        for painting in of_shot:
            variant = VARIANTS[painting.variant]
            key = (variant.settings(preset, replace(settings, seed=painting.seed(settings.seed))), variant.lora)
            if key not in painted:
                painted[key] = estimate(shot.photo_ldr, painter_of(variant, shot), key[0])
            probe = mend_map(painted[key], shot.photo_ldr, Mending(variant.front_fill, painting.camera.longer_fov))
            _keep(folder, painting, shot, probe)
            yield f"{painting.shot} {variant.label}: {probe.evaluations} evaluations"


def photographed(paintings: Sequence[Painting], folder: Path) -> Iterator[tuple[Shot, list[Painting]]]:
    """The photographs that maps are wanted of, each taken once, with its paintings.

    Args:
        paintings: as `planned` orders them.
        folder: of the run; it holds a photograph's true map once the photograph is given.

    Raises:
        ImageError: a panorama cannot be read.
        OutputError: the folder cannot be written.
    """
    for panorama, inside in groupby(paintings, key=lambda painting: painting.panorama):
        light = read_envmap(panorama)
        for camera, group in groupby(inside, key=lambda painting: painting.camera):
            shot, of_shot = take(light, camera), list(group)
            truth = of_shot[0].truth_in(folder)
            truth.parent.mkdir(parents=True, exist_ok=True)
            write_exr(truth, shot.truth_hdr[0], metadata={})
            yield shot, of_shot


def _require_same_run(folder: Path, options: dict[str, Any]) -> None:
    """Keep runs apart: maps of two schedules under one name would be scored as one."""
    folder.mkdir(parents=True, exist_ok=True)
    path, wanted = folder / "run.json", json.dumps(options, sort_keys=True)
    if path.is_file() and path.read_text(encoding="utf-8") != wanted:
        raise OptionError("--out", str(folder), "a new folder, or the options of the run that is in it (run.json)")
    with atomic(path) as temporary:
        temporary.write_text(wanted, encoding="utf-8")


def _keep(folder: Path, painting: Painting, shot: Shot, probe: Probe) -> None:
    """Write sheet and map; the map last, for it says that the others are there."""
    sheet, path = painting.sheet_in(folder), painting.map_in(folder)
    for place in (sheet, path):
        place.parent.mkdir(parents=True, exist_ok=True)
    write_png(sheet, _sheet(shot, probe))
    write_exr(path, probe.latlong_hdr[0], metadata={"lightprobe:nfe": str(probe.evaluations)})


def _sheet(shot: Shot, probe: Probe) -> Tensor:
    """Photograph, painted ball, true ball; below them the map and the true map. All at EV 0."""
    rows = probe.ball_hdr.shape[1]
    true_ball = latlong_to_ball(shot.truth_hdr, rows)
    top = torch.cat([_resized(shot.photo_ldr, rows), *(expose(ball, 0.0) for ball in (probe.ball_hdr, true_ball))], 2)
    width = top.shape[2]
    maps = torch.cat([_resized(expose(light, 0.0), width // 4) for light in (probe.latlong_hdr, shot.truth_hdr)], 2)
    return torch.cat([top, F.pad(maps, (0, 0, 0, width - maps.shape[2]))], dim=1)[0]


def _resized(picture: Tensor, rows: int) -> Tensor:
    size = (rows, round(picture.shape[2] * rows / picture.shape[1]))
    return F.interpolate(picture.permute(0, 3, 1, 2), size=size, mode="bilinear", antialias=True).permute(0, 2, 3, 1)
