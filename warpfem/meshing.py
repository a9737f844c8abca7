"""Meshes from elsewhere: mesh files, surface files, and tetrahedra inside a closed surface.

Files are read in a child process: what is wrong with one cannot harm this one.

What this needs beyond NumPy is optional and imported where it is used: ``meshio`` (extra ``mesh``) reads
mesh files, ``pytetwild`` (extra ``tet``) fills surfaces.
"""

from __future__ import annotations

import importlib.util
import io
import os
import re
import warnings
from collections import defaultdict
from collections.abc import Iterator
from contextlib import chdir, contextmanager, redirect_stderr, redirect_stdout
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from warpfem.boundary import is_number
from warpfem.child import DAMAGED, existing, read_in_child
from warpfem.errors import MeshError, MissingExtraError, described, one_line
from warpfem.mesh import Mesh, _array, _check_references

_USD = {".usd", ".usda", ".usdc", ".usdz"}
_CELLS = {2: ("triangle", "triangle6"), 3: ("tetra", "tetra10")}
_ENTITIES = ("point", "curve", "surface", "volume")  # Gmsh's words, by dimension

# What a whole file has: without it, meshio reads on for ever or takes a part for the whole.
_MARKS = {
    ".msh": rb"^\$End\w+\s*\Z",
    ".mdpa": rb"^\s*End \w+\s*\Z",
    ".ply": rb"^end_header\s",
    ".off": rb"^\s*\d+\s+\d+\s+\d+\s",
    ".stl": rb"\A(?!solid)|^\s*endsolid",  # text starts with the word
}

MAX_CLOSED_AREA_RATIO = 1.1
"""A mesh whose boundary is larger than the given surface by more than this had holes to close."""


def read_mesh(path: str | os.PathLike[str]) -> Mesh:
    """Read a mesh of tetrahedra (3D) or of triangles in a plane of constant z (2D), linear or quadratic.

    Midpoints of quadratic cells stay where the file has them, so that curved edges stay curved. Inverted cells are
    turned round and unused points dropped (:meth:`Mesh.repaired`). Named groups of cells become cell sets; named
    groups of faces, edges and vertices become sets of their points. Gmsh's physical groups without a name are called
    ``volume_1``, ``surface_2``, ``curve_3`` and ``point_4`` by their tags.

    Args:
        path: a USD file with a tetrahedral mesh, or what meshio reads by its extension: .msh (Gmsh 2.2 and
            4.1), .vtu, .vtk, .mesh, .inp and others. Coordinates are taken to be in metres.

    Returns:
        The mesh, 3D if the file has tetrahedra.

    Raises:
        MeshError: the file is missing, damaged or of an unknown format, has other cells than these, or its
            mesh cannot be simulated; triangles off the plane are a surface, for :func:`tetrahedralize`.
        MissingExtraError: meshio is not installed.
    """
    path = existing(path, MeshError)
    if path.suffix.lower() in _USD:
        from warpfem.usd import read_tet_mesh

        points, cells = read_tet_mesh(path)
        with _naming(path):
            return Mesh.repaired(points, cells)
    _require_meshio(path)
    arrays = read_in_child(read_solid_file, path, MeshError)
    with _naming(path):
        return Mesh.repaired(*arrays)


def read_surface(path: str | os.PathLike[str]) -> tuple[np.ndarray, np.ndarray]:
    """Read a surface in space, as triangles.

    Args:
        path: a USD file with a mesh, or what meshio reads by its extension: .obj, .ply, .stl, .off and
            others. Coordinates are taken to be in metres. Faces with more corners are cut into fans.

    Returns:
        points (n, 3) float64 [m] and triangles (k, 3) int32, as :func:`tetrahedralize` takes them.

    Raises:
        MeshError: the file is missing, damaged or of an unknown format, or has no faces.
        MissingExtraError: meshio is not installed.
    """
    path = existing(path, MeshError)
    if path.suffix.lower() in _USD:
        from warpfem.usd import read_surface_mesh

        arrays = read_surface_mesh(path)
    else:
        _require_meshio(path)
        arrays = read_in_child(read_surface_file, path, MeshError)
    with _naming(path):
        return _surface(*arrays)


