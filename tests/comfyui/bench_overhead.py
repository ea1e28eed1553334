"""How much time the nodes add to the bare sampler calls they make: `python tests/comfyui/bench_overhead.py`.

A run of IterativeMedian is timed against the sum of its calls of ComfyUI's sampling in the same run, so that a busy
machine slows both alike. What is left is the nodes' own: conditioning, noise, decoding, median, report.
"""

from __future__ import annotations

import sys
from pathlib import Path
from statistics import median, quantiles
from time import perf_counter
from typing import Any

sys.path[:0] = [str(Path(__file__).resolve().parents[2]), str(Path(__file__).resolve().parents[1])]

import torch  # noqa: E402
from comfy_host import pack_module  # noqa: E402

REPEATS = 5


class Stopwatch:
    """Adds up the seconds spent in a function."""

    def __init__(self, function: Any) -> None:
        self.seconds = 0.0
        self._function = function

    def __call__(self, *arguments: Any, **options: Any) -> Any:
        started = perf_counter()
        try:
            return self._function(*arguments, **options)
        finally:
            self.seconds += perf_counter() - started


def timed_run(run: Any) -> tuple[float, float, float]:
    """Seconds of a run, of them in sampling, of them in the autoencoder."""
    import comfy.sample
    import comfy.sd

    sample, decode, encode = Stopwatch(comfy.sample.sample_custom), comfy.sd.VAE.decode, comfy.sd.VAE.encode
    coder = Stopwatch(lambda method, *arguments: method(*arguments))
    comfy.sample.sample_custom = sample
    comfy.sd.VAE.decode = lambda self, samples: coder(decode, self, samples)
    comfy.sd.VAE.encode = lambda self, pixels: coder(encode, self, pixels)
    try:
        started = perf_counter()
        run()
        return perf_counter() - started, sample.seconds, coder.seconds
    finally:
        comfy.sample.sample_custom, comfy.sd.VAE.decode, comfy.sd.VAE.encode = sample._function, decode, encode


def main() -> None:
    """Print the overhead of the preset draft on the mini model, one exposure."""
    nodes = {kind.GET_SCHEMA().node_id: kind for kind in pack_module("nodes").NODES}
    mini_model = pack_module("dl_core.backends.mini").MiniModel
    torch.manual_seed(0)
    mini = mini_model.untrained()
    convert, defaults = pack_module("nodes.mini"), mini.defaults
    clip, model = convert.to_clip(mini), convert.to_model(mini, 0)
    photo = torch.rand(1, 400, 600, 3)
    sizes = {"canvas": defaults.canvas, "diameter": defaults.diameter, "x": -1, "y": -1, "dilation": -1}
    canvas, depth, mask, ball = nodes["DepthBallMask"].execute(photo, **sizes).args
    positive, negative = (
        clip.encode_from_tokens_scheduled(clip.tokenize(text)) for text in (defaults.prompt, defaults.negative_prompt)
    )
    sockets = {"model": model, "positive": positive, "negative": negative, "vae": convert.to_vae(mini)}
    sockets |= {"control_net": convert.to_controlnet(mini), "image": canvas, "depth": depth, "mask": mask, "ball": ball}
    schedule = {"preset": "draft", "balls": 3, "rounds": 1, "strength": 0.8, "final": False, "steps": 6, "seed": 0}
    sampling = {"cfg": defaults.guidance, "sampler": "uni_pc", "scheduler": "leading (paper)"}
    sampling |= {"control_strength": defaults.control_scale, "batch_size": 4}

    finished = pack_module("nodes.painting").FINISHED

    def run() -> None:
        finished.clear()
        with torch.inference_mode():
            nodes["IterativeMedian"].execute(**sockets, **schedule, **sampling)

    run()
    rows = [timed_run(run) for _ in range(REPEATS)]
    added = [100 * (total - sampled - coded) / sampled for total, sampled, coded in rows]
    coded = [100 * coded / sampled for _, sampled, coded in rows]
    low, _, high = quantiles(added, n=4)
    print(f"sampling: median {median(row[1] for row in rows):.2f} s of {REPEATS} runs")  # noqa: T201
    print(f"nodes add: median {median(added):.2f}% (quartiles {low:.2f} to {high:.2f}%)")  # noqa: T201
    print(f"encoding and decoding, which any graph does: median {median(coded):.1f}%")  # noqa: T201


if __name__ == "__main__":
    main()
