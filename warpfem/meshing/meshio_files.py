"""Mesh files by meshio: .msh, .vtu, .vtk, .mesh, .inp and others. Its functions run in a child process."""

from __future__ import annotations

import io
import re
import warnings
from collections import defaultdict
from collections.abc import Iterator
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any

import numpy as np

from warpfem.child import DAMAGED
from warpfem.errors import MeshError, described, one_line
from warpfem.mesh import _check_references
from warpfem.meshing.contents import Solid, Surface, naming, tagged

_CELLS = {2: ("triangle", "triangle6"), 3: ("tetra", "tetra10")}
_CORNERS = {"triangle": 3, "triangle6": 3, "quad": 4, "quad8": 4, "quad9": 4, "polygon": None}
_ENTITIES = ("point", "curve", "surface", "volume")  # Gmsh's words, by dimension
_TAGS = ("gmsh:physical", "medit:ref")
"""Where formats keep the numbers of groups, 0 for cells in none."""

# What a whole file has: without it, meshio reads on for ever or takes a part for the whole.
_MARKS = {
    ".msh": rb"^\$End\w+\s*\Z",
    ".mdpa": rb"^\s*End \w+\s*\Z",
}


def read_solid_or_surface(path: str) -> Solid | Surface:
    """The cells of the file's highest dimension, if they are solid: triangles off the plane are a surface.

    Raises:
        MeshError: the file is damaged, or has other cells.
    """
    with naming(path):
        file = _read_file(Path(path))
        return _surface(file) if _is_surface(file) else _solid(file)


def read_surface(path: str) -> Surface:
    """The faces of the file, whatever else there is.

    Raises:
        MeshError: the file is damaged, or has no faces.
    """
    with naming(path):
        return _surface(_read_file(Path(path)))


def _read_file(path: Path) -> Any:
    """The file as a ``meshio.Mesh``, with what meshio prints turned into errors and warnings."""
    import meshio

    suffix = path.suffix.lower()
    printed = io.StringIO()
    try:
        if suffix in _MARKS and not re.search(_MARKS[suffix], path.read_bytes(), re.MULTILINE):
            raise EOFError("a part is missing")
        with redirect_stdout(printed), redirect_stderr(printed):
            file = meshio.read(path)
        if suffix == ".vtk":
            _require_all_cells(path, file)
    except (Exception, SystemExit) as error:  # meshio raises anything on damaged files, and may exit
        reason = one_line(printed.getvalue()) or described(error)
        raise MeshError(f"{DAMAGED} ({reason})") from error
    if remarks := one_line(printed.getvalue()):
        warnings.warn(f"{path}: meshio says: {remarks}", stacklevel=3)
    return file


def _require_all_cells(path: Path, file: Any) -> None:
    """Raises EOFError where a legacy VTK file is cut short in its cell types, of which meshio takes what is there."""
    stated = re.search(rb"^CELL_TYPES\s+(\d+)", path.read_bytes(), re.MULTILINE)
    if stated and int(stated[1]) != sum(len(block.data) for block in file.cells):
        raise EOFError("a part is missing")


def _is_surface(file: Any) -> bool:
    """Whether the file has faces off the plane of constant z, and nothing solid."""
    faces = [block.data for block in file.cells if block.dim == 2]
    if not faces or any(block.dim == 3 for block in file.cells) or file.points.shape[1] < 3:
        return False
    for rows in faces:
        _check_references("cell", file.points, rows)
    used = file.points[np.unique(np.concatenate([rows.ravel() for rows in faces]))]
    return bool(np.ptp(used[:, 2]) > 1e-9 * np.ptp(used, axis=0).max())


def _surface(file: Any) -> Surface:
    """The faces of a ``meshio.Mesh``; those with more than three corners are cut into fans, curved ones flattened."""
    faces = [block.data[:, : _CORNERS[block.type]] for block in file.cells if block.type in _CORNERS]
    fans = [face[:, [0, k, k + 1]] for face in faces for k in range(1, face.shape[1] - 1)]
    if not fans:
        raise MeshError("the file holds no triangles, quadrilaterals or polygons")
    return Surface(file.points[:, :3], np.concatenate(fans))


def _solid(file: Any) -> Solid:
    """The cells of the highest dimension of a ``meshio.Mesh``, with their sets and data."""
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
    return Solid(
        file.points[:, :dim],
        np.concatenate([block.data for block in file.cells if block.dim == dim]),
        {name: np.concatenate(members) for name, members in point_sets.items()},
        {name: np.concatenate(members) for name, members in cell_sets.items()},
        {
            name: np.concatenate([values for values, block in zip(blocks, file.cells, strict=True) if block.dim == dim])
            for name, blocks in _cell_data(file).items()
        },
    )


def _groups(file: Any) -> Iterator[tuple[str, int, np.ndarray]]:
    """Each set of cells or faces of a ``meshio.Mesh`` as name, block number and members (int64) in the block."""
    for name, blocks in file.cell_sets.items():
        if not name.startswith("gmsh:"):  # meshio keeps other things there
            for number, members in enumerate(blocks):
                if members is not None and len(members):
                    yield name, number, np.asarray(members, dtype=np.int64)
    for key in _TAGS:
        blocks = file.cell_data.get(key, [])
        names = {tuple(value): name for name, value in file.field_data.items()} if blocks else {}
        for number, tags in enumerate(blocks):
            dim = file.cells[number].dim
            for tag in np.unique(tags[tags != 0]):
                name = names.get((tag, dim), f"{_ENTITIES[dim]}_{tag}")
                yield name, number, np.flatnonzero(tags == tag)
    for key, blocks in _cell_data(file).items():
        for number, tags in enumerate(blocks):
            for name, members in tagged(key, tags):
                yield name, number, members


def _cell_data(file: Any) -> dict[str, list[np.ndarray]]:
    """The data of one number per cell, by name and block; vectors, tensors and what formats add are left out."""
    found = {}
    for name, blocks in file.cell_data.items():
        arrays = [np.asarray(values) for values in blocks]
        is_scalar = all(values.dtype.kind in "biuf" and values.size == len(values) for values in arrays)
        if is_scalar and not name.startswith(("gmsh:", "medit:")):
            found[name] = [values.ravel() for values in arrays]
    return found
