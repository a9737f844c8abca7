"""Tetrahedra inside a surface, by fTetWild."""

from __future__ import annotations

import importlib.metadata
import importlib.util
import os
import warnings
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from warpfem.boundary import is_number
from warpfem.child import ChildError, call_in_child
from warpfem.errors import MeshError, MissingExtraError
from warpfem.mesh import Mesh, _array, _check_references
from warpfem.meshing import cache
from warpfem.meshing.waiting import telling_time

MAX_CLOSED_AREA_RATIO = 1.1
"""A mesh whose boundary is larger than the given surface by more than this had holes to close."""

MAX_LOST_SHARE = 0.01
"""If more of the surface than this is away from the mesh, parts of the body are missing."""

_SAMPLES = 200


def tetrahedralize(
    points: np.ndarray,
    triangles: np.ndarray,
    edge_length: float | None = None,
    envelope: float | None = None,
    progress: bool = True,
) -> Mesh:
    """Fill a surface with tetrahedra by fTetWild (Hu et al., ACM Trans. Graph. 39(4), 2020).

    The surface may intersect itself, consist of several parts, have edges with more than two triangles, duplicate
    points, triangles of either orientation, and small holes.

    Time grows with the fineness: seconds for a few thousand cells, minutes for a hundred thousand. Two runs of fTetWild
    differ, even in their numbers of cells; so the first mesh of a surface, an edge length and an envelope is kept on
    the disk (``warpfem.meshing.cache``), and is the mesh of all later calls.

    Args:
        points: (n, 3) positions [m].
        triangles: (k, 3) point indices.
        edge_length: edge length to aim for [m], > 0, at most the diagonal of the bounding box; where the
            surface has finer detail, edges are shorter. ``None`` takes a twentieth of that diagonal.
        envelope: largest distance of the mesh from the surface [m], > 0, at most the edge length. Small ones follow
            fine detail by small cells, large ones smooth it away, and parts that are thinner vanish. ``None`` takes a
            tenth of the edge length, or for thin bodies less.
        progress: tell on the standard error how long it takes, if that is a terminal.

    Returns:
        A 3D mesh without sets.

    Raises:
        MeshError: points or triangles have the wrong shape or type, are out of range or not finite, the
            surface is flat or open, the edge length or the envelope is out of its domain, or fTetWild fails.
        MissingExtraError: pytetwild, or something that it needs, is not installed.
    """
    points, triangles = checked_surface(points, triangles)
    corners = points[triangles]
    area_vectors = 0.5 * np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    areas = np.linalg.norm(area_vectors, axis=1)
    area = areas.sum()
    lower = corners.min(axis=(0, 1))
    diagonal = float(np.linalg.norm(corners.max(axis=(0, 1)) - lower))
    spread = np.linalg.eigvalsh(np.cov(corners.reshape(-1, 3).T))  # squares of the extents
    if not (spread[0] > 1e-12 * spread[2] and area > 1e-12 * diagonal**2):
        raise MeshError("the surface is flat and encloses no volume: give the closed surface of a solid")
    if edge_length is None:
        edge_length = diagonal / 20.0
    if not is_number(edge_length) or not 0.0 < edge_length <= diagonal:
        raise MeshError(
            f"edge_length must be above 0 and at most the diagonal of the surface's bounding box, "
            f"{diagonal:g} m, not {edge_length!r}"
        )
    if envelope is None:
        # volume by the divergence theorem; where parts of the surface are turned round it is too small
        half_thickness = abs(np.linalg.det(corners - lower).sum()) / 6.0 / area
        envelope = min(edge_length / 10.0, max(half_thickness / 2.0, diagonal / 1000.0))
    if not is_number(envelope) or not 0.0 < envelope <= edge_length:
        raise MeshError(f"envelope must be above 0 and at most the edge length, {edge_length:g} m, not {envelope!r}")

    # fTetWild loses accuracy far from the origin, and takes unused points for part of the surface.
    welded, faces = np.unique(((corners - lower) / diagonal).reshape(-1, 3), axis=0, return_inverse=True)
    problem = {
        "points": welded,
        "triangles": faces.reshape(-1, 3).astype(np.int32),
        "edge_length": np.array(edge_length / diagonal),
        "envelope": np.array(envelope / diagonal),
    }
    filled, cells = _filled(problem, progress)
    if not len(cells):
        raise MeshError("the surface encloses no volume: it is open, so close its holes")
    mesh = Mesh.repaired(lower + diagonal * filled, cells)
    ratio = mesh.boundary_face_areas.sum() / area
    if ratio > MAX_CLOSED_AREA_RATIO:
        raise MeshError(
            f"the surface is open: closing it took {ratio - 1.0:.0%} more area than it has; close its holes"
        )
    lost = _lost_share(mesh, corners, areas, envelope)
    if lost > MAX_LOST_SHARE:
        warnings.warn(
            f"{lost:.0%} of the surface is not near the mesh: parts thinner than the envelope, {envelope:g} m, vanish; "
            "give a smaller envelope if they matter",
            stacklevel=2,
        )
    return mesh


