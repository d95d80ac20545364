"""USD layers read back through usd-core's own stage."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import soundfile
from pxr import Usd, UsdGeom, UsdMedia, UsdShade, UsdValidation

from facediff.animation import Animation
from facediff.export import ExportOptions, write_animations


@pytest.mark.parametrize("suffix", [".usdc", ".usda"])
def test_usd_gives_back_every_vertex_of_every_frame(animation: Animation, tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"a{suffix}"
    assert write_animations(path, [animation]) == [path, tmp_path / "a.wav"]
    stage = Usd.Stage.Open(str(path))
    root = stage.GetDefaultPrim()
    assert (stage.GetTimeCodesPerSecond(), stage.GetStartTimeCode(), stage.GetEndTimeCode()) == (30, 0, 39)
    assert (UsdGeom.GetStageMetersPerUnit(stage), UsdGeom.GetStageUpAxis(stage)) == (1, "Y")
    mesh = UsdGeom.Mesh(root.GetChild("face"))
    assert mesh.GetSubdivisionSchemeAttr().Get() == "none"
    assert list(mesh.GetFaceVertexCountsAttr().Get()) == [3] * 320
    np.testing.assert_array_equal(np.reshape(mesh.GetFaceVertexIndicesAttr().Get(), (-1, 3)), animation.triangles)
    points = mesh.GetPointsAttr()
    assert points.GetTimeSamples() == list(range(40))
    np.testing.assert_array_equal(points.Get(), animation.template)
    for index in range(40):
        np.testing.assert_array_equal(points.Get(index), animation.vertices[index])
        low, high = mesh.GetExtentAttr().Get(index)
        np.testing.assert_array_equal(low, animation.vertices[index].min(0))
        np.testing.assert_array_equal(high, animation.vertices[index].max(0))
        normals = np.array(mesh.GetNormalsAttr().Get(index))
        assert ((normals * (animation.vertices[index] - animation.vertices[index].mean(0))).sum(-1) > 0).all()
    assert mesh.GetNormalsInterpolation() == "vertex"
    np.testing.assert_allclose(points.Get(6.5), (animation.vertices[6] + animation.vertices[7]) / 2, atol=1e-7)


def test_usd_metadata_colours_and_sound(animation: Animation, tmp_path: Path) -> None:
    write_animations(tmp_path / "a.usdc", [animation])
    stage = Usd.Stage.Open(str(tmp_path / "a.usdc"))
    data = stage.GetRootLayer().customLayerData["facediff"]
    assert data["metadata"] == {"identity": "Zoë", "style": "F1_e01"}
    assert (data["name"], data["frame_rate"], data["unit"]) == ("Hello Zoë", 30.0, "m")
    colour = UsdGeom.PrimvarsAPI(stage.GetDefaultPrim().GetChild("face")).GetPrimvar("displayColor")
    share = animation.colours / 255  # type: ignore[operator]
    linear = np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)  # IEC 61966-2-1
    np.testing.assert_allclose(colour.Get(), linear, atol=1e-6)
    assert colour.GetInterpolation() == "vertex"
    bound = UsdShade.MaterialBindingAPI(stage.GetDefaultPrim().GetChild("face")).ComputeBoundMaterial()[0]
    (source,), _ = bound.ComputeSurfaceSource()[0].GetInput("diffuseColor").GetConnectedSources()
    assert UsdShade.Shader(source.source.GetPrim()).GetInput("varname").Get() == "displayColor"
    sound = UsdMedia.SpatialAudio(stage.GetDefaultPrim().GetChild("speech"))
    assert Path(sound.GetFilePathAttr().Get().resolvedPath) == tmp_path / "a.wav"
    assert (sound.GetStartTimeAttr().Get(), sound.GetAuralModeAttr().Get()) == (0, "nonSpatial")
    samples, rate = soundfile.read(tmp_path / "a.wav", dtype="float32")
    assert rate == 16_000
    np.testing.assert_array_equal(samples[:20_000], animation.speech)
    assert len(samples) == round(40 / 30 * 16_000)
    assert not samples[20_000:].any()


@pytest.mark.parametrize("suffix", [".usdc", ".usda"])
def test_usd_metadata_may_hold_any_text(make_animation: Callable[..., Animation], tmp_path: Path, suffix: str) -> None:
    words = {"a b:c": 'say "ü"\n\\ twice', "": "", "1": "{}"}
    write_animations(tmp_path / f"a{suffix}", [make_animation(name='1 "q" / é', metadata=words)])
    stage = Usd.Stage.Open(str(tmp_path / f"a{suffix}"))
    data = stage.GetRootLayer().customLayerData["facediff"]
    assert data["metadata"] == words
    assert data["name"] == '1 "q" / é'
    assert len(UsdGeom.Mesh(stage.GetDefaultPrim().GetChild("face")).GetPointsAttr().Get(0)) == 162


def test_usd_layer_is_valid(animation: Animation, tmp_path: Path) -> None:
    write_animations(tmp_path / "a.usdc", [animation])
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    assert len(validators) > 10
    stage = Usd.Stage.Open(str(tmp_path / "a.usdc"))
    found = UsdValidation.ValidationContext(validators).Validate(stage)
    assert [error.GetErrorAsString() for error in found] == []


def test_usd_in_another_unit_with_z_up(make_animation: Callable[..., Animation], tmp_path: Path) -> None:
    animation = make_animation(unit="mm", speech=None)
    options = ExportOptions(output_unit="cm", up="z")
    assert write_animations(tmp_path / "a.usda", [animation], options) == [tmp_path / "a.usda"]
    stage = Usd.Stage.Open(str(tmp_path / "a.usda"))
    assert (UsdGeom.GetStageMetersPerUnit(stage), UsdGeom.GetStageUpAxis(stage)) == (0.01, "Z")
    points = np.array(UsdGeom.Mesh(stage.GetDefaultPrim().GetChild("face")).GetPointsAttr().Get(3))
    turn = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])  # +90 degrees about x
    np.testing.assert_allclose(points, animation.vertices[3] @ turn.T / 10, rtol=1e-6)
    assert not stage.GetDefaultPrim().GetChild("speech")
