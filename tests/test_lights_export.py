"""Light models as files: what they say is the light, in each format's own conventions."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from tolerances import assert_close

from dl_core.errors import OptionError, OutputError
from dl_core.geometry import latlong_directions
from dl_core.harmonics import sh_basis, sh_map
from dl_core.imageio import read_envmap, write_exr
from dl_core.lights.choose import Decision
from dl_core.lights.describe import describe, describe_harmonics
from dl_core.lights.export import write_lights
from dl_core.lights.gltf import EXTENSION, gltf_scene
from dl_core.lights.model import Light, LightModel
from dl_core.lights.search import Candidate
from dl_core.lights.usd import usd_stage
from dl_core.metrics import irradiance

READER = "NO INDEPENDENT READER: pip install {} to check with it"


def coefficients(seed: int = 1) -> torch.Tensor:
    """(9, 3) of a light that is positive everywhere."""
    found = 0.1 * torch.randn(9, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    found[0] = torch.tensor([3.0, 2.5, 2.0])
    return found


def unit(x: float, y: float, z: float) -> tuple[float, float, float]:
    length = math.hypot(x, y, z)
    return x / length, y / length, z / length


LIGHTS = (
    Light(unit(0.3, 0.8, -0.5), (6.0, 4.5, 3.0), 2.0),
    Light(unit(-1.0, 0.1, 0.2), (0.2, 0.4, 0.8)),
    Light((0.0, 1.0, 0.0), (1.0, 1.0, 1.0)),
    Light((0.0, -1.0, 0.0), (1.0, 1.0, 0.5), 5.0),
    Light((0.0, 0.0, 1.0), (0.5, 1.0, 1.0)),
    Light((0.0, 0.0, -1.0), (2.0, 1.0, 1.0)),
)
MODEL = LightModel(coefficients(), LIGHTS)


def decided(model: LightModel | None) -> Decision:
    """A decision for a model, or for the full map."""
    close = Candidate(LightModel(coefficients()[:1]), 3, {"diffuse": 0.4})
    full = Candidate(None, 8 * 16 * 3, {"diffuse": 0.0})
    chosen = (Candidate(model, model.parameters, {"diffuse": 0.005}),) if model else ()
    return Decision(0.01, ("diffuse",), (close, *chosen, full), {"diffuse": 0.01})


def turned(quaternion: list[float], vector: tuple[float, float, float]) -> np.ndarray:
    """A vector turned by a glTF rotation (x, y, z, w): v + 2 w (q x v) + 2 q x (q x v)."""
    axis, w = np.array(quaternion[:3]), quaternion[3]
    across = np.cross(axis, vector)
    return np.array(vector) + 2 * w * across + 2 * np.cross(axis, across)


directions = st.tuples(st.floats(-1, 1), st.floats(-1, 1), st.floats(-1, 1)).filter(lambda v: math.hypot(*v) > 1e-3)


# --- JSON --------------------------------------------------------------------------------------------------------


def test_json_holds_the_decision(tmp_path: Path) -> None:
    decision = decided(MODEL)
    assert write_lights(tmp_path / "a.json", decision, tmp_path / "map.exr") == [tmp_path / "a.json"]
    facts = json.loads((tmp_path / "a.json").read_text(encoding="utf-8"))
    assert facts == json.loads(json.dumps(describe(decision)))
    assert (facts["model"], facts["parameters"]) == ("sh2 + 4 directional + 2 area", 27 + 4 * 5 + 2 * 6)
    assert facts["levels"]["0.05"]["model"] == MODEL.name
    assert facts["lights"][0] == {
        "direction": list(LIGHTS[0].direction), "irradiance": [6.0, 4.5, 3.0], "angular_radius_deg": 2.0,
    }  # fmt: skip
    assert "angular_radius_deg" not in facts["lights"][1]


def test_both_conventions_of_harmonics_are_the_light() -> None:
    """Summed as the description says, they are the radiance and the irradiance of the map."""
    facts = describe_harmonics(MODEL)
    assert facts["order"] == ["L00", "L1-1", "L10", "L11", "L2-2", "L2-1", "L20", "L21", "L22"]
    normals = torch.nn.functional.normalize(torch.randn(20, 3, generator=torch.Generator().manual_seed(2)), dim=-1)
    basis = sh_basis(normals, 2)
    latlong = sh_map(coefficients()[None], 128)
    radiance, received = (torch.tensor(facts[key], dtype=torch.float64) for key in ("radiance", "irradiance"))
    assert_close(radiance, coefficients())
    # 128 rows of pixels, each a light at its centre, against the closed form.
    torch.testing.assert_close((basis @ received).float(), irradiance(latlong, normals)[0], rtol=1e-3, atol=1e-3)
    x, y, z = normals.double().T
    band_1 = math.sqrt(3 / (4 * math.pi)) * torch.stack((x, y, z), dim=-1)
    assert_close(basis[:, 1:4], band_1, dtype=torch.float32)


# --- glTF --------------------------------------------------------------------------------------------------------


def check_gltf(document: dict[str, Any]) -> None:
    """What the schemas of glTF 2.0 and KHR_lights_punctual ask of the parts that are written here."""
    assert document["asset"]["version"] == "2.0"
    assert 0 <= document["scene"] < len(document["scenes"])
    for key in ("nodes", "extensionsUsed"):
        assert document.get(key, ["absent"])  # lists are absent or not empty
    for scene in document["scenes"]:
        if "nodes" in scene:
            assert len(set(scene["nodes"])) == len(scene["nodes"]) > 0
            assert all(0 <= index < len(document["nodes"]) for index in scene["nodes"])
    used = set(document.get("extensionsUsed", []))
    assert set(document.get("extensions", {})) <= used
    lights = document.get("extensions", {}).get(EXTENSION, {"lights": [None]})["lights"]
    assert lights
    for node in document.get("nodes", []):
        assert set(node["extensions"]) <= used
        assert 0 <= node["extensions"][EXTENSION]["light"] < len(lights)
        assert math.hypot(*node["rotation"]) == pytest.approx(1)
        assert all(-1 <= value <= 1 for value in node["rotation"])
    for light in filter(None, lights):
        assert light["type"] == "directional"
        assert "range" not in light  # forbidden for directional lights
        assert len(light["color"]) == 3
        assert all(0 <= channel <= 1 for channel in light["color"])
        assert light["intensity"] >= 0


def test_gltf_is_valid_with_and_without_lights(tmp_path: Path) -> None:
    for model in (MODEL, LightModel(coefficients())):
        write_lights(tmp_path / "a.gltf", decided(model), tmp_path / "map.exr")
        document = json.loads((tmp_path / "a.gltf").read_text(encoding="utf-8"))
        check_gltf(document)
        assert ("extensionsUsed" in document) == bool(model.lights)
        extras = document["scenes"][0]["extras"]["lightprobe"]
        assert extras["spherical_harmonics"] == json.loads(json.dumps(describe_harmonics(model)))


@given(direction=directions, irradiance=st.tuples(*[st.floats(0.01, 100)] * 3))
def test_gltf_lights_shine_the_way_and_as_much_as_they_do(
    direction: tuple[float, float, float], irradiance: tuple[float, float, float]
) -> None:
    light = Light(unit(*direction), irradiance)
    document = gltf_scene(LightModel(coefficients()[:1], (light,)))
    check_gltf(document)
    shines = turned(document["nodes"][0]["rotation"], (0, 0, -1))
    np.testing.assert_allclose(shines, [-value for value in light.direction], atol=1e-12)
    written = document["extensions"][EXTENSION]["lights"][0]
    assert [written["intensity"] * channel for channel in written["color"]] == pytest.approx(irradiance)


def test_gltf_is_read_by_another_reader(tmp_path: Path) -> None:
    pygltflib = pytest.importorskip("pygltflib", reason=READER.format("pygltflib"))
    write_lights(tmp_path / "a.gltf", decided(MODEL), tmp_path / "map.exr")
    read = pygltflib.GLTF2().load(str(tmp_path / "a.gltf"))
    assert len(read.nodes) == len(LIGHTS)
    lights = read.extensions[EXTENSION]["lights"]
    for node, light in zip(read.nodes, LIGHTS, strict=True):
        found = lights[node.extensions[EXTENSION]["light"]]
        assert [found["intensity"] * channel for channel in found["color"]] == pytest.approx(light.irradiance)
        np.testing.assert_allclose(turned(node.rotation, (0, 0, 1)), light.direction, atol=1e-12)


def test_gltf_refuses_a_full_map_and_names_what_comes_closest(tmp_path: Path) -> None:
    with pytest.raises(OptionError, match=r"within 0\.01 .* closest model is ambient with an error of 0\.4"):
        write_lights(tmp_path / "a.gltf", decided(None), tmp_path / "map.exr")
    assert not list(tmp_path.iterdir())


# --- USD ---------------------------------------------------------------------------------------------------------


@given(direction=directions)
def test_usd_lights_shine_the_way_they_do(direction: tuple[float, float, float]) -> None:
    light = Light(unit(*direction), (1.0, 2.0, 4.0), 3.0)
    text = usd_stage((light,), ambient=(1.0, 1.0, 1.0))
    numbers = re.search(r"matrix4d xformOp:transform = \( (.*) \)", text)
    assert numbers is not None
    matrix = np.array([float(value) for value in re.findall(r"[-+.\de]+", numbers[1])]).reshape(4, 4)
    # Numbers are written with nine digits.
    np.testing.assert_allclose(matrix[:3, :3] @ matrix[:3, :3].T, np.eye(3), atol=1e-8)
    assert np.linalg.det(matrix) == pytest.approx(1, abs=1e-7)
    np.testing.assert_allclose(np.array([0, 0, -1, 0]) @ matrix, [*(-value for value in light.direction), 0], atol=1e-8)
    assert "float inputs:angle = 6\n" in text
    assert "float inputs:intensity = 4\n" in text
    assert "color3f inputs:color = (0.25, 0.5, 1)\n" in text


def test_usd_shows_harmonics_as_a_texture_beside_the_stage(tmp_path: Path) -> None:
    stage, texture = write_lights(tmp_path / "a.usda", decided(MODEL), tmp_path / "map.exr")
    assert (stage.name, texture.name) == ("a.usda", "a.dome.exr")
    assert_close(read_envmap(texture), MODEL.background_map(64))
    assert "@./a.dome.exr@" in stage.read_text(encoding="utf-8")


def test_usd_refers_to_the_full_map_from_where_the_stage_is(tmp_path: Path) -> None:
    source = tmp_path / "maps" / "sky@noon.exr"
    (tmp_path / "maps").mkdir()
    (tmp_path / "stages").mkdir()
    write_exr(source, torch.ones(8, 16, 3), metadata={})
    (stage,) = write_lights(tmp_path / "stages" / "a.usda", decided(None), source)
    asset = re.search(r"asset inputs:texture:file = @@@(.*)@@@", stage.read_text(encoding="utf-8"))
    assert asset is not None
    assert (stage.parent / asset[1]).resolve() == source.resolve()


def test_usd_needs_no_texture_for_ambient_light(tmp_path: Path) -> None:
    model = LightModel(coefficients()[:1])
    (stage,) = write_lights(tmp_path / "a.usda", decided(model), tmp_path / "map.exr")
    text = stage.read_text(encoding="utf-8")
    assert "texture" not in text
    assert f"float inputs:intensity = {3 / math.sqrt(4 * math.pi):.9g}" in text


def test_usd_is_read_by_its_own_library(tmp_path: Path) -> None:
    pytest.importorskip("pxr", reason=READER.format("usd-core"))
    from pxr import Gf, Usd, UsdGeom, UsdLux

    stage_file, texture = write_lights(tmp_path / "a.usda", decided(MODEL), tmp_path / "map.exr")
    stage = Usd.Stage.Open(str(stage_file))
    assert UsdGeom.GetStageUpAxis(stage) == UsdGeom.Tokens.y
    cache = UsdGeom.XformCache()
    for index, light in enumerate(LIGHTS):
        prim = UsdLux.DistantLight(stage.GetPrimAtPath(f"/Light/Light{index + 1}"))
        shines = cache.GetLocalToWorldTransform(prim.GetPrim()).TransformDir(Gf.Vec3d(0, 0, -1))
        np.testing.assert_allclose(list(shines), [-value for value in light.direction], atol=1e-8)
        assert prim.GetNormalizeAttr().Get() is True
        assert prim.GetAngleAttr().Get() == pytest.approx(2 * (light.angular_radius or 0))
        shown = [prim.GetIntensityAttr().Get() * channel for channel in prim.GetColorAttr().Get()]
        assert shown == pytest.approx(light.irradiance)
    dome = UsdLux.DomeLight(stage.GetPrimAtPath("/Light/Dome"))
    assert dome.GetTextureFormatAttr().Get() == UsdLux.Tokens.latlong
    assert Path(dome.GetTextureFileAttr().Get().resolvedPath).resolve() == texture.resolve()
    # OpenEXR's latlong: latitude +π/2 at the top, longitude from +π at the left to -π; 0 is +Z and +π/2 is +X.
    world = cache.GetLocalToWorldTransform(dome.GetPrim())
    for u, v in ((0.5, 0.5), (0.25, 0.5), (0.7, 0.2)):
        longitude, latitude = math.pi * (1 - 2 * u), math.pi * (0.5 - v)
        local = Gf.Vec3d(
            math.cos(latitude) * math.sin(longitude), math.sin(latitude), math.cos(latitude) * math.cos(longitude)
        )
        ours = latlong_directions(200)[min(199, int(v * 200)), min(399, int(u * 400))]
        np.testing.assert_allclose(list(world.TransformDir(local)), ours.tolist(), atol=0.02)  # a pixel's half


# --- files -------------------------------------------------------------------------------------------------------


def test_other_suffixes_and_places_are_refused(tmp_path: Path) -> None:
    with pytest.raises(OptionError, match=r"export is 'a\.fbx'; accepted: a file named \.json, \.gltf, \.usda"):
        write_lights(tmp_path / "a.fbx", decided(MODEL), tmp_path / "map.exr")
    with pytest.raises(OutputError, match="does not exist"):
        write_lights(tmp_path / "missing" / "a.json", decided(MODEL), tmp_path / "map.exr")
    assert not list(tmp_path.iterdir())
