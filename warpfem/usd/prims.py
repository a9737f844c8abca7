"""The prims of a scene: one Xform per body with its tetrahedra and its surface, and the materials."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from pxr import Gf, Kind, Sdf, Tf, Usd, UsdGeom, UsdShade, Vt

from warpfem.errors import OutputError
from warpfem.usd.bodies import (
    BodyFrame,
    CellAverage,
    UsdBody,
    as_float32,
    cells_of_faces,
    in_space,
)
from warpfem.usd.colors import ColorQuantity, ColorScale
from warpfem.usd.normals import SurfaceNormals

WORLD = Sdf.Path("/World")
TETS, OBSTACLES = "simulation", "Obstacles"
LOOKS = WORLD.AppendChild("Looks")
PHYSICS = WORLD.AppendChild("Physics")
POINT_PRIMVARS: dict[ColorQuantity, str] = {"von_mises": "vonMisesPoint", "jacobian": "JPoint"}
CELL_PRIMVARS: dict[ColorQuantity, str] = {"von_mises": "vonMises", "jacobian": "J"}

_OBSTACLE_GREY = (0.35, 0.35, 0.37)
# Beyond this distance from the origin, in sizes of the body, float32 points would lose too much.
_FAR = 16.0


def prim_names(names: Iterable[str]) -> list[str]:
    """Valid prim names, unique among themselves and apart from those of warpfem's own prims."""
    taken, result = {LOOKS.name, PHYSICS.name, OBSTACLES}, []
    for name in names:
        stem = Tf.MakeValidIdentifier(name or "body")
        unique, count = stem, 1
        while unique in taken:
            count += 1
            unique = f"{stem}_{count}"
        taken.add(unique)
        result.append(unique)
    return result


def define_world(stage: Usd.Stage, up_axis: str, comment: str) -> None:
    """Authors the default prim, the stage's units, and the materials."""
    world = UsdGeom.Xform.Define(stage, WORLD).GetPrim()
    Usd.ModelAPI(world).SetKind(Kind.Tokens.component)
    stage.SetDefaultPrim(world)
    UsdGeom.SetStageUpAxis(stage, up_axis)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    stage.GetRootLayer().comment = comment

    UsdGeom.Scope.Define(stage, LOOKS)
    color = _material(stage, "Body").CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f)
    reader = UsdShade.Shader.Define(stage, LOOKS.AppendPath("Body/DisplayColor"))
    reader.CreateIdAttr("UsdPrimvarReader_float3")
    reader.CreateInput("varname", Sdf.ValueTypeNames.String).Set("displayColor")
    reader.CreateInput("fallback", Sdf.ValueTypeNames.Float3).Set(Gf.Vec3f(0.5))
    color.ConnectToSource(reader.CreateOutput("result", Sdf.ValueTypeNames.Float3))
    grey = _material(stage, "Obstacle").CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f)
    grey.Set(Gf.Vec3f(_OBSTACLE_GREY))


def paint_obstacle(prim: UsdGeom.Gprim) -> None:
    """Gives an obstacle its neutral colour."""
    prim.CreateDisplayColorAttr(Vt.Vec3fArray([Gf.Vec3f(_OBSTACLE_GREY)]))
    bind(prim.GetPrim(), "Obstacle")


def bind(prim: Usd.Prim, material: str) -> None:
    """Binds the material ``/World/Looks/<material>``."""
    looks = UsdShade.Material.Get(prim.GetStage(), LOOKS.AppendChild(material))
    UsdShade.MaterialBindingAPI.Apply(prim).Bind(looks)


def set_topology(mesh: UsdGeom.Mesh, faces: Iterable[np.ndarray]) -> None:
    """Authors polygons, without subdivision."""
    faces = list(faces)
    mesh.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.array([len(face) for face in faces], np.int32)))
    mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(np.concatenate(faces).astype(np.int32)))
    mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    mesh.CreateOrientationAttr(UsdGeom.Tokens.rightHanded)


