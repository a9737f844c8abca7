"""Meshes out of USD files that others made."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from pxr import Tf, Usd, UsdGeom

from warpfem.errors import MeshError, WarpfemError


def read_tet_mesh(path: str | Path) -> tuple[np.ndarray, np.ndarray]:
    """Reads the ``TetMesh`` of a USD file, at rest.

    Positions are taken to the world, and to metres by the stage's ``metersPerUnit`` where the file states one.
    Where it does not, numbers are taken as metres: USD's fallback of a centimetre is what nobody meant who did
    not write it. The axes stay as they are, whatever ``upAxis`` says. "At rest" is the default value, or the
    first sample of a mesh that has only samples.

    Args:
        path: a USD file with exactly one ``TetMesh``.

    Returns:
        Points (n, 3) float64 [m], and cells (m, 4) int32, positively oriented if the file's orientation is true.

    Raises:
        MeshError: a file that is missing or unreadable, no ``TetMesh`` or several, or indices out of range.
    """
    stage = open_stage(path, MeshError)
    prims = [prim for prim in _traverse(stage) if prim.IsA(UsdGeom.TetMesh)]
    if len(prims) != 1:
        found = ", ".join(str(prim.GetPath()) for prim in prims) or "none"
        raise MeshError(f"{path}: there must be one TetMesh in the file, found: {found}")
    mesh = UsdGeom.TetMesh(prims[0])
    cells = np.array(at_rest(mesh.GetTetVertexIndicesAttr()) or [], np.int32).reshape(-1, 4)
    points, mirrored = world_points(mesh)
    _check_indices(path, prims[0], cells, len(points))
    return points, cells[:, [0, 2, 1, 3]] if mirrored else cells


def read_surface_mesh(path: str | Path) -> tuple[np.ndarray, np.ndarray]:
    """Reads the surface of a USD file, at rest: all its ``Mesh`` prims that are meant to be rendered, as one.

    Polygons are cut into triangles around their first corner; subdivision is not applied. Units, axes and time
    are those of :func:`read_tet_mesh`.

    Args:
        path: a USD file with at least one ``Mesh``.

    Returns:
        Points (n, 3) float64 [m], and triangles (k, 3) int32, counter-clockwise seen from outside if the file's
        orientation is true.

    Raises:
        MeshError: a file that is missing or unreadable, no ``Mesh``, or indices out of range.
    """
    stage = open_stage(path, MeshError)
    rendered = (UsdGeom.Tokens.default_, UsdGeom.Tokens.render)
    prims = [prim for prim in _traverse(stage) if prim.IsA(UsdGeom.Mesh)]
    prims = [prim for prim in prims if UsdGeom.Imageable(prim).ComputePurpose() in rendered]
    if not prims:
        raise MeshError(f"{path}: there is no Mesh in the file")
    parts = [surface_of(path, UsdGeom.Mesh(prim)) for prim in prims]
    offsets = np.cumsum([0, *(len(points) for points, _ in parts)])
    triangles = [faces + offset for (_, faces), offset in zip(parts, offsets[:-1], strict=True)]
    return np.concatenate([points for points, _ in parts]), np.concatenate(triangles).astype(np.int32)


def open_stage(path: str | Path, error: type[WarpfemError]) -> Usd.Stage:
    """Opens a USD file.

    Raises:
        error: the file is missing, or not readable as USD.
    """
    if not Path(path).is_file():
        raise error(f"{path}: there is no such file")
    try:
        return Usd.Stage.Open(str(path))
    except Tf.ErrorException as problem:
        reason = "; ".join(item.commentary.strip() for item in problem.args)
        raise error(f"{path} cannot be read as USD: {reason}") from None


def surface_of(path: str | Path, mesh: UsdGeom.Mesh) -> tuple[np.ndarray, np.ndarray]:
    """World points (n, 3) float64 [m] and triangles (k, 3) int32 of a ``Mesh`` at rest.

    Raises:
        MeshError: face counts and indices that do not fit each other, or indices out of range.
    """
    counts = np.array(at_rest(mesh.GetFaceVertexCountsAttr()) or [], np.int64)
    indices = np.array(at_rest(mesh.GetFaceVertexIndicesAttr()) or [], np.int64)
    points, mirrored = world_points(mesh)
    if counts.sum() != len(indices) or (counts < 3).any():
        raise MeshError(
            f"{path}, {mesh.GetPath()}: faceVertexCounts must be at least 3 each and sum to the "
            f"{len(indices)} faceVertexIndices, not to {counts.sum()}"
        )
    _check_indices(path, mesh.GetPrim(), indices, len(points))
    fans = counts - 2
    first = np.repeat(np.cumsum(counts) - counts, fans)
    step = np.arange(fans.sum()) - np.repeat(np.cumsum(fans) - fans, fans)
    triangles = indices[np.column_stack([first, first + step + 1, first + step + 2])].astype(np.int32)
    return points, triangles[:, ::-1] if mirrored else triangles


def world_points(prim: UsdGeom.PointBased) -> tuple[np.ndarray, bool]:
    """World points (n, 3) float64 [m] at rest, and whether the winding has to be reversed."""
    points = np.array(at_rest(prim.GetPointsAttr()) or [], np.float64).reshape(-1, 3)
    matrix = world_matrix(prim.GetPrim())
    left_handed = at_rest(prim.GetOrientationAttr()) == UsdGeom.Tokens.leftHanded
    return points @ matrix[:3, :3] + matrix[3, :3], left_handed != (np.linalg.det(matrix[:3, :3]) < 0.0)


def world_matrix(prim: Usd.Prim) -> np.ndarray:
    """The (4, 4) float64 matrix that takes row vectors from the prim to the world in metres."""
    stage = prim.GetStage()
    stated = stage.HasAuthoredMetadata(UsdGeom.Tokens.metersPerUnit)
    unit = UsdGeom.GetStageMetersPerUnit(stage) if stated else 1.0
    matrix = np.array(UsdGeom.XformCache(Usd.TimeCode.EarliestTime()).GetLocalToWorldTransform(prim))
    matrix[:, :3] *= unit
    return matrix


def at_rest(attribute: Usd.Attribute):
    """The default value of an attribute, or its first sample if there is no default."""
    value = attribute.Get()
    return attribute.Get(Usd.TimeCode.EarliestTime()) if value is None else value


def _traverse(stage: Usd.Stage):
    return stage.Traverse(Usd.TraverseInstanceProxies())


def _check_indices(path: str | Path, prim: Usd.Prim, indices: np.ndarray, point_count: int) -> None:
    if indices.size == 0 or point_count == 0:
        raise MeshError(f"{path}, {prim.GetPath()}: the mesh is empty")
    bad = np.flatnonzero((indices.reshape(-1) < 0) | (indices.reshape(-1) >= point_count))
    if len(bad):
        raise MeshError(
            f"{path}, {prim.GetPath()}: {len(bad)} indices are outside of its {point_count} points, the first one "
            f"is {indices.reshape(-1)[bad[0]]} at position {bad[0]}"
        )
