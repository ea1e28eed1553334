"""The embedded mini model as ComfyUI's MODEL, CLIP, VAE and CONTROL_NET.

The mini model lives in diffusers and transformers modules (`dl_core.backends.mini`). ComfyUI has the same
architectures under other names of keys, so its own classes are built at the mini model's widths and given the weights
renamed. From there on nothing knows the difference between it and SDXL.

Import this module late: it brings in diffusers, which takes seconds and nothing else in the pack needs.
"""

from __future__ import annotations

from typing import Any, Final

import comfy.cldm.cldm
import comfy.controlnet
import comfy.latent_formats
import comfy.model_base
import comfy.model_management
import comfy.model_patcher
import comfy.ops
import comfy.sd
import comfy.sdxl_clip
import comfy.supported_models
import comfy.supported_models_base
import comfy.utils
import torch

from ..dl_core.backends.mini import CONTROLNET_CONFIG, SCHEDULER_CONFIG, TEXT_CONFIG, UNET_CONFIG, MiniModel
from ..dl_core.errors import ModelError
from .lora import with_lora

__all__ = ["to_clip", "to_controlnet", "to_model", "to_vae"]

Weights = dict[str, torch.Tensor]

_WIDTH: Final[int] = UNET_CONFIG["block_out_channels"][0]
_LEVELS: Final = len(UNET_CONFIG["block_out_channels"])

