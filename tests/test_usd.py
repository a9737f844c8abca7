"""USD output and input: what two readers and the validators find in the files, also after a kill."""

from __future__ import annotations

import itertools
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from pxr import Gf, Sdf, Usd, UsdGeom, UsdShade, UsdValidation, Vt

from warpfem.boundary import Box, BoxWalls, Plane, Sphere
from warpfem.errors import MeshError, OutputError
from warpfem.mesh import Mesh
from warpfem.meshing import load_mesh
from warpfem.usd import (
    BodyFrame,
    ColorScale,
    UsdBody,
    UsdWriter,
    animation,
    read_animation,
    read_mesh,
    read_pictured_stage,
    read_surface_mesh,
)
from warpfem.usd.normals import SurfaceNormals

REPOSITORY = Path(__file__).parent.parent
OBSTACLES = {
    2: (
        Plane((0.0, -1.0), (0.3, 1.0)),
        Sphere((2.0, 0.0), 0.5),
        Box((2.0, 1.0), (0.5, 0.3), ((1.0, 1.0), (1.0, -1.0))),
        BoxWalls((-1.0, -1.0), (3.0, 3.0)),
    ),
    3: (
        Plane((0, -1, 0), (0, 1, 0.2)),
        Sphere((2, 0, 0), 0.5),
        Box((2, 1, 0), (0.5, 0.3, 0.2), ((1, 1, 0), (1, -1, 0), (0, 0, 1))),
        BoxWalls((-1, -1, -1), (3, 3, 3)),
    ),
}
SETUPS = [pytest.param(2, id="2D"), pytest.param(3, id="3D")]


def make_body(dim: int, name: str = "block", cells: int = 3, offset: float = 0.0) -> UsdBody:
    sizes, counts, origin = (1.0, 0.7, 0.4)[:dim], (cells,) * dim, (offset,) * dim
    mesh = Mesh.box(sizes, counts, origin) if dim == 3 else Mesh.rectangle(sizes, counts, origin)
    return UsdBody(name, mesh.points, mesh.cells, mesh.boundary_faces if dim == 3 else mesh.cells)


def make_frame(body: UsdBody, index: int) -> BodyFrame:
    """A frame that differs in every number from those of other indices."""
    rng = np.random.default_rng(index)
    points = np.asarray(body.rest_points)
    count = len(body.cells)
    return BodyFrame(
        points=points + 0.01 * (index + 1) * rng.normal(size=points.shape),
        velocities=rng.normal(size=points.shape),
        von_mises=1e6 * rng.random(count) / (index + 1),
        jacobian=1.0 + 0.2 * (index + 1) * (rng.random(count) - 0.5),
    )


def write(path: Path, bodies: list[UsdBody], frame_count: int, **settings) -> list[list[BodyFrame]]:
    frames = [[make_frame(body, index) for body in bodies] for index in range(frame_count)]
    with UsdWriter(path, bodies, fps=25.0, **settings) as writer:
        for frame in frames:
            writer.write_frame(frame)
    return frames


def lifted(vectors: np.ndarray) -> np.ndarray:
    return np.pad(vectors, ((0, 0), (0, 3 - vectors.shape[1])))


def attribute(stage: Usd.Stage, path: str, code: float | None = None) -> np.ndarray:
    value = stage.GetAttributeAtPath(path)
    return np.array(value.Get() if code is None else value.Get(code))


def normals_of(mesh: UsdGeom.PointBased, code: float | None) -> tuple[np.ndarray, str]:
    """The normals of a surface and what they belong to, as USD's rules have it: the primvar before the attribute."""
    time = Usd.TimeCode.Default() if code is None else code
    primvar = UsdGeom.PrimvarsAPI(mesh).GetPrimvar("normals")
    if primvar:
        return np.array(primvar.ComputeFlattened(time)), primvar.GetInterpolation()
    return np.array(mesh.GetNormalsAttr().Get(time)), mesh.GetNormalsInterpolation()


def validation_errors(stage: Usd.Stage) -> list[str]:
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    errors = UsdValidation.ValidationContext(validators).Validate(stage)
    return [f"{error.GetName()}: {error.GetMessage()}" for error in errors]


def assert_sound(path: Path, frame_count: int) -> None:
    """What the validators miss: extents, time range, indices, lengths of primvars, numbers that are not."""
    stage = Usd.Stage.Open(str(path))
    assert validation_errors(stage) == []
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode()) == (0.0, max(frame_count - 1.0, 0.0))
    codes = [float(code) for code in range(frame_count)]
    prims = [prim for prim in stage.Traverse() if prim.IsA(UsdGeom.PointBased)]
    assert prims
    for prim in prims:
        mesh = UsdGeom.PointBased(prim)
        moves = not prim.GetPath().HasPrefix("/World/Obstacles")
        point_count = len(mesh.GetPointsAttr().Get())
        if prim.IsA(UsdGeom.TetMesh):
            indices = np.array(UsdGeom.TetMesh(prim).GetTetVertexIndicesAttr().Get())
            face_count, corner_count = len(indices), 0
        else:
            counts = np.array(UsdGeom.Mesh(prim).GetFaceVertexCountsAttr().Get())
            indices = np.array(UsdGeom.Mesh(prim).GetFaceVertexIndicesAttr().Get())
            face_count, corner_count = len(counts), counts.sum()
            assert len(indices) == corner_count
        assert indices.min() == 0 and indices.max() == point_count - 1
        sizes = {"vertex": point_count, "uniform": face_count, "faceVarying": corner_count, "constant": 1}
        for code in [None, *(codes if moves else [])]:
            points = attribute(stage, f"{prim.GetPath()}.points", code)
            extent = attribute(stage, f"{prim.GetPath()}.extent", code)
            assert len(points) == point_count and np.isfinite(points).all()
            assert np.array_equal(extent, [points.min(axis=0), points.max(axis=0)])
            if not prim.IsA(UsdGeom.TetMesh):
                normals, interpolation = normals_of(mesh, code)
                assert len(normals) == sizes[interpolation]
                assert np.linalg.norm(normals, axis=1) == pytest.approx(1.0, abs=1e-5)
            for primvar in UsdGeom.PrimvarsAPI(prim).GetPrimvarsWithAuthoredValues():
                values = np.array(primvar.ComputeFlattened(Usd.TimeCode.Default() if code is None else code))
                assert np.isfinite(values).all()
                assert len(values) == sizes[primvar.GetInterpolation()]
        animated = [item for item in prim.GetAuthoredAttributes() if item.GetNumTimeSamples()]
        assert all(item.GetTimeSamples() == codes for item in animated)
        names = {item.GetName() for item in animated}
        expected = {"points", "velocities", "extent"} if moves and frame_count else set()
        assert expected <= names and bool(names) == bool(expected)


