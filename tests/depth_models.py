"""Depth models at toy size with random weights, saved as transformers saves them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch

SIDE = 56
"""Pixels of the short side that the toys' processors make of a picture: a multiple of every patch size here."""


def save_dpt(folder: Path) -> Path:
    """A DPT of the kind of the authors' DPT-hybrid."""
    from transformers import DPTConfig, DPTForDepthEstimation

    config = DPTConfig(
        hidden_size=16,
        num_hidden_layers=4,
        num_attention_heads=2,
        intermediate_size=32,
        image_size=SIDE,
        patch_size=8,
        backbone_out_indices=[0, 1, 2, 3],
        neck_hidden_sizes=[16, 16, 16, 16],
        fusion_hidden_size=16,
        is_hybrid=False,
    )
    return _save(folder, DPTForDepthEstimation, config, keep_aspect_ratio=False, ensure_multiple_of=1)


def save_depth_anything(folder: Path, kind: str = "relative") -> Path:
    """A Depth Anything V2, relative or metric."""
    from transformers import DepthAnythingConfig, DepthAnythingForDepthEstimation, Dinov2Config

    backbone = Dinov2Config(
        hidden_size=16,
        num_hidden_layers=4,
        num_attention_heads=2,
        mlp_ratio=2,
        image_size=SIDE,
        patch_size=14,
        out_features=["stage1", "stage2", "stage3", "stage4"],
        reshape_hidden_states=False,
    )
    config = DepthAnythingConfig(
        backbone_config=backbone,
        patch_size=14,
        reassemble_hidden_size=16,
        neck_hidden_sizes=[16, 16, 16, 16],
        fusion_hidden_size=16,
        head_hidden_size=16,
        depth_estimation_type=kind,
        max_depth=20,
    )
    return _save(folder, DepthAnythingForDepthEstimation, config, keep_aspect_ratio=True, ensure_multiple_of=14)


def _save(folder: Path, kind: Any, config: Any, **resizing: Any) -> Path:
    from transformers import DPTImageProcessor

    with torch.random.fork_rng():
        torch.manual_seed(0)
        network = kind(config)
    with torch.no_grad():
        for parameter in network.head.parameters():
            # Untrained heads answer with a constant, or with zeros behind a ReLU.
            parameter.normal_(std=0.3, generator=torch.Generator().manual_seed(parameter.numel()))
        for name, parameter in network.head.named_parameters():
            if name.endswith("bias"):
                parameter.fill_(0.5)
    network.save_pretrained(folder)
    DPTImageProcessor(size={"height": SIDE, "width": SIDE}, **resizing).save_pretrained(folder)
    return folder
