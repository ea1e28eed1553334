"""Balls rendered by Blender's Cycles, the independent judge of spheres, their array and the perspective unwrap.

    python -m dl_core.bench.blender perspective|spheres|array OUT [NAME ...]

Needs `bpy` (extra `blender`), which wants numpy 1 and so an environment of its own. Nothing else of this package is
imported but the maps: the judge shares no code with what it judges. Renders are written as linear half-float EXR, with
a JSON file of the same name that holds what is in the picture.

World: Blender's +X is right, +Z up, and the cameras look along +Y. That is our +X, +Y and -Z, so the centre column of a
map lies straight ahead of a level camera, row 0 is up, and the right of the picture is right of the centre. Cycles puts
the centre of an equirectangular map at +X with -Y right of it: maps are rolled by a quarter, an exact shift of pixels.

Cycles reads the map bilinearly. All clamps, adaptive sampling, light-threshold and denoising are off, and the pixel
filter is a box of one pixel, so that every render is an unbiased estimate of the mean radiance over each pixel; its
variance is estimated from two renders with different seeds, of which the mean is written.
"""

from __future__ import annotations

import argparse
import json
import math
import tempfile
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

import bpy
import numpy as np
import OpenEXR

from .blender_maps import DIRECTION_MAP_HEIGHT, Pixels, environment

__all__ = ["Frame", "Material", "main", "perspective", "sphere_array", "three_spheres"]


# --- files --------------------------------------------------------------------------------------------------------


def _read_rgba(path: str) -> Pixels:
    channels = OpenEXR.File(path, separate_channels=True).channels()
    return np.stack([channels[name].pixels.astype(np.float32) for name in "RGBA"], axis=-1)


def _write(path: Path, pixels: Pixels, dtype: type = np.float16) -> None:
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    names = "RGBA"[: pixels.shape[-1]]
    channels: dict[str, Any] = {
        name: np.ascontiguousarray(pixels[..., index].astype(dtype)) for index, name in enumerate(names)
    }
    OpenEXR.File(header, channels).write(str(path))


# --- scene --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Material:
    """Inputs of Blender's Principled BSDF; all others stay at their defaults (IOR 1.5, specular level 0.5, white
    tint), with the distribution Multiscatter GGX.
    """

    base: float
    metallic: float
    roughness: float


MATERIALS: Final = {
    "chrome": Material(base=1.0, metallic=1.0, roughness=0.0),
    "mirror": Material(base=0.8, metallic=1.0, roughness=0.0),
    "matte": Material(base=0.8, metallic=1.0, roughness=0.3271),
    "diffuse": Material(base=0.8, metallic=0.0, roughness=0.364),
    "lambert": Material(base=0.8, metallic=0.0, roughness=0.364),
}
"""The three spheres of the authors' evaluation; chrome, a mirror that absorbs nothing; lambert, a Diffuse BSDF of
the base colour alone.
"""


@dataclass(frozen=True)
class Frame:
    """A pinhole camera and the part of its picture that is kept.

    Attributes:
        width: of the whole picture in pixels.
        height: of the whole picture in pixels.
        fov: horizontal field of view in degrees; 0 for an orthographic camera.
        crop: left, top, width and height of the kept part in pixels.
    """

    width: int
    height: int
    fov: float
    crop: tuple[int, int, int, int]

    @property
    def focal(self) -> float:
        """Focal length in pixels."""
        return self.width / 2 / math.tan(math.radians(self.fov) / 2)


def _empty_scene() -> Any:
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    scene.render.engine = "CYCLES"
    scene.render.threads_mode, scene.render.threads = "FIXED", 1
    scene.render.film_transparent = True
    scene.render.image_settings.file_format = "OPEN_EXR"
    scene.render.image_settings.color_mode = "RGBA"
    scene.render.image_settings.color_depth = "32"
    settings = scene.cycles
    settings.device = "CPU"
    settings.use_denoising = settings.use_adaptive_sampling = False
    settings.sample_clamp_direct = settings.sample_clamp_indirect = 0
    settings.light_sampling_threshold = settings.blur_glossy = 0
    settings.pixel_filter_type = "BOX"
    scene.render.filter_size = 1
    settings.max_bounces = settings.diffuse_bounces = settings.glossy_bounces = 32
    return scene


