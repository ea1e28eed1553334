"""TurboLoRASwap: the Turbo LoRA for the first, noisy timesteps of a pass, the exposure LoRA for the rest."""

from __future__ import annotations

from typing import Any, Final

import folder_paths
from comfy_api.latest import io

from ..dl_core.lora import LoraSwap
from .lora import read_lora_file, with_lora_swap
from .sockets import CATEGORY, named_output

__all__ = ["TurboLoRASwap"]

_DEFAULT: Final = LoraSwap()


def _lora_input(name: str, tooltip: str) -> Any:
    return io.Combo.Input(name, options=folder_paths.get_filename_list("loras"), tooltip=tooltip)


def _scale_input(name: str, default: float, tooltip: str) -> Any:
    return io.Float.Input(name, default=default, min=0.0, max=2.0, step=0.05, tooltip=tooltip)


class TurboLoRASwap(io.ComfyNode):  # type: ignore[misc]
    """Two LoRAs that share a sampling pass."""

    @classmethod
    def define_schema(cls) -> io.Schema:
        """Sockets of the node."""
        return io.Schema(
            node_id="TurboLoRASwap",
            display_name="Turbo LoRA Swap",
            category=CATEGORY,
            description="Lets the Turbo LoRA act for the first timesteps of every sampling pass and the exposure LoRA "
            "for the rest, so that one pass an exposure is enough. Nothing is loaded again at the swap.",
            inputs=[
                io.Model.Input("model", tooltip="The denoiser, of SDXL's architecture, without the exposure LoRA."),
                _lora_input("turbo_lora", "The Turbo LoRA, under any trainer's or host's names."),
                _lora_input("exposure_lora", "The exposure LoRA that follows it, under any names."),
                _scale_input("turbo_scale", _DEFAULT.turbo_scale, "How strongly the Turbo LoRA acts. The authors: 1."),
                _scale_input(
                    "exposure_scale", _DEFAULT.exposure_scale, "How strongly the exposure LoRA acts. The paper: 0.75."
                ),
                io.Int.Input(
                    "timestep",
                    default=int(_DEFAULT.timestep),
                    min=0,
                    max=1000,
                    tooltip="The Turbo LoRA acts at this timestep and above: at 800 for 6 of the paper's 30 steps. "
                    "At 0 it acts throughout, at 1000 never.",
                ),
            ],
            outputs=[named_output(io.Model, "model", "The model with both LoRAs, for any sampler.")],
        )

    @classmethod
    def execute(
        cls,
        model: Any,
        turbo_lora: str,
        exposure_lora: str,
        turbo_scale: float,
        exposure_scale: float,
        timestep: int,
    ) -> io.NodeOutput:
        """Read both files and let them take turns."""
        swap = LoraSwap(timestep, turbo_scale, exposure_scale)
        return io.NodeOutput(with_lora_swap(model, read_lora_file(turbo_lora), read_lora_file(exposure_lora), swap))
