"""Meshes out of USD files that others made, which are opened in a child process alone."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from pxr import Usd, UsdGeom

from warpfem.child import read_in_child
from warpfem.errors import MeshError
from warpfem.meshing.contents import Solid, Surface, tagged
from warpfem.usd.stages import at_rest, open_stage, reporting, stated_up_axis, world_matrix


def read_mesh(path: str | Path) -> Solid | Surface:
    """Reads the ``TetMesh`` of a USD file at rest, or its surface if it has none.

    Positions are taken to the world, and to metres by the stage's ``metersPerUnit`` if the file states one.
    If it does not, its numbers are taken as metres: USD's fallback of a centimetre is hardly what somebody
    meant who did not write it. Axes are those of the file, whose ``upAxis`` is told if it is stated. "At rest" is the
    default value, or the first sample of a mesh that has only samples.

    A ``GeomSubset`` of tetrahedra becomes a cell set, one of points or faces a point set, and a primvar of one number
    per cell cell data.

    Args:
        path: a USD file with at most one ``TetMesh``.

    Returns:
        Cells positively oriented if the file's orientation holds, or what :func:`read_surface_mesh` returns.

    Raises:
        MeshError: a file that is missing or unreadable, neither a ``TetMesh`` nor a ``Mesh``, several of the former, an
            empty one, or indices out of range.
    """
    return read_in_child(solid_or_surface, path, MeshError)


def read_surface_mesh(path: str | Path) -> Surface:
    """Reads the surface of a USD file, at rest: all its ``Mesh`` prims that are meant to be seen, as one.

    Polygons are cut into triangles around their first corner; subdivision is not applied. Units, axes and
    time are those of :func:`read_mesh`.

    Args:
        path: a USD file with at least one ``Mesh``.

    Returns:
        Triangles counter-clockwise as seen from outside if the file's orientation holds.

    Raises:
        MeshError: a file that is missing or unreadable, no ``Mesh``, an empty one, or indices that do not
            fit.
    """
    return read_in_child(surface, path, MeshError)


def solid_or_surface(path: str) -> Solid | Surface:
    """What :func:`read_mesh` returns; called in a child process."""
    stage = open_stage(path, MeshError)
    with reporting(f"{path} cannot be read as USD", MeshError):
        prims = [prim for prim in stage.Traverse(Usd.TraverseInstanceProxies()) if prim.IsA(UsdGeom.TetMesh)]
        if not prims:
            return _surface(stage, path)
        if len(prims) > 1:
            found = ", ".join(str(prim.GetPath()) for prim in prims)
            raise MeshError(
                f"{path}: there must be one TetMesh in the file, found: {found}; read_stage takes each as a body"
            )
        mesh = UsdGeom.TetMesh(prims[0])
        cells = np.array(at_rest(mesh.GetTetVertexIndicesAttr()) or [], np.int32).reshape(-1, 4)
        points, mirrored = _world_points(mesh)
        _check_indices(f"{path}, {mesh.GetPath()}", cells.reshape(-1), len(points))
        data = _cell_data(mesh, len(cells))
        point_sets, cell_sets = _subsets(mesh)
        for name, values in data.items():
            cell_sets |= dict(tagged(name, values))
        if mirrored:
            cells = cells[:, [0, 2, 1, 3]]
        return Solid(points, cells, point_sets, cell_sets, data, stated_up_axis(stage))


def surface(path: str) -> Surface:
    """What :func:`read_surface_mesh` returns; called in a child process."""
    stage = open_stage(path, MeshError)
    with reporting(f"{path} cannot be read as USD", MeshError):
        return _surface(stage, path)


def _surface(stage: Usd.Stage, path: str) -> Surface:
    meshes = [UsdGeom.Mesh(prim) for prim in stage.Traverse(Usd.TraverseInstanceProxies())]
    seen = (UsdGeom.Tokens.default_, UsdGeom.Tokens.render)
    parts = [triangles_of(mesh) for mesh in meshes if mesh and mesh.ComputePurpose() in seen]
    if not parts:
        raise MeshError(f"{path}: there is no Mesh in the file")
    offsets = np.cumsum([0, *(len(points) for points, _ in parts[:-1])], dtype=np.int32)
    triangles = [faces + offset for (_, faces), offset in zip(parts, offsets, strict=True)]
    return Surface(np.concatenate([points for points, _ in parts]), np.concatenate(triangles), stated_up_axis(stage))


def _subsets(mesh: UsdGeom.TetMesh) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Sets of points and of cells by the names of the ``GeomSubset`` prims; that of faces has their points."""
    faces = np.array(at_rest(mesh.GetSurfaceFaceVertexIndicesAttr()) or [], np.int32).reshape(-1, 3)
    point_sets, cell_sets = {}, {}
    for subset in UsdGeom.Subset.GetAllGeomSubsets(mesh):
        name = subset.GetPrim().GetName()
        members = np.array(at_rest(subset.GetIndicesAttr()) or [], np.int32)
        kind = at_rest(subset.GetElementTypeAttr())
        if kind == UsdGeom.Tokens.tetrahedron:
            cell_sets[name] = members
        elif kind == UsdGeom.Tokens.point:
            point_sets[name] = members
        elif kind == UsdGeom.Tokens.face:
            if members.size and not 0 <= members.min() <= members.max() < len(faces):
                raise MeshError(f"{subset.GetPath()}: there are indices outside of the {len(faces)} surface faces")
            point_sets[name] = faces[members].ravel()
    return point_sets, cell_sets