def extent_of(points: np.ndarray) -> Vt.Vec3fArray:
    """The bounds of (n, 3) float32 points."""
    bounds = [(axis.min(), axis.max()) for axis in points.T]  # axis=0 of all three takes ten times as long
    return Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(np.transpose(bounds)))


def surface_name(body: str) -> str:
    """The name of a body's surface. Blender shows it alone, without the body's Xform."""
    return f"{body}_surface"


class BodyPrims:
    """The prims of one body: authored once at rest, then a source of samples, frame by frame.

    In 3D there is a ``TetMesh`` named ``simulation`` of purpose guide with every point, and beside it a
    ``Mesh`` named after the body with the points of the boundary only; in 2D there is just that surface.
    """

    def __init__(self, stage: Usd.Stage, name: str, body: UsdBody) -> None:
        """Defines the prims.

        Raises:
            OutputError: a surface face that is no face of any cell.
        """
        self.body = body
        self._average = CellAverage(np.asarray(body.rest_points, float), body.cells)
        used, faces = np.unique(body.surface_faces, return_inverse=True)
        self._used, self._faces = used, faces.reshape(-1, 3).astype(np.int32)
        self._owners = cells_of_faces(body)

        path = WORLD.AppendChild(name)
        root = UsdGeom.Xform.Define(stage, path)
        root.GetPrim().SetDisplayName(body.name)
        rest = in_space(body.rest_points)
        lower, upper = rest.min(axis=0), rest.max(axis=0)
        self._origin = np.zeros(3)
        if np.abs(lower + upper).max() > 2.0 * _FAR * (upper - lower).max():
            self._origin = 0.5 * (lower + upper)
            root.AddTranslateOp(UsdGeom.XformOp.PrecisionDouble).Set(Gf.Vec3d(*self._origin))

        self._tets = path.AppendChild(TETS) if body.cells.shape[1] == 4 else None
        self._surface = path.AppendChild(surface_name(name))
        if self._tets:
            tets = UsdGeom.TetMesh.Define(stage, self._tets)
            tets.CreatePurposeAttr(UsdGeom.Tokens.guide)
            tets.CreateOrientationAttr(UsdGeom.Tokens.rightHanded)
            tets.CreateTetVertexIndicesAttr(Vt.Vec4iArray.FromNumpy(body.cells.astype(np.int32)))
            tets.CreateSurfaceFaceVertexIndicesAttr(Vt.Vec3iArray.FromNumpy(body.surface_faces.astype(np.int32)))
            _create_primvars(tets)
        surface = UsdGeom.Mesh.Define(stage, self._surface)
        set_topology(surface, self._faces)
        surface.CreateDoubleSidedAttr(self._tets is None)
        self._normals = SurfaceNormals(rest[used], self._faces)
        if self._normals.creased:
            normals = UsdGeom.PrimvarsAPI(surface).CreatePrimvar(
                "normals", Sdf.ValueTypeNames.Normal3fArray, UsdGeom.Tokens.faceVarying
            )
            normals.SetIndices(Vt.IntArray.FromNumpy(self._normals.indices.ravel()))
        else:
            surface.CreateNormalsAttr()
            surface.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
        surface.CreateDisplayColorPrimvar(UsdGeom.Tokens.vertex)
        _create_primvars(surface)
        bind(surface.GetPrim(), "Body")

        cell_count = len(body.cells)
        self.rest = BodyFrame(
            body.rest_points, np.zeros_like(body.rest_points), np.zeros(cell_count), np.ones(cell_count)
        )

    def check(self, frame: BodyFrame, where: str) -> None:
        """Checks the shapes of a frame.

        Raises:
            OutputError: names ``where``, the body, the array and the shape it should have.
        """
        points, cells = np.shape(self.body.rest_points), (len(self.body.cells),)
        expected = {"points": points, "velocities": points, "von_mises": cells, "jacobian": cells}
        for field, shape in expected.items():
            if np.shape(getattr(frame, field)) != shape:
                raise OutputError(
                    f"{where}, body {self.body.name!r}: {field} must have shape {shape}, "
                    f"not {np.shape(getattr(frame, field))}"
                )

    def samples(self, frame: BodyFrame, where: str) -> dict[Sdf.Path, Any]:
        """The values of everything that moves but the colours.

        Raises:
            OutputError: a value that is not finite in float32; names ``where``, the body and the index.
        """
        label = f"{where}, body {self.body.name!r}"
        points = as_float32(f"{label}, points", in_space(frame.points) - self._origin)
        velocities = as_float32(f"{label}, velocities", in_space(frame.velocities))
        cells: dict[ColorQuantity, np.ndarray] = {
            "von_mises": as_float32(f"{label}, von_mises", frame.von_mises),
            "jacobian": as_float32(f"{label}, jacobian", frame.jacobian),
        }
        averages = {quantity: self._average(values) for quantity, values in cells.items()}

        surface_points = points[self._used]
        result = _point_based(self._surface, surface_points, velocities[self._used])
        name = "primvars:normals" if self._normals.creased else "normals"
        result[self._surface.AppendProperty(name)] = Vt.Vec3fArray.FromNumpy(self._normals(surface_points))
        for quantity in cells:
            result |= _primvar(self._surface, CELL_PRIMVARS[quantity], cells[quantity][self._owners])
            result |= _primvar(self._surface, POINT_PRIMVARS[quantity], averages[quantity][self._used])
        if self._tets:
            result |= _point_based(self._tets, points, velocities)
            for quantity in cells:
                result |= _primvar(self._tets, CELL_PRIMVARS[quantity], cells[quantity])
                result |= _primvar(self._tets, POINT_PRIMVARS[quantity], averages[quantity])
        return result

    @property
    def simulation(self) -> Sdf.Path | None:
        """The ``TetMesh``, if there is one."""
        return self._tets

    def surface_attribute(self, quantity: ColorQuantity) -> Sdf.Path:
        """The attribute of the point values on the surface."""
        return self._surface.AppendProperty(f"primvars:{POINT_PRIMVARS[quantity]}")

    def colors(self, samples: dict[Sdf.Path, Any], scale: ColorScale) -> dict[Sdf.Path, Any]:
        """The sample of the colours that belongs to the samples of a frame."""
        colors = scale.linear(np.asarray(samples[self.surface_attribute(scale.quantity)]))
        return {self._surface.AppendProperty("primvars:displayColor"): Vt.Vec3fArray.FromNumpy(colors)}


