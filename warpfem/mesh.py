"""Meshes of triangles (2D) and tetrahedra (3D), linear or quadratic: checks, named sets, boundary, quality, builders.

A :class:`Mesh` holds rest positions and never changes. Whatever can be wrong with it is reported when it is
made, so that nothing downstream has to look again.
"""

from __future__ import annotations

import difflib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import combinations
from types import MappingProxyType
from typing import Any, Literal, TypeAlias

import numpy as np

from warpfem.boundary import is_number
from warpfem.errors import MeshError, source_of, user_code
from warpfem.shapes import Shape, shape, shape_of_points

Selection: TypeAlias = str | int | Sequence[int] | np.ndarray
"""The name of a set, or indices."""

Definition: TypeAlias = int | Sequence[int] | np.ndarray | Callable[[np.ndarray], np.ndarray]
"""Indices, or a function of the (k, dim) positions [m] that returns a boolean mask (k,)."""

MIN_QUALITY = 1e-8
"""Cells below this mean-ratio quality count as having no volume: flat, but for rounding."""

# Splits of a square and a cube into simplices; corner i + 2 j + 4 k lies at (i, j, k).
_SQUARE = np.array([[0, 1, 3], [0, 3, 2]])
_CUBE_5 = np.array([[0, 3, 6, 5], [1, 0, 5, 3], [2, 0, 3, 6], [4, 0, 6, 5], [7, 3, 5, 6]])
_CUBE_6 = np.array([[0, 1, 3, 7], [0, 3, 2, 7], [0, 2, 6, 7], [0, 6, 4, 7], [0, 4, 5, 7], [0, 5, 1, 7]])

_SIDES = (("left", "right"), ("bottom", "top"), ("back", "front"))


@dataclass(frozen=True)
class MeshQuality:
    """How well shaped the cells of a mesh are.

    Attributes:
        worst: smallest mean-ratio quality (1 for a regular cell, 0 for a flat one).
        worst_cell: the index of that cell.
        mean: mean of the quality.
        shortest_edge: length of the shortest edge [m].
        longest_edge: length of the longest edge [m].
    """

    worst: float
    worst_cell: int
    mean: float
    shortest_edge: float
    longest_edge: float

    def __str__(self) -> str:
        return (
            f"quality {self.worst:.3g} (cell {self.worst_cell}) to mean {self.mean:.3g}, "
            f"edges {self.shortest_edge:.3g} to {self.longest_edge:.3g} m"
        )


