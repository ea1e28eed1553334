"""The prompt's embeddings at an exposure value.

Source: DiffusionLight, Sec. 4.2: ξ(ev) = ξ_o + (ev / EV_min) (ξ_d - ξ_o), for token and pooled embeddings alike.
"""

from __future__ import annotations

import torch
from torch import Tensor

__all__ = ["embedding_at"]


def embedding_at(original: Tensor, dark: Tensor, evs: Tensor, ev_min: float) -> Tensor:
    """Embeddings between the prompt's and the dark prompt's, one an exposure.

    Args:
        original: (1, ...) embedding at EV 0, of tokens or pooled.
        dark: (1, ...) embedding at `ev_min`.
        evs: (B,) exposure values.
        ev_min: EV at which the dark prompt stands alone, below 0.

    Returns:
        (B, ...), each made of the two originals, not of one another.
    """
    shares = (evs / ev_min).to(original).view(-1, *(1,) * (original.ndim - 1))
    return torch.lerp(original, dark, shares)