def tetrahedralize(points: np.ndarray, triangles: np.ndarray, edge_length: float | None = None) -> Mesh:
    """Fill a closed surface with tetrahedra by fTetWild (Hu et al., ACM Trans. Graph. 39(4), 2020).

    The surface may intersect itself, have duplicate points or triangles of either orientation, and small
    holes. The mesh follows it within ``edge_length / 10``. Two runs differ, even in their numbers of cells.
    Time grows with the fineness: seconds for a few thousand cells, minutes for a hundred thousand. The
    process works in another directory meanwhile, because fTetWild leaves a file in the current one.

    Args:
        points: (n, 3) positions [m].
        triangles: (k, 3) point indices.
        edge_length: edge length to aim for [m], > 0, at most the diagonal of the bounding box; where the
            surface has finer detail, edges are shorter. ``None`` takes a twentieth of that diagonal.

    Returns:
        A 3D mesh without sets.

    Raises:
        MeshError: points or triangles have the wrong shape or type, are out of range or not finite, the
            surface is flat or open, or the edge length is out of its domain.
        MissingExtraError: pytetwild, or something that it needs, is not installed.
    """
    points, triangles = _surface(points, triangles)
    corners = points[triangles]
    area_vectors = 0.5 * np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(area_vectors, axis=1).sum()
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
    try:
        import pytetwild
    except ImportError as error:
        raise MissingExtraError("filling a surface", error.name or "pytetwild", "tet") from error

    # fTetWild loses accuracy far from the origin, and takes unused points for part of the surface.
    welded, faces = np.unique(((corners - lower) / diagonal).reshape(-1, 3), axis=0, return_inverse=True)
    fraction = edge_length / diagonal
    with TemporaryDirectory() as scratch, chdir(scratch):  # it leaves a file where it runs
        filled, cells = pytetwild.tetrahedralize(
            welded,
            faces.reshape(-1, 3).astype(np.int32),
            edge_length_fac=fraction,
            epsilon=fraction / 10.0,
            vtk_ordering=True,
        )
    if not len(cells):
        raise MeshError("the surface encloses no volume: it is open, so close its holes")
    mesh = Mesh.repaired(lower + diagonal * filled, cells)
    ratio = mesh.boundary_face_areas.sum() / area
    if ratio > MAX_CLOSED_AREA_RATIO:
        raise MeshError(
            f"the surface is open: closing it took {ratio - 1.0:.0%} more area than it has; close its holes"
        )
    return mesh


# ---- files


@contextmanager
def _naming(path: str | Path) -> Iterator[None]:
    """Put the file's name in front of errors about what is in it."""
    try:
        yield
    except MeshError as error:
        raise MeshError(f"{path}: {error}") from error


def _require_meshio(path: Path) -> None:
    if importlib.util.find_spec("meshio") is None:
        raise MissingExtraError(f"reading {path.name}", "meshio", "mesh")