@pytest.mark.parametrize("suffix", [".usdc", ".usda", ".usd"])
@pytest.mark.parametrize("dim", SETUPS)
def test_a_file_is_sound(tmp_path: Path, dim: int, suffix: str) -> None:
    path = tmp_path / f"run{suffix}"
    bodies = [make_body(dim), make_body(dim, "block", cells=2, offset=1e6)]
    write(path, bodies, 11, obstacles=OBSTACLES[dim], frames_per_chunk=4, up_axis="Z", comment="a run")
    assert [item.name for item in tmp_path.iterdir()] == [path.name]
    assert_sound(path, 11)

    stage = Usd.Stage.Open(str(path))
    assert stage.GetDefaultPrim().GetPath() == "/World"
    assert Usd.ModelAPI(stage.GetDefaultPrim()).GetKind() == "component"
    assert stage.GetFramesPerSecond() == stage.GetTimeCodesPerSecond() == 25.0
    assert stage.HasAuthoredMetadata("metersPerUnit") and UsdGeom.GetStageMetersPerUnit(stage) == 1.0
    assert UsdGeom.GetStageUpAxis(stage) == "Z"
    assert stage.GetRootLayer().comment == "a run"
    children = [child.GetName() for child in stage.GetDefaultPrim().GetChildren()]
    assert children == ["Looks", "block", "block_2", "Obstacles"]
    for name in ("block", "block_2"):
        tets = UsdGeom.TetMesh.Get(stage, f"/World/{name}/simulation")
        assert bool(tets) == (dim == 3)
        if tets:
            assert tets.GetPurposeAttr().Get() == "guide" and tets.GetOrientationAttr().Get() == "rightHanded"
        surface = UsdGeom.Mesh.Get(stage, f"/World/{name}/{name}_surface")
        assert surface.GetSubdivisionSchemeAttr().Get() == "none"
        assert surface.GetDoubleSidedAttr().Get() == (dim == 2)
        assert surface.GetDisplayColorPrimvar().GetInterpolation() == "vertex"
        material, _ = UsdShade.MaterialBindingAPI(surface).ComputeBoundMaterial()
        shader, _, _ = material.ComputeSurfaceSource()
        assert shader.GetIdAttr().Get() == "UsdPreviewSurface"
        source = shader.GetInput("diffuseColor").GetConnectedSources()[0][0].source
        reader = UsdShade.Shader(source.GetPrim())
        assert reader.GetIdAttr().Get() == "UsdPrimvarReader_float3"
        assert reader.GetInput("varname").Get() == "displayColor"


def test_the_validators_are_awake(tmp_path: Path) -> None:
    write(tmp_path / "run.usdc", [make_body(3)], 1)
    stage = Usd.Stage.Open(str(tmp_path / "run.usdc"))
    stage.ClearMetadata("metersPerUnit")
    UsdGeom.Mesh.Define(stage, "/World/block/block_surface/nested")
    assert len(validation_errors(stage)) >= 2


@pytest.mark.parametrize("dim", SETUPS)
def test_values_are_those_given_to_the_last_bit(tmp_path: Path, dim: int) -> None:
    body = make_body(dim)
    frames = write(tmp_path / "run.usdc", [body], 5, frames_per_chunk=2)
    stage = Usd.Stage.Open(str(tmp_path / "run.usdc"))
    used = np.unique(body.surface_faces)
    faces = attribute(stage, "/World/block/block_surface.faceVertexIndices").reshape(-1, 3)
    assert np.array_equal(used[faces], body.surface_faces)
    prims = {"block_surface": used} | ({"simulation": np.arange(len(body.rest_points))} if dim == 3 else {})
    for prim, points in prims.items():
        path = f"/World/block/{prim}"
        rest = lifted(body.rest_points)[points].astype(np.float32)
        assert np.array_equal(attribute(stage, f"{path}.points"), rest)
        assert not attribute(stage, f"{path}.velocities").any()
        for index, (frame,) in enumerate(frames):
            expected = lifted(frame.points)[points].astype(np.float32)
            assert np.array_equal(attribute(stage, f"{path}.points", index), expected)
            velocities = lifted(frame.velocities)[points].astype(np.float32)
            assert np.array_equal(attribute(stage, f"{path}.velocities", index), velocities)
    if dim == 3:
        for index, (frame,) in enumerate(frames):
            for name, values in (("vonMises", frame.von_mises), ("J", frame.jacobian)):
                found = attribute(stage, f"/World/block/simulation.primvars:{name}", index)
                assert np.array_equal(found, values.astype(np.float32))
        assert np.array_equal(attribute(stage, "/World/block/simulation.tetVertexIndices"), body.cells)


@pytest.mark.parametrize("dim", SETUPS)
def test_a_second_reader_finds_the_same(tmp_path: Path, dim: int) -> None:
    tinyusdz = pytest.importorskip("tinyusdz")
    body = make_body(dim)
    frames = write(tmp_path / "run.usdc", [body], 5, frames_per_chunk=2)
    stage = tinyusdz.load(str(tmp_path / "run.usdc"))
    keys = ("framesPerSecond", "timeCodesPerSecond", "startTimeCode", "endTimeCode", "metersPerUnit")
    assert [stage.get_metadata(key) for key in keys] == [25.0, 25.0, 0.0, 4.0, 1.0]
    assert stage.get_default_prim() == "World"
    surface = stage.get_prim_at_path("/World/block/block_surface")
    used = np.unique(body.surface_faces)
    faces = np.asarray(surface.get_attribute("faceVertexIndices").value).reshape(-1, 3)
    assert np.array_equal(used[faces], body.surface_faces)
    for name in ("points", "velocities"):
        samples = surface.get_attribute_timesamples(name)
        assert [code for code, _ in samples] == [0.0, 1.0, 2.0, 3.0, 4.0]
        for (_, values), (frame,) in zip(samples, frames, strict=True):
            expected = lifted(getattr(frame, name))[used].astype(np.float32)
            assert np.array_equal(np.asarray(values), expected)
    if dim == 3:
        text = stage.export_to_string()
        tets = text[text.index('TetMesh "simulation"') :]
        samples = tets[tets.index("points.timeSamples") :].splitlines()[1:6]
        for index, (line, (frame,)) in enumerate(zip(samples, frames, strict=True)):
            code, values = line.split(":")
            values = np.array(re.findall(r"[^\s,()\[\]]+", values), np.float32).reshape(-1, 3)
            assert float(code) == index and np.array_equal(values, frame.points.astype(np.float32))


def test_primvars_are_averaged_by_volume_and_taken_from_the_owner(tmp_path: Path) -> None:
    """Two tetrahedra of volumes 1/6 and 1/3 that share the face (1, 2, 3)."""
    points = np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 1, 1)], float)
    cells = np.array([(0, 1, 2, 3), (1, 2, 3, 4)], np.int32)
    faces = np.array([(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 4), (2, 3, 4), (1, 4, 3)], np.int32)
    body = UsdBody("pair", points, cells, faces)
    with UsdWriter(tmp_path / "pair.usdc", [body], fps=24) as writer:
        writer.write_frame([BodyFrame(points, 0 * points, np.array([3.0, 9.0]), np.array([0.5, 2.0]))])
    stage = Usd.Stage.Open(str(tmp_path / "pair.usdc"))
    expected = {
        "vonMisesPoint": [3, 7, 7, 7, 9],
        "JPoint": [0.5, 1.5, 1.5, 1.5, 2],
        "vonMises": [3, 3, 3, 9, 9, 9],
        "J": [0.5, 0.5, 0.5, 2, 2, 2],
    }
    for name, values in expected.items():
        assert attribute(stage, f"/World/pair/pair_surface.primvars:{name}", 0) == pytest.approx(values)
    assert attribute(stage, "/World/pair/simulation.primvars:vonMises", 0) == pytest.approx([3, 9])
    assert not attribute(stage, "/World/pair/pair_surface.primvars:vonMises").any()
    assert (attribute(stage, "/World/pair/pair_surface.primvars:J") == 1.0).all()


def test_normals_point_outwards_and_turn_with_the_body(tmp_path: Path) -> None:
    body = make_body(3)
    turn = np.array([(0.0, -1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0)])
    cells = np.ones(len(body.cells))
    turned = BodyFrame(body.rest_points @ turn.T, 0 * body.rest_points, cells, cells)
    with UsdWriter(tmp_path / "run.usdc", [body], fps=24) as writer:
        writer.write_frame([turned])
    stage = Usd.Stage.Open(str(tmp_path / "run.usdc"))
    surface = UsdGeom.Mesh.Get(stage, "/World/block/block_surface")
    normals, interpolation = normals_of(surface, None)
    assert interpolation == "faceVarying"
    corners = np.array(surface.GetPointsAttr().Get())[np.array(surface.GetFaceVertexIndicesAttr().Get())]
    a, b, c = corners.reshape(-1, 3, 3).transpose(1, 0, 2)
    flat = np.cross(b - a, c - a)
    flat /= np.linalg.norm(flat, axis=1, keepdims=True)
    assert normals == pytest.approx(np.repeat(flat, 3, axis=0), abs=1e-6)  # each side of a box is flat
    assert normals_of(surface, 0)[0] == pytest.approx(normals @ turn.T, abs=1e-6)


