"""Procedural HDR panoramas with real light transport: streets and furnished rooms, path traced by Mitsuba.

The closed forms of `procedural` know no shadows and no light between walls; a model that is to find light in a
photograph learns from exactly these. A scene follows from its seed: the sky of `procedural.draw_sky` lights ground,
houses and trees, or comes into a room through its windows; lamps light the rest. Renders are denoised by Intel's Open
Image Denoise. Mitsuba and the denoiser are the extra `train`.
"""

from __future__ import annotations

import importlib
import math
from typing import Any, Final

import numpy as np
import torch
import torch.nn.functional as F
from torch import Generator

from ...errors import OptionError
from ...shapes import Latlong
from .procedural import MEDIAN, draw_sky, random_colour, random_log_uniform, random_uniform

__all__ = ["render_panorama"]

DEPTH: Final = 6
"""Longest path, segments."""

EYE: Final = 1.5
"""Height of the camera, metres."""

WRAP: Final = 16
"""Columns repeated at both sides for the denoiser, so that no seam shows behind the camera."""

DARKEST: Final = 1e-3
"""Median luminance under which a scene counts as unlit, in units where the sky's median is 0.2."""

Shape = dict[str, Any]


def _libraries() -> tuple[Any, Any]:
    """Mitsuba on its fastest variant that runs here, and the denoiser.

    Raises:
        OptionError: they are not installed.
    """
    try:
        mitsuba, denoiser = importlib.import_module("mitsuba"), importlib.import_module("pyoidn")
    except ImportError as error:
        raise OptionError(
            "--rendered", f"scenes without {error.name}", "0, or mitsuba and pyoidn installed (the extra train)"
        ) from error
    if mitsuba.variant() is None:
        try:
            mitsuba.set_variant("llvm_ad_rgb")
            mitsuba.Float(1.0)
        except Exception:  # without LLVM's library; Mitsuba raises what its parts do
            mitsuba.set_variant("scalar_rgb")
    return mitsuba, denoiser


def render_panorama(seed: int, height: int, samples: int = 64) -> Latlong:
    """The rendered panorama of a seed: a street for even seeds, a room for odd ones.

    Args:
        seed: decides the scene. The noise of its render repeats, too, unless Mitsuba takes the lights in another order,
            which it does at times.
        height: rows of the map.
        samples: paths a pixel.

    Returns:
        (1, height, 2 height, 3) linear radiance scaled to a median luminance of `procedural.MEDIAN`.

    Raises:
        OptionError: Mitsuba or the denoiser is not installed.
    """
    mitsuba, denoiser = _libraries()
    # A scene that came out unlit (a room whose lamps all hang behind furniture) is drawn again.
    for attempt in range(8):
        generator = torch.Generator().manual_seed(seed * 8 + attempt)
        shapes, eye = (_street if seed % 2 == 0 else _room)(mitsuba, generator)
        # One after the other: in parallel lights come in any order more often, and with them the noise.
        scene = mitsuba.load_dict(
            {"type": "scene", **{f"shape{i}": shape for i, shape in enumerate(shapes)}}, parallel=False
        )
        noisy = _trace(mitsuba, scene, eye, height, samples, seed)
        median = float(np.median(noisy.mean(axis=-1)))
        if median > DARKEST:
            break
    panorama = torch.from_numpy(_denoised(denoiser, noisy)).clamp(min=0)[None]
    return panorama * (MEDIAN / panorama.mean(dim=-1).median().clamp(min=1e-3))


