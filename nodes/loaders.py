"""MiniProbeLoader: the model helpers of the pack."""

from __future__ import annotations

from comfy_api.latest import io

from .sockets import CATEGORY, named_output

__all__ = ["MiniProbeLoader"]


class MiniProbeLoader(io.ComfyNode):  # type: ignore[misc]
    """Loads the embedded mini model."""

    @classmethod
    def define_schema(cls) -> io.Schema:
        """Sockets of the node."""
        return io.Schema(
            node_id="MiniProbeLoader",
            display_name="Mini Probe Loader",
            category=CATEGORY,
            description="Loads the small model that comes with this pack: SDXL's architecture at toy width, made to "
            "see the method work before any download. For estimates to use, load SDXL and a depth ControlNet instead.",
            inputs=[
                io.Float.Input(
                    "lora_scale",
                    default=1.0,
                    min=0.0,
                    max=2.0,
                    step=0.05,
                    tooltip="How strongly the model's exposure LoRA acts, where the pack has one; 0 leaves it out. "
                    "It was trained to act at 1; the paper's is used at 0.75.",
                ),
            ],
            outputs=[
                named_output(io.Model, "model", "The denoiser, with its exposure LoRA."),
                named_output(io.Clip, "clip", "Both text encoders."),
                named_output(io.Vae, "vae", "The autoencoder."),
                named_output(io.ControlNet, "control_net", "The depth ControlNet."),
            ],
        )

    @classmethod
    def execute(cls, lora_scale: float) -> io.NodeOutput:
        """Load the networks and hand them over as ComfyUI's own."""
        # Late, because diffusers takes seconds to import and would slow every start of ComfyUI.
        from ..dl_core.backends.mini import load_mini
        from .mini import to_clip, to_controlnet, to_model, to_vae

        mini = load_mini()
        return io.NodeOutput(to_model(mini, lora_scale), to_clip(mini), to_vae(mini), to_controlnet(mini))
