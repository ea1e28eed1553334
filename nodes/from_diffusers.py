"""SDXL's networks as diffusers and transformers hold them, at any width, as ComfyUI's MODEL, CLIP and CONTROL_NET.

ComfyUI has the same architectures under other names of keys, so its own classes are built at the networks' widths and
given the weights renamed. From there on nothing knows where they came from.

Import this module late: what it converts comes from diffusers, which takes seconds to import.
"""

from __future__ import annotations

from typing import Any, Final

import comfy.cldm.cldm
import comfy.controlnet
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

from ..dl_core.errors import ModelError

__all__ = ["clip_of", "control_net_of", "load_weights", "model_of"]

Weights = dict[str, torch.Tensor]

_PREDICTIONS: Final = {
    "epsilon": comfy.model_base.ModelType.EPS,
    "v_prediction": comfy.model_base.ModelType.V_PREDICTION,
}


def _blocks(config: Any) -> dict[str, Any]:
    """A diffusers UNet's or ControlNet's blocks in ComfyUI's terms."""
    width, levels, layers = config.block_out_channels[0], len(config.block_out_channels), config.layers_per_block
    depths = config.transformer_layers_per_block
    depths = [depths] * levels if isinstance(depths, int) else depths
    by_level = [depth * ("CrossAttn" in name) for depth, name in zip(depths, config.down_block_types, strict=True)]
    return {
        "image_size": 32,
        "in_channels": config.in_channels,
        "model_channels": width,
        "channel_mult": [channels // width for channels in config.block_out_channels],
        "num_res_blocks": [layers] * levels,
        "transformer_depth": [depth for depth in by_level for _ in range(layers)],
        "transformer_depth_middle": depths[-1],
        "context_dim": config.cross_attention_dim,
        "num_head_channels": 64,
        "num_classes": "sequential",
        "adm_in_channels": config.projection_class_embeddings_input_dim,
        "use_spatial_transformer": True,
        "use_linear_in_transformer": True,
        "use_temporal_attention": False,
        "legacy": False,
    }


def _up_depths(blocks: dict[str, Any]) -> list[int]:
    """Transformer blocks of each block on the way up; a level has one more than on the way down.

    ComfyUI lists them from the outermost level inwards.
    """
    layers = blocks["num_res_blocks"][0]
    return [depth for depth in blocks["transformer_depth"][::layers] for _ in range(layers + 1)]


def _rename(weights: Weights, names: dict[str, str], source: str) -> Weights:
    """The weights under their new names.

    Raises:
        ModelError: a weight without a new name; `source` says of which network.
    """
    wanted = {old: new for old, new in names.items() if old in weights}
    unknown = sorted(weights.keys() - wanted.keys())
    if unknown:
        raise ModelError(source, f"has weights ComfyUI has no place for, such as {unknown[0]}")
    return {new: weights[old] for old, new in wanted.items()}


def load_weights(module: torch.nn.Module, weights: Weights, source: str) -> None:
    """Load weights that have ComfyUI's names.

    Raises:
        ModelError: weights of another architecture; `source` says of which network.
    """
    try:
        module.load_state_dict(weights)
    except RuntimeError as error:
        raise ModelError(source, f"does not fit ComfyUI's classes ({error})") from error


def model_of(unet: Any, schedule: dict[str, Any], latents: type, source: str = "unet") -> Any:
    """ComfyUI's MODEL of a UNet of SDXL's kind.

    Args:
        unet: diffusers' UNet2DConditionModel.
        schedule: num_train_timesteps, beta_start, beta_end (square roots evenly spaced) and prediction_type.
        latents: ComfyUI's latent format.
        source: names the network in errors.

    Raises:
        ModelError: weights that do not fit.
    """
    blocks = _blocks(unet.config)

    class Sized(comfy.supported_models.SDXL):  # type: ignore[misc]
        """SDXL as ComfyUI knows it, at this network's widths."""

        latent_format = latents
        sampling_settings = {  # noqa: RUF012  the base class copies it
            "beta_schedule": "linear",
            "linear_start": schedule["beta_start"],
            "linear_end": schedule["beta_end"],
            "timesteps": schedule["num_train_timesteps"],
        }
        unet_config = blocks | {
            "out_channels": unet.config.out_channels,
            "transformer_depth_output": _up_depths(blocks),
        }

        def model_type(self, state_dict: Weights, prefix: str = "") -> Any:
            """What the network predicts, as its schedule says."""
            return _PREDICTIONS[schedule["prediction_type"]]

    config = Sized(Sized.unet_config)
    # Full precision: half would change what a network trained in single precision gives.
    config.set_inference_dtype(torch.float32, None)
    offload = comfy.model_management.unet_offload_device()
    model = config.get_model({}, device=offload)
    weights = _rename(unet.state_dict(), comfy.utils.unet_to_diffusers(config.unet_config), source)
    load_weights(model.diffusion_model, weights, source)
    return comfy.model_patcher.ModelPatcher(
        model.eval(), load_device=comfy.model_management.get_torch_device(), offload_device=offload
    )


def _controlnet_names(weights: Weights, blocks: dict[str, Any]) -> dict[str, str]:
    """diffusers' name -> ComfyUI's name, for a ControlNet with a convolutional hint encoder."""
    names: dict[str, str] = comfy.utils.unet_to_diffusers(blocks | {"transformer_depth_output": _up_depths(blocks)})
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


def control_net_of(controlnet: Any, source: str = "controlnet") -> Any:
    """ComfyUI's CONTROL_NET of a ControlNet of SDXL's kind.

    Raises:
        ModelError: weights that do not fit.
    """
    weights, blocks = controlnet.state_dict(), _blocks(controlnet.config)
    network = comfy.cldm.cldm.ControlNet(
        **blocks,
        hint_channels=controlnet.config.conditioning_channels,
        dtype=torch.float32,
        device=comfy.model_management.unet_offload_device(),
        operations=comfy.ops.disable_weight_init,
    )
    load_weights(network, _rename(weights, _controlnet_names(weights, blocks), source), source)
    return comfy.controlnet.ControlNet(
        network.eval(), load_device=comfy.model_management.get_torch_device(), extra_conds=["y"]
    )


_TEXT_SIZES: Final = (
    "vocab_size", "hidden_size", "intermediate_size", "num_hidden_layers", "num_attention_heads",
    "max_position_embeddings", "eos_token_id", "hidden_act",
)  # fmt: skip


def clip_of(text_encoder: Any, text_encoder_2: Any, source: str = "text encoders") -> Any:
    """ComfyUI's CLIP of SDXL's two text encoders, behind ComfyUI's own CLIP tokenizers.

    Raises:
        ModelError: weights that do not fit.
    """
    target = comfy.supported_models_base.ClipTarget(comfy.sdxl_clip.SDXLTokenizer, comfy.sdxl_clip.SDXLClipModel)
    encoders = {"clip_l": text_encoder, "clip_g": text_encoder_2}
    options: dict[str, Any] = {
        f"{name}_model_config": {key: getattr(encoder.config, key) for key in _TEXT_SIZES}
        for name, encoder in encoders.items()
    }
    clip = comfy.sd.CLIP(target, model_options=options | {"dtype": torch.float32})
    for name, encoder in encoders.items():
        load_weights(getattr(clip.cond_stage_model, name).transformer, _text_weights(encoder), f"{source}, {name}")
    return clip


def _text_weights(encoder: Any) -> Weights:
    """Weights of a CLIP text encoder under the hub's names, with a projection (identity if it has none)."""
    weights: Weights = {}
    for name, tensor in encoder.state_dict().items():
        prefixed = name.startswith(("text_model.", "text_projection."))
        weights[name if prefixed else f"text_model.{name}"] = tensor
    weights.pop("text_model.embeddings.position_ids", None)
    weights.setdefault("text_projection.weight", torch.eye(encoder.config.hidden_size))
    return weights