_COMFY_BLOCKS: Final[dict[str, Any]] = {
    "image_size": 32,
    "in_channels": UNET_CONFIG["in_channels"],
    "model_channels": _WIDTH,
    "channel_mult": [width // _WIDTH for width in UNET_CONFIG["block_out_channels"]],
    "num_res_blocks": [UNET_CONFIG["layers_per_block"]] * _LEVELS,
    "transformer_depth": [int("CrossAttn" in name) for name in UNET_CONFIG["down_block_types"]],
    "transformer_depth_middle": 1,
    "context_dim": UNET_CONFIG["cross_attention_dim"],
    "num_head_channels": 64,
    "num_classes": "sequential",
    "adm_in_channels": UNET_CONFIG["projection_class_embeddings_input_dim"],
    "use_spatial_transformer": True,
    "use_linear_in_transformer": True,
    "use_temporal_attention": False,
    "legacy": False,
}
"""The mini model's blocks in ComfyUI's terms."""

_UP_DEPTHS: Final = [depth for depth in _COMFY_BLOCKS["transformer_depth"] for _ in range(2)]
"""An up level has one block more than a down level, and ComfyUI lists them from the outermost inwards."""


_PREDICTIONS: Final = {
    "epsilon": comfy.model_base.ModelType.EPS,
    "v_prediction": comfy.model_base.ModelType.V_PREDICTION,
}


class _MiniLatents(comfy.latent_formats.LatentFormat):  # type: ignore[misc]
    """Four channels, used as the autoencoder gives them."""

    scale_factor = 1.0


class _MiniSDXL(comfy.supported_models.SDXL):  # type: ignore[misc]
    """SDXL as ComfyUI knows it, at the mini model's widths."""

    latent_format = _MiniLatents
    sampling_settings = {  # noqa: RUF012  the base class copies it
        "beta_schedule": "linear",
        "linear_start": SCHEDULER_CONFIG["beta_start"],
        "linear_end": SCHEDULER_CONFIG["beta_end"],
        "timesteps": SCHEDULER_CONFIG["num_train_timesteps"],
    }
    unet_config = _COMFY_BLOCKS | {"out_channels": UNET_CONFIG["out_channels"], "transformer_depth_output": _UP_DEPTHS}

    def model_type(self, state_dict: Weights, prefix: str = "") -> Any:
        """What the network predicts, as its schedule says."""
        return _PREDICTIONS[SCHEDULER_CONFIG["prediction_type"]]


def _rename(weights: Weights, names: dict[str, str], source: str) -> Weights:
    """The weights under their new names.

    Raises:
        ModelError: a weight without a new name, or a name without a weight; `source` says of which network.
    """
    wanted = {old: new for old, new in names.items() if old in weights}
    unknown = sorted(weights.keys() - wanted.keys())
    if unknown:
        raise ModelError(f"mini model's {source}", f"has weights ComfyUI has no place for, such as {unknown[0]}")
    return {new: weights[old] for old, new in wanted.items()}


def _load(module: torch.nn.Module, weights: Weights, source: str) -> None:
    try:
        module.load_state_dict(weights)
    except RuntimeError as error:
        raise ModelError(f"mini model's {source}", f"does not fit ComfyUI's classes ({error})") from error


def to_model(mini: MiniModel, lora_scale: float) -> Any:
    """ComfyUI's MODEL of the mini UNet, with its exposure LoRA, where it has one, at a scale (0 leaves it out).

    Raises:
        ModelError: weights that do not fit.
    """
    config = _MiniSDXL(_MiniSDXL.unet_config)
    # It is small: full precision everywhere costs nothing and spares a model that was trained in it.
    config.set_inference_dtype(torch.float32, None)
    offload = comfy.model_management.unet_offload_device()
    model = config.get_model({}, device=offload)
    weights = _rename(mini.unet.state_dict(), comfy.utils.unet_to_diffusers(config.unet_config), "unet")
    _load(model.diffusion_model, weights, "unet")
    patcher = comfy.model_patcher.ModelPatcher(
        model.eval(), load_device=comfy.model_management.get_torch_device(), offload_device=offload
    )
    if lora_scale == 0 or mini.lora is None:
        return patcher
    return with_lora(patcher, mini.lora, lora_scale, "mini model's exposure LoRA")


def _controlnet_names(weights: Weights, config: dict[str, Any]) -> dict[str, str]:
    """diffusers' name -> ComfyUI's name, for a ControlNet with a convolutional hint encoder."""
    names: dict[str, str] = comfy.utils.unet_to_diffusers(config | {"transformer_depth_output": [0] * 2 * _LEVELS})
    zero_convolutions = len({name.split(".")[1] for name in weights if name.startswith("controlnet_down_blocks.")})
    hint_blocks = len({name.split(".")[2] for name in weights if ".blocks." in name and "cond_embedding" in name})
    hint = ["conv_in", *(f"blocks.{i}" for i in range(hint_blocks)), "conv_out"]
    for kind in ("weight", "bias"):
        names[f"controlnet_mid_block.{kind}"] = f"middle_block_out.0.{kind}"
        names |= {f"controlnet_down_blocks.{i}.{kind}": f"zero_convs.{i}.0.{kind}" for i in range(zero_convolutions)}
        # An activation stands between two convolutions of the hint encoder, hence every second index.
        names |= {
            f"controlnet_cond_embedding.{layer}.{kind}": f"input_hint_block.{2 * i}.{kind}"
            for i, layer in enumerate(hint)
        }
    return names


def to_controlnet(mini: MiniModel) -> Any:
    """ComfyUI's CONTROL_NET of the mini depth ControlNet.

    Raises:
        ModelError: weights that do not fit.
    """
    weights = mini.controlnet.state_dict()
    network = comfy.cldm.cldm.ControlNet(
        **_COMFY_BLOCKS,
        hint_channels=CONTROLNET_CONFIG.get("conditioning_channels", 3),
        dtype=torch.float32,
        device=comfy.model_management.unet_offload_device(),
        operations=comfy.ops.disable_weight_init,
    )
    _load(network, _rename(weights, _controlnet_names(weights, _COMFY_BLOCKS), "controlnet"), "controlnet")
    return comfy.controlnet.ControlNet(
        network.eval(), load_device=comfy.model_management.get_torch_device(), extra_conds=["y"]
    )


def to_vae(mini: MiniModel) -> Any:
    """ComfyUI's VAE of the mini autoencoder, which has TAESD's shape and no scale or shift of its latents.

    Raises:
        ModelError: weights that do not fit.
    """
    weights = {"vae_scale": torch.tensor(1.0), "vae_shift": torch.tensor(0.0)}
    for name, tensor in mini.vae.state_dict().items():
        half, _, index, rest = name.split(".", 3)
        # ComfyUI's decoder counts the clamp of its input as a layer, diffusers' does not.
        place = int(index) + (half == "decoder")
        weights[f"taesd_{half}.{place}.{rest}"] = tensor
    vae = comfy.sd.VAE(sd=weights, dtype=torch.float32)
    _load(vae.first_stage_model, weights, "vae")
    return vae


def to_clip(mini: MiniModel) -> Any:
    """ComfyUI's CLIP of the two mini text encoders, behind ComfyUI's own CLIP tokenizers.

    Raises:
        ModelError: weights that do not fit.
    """
    widths = {key: value for key, value in TEXT_CONFIG.items() if key != "projection_dim"}
    target = comfy.supported_models_base.ClipTarget(comfy.sdxl_clip.SDXLTokenizer, comfy.sdxl_clip.SDXLClipModel)
    options = {"clip_l_model_config": widths, "clip_g_model_config": widths, "dtype": torch.float32}
    clip = comfy.sd.CLIP(target, model_options=options)
    encoders = {"clip_l": mini.text_encoder, "clip_g": mini.text_encoder_2}
    for name, encoder in encoders.items():
        _load(getattr(clip.cond_stage_model, name).transformer, _text_weights(encoder), name)
    return clip


def _text_weights(encoder: torch.nn.Module) -> Weights:
    """Weights of a CLIP text encoder under the hub's names, with a projection (identity if it has none)."""
    weights: Weights = {}
    for name, tensor in encoder.state_dict().items():
        prefixed = name.startswith(("text_model.", "text_projection."))
        weights[name if prefixed else f"text_model.{name}"] = tensor
    weights.pop("text_model.embeddings.position_ids", None)
    weights.setdefault("text_projection.weight", torch.eye(TEXT_CONFIG["hidden_size"]))
    return weights