def read_solid_file(path: str) -> tuple[np.ndarray, np.ndarray, dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Points, cells, point sets and cell sets for :meth:`Mesh.repaired`; called in a child process."""
    with _naming(path):
        return _solid(_read_file(Path(path)))


def read_surface_file(path: str) -> tuple[np.ndarray, np.ndarray]:
    """Points and triangles of a surface; called in a child process."""
    with _naming(path):
        file = _read_file(Path(path))
        faces = [block.data for block in file.cells if block.type in ("triangle", "quad", "polygon")]
        fans = [face[:, [0, k, k + 1]] for face in faces for k in range(1, face.shape[1] - 1)]
        if not fans:
            raise MeshError("the file holds no triangles, quadrilaterals or polygons")
        return file.points[:, :3], np.concatenate(fans)


def _read_file(path: Path) -> Any:
    """The file as a ``meshio.Mesh``, with what meshio prints turned into errors and warnings."""
    import meshio

    mark = _MARKS.get(path.suffix.lower())
    printed = io.StringIO()
    try:
        if mark and not re.search(mark, path.read_bytes(), re.MULTILINE):
            raise EOFError("a part is missing")
        with redirect_stdout(printed), redirect_stderr(printed):
            file = meshio.read(path)
    except (Exception, SystemExit) as error:  # meshio raises anything on damaged files, and may exit
        reason = one_line(printed.getvalue()) or described(error)
        raise MeshError(f"{DAMAGED} ({reason})") from error
    if remarks := one_line(printed.getvalue()):
        warnings.warn(f"{path}: meshio says: {remarks}", stacklevel=3)
    return file


def _solid(file: Any) -> tuple[np.ndarray, np.ndarray, dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Points, cells of the highest dimension, point sets and cell sets of a ``meshio.Mesh``."""
    dim = max((block.dim for block in file.cells), default=0)
    if dim < 2:
        raise MeshError("the file holds no triangles or tetrahedra")
    for block in file.cells:
        if block.dim == dim and block.type not in _CELLS[dim]:
            raise MeshError(
                f"the file holds {len(block)} cells of type '{block.type}': only triangles and tetrahedra, linear or "
                "quadratic, can be read; mesh again with these"
            )
    kinds = {block.type for block in file.cells if block.dim == dim}
    if len(kinds) > 1:
        raise MeshError(f"the file mixes cells of types {' and '.join(sorted(kinds))}: mesh again with one of them")
    cells = np.concatenate([block.data for block in file.cells if block.dim == dim])
    points = np.asarray(file.points)
    if dim == 2 and points.shape[1] == 3:
        used = points[np.unique(cells)]
        if np.ptp(used[:, 2]) > 1e-9 * np.ptp(used, axis=0).max():
            raise MeshError(
                "the triangles do not lie in a plane of constant z: they are a surface; fill it with "
                "tetrahedralize(*read_surface(path))"
            )
        points = points[:, :2]

    point_sets, cell_sets = defaultdict(list), defaultdict(list)
    for name, members in file.point_sets.items():
        point_sets[name].append(members)
    offsets = np.cumsum([0] + [len(block) if block.dim == dim else 0 for block in file.cells])
    for name, number, members in _groups(file):
        block = file.cells[number]
        if block.dim == dim:
            cell_sets[name].append(offsets[number] + members)
        else:
            point_sets[name].append(block.data[members].ravel())
    return (
        points,
        cells,
        {name: np.concatenate(members) for name, members in point_sets.items()},
        {name: np.concatenate(members) for name, members in cell_sets.items()},
    )


def _groups(file: Any) -> Iterator[tuple[str, int, np.ndarray]]:
    """Each named group of a ``meshio.Mesh`` as name, block number and members (int64) in the block."""
    for name, blocks in file.cell_sets.items():
        if not name.startswith("gmsh:"):  # meshio keeps other things there
            for number, members in enumerate(blocks):
                if members is not None and len(members):
                    yield name, number, np.asarray(members, dtype=np.int64)
    tagged = file.cell_data.get("gmsh:physical", [])
    names = {tuple(value): name for name, value in file.field_data.items()} if tagged else {}
    for number, tags in enumerate(tagged):
        dim = file.cells[number].dim
        for tag in np.unique(tags[tags != 0]):  # 0: in no group
            name = names.get((tag, dim), f"{_ENTITIES[dim]}_{tag}")
            yield name, number, np.flatnonzero(tags == tag)


# ---- surfaces


def _surface(points: object, triangles: object) -> tuple[np.ndarray, np.ndarray]:
    """Points and triangles in their types, checked."""
    positions = _array("points", points, "iuf", "an (n, 3) array of numbers").astype(np.float64)
    indices = _array("triangles", triangles, "iu", "a (k, 3) array of point indices (integers)")
    for name, array in (("points", positions), ("triangles", indices)):
        if array.ndim != 2 or array.shape[1] != 3 or not len(array):
            raise MeshError(f"the {name} of a surface must be an array (k, 3), k > 0, not {array.shape}")
    _check_references("triangle", positions, indices)
    return positions, indices.astype(np.int32)
