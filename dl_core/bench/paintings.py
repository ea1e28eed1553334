"""Paint the maps that a protocol scores: any panoramas, any painter, the paper's ablation rows.

A run's folder holds, for every variant and shot, `maps/VARIANT/SHOT.exr` and `sheets/VARIANT/SHOT.png`, and for every
shot `truth/SHOT.exr`. What is there already is not painted again, so a killed run loses one map at most.

Source: DiffusionLight, Table 1 (rows) and Sec. 5.1.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Final

import torch
import torch.nn.functional as F
from torch import Tensor

from ..errors import OptionError
from ..estimate import Probe, Settings
from ..exposure import expose
from ..geometry import latlong_to_ball
from ..imageio import atomic, read_envmap, write_exr, write_png
from ..mending import Mending, estimate_mended
from ..painter import Observer, Painter
from ..presets import Preset
from .cameras import CAMERAS, Camera, Shot, take

__all__ = ["VARIANTS", "PainterOf", "Painting", "Variant", "paint_maps", "planned"]


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
        rounds = preset.rounds if self.iterative else replace(preset.rounds, rounds=0)
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

    def map_in(self, folder: Path) -> Path:
        """File of the painted map in a run's folder."""
        return folder / "maps" / self.variant / f"{self.shot}.exr"

    def truth_in(self, folder: Path) -> Path:
        """File of the true map, the same for every variant."""
        return folder / "truth" / f"{self.shot}.exr"

    def sheet_in(self, folder: Path) -> Path:
        """File of the picture sheet."""
        return folder / "sheets" / self.variant / f"{self.shot}.png"


def planned(panoramas: Sequence[Path], protocol: str, variants: Sequence[str], seed: int) -> Iterator[Painting]:
    """Every map of a run, panorama by panorama, so that a run cut short has whole panoramas."""
    for panorama in panoramas:
        for camera in CAMERAS[protocol](panorama.stem, seed):
            yield from (Painting(panorama, camera, variant) for variant in variants)


def paint_maps(
    paintings: Sequence[Painting],
    painter_of: PainterOf,
    preset: Preset,
    settings: Settings,
    folder: Path,
    *,
    painter: str,
    observer: Observer | None = None,
    report: Callable[[str], None],
) -> None:
    """Paint what a folder does not hold yet.

    Args:
        paintings: what to paint.
        painter_of: gives the painter.
        painter: what tells it from other painters; a folder holds maps of one.
        preset: schedule and bracket of the full method.
        settings: all else: canvas, ball, merge, seed, rows of the map.
        folder: of the run.
        observer: hears of progress; may stop the run by raising `Interrupted`.
        report: told of each map, once it is written.

    Raises:
        OptionError: the folder holds a run with other settings or of another painter.
        OutputError: the folder cannot be written.
    """
    _require_same_run(folder, {"painter": painter, "preset": asdict(preset), "settings": asdict(settings)})
    for number, painting in enumerate(paintings, 1):
        if painting.map_in(folder).is_file():
            continue
        shot = take(read_envmap(painting.panorama), painting.camera)
        variant = VARIANTS[painting.variant]
        probe = estimate_mended(
            shot.photo_ldr,
            painter_of(variant, shot),
            variant.settings(preset, settings),
            Mending(variant.front_fill, painting.camera.longer_fov),
            observer=observer,
        )
        _keep(folder, painting, shot, probe)
        report(f"{number}/{len(paintings)} {painting.shot} {variant.label}: {probe.evaluations} evaluations")


def _require_same_run(folder: Path, options: dict[str, Any]) -> None:
    """Keep runs apart: maps of two schedules under one name would be scored as one."""
    folder.mkdir(parents=True, exist_ok=True)
    path, wanted = folder / "run.json", json.dumps(options, sort_keys=True)
    if path.is_file() and path.read_text(encoding="utf-8") != wanted:
        raise OptionError("--out", str(folder), "a new folder, or the options of the run that is in it (run.json)")
    with atomic(path) as temporary:
        temporary.write_text(wanted, encoding="utf-8")


def _keep(folder: Path, painting: Painting, shot: Shot, probe: Probe) -> None:
    """Write truth, sheet and map; the map last, for it says that the others are there."""
    truth, sheet, path = painting.truth_in(folder), painting.sheet_in(folder), painting.map_in(folder)
    for place in (truth, sheet, path):
        place.parent.mkdir(parents=True, exist_ok=True)
    write_exr(truth, shot.truth_hdr[0], metadata={})
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
