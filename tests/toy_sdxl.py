"""SDXL with random weights at a tenth of its width: every block, layer and transformer of the real one, twice.

Once as the networks of diffusers' StableDiffusionXLControlNetInpaintPipeline, once as ComfyUI's MODEL, CLIP, VAE and
CONTROL_NET. Kept from SDXL: three levels of two residual blocks with 0, 2 and 10 transformers, 64 channels a head,
12 and 32 text layers read one before the last, an autoencoder of four levels with attention in the middle, epsilon.
"""

from __future__ import annotations

from typing import Any, Final

import torch
from comfy_host import pack_module

TOKENS, POOLED = 32 + 64, 64
BLOCKS: Final[dict[str, Any]] = {
    "in_channels": 4,
    "down_block_types": ("DownBlock2D", "CrossAttnDownBlock2D", "CrossAttnDownBlock2D"),
    "block_out_channels": (64, 128, 256),
    "layers_per_block": 2,
    "transformer_layers_per_block": (1, 2, 10),
    "attention_head_dim": (1, 2, 4),
    "cross_attention_dim": TOKENS,
    "use_linear_projection": True,
    "addition_embed_type": "text_time",
    "addition_time_embed_dim": 256,
    "projection_class_embeddings_input_dim": POOLED + 6 * 256,
}
AUTOENCODER: Final[dict[str, Any]] = {
    "down_block_types": ("DownEncoderBlock2D",) * 4,
    "up_block_types": ("UpDecoderBlock2D",) * 4,
    "block_out_channels": (32, 64, 128, 128),
    "layers_per_block": 2,
    "latent_channels": 4,
    "scaling_factor": 0.13025,
}
SCHEDULE: Final[dict[str, Any]] = {
    "num_train_timesteps": 1000,
    "beta_schedule": "scaled_linear",
    "beta_start": 0.00085,
    "beta_end": 0.012,
    "prediction_type": "epsilon",
}


def _text(hidden: int, layers: int, activation: str) -> Any:
    from transformers import CLIPTextConfig

    return CLIPTextConfig(
        vocab_size=49408,
        hidden_size=hidden,
        intermediate_size=4 * hidden,
        num_hidden_layers=layers,
        num_attention_heads=hidden // 16,
        projection_dim=hidden,
        eos_token_id=49407,
        hidden_act=activation,
    )


def build_pipeline() -> Any:
    """The networks in diffusers' pipeline, the ControlNet awake, the autoencoder's posterior narrow.

    A narrow posterior makes its sample, which diffusers draws, its mode, which ComfyUI takes.
    """
    from diffusers import (
        AutoencoderKL,
        ControlNetModel,
        StableDiffusionXLControlNetInpaintPipeline,
        UNet2DConditionModel,
        UniPCMultistepScheduler,
    )
    from transformers import CLIPTextModel, CLIPTextModelWithProjection, CLIPTokenizer

    tokenizers = pack_module("dl_core.backends.mini").MINI_FOLDER / "tokenizer"
    with torch.random.fork_rng():
        torch.manual_seed(0)
        unet = UNet2DConditionModel(
            **BLOCKS,
            sample_size=128,
            out_channels=4,
            up_block_types=("CrossAttnUpBlock2D", "CrossAttnUpBlock2D", "UpBlock2D"),
        )
        controlnet = ControlNetModel(**BLOCKS)
        vae = AutoencoderKL(**AUTOENCODER)
        encoder = CLIPTextModel(_text(32, 12, "quick_gelu"))
        encoder_2 = CLIPTextModelWithProjection(_text(64, 32, "gelu"))
        with torch.no_grad():
            for parameter in controlnet.parameters():
                if not parameter.any():
                    parameter.normal_(std=0.02)
            vae.quant_conv.weight[4:] = 0
            vae.quant_conv.bias[4:] = -30
    return StableDiffusionXLControlNetInpaintPipeline(
        vae=vae.eval(),
        text_encoder=encoder.eval(),
        text_encoder_2=encoder_2.eval(),
        tokenizer=CLIPTokenizer.from_pretrained(tokenizers),
        tokenizer_2=CLIPTokenizer.from_pretrained(tokenizers, pad_token="!"),
        unet=unet.eval(),
        controlnet=controlnet.eval(),
        scheduler=UniPCMultistepScheduler(**SCHEDULE, timestep_spacing="leading", steps_offset=1),
    )


def as_comfy_vae(vae: Any) -> Any:
    """ComfyUI's VAE of a diffusers AutoencoderKL."""
    import comfy.diffusers_convert
    import comfy.sd

    sizes = {
        "double_z": True,
        "z_channels": 4,
        "resolution": 256,
        "in_channels": 3,
        "out_ch": 3,
        "ch": AUTOENCODER["block_out_channels"][0],
        "ch_mult": [width // AUTOENCODER["block_out_channels"][0] for width in AUTOENCODER["block_out_channels"]],
        "num_res_blocks": 2,
        "attn_resolutions": [],
        "dropout": 0.0,
    }
    weights = comfy.diffusers_convert.convert_vae_state_dict(dict(vae.state_dict()))
    return comfy.sd.VAE(sd=weights, config={"params": {"ddconfig": sizes, "embed_dim": 4}}, dtype=torch.float32)


def comfy_networks(pipeline: Any) -> dict[str, Any]:
    """The same networks by the sockets of ComfyUI's nodes."""
    import comfy.latent_formats

    convert = pack_module("nodes.from_diffusers")
    return {
        "model": convert.model_of(pipeline.unet, SCHEDULE, comfy.latent_formats.SDXL),
        "clip": convert.clip_of(pipeline.text_encoder, pipeline.text_encoder_2),
        "vae": as_comfy_vae(pipeline.vae),
        "control_net": convert.control_net_of(pipeline.controlnet),
    }
