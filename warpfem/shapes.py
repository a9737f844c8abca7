"""Shape functions and quadrature of simplices: linear (P1) and quadratic (P2) triangles and tetrahedra.

Points of a cell are numbered as VTK does: the corners first, then the midpoints of the edges (0, 1), (1, 2), (2, 0)
and, in 3D, (0, 3), (1, 3), (2, 3). Places within a cell are barycentric: the corner k is at lambda_k = 1.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from functools import cached_property
from math import factorial, sqrt

import numpy as np

_CORNER_EDGES = {2: ((0, 1), (1, 2), (2, 0)), 3: ((0, 1), (1, 2), (2, 0), (0, 3), (1, 3), (2, 3))}

# Face k of a positively oriented cell lies opposite its corner k and is oriented outwards.
_CORNER_FACES = {2: ((1, 2), (2, 0), (0, 1)), 3: ((1, 2, 3), (0, 3, 2), (0, 1, 3), (0, 2, 1))}

# How corners and midpoints divide an edge, a triangle and a tetrahedron into linear ones.
_OCTAHEDRON = ((4, 9, 5, 6), (4, 9, 6, 7), (4, 9, 7, 8), (4, 9, 8, 5))  # about the diagonal 4-9
_PARTS = {
    1: ((0, 2), (2, 1)),
    2: ((0, 3, 5), (3, 1, 4), (5, 4, 2), (3, 4, 5)),
    3: ((0, 4, 6, 7), (4, 1, 5, 8), (6, 5, 2, 9), (7, 8, 9, 3), *_OCTAHEDRON),
}

# Places (lambda at the near corner, at the others) of the dim + 1 points of equal weight that integrate quadratic
# functions exactly (Hammer and Stroud 1956; Zienkiewicz and Taylor 2000, tables 9.2 and 9.3).
_PLACES = {1: (0.5 + sqrt(3.0) / 6.0, 0.5 - sqrt(3.0) / 6.0), 2: (2.0 / 3.0, 1.0 / 6.0)}
_PLACES[3] = ((5.0 + 3.0 * sqrt(5.0)) / 20.0, (5.0 - sqrt(5.0)) / 20.0)

# Shares of a corner and of a midpoint in the mass of a cell: proportional to the integral of N^2 over the straight
# cell (Hinton, Rock and Zienkiewicz 1976).
_QUADRATIC_MASS = {1: (1.0 / 6.0, 2.0 / 3.0), 2: (1.0 / 19.0, 16.0 / 57.0), 3: (1.0 / 36.0, 4.0 / 27.0)}


@dataclass(frozen=True)
class Shape:
    """A simplex of linear or quadratic shape functions.

    Attributes:
        dim: dimension of the simplex: 2 or 3 for cells, 1 or 2 for their faces.
        order: 1, linear, or 2, quadratic.
    """

    dim: int
    order: int

    @property
    def corner_count(self) -> int:
        """Corners of a cell."""
        return self.dim + 1

    @cached_property
    def edges(self) -> np.ndarray:
        """(k, 2), the corners between which each midpoint lies; none if linear."""
        edges = {1: ((0, 1),), **_CORNER_EDGES}[self.dim] if self.order == 2 else ()
        return np.array(edges, dtype=np.int64).reshape(-1, 2)

    @property
    def point_count(self) -> int:
        """Points of a cell."""
        return self.corner_count + len(self.edges)

    @cached_property
    def places(self) -> np.ndarray:
        """(point_count, dim + 1) barycentric places of the points."""
        corners = np.eye(self.corner_count)
        return np.concatenate([corners, corners[self.edges].mean(axis=1)])

    @property
    def quadrature_count(self) -> int:
        """Quadrature points of a cell: 1 if linear, dim + 1 if quadratic, all of equal weight.

        Quadratic functions are integrated exactly: all that the strain energy of a straight cell holds at small
        strains. The gradients in curved tetrahedra are cubic: they pass the patch test to the order of the curvature.
        """
        return 1 if self.order == 1 else self.corner_count

    @cached_property
    def quadrature_places(self) -> np.ndarray:
        """(quadrature_count, dim + 1) barycentric places of the quadrature points."""
        if self.order == 1:
            return np.full((1, self.corner_count), 1.0 / self.corner_count)
        near, far = _PLACES[self.dim]
        return far + (near - far) * np.eye(self.corner_count)

    @property
    def mass_shares(self) -> np.ndarray:
        """(point_count,) shares of the points in the lumped mass of a cell; all positive, their sum is 1."""
        if self.order == 1:
            return np.full(self.corner_count, 1.0 / self.corner_count)
        corner, middle = _QUADRATIC_MASS[self.dim]
        return np.repeat([corner, middle], [self.corner_count, len(self.edges)])

    def values(self, places: np.ndarray) -> np.ndarray:
        """The shape functions (k, point_count) at barycentric places (k, dim + 1)."""
        if self.order == 1:
            return places
        first, second = places[:, self.edges[:, 0]], places[:, self.edges[:, 1]]
        return np.concatenate([places * (2.0 * places - 1.0), 4.0 * first * second], axis=1)

    def gradients(self, places: np.ndarray) -> np.ndarray:
        """Their derivatives (k, point_count, dim) by lambda_1..lambda_dim, with lambda_0 = 1 - the others."""
        directions = np.eye(self.corner_count)[:, 1:] - np.eye(self.corner_count)[:, :1]  # d lambda_a / d lambda_k
        if self.order == 1:
            return np.broadcast_to(directions, (len(places), *directions.shape))
        a, b = self.edges.T
        corners = (4.0 * places - 1.0)[:, :, None] * directions
        middles = 4.0 * (places[:, a, None] * directions[b] + places[:, b, None] * directions[a])
        return np.concatenate([corners, middles], axis=1)

    @cached_property
    def quadrature_gradients(self) -> np.ndarray:
        """:meth:`gradients` at the quadrature points."""
        return self.gradients(self.quadrature_places)

    @cached_property
    def parts(self) -> np.ndarray:
        """(k, dim + 1), the linear simplices that the points divide a cell into: 1, or 4 (2D) or 8 (3D)."""
        return np.array(_PARTS[self.dim] if self.order == 2 else (tuple(range(self.corner_count)),))

    @property
    def face(self) -> Shape:
        """The shape of a face."""
        return shape(self.dim - 1, self.order)

    @cached_property
    def faces(self) -> np.ndarray:
        """(dim + 1, k), the points of each face in the order of :attr:`face`; face k is opposite corner k."""
        faces = np.array(_CORNER_FACES[self.dim])
        if self.order == 1:
            return faces
        middle = {frozenset(edge): self.corner_count + k for k, edge in enumerate(self.edges.tolist())}
        own = [[middle[frozenset(edge)] for edge in corners[self.face.edges].tolist()] for corners in faces]
        return np.concatenate([faces, np.array(own)], axis=1)

    @cached_property
    def face_weights(self) -> np.ndarray:
        """(dim + 1, quadrature_count), from values at the quadrature points to that at the centroid of each face.

        Exact for functions that are linear in the cell; of one quadrature point, for constants.
        """
        if self.order == 1:
            return np.ones((self.corner_count, 1))
        near, far = _PLACES[self.dim]
        centroids = (1.0 - np.eye(self.corner_count)) / self.dim
        return (centroids - far) / (near - far)

    @cached_property
    def mirrored(self) -> np.ndarray:
        """The order of the points of a cell of the other orientation: the last two corners change places."""
        corners = [*range(self.dim - 1), self.dim, self.dim - 1]
        middle = {frozenset(edge): self.corner_count + k for k, edge in enumerate(self.edges.tolist())}
        return np.array(corners + [middle[frozenset((corners[a], corners[b]))] for a, b in self.edges])

    def jacobians(self, corners: np.ndarray, places: np.ndarray) -> np.ndarray:
        """The derivatives dX/d lambda_1..dim (m, k, space, dim) of cells with points (m, point_count, space)."""
        return np.einsum("mai,kad->mkid", corners, self.gradients(places))

    @property
    def unit_volume(self) -> float:
        """Volume of the cell in the space of lambda_1..lambda_dim."""
        return 1.0 / factorial(self.dim)


@functools.cache
def shape(dim: int, order: int) -> Shape:
    """The shape of that dimension and order."""
    return Shape(dim, order)


def shape_of_points(dim: int, point_count: int) -> Shape | None:
    """The shape of cells with that many points, if there is one."""
    return next((own for own in (shape(dim, 1), shape(dim, 2)) if own.point_count == point_count), None)
