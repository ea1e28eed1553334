"""Training pairs whose balls are medians that the iterative method painted: what a Turbo LoRA learns to paint at once.

Each photograph is painted at every exposure, and each of these is a shard of its own: a run that was stopped goes on at
the first that is missing. `pairs.PairShards` reads them.

Source: DiffusionLight, Algorithm 1 (the median); DiffusionLight-Turbo (a LoRA in the place of the median's rounds).
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import Any, Final

from ...backends.loading import LoadedPainter
from ...ball import Ball, fit_canvas, paint_depth, paste_ball, place_ball
from ...errors import ImageError, OptionError
from ...imageio import read_photograph
from ...iterative import Rounds, iterative_inpaint
from ...json_text import read_json
from ...painter import Observer, Painter, PaintRequest, SilentObserver
from ...photo_folder import folder_files
from ...shapes import Image
from ..data.pairs import FORMAT, INDEX, PairShards
from ..data.shard_plan import write_json
from ..data.shards import Shard, clear_leftovers, png_bytes, write_pairs

__all__ = ["PLAN", "MedianPainting", "paint_medians"]

PLAN: Final = "medians.json"
"""What the folder's medians were painted with."""


@dataclass(frozen=True)
class MedianPainting:
    """How medians are painted.

    Attributes:
        rounds: N, k, γ and steps; a last ball after the median is not painted.
        evs: exposures.
        seed: of the first ball.
        made_with: names of what the painter was loaded from, by option.
        depth_disc: of `ball.DEPTH_DISCS`.
    """

    rounds: Rounds
    evs: tuple[float, ...]
    seed: int
    made_with: dict[str, str]
    depth_disc: str = "ball"


def paint_medians(
    photographs: Path,
    load: Callable[[], LoadedPainter],
    painting: MedianPainting,
    out: Path,
    *,
    depth_of: Callable[[Image], Image] | None = None,
    observer: Observer | None = None,
    report: Callable[[str], None],
) -> PairShards:
    """Paint the medians that are not there yet.

    Args:
        photographs: folder of them; those that cannot be read are left out, with a line.
        load: gives the painter; called only if something is to be painted.
        painting: how.
        out: folder for the shards, made if it is not there.
        depth_of: depth of a canvas, see `iterative.iterative_inpaint`; without it the scene counts as far away.
        observer: hears of the painting; may stop it by raising.
        report: told of every median.

    Returns:
        The pairs: photographs at EV 0 with the median pasted in, photograph by photograph, exposures in their order.

    Raises:
        ImageError: no folder, or no photograph in it.
        OptionError: the folder `out` holds medians painted in another way, or of other photographs.
        OutputError: a shard cannot be written; those before it stay.
    """
    out.mkdir(parents=True, exist_ok=True)
    files = [path for path in folder_files(photographs) if _is_readable(path, report)]
    if not files:
        raise ImageError(photographs, "holds no photograph")
    _require_plan(out, painting, files)
    for path in clear_leftovers(out):
        report(f"removed {path.name}, left by a run that was killed")
    loaded = cache(load)
    shards = []
    for i, file in enumerate(files):
        for j, ev in enumerate(painting.evs):
            index = i * len(painting.evs) + j
            path = out / Shard("training", index, index, 1).file
            if not path.is_file():
                place = loaded()
                ball = place_ball(place.canvas, place.diameter, depth_disc=painting.depth_disc)
                canvas = _with_median(place.painter, file, ball, ev, painting, depth_of, observer)
                record = {"panorama": file.name, "ev": ev, "ball": asdict(ball)}
                write_pairs(path, [(index, {"image.png": png_bytes(canvas[0]), "json": json.dumps(record).encode()})])
                report(f"median {index + 1} of {len(files) * len(painting.evs)}: {file.name} at EV {ev:g}")
            shards.append({"file": path.name, "split": "training", "pairs": 1, "bytes": path.stat().st_size})
    write_json(out / INDEX, {"format": FORMAT, "shards": shards})
    return PairShards(out)


def _is_readable(path: Path, report: Callable[[str], None]) -> bool:
    try:
        read_photograph(path)
    except ImageError as error:
        report(f"{path.name} is left out: {error.reason}")
        return False
    return True


def _require_plan(out: Path, painting: MedianPainting, files: Sequence[Path]) -> None:
    """Compare with what the folder's medians were painted with, or note it down."""
    plan: dict[str, Any] = {
        "photographs": {file.name: file.stat().st_size for file in files},
        "rounds": asdict(painting.rounds),
        "evs": list(painting.evs),
        "--seed": painting.seed,
        "depth_disc": painting.depth_disc,
        **painting.made_with,
    }
    path = out / PLAN
    if not path.is_file():
        write_json(path, plan)
        return
    try:
        there = dict(read_json(path))
    except (OSError, ValueError, TypeError) as error:
        raise OptionError("--work", str(out), f"a folder whose {PLAN} can be read") from error
    for name, value in plan.items():
        if there.get(name) != value:
            raise OptionError(name, value, f"{there.get(name)!r}, what the medians in {out} are of; or another --work")


def _with_median(
    painter: Painter,
    file: Path,
    ball: Ball,
    ev: float,
    painting: MedianPainting,
    depth_of: Callable[[Image], Image] | None,
    observer: Observer | None,
) -> Image:
    """A photograph on its canvas with its median ball, (1, S, S, 3)."""
    canvas = fit_canvas(read_photograph(file), ball.canvas)
    depth = paint_depth(None if depth_of is None else depth_of(canvas), ball)
    request = PaintRequest(canvas, depth, ball, ev, (painting.seed,))
    found = iterative_inpaint(painter, request, painting.rounds, observer or SilentObserver(), depth_of=depth_of)
    return paste_ball(canvas, found.median, ball)