def test_round_surfaces_have_one_normal_for_each_point(tmp_path: Path) -> None:
    polar, around = np.linspace(0.0, np.pi, 13)[1:-1, None], np.linspace(0.0, 2 * np.pi, 24, endpoint=False)
    circles = np.sin(polar) * np.cos(around), np.sin(polar) * np.sin(around), np.cos(polar) + 0 * around
    points = np.concatenate([np.stack(circles, axis=-1).reshape(-1, 3), [(0.0, 0.0, 1.0), (0.0, 0.0, -1.0)]])
    grid = np.arange(11 * 24).reshape(11, 24)
    after, (top, bottom) = np.roll(grid, -1, axis=1), np.repeat([[264], [265]], 24, axis=1)
    corners = [(grid[:-1], grid[1:], after[1:]), (grid[:-1], after[1:], after[:-1])]
    corners += [(top, grid[0], after[0]), (bottom, after[-1], grid[-1])]
    faces = np.concatenate([np.stack(parts, axis=-1).reshape(-1, 3) for parts in corners])
    smooth = SurfaceNormals(points, faces)
    assert not smooth.creased and np.array_equal(smooth.indices, faces)
    assert np.einsum("ij,ij->i", smooth(points), points).min() > 0.99
    flattened = points * (1.0, 1.0, 0.01)  # a disc with a rim
    assert SurfaceNormals(flattened, faces).creased


@pytest.mark.parametrize("dim", SETUPS)
def test_a_body_far_away_keeps_its_precision(tmp_path: Path, dim: int) -> None:
    near, far = make_body(dim, "near"), make_body(dim, "far", offset=1e7)
    frames = write(tmp_path / "run.usdc", [near, far], 3)
    stage = Usd.Stage.Open(str(tmp_path / "run.usdc"))
    assert not UsdGeom.Xformable.Get(stage, "/World/near").GetOrderedXformOps()
    (translate,) = UsdGeom.Xformable.Get(stage, "/World/far").GetOrderedXformOps()
    assert translate.GetPrecision() == UsdGeom.XformOp.PrecisionDouble
    animation = read_animation(tmp_path / "run.usdc")
    assert np.abs(animation.bodies[1].rest_points - lifted(far.rest_points)).max() < 1e-7
    for index in range(3):
        assert np.abs(animation.frame(index)[1].points - lifted(frames[index][1].points)).max() < 1e-7


@pytest.mark.parametrize("dim", SETUPS)
def test_read_animation_gives_back_what_was_written(tmp_path: Path, dim: int) -> None:
    bodies = [make_body(dim, "Körper 1"), make_body(dim, "", cells=2, offset=1.5)]
    frames = write(tmp_path / "run.usdc", bodies, 4, obstacles=OBSTACLES[dim])
    animation = read_animation(tmp_path / "run.usdc")
    assert (animation.fps, animation.frame_count, animation.up_axis) == (25.0, 4, "Y")
    assert [body.name for body in animation.bodies] == ["Körper 1", ""]
    for number, (read, given) in enumerate(zip(animation.bodies, bodies, strict=True)):
        assert np.array_equal(read.cells, given.cells)
        assert np.array_equal(read.surface_faces, given.surface_faces)
        assert read.rest_points == pytest.approx(lifted(given.rest_points), abs=1e-6)
        for index in range(4):
            frame = animation.frame(index)[number]
            assert np.array_equal(frame.points, lifted(frames[index][number].points).astype(np.float32))
            assert frame.von_mises == pytest.approx(frames[index][number].von_mises, rel=1e-6)
            assert frame.jacobian == pytest.approx(frames[index][number].jacobian, rel=1e-6)
    for index in (-1, 4):
        with pytest.raises(IndexError):
            animation.frame(index)


def test_an_output_is_a_mesh_again(tmp_path: Path) -> None:
    body = make_body(3)
    write(tmp_path / "run.usdc", [body], 2, obstacles=OBSTACLES[3])
    mesh = load_mesh(tmp_path / "run.usdc")
    assert np.array_equal(mesh.cells, body.cells)
    assert np.array_equal(mesh.points, body.rest_points.astype(np.float32))


@pytest.mark.parametrize("dim", SETUPS)
def test_scalars_of_a_surface_are_read_at_the_corners_of_its_faces(tmp_path: Path, dim: int) -> None:
    body = make_body(dim)
    write(tmp_path / "run.usdc", [body], 2)
    stage = Usd.Stage.Open(str(tmp_path / "run.usdc"))
    surface = UsdGeom.Mesh.Get(stage, "/World/block/block_surface")
    faces = np.array(surface.GetFaceVertexIndicesAttr().Get()).reshape(-1, 3)
    point_count = len(surface.GetPointsAttr().Get(0))
    primvars, tokens = UsdGeom.PrimvarsAPI(surface), UsdGeom.Tokens
    expected = {}
    for interpolation, count, pick in (
        (tokens.constant, 1, lambda values: np.full(faces.shape, values[0])),
        (tokens.uniform, len(faces), lambda values: np.repeat(values[:, None], 3, axis=1)),
        (tokens.vertex, point_count, lambda values: values[faces]),
        (tokens.varying, point_count, lambda values: values[faces]),
        (tokens.faceVarying, faces.size, lambda values: values.reshape(faces.shape)),
    ):
        name = f"by_{interpolation}"
        primvar = primvars.CreatePrimvar(name, Sdf.ValueTypeNames.DoubleArray, interpolation)
        for index in range(2):
            primvar.Set(np.arange(count) + 0.5 + index, index)
        expected[name] = pick(np.arange(count) + 0.5)
    indexed = primvars.CreatePrimvar("indexed", Sdf.ValueTypeNames.HalfArray, tokens.uniform)
    indexed.Set([3.0, 4.0])
    indexed.SetIndices([face % 2 for face in range(len(faces))])
    short = primvars.CreatePrimvar("short", Sdf.ValueTypeNames.IntArray, tokens.vertex)
    short.Set([1, 2])
    stage.Save()
    stage = read_pictured_stage(tmp_path / "run.usdc")
    assert set(stage.primvars) == {*expected, "indexed", "short", "J", "JPoint", "vonMises", "vonMisesPoint"}
    for index in range(2):
        for name, values in expected.items():
            (read,) = stage.values(name, index)
            assert np.array_equal(read, values + index), name
        (read,) = stage.values("indexed", index)
        assert np.array_equal(read[:, 0], 3.0 + np.arange(len(faces)) % 2)
    with pytest.raises(
        OutputError, match=r"lacks primvars:short of /World/block/block_surface at 0.0, one number for each"
    ):
        stage.values("short", 0)


@pytest.mark.parametrize("dim", SETUPS)
def test_obstacles_are_where_they_act(tmp_path: Path, dim: int) -> None:
    body = make_body(dim)
    write(tmp_path / "run.usdc", [body], 0, obstacles=OBSTACLES[dim])
    plane, sphere, box, walls = read_animation(tmp_path / "run.usdc").obstacles
    declared = OBSTACLES[dim]
    distances = (plane[0][:, :dim] - declared[0].point) @ declared[0].normal
    assert distances.max() == pytest.approx(0.0, abs=1e-6)
    assert distances.min() == pytest.approx(0.0 if dim == 3 else -0.05, abs=1e-6)
    assert np.ptp(plane[0], axis=0).max() > 3.5
    radii = np.linalg.norm(sphere[0][:, :dim] - declared[1].center, axis=1)
    assert radii == pytest.approx(0.5, abs=1e-6)
    inside = (walls[0][:, :dim] > np.array(declared[3].lower) + 1e-6) & (
        walls[0][:, :dim] < np.array(declared[3].upper) - 1e-6
    )
    assert not inside.all(axis=1).any()
    assert walls[0][:, :dim].min() < -1.0 and walls[0][:, :dim].max() > 3.0
    assert np.abs((box[0][:, :dim] - declared[2].center) @ declared[2].shape.T) == pytest.approx(1.0, abs=1e-5)
    if dim == 2:
        assert all((points[:, 2] < 0.0).all() for points, _ in (plane, sphere, box, walls))
    else:
        for (points, triangles), own in ((sphere, declared[1]), (box, declared[2])):
            corners = points[triangles]
            areas = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
            assert (np.einsum("ij,ij->i", areas, corners.mean(axis=1) - own.center) > 0.0).all()