def _trace(mitsuba: Any, scene: Any, eye: list[float], height: int, samples: int, seed: int) -> np.ndarray:
    """Path trace all directions from a point: (height, 2 height, 3), in this package's latlong convention."""
    drjit = importlib.import_module("drjit")
    integrator = mitsuba.load_dict({"type": "path", "max_depth": DEPTH})
    sampler = mitsuba.load_dict({"type": "independent", "sample_count": 1})
    if mitsuba.variant().startswith("scalar"):
        raise OptionError("--rendered", "scenes without LLVM", "0, or LLVM 16 or newer installed, which Mitsuba uses")
    width, count = 2 * height, 2 * height * height * samples
    sampler.seed(seed, count)
    pixel = drjit.arange(mitsuba.UInt32, count) // samples
    column, row = mitsuba.Float(pixel % width), mitsuba.Float(pixel // width)
    azimuth = ((column + sampler.next_1d()) / width - 0.5) * (2 * math.pi)
    polar = (row + sampler.next_1d()) / height * math.pi
    towards = mitsuba.Vector3f(
        drjit.sin(polar) * drjit.sin(azimuth), drjit.cos(polar), -drjit.sin(polar) * drjit.cos(azimuth)
    )
    rays = mitsuba.RayDifferential3f(mitsuba.Point3f(eye), towards)
    colour, _, _ = integrator.sample(scene, sampler, rays)
    return np.array(colour).reshape(3, height, width, samples).mean(axis=-1).transpose(1, 2, 0).astype(np.float32)


def _denoised(denoiser: Any, noisy: np.ndarray) -> np.ndarray:
    """A latlong without its render noise, whose left and right edges still meet."""
    wrapped = np.concatenate((noisy[:, -WRAP:], noisy, noisy[:, :WRAP]), axis=1)
    clean: np.ndarray = denoiser.denoise(np.ascontiguousarray(wrapped), hdr=True)[:, WRAP:-WRAP]
    return np.ascontiguousarray(clean)


# --- parts ----------------------------------------------------------------------------------------------------------


def _texture(mitsuba: Any, generator: Generator, albedo: torch.Tensor, contrast: float, size: int = 64) -> Shape:
    """A blotchy or tiled texture around an albedo (3,)."""
    grid = torch.zeros(1, 1, size, size)
    for octave in range(4):
        side = min(size, 4 << octave)
        coarse = torch.randn(1, 1, side, side, generator=generator)
        grid = grid + 0.6**octave * F.interpolate(coarse, (size, size), mode="bicubic")
    if random_uniform(generator, 0, 1) < 0.4:
        tiles = 2 ** int(random_uniform(generator, 1, 5))
        checks = (torch.arange(size) * tiles // size) % 2
        grid = 0.5 * grid + 2.0 * (checks[:, None] ^ checks[None, :])[None, None]
    grid = (grid - grid.mean()) / grid.std()
    pattern = (1 + contrast * grid[0, 0]).clamp(0.15, 2)[..., None]
    values = (albedo * pattern).clamp(0.02, 0.95)
    bitmap = mitsuba.Bitmap(values.numpy().astype(np.float32))
    return {"type": "bitmap", "bitmap": bitmap, "raw": True, "filter_type": "bilinear"}


def _material(mitsuba: Any, generator: Generator, low: float, high: float, saturation: float) -> Shape:
    """Mostly diffuse surfaces, some glossy, a few of metal."""
    albedo = random_uniform(generator, low, high) * random_colour(generator, saturation)
    reflectance = _texture(mitsuba, generator, albedo, random_uniform(generator, 0.05, 0.4))
    kind = random_uniform(generator, 0, 1)
    if kind < 0.72:
        inner: Shape = {"type": "diffuse", "reflectance": reflectance}
    elif kind < 0.94:
        inner = {
            "type": "roughplastic",
            "diffuse_reflectance": reflectance,
            "alpha": random_uniform(generator, 0.05, 0.4),
        }
    else:
        inner = {"type": "roughconductor", "material": "Al", "alpha": random_uniform(generator, 0.1, 0.4)}
    return {"type": "twosided", "bsdf": inner}


def _box(mitsuba: Any, centre: list[float], half: list[float], turn: float, material: Shape) -> Shape:
    transform = mitsuba.ScalarTransform4f
    place = transform().translate(centre).rotate([0, 1, 0], turn).scale(half)
    return {"type": "cube", "to_world": place, "bsdf": material}


def _panel(mitsuba: Any, centre: list[float], towards: list[float], size: tuple[float, float], **what: Shape) -> Shape:
    """A rectangle of half sizes, facing a direction."""
    transform = mitsuba.ScalarTransform4f
    up = [0.0, 0.0, 1.0] if abs(towards[1]) > 0.9 else [0.0, 1.0, 0.0]
    target = [a + b for a, b in zip(centre, towards, strict=True)]
    place = transform().look_at(origin=centre, target=target, up=up).scale([size[0], size[1], 1])
    return {"type": "rectangle", "to_world": place, **what}


def _sky(mitsuba: Any, generator: Generator, level: float = 1.0) -> Shape:
    """The closed-form sky as a light; its own ground lies below and lights nothing that stands on real ground."""
    sky = draw_sky(generator, 128)[0] * level
    return {"type": "envmap", "bitmap": mitsuba.Bitmap(sky.numpy().astype(np.float32))}


def _ground(mitsuba: Any, generator: Generator) -> Shape:
    albedo = random_uniform(generator, 0.08, 0.5) * random_colour(generator, 0.35)
    reflectance = _texture(mitsuba, generator, albedo, 0.35, 256)
    reflectance["to_uv"] = mitsuba.ScalarTransform3f().scale([random_log_uniform(generator, 3, 24)] * 2)
    return _panel(mitsuba, [0, 0, 0], [0, 1, 0], (80, 80), bsdf={"type": "diffuse", "reflectance": reflectance})


def _street(mitsuba: Any, generator: Generator) -> tuple[list[Shape], list[float]]:
    """Open ground under a sky with houses, trees and small things around the camera."""
    shapes = [_sky(mitsuba, generator), _ground(mitsuba, generator)]
    for _ in range(int(random_uniform(generator, 0, 14))):
        away, bearing = random_log_uniform(generator, 5, 50), random_uniform(generator, 0, 2 * math.pi)
        half = [
            random_uniform(generator, 1.5, 8),
            random_log_uniform(generator, 1.2, 10),
            random_uniform(generator, 1.5, 8),
        ]
        away += 1.5 * max(half[0], half[2])
        centre = [away * math.sin(bearing), half[1], away * math.cos(bearing)]
        material = _material(mitsuba, generator, 0.15, 0.75, 0.3)
        shapes.append(_box(mitsuba, centre, half, random_uniform(generator, 0, 90), material))
    for _ in range(int(random_uniform(generator, 0, 12))):
        away, bearing = random_log_uniform(generator, 4, 30), random_uniform(generator, 0, 2 * math.pi)
        radius, trunk = random_uniform(generator, 0.8, 2.5), random_uniform(generator, 0.5, 3)
        x, z = (away + radius) * math.sin(bearing), (away + radius) * math.cos(bearing)
        leaves = random_uniform(generator, 0.08, 0.3) * torch.tensor([0.7, 1.3, 0.4]) * random_colour(generator, 0.25)
        crown = {"type": "diffuse", "reflectance": _texture(mitsuba, generator, leaves, 0.5)}
        bark = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.14, 0.1, 0.07]}}
        shapes.append({"type": "sphere", "center": [x, trunk + radius, z], "radius": radius, "bsdf": crown})
        shapes.append({"type": "cylinder", "p0": [x, 0, z], "p1": [x, trunk + radius, z], "radius": 0.15, "bsdf": bark})
    for _ in range(int(random_uniform(generator, 0, 8))):
        shapes.append(_thing(mitsuba, generator, random_uniform(generator, 1.2, 6), 0.0))
    return shapes, [0.0, EYE, 0.0]


