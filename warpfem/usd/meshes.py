"""Meshes out of USD files that others made, which are opened in a child process alone."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from pxr import Usd, UsdGeom

from warpfem.child import read_in_child
from warpfem.errors import MeshError
from warpfem.usd.stages import at_rest, open_stage, reporting, world_matrix


def read_tet_mesh(path: str | Path) -> tuple[np.ndarray, np.ndarray]:
    """Reads the ``TetMesh`` of a USD file, at rest.

    Positions are taken to the world, and to metres by the stage's ``metersPerUnit`` if the file states one.
    If it does not, its numbers are taken as metres: USD's fallback of a centimetre is hardly what somebody
    meant who did not write it. The axes stay as they are, whatever ``upAxis`` says. "At rest" is the
    default value, or the first sample of a mesh that has only samples.

    Args:
        path: a USD file with exactly one ``TetMesh``.

    Returns:
        Points (n, 3) float64 [m], and cells (m, 4) int32, positively oriented if the file's orientation
        holds.

    Raises:
        MeshError: a file that is missing or unreadable, no ``TetMesh`` or several, an empty one, or indices
            out of range.
    """
    return read_in_child(tet_mesh, path, MeshError)


def read_surface_mesh(path: str | Path) -> tuple[np.ndarray, np.ndarray]:
    """Reads the surface of a USD file, at rest: all its ``Mesh`` prims that are meant to be seen, as one.

    Polygons are cut into triangles around their first corner; subdivision is not applied. Units, axes and
    time are those of :func:`read_tet_mesh`.

    Args:
        path: a USD file with at least one ``Mesh``.

    Returns:
        Points (n, 3) float64 [m], and triangles (k, 3) int32, counter-clockwise as seen from outside if the
        file's orientation holds.

    Raises:
        MeshError: a file that is missing or unreadable, no ``Mesh``, an empty one, or indices that do not
            fit.
    """
    return read_in_child(surface_mesh, path, MeshError)


def tet_mesh(path: str) -> tuple[np.ndarray, np.ndarray]:
    """What :func:`read_tet_mesh` returns; called in a child process."""
    stage = open_stage(path, MeshError)
    with reporting(f"{path} cannot be read as USD", MeshError):
        prims = [prim for prim in stage.Traverse(Usd.TraverseInstanceProxies()) if prim.IsA(UsdGeom.TetMesh)]
        if len(prims) != 1:
            found = ", ".join(str(prim.GetPath()) for prim in prims) or "none"
            raise MeshError(f"{path}: there must be one TetMesh in the file, found: {found}")
        mesh = UsdGeom.TetMesh(prims[0])
        cells = np.array(at_rest(mesh.GetTetVertexIndicesAttr()) or [], np.int32).reshape(-1, 4)
        points, mirrored = _world_points(mesh)
    _check_indices(f"{path}, {mesh.GetPath()}", cells.reshape(-1), len(points))
    return points, cells[:, [0, 2, 1, 3]] if mirrored else cells


def surface_mesh(path: str) -> tuple[np.ndarray, np.ndarray]:
    """What :func:`read_surface_mesh` returns; called in a child process."""
    stage = open_stage(path, MeshError)
    with reporting(f"{path} cannot be read as USD", MeshError):
        meshes = [UsdGeom.Mesh(prim) for prim in stage.Traverse(Usd.TraverseInstanceProxies())]
        seen = (UsdGeom.Tokens.default_, UsdGeom.Tokens.render)
        parts = [triangles_of(mesh) for mesh in meshes if mesh and mesh.ComputePurpose() in seen]
    if not parts:
        raise MeshError(f"{path}: there is no Mesh in the file")
    offsets = np.cumsum([0, *(len(points) for points, _ in parts[:-1])], dtype=np.int32)
    triangles = [faces + offset for (_, faces), offset in zip(parts, offsets, strict=True)]
    return np.concatenate([points for points, _ in parts]), np.concatenate(triangles)


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
