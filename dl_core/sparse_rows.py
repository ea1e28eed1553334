"""Matrices of few entries, as rows: what pixels of one picture read of the pixels of another."""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor

__all__ = ["SparseRows"]


@dataclass(frozen=True)
class SparseRows:
    """Rows of a sparse matrix.

    Attributes:
        starts: (n,) where each row begins.
        columns: (entries,) column of each entry.
        values: (entries,).
    """

    starts: Int[Tensor, "n"]
    columns: Int[Tensor, "e"]
    values: Float[Tensor, "e"]

    @classmethod
    def gathered(cls, columns: Int[Tensor, "rows k"], values: Float[Tensor, "rows k"], width: int) -> SparseRows:
        """Rows of as many entries each; zeros are dropped and entries of one column added up.

        Args:
            columns: of the entries, 0 to width - 1.
            values: of the entries.
            width: columns of the matrix.
        """
        count = len(columns)
        row = torch.arange(count)[:, None].expand_as(columns)
        kept = values != 0
        place, merged = (row[kept] * width + columns[kept]).unique(return_inverse=True)
        summed = values.new_zeros(len(place)).index_add_(0, merged, values[kept])
        starts = torch.searchsorted(place, torch.arange(count) * width)
        return cls(starts, place % width, summed)

    def __matmul__(self, dense: Float[Tensor, "k c"]) -> Float[Tensor, "n c"]:
        """Product with a dense matrix; its gradient costs what the product costs, unlike that of torch.sparse."""
        return F.embedding_bag(
            self.columns, dense, self.starts, mode="sum", per_sample_weights=self.values.to(dense.dtype)
        )

    def spread(self, per_row: Float[Tensor, "n"]) -> Float[Tensor, "e"]:
        """A value of each row, at each of its entries."""
        ends = torch.cat((self.starts[1:], self.starts.new_tensor([len(self.columns)])))
        return per_row.repeat_interleave(ends - self.starts)

    def to(self, device: torch.device) -> SparseRows:
        """The same on a device."""
        return SparseRows(self.starts.to(device), self.columns.to(device), self.values.to(device))
