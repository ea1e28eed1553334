"""diffusers' own inpainting pipeline on a request: the reference that painters are held against."""

from __future__ import annotations

from typing import Any

import torch
from PIL import Image as PILImage
from torch import Tensor

__all__ = ["pipeline_canvases"]


def _picture(values: Tensor) -> PILImage.Image:
    return PILImage.fromarray((values * 255).round().byte().numpy())


def pipeline_canvases(
    pipeline: Any, scheduler: Any, request: Any, guidance: Any, defaults: Any, mask: Tensor
) -> Tensor:
    """Canvases that the pipeline paints, (n, S, S, 3), one for each seed.

    Args:
        pipeline: StableDiffusionXLControlNetInpaintPipeline.
        scheduler: to paint with instead of its own.
        request: a PaintRequest.
        guidance: embeddings, as DiffusersPainter.guidance_at gives them.
        defaults: scales of guidance and ControlNet.
        mask: (1, 1, s, s) where to paint, at latent size and binary: the pipeline rounds it.
    """
    count, side = len(request.seeds), request.ball.canvas
    pixels = mask[0, 0].repeat_interleave(8, 0).repeat_interleave(8, 1)
    kept, pipeline.scheduler = pipeline.scheduler, scheduler
    pipeline.set_progress_bar_config(disable=True)
    try:
        canvas = pipeline(
            # A picture for each ball: of a single one only the first ball's generator draws a posterior.
            image=[_picture(request.canvas[0])] * count,
            mask_image=[_picture(pixels)] * count,
            control_image=[_picture(request.depth[0])] * count,
            prompt_embeds=guidance.tokens.expand(count, -1, -1),
            pooled_prompt_embeds=guidance.pooled.expand(count, -1),
            negative_prompt_embeds=guidance.negative_tokens.expand(count, -1, -1),
            negative_pooled_prompt_embeds=guidance.negative_pooled.expand(count, -1),
            guidance_scale=defaults.guidance,
            controlnet_conditioning_scale=defaults.control_scale,
            num_inference_steps=request.steps,
            strength=request.strength,
            height=side,
            width=side,
            generator=[torch.Generator().manual_seed(seed) for seed in request.seeds],
            output_type="pt",
        ).images
    finally:
        pipeline.scheduler = kept
    return canvas.permute(0, 2, 3, 1).float()
