"""Medians that stop denoising early: error, cost and time against the share of the schedule that they run."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from statistics import fmean
from typing import Final

from ...estimate import Probe, Settings, estimate
from ...iterative import Rounds
from ...presets import PAPER_EVS
from ..painters import Studio
from ..paintings import VARIANTS
from ..report import Column, Row
from ..scoring import SPHERES, score_maps
from ..shared_balls import SharedBalls
from .section import Options, Scene, Section, ball_rmse

__all__ = ["UntilSection"]

CONVENTION: Final = "published"
_FIGURES: Final = ("ball_rmse", "dark_rmse", *(f"{sphere}_{error}" for sphere in SPHERES for error in ("si", "deg")))


class UntilSection(Section):
    """Errors of the spheres and of the ball, cost and time; with a last ball and without one."""

    summary = "error against the share of the schedule after which medians stop"
    rows = (
        Column("panorama", "panorama"),
        Column("until", "until", "g"),
        Column("last ball", "final"),
        Column("NFE", "evaluations"),
        Column("s", "seconds", ".1f"),
        Column("ball", "ball_rmse", ".4f"),
        Column("diffuse si", "diffuse_si", ".3f"),
        Column("mirror si", "mirror_si", ".3f"),
    )
    columns = (
        Column("until", "until", "g"),
        Column("last ball", "final"),
        Column("NFE", "evaluations", ".0f"),
        Column("s", "seconds", ".1f"),
        Column("spread", "spread", ".4f"),
        Column("ball EV 0", "ball_rmse", ".4f"),
        Column("to whole", "ball_rmse_ratio", ".3f"),
        Column("darkest ball", "dark_rmse", ".4f"),
        *(
            Column(f"{sphere} {title}", f"{sphere}_{key}", form)
            for sphere in SPHERES
            for title, key, form in (("si-RMSE", "si", ".3f"), ("deg", "deg", ".2f"))
        ),
    )

    def __init__(self, studio: Studio, options: Options) -> None:
        super().__init__(studio, options)
        self._settings = Settings(evs=PAPER_EVS, seed=options.seed, canvas=studio.canvas, diameter=studio.diameter)

    @property
    def each(self) -> int:
        """Rows of a panorama."""
        return 2 * len(self._options.untils)

    def measure(self, path: Path) -> list[Row]:
        """A row for each share, with a last ball and without one."""
        scene = Scene.of(path, self._studio)
        painter = self._studio.painter_of(VARIANTS["both"], scene.shot)
        options, rows = self._options, list[Row]()
        for until in options.untils:
            shared = SharedBalls(painter)
            for final in (True, False):
                before = shared.seconds
                rounds = Rounds(options.balls, options.rounds, options.strength, options.steps, final, until)
                probe = estimate(scene.shot.photo_ldr, shared, replace(self._settings, rounds=rounds))
                row = {"panorama": path.stem, "until": until, "final": final}
                cost = {"evaluations": probe.evaluations, "seconds": shared.seconds - before}
                rows.append({**row, **cost, **_errors(scene, probe)})
        return rows

    def summarize(self, rows: list[Row]) -> list[Row]:
        """Means over panoramas, and the ball's error as a multiple of that of whole schedules, panorama by panorama."""
        summary = []
        whole = {(row["panorama"], row["final"]): row["ball_rmse"] for row in rows if row["until"] == 1}
        for until, final in dict.fromkeys((row["until"], row["final"]) for row in rows):
            own = [row for row in rows if (row["until"], row["final"]) == (until, final)]
            line: Row = {"until": until, "final": final, "panoramas": len(own)}
            line |= {key: fmean(row[key] for row in own) for key in ("evaluations", "seconds", "spread", *_FIGURES)}
            ratios = [
                row["ball_rmse"] / whole[row["panorama"], final] for row in own if whole.get((row["panorama"], final))
            ]
            summary.append({**line, "ball_rmse_ratio": fmean(ratios) if ratios else None})
        return summary

    def protocol(self) -> Row:
        """What was measured how."""
        return {
            "evs": list(PAPER_EVS),
            "ball": "RMSE of the answer from the true ball inside the disc, display-encoded; means over panoramas",
            "to whole": "the ball's error at EV 0 over that of whole schedules, mean of panoramas",
            "spread": "mean over the ball of the median deviation of the last median's balls at EV 0",
            "spheres": f"three-spheres, convention {CONVENTION}",
            "seconds": "in the painter alone",
        }


def _errors(scene: Scene, probe: Probe) -> Row:
    balls = [ball_rmse(found.ball, scene.true_ball(ev)) for found, ev in zip(probe.exposures, PAPER_EVS, strict=True)]
    spheres = score_maps(probe.latlong_hdr, scene.shot.truth_hdr, "three-spheres", CONVENTION)
    return {
        "spread": float(probe.exposures[0].spread.mean()),
        "ball_rmse": balls[0],
        "dark_rmse": balls[-1],
        **{f"{row['sphere']}_si": row["si_rmse"] for row in spheres},
        **{f"{row['sphere']}_deg": row["angular_error_deg"] for row in spheres},
    }