def test_colors_have_one_range_for_the_whole_run(tmp_path: Path) -> None:
    """The first frame is the least stressed one: its colours must count on what came later."""
    body = make_body(3)
    cells = np.ones(len(body.cells))
    levels = [1.0, 4.0, 2.0]
    writer = UsdWriter(tmp_path / "run.usdc", [body], fps=24, frames_per_chunk=1)
    for level in levels:
        writer.write_frame([BodyFrame(body.rest_points, 0 * body.rest_points, level * cells, cells)])
    partial = read_animation(tmp_path / "run.partial.usda")
    early = attribute(Usd.Stage.Open(str(tmp_path / "run.partial.usda")), COLORS, 0)
    assert partial.scale == ColorScale("von_mises", 0.0, 4.0)
    assert early == pytest.approx(np.tile(ColorScale("von_mises", 0.0, 1.0).linear(1.0), (len(early), 1)))
    writer.close()

    stage = Usd.Stage.Open(str(tmp_path / "run.usdc"))
    stated = stage.GetDefaultPrim().GetCustomData()["warpfem"]
    assert stated == {
        "colorBy": "von_mises",
        "colorPrimvar": "vonMisesPoint",
        "colorRange": Gf.Vec2d(0.0, 4.0),
    }
    scale = ColorScale("von_mises", 0.0, 4.0)
    for index, level in enumerate(levels):
        values = attribute(stage, COLORS, index)
        assert values == pytest.approx(np.tile(scale.linear(level), (len(values), 1)), abs=1e-6)


COLORS = "/World/block/block_surface.primvars:displayColor"


def test_colors_of_the_volume_ratio_are_symmetric_about_one(tmp_path: Path) -> None:
    body = make_body(2)
    cells = np.ones(len(body.cells))
    with UsdWriter(tmp_path / "run.usdc", [body], fps=24, color_by="jacobian") as writer:
        for ratio in (1.0, 0.7, 1.1):
            writer.write_frame([BodyFrame(body.rest_points, 0 * body.rest_points, cells, ratio * cells)])
    scale = read_animation(tmp_path / "run.usdc").scale
    assert scale.quantity == "jacobian"
    assert (scale.lower, scale.upper) == pytest.approx((0.7, 1.3), abs=1e-6)
    stage = Usd.Stage.Open(str(tmp_path / "run.usdc"))
    rest, compressed, stretched = (attribute(stage, COLORS, index)[0] for index in range(3))
    assert np.ptp(rest) < 0.05 and compressed.argmax() == 2 and stretched.argmax() == 0


def test_one_singular_corner_does_not_set_the_color_range(tmp_path: Path) -> None:
    body = make_body(2, cells=40)
    stress = np.linspace(1.0, 2.0, len(body.cells))
    stress[0] = 1e6
    with UsdWriter(tmp_path / "run.usdc", [body], fps=24) as writer:
        writer.write_frame([BodyFrame(body.rest_points, 0 * body.rest_points, stress, 1.0 + 1e-3 * stress)])
    stage = Usd.Stage.Open(str(tmp_path / "run.usdc"))
    values = attribute(stage, "/World/block/block_surface.primvars:vonMisesPoint", 0)
    upper = read_animation(tmp_path / "run.usdc").scale.upper
    assert values.max() > 1e5 and 1.9 < upper < 2.0
    assert 0.004 < np.mean(values > upper) <= 0.005


def test_a_given_color_range_is_kept(tmp_path: Path) -> None:
    body = make_body(2)
    frames = write(tmp_path / "run.usdc", [body], 2, color_range=(1e5, 2e5))
    animation = read_animation(tmp_path / "run.usdc")
    assert animation.scale == ColorScale("von_mises", 1e5, 2e5)
    assert frames[0][0].von_mises.max() > 2e5
    stage = Usd.Stage.Open(str(tmp_path / "run.usdc"))
    values = attribute(stage, "/World/block/block_surface.primvars:vonMisesPoint", 1)
    assert np.array_equal(attribute(stage, COLORS, 1), animation.scale.linear(values))


@pytest.mark.parametrize("quantity", ["von_mises", "jacobian"])
def test_color_tables_step_evenly_in_lightness(quantity: str) -> None:
    values = np.linspace(0.0, 1.0, 65)
    luminance = ColorScale(quantity, 0.0, 1.0).linear(values) @ [0.2126, 0.7152, 0.0722]
    lightness = 116.0 * np.cbrt(luminance) - 16.0
    steps = np.diff(lightness if quantity == "von_mises" else lightness[:33])
    assert steps.min() > 0.5 * steps.mean() and steps.max() < 1.6 * steps.mean()
    if quantity == "jacobian":
        assert lightness == pytest.approx(lightness[::-1], abs=4.0)


def test_no_frames_leave_the_rest_shape(tmp_path: Path) -> None:
    body = make_body(3)
    writer = UsdWriter(tmp_path / "run.usdc", [body], fps=24)
    assert read_animation(tmp_path / "run.partial.usda").frame_count == 0
    assert_sound(tmp_path / "run.partial.usda", 0)
    assert writer.close() == writer.close() == tmp_path / "run.usdc"
    assert_sound(tmp_path / "run.usdc", 0)
    read = read_mesh(tmp_path / "run.usdc")
    points, cells = read.points, read.cells
    assert points == pytest.approx(body.rest_points, abs=1e-7) and np.array_equal(cells, body.cells)


@pytest.mark.parametrize("error", [RuntimeError("diverged"), KeyboardInterrupt()])
def test_frames_before_an_exception_are_kept(tmp_path: Path, error: BaseException) -> None:
    body = make_body(2)
    with (
        pytest.raises(type(error)),
        UsdWriter(tmp_path / "run.usdc", [body], fps=24, frames_per_chunk=4) as writer,
    ):
        for index in itertools.count():
            if index == 6:
                raise error
            writer.write_frame([make_frame(body, index)])
    assert [item.name for item in tmp_path.iterdir()] == ["run.usdc"]
    assert_sound(tmp_path / "run.usdc", 6)


def test_the_partial_file_is_sound_and_can_be_moved(tmp_path: Path) -> None:
    body = make_body(3)
    writer = UsdWriter(tmp_path / "run.usdc", [body], fps=24, frames_per_chunk=2, obstacles=OBSTACLES[3])
    frames = [make_frame(body, index) for index in range(7)]
    for index, frame in enumerate(frames):
        writer.write_frame([frame])
        saved = (index + 1) // 2 * 2
        assert read_animation(tmp_path / "run.partial.usda").frame_count == saved
    assert_sound(tmp_path / "run.partial.usda", 6)
    moved = tmp_path / "elsewhere"
    moved.mkdir()
    for item in ("run.partial", "run.partial.usda"):
        (tmp_path / item).rename(moved / item)
    animation = read_animation(moved / "run.partial.usda")
    for index in range(6):
        read = animation.frame(index)[0]
        assert np.array_equal(read.points, frames[index].points.astype(np.float32))
        assert np.array_equal(read.jacobian, frames[index].jacobian.astype(np.float32))


