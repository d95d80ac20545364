"""Universal Scene Description: a mesh with points for every frame, and a sound that refers to the .wav file."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from facediff.animation import Animation
from facediff.animation.options import ExportOptions
from facediff.errors import FaceDiffError, needs_extra
from facediff.export.format import FileSpace, Format, facts, linear_colours, normals_of, outward, surface_of
from facediff.registry import export_format


class Usd(Format):
    """USD: a mesh with points for every frame; USD itself writes text or binary data, as the suffix says."""

    next_step = "Blender: File > Import > USD; other programs: docs/export.md"
    speech = "next to it"
    requires = ("pxr", "usd")
    uses = ("surface",)

    def write(self, path: Path, animations: Sequence[Animation], options: ExportOptions) -> None:
        """Write one animation; frame t is time code t."""
        with needs_extra("pxr", "usd", "writing USD"):
            from pxr import Sdf, Tf, Usd, UsdGeom, UsdMedia, Vt
        (animation,) = animations
        space = FileSpace.of(animation, options)
        stage = Usd.Stage.CreateInMemory()
        UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z if space.up == "z" else UsdGeom.Tokens.y)
        UsdGeom.SetStageMetersPerUnit(stage, space.metres)
        stage.SetTimeCodesPerSecond(animation.frame_rate)
        stage.SetFramesPerSecond(animation.frame_rate)
        stage.SetStartTimeCode(0)
        stage.SetEndTimeCode(len(animation.vertices) - 1)
        root = Sdf.Path(f"/{Tf.MakeValidIdentifier(animation.name)}")
        stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, root).GetPrim())
        data: dict[str, Any] = facts(animation, space)
        if options.speech_file is not None:
            # The speech, from the first frame on, equally loud wherever the listener stands. The start is time code 0
            # by default. Writing it would mark the file as a newer version than old readers know.
            sound = UsdMedia.SpatialAudio.Define(stage, root.AppendChild("speech"))
            sound.CreateFilePathAttr(Sdf.AssetPath(f"./{options.speech_file}"))
            sound.CreateAuralModeAttr(UsdMedia.Tokens.nonSpatial)
            sound.CreatePlaybackModeAttr(UsdMedia.Tokens.onceFromStart)
            data["speech"] = options.speech_file
        layer = stage.GetRootLayer()
        layer.customLayerData = {"facediff": data}
        layer.documentation = f"{animation.name}, written by facediff"
        try:
            mesh = _add_face(stage, root.AppendChild("face"), animation, space)
            if (surface := surface_of(animation, options)) is not None:
                corners = surface.uvs[surface.turned(animation.triangles, outward(animation))].reshape(-1, 2)
                kind, rate = Sdf.ValueTypeNames.TexCoord2fArray, UsdGeom.Tokens.faceVarying
                coordinates = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar("st", kind, rate)
                coordinates.Set(Vt.Vec2fArray.FromNumpy(np.ascontiguousarray(corners, np.float32)))
            written, cause = layer.Export(str(path)), None
        except Tf.ErrorException as error:
            written, cause = False, error
        if not written:
            raise FaceDiffError(f"{path}: cannot be written; check whether the disk is full") from cause


@export_format.register("usdc")
class BinaryUsd(Usd):
    """USD, binary: a mesh with points for every frame."""


@export_format.register("usda")
class TextUsd(Usd):
    """USD, text: a mesh with points for every frame."""


def _add_face(stage: Any, path: Any, animation: Animation, space: FileSpace) -> Any:  # noqa: ANN401 - usd-core has no type hints
    """A polygon mesh without subdivision, with points, normals and extent of every frame."""
    from pxr import Sdf, UsdGeom, Vt

    mesh = UsdGeom.Mesh.Define(stage, path)
    faces = outward(animation)
    mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    mesh.CreateDoubleSidedAttr(True)
    mesh.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(faces), 3, np.int32)))
    mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(np.ascontiguousarray(faces.ravel())))
    points, normals, extent = mesh.CreatePointsAttr(), mesh.CreateNormalsAttr(), mesh.CreateExtentAttr()
    mesh.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
    for time, frame in enumerate([space.place(animation.template), *space.frames(animation)], start=-1):
        when = [] if time < 0 else [time]  # the default value is the neutral face
        points.Set(Vt.Vec3fArray.FromNumpy(frame), *when)
        normals.Set(Vt.Vec3fArray.FromNumpy(normals_of(frame, faces)), *when)
        extent.Set(Vt.Vec3fArray.FromNumpy(np.stack([frame.min(0), frame.max(0)])), *when)
    if animation.colours is not None:
        colour = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar(
            "displayColor", Sdf.ValueTypeNames.Color3fArray, UsdGeom.Tokens.vertex
        )
        colour.Set(Vt.Vec3fArray.FromNumpy(linear_colours(animation.colours)))
        _colour_by_vertices(stage, path, mesh)
    return mesh


def _colour_by_vertices(stage: Any, path: Any, mesh: Any) -> None:  # noqa: ANN401
    """A material that shows the display colours: renderers other than previews ignore colours without one."""
    from pxr import Sdf, UsdShade

    material = UsdShade.Material.Define(stage, path.AppendChild("skin"))
    reader = UsdShade.Shader.Define(stage, material.GetPath().AppendChild("colours"))
    reader.CreateIdAttr("UsdPrimvarReader_float3")
    reader.CreateInput("varname", Sdf.ValueTypeNames.String).Set("displayColor")
    surface = UsdShade.Shader.Define(stage, material.GetPath().AppendChild("surface"))
    surface.CreateIdAttr("UsdPreviewSurface")
    surface.CreateInput("roughness", Sdf.ValueTypeNames.Float).Set(0.7)
    colours = reader.CreateOutput("result", Sdf.ValueTypeNames.Float3)
    surface.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f).ConnectToSource(colours)
    material.CreateSurfaceOutput().ConnectToSource(surface.CreateOutput("surface", Sdf.ValueTypeNames.Token))
    UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim()).Bind(material)
