"""SpeedAccuracyChart: what a schedule costs, and what others reach for it."""

from __future__ import annotations

from comfy_api.latest import io

from ..dl_core.exposure import check_evs
from ..dl_core.iterative import Rounds
from .painting import light_balls_input, rounds_inputs, rounds_of, settling_inputs
from .sockets import CATEGORY, named_output, parse_evs

__all__ = ["SpeedAccuracyChart"]


class SpeedAccuracyChart(io.ComfyNode):  # type: ignore[misc]
    """Points at a schedule on the measured chart."""

    @classmethod
    def define_schema(cls) -> io.Schema:
        """Sockets of the node."""
        return io.Schema(
            node_id="SpeedAccuracyChart",
            display_name="Speed Accuracy Chart",
            category=CATEGORY,
            description="Shows the mini model's errors against denoiser evaluations, as `lightprobe bench pareto` "
            "measured them, and these settings: a star, or a dashed line at their cost where they were not measured.",
            inputs=[
                *rounds_inputs("balanced"),
                io.Int.Input("steps", default=30, min=1, max=998, tooltip="Denoising steps of a full schedule."),
                *settling_inputs(),
                io.String.Input("evs", default="0, -2.5, -5", tooltip="Exposures, descending from 0."),
                light_balls_input(),
            ],
            outputs=[
                named_output(io.Image, "chart", "Four errors against evaluations; the line is the front."),
                named_output(io.String, "report", "What these settings cost, and where they stand."),
            ],
        )

    @classmethod
    def execute(
        cls,
        preset: str,
        balls: int,
        rounds: int,
        strength: float,
        final: bool,
        steps: int,
        evs: str,
        tolerance: float = 0.0,
        min_balls: int = Rounds.min_balls,
        until: float = 1.0,
        light_balls: int = 0,
    ) -> io.NodeOutput:
        """Draw the chart."""
        # matplotlib takes a second to import, which no other node should wait for.
        from ..dl_core.bench.pareto.shipped_chart import chart_of

        rest = (tolerance, min_balls, until, False, light_balls)
        schedule = rounds_of(preset, balls, rounds, strength, final, steps, *rest)
        return io.NodeOutput(*chart_of(schedule, check_evs(parse_evs(evs))))
