"""Balls of ComfyPainter against DiffusersPainter on the mini model: `python tests/comfyui/bench_parity.py`.

Same weights, initial noise, mask and timesteps. Euler shows that the paths agree; UniPC differs by design: ComfyUI's
is of third order (bh1, bh2), diffusers' of second (bh2). Rows with a swap have two random LoRAs, as large as the
weights they act on, that change places at timestep 800.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

sys.path[:0] = [str(Path(__file__).resolve().parents[2]), str(Path(__file__).resolve().parents[1])]

import torch  # noqa: E402
from comfy_host import PHOTO, leading_euler, pack_module  # noqa: E402
from lora_files import RandomLora, attention_layers  # noqa: E402

PAIRS = (("euler", "euler"), ("unipc", "uni_pc"), ("unipc", "uni_pc_bh2"))
SCHEDULES = ((6, 1.0), (10, 0.8), (30, 1.0))
SWAPPED = ((6, 1.0, True), (30, 1.0, True))
SEEDS = (0, 1)


def random_loras(mini: Any) -> dict[str, dict[str, torch.Tensor]]:
    """Two LoRAs on every attention of the UNet, by the names of the diffusers painter's adapters."""
    adapters, names = pack_module("dl_core.backends.diffusers_lora"), pack_module("dl_core.lora_names")
    layers, generator = adapters.lora_shapes(mini.unet), torch.Generator().manual_seed(1)
    return {
        adapter: RandomLora.on(attention_layers(layers), generator, size=1.0).written(
            "ComfyUI", names.comfyui_layers(layers)
        )
        for adapter in (adapters.EXPOSURE, adapters.TURBO)
    }


def main() -> None:
    """Print one row a sampler and schedule."""
    painting, ports = pack_module("nodes.painter"), pack_module("dl_core.painter")
    backend, balls = pack_module("dl_core.backends.diffusers_painter"), pack_module("dl_core.ball")
    backend.SAMPLERS["euler"] = leading_euler
    mini = replace(pack_module("dl_core.backends.mini").load_mini(), lora=None)
    convert, defaults = pack_module("nodes.mini"), mini.defaults
    clip = convert.to_clip(mini)
    positive, negative = (
        clip.encode_from_tokens_scheduled(clip.tokenize(text)) for text in (defaults.prompt, defaults.negative_prompt)
    )
    networks = painting.Networks(
        convert.to_model(mini, 0), positive, negative, convert.to_vae(mini), convert.to_controlnet(mini)
    )
    adapters, swap, loras = pack_module("dl_core.backends.diffusers_lora"), pack_module("dl_core.lora").LoraSwap(), {}
    ball = balls.place_ball(defaults.canvas, defaults.diameter)
    canvas = balls.fit_canvas(pack_module("dl_core.imageio").read_photograph(PHOTO), defaults.canvas)
    depth = balls.paint_depth(None, ball)
    print("steps strength diffusers comfyui    swap  mean |difference|  99th percentile  contrast of the balls")  # noqa: T201
    for steps, strength, swapped in (*((*schedule, False) for schedule in SCHEDULES), *SWAPPED):
        asked = ports.PaintRequest(canvas, depth, ball, 0.0, SEEDS, strength=strength, steps=steps)
        if swapped and not loras:  # last, since adapters stay on a UNet
            loras = random_loras(mini)
            for adapter, weights in loras.items():
                adapters.add_lora(backend.DiffusersPainter.from_mini(mini).pipeline, weights, adapter, adapter)
            model = pack_module("nodes.lora").with_lora_swap(
                networks.model, loras[adapters.TURBO], loras[adapters.EXPOSURE], swap
            )
            networks = replace(networks, model=model)
        for theirs, ours in PAIRS:
            guidance = painting.Guidance(
                cfg=defaults.guidance, sampler=ours, control_strength=defaults.control_scale, batch_size=len(SEEDS)
            )
            reference = backend.DiffusersPainter.from_mini(mini, sampler=theirs, lora_swap=swap if swapped else None)
            expected = reference.paint(asked, ports.SilentObserver()).balls
            with torch.inference_mode():
                found = painting.ComfyPainter(networks, guidance).paint(asked, ports.SilentObserver()).balls
            difference = (found - expected).abs()
            print(  # noqa: T201
                f"{steps:5} {strength:8.1f} {theirs:9} {ours:10} {'yes' if swapped else 'no':4} "
                f"{float(difference.mean()):18.5f} "
                f"{float(difference.flatten().quantile(0.99)):16.5f} {float(expected.std()):22.3f}"
            )


if __name__ == "__main__":
    main()
