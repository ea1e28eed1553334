"""Whether what a graph connects is of SDXL's architecture, said by socket.

Relied on of ComfyUI: `comfy.model_base.SDXL`, a model's `model_config` and `latent_format`, a VAE's `latent_channels`,
`comfy.controlnet.ControlBase` and a ControlNet's `control_model`.
"""

from __future__ import annotations

from typing import Any

import comfy.controlnet
import comfy.model_base

from ..dl_core.errors import ModelError

__all__ = ["require_conditioning", "require_control_net", "require_sdxl", "require_vae"]


def require_sdxl(model: Any) -> Any:
    """The network inside a MODEL of SDXL's architecture that takes plain latents.

    Raises:
        ModelError: another architecture, or one of SDXL's kind that sees more than noisy latents (inpainting models,
            InstructPix2Pix).
    """
    inner = getattr(model, "model", None)
    if not isinstance(inner, comfy.model_base.SDXL):
        found = type(getattr(inner, "model_config", inner)).__name__
        raise ModelError("socket model", f"holds {found}; a model of SDXL's architecture is accepted")
    channels, latents = inner.model_config.unet_config["in_channels"], inner.latent_format.latent_channels
    if channels != latents:
        raise ModelError(
            "socket model",
            f"holds an SDXL of {channels} input channels, made for editing or inpainting; "
            f"a base model of {latents} is accepted",
        )
    return inner


def require_vae(vae: Any, model: Any) -> None:
    """Check that a VAE makes the latents that a MODEL of SDXL's architecture takes.

    Raises:
        ModelError: latents of another number of channels.
    """
    channels, wanted = getattr(vae, "latent_channels", None), model.model.latent_format.latent_channels
    if channels != wanted:
        raise ModelError("socket vae", f"holds a VAE of {channels} latent channels; the model's has {wanted}")


def require_control_net(control_net: Any) -> None:
    """Check that a CONTROL_NET takes SDXL's conditioning. What it was trained to see, its weights do not tell.

    Raises:
        ModelError: no ControlNet, or one of another architecture.
    """
    if not isinstance(control_net, comfy.controlnet.ControlBase):
        raise ModelError("socket control_net", f"holds {type(control_net).__name__}; a ControlNet is accepted")
    network = getattr(control_net, "control_model", None)
    if network is not None and getattr(network, "num_classes", "unknown") is None:
        raise ModelError("socket control_net", "holds a ControlNet of another architecture; one for SDXL is accepted")


def require_conditioning(socket: str, conditioning: Any, model: Any) -> None:
    """Check that a CONDITIONING comes from the text encoders of a MODEL of SDXL's architecture.

    Raises:
        ModelError: none, or embeddings of another width or without a pooled one.
    """
    wanted = model.model.model_config.unet_config["context_dim"]
    if not conditioning:
        raise ModelError(f"socket {socket}", "holds no conditioning")
    for embedding, options in conditioning:
        if embedding.shape[-1] != wanted or options.get("pooled_output") is None:
            raise ModelError(
                f"socket {socket}",
                f"holds embeddings {embedding.shape[-1]} wide; the model takes {wanted} with a pooled output: "
                "encode the prompt with the CLIP that belongs to the model",
            )