@dataclass(frozen=True, eq=False, repr=False)
class Mesh:
    """A body at rest, divided into triangles (2D) or tetrahedra (3D), linear or quadratic.

    The arrays are copied, checked and made read-only. Sets are stored sorted, each index once; a set may be
    empty, but selecting an empty set is an error.

    Attributes:
        points: (n, dim) float64, rest positions [m], dim 2 or 3.
        cells: (m, k) int32, the points of each cell: triangles counterclockwise, tetrahedra with
            det(X1 - X0, X2 - X0, X3 - X0) > 0. Linear cells have k = dim + 1 corners. Quadratic ones, k = 6 or 10,
            have the midpoints of their edges after them, in the order (0, 1), (1, 2), (2, 0) and in 3D (0, 3),
            (1, 3), (2, 3); edges are curved where their midpoint is not halfway.
        point_sets: named sets of points, each an int32 index array.
        cell_sets: named sets of cells, likewise.
        cell_data: named numbers of the cells, each (m,) float64, such as the moduli or densities that a mesh file has.

    Raises:
        MeshError: the arrays have the wrong shape or type, a point is not finite or belongs to no cell, a
            cell refers to a point that does not exist, repeats a point or another cell, is inverted or has
            no volume (mean-ratio quality of its corners below ``MIN_QUALITY``), midpoints fold a cell, are corners
            of another one or differ between the cells of an edge, or a set is out of range or badly named, or cell
            data are not one number per cell.
            :meth:`repaired` mends inverted cells and unused points.
    """

    points: np.ndarray
    cells: np.ndarray
    point_sets: Mapping[str, np.ndarray] = field(default_factory=dict)
    cell_sets: Mapping[str, np.ndarray] = field(default_factory=dict)
    cell_data: Mapping[str, np.ndarray] = field(default_factory=dict)

    def __post_init__(self) -> None:
        points, cells = _arrays(self.points, self.cells)
        _check_cells(points, cells)
        self.__dict__.update(  # the way round frozen
            points=_frozen(points),
            cells=_frozen(cells),
            point_sets=_sets("point", self.point_sets, len(points)),
            cell_sets=_sets("cell", self.cell_sets, len(cells)),
            cell_data=_cell_data(self.cell_data, len(cells)),
        )

    def __repr__(self) -> str:
        names = "".join(
            f", {kind}: {', '.join(named)}"
            for kind, named in (
                ("point sets", self.point_sets),
                ("cell sets", self.cell_sets),
                ("cell data", self.cell_data),
            )
            if named
        )
        return f"Mesh({self.dim}D, {self.point_count} points, {self.cell_count} cells{names})"

    def __reduce__(self) -> tuple[Any, ...]:
        return Mesh, (self.points, self.cells, dict(self.point_sets), dict(self.cell_sets), dict(self.cell_data))

    # ---- construction

    @classmethod
    def repaired(
        cls,
        points: np.ndarray,
        cells: np.ndarray,
        point_sets: Mapping[str, Selection] = MappingProxyType({}),
        cell_sets: Mapping[str, Selection] = MappingProxyType({}),
        cell_data: Mapping[str, np.ndarray] = MappingProxyType({}),
    ) -> Mesh:
        """Make a mesh after turning inverted cells round and dropping points that no cell uses.

        Files routinely have both. Points keep their order, and sets are renumbered.

        Args:
            points: (n, dim) rest positions [m].
            cells: (m, k) point indices, linear or quadratic, of either orientation.
            point_sets: indices into ``points`` by name; those of dropped points are dropped.
            cell_sets: indices into ``cells`` by name.
            cell_data: (m,) numbers by name.

        Raises:
            MeshError: as for :class:`Mesh`, for everything else.
        """
        points, cells = _arrays(points, cells)
        own = _shape_of(points, cells)
        inverted = _signed_volumes(_spans(points, cells[:, : own.corner_count])) < 0.0
        cells[inverted] = cells[inverted][:, own.mirrored]
        used = np.unique(cells)
        renumbered = np.full(len(points), -1, dtype=np.int32)
        renumbered[used] = np.arange(len(used), dtype=np.int32)
        new_sets = {name: renumbered[s] for name, s in _sets("point", point_sets, len(points)).items()}
        new_sets = {name: members[members >= 0] for name, members in new_sets.items()}
        return cls(points[used], renumbered[cells], new_sets, cell_sets, cell_data)  # type: ignore[arg-type]

    @classmethod
    def rectangle(cls, size: Sequence[float], cells: Sequence[int], origin: Sequence[float] = (0.0, 0.0)) -> Mesh:
        """Make a rectangle of right triangles, two per square, with diagonals that alternate.

        Point sets: ``left``, ``right`` (least and greatest x), ``bottom``, ``top`` (y).

        Args:
            size: (width, height) [m], > 0.
            cells: squares along x and y, >= 1.
            origin: the lower left corner [m].

        Raises:
            MeshError: a size or count is not positive, or not two of them are given.
        """
        return cls._grid(size, cells, origin, _SQUARE, _mirrored(_SQUARE))

    @classmethod
    def box(
        cls,
        size: Sequence[float],
        cells: Sequence[int],
        origin: Sequence[float] = (0.0, 0.0, 0.0),
        split: Literal[5, 6] = 5,
    ) -> Mesh:
        """Make a box of tetrahedra.

        Point sets: ``left``, ``right`` (least and greatest x), ``bottom``, ``top`` (y), ``back``,
        ``front`` (z).

        Args:
            size: (width, height, depth) [m], > 0.
            cells: cubes along x, y and z, >= 1.
            origin: the corner of least x, y and z [m].
            split: tetrahedra per cube. 5: a regular one and four corners, mirrored between neighbouring
                cubes, the better shapes. 6: Kuhn's split, all congruent and around the same diagonal.

        Raises:
            MeshError: a size or count is not positive, not three of them are given, or the split is
                neither 5 nor 6.
        """
        if not isinstance(split, int) or split not in (5, 6):
            raise MeshError(f"split must be 5 or 6 tetrahedra per cube, not {split!r}")
        if split == 6:
            return cls._grid(size, cells, origin, _CUBE_6, _CUBE_6)
        return cls._grid(size, cells, origin, _CUBE_5, _mirrored(_CUBE_5))

    @classmethod
    def _grid(
        cls,
        size: Sequence[float],
        cells: Sequence[int],
        origin: Sequence[float],
        even: np.ndarray,
        odd: np.ndarray,
    ) -> Mesh:
        dim = even.shape[1] - 1
        lengths, corner = _vector("size", size, dim), _vector("origin", origin, dim)
        if not (lengths > 0.0).all():
            raise MeshError(f"size must be positive, not {size!r}")
        counts = _array("cells", cells, "iu", f"{dim} whole numbers of at least 1")
        if counts.shape != (dim,) or (counts < 1).any():
            raise MeshError(f"cells must be {dim} whole numbers of at least 1, not {cells!r}")

        ticks = [np.linspace(0.0, length, n + 1) for length, n in zip(lengths, counts, strict=True)]
        points = np.stack(np.meshgrid(*ticks, indexing="ij"), axis=-1).reshape(-1, dim) + corner
        numbers = np.arange(len(points), dtype=np.int32).reshape(counts + 1)
        halves = (slice(None, -1), slice(1, None))
        corners = [numbers[tuple(halves[code >> axis & 1] for axis in range(dim))] for code in range(2**dim)]
        corner_points = np.stack(corners, axis=-1)
        is_odd = np.indices(tuple(counts)).sum(axis=0)[..., None, None] % 2 == 1
        simplices = np.where(is_odd, corner_points[..., odd], corner_points[..., even])
        sides = {
            name: numbers.take(end, axis=axis).ravel()
            for axis, names in enumerate(_SIDES[:dim])
            for name, end in zip(names, (0, -1), strict=True)
        }
        return cls(points, simplices.reshape(-1, dim + 1), sides)

    def transformed(self, scale: float = 1.0, offset: Sequence[float] | None = None) -> Mesh:
        """Return the mesh with points at ``scale * points + offset``.

        Args:
            scale: factor of all lengths, > 0.
            offset: translation (dim,) [m]; ``None`` for none.

        Raises:
            MeshError: the scale is not positive and finite, or the offset is not a finite vector.
        """
        if not is_number(scale) or scale <= 0.0:
            raise MeshError(f"scale must be a positive number, not {scale!r}")
        shift = 0.0 if offset is None else _vector("offset", offset, self.dim)
        return replace(self, points=scale * self.points + shift)

    def quadratic(self) -> Mesh:
        """Return the mesh with a midpoint on every edge: quadratic cells, ten times as accurate in bending.

        The midpoints follow the points. A point set gains the midpoints between any two of its points. A mesh that is
        quadratic is returned as it is.
        """
        if self.order == 2:
            return self
        own = shape(self.dim, 2)
        places = np.searchsorted(
            _row_keys(self.edges, self.point_count),
            _row_keys(np.sort(self.cells[:, own.edges].reshape(-1, 2), axis=1), self.point_count),
        )
        middles = self.point_count + places.reshape(self.cell_count, -1).astype(np.int32)
        sets = {name: self.with_midpoints(members) for name, members in self.point_sets.items()}
        points = np.concatenate([self.points, self.points[self.edges].mean(axis=1)])
        return Mesh(points, np.concatenate([self.cells, middles], axis=1), sets, self.cell_sets, self.cell_data)

    def refined(self) -> Mesh:
        """Return the linear mesh with each cell divided into 4 (2D) or 8 (3D), at the midpoints of its edges.

        The midpoints follow the points, in the order of :meth:`quadratic`. A point set gains the midpoints between any
        two of its points, and a cell set the parts of its cells: those of cell c are p c to p c + p - 1. They have the
        data of their cell.
        """
        own = self.quadratic()
        parts = len(own.shape.parts)
        sets = {name: (parts * members[:, None] + np.arange(parts)).ravel() for name, members in self.cell_sets.items()}
        data = {name: np.repeat(values, parts) for name, values in self.cell_data.items()}
        return Mesh(own.points, own.linear_cells, own.point_sets, sets, data)

    def with_midpoints(self, members: np.ndarray) -> np.ndarray:
        """Return points of this linear mesh, and the midpoints between them by their numbers in :meth:`quadratic`.

        Args:
            members: point indices, (k,) int.

        Returns:
            (j,) int.
        """
        chosen = np.zeros(self.point_count, dtype=bool)
        chosen[members] = True
        return np.concatenate([members, self.point_count + np.flatnonzero(chosen[self.edges].all(axis=1))])

    # ---- sets

    def with_point_set(self, name: str, selection: Definition) -> Mesh:
        """Return the mesh with a named set of points, new or replaced.

        Args:
            name: a non-empty name.
            selection: point indices, or a function that takes ``points`` (n, dim) [m] and returns a boolean
                mask (n,).

        Raises:
            MeshError: the set would be empty or out of range, or the function does not return a mask.
        """
        members = _defined("point", name, selection, self.points)
        return self._with(point_sets=_sets("point", {**self.point_sets, name: members}, self.point_count))

    def with_cell_set(self, name: str, selection: Definition) -> Mesh:
        """Return the mesh with a named set of cells, new or replaced.

        Args:
            name: a non-empty name.
            selection: cell indices, or a function that takes the mean places of the cells' corners (m, dim) [m]
                and returns a boolean mask (m,).

        Raises:
            MeshError: the set would be empty or out of range, or the function does not return a mask.
        """
        members = _defined("cell", name, selection, self.points[self.corners].mean(axis=1))
        return self._with(cell_sets=_sets("cell", {**self.cell_sets, name: members}, self.cell_count))

    def _with(self, **changes: object) -> Mesh:
        """Return a copy that shares what has been checked and computed."""
        mesh = object.__new__(Mesh)
        mesh.__dict__.update(self.__dict__, **changes)
        return mesh

    def select_points(self, selection: Selection) -> np.ndarray:
        """Return the points of a set.

        Args:
            selection: the name of a point set, or point indices.

        Returns:
            (k,) int32, sorted, each point once.

        Raises:
            MeshError: no set has that name, or the selection is empty or out of range.
        """
        return _selected("point", selection, self.point_sets, self.point_count)

    def select_cells(self, selection: Selection) -> np.ndarray:
        """Return the cells of a set: as :meth:`select_points`, for cells."""
        return _selected("cell", selection, self.cell_sets, self.cell_count)

    def select_faces(self, selection: Selection) -> np.ndarray:
        """Return the boundary faces all of whose points are selected.

        Args:
            selection: the name of a point set, or point indices.

        Returns:
            (k,) int32, indices into ``boundary_faces``, sorted.

        Raises:
            MeshError: as for :meth:`select_points`, or no boundary face has all its points selected.
        """
        chosen = np.zeros(self.point_count, dtype=bool)
        chosen[self.select_points(selection)] = True
        faces = np.flatnonzero(chosen[self.boundary_faces].all(axis=1)).astype(np.int32)
        if not len(faces):
            raise MeshError(
                f"no boundary face has all its points in {_described('point', selection)}: "
                "select every point of the faces, on the boundary"
            )
        return faces

    def per_cell(self, values: Mapping[str, float]) -> np.ndarray:
        """Return one number per cell from one number per cell set, as materials and densities take them.

        ``NeoHookean(E=mesh.per_cell({"bone": 1e9, "muscle": 1e5}), nu=0.3)``

        Args:
            values: a number by the name of each cell set; together the sets must hold every cell.

        Returns:
            (m,) float64.

        Raises:
            MeshError: no set has that name, a value is no number, a cell is in none of the sets, or in several with
                different numbers.
        """
        result = np.full(self.cell_count, np.nan)
        for name, value in values.items():
            members = self.select_cells(name)
            if not is_number(value):
                raise MeshError(f"per_cell: the value of {name!r} must be a finite number, not {value!r}")
            taken = np.isfinite(result[members]) & (result[members] != value)
            if taken.any():
                raise MeshError(
                    f"per_cell: cell {members[taken][0]} ({taken.sum()} in all) is in {name!r} and in another set with "
                    "another value: give sets that do not overlap"
                )
            result[members] = value
        missing = np.flatnonzero(np.isnan(result))
        if len(missing):
            others = ", ".join(map(repr, [name for name in self.cell_sets if name not in values])) or "none"
            raise MeshError(
                f"per_cell: cell {missing[0]} ({len(missing)} in all) is in none of {', '.join(map(repr, values))}; "
                f"other cell sets of the mesh: {others}"
            )
        return result

    # ---- size and shape

    @property
    def dim(self) -> int:
        """Dimension of space: 2 or 3."""
        return self.points.shape[1]

    @property
    def point_count(self) -> int:
        """Number of points."""
        return len(self.points)

    @property
    def cell_count(self) -> int:
        """Number of cells."""
        return len(self.cells)

    @property
    def shape(self) -> Shape:
        """Shape functions and quadrature of the cells."""
        return _shape_of(self.points, self.cells)

    @property
    def order(self) -> int:
        """1 for linear cells, 2 for quadratic ones."""
        return self.shape.order

    @property
    def corners(self) -> np.ndarray:
        """(m, dim + 1) int32, the corners of each cell."""
        return self.cells[:, : self.dim + 1]

    @cached_property
    def cell_volumes(self) -> np.ndarray:
        """(m,) float64, rest volume of each cell [m^3], in 2D its area [m^2]; > 0. It is that of the quadrature."""
        return _frozen(self.quadrature_volumes.reshape(self.cell_count, -1).sum(axis=1))

    @cached_property
    def quadrature_volumes(self) -> np.ndarray:
        """(m q,) float64, the part of the rest volume of each of the q quadrature points of each cell [m^3]; > 0."""
        if self.order == 1:
            return _frozen(_signed_volumes(_spans(self.points, self.cells)))
        own = self.shape
        jacobians = own.jacobians(self.points[self.cells], own.quadrature_places)
        return _frozen(np.linalg.det(jacobians).ravel() * (own.unit_volume / own.quadrature_count))

    @cached_property
    def inverse_shape_matrices(self) -> np.ndarray:
        """(m q, dim, dim) float64, B = D_m^-1 [1/m] at each of the q quadrature points of each cell (q = 1 if linear).

        Column k - 1 of D_m is dX/dlambda_k, k = 1..dim; row k - 1 of B is the gradient of lambda_k. In linear cells the
        column is X_k - X_0 and the row the gradient of the shape function of corner k: with D_s made likewise of
        current positions, the deformation gradient is F = D_s B.
        """
        if self.order == 1:
            return _frozen(_inverse_transpose(_spans(self.points, self.cells)))
        jacobians = self.shape.jacobians(self.points[self.cells], self.shape.quadrature_places)
        return _frozen(np.linalg.inv(jacobians).reshape(-1, self.dim, self.dim))

    @cached_property
    def edges(self) -> np.ndarray:
        """(k, 2) int32, the corners of each edge once, the smaller point index first, sorted."""
        pairs = np.concatenate([self.corners[:, pair] for pair in combinations(range(self.dim + 1), 2)])
        keys = np.sort(pairs.min(axis=1).astype(np.int64) * self.point_count + pairs.max(axis=1))
        keys = keys[np.diff(keys, prepend=-1) > 0]  # np.unique is ten times slower on millions
        return _frozen(np.stack(np.divmod(keys, self.point_count), axis=1).astype(np.int32))

    @cached_property
    def edge_lengths(self) -> np.ndarray:
        """(k,) float64, straight rest length of each of ``edges`` [m]."""
        return _frozen(np.linalg.norm(np.diff(self.points[self.edges], axis=1)[:, 0], axis=1))

    @property
    def mean_edge_length(self) -> float:
        """Mean rest length of the edges [m]."""
        return float(self.edge_lengths.mean())

    @cached_property
    def bounding_box(self) -> np.ndarray:
        """(2, dim) float64, the least and the greatest coordinates [m]."""
        return _frozen(np.stack([self.points.min(axis=0), self.points.max(axis=0)]))

    @cached_property
    def quality(self) -> np.ndarray:
        """(m,) float64 in (0, 1], the mean ratio of the corners of each cell: 1 if regular, to 0 as it gets flat.

        12 (3 V)^(2/3) / sum(l^2) for tetrahedra (Liu and Joe, Relationship between tetrahedron shape
        measures, BIT 34, 1994, 268-287), 4 sqrt(3) A / sum(l^2) for triangles.
        """
        return _frozen(_signed_quality(_spans(self.points, self.corners)))

    def quality_summary(self) -> MeshQuality:
        """Return the extremes and the mean of quality and edge length."""
        worst = int(self.quality.argmin())
        return MeshQuality(
            worst=float(self.quality[worst]),
            worst_cell=worst,
            mean=float(self.quality.mean()),
            shortest_edge=float(self.edge_lengths.min()),
            longest_edge=float(self.edge_lengths.max()),
        )

    # ---- boundary

    @cached_property
    def _boundary_slots(self) -> np.ndarray:
        """Numbers (dim + 1) * cell + local face of the faces that belong to one cell alone."""
        faces = self.cells[:, self.shape.faces[:, : self.dim]].reshape(-1, self.dim)
        keys = _row_keys(np.sort(faces, axis=1), self.point_count)
        order = np.argsort(keys)
        begins = np.diff(keys[order], prepend=-1, append=-1) != 0
        return np.sort(order[begins[:-1] & begins[1:]])

    @cached_property
    def boundary_faces(self) -> np.ndarray:
        """(k, j) int32, the points of each face that belongs to one cell alone, oriented outwards.

        Linear faces have j = dim corners; quadratic ones have their midpoints after them. Triangles (3D) have their
        right-hand normal outwards. Edges (2D) run counterclockwise round the body: the direction (dx, dy) turned to
        (dy, -dx) points outwards.
        """
        cells, faces = np.divmod(self._boundary_slots, self.dim + 1)
        return _frozen(self.cells[cells[:, None], self.shape.faces[faces]])

    @cached_property
    def face_cells(self) -> np.ndarray:
        """(k,) int32, the cell that each of ``boundary_faces`` belongs to."""
        return _frozen((self._boundary_slots // (self.dim + 1)).astype(np.int32))

    @cached_property
    def face_sides(self) -> np.ndarray:
        """(k,) int32, the corner of that cell that each of ``boundary_faces`` is opposite to."""
        return _frozen((self._boundary_slots % (self.dim + 1)).astype(np.int32))

    @cached_property
    def _boundary_area_vectors(self) -> np.ndarray:
        """(k, q, dim), the parts of the quadrature points of each boundary face in its area vector."""
        face = self.shape.face
        tangents = face.jacobians(self.points[self.boundary_faces], face.quadrature_places)
        if self.dim == 2:
            vectors = tangents[..., ::-1, 0] * (1.0, -1.0)
        else:
            vectors = np.cross(tangents[..., 0], tangents[..., 1])
        return vectors * (face.unit_volume / face.quadrature_count)

    @cached_property
    def boundary_face_areas(self) -> np.ndarray:
        """(k,) float64, rest area of each of ``boundary_faces`` [m^2], in 2D its length [m]."""
        return _frozen(np.linalg.norm(self._boundary_area_vectors, axis=2).sum(axis=1))

    @cached_property
    def boundary_face_shares(self) -> np.ndarray:
        """(k, j) float64, the integral of the shape function of each point of each of ``boundary_faces`` [m^2]."""
        face = self.shape.face
        return _frozen(np.linalg.norm(self._boundary_area_vectors, axis=2) @ face.values(face.quadrature_places))

    @cached_property
    def boundary_face_normals(self) -> np.ndarray:
        """(k, dim) float64, outward unit normal of each of ``boundary_faces`` at rest; the mean one if it is curved."""
        vectors = self._boundary_area_vectors.sum(axis=1)
        return _frozen(vectors / np.linalg.norm(vectors, axis=1)[:, None])

    @cached_property
    def boundary_points(self) -> np.ndarray:
        """(k,) int32, the points of ``boundary_faces``, sorted, each once."""
        return _frozen(np.unique(self.boundary_faces))

    # ---- linear parts

    @cached_property
    def linear_cells(self) -> np.ndarray:
        """(m p, dim + 1) int32, the cells divided into p linear ones each: 1 if linear, else 4 (2D) or 8 (3D)."""
        return _frozen(self.cells[:, self.shape.parts].reshape(-1, self.dim + 1))

    @cached_property
    def linear_boundary_faces(self) -> np.ndarray:
        """(k p, dim) int32, ``boundary_faces`` divided into p linear ones each: 1 if linear, else 2 (2D) or 4 (3D)."""
        return _frozen(self.boundary_faces[:, self.shape.face.parts].reshape(-1, self.dim))


# ---- geometry


def _spans(points: np.ndarray, simplices: np.ndarray) -> np.ndarray:
    """(m, k, dim) vectors from vertex 0 of each simplex to its k others."""
    corners = points[simplices]
    return corners[:, 1:] - corners[:, :1]


def _inverse_transpose(spans: np.ndarray) -> np.ndarray:
    """(m, dim, dim) by cofactors, several times faster than LAPACK for matrices this small."""
    if spans.shape[1] == 2:
        (a, b), (c, d) = spans.transpose(1, 2, 0)
        cofactors = np.stack([d, -c, -b, a], axis=1).reshape(-1, 2, 2)
    else:
        cofactors = np.stack([np.cross(spans[:, k - 2], spans[:, k - 1]) for k in range(3)], axis=1)
    return cofactors / np.einsum("cj,cj->c", spans[:, 0], cofactors[:, 0])[:, None, None]


def _signed_volumes(spans: np.ndarray) -> np.ndarray:
    return np.linalg.det(spans) * shape(spans.shape[1], 1).unit_volume


def _signed_quality(spans: np.ndarray) -> np.ndarray:
    """Mean ratio with the sign of the volume; 0 where all points coincide."""
    volumes = _signed_volumes(spans)
    squares = np.einsum("cij,cij->c", spans, spans)
    for i, j in combinations(range(spans.shape[1]), 2):
        other = spans[:, i] - spans[:, j]
        squares += np.einsum("ci,ci->c", other, other)
    if spans.shape[1] == 2:
        ratio = 4.0 * np.sqrt(3.0) * volumes
    else:
        ratio = np.sign(volumes) * 12.0 * np.cbrt(3.0 * volumes) ** 2
    return np.divide(ratio, squares, out=np.zeros_like(ratio), where=squares > 0.0)


def _mirrored(split: np.ndarray) -> np.ndarray:
    """The mirror image in x of a split of a square or cube."""
    return (split ^ 1)[:, shape(split.shape[1] - 1, 1).mirrored]


def _shape_of(points: np.ndarray, cells: np.ndarray) -> Shape:
    own = shape_of_points(points.shape[1], cells.shape[1])
    assert own is not None
    return own


def _row_keys(rows: np.ndarray, bound: int) -> np.ndarray:
    """(k,) int64, equal for equal rows alone; for two columns it is ``first * bound + second``."""
    keys, size = rows[:, 0].astype(np.int64), bound
    for column in rows.T[1:]:
        if size * bound > np.iinfo(np.int64).max:
            keys, size = np.unique(keys, return_inverse=True)[1], len(rows)
        keys, size = keys * bound + column, size * bound
    return keys


# ---- checks


def _frozen(array: np.ndarray) -> np.ndarray:
    array.setflags(write=False)
    return array


def _array(name: str, value: object, kinds: str, what: str) -> np.ndarray:
    try:
        array = np.asarray(value)
    except ValueError:
        raise MeshError(f"{name} must be {what}, and its rows are not equally long") from None
    if array.dtype.kind not in kinds and array.size:
        raise MeshError(f"{name} must be {what}, not of type {array.dtype}")
    return array


def _vector(name: str, value: object, dim: int) -> np.ndarray:
    vector = _array(name, value, "iuf", f"{dim} numbers").astype(np.float64)
    if vector.shape != (dim,) or not np.isfinite(vector).all():
        raise MeshError(f"{name} must be {dim} finite numbers, not {value!r}")
    return vector


def _reject(kind: str, bad: np.ndarray, problem: str, advice: str) -> None:
    """Raise, with the first index and the count, if anything is bad."""
    indices = np.flatnonzero(bad)
    if len(indices):
        raise MeshError(f"{kind} {indices[0]} {problem} ({len(indices)} of {len(bad)} {kind}s in all): {advice}")


def _arrays(points: object, cells: object) -> tuple[np.ndarray, np.ndarray]:
    """Copies of points and cells in their types, cells referring to existing points."""
    positions = _array("points", points, "iuf", "an (n, 2) or (n, 3) array of numbers")
    indices = _array("cells", cells, "iu", "an (m, 3), (m, 6), (m, 4) or (m, 10) array of point indices (integers)")
    if positions.ndim != 2 or positions.shape[1] not in (2, 3):
        raise MeshError(f"points must be an (n, 2) or (n, 3) array, not of shape {positions.shape}")
    dim = positions.shape[1]
    if not indices.size:
        raise MeshError("the mesh has no cells: give at least one triangle (2D) or tetrahedron (3D)")
    if dim == 3 and indices.ndim == 2 and indices.shape[1] in (3, 6):
        raise MeshError(
            "triangles with points in 3D are a surface, not a solid: fill it with "
            "warpfem.tetrahedralize, or give points (n, 2) for a plane body"
        )
    if indices.ndim != 2 or shape_of_points(dim, indices.shape[1]) is None:
        kind = "(m, 3) or (m, 6) triangles" if dim == 2 else "(m, 4) or (m, 10) tetrahedra"
        raise MeshError(f"cells must be {kind} for points in {dim}D, not of shape {indices.shape}")
    positions = positions.astype(np.float64)
    _check_references("cell", positions, indices)
    return positions, indices.astype(np.int32)


def _check_references(kind: str, points: np.ndarray, indices: np.ndarray) -> None:
    """The points are finite, and each row of indices refers to some of them."""
    _reject("point", ~np.isfinite(points).all(axis=1), "is not finite", "remove NaN and infinity")
    outside = (indices.min(axis=1) < 0) | (indices.max(axis=1) >= len(points))
    missing = f"refers to a point outside 0..{len(points) - 1}"
    _reject(kind, outside, missing, "count points from 0, without gaps")


def _check_cells(points: np.ndarray, cells: np.ndarray) -> None:
    ordered = np.sort(cells, axis=1)
    _reject("cell", (ordered[:, 1:] == ordered[:, :-1]).any(axis=1), "repeats a point", "remove such cells")
    keys = _row_keys(ordered, len(points))
    if not np.diff(np.sort(keys)).all():
        _, first, group = np.unique(keys, return_index=True, return_inverse=True)
        twins = first[group]
        again = twins != np.arange(len(cells))
        _reject("cell", again, f"has the same points as cell {twins[again][0]}", "keep one of each")
    own = _shape_of(points, cells)
    quality = _signed_quality(_spans(points, cells[:, : own.corner_count]))
    _reject(
        "cell",
        ~(np.abs(quality) >= MIN_QUALITY),
        f"has no volume at rest (quality below {MIN_QUALITY:g})",
        "remove flat cells, or mesh again",
    )
    _reject("cell", quality < 0.0, "is inverted at rest", "Mesh.repaired(points, cells) turns such cells")
    if own.order == 2:
        _check_midpoints(points, cells, own)
    unused = np.ones(len(points), dtype=bool)
    unused[cells] = False
    _reject("point", unused, "belongs to no cell", "Mesh.repaired(points, cells) drops such points")


def _check_midpoints(points: np.ndarray, cells: np.ndarray, own: Shape) -> None:
    is_corner = np.zeros(len(points), dtype=bool)
    is_corner[cells[:, : own.corner_count]] = True
    middles = cells[:, own.corner_count :]
    order = "list corners first, then the midpoints of the edges (0, 1), (1, 2), (2, 0), (0, 3), (1, 3), (2, 3)"
    _reject("cell", is_corner[middles].any(axis=1), "has a midpoint that is the corner of a cell", order)
    keys = _row_keys(np.sort(cells[:, own.edges].reshape(-1, 2), axis=1), len(points))
    _, first, edge = np.unique(keys, return_index=True, return_inverse=True)
    differs = middles.ravel() != middles.ravel()[first][edge]
    shared = "has another midpoint on an edge than another cell that shares the edge"
    _reject("cell", differs.reshape(middles.shape).any(axis=1), shared, "give each edge one midpoint")
    places = np.concatenate([own.places, own.quadrature_places])
    folded = ~(np.linalg.det(own.jacobians(points[cells], places)) > 0.0).all(axis=1)
    _reject("cell", folded, "is folded by its midpoints", f"move them nearer to the middles of its edges, and {order}")


def _indices(kind: str, owner: str, value: object, count: int) -> np.ndarray:
    """Sorted int32 indices, each once, within 0..count - 1."""
    array = _array(owner, value, "iu", f"{kind} indices (integers; for a mask, np.flatnonzero(mask))")
    if array.ndim > 1:
        raise MeshError(f"{owner} must be a row of {kind} indices, not of shape {array.shape}")
    array = np.unique(array)
    outside = array[(array < 0) | (array >= count)]
    if len(outside):
        raise MeshError(
            f"{owner} refers to {kind} {outside[0]} ({len(outside)} of {len(array)} in all): "
            f"{kind}s go from 0 to {count - 1}"
        )
    return array.astype(np.int32)


def _check_name(kind: str, name: object) -> None:
    if not isinstance(name, str) or not name:
        raise MeshError(f"the name of a {kind} set must be a non-empty str, not {name!r}")


def _sets(kind: str, sets: Mapping[str, Any], count: int) -> Mapping[str, np.ndarray]:
    if not isinstance(sets, Mapping):
        raise MeshError(f"{kind}_sets must be a dict from names to {kind} indices, not {sets!r}")
    for name in sets:
        _check_name(kind, name)
    return MappingProxyType(
        {name: _frozen(_indices(kind, f"{kind} set {name!r}", value, count)) for name, value in sets.items()}
    )


def _cell_data(data: object, count: int) -> Mapping[str, np.ndarray]:
    if not isinstance(data, Mapping):
        raise MeshError(f"cell_data must be a dict from names to one number per cell, not {data!r}")
    checked = {}
    for name, values in data.items():
        if not isinstance(name, str) or not name:
            raise MeshError(f"the name of cell data must be a non-empty str, not {name!r}")
        array = _array(f"cell data {name!r}", values, "biuf", "one number per cell")
        if array.shape != (count,):
            raise MeshError(f"cell data {name!r} must have one number for each of {count} cells, not {array.shape}")
        checked[name] = _frozen(array.astype(np.float64))
    return MappingProxyType(checked)


def _described(kind: str, selection: object) -> str:
    return f"{kind} set {selection!r}" if isinstance(selection, str) else f"the {kind} selection"


def _selected(kind: str, selection: Selection, sets: Mapping[str, np.ndarray], count: int) -> np.ndarray:
    owner = _described(kind, selection)
    if not isinstance(selection, str):
        chosen = _indices(kind, owner, selection, count)
    elif selection in sets:
        chosen = sets[selection]
    else:
        close = difflib.get_close_matches(selection, sets, n=1)
        hint = f"; did you mean {close[0]!r}?" if close else "."
        known = ", ".join(map(repr, sets)) if sets else f"none (add one by with_{kind}_set)"
        raise MeshError(f"the mesh has no {owner}{hint} Known {kind} sets: {known}")
    if not len(chosen):
        raise MeshError(f"{owner} is empty: select at least one {kind}")
    return chosen


def _defined(kind: str, name: str, selection: Definition, positions: np.ndarray) -> np.ndarray:
    _check_name(kind, name)
    owner = f"{kind} set {name!r}"
    if callable(selection):
        with user_code(owner, source_of(selection)):
            mask = np.asarray(selection(positions))
        if mask.dtype != bool or mask.shape != (len(positions),):
            raise MeshError(
                f"{owner}: the function must return a boolean mask of shape ({len(positions)},), one value "
                f"per {kind}, not {mask.dtype} of shape {mask.shape}"
            )
        selection = np.flatnonzero(mask)
    members = _indices(kind, owner, selection, len(positions))
    if not len(members):
        raise MeshError(f"{owner} is empty: it must hold at least one {kind}")
    return members
