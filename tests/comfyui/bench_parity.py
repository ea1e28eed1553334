"""One set of weights in ComfyUI and in diffusers' own pipeline, stage by stage: `python tests/comfyui/bench_parity.py`.

SDXL's true topology at a tenth of its width (`toy_sdxl`) and the mini model. Then balls by sampler: Euler shows that
the paths agree; UniPC differs by design, ComfyUI's being of third order (bh1, bh2), diffusers' of second (bh2).
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

sys.path[:0] = [str(Path(__file__).resolve().parents[2]), str(Path(__file__).resolve().parents[1])]

import torch  # noqa: E402
from comfy_host import leading_euler, pack_module  # noqa: E402
from parity import (  # noqa: E402
    Pair,
    comfy_balls,
    mini_pair,
    pipeline_balls,
    request_of,
    stages,
    toy_pair,
)

SAMPLERS = ("euler", "uni_pc", "uni_pc_bh2")


def print_stages(pair: Pair, steps: int) -> None:
    """A row for each stage."""
    print(f"{'stage':36}{'difference':>12}{'allowed':>10}  counted; reason for what remains")  # noqa: T201
    for stage in stages(pair, steps):
        print(  # noqa: T201
            f"{stage.name:36}{stage.difference:12.1e}{stage.tolerance:10.0e}  {stage.measure}; {stage.reason}"
        )


@torch.no_grad()
def print_samplers(pair: Pair, steps: int) -> None:
    """A row for each sampler and strength."""
    print("sampler     strength  mean |difference|  99th percentile  contrast of the balls")  # noqa: T201
    for sampler in SAMPLERS:
        config = pair.pipeline.scheduler.config
        for strength in (1.0, 0.8):
            asked = request_of(pair, steps, strength)
            reference = leading_euler(config) if sampler == "euler" else type(pair.pipeline.scheduler)(**config)
            expected = pipeline_balls(pair, asked, reference)
            difference = (comfy_balls(pair, asked, sampler) - expected).abs()
            print(  # noqa: T201
                f"{sampler:11} {strength:8.1f} {float(difference.mean()):18.6f} "
                f"{float(difference.flatten().quantile(0.99)):16.6f} {float(expected.std()):22.3f}"
            )


def main() -> None:
    """Both models, stage by stage, then sampler by sampler."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=30, help="of the trajectories (default: 30)")
    steps = parser.parse_args().steps
    for name, pair in (
        ("SDXL's topology, random weights", toy_pair()),
        ("mini model", mini_pair(pack_module("dl_core.backends.mini").load_mini())),
    ):
        print(f"\n{name}, {steps} steps")  # noqa: T201
        print_stages(pair, steps)
        print()  # noqa: T201
        print_samplers(pair, steps)


if __name__ == "__main__":
    main()