def _thing(mitsuba: Any, generator: Generator, away: float, floor: float) -> Shape:
    """A block or a round thing standing on a floor, so far away that the camera is not in it."""
    bearing = random_uniform(generator, 0, 2 * math.pi)
    material = _material(mitsuba, generator, 0.1, 0.8, 0.6)
    half = [
        random_uniform(generator, 0.15, 0.5),
        random_uniform(generator, 0.15, 0.7),
        random_uniform(generator, 0.15, 0.5),
    ]
    x, z = (away + 0.6) * math.sin(bearing), (away + 0.6) * math.cos(bearing)
    if random_uniform(generator, 0, 1) < 0.3:
        return {"type": "sphere", "center": [x, floor + half[1], z], "radius": half[1], "bsdf": material}
    return _box(mitsuba, [x, floor + half[1], z], half, random_uniform(generator, 0, 90), material)


def _room(mitsuba: Any, generator: Generator) -> tuple[list[Shape], list[float]]:
    """A room with furniture, lit through windows by a sky outside, by lamps, or by both."""
    width, depth = (random_uniform(generator, 1.8, 6) for _ in range(2))
    ceiling = random_uniform(generator, 2.3, 4.2)
    eye = [random_uniform(generator, -0.5, 0.5) * width, EYE, random_uniform(generator, -0.5, 0.5) * depth]
    windows = int(random_uniform(generator, 0, 3.99))
    night = windows == 0 or random_uniform(generator, 0, 1) < 0.15
    shapes = [
        _sky(mitsuba, generator, 0.01 if night else random_log_uniform(generator, 1, 8)),
        _ground(mitsuba, generator),
    ]
    wall = _material(mitsuba, generator, 0.3, 0.85, 0.25)
    floor, top = (_material(mitsuba, generator, *span) for span in ((0.08, 0.55, 0.4), (0.6, 0.9, 0.06)))
    shapes.append(_panel(mitsuba, [0, 0.02, 0], [0, 1, 0], (width, depth), bsdf=floor))
    shapes.append(_panel(mitsuba, [0, ceiling, 0], [0, -1, 0], (width, depth), bsdf=top))
    sides = torch.randperm(4, generator=generator).tolist()[:windows]
    for side in range(4):
        shapes += _wall(mitsuba, generator, side, (width, depth, ceiling), side in sides, wall)
    for _ in range(int(random_uniform(generator, 1 if night else 0, 5))):
        shapes.append(_lamp(mitsuba, generator, (width, depth, ceiling), eye))
    for _ in range(int(random_uniform(generator, 2, 10))):
        reach = random_uniform(generator, 0.5, 0.9)
        thing = _thing(mitsuba, generator, reach * min(width, depth), 0.02)
        shapes.append(thing)
    return shapes, eye