def test_a_slow_run_saves_every_frame(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("warpfem.usd.chunks._PATIENCE", -1.0)
    body = make_body(2)
    with UsdWriter(tmp_path / "run.usdc", [body], fps=24) as writer:
        for index in range(3):
            writer.write_frame([make_frame(body, index)])
            assert read_animation(tmp_path / "run.partial.usda").frame_count == index + 1


def test_merging_in_many_steps_gives_the_same(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write(tmp_path / "one.usdc", [make_body(3)], 9, frames_per_chunk=2)
    monkeypatch.setattr("warpfem.usd.chunks._MERGE_BYTES", 0)
    write(tmp_path / "many.usdc", [make_body(3)], 9, frames_per_chunk=2)
    one, many = (Sdf.Layer.FindOrOpen(str(tmp_path / name)) for name in ("one.usdc", "many.usdc"))
    assert one.ExportToString() == many.ExportToString()


def test_an_old_output_stays_until_the_new_one_is_complete(tmp_path: Path) -> None:
    path, body = tmp_path / "run.usdc", make_body(2)
    write(path, [body], 2)
    abandoned = UsdWriter(path, [body], fps=24, frames_per_chunk=1)
    for index in range(5):
        abandoned.write_frame([make_frame(body, index)])
    held = read_animation(path)
    assert held.frame_count == 2
    assert read_animation(tmp_path / "run.partial.usda").frame_count == 5

    frames = write(path, [body], 3)
    assert [item.name for item in tmp_path.iterdir()] == ["run.usdc"]
    animation = read_animation(path)
    assert animation.frame_count == 3
    assert np.array_equal(animation.frame(2)[0].points, lifted(frames[2][0].points).astype(np.float32))


def test_a_partial_file_is_read_as_it_is_now(tmp_path: Path) -> None:
    """An animation that is still held must not hide that other chunks have taken its place."""
    path, body = tmp_path / "run.usdc", make_body(2)
    held = []
    for first, per_chunk in ((0, 1), (10, 3)):
        writer = UsdWriter(path, [body], fps=24, frames_per_chunk=per_chunk)
        frames = [make_frame(body, first + index) for index in range(6)]
        for frame in frames:
            writer.write_frame([frame])
        held.append(read_animation(tmp_path / "run.partial.usda"))
        for index, frame in enumerate(frames):
            points = held[-1].frame(index)[0].points
            assert np.array_equal(points, lifted(frame.points).astype(np.float32))


def fail_to_move(monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    """Lets no file be moved to a path of this name."""

    def replace(source, target) -> None:
        if Path(target).name == name:
            raise OSError("no space left")
        REPLACE(source, target)

    monkeypatch.setattr("warpfem.files.os.replace", replace)


REPLACE = os.replace


@pytest.mark.parametrize("name", ["000002.usdc", "run.partial.usda"])
def test_frames_that_could_not_be_saved_are_saved_later(tmp_path: Path, monkeypatch, name: str) -> None:
    body = make_body(2)
    frames = [make_frame(body, index) for index in range(5)]
    writer = UsdWriter(tmp_path / "run.usdc", [body], fps=24, frames_per_chunk=2)
    for frame in frames[:3]:
        writer.write_frame([frame])
    with monkeypatch.context() as patch, pytest.raises(OutputError, match=r"run\.usdc cannot be written .*: no space"):
        fail_to_move(patch, name)
        writer.write_frame([frames[3]])
    assert (tmp_path / "run.partial" / "000002.usdc").exists() == (name != "000002.usdc")
    assert_sound(tmp_path / "run.partial.usda", 2)
    writer.write_frame([frames[4]])
    writer.close()
    assert_sound(tmp_path / "run.usdc", 5)
    animation = read_animation(tmp_path / "run.usdc")
    for index, frame in enumerate(frames):
        assert np.array_equal(animation.frame(index)[0].points, lifted(frame.points).astype(np.float32))


def test_a_failed_merge_keeps_the_old_output_the_frames_and_the_first_error(tmp_path: Path, monkeypatch) -> None:
    path, body = tmp_path / "run.usdc", make_body(2)
    write(path, [body], 2)
    with monkeypatch.context() as patch, pytest.raises(RuntimeError, match="diverged") as caught:
        fail_to_move(patch, path.name)
        with UsdWriter(path, [body], fps=24) as writer:
            writer.write_frame([make_frame(body, 0)])
            raise RuntimeError("diverged")
    (note,) = caught.value.__notes__
    assert f"cannot be written (what was saved of its frames is in {tmp_path / 'run.partial.usda'})" in note
    assert_sound(path, 2)
    assert_sound(tmp_path / "run.partial.usda", 1)
    assert not (tmp_path / "run.partial" / "merged.usdc").exists()
    writer.close()
    assert_sound(path, 1)


CHILD = """
import sys
sys.path[:0] = [{repository!r}, {tests!r}]
from test_usd import UsdWriter, make_body, make_frame

body = make_body(3)
with UsdWriter(sys.argv[1], [body], fps=24, frames_per_chunk=int(sys.argv[2])) as writer:
    print("ready", flush=True)
    for index in range(60):
        writer.write_frame([make_frame(body, index)])
        print(index, flush=True)
print("done", flush=True)
"""


def test_a_killed_run_leaves_its_frames(tmp_path: Path) -> None:
    """Kills at random moments, also while chunks are being merged."""
    body = make_body(3)
    frames = [make_frame(body, index) for index in range(60)]
    code = CHILD.format(repository=str(REPOSITORY), tests=str(REPOSITORY / "tests"))
    moments = random.Random(0)
    lines_before = [0, 1, 17, moments.randrange(60), moments.randrange(60), 60, 60]
    found = []
    for number, line_count in enumerate(lines_before):
        per_chunk = (1, 4)[number % 2]
        path = tmp_path / f"{number}.usdc"
        command = [sys.executable, "-c", code, str(path), str(per_chunk)]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
            lines = [process.stdout.readline() for _ in range(line_count + 1)]
            assert lines[0] == "ready\n"
            time.sleep(moments.uniform(0.0, 0.02))
            process.send_signal(signal.SIGKILL)
        finished = path.exists()
        animation = read_animation(path if finished else tmp_path / f"{number}.partial.usda")
        saved = animation.frame_count
        assert saved >= (60 if finished else line_count // per_chunk * per_chunk)
        found.append(saved)
        for index in range(saved):
            read = animation.frame(index)[0]
            assert np.array_equal(read.points, frames[index].points.astype(np.float32))
            assert np.array_equal(read.von_mises, frames[index].von_mises.astype(np.float32))
    assert min(found) < 5 and max(found) == 60


FULL_DISK = """
import resource, signal, sys
sys.path[:0] = [{repository!r}, {tests!r}]
from test_usd import UsdWriter, make_body, make_frame

signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
body = make_body(3)
writer = UsdWriter(sys.argv[1], [body], fps=24, frames_per_chunk=4)
for index in range(20):
    writer.write_frame([make_frame(body, index)])
resource.setrlimit(resource.RLIMIT_FSIZE, (65536, resource.RLIM_INFINITY))
try:
    writer.close()
except OSError as error:
    print(error)
resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
from warpfem.usd import read_animation
print(read_animation(str(writer.path).replace(".usdc", ".partial.usda")).frame_count)
print(writer.close() == writer.path and read_animation(writer.path).frame_count)
"""


@pytest.mark.skipif(sys.platform == "win32", reason="limits the size of files as POSIX does")
def test_a_full_disk_loses_no_frames(tmp_path: Path) -> None:
    code = FULL_DISK.format(repository=str(REPOSITORY), tests=str(REPOSITORY / "tests"))
    command = [sys.executable, "-c", code, str(tmp_path / "run.usdc")]
    result = subprocess.run(command, capture_output=True, text=True, check=True)
    *message, partial, complete = result.stdout.splitlines()
    assert "cannot be written (what was saved of its frames is in" in message[0] and "run.partial.usda" in message[0]
    assert (partial, complete) == ("20", "20")


FULL_CHUNK = """
import resource, signal, sys
sys.path[:0] = [{repository!r}, {tests!r}]
from test_usd import UsdWriter, make_body, make_frame
from warpfem.usd import partial_path, read_animation

signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
path, limit = sys.argv[1], int(sys.argv[2])
body = make_body(3)
try:
    with UsdWriter(path, [body], fps=24, frames_per_chunk=4) as writer:
        for index in range(20):
            if index == 11:
                resource.setrlimit(resource.RLIMIT_FSIZE, (limit, resource.RLIM_INFINITY))
            writer.write_frame([make_frame(body, index)])
except OSError as error:
    print(index, error, getattr(error, "__notes__", []))
print(read_animation(partial_path(path)).frame_count, sorted(file.name for file in writer._layer._folder.iterdir()))
resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
print(read_animation(writer.close()).frame_count)
"""


@pytest.mark.skipif(sys.platform == "win32", reason="limits the size of files as POSIX does")
@pytest.mark.parametrize("limit", [500, 8192])
def test_a_disk_that_fills_up_during_a_run_ends_it_with_one_error(tmp_path: Path, limit: int) -> None:
    """The chunk, or what joins the chunks, is cut off in the middle of writing: what was saved stays sound."""
    code = FULL_CHUNK.format(repository=str(REPOSITORY), tests=str(REPOSITORY / "tests"))
    command = [sys.executable, "-c", code, str(tmp_path / "run.usdc"), str(limit)]
    result = subprocess.run(command, capture_output=True, text=True, check=True)
    message, partial, complete = result.stdout.splitlines()
    assert re.fullmatch(r"11 .*run\.usdc cannot be written \(.*run\.partial\.usda\): .*File too large \[\]", message)
    assert partial == "8 ['000000.usdc', '000004.usdc', 'manifest.usdc', 'static.usdc']"
    assert complete == "12"  # once there is room again, also the frames that waited


def test_a_disk_without_room_is_said_at_once(tmp_path: Path, monkeypatch) -> None:
    body, path = make_body(3), tmp_path / "run.usdc"
    write(path, [body], 40)
    needed = 2 * path.stat().st_size  # in parts and merged
    left = UsdWriter(path, [body], fps=24, frames_per_chunk=1)
    left.write_frame([make_frame(body, 0)])
    before = {str(item): item.read_bytes() for item in tmp_path.rglob("*") if item.is_file()}
    usage = shutil.disk_usage(tmp_path)
    monkeypatch.setattr("warpfem.usd.frames.shutil.disk_usage", lambda folder: usage._replace(free=int(0.7 * needed)))
    with pytest.raises(OutputError, match=r"its 40 frames need \d[\d.]* MB .* has \d[\d.]* MB free: take another"):
        UsdWriter(path, [body], fps=24, expected_frames=40)
    assert {str(item): item.read_bytes() for item in tmp_path.rglob("*") if item.is_file()} == before
    UsdWriter(path, [body], fps=24, expected_frames=20).close()
    with pytest.raises(OutputError, match="its 20 frames need"):
        UsdWriter(path.with_suffix(".usda"), [body], fps=24, expected_frames=20)  # text is larger


def test_a_folder_that_is_removed_ends_the_run(tmp_path: Path) -> None:
    body, folder = make_body(2), tmp_path / "folder"
    message = r"run\.usdc cannot be written: .*run\.partial has been removed, with the frames in it"
    with (
        pytest.raises(OutputError, match=message) as caught,
        UsdWriter(folder / "run.usdc", [body], fps=24, frames_per_chunk=1) as writer,
    ):
        writer.write_frame([make_frame(body, 0)])
        shutil.rmtree(folder)
        writer.write_frame([make_frame(body, 1)])
    assert not hasattr(caught.value, "__notes__")
    assert not folder.exists()


def test_waiting_frames_can_be_saved_at_once(tmp_path: Path) -> None:
    body = make_body(2)
    with UsdWriter(tmp_path / "run.usdc", [body], fps=24, frames_per_chunk=50) as writer:
        for index in range(4):
            writer.write_frame([make_frame(body, index)])
            assert read_animation(tmp_path / "run.partial.usda").frame_count == max(0, index)
            writer.flush()
            writer.flush()
            assert read_animation(tmp_path / "run.partial.usda").frame_count == index + 1
    assert_sound(tmp_path / "run.usdc", 4)


@pytest.mark.parametrize("source", ["partial", ".usdc", ".usda"])
@pytest.mark.parametrize("per_chunk", [1, 4])
def test_a_writer_keeps_frames_of_an_earlier_one(tmp_path: Path, source: str, per_chunk: int) -> None:
    """Also the largest stress, which is in an early frame, and drops the frames after the last one kept."""
    body = make_body(3)
    path = tmp_path / ("run.usdc" if source == "partial" else f"run{source}")
    whole = write(tmp_path / f"whole{path.suffix}", [body], 9)
    earlier = UsdWriter(path, [body], fps=25.0, frames_per_chunk=per_chunk)
    for frame in (*whole[:5], *whole[:2]):
        earlier.write_frame(frame)
    earlier.flush() if source == "partial" else earlier.close()
    with UsdWriter(path, [body], fps=25.0, frames_per_chunk=3, keep=(4, whole[4])) as writer:
        kept = read_animation(tmp_path / "run.partial.usda")
        assert kept.frame_count == 5
        assert kept.scale == read_animation(tmp_path / f"whole{path.suffix}").scale
        assert np.array_equal(kept.frame(2)[0].points, whole[2][0].points.astype(np.float32))
        assert_sound(tmp_path / "run.partial.usda", 5)
        for frame in whole[5:]:
            writer.write_frame(frame)
    written, expected = (Sdf.Layer.OpenAsAnonymous(str(tmp_path / f"{name}{path.suffix}")) for name in ("run", "whole"))
    assert written.ExportToString() == expected.ExportToString()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"points": (5, np.nan)}, r"frame 1, body 'two', points: 1 of 64 are not finite.* one is 5:"),
        ({"points": (6, 1e39)}, r"frame 1, body 'two', points: .* first one is 6"),
        ({"velocities": (3, np.inf)}, r"frame 1, body 'two', velocities: .* first one is 3"),
        ({"von_mises": (7, np.nan)}, r"frame 1, body 'two', von_mises: .* first one is 7"),
        ({"jacobian": (0, -np.inf)}, r"frame 1, body 'two', jacobian: .* first one is 0"),
    ],
)
def test_a_frame_that_is_not_finite_is_left_out(tmp_path: Path, changes: dict, message: str) -> None:
    bodies = [make_body(3, "one"), make_body(3, "two")]
    with UsdWriter(tmp_path / "run.usdc", bodies, fps=24) as writer:
        writer.write_frame([make_frame(body, 0) for body in bodies])
        bad = [make_frame(body, 1) for body in bodies]
        ((field, (index, value)),) = changes.items()
        getattr(bad[1], field)[index] = value
        with pytest.raises(OutputError, match=message):
            writer.write_frame(bad)
        writer.write_frame([make_frame(body, 1) for body in bodies])
    assert_sound(tmp_path / "run.usdc", 2)


