"""From a file to a mesh, or to a surface."""

from __future__ import annotations

import importlib.util
import os
from pathlib import Path
from typing import Any, get_args

import numpy as np

from warpfem.boundary import is_number
from warpfem.child import existing, read_in_child
from warpfem.errors import MeshError, MissingExtraError
from warpfem.mesh import Mesh
from warpfem.meshing import meshio_files, trimesh_files
from warpfem.meshing.contents import Axis, Solid, Surface, naming
from warpfem.meshing.filling import checked_surface, tetrahedralize

_USD = {".usd", ".usda", ".usdc", ".usdz"}


def load_mesh(
    path: str | os.PathLike[str],
    *,
    scale: float = 1.0,
    up_axis: Axis = "Y",
    edge_length: float | None = None,
    envelope: float | None = None,
    progress: bool = True,
) -> Mesh:
    """Load a mesh of whatever a file holds.

    =====================================  ==============================================================
    file                                   mesh
    =====================================  ==============================================================
    .usd, .usda, .usdc, .usdz              its ``TetMesh``; if there is none, its ``Mesh`` prims are a surface
    .obj, .stl, .ply, .off, .glb, .gltf    a surface, read by trimesh
    .msh, .vtu, .vtk, .mesh, .inp, others  tetrahedra (3D), or triangles in a plane of constant z (2D), linear or
                                           quadratic, read by meshio; triangles off the plane are a surface
    =====================================  ==============================================================

    A surface is filled with tetrahedra by :func:`tetrahedralize`, which keeps what it made for the next time. All
    geometries of a file are joined, each where the transforms of the file put it.

    Of cells, midpoints of quadratic ones stay where the file has them, so that curved edges stay curved; inverted ones
    are turned round and unused points dropped (:meth:`Mesh.repaired`). Named groups of cells become cell sets; those of
    faces, edges and vertices become sets of their points. Physical groups of Gmsh and references of Medit without a
    name are called ``volume_1``, ``surface_2``, ``curve_3`` and ``point_4`` by their numbers. One number per cell, such
    as a modulus or a density, becomes :attr:`Mesh.cell_data`; of whole numbers, such as those of regions, each value
    makes a set as well: ``region_1``, ``region_2``.

    Args:
        path: the file.
        scale: factor of all coordinates, > 0: ``1e-3`` for an STL in millimetres. USD files that state their
            ``metersPerUnit`` come in metres, and so does glTF; of other formats the numbers are taken for metres.
        up_axis: the axis that shall point up, "Y" or "Z", as in :class:`Scene`. USD files that state their ``upAxis``,
            and glTF, whose is Y, are turned; other formats do not say which it is, and stay as they are.
        edge_length: edge length to aim for in a surface [m], after scaling; ``None`` as for :func:`tetrahedralize`.
        envelope: largest distance of the mesh from a surface [m], likewise.
        progress: tell on the standard error how long filling takes, if that is a terminal.

    Returns:
        The mesh, 2D for triangles in a plane, else 3D.

    Raises:
        MeshError: the file is missing, damaged or of an unknown format, has cells of other kinds or several ``TetMesh``
            prims, its mesh cannot be simulated, its surface is flat or open, or an option is out of its domain or is
            for surfaces alone.
        MissingExtraError: a package that reads the format, or fills surfaces, is not installed.
    """
    path = existing(path, MeshError)
    _check_options(scale, up_axis)
    found: Solid | Surface = _read(path, surface=False)
    with naming(path):
        points = _placed(found, scale, up_axis)
        if isinstance(found, Surface):
            return tetrahedralize(points, found.triangles, edge_length, envelope, progress)
        if edge_length is not None or envelope is not None:
            raise MeshError(
                "edge_length and envelope are for surfaces, and the file holds cells already: leave them out"
            )
        return Mesh.repaired(points, found.cells, found.point_sets, found.cell_sets, found.cell_data)


def read_surface(
    path: str | os.PathLike[str], *, scale: float = 1.0, up_axis: Axis = "Y"
) -> tuple[np.ndarray, np.ndarray]:
    """Read a surface in space, as triangles, to change it before :func:`tetrahedralize` fills it.

    Args:
        path: a file that :func:`load_mesh` knows; of one with tetrahedra, the faces that it has besides. Faces with
            more corners are cut into triangles.
        scale: as for :func:`load_mesh`.
        up_axis: likewise.

    Returns:
        points (n, 3) float64 [m] and triangles (k, 3) int32.

    Raises:
        MeshError: the file is missing, damaged or of an unknown format, or has no faces.
        MissingExtraError: the package that reads the format is not installed.
    """
    path = existing(path, MeshError)
    _check_options(scale, up_axis)
    found: Surface = _read(path, surface=True)
    with naming(path):
        return checked_surface(_placed(found, scale, up_axis), found.triangles)


def _read(path: Path, *, surface: bool) -> Any:
    """What a file holds, or the surface in it alone, by the library that reads it."""
    suffix = path.suffix.lower()
    if suffix in _USD:
        from warpfem.usd import read_mesh, read_surface_mesh

        return read_surface_mesh(path) if surface else read_mesh(path)
    if suffix in trimesh_files.SUFFIXES:
        return _read_by("trimesh", trimesh_files.read, path)
    return _read_by("meshio", meshio_files.read_surface if surface else meshio_files.read_solid_or_surface, path)


def _read_by(package: str, read: Any, path: Path) -> Any:
    if importlib.util.find_spec(package) is None:
        raise MissingExtraError(f"reading {path.name}", package, "mesh")
    return read_in_child(read, path, MeshError)


def _check_options(scale: float, up_axis: Axis) -> None:
    if not is_number(scale) or scale <= 0.0:
        raise MeshError(f"scale must be a positive number, not {scale!r}")
    if not isinstance(up_axis, str) or up_axis not in get_args(Axis):
        raise MeshError(f"up_axis must be 'Y' or 'Z', not {up_axis!r}")


def _placed(found: Solid | Surface, scale: float, up_axis: Axis) -> np.ndarray:
    """The points scaled, and turned about x so that what is up in the file is up along the axis."""
    points = scale * np.asarray(found.points, dtype=np.float64)
    if found.up_axis in (None, up_axis):
        return points
    x, y, z = points.T
    return np.column_stack([x, z, -y] if up_axis == "Y" else [x, -z, y])