def _light(scene: Any, pixels: Pixels, folder: Path) -> None:
    """Make a map the world's light; importance sampling sees it at twice its own resolution."""
    path = folder / "world.exr"
    _write(path, np.roll(pixels, -pixels.shape[1] // 4, axis=1), np.float32)
    world = scene.world = bpy.data.worlds.new("map")
    world.use_nodes = True
    nodes = world.node_tree.nodes
    picture = nodes.new("ShaderNodeTexEnvironment")
    picture.image = bpy.data.images.load(str(path))
    picture.image.colorspace_settings.name = "Non-Color"
    picture.interpolation = "Linear"
    world.node_tree.links.new(picture.outputs["Color"], nodes["Background"].inputs["Color"])
    world.cycles.sampling_method = "MANUAL"
    world.cycles.sample_map_resolution = 2 * pixels.shape[1]


def _principled(material: Material) -> Any:
    shader = bpy.data.materials.new("ball")
    shader.use_nodes = True
    node = next(node for node in shader.node_tree.nodes if node.type == "BSDF_PRINCIPLED")
    node.distribution = "MULTI_GGX"
    node.inputs["Base Color"].default_value = (*[material.base] * 3, 1)
    node.inputs["Metallic"].default_value = material.metallic
    node.inputs["Roughness"].default_value = material.roughness
    return shader


def _lambert(base: float) -> Any:
    shader = bpy.data.materials.new("lambert")
    shader.use_nodes = True
    tree = shader.node_tree
    node = tree.nodes.new("ShaderNodeBsdfDiffuse")
    node.inputs["Color"].default_value = (base, base, base, 1)
    output = next(node for node in tree.nodes if node.type == "OUTPUT_MATERIAL")
    tree.links.new(node.outputs["BSDF"], output.inputs["Surface"])
    return shader


def _shader(name: str) -> Any:
    material = MATERIALS[name]
    return _lambert(material.base) if name == "lambert" else _principled(material)


_SEGMENTS, _RINGS = 256, 128


def _sphere_mesh(radius: float) -> Any:
    """A closed sphere of 256 x 128 faces, 8e-5 of its radius from round at most, whose normals point from its centre.

    An interpolated normal is then that of the point hit exactly: normals and corners are proportional.
    """
    polar = (np.arange(1, _RINGS) * (math.pi / _RINGS))[:, None]
    azimuth = (np.arange(_SEGMENTS) * (2 * math.pi / _SEGMENTS))[None, :]
    parts = (np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar) * np.ones_like(azimuth))
    corners = np.concatenate((np.stack(parts, axis=-1).reshape(-1, 3), [[0, 0, 1], [0, 0, -1]]))
    index = np.arange((_RINGS - 1) * _SEGMENTS).reshape(_RINGS - 1, _SEGMENTS)
    after = np.roll(index, -1, axis=1)
    quads = np.stack((index[:-1], index[1:], after[1:], after[:-1]), axis=-1).reshape(-1, 4).tolist()
    north = [(len(corners) - 2, here, there) for here, there in zip(index[0], after[0], strict=True)]
    south = [(len(corners) - 1, there, here) for here, there in zip(index[-1], after[-1], strict=True)]
    mesh = bpy.data.meshes.new("sphere")
    mesh.from_pydata((radius * corners).tolist(), [], quads + north + south)
    mesh.polygons.foreach_set("use_smooth", np.ones(len(mesh.polygons), bool))
    mesh.normals_split_custom_set_from_vertices(corners.tolist())
    return mesh


def _sphere(scene: Any, shader: Any, centre: tuple[float, float, float], radius: float) -> None:
    mesh = _sphere_mesh(radius)
    mesh.materials.append(shader)
    ball = bpy.data.objects.new("ball", mesh)
    ball.location = centre
    scene.collection.objects.link(ball)


def _camera(scene: Any, frame: Frame, place: tuple[float, float, float], pitch: float, width: float = 0) -> None:
    """A camera that looks along +Y, tilted by `pitch` degrees upwards; `width` is what an orthographic one sees."""
    data = bpy.data.cameras.new("camera")
    data.sensor_fit = "HORIZONTAL"
    if frame.fov:
        data.angle = math.radians(frame.fov)
    else:
        data.type, data.ortho_scale = "ORTHO", width
    data.clip_start, data.clip_end = 1e-3, 1e4
    camera = bpy.data.objects.new("camera", data)
    camera.location = place
    camera.rotation_euler = (math.radians(90 + pitch), 0, 0)
    scene.collection.objects.link(camera)
    scene.camera = camera
    left, top, columns, rows = frame.crop
    render = scene.render
    render.resolution_x, render.resolution_y, render.resolution_percentage = frame.width, frame.height, 100
    render.use_border = render.use_crop_to_border = True
    # Half a thousandth of a pixel inwards: the border is truncated to pixels.
    render.border_min_x, render.border_max_x = (left + 5e-4) / frame.width, (left + columns + 5e-4) / frame.width
    render.border_min_y = 1 - (top + rows - 5e-4) / frame.height
    render.border_max_y = 1 - (top - 5e-4) / frame.height


def _render(scene: Any, samples: int, seed: int, folder: Path) -> Pixels:
    scene.cycles.samples, scene.cycles.seed = samples, seed
    scene.render.filepath = str(folder / "render.exr")
    bpy.ops.render.render(write_still=True)
    return _read_rgba(scene.render.filepath)


def _noise(first: Pixels, second: Pixels) -> float:
    """RMSE of the mean of two renders relative to their RMS where the ball covers the pixel: half their difference."""
    inside = first[..., 3] > 0.999
    difference = (first[..., :3] - second[..., :3])[inside] / 2
    mean = (first[..., :3] + second[..., :3])[inside] / 2
    return float(np.sqrt(np.mean(difference**2) / np.mean(mean**2)))


def _save(path: Path, scene: Any, samples: int, facts: dict[str, Any]) -> None:
    """Render twice and write the mean, premultiplied by coverage, and what is known about it."""
    with tempfile.TemporaryDirectory() as folder:
        first, second = (_render(scene, samples, seed, Path(folder)) for seed in (1, 2))
    _write(path.with_suffix(".exr"), (first + second) / 2)
    facts |= {"blender": bpy.app.version_string, "samples": 2 * samples, "seeds": [1, 2]}
    facts["noise_relative_rms"] = _noise(first, second)
    path.with_suffix(".json").write_text(json.dumps(facts, indent=1) + "\n", encoding="utf-8")


# --- perspective balls -------------------------------------------------------------------------------------------

_BALL_RADIUS: Final = 128.0
_FRAME: Final = 1024
_MARGIN: Final = 8
_ORIENTATION: Final = (
    "our axes: +X right, +Y up, the camera looks along -Z; centre column of the map straight ahead, row 0 up, "
    "right of the picture right of the centre"
)


def perspective(out: Path, environment_name: str, fov: float, samples: int = 64) -> None:
    """A chrome ball at the centre of a square picture, its silhouette 128 px in radius."""
    half = _FRAME // 2
    side = int(_BALL_RADIUS) + _MARGIN
    frame = Frame(_FRAME, _FRAME, fov, (half - side, half - side, 2 * side, 2 * side))
    distance = math.hypot(frame.focal, _BALL_RADIUS) / _BALL_RADIUS  # sin of the silhouette's half angle is 1/distance
    scene = _empty_scene()
    with tempfile.TemporaryDirectory() as folder:
        _light(scene, environment(environment_name, DIRECTION_MAP_HEIGHT), Path(folder))
        _sphere(scene, _shader("chrome"), (0, distance, 0), 1)
        _camera(scene, frame, (0, 0, 0), 0)
        suffix = "" if environment_name == "directions" else f"_{environment_name}"
        facts = {
            "panorama": environment_name,
            "panorama_height": DIRECTION_MAP_HEIGHT,
            "colour": "1 + direction / 2" if environment_name == "directions" else "linear radiance",
            "orientation": _ORIENTATION,
            "fov_deg": fov,
            "frame_px": [_FRAME, _FRAME],
            "crop_px": dict(zip(("left", "top", "width", "height"), frame.crop, strict=True)),
            "centre_in_frame_px": [half, half],
            "centre_in_crop_px": [side, side],
            "pixel_convention": "pixel (i, j) spans j to j + 1 across and i to i + 1 down",
            "silhouette_radius_px": _BALL_RADIUS,
            "focal_px": frame.focal,
            "distance_in_radii": distance,
            "material": asdict(MATERIALS["chrome"]),
        }
        _save(out / f"perspective_fov{fov:g}{suffix}", scene, samples // 2, facts)


def _all_perspective(out: Path, names: list[str]) -> None:
    for name in names or ["directions", "dancing_hall"]:
        for fov in (40.0, 60.0, 90.0):
            perspective(out, name, fov)


# --- the authors' three spheres ------------------------------------------------------------------------------------

_CAMERA: Final = (0.0, -16.0, 2.0)
_FOV: Final = math.degrees(2 * math.atan(36 / 2 / 85))  # an 85 mm lens on a 36 mm sensor
_THIRD: Final = Frame(320, 180, _FOV, (110, 40, 100, 100))
_SIXTH: Final = Frame(160, 90, _FOV, (55, 20, 50, 50))
_SPHERE_SAMPLES: Final = {"diffuse": (_SIXTH, 4096), "matte": (_SIXTH, 4096), "mirror": (_THIRD, 1024)}
"""Parts of the authors' resolution, and samples a pixel. A mirror's sun is smaller than a pixel: of 64 samples none or
several meet it, and two renders say little of the error; 1024 leave 0.8% under the worst panorama.
"""
_PANORAMAS: Final = (
    "apartment",
    "dancing_hall",
    "drachenfels_cellar",
    "kloppenheim_05",
    "narrow_moonlit_road",
    "sun",
    "uniform",
)


def three_spheres(out: Path, environment_name: str) -> None:
    """The authors' spheres seen by their camera, which looks down at the sphere, in a third or a sixth of their
    resolution.
    """
    distance = math.hypot(*_CAMERA)
    pitch = -math.degrees(math.atan2(_CAMERA[2], -_CAMERA[1]))
    for name, (frame, samples) in _SPHERE_SAMPLES.items():
        scene = _empty_scene()
        with tempfile.TemporaryDirectory() as folder:
            _light(scene, environment(environment_name, DIRECTION_MAP_HEIGHT), Path(folder))
            _sphere(scene, _shader(name), (0, 0, 0), 1)
            _camera(scene, frame, _CAMERA, pitch)
            facts = {
                "panorama": environment_name,
                "panorama_height": DIRECTION_MAP_HEIGHT,
                "orientation": _ORIENTATION + ", but for the camera's pitch",
                "pitch_deg": pitch,
                "distance_in_radii": distance,
                "frame_px": [frame.width, frame.height],
                "crop_px": dict(zip(("left", "top", "width", "height"), frame.crop, strict=True)),
                "silhouette_radius_px": frame.focal / math.sqrt(distance**2 - 1),
                "material": asdict(MATERIALS[name]),
            }
            _save(out / f"{name}_{environment_name}", scene, samples // 2, facts)


def _all_spheres(out: Path, names: list[str]) -> None:
    for name in names or _PANORAMAS:
        three_spheres(out, name)


# --- the array of spheres on a plane ---------------------------------------------------------------------------------

_SPACING: Final = 2.89
_ABOVE: Final = 14.6
_ARRAY: Final = Frame(128, 128, math.degrees(2 * math.atan(36 / 2 / 50)), (0, 0, 128, 128))
"""A 50 mm lens on a 36 mm sensor, in half of the authors' resolution."""
_ARRAY_SAMPLES: Final = 1024


def _plane(scene: Any, shader: Any, half: float) -> None:
    mesh = bpy.data.meshes.new("plane")
    corners = [(x * half, y * half, 0) for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    mesh.from_pydata(corners, [], [(0, 1, 2, 3)])
    mesh.materials.append(shader)
    scene.collection.objects.link(bpy.data.objects.new("plane", mesh))


def sphere_array(out: Path, environment_name: str) -> None:
    """Nine Lambertian spheres on a plane that fills the frame, seen from straight above; -Z of our axes is at the top.

    In radii: a square lattice of 2.89, its diagonals along the sides of the picture, 14.6 below the camera.
    """
    scene = _empty_scene()
    half = (_ABOVE + 1) * _ARRAY.width / 2 / _ARRAY.focal
    step = _SPACING / math.sqrt(2)
    with tempfile.TemporaryDirectory() as folder:
        _light(scene, environment(environment_name, DIRECTION_MAP_HEIGHT), Path(folder))
        shader = _shader("lambert")
        for i in (-1, 0, 1):
            for j in (-1, 0, 1):
                _sphere(scene, shader, ((i + j) * step, (i - j) * step, 1), 1)
        _plane(scene, shader, half)
        _camera(scene, _ARRAY, (0, 0, _ABOVE + 1), -90)
        facts = {
            "panorama": environment_name,
            "panorama_height": DIRECTION_MAP_HEIGHT,
            "orientation": "seen from above: right of the picture is our +X, its top our -Z",
            "spacing_in_radii": _SPACING,
            "lattice": "3 x 3, at 45 degrees to the picture, on the plane",
            "camera_above_centres_in_radii": _ABOVE,
            "plane_half_side_in_radii": half,
            "frame_px": [_ARRAY.width, _ARRAY.height],
            "focal_px": _ARRAY.focal,
            "lambert": MATERIALS["lambert"].base,
            "diffuse_bounces": scene.cycles.diffuse_bounces,
        }
        _save(out / f"array_{environment_name}", scene, _ARRAY_SAMPLES // 2, facts)


def _all_arrays(out: Path, names: list[str]) -> None:
    for name in names or _PANORAMAS:
        sphere_array(out, name)


SETS: Final[dict[str, Callable[[Path, list[str]], None]]] = {
    "perspective": _all_perspective,
    "spheres": _all_spheres,
    "array": _all_arrays,
}
"""What can be rendered, by name: (folder, names of maps) -> files."""


def main() -> None:
    """Render a set of references into a folder."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("set", choices=tuple(SETS))
    parser.add_argument("out", type=Path)
    parser.add_argument("maps", nargs="*", help="names of maps; all of the set when none is given")
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    SETS[args.set](args.out, args.maps)


if __name__ == "__main__":
    main()