def test_frames_of_the_wrong_shape_are_refused(tmp_path: Path) -> None:
    body, other = make_body(3), make_body(2)
    with UsdWriter(tmp_path / "run.usdc", [body], fps=24) as writer:
        with pytest.raises(OutputError, match=r"points must have shape \(64, 3\), not \(16, 2\)"):
            writer.write_frame([make_frame(other, 0)])
        with pytest.raises(OutputError, match="frame 0: 2 bodies given, the file has 1"):
            writer.write_frame([make_frame(body, 0)] * 2)
    with pytest.raises(OutputError, match="is closed"):
        writer.write_frame([make_frame(body, 0)])


def test_outputs_that_cannot_be_written_are_refused_at_once(tmp_path: Path) -> None:
    (tmp_path / "folder.usdc").mkdir()
    (tmp_path / "file").touch()
    body = make_body(2)
    for path, message in (
        (tmp_path / "run.abc", "must end in .usdc, .usd, .usda"),
        (tmp_path / "folder.usdc", "is a folder"),
        (tmp_path / "file" / "run.usdc", "cannot be written"),
        (Path("/proc/run.usdc"), "cannot be written"),
        (tmp_path / "file" / "folder" / "run.usdc", "file is not a folder that can be written to"),
        (tmp_path / ("x" * 300 + ".usdc"), "File name too long"),
        (tmp_path / ("x" * 240 + ".usdc"), "File name too long"),  # that of the partial file would be
        (tmp_path / "back\\slash" / "run.usdc", r"USD does not bear '\\\\' in the name"),
        (tmp_path / "new\nline.usdc", r"USD does not bear '\\n' in the name"),
        (tmp_path / os.fsdecode(b"\xff.usdc"), "USD does not bear bytes that are not UTF-8"),
        (tmp_path / "a:SDF_FORMAT_ARGS:b.usdc", "USD does not bear ':SDF_FORMAT_ARGS:'"),
    ):
        with pytest.raises(OutputError, match=message):
            UsdWriter(path, [body], fps=24)
    for settings, message in (
        ({"fps": 0.0}, "fps"),
        ({"fps": np.nan}, "fps"),
        ({"up_axis": "X"}, "up_axis"),
        ({"color_by": "pressure"}, "color_by"),
        ({"color_range": (2.0, 1.0)}, "color_range"),
        ({"frames_per_chunk": 0}, "frames_per_chunk"),
    ):
        with pytest.raises(OutputError, match=message):
            UsdWriter(tmp_path / "run.usdc", [body], **{"fps": 24, **settings})
    with pytest.raises(OutputError, match="no bodies"):
        UsdWriter(tmp_path / "run.usdc", [], fps=24)
    assert {item.name for item in tmp_path.iterdir()} == {"folder.usdc", "file"}