def _material(stage: Usd.Stage, name: str) -> UsdShade.Shader:
    path = LOOKS.AppendChild(name)
    material = UsdShade.Material.Define(stage, path)
    shader = UsdShade.Shader.Define(stage, path.AppendChild("Preview"))
    shader.CreateIdAttr("UsdPreviewSurface")
    shader.CreateInput("roughness", Sdf.ValueTypeNames.Float).Set(0.6)
    material.CreateSurfaceOutput().ConnectToSource(shader.CreateOutput("surface", Sdf.ValueTypeNames.Token))
    return shader


def _create_primvars(prim: UsdGeom.PointBased) -> None:
    primvars = UsdGeom.PrimvarsAPI(prim)
    for names, interpolation in ((CELL_PRIMVARS, "uniform"), (POINT_PRIMVARS, "vertex")):
        for name in names.values():
            primvars.CreatePrimvar(name, Sdf.ValueTypeNames.FloatArray, interpolation)


def _point_based(path: Sdf.Path, points: np.ndarray, velocities: np.ndarray) -> dict[Sdf.Path, Any]:
    return {
        path.AppendProperty("points"): Vt.Vec3fArray.FromNumpy(points),
        path.AppendProperty("velocities"): Vt.Vec3fArray.FromNumpy(velocities),
        path.AppendProperty("extent"): extent_of(points),
    }


def _primvar(path: Sdf.Path, name: str, values: np.ndarray) -> dict[Sdf.Path, Any]:
    return {path.AppendProperty(f"primvars:{name}"): Vt.FloatArray.FromNumpy(values)}