def checked_surface(points: object, triangles: object) -> tuple[np.ndarray, np.ndarray]:
    """Points (n, 3) float64 and triangles (k, 3) int32.

    Raises:
        MeshError: they have the wrong shape or type, or are out of range or not finite.
    """
    positions = _array("points", points, "iuf", "an (n, 3) array of numbers").astype(np.float64)
    indices = _array("triangles", triangles, "iu", "a (k, 3) array of point indices (integers)")
    for name, array in (("points", positions), ("triangles", indices)):
        if array.ndim != 2 or array.shape[1] != 3 or not len(array):
            raise MeshError(f"the {name} of a surface must be an array (k, 3), k > 0, not {array.shape}")
    _check_references("triangle", positions, indices)
    return positions, indices.astype(np.int32)


def _filled(problem: dict[str, np.ndarray], progress: bool) -> tuple[np.ndarray, np.ndarray]:
    """Points (n, 3) float64 and cells (m, 4) int32 of a surface of unit size, from the cache if they are there."""
    try:
        found = importlib.util.find_spec("pytetwild")
        version = importlib.metadata.version("pytetwild")
    except importlib.metadata.PackageNotFoundError:
        found = None
    if found is None:
        raise MissingExtraError("filling a surface", "pytetwild", "tet")
    key = cache.key(f"pytetwild {version}", problem)
    kept = cache.recall(key)
    if kept is not None:
        return kept
    what = f"filling a surface of {len(problem['triangles'])} triangles with tetrahedra"
    with TemporaryDirectory() as scratch, telling_time(what, progress):
        path = Path(scratch) / "surface.npz"
        np.savez(path, **problem)  # type: ignore[arg-type]
        try:
            made = call_in_child(fill, path)
        except (ChildError, OSError) as error:
            raise MeshError(
                f"fTetWild could not fill the surface ({error}): try a smaller envelope, or another edge_length"
            ) from error
    return cache.keep(key, *made)


def _lost_share(mesh: Mesh, corners: np.ndarray, areas: np.ndarray, envelope: float) -> float:
    """The share of a surface's area that is farther from the mesh than some envelopes, by samples."""
    ends = np.cumsum(areas)
    chosen = np.searchsorted(ends, ends[-1] * (np.arange(_SAMPLES) + 0.5) / _SAMPLES)
    samples = corners[chosen].mean(axis=1)
    cells = mesh.points[mesh.corners]
    lower, upper = cells.min(axis=1) - 3.0 * envelope, cells.max(axis=1) + 3.0 * envelope
    near = [((lower <= sample) & (sample <= upper)).all(axis=1).any() for sample in samples]
    return 1.0 - float(np.mean(near))


def fill(path: str) -> tuple[np.ndarray, np.ndarray]:
    """Points and cells made by fTetWild of what a file says; called in a child process, which it may crash."""
    try:
        import pytetwild
    except ImportError as error:
        raise MissingExtraError("filling a surface", error.name or "pytetwild", "tet") from error
    with np.load(path) as problem:
        points, triangles = problem["points"], problem["triangles"]
        edge_length, envelope = float(problem["edge_length"]), float(problem["envelope"])
    os.chdir(Path(path).parent)  # it leaves a file where it runs
    filled, cells = pytetwild.tetrahedralize(
        points, triangles, edge_length_fac=edge_length, epsilon=envelope, vtk_ordering=True
    )
    return np.array(filled, dtype=np.float64), np.array(cells, dtype=np.int32).reshape(-1, 4)