@pytest.mark.parametrize(
    "name", ["a b", "q'\"", "at@@@", "[x]", "é中", "100%20", "<UDIM>", "${X}", "`x`", "-x", "~", "*", "{}"]
)
def test_odd_names_are_borne(tmp_path: Path, name: str) -> None:
    body, path = make_body(2), tmp_path / name / f"{name}.usdc"
    with UsdWriter(path, [body], fps=24, frames_per_chunk=2) as writer:
        for index in range(3):
            writer.write_frame([make_frame(body, index)])
        assert_sound(path.with_name(f"{name}.partial.usda"), 2)
    assert_sound(path, 3)


PROTECTED = """
import os, sys
sys.path[:0] = [{repository!r}]
from warpfem.usd import check_path

if os.getuid() == 0:
    os.setuid(65534)  # nothing is denied to root
for path in sys.argv[1:]:
    try:
        check_path(path)
    except OSError as error:
        print(error)
"""


@pytest.mark.skipif(sys.platform == "win32", reason="permissions as POSIX has them")
def test_what_is_write_protected_is_refused(tmp_path: Path) -> None:
    file, folder, free = tmp_path / "file.usdc", tmp_path / "folder", tmp_path / "free.usdc"
    file.touch()
    file.chmod(0o444)
    folder.mkdir()
    folder.chmod(0o555)
    for parent in (tmp_path, *tmp_path.parents):
        if parent.owner() == tmp_path.owner() and "pytest" in str(parent):
            parent.chmod(0o777)
    code = PROTECTED.format(repository=str(REPOSITORY))
    command = [sys.executable, "-c", code, str(file), str(folder / "run.usdc"), str(free)]
    result = subprocess.run(command, capture_output=True, text=True, check=True)
    assert result.stdout.splitlines() == [
        f"{file} cannot be written: it is write-protected",
        f"{folder / 'run.usdc'} cannot be written: {folder} is not a folder that can be written to",
    ]


def test_bodies_that_contradict_themselves_are_refused(tmp_path: Path) -> None:
    good = make_body(3)
    with pytest.raises(OutputError, match="rest_points"):
        UsdBody("b", np.zeros((4, 4)), good.cells, good.surface_faces)
    with pytest.raises(OutputError, match="finite"):
        UsdBody("b", np.full((64, 3), np.nan), good.cells, good.surface_faces)
    with pytest.raises(OutputError, match="cells must index its 64 points"):
        UsdBody("b", good.rest_points, good.cells + 1, good.surface_faces)
    with pytest.raises(OutputError, match="surface_faces must be integers"):
        UsdBody("b", good.rest_points, good.cells, good.surface_faces.astype(float))
    stray = good.surface_faces.copy()
    stray[4] = (0, 1, 63)
    with pytest.raises(OutputError, match=r"1 surface faces belong to no cell.*face 4: \[0, 1, 63\]"):
        UsdWriter(tmp_path / "run.usdc", [UsdBody("b", good.rest_points, good.cells, stray)], fps=24)


TETRAHEDRON = np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)], np.float32)


def author_tets(path: Path, cells, *, meters_per_unit=None, orientation="rightHanded", scale=(1, 1, 1)):
    stage = Usd.Stage.CreateNew(str(path))
    if meters_per_unit is not None:
        UsdGeom.SetStageMetersPerUnit(stage, meters_per_unit)
    root = UsdGeom.Xform.Define(stage, "/root")
    root.AddTranslateOp(UsdGeom.XformOp.PrecisionDouble).Set(Gf.Vec3d(10, 0, 0))
    root.AddScaleOp().Set(Gf.Vec3f(*scale))
    tets = UsdGeom.TetMesh.Define(stage, "/root/tets")
    tets.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(TETRAHEDRON))
    tets.CreateTetVertexIndicesAttr(Vt.Vec4iArray.FromNumpy(np.array(cells, np.int32)))
    tets.CreateOrientationAttr(orientation)
    return stage


@pytest.mark.parametrize(("authored", "unit"), [(None, 1.0), (1.0, 1.0), (0.01, 0.01)])
def test_tet_meshes_come_in_metres_and_in_the_world(tmp_path: Path, authored, unit: float) -> None:
    author_tets(tmp_path / "a.usda", [(0, 1, 2, 3)], meters_per_unit=authored, scale=(2, 3, 4)).Save()
    read = read_mesh(tmp_path / "a.usda")
    points, cells = read.points, read.cells
    assert (points.dtype, cells.dtype) == (np.float64, np.int32)
    assert points == pytest.approx(unit * (TETRAHEDRON * (2, 3, 4) + (10, 0, 0)), rel=1e-12)
    assert cells.tolist() == [[0, 1, 2, 3]]


@pytest.mark.parametrize(("orientation", "cell"), [("rightHanded", (0, 1, 2, 3)), ("leftHanded", (0, 2, 1, 3))])
@pytest.mark.parametrize("mirror", [1, -1])
def test_tet_meshes_come_with_positive_volumes(tmp_path: Path, orientation: str, cell, mirror: int) -> None:
    author_tets(tmp_path / "a.usda", [cell], orientation=orientation, scale=(mirror, 1, 1)).Save()
    read = read_mesh(tmp_path / "a.usda")
    a, b, c, d = read.points[read.cells[0]]
    assert np.linalg.det([b - a, c - a, d - a]) == pytest.approx(1.0)