def _wall(
    mitsuba: Any, generator: Generator, side: int, room: tuple[float, float, float], window: bool, material: Shape
) -> list[Shape]:
    """A wall, whole or in four panels around a window."""
    width, depth, ceiling = room
    half, away = (depth, width) if side % 2 == 0 else (width, depth)
    sign = 1.0 if side < 2 else -1.0

    def panel(left: float, right: float, bottom: float, top: float) -> Shape:
        along, level = (left + right) / 2, (bottom + top) / 2
        centre = [sign * away, level, along] if side % 2 == 0 else [along, level, sign * away]
        inward = [-sign, 0.0, 0.0] if side % 2 == 0 else [0.0, 0.0, -sign]
        return _panel(mitsuba, centre, inward, ((right - left) / 2, (top - bottom) / 2), bsdf=material)

    if not window:
        return [panel(-half, half, 0, ceiling)]
    left = random_uniform(generator, -0.85, 0.1) * half
    right = min(0.95 * half, left + random_uniform(generator, 0.6, 1.6) * half)
    bottom = random_uniform(generator, 0.0, 1.1)
    top = min(0.95 * ceiling, bottom + random_uniform(generator, 0.9, 2.4))
    return [
        panel(-half, left, 0, ceiling),
        panel(right, half, 0, ceiling),
        panel(left, right, 0, bottom),
        panel(left, right, top, ceiling),
    ]


def _lamp(mitsuba: Any, generator: Generator, room: tuple[float, float, float], eye: list[float]) -> Shape:
    """A panel in the ceiling or a globe under it or on the floor; never where the camera is."""
    width, depth, ceiling = room
    green = random_uniform(generator, 0.6, 1.0)
    colour = torch.tensor([1.0, green, green * random_uniform(generator, 0.4, 1.1)])
    x, z = (random_uniform(generator, -0.85, 0.85) * side for side in (width, depth))
    flat = random_uniform(generator, 0, 1) < 0.5
    if flat:
        size = (random_log_uniform(generator, 0.08, 0.8), random_log_uniform(generator, 0.08, 0.8))
        area = 4 * size[0] * size[1]
    else:
        radius = random_log_uniform(generator, 0.05, 0.25)
        area = 4 * math.pi * radius**2
    power = random_log_uniform(generator, 1.5, 12)
    radiance = (colour * min(400.0, power / area)).tolist()
    emitter = {"type": "area", "radiance": {"type": "rgb", "value": radiance}}
    if flat:
        return _panel(mitsuba, [x, ceiling - 0.02, z], [0, -1, 0], size, emitter=emitter)
    level = random_uniform(generator, 0.4, ceiling - 0.3)
    if math.dist((x, level, z), eye) < radius + 0.3:
        level = ceiling - radius - 0.05
    return {"type": "sphere", "center": [x, level, z], "radius": radius, "emitter": emitter}
