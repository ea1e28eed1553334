"""Closeness by dtype: the one table tests compare with.

A test that needs another tolerance derives it in a comment beside it.
"""

from __future__ import annotations

from typing import Final

import torch

__all__ = ["TOLERANCES", "assert_close"]

TOLERANCES: Final[dict[torch.dtype, tuple[float, float]]] = {
    # (relative, absolute): a few dozen roundings of the type, for sums of a few thousand terms.
    torch.float16: (2e-3, 1e-3),
    torch.float32: (1e-5, 1e-6),
    torch.float64: (1e-10, 1e-12),
}


def assert_close(actual: torch.Tensor, expected: torch.Tensor | float, *, dtype: torch.dtype | None = None) -> None:
    """Assert closeness at the tolerance of the coarser of the types involved.

    Args:
        actual: what the code under test gives.
        expected: what it should be; a number stands for a tensor full of it.
        dtype: a type the values passed through on their way, such as half floats in a file.
    """
    wanted = torch.as_tensor(expected, dtype=actual.dtype).expand_as(actual)
    relative, absolute = TOLERANCES[dtype or actual.dtype]
    torch.testing.assert_close(actual, wanted, rtol=relative, atol=absolute)