def test_a_tet_mesh_with_only_samples_is_read_at_the_first(tmp_path: Path) -> None:
    stage = author_tets(tmp_path / "a.usda", [(0, 1, 2, 3)])
    attr = stage.GetAttributeAtPath("/root/tets.points")
    attr.Clear()
    for code in (7.0, 3.0):
        attr.Set(Vt.Vec3fArray.FromNumpy(TETRAHEDRON * np.float32(code)), code)
    stage.Save()
    assert read_mesh(tmp_path / "a.usda").points == pytest.approx(3.0 * TETRAHEDRON + (10, 0, 0))


def test_surfaces_are_merged_and_cut_into_triangles(tmp_path: Path) -> None:
    path = tmp_path / "a.usda"
    stage = Usd.Stage.CreateNew(str(path))
    for name, height in (("low", 0.0), ("high", 1.0), ("hidden", 2.0)):
        mesh = UsdGeom.Mesh.Define(stage, f"/{name}")
        mesh.CreatePointsAttr([(0, 0, height), (1, 0, height), (1, 1, height), (0, 1, height), (-1, 0.5, height)])
        mesh.CreateFaceVertexCountsAttr([3, 5])
        mesh.CreateFaceVertexIndicesAttr([0, 1, 2, 0, 1, 2, 3, 4])
        if name == "high":
            mesh.CreateOrientationAttr("leftHanded")
        if name == "hidden":
            mesh.CreatePurposeAttr("guide")
    stage.Save()
    read = read_surface_mesh(path)
    points, triangles = read.points, read.triangles
    assert points[:, 2].tolist() == [0.0] * 5 + [1.0] * 5
    fan = [[0, 1, 2], [0, 1, 2], [0, 2, 3], [0, 3, 4]]
    assert triangles[:4].tolist() == fan
    assert triangles[4:].tolist() == [[c + 5, b + 5, a + 5] for a, b, c in fan]
    assert triangles.dtype == np.int32


def test_the_bear_that_comes_with_warp_is_closed_and_outward() -> None:
    examples = pytest.importorskip("warp.examples")
    read = read_surface_mesh(Path(examples.get_asset_directory()) / "bear.usd")
    points, triangles = read.points, read.triangles
    assert (points.shape, triangles.shape) == ((1986, 3), (3968, 3))
    assert np.ptp(points, axis=0) == pytest.approx((4.89, 5.542, 9.78), abs=1e-3)
    a, b, c = (points[triangles[:, corner]] for corner in range(3))
    assert np.einsum("ij,ij->", np.cross(a, b), c) / 6.0 > 10.0
    edges = {tuple(edge) for edge in np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])}
    assert len(edges) == 3 * 3968 and all((end, start) in edges for start, end in edges)


@pytest.mark.parametrize("read", [read_mesh, read_surface_mesh])
def test_unreadable_meshes_are_errors(tmp_path: Path, read) -> None:
    write(tmp_path / "run.usdc", [make_body(3)], 1)
    whole = (tmp_path / "run.usdc").read_bytes()
    contents = {
        "short.usdc": whole[: len(whole) // 2],
        "tiny.usdc": whole[:20],
        "empty.usda": b"",
        "garbage.usda": b"once upon a time",
        "broken.usda": b'#usda 1.0\ndef TetMesh "a"\n{\n    point3f[] points = [(0, 0,\n',
        "nothing.usda": b'#usda 1.0\ndef Xform "a"\n{\n}\n',
        "wrong.txt": b"#usda 1.0\n",
    }
    for name, content in contents.items():
        (tmp_path / name).write_bytes(content)
        with pytest.raises(MeshError, match=name):
            read(tmp_path / name)
    with pytest.raises(MeshError, match="no such file"):
        read(tmp_path / "missing.usdc")


def test_meshes_that_make_no_sense_are_errors(tmp_path: Path) -> None:
    author_tets(tmp_path / "range.usda", [(0, 1, 2, 3), (0, 1, 2, 4)]).Save()
    with pytest.raises(MeshError, match="1 indices are outside of its 4 points, the first one is 4 at position 7"):
        read_mesh(tmp_path / "range.usda")
    author_tets(tmp_path / "empty.usda", np.empty((0, 4))).Save()
    with pytest.raises(MeshError, match="/root/tets: the mesh is empty"):
        read_mesh(tmp_path / "empty.usda")
    write(tmp_path / "two.usdc", [make_body(3, "a"), make_body(3, "b")], 0)
    with pytest.raises(MeshError, match="/World/a/simulation, /World/b/simulation"):
        read_mesh(tmp_path / "two.usdc")

    stage = Usd.Stage.CreateNew(str(tmp_path / "counts.usda"))
    mesh = UsdGeom.Mesh.Define(stage, "/mesh")
    mesh.CreatePointsAttr([(0, 0, 0), (1, 0, 0), (0, 1, 0)])
    mesh.CreateFaceVertexCountsAttr([4])
    mesh.CreateFaceVertexIndicesAttr([0, 1, 2])
    stage.Save()
    with pytest.raises(MeshError, match="sum to the 3 faceVertexIndices, not to 4"):
        read_surface_mesh(tmp_path / "counts.usda")


def test_other_files_are_no_animations(tmp_path: Path) -> None:
    author_tets(tmp_path / "a.usda", [(0, 1, 2, 3)]).Save()
    with pytest.raises(OutputError, match="not an animation that warpfem wrote"):
        read_animation(tmp_path / "a.usda")
    with pytest.raises(OutputError, match="no such file"):
        read_animation(tmp_path / "missing.usdc")
    (tmp_path / "b.usdc").write_bytes(b"PXR-USDC")
    with pytest.raises(OutputError, match=r"b\.usdc cannot be read as USD"):
        read_animation(tmp_path / "b.usdc")


def test_a_file_is_read_through_in_a_child_unless_it_is_known(tmp_path: Path, monkeypatch) -> None:
    path = tmp_path / "run.usdc"
    probed: list[str] = []
    read_in_child = animation.read_in_child
    monkeypatch.setattr(animation, "read_in_child", lambda *a: probed.append(str(a[1])) or read_in_child(*a))
    write(path, [make_body(2)], 3)
    assert read_animation(path).frame_count == 3
    assert not probed  # this process wrote it
    os.utime(path, ns=(1, 1))
    for _ in range(2):
        assert read_animation(path).frame_count == 3
    assert probed == [str(path)]  # once
    with path.open("ab") as file:
        file.write(b" ")
    read_animation(path)
    assert len(probed) == 2


def test_damage_in_a_chunk_of_a_known_partial_file_is_found(tmp_path: Path) -> None:
    body = make_body(2)
    writer = UsdWriter(tmp_path / "run.usdc", [body], fps=24, frames_per_chunk=2)
    for index in range(4):
        writer.write_frame([make_frame(body, index)])
    partial = tmp_path / "run.partial.usda"
    assert read_animation(partial).frame_count == 4
    chunk = tmp_path / "run.partial" / "000002.usdc"
    for content in (chunk.read_bytes()[:-40], b"", None):
        if content is None:
            chunk.unlink()
        else:
            chunk.write_bytes(content)
        with pytest.raises(OutputError, match=r"run\.partial\.usda"):
            read_animation(partial)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("framesPerSecond = 25", "framesPerSecond = 0"),
        ("framesPerSecond = 25", "framesPerSecond = -3"),
        ("double2 colorRange = (", "double2 colorRange = (inf, 1) # "),
        ('colorBy = "von_mises"', 'colorBy = "taste"'),
        ("point3f[] points = [(", "point3f[] points = [(nan, 0, 0), ("),
        ("int[] faceVertexIndices = [0,", "int[] faceVertexIndices = [99,"),
        ("float[] primvars:J.timeSamples = {\n                0: [", "float[] primvars:J.timeSamples = {\n 0: [1, "),
    ],
)
def test_an_animation_that_makes_no_sense_is_an_error(tmp_path: Path, old: str, new: str) -> None:
    path = tmp_path / "run.usda"
    write(path, [make_body(2)], 2)
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(OutputError, match=r"run\.usda"):
        read_animation(path)
