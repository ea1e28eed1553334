"""Sparse rows against the dense matrix they stand for."""

from __future__ import annotations

import torch
from hypothesis import given
from hypothesis import strategies as st

from dl_core.sparse_rows import SparseRows


@given(st.integers(1, 6), st.integers(1, 5), st.integers(1, 7), st.integers(0, 1000))
def test_a_product_is_that_of_the_dense_matrix(rows: int, entries: int, width: int, seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    columns = torch.randint(width, (rows, entries), generator=generator)
    values = torch.randn(rows, entries, generator=generator) * (torch.rand(rows, entries, generator=generator) > 0.3)
    dense = torch.randn(width, 3, generator=generator)
    matrix = torch.zeros(rows, width).scatter_add_(1, columns, values)
    # Sums of at most five products of standard normal numbers, in another order.
    torch.testing.assert_close(SparseRows.gathered(columns, values, width) @ dense, matrix @ dense, rtol=0, atol=1e-5)


def test_a_value_of_each_row_reaches_its_entries() -> None:
    rows = SparseRows.gathered(torch.tensor([[0, 2], [1, 1], [0, 0]]), torch.tensor([[1.0, 2], [3, 4], [0, 0]]), 3)
    assert rows.spread(torch.tensor([10.0, 20, 30])).tolist() == [10, 10, 20]
    assert rows.values.tolist() == [1, 2, 7]
