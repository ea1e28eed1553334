from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from tolerances import assert_close

from dl_core.errors import OptionError
from dl_core.microfacet import Surface, directional_albedo, fresnel_dielectric, fresnel_schlick, mean_albedo

MATTE = Surface(base=0.8, metallic=True, roughness=0.3271)
COATED = Surface(base=0.8, metallic=False, roughness=0.364)
COSINES = torch.tensor([0.1, 0.35, 0.7, 0.99])


def integral_of_gloss(surface: Surface, cos_view: float, count: int = 500) -> float:
    """∫ f(v, l) (n·l) dω by midpoints in n·l and the azimuth: dω = d(n·l) dφ, another quadrature than the library's."""
    steps = (torch.arange(count) + 0.5) / count
    cos_light = steps[:, None].expand(-1, count).reshape(1, -1)
    azimuth = (steps * math.pi)[None, :].expand(count, -1).reshape(1, -1)
    sines = torch.sqrt(1 - cos_light**2) * math.sqrt(1 - cos_view**2)
    between = sines * torch.cos(azimuth) + cos_light * cos_view
    return float(surface.gloss(torch.tensor([cos_view]), cos_light, between).double().mean() * 2 * math.pi)


def test_fresnel_at_its_ends() -> None:
    """((n - 1) / (n + 1))² at right angles, everything at grazing; no p-polarized light at Brewster's angle."""
    ends = torch.tensor([1.0, 0.0])
    assert_close(fresnel_dielectric(ends, 1.5), torch.tensor([0.04, 1.0]))
    assert_close(fresnel_schlick(ends, 0.8), torch.tensor([0.8, 1.0]))
    brewster = torch.cos(torch.atan(torch.tensor([1.5])))
    across = (1 - 1.5**2) / (1 + 1.5**2)  # the s-polarized amplitude there
    assert_close(fresnel_dielectric(brewster, 1.5), across**2 / 2)


@given(cosine=st.floats(0.05, 1.0), roughness=st.floats(0.2, 1.0))
def test_white_metal_loses_nothing(cosine: float, roughness: float) -> None:
    """With further reflections given back, a surface whose mirrors reflect everything reflects everything."""
    white = Surface(base=1.0, metallic=True, roughness=roughness)
    torch.testing.assert_close(
        white.albedo(torch.tensor([cosine])), torch.ones(1, dtype=torch.float64), rtol=0, atol=1e-9
    )


@given(cosine=st.floats(0.05, 1.0), roughness=st.floats(0.05, 1.0), base=st.floats(0.0, 1.0), metallic=st.booleans())
def test_no_surface_makes_light(cosine: float, roughness: float, base: float, metallic: bool) -> None:
    albedo = Surface(base, metallic, roughness).albedo(torch.tensor([cosine]))
    assert 0 <= float(albedo) <= 1 + 1e-9


@pytest.mark.parametrize("surface", [MATTE, COATED, Surface(0.5, True, 0.9)])
@pytest.mark.parametrize("cosine", COSINES.tolist())
def test_the_lobe_holds_its_albedo(surface: Surface, cosine: float) -> None:
    """The lobe added up over light directions is the albedo added up over visible mirrors, to 0.3%: both quadratures
    have a fifth of a degree between nodes where lobes are 6 degrees wide.
    """
    expected = float(surface.gloss_albedo(torch.tensor([cosine])))
    assert integral_of_gloss(surface, cosine) == pytest.approx(expected, rel=3e-3)


def test_single_reflection_is_reciprocal_and_darkens_with_roughness() -> None:
    """Without the view's factor f(v, l) = f(l, v), and what is lost grows with roughness (Heitz 2014, Sec. 6)."""
    cos_view, cos_light, between = torch.tensor([0.4]), torch.tensor([[0.8]]), torch.tensor([[0.5]])
    there = MATTE.gloss(cos_view, cos_light, between) / cos_light
    back = MATTE.gloss(cos_light[0], cos_view[None], between) / cos_view

    def factor(cosine: torch.Tensor) -> torch.Tensor:
        once, mean = directional_albedo(cosine, MATTE.roughness), mean_albedo(MATTE.roughness)
        fresnel = 0.8 + 0.2 / 21  # 2 ∫ (b + (1 - b) (1 - μ)⁵) μ dμ = b + (1 - b) / 21
        return 1 + fresnel * mean / (1 - fresnel * (1 - mean)) * (1 - once) / once

    assert_close(there / factor(cos_view).float(), back / factor(cos_light[0]).float())
    losses = [1 - mean_albedo(roughness) for roughness in (0.2, 0.4, 0.6, 0.8, 1.0)]
    assert losses == sorted(losses)
    assert losses[0] < 0.02
    assert losses[-1] > 0.4


def test_surfaces_are_checked() -> None:
    with pytest.raises(OptionError, match=r"base is 1\.2; accepted: 0 to 1"):
        Surface(1.2, True, 0.5)
    with pytest.raises(OptionError, match=r"roughness is -0\.1"):
        Surface(0.8, True, -0.1)
    with pytest.raises(OptionError, match=r"roughness is 0\.0; accepted: 0\.03 or more, unless"):
        Surface(0.8, False, 0.0)
    with pytest.raises(OptionError, match=r"ior is 1\.0; accepted: above 1"):
        Surface(0.8, False, 0.5, ior=1.0)
