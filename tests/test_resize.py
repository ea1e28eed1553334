"""Maps of another size: energy, identity, two steps as one, gradients."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from tolerances import assert_close

from dl_core.errors import OptionError
from dl_core.geometry import latlong_energy
from dl_core.resize import resize_latlong


@given(source=st.integers(1, 40), target=st.integers(1, 40), seed=st.integers(0, 99))
def test_resizing_keeps_energy_or_the_mean_at_any_sizes(source: int, target: int, seed: int) -> None:
    latlong = torch.rand(1, source, 2 * source, 3, generator=torch.Generator().manual_seed(seed))
    radiance = resize_latlong(latlong, target)
    # Solid angles of thin polar rows come from differences of float32 cosines in `latlong_energy`.
    torch.testing.assert_close(latlong_energy(radiance), latlong_energy(latlong), rtol=1e-4, atol=0)
    picture = resize_latlong(latlong, target, solid_angle=False)
    assert_close(picture.mean(dim=(1, 2)), latlong.mean(dim=(1, 2)), dtype=torch.float32)
    if source == target:
        assert_close(radiance, latlong)


@given(rows=st.integers(1, 12), factor=st.integers(1, 4), again=st.integers(1, 3))
def test_two_reductions_are_one(rows: int, factor: int, again: int) -> None:
    latlong = torch.rand(1, rows * factor * again, 2 * rows * factor * again, 2)
    assert_close(resize_latlong(resize_latlong(latlong, rows * again), rows), resize_latlong(latlong, rows))


def test_the_gradient_of_the_energy_is_the_solid_angle_whatever_the_size() -> None:
    latlong = torch.rand(1, 24, 48, 1, dtype=torch.float64, requires_grad=True)
    direct, resized = (
        torch.autograd.grad(latlong_energy(light).sum(), latlong)[0] for light in (latlong, resize_latlong(latlong, 9))
    )
    # Shares are kept as float32.
    torch.testing.assert_close(resized, direct, rtol=1e-5, atol=0)


@pytest.mark.parametrize(("shape", "height", "name"), [((1, 4, 4, 3), 2, "latlong"), ((1, 4, 8, 3), 0, "height")])
def test_wrong_options_are_named(shape: tuple[int, ...], height: int, name: str) -> None:
    with pytest.raises(OptionError, match=name):
        resize_latlong(torch.ones(shape), height)