def _cell_data(mesh: UsdGeom.TetMesh, cell_count: int) -> dict[str, np.ndarray]:
    """Primvars of one number per cell, by name."""
    found = {}
    for primvar in UsdGeom.PrimvarsAPI(mesh).GetPrimvars():
        if primvar.GetInterpolation() == UsdGeom.Tokens.uniform:
            values = np.asarray(primvar.ComputeFlattened(Usd.TimeCode.EarliestTime()))
            if values.shape == (cell_count,) and values.dtype.kind in "biuf":
                found[primvar.GetPrimvarName()] = values
    return found


def triangles_of(mesh: UsdGeom.Mesh) -> tuple[np.ndarray, np.ndarray]:
    """World points (n, 3) float64 [m] and triangles (k, 3) int32 of a ``Mesh`` at rest.

    Raises:
        MeshError: an empty mesh, face counts and indices that do not fit each other, or indices out of range.
    """
    counts = np.array(at_rest(mesh.GetFaceVertexCountsAttr()) or [], np.int32)
    indices = np.array(at_rest(mesh.GetFaceVertexIndicesAttr()) or [], np.int32)
    points, mirrored = _world_points(mesh)
    where = f"{mesh.GetPrim().GetStage().GetRootLayer().realPath}, {mesh.GetPath()}"
    _check_indices(where, indices, len(points))
    if counts.sum() != len(indices) or (counts < 3).any():
        raise MeshError(
            f"{where}: faceVertexCounts must be at least 3 each and sum to the {len(indices)} "
            f"faceVertexIndices, not to {counts.sum()}"
        )
    fans = counts - 2
    first = np.repeat(np.cumsum(counts) - counts, fans)
    step = np.arange(fans.sum()) - np.repeat(np.cumsum(fans) - fans, fans)
    triangles = indices[np.column_stack([first, first + step + 1, first + step + 2])]
    return points, triangles[:, ::-1] if mirrored else triangles


def _world_points(prim: UsdGeom.PointBased) -> tuple[np.ndarray, bool]:
    """World points (n, 3) float64 [m] at rest, and whether the winding has to be reversed."""
    points = np.array(at_rest(prim.GetPointsAttr()) or [], np.float64).reshape(-1, 3)
    matrix = world_matrix(prim.GetPrim())
    left_handed = at_rest(prim.GetOrientationAttr()) == UsdGeom.Tokens.leftHanded
    mirrored = left_handed != (np.linalg.det(matrix[:3, :3]) < 0.0)
    points = points @ matrix[:3, :3] + matrix[3, :3]
    if not np.isfinite(points).all():
        raise MeshError(f"{prim.GetPath()}: there are points that are not finite")
    return points, mirrored


def _check_indices(where: str, indices: np.ndarray, point_count: int) -> None:
    if indices.size == 0 or point_count == 0:
        raise MeshError(f"{where}: the mesh is empty")
    bad = np.flatnonzero((indices < 0) | (indices >= point_count))
    if len(bad):
        raise MeshError(
            f"{where}: {len(bad)} indices are outside of its {point_count} points, the first one is "
            f"{indices[bad[0]]} at position {bad[0]}"
        )
