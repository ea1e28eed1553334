"""SDXL and a depth ControlNet at full size with random weights: what a guided step costs, and the paper's schedule.

`python tests/comfyui/bench_sdxl_size.py [--batches 1,2,4,8,16] [--steps 3] [--canvas 1024] [--dtype float16]`

ComfyPainter's sampling is timed against bare calls of ComfyUI's sampling with the same prompts, control and batch,
alternately, so that a busy machine slows both alike; the autoencoder, which any graph runs, apart. Random weights cost
what trained ones do. On a CPU a small canvas shows the ratio; the seconds mean something on the machine that is to
paint.
"""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import replace
from pathlib import Path
from statistics import median
from typing import Any

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE.parents[1]), str(HERE.parent), str(HERE)]

import torch  # noqa: E402
from bench_overhead import timed_run  # noqa: E402
from comfy_host import pack_module  # noqa: E402


def described(network: str) -> dict[str, Any]:
    """SDXL's description of a network, as the library ships it."""
    folder = pack_module("dl_core.backends.sdxl_files").SDXL_FOLDER
    config: dict[str, Any] = json.loads((folder / network / "config.json").read_text())
    return config


@torch.no_grad()
def randomize(module: torch.nn.Module) -> torch.nn.Module:
    """Values that keep activations finite: normal weights of 0.02, norms of one, no biases."""
    for name, parameter in module.named_parameters():
        if parameter.ndim > 1:
            parameter.normal_(std=0.02)
        else:
            parameter.fill_(float(name.endswith("weight")))
    return module.eval()


def networks(dtype: torch.dtype) -> dict[str, Any]:
    """MODEL, CONTROL_NET, VAE and two conditionings of SDXL's sizes."""
    import comfy.cldm.cldm
    import comfy.controlnet
    import comfy.diffusers_convert
    import comfy.model_management
    import comfy.model_patcher
    import comfy.ops
    import comfy.sd
    from comfy.model_detection import model_config_from_diffusers_unet
    from diffusers import AutoencoderKL, UNet2DConditionModel

    device, offload = comfy.model_management.get_torch_device(), comfy.model_management.unet_offload_device()
    with torch.device("meta"):
        config = model_config_from_diffusers_unet(UNet2DConditionModel.from_config(described("unet")).state_dict())
    config.set_inference_dtype(dtype, None)
    model = config.get_model({}, device=offload)
    randomize(model.diffusion_model)
    blocks = {name: value for name, value in config.unet_config.items() if name not in ("out_channels", "dtype")}
    blocks.pop("transformer_depth_output")
    control = comfy.cldm.cldm.ControlNet(
        **blocks, hint_channels=3, dtype=dtype, device=offload, operations=comfy.ops.disable_weight_init
    )
    vae = AutoencoderKL.from_config(described("vae"))
    weights = comfy.diffusers_convert.convert_vae_state_dict(dict(vae.state_dict()))
    prompt = [[torch.randn(1, 77, 2048), {"pooled_output": torch.randn(1, 1280)}]]
    return {
        "model": comfy.model_patcher.ModelPatcher(model.eval(), load_device=device, offload_device=offload),
        "control_net": comfy.controlnet.ControlNet(
            randomize(control), load_device=device, extra_conds=["y"], manual_cast_dtype=None
        ),
        "vae": comfy.sd.VAE(sd=weights),
        "positive": prompt,
        "negative": [[torch.randn(1, 77, 2048), {"pooled_output": torch.randn(1, 1280)}]],
    }


class Nothing:
    """An observer that is told and does nothing."""

    def evaluated(self, count: int) -> None:
        """Ignore it."""

    def painted(self, ev: float, round_index: int, balls: Any) -> None:
        """Ignore it."""


def bare(sockets: dict[str, Any], request: Any, count: int) -> None:
    """The same balls' sampling without the node pack: no ball masks, counting or preparation of schedules."""
    import comfy.sample
    import comfy.samplers

    from nodes import ControlNetApplyAdvanced

    positive, negative = ControlNetApplyAdvanced().apply_controlnet(
        sockets["positive"], sockets["negative"], sockets["control_net"], request.depth, 0.5, 0.0, 1.0
    )
    side = request.ball.canvas // 8
    latent = torch.zeros(count, 4, side, side)
    sigmas = comfy.samplers.KSampler(sockets["model"], request.steps, "cpu", "uni_pc", "simple").sigmas
    comfy.sample.sample_custom(
        sockets["model"],
        torch.randn(latent.shape),
        5.0,
        comfy.samplers.sampler_object("uni_pc"),
        sigmas,
        positive,
        negative,
        latent,
        disable_pbar=True,
        seed=0,
    )


def peak_gib() -> float:
    """Most memory held so far: of the GPU, or of the process where there is none."""
    if torch.cuda.is_available():
        return torch.cuda.max_memory_allocated() / 2**30
    import resource

    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20


@torch.inference_mode()
def main() -> None:
    """A row for each batch, then the paper's schedule at the best."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--batches", default="1,2,4,8,16", help="balls at once (default: 1,2,4,8,16)")
    parser.add_argument("--steps", type=int, default=3, help="guided steps timed, two at least (default: 3)")
    parser.add_argument("--repeats", type=int, default=3, help="timings of each way (default: 3)")
    parser.add_argument("--canvas", type=int, default=1024, help="side in pixels (default: 1024)")
    parser.add_argument("--dtype", default="float16" if torch.cuda.is_available() else "bfloat16")
    args = parser.parse_args()
    ball_module, painting, ports = map(pack_module, ("dl_core.ball", "nodes.painter", "dl_core.painter"))
    sockets = networks(getattr(torch, args.dtype))
    ball = ball_module.place_ball(args.canvas, args.canvas // 4)
    canvas = torch.rand(1, args.canvas, args.canvas, 3)
    request = ports.PaintRequest(canvas, ball_module.paint_depth(None, ball), ball, 0.0, (0,), steps=args.steps)
    place = torch.cuda.get_device_name() if torch.cuda.is_available() else "CPU"
    print(f"{place}, {args.dtype}, canvas {args.canvas}, {args.steps} guided steps a timing")  # noqa: T201
    print("batch  s per guided step of a ball  bare sampler  ratio  s of autoencoder a ball  peak GiB")  # noqa: T201
    best = float("inf")
    for count in (int(number) for number in args.batches.split(",")):
        asked = replace(request, seeds=tuple(range(count)))
        ours, theirs, coded = list[float](), list[float](), list[float]()
        for repeat in range(args.repeats + 1):
            painter = painting.ComfyPainter(painting.Networks(**sockets), painting.Guidance(batch_size=count))
            _, sampled, autoencoder = timed_run(lambda painter=painter, asked=asked: painter.paint(asked, Nothing()))
            _, plain, _ = timed_run(lambda asked=asked, count=count: bare(sockets, asked, count))
            if repeat:  # the first loads the weights
                ours.append(sampled / args.steps / count)
                theirs.append(plain / args.steps / count)
                coded.append(autoencoder / count)
        best = min(best, median(ours))
        ratio = median(a / b for a, b in zip(ours, theirs, strict=True))
        print(  # noqa: T201
            f"{count:5d} {median(ours):29.3f} {median(theirs):13.3f} {ratio:6.3f} {median(coded):24.3f} "
            f"{peak_gib():9.2f}",
            flush=True,
        )
    steps = pack_module("dl_core.presets").preset("paper").guided_steps
    print(f"the paper's schedule, {steps} guided steps, from the best row: {steps * best / 60:.1f} minutes")  # noqa: T201


if __name__ == "__main__":
    main()
