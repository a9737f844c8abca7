"""Lagrange polynomials and quadrature on triangles and tetrahedra, apart from the kernels that are judged by them.

A point of a cell is given by its barycentric coordinates b (dim + 1). Points of quadratic cells come in the order of
VTK: the corners, then the midpoints of the edges (0,1), (1,2), (2,0) and in 3D (0,3), (1,3), (2,3).
"""

from __future__ import annotations

from functools import cache

import numpy as np
from scipy.special import roots_jacobi

from warpfem import Mesh

EDGES = {2: ((0, 1), (1, 2), (2, 0)), 3: ((0, 1), (1, 2), (2, 0), (0, 3), (1, 3), (2, 3))}


@cache
def quadrature(dim: int, points: int = 4) -> tuple[np.ndarray, np.ndarray]:
    """Barycentric points (q, dim + 1) and weights (q,) that sum to 1.

    The product of Gauss-Jacobi rules on the collapsed cube (Stroud 1971), exact to degree 2 points - 1.
    """
    b = np.ones((1, 1))  # the barycentric coordinates of a point
    w = np.ones(1)
    for k in range(1, dim + 1):  # a simplex is the cone from a new corner over the last one
        x, v = roots_jacobi(points, 0.0, k - 1.0) if k > 1 else np.polynomial.legendre.leggauss(points)
        t, v = 0.5 * (x + 1.0), v / v.sum()
        cone = np.concatenate([t[:, None, None] * b, np.broadcast_to(1.0 - t[:, None, None], (points, len(b), 1))], 2)
        b, w = cone.reshape(-1, k + 1), np.outer(v, w).ravel()
    return b, w


def shapes(b: np.ndarray, order: int) -> np.ndarray:
    """The shape functions at the points b (q, dim + 1): (q, points of a cell)."""
    if order == 1:
        return b
    corners = b * (2.0 * b - 1.0)
    return np.concatenate([corners, *(4.0 * b[:, i : i + 1] * b[:, j : j + 1] for i, j in EDGES[b.shape[1] - 1])], 1)


def shape_rates(b: np.ndarray, order: int) -> np.ndarray:
    """Their derivatives by the barycentric coordinates, (q, points of a cell, dim + 1)."""
    q, corners = b.shape
    unit = np.eye(corners)
    if order == 1:
        return np.broadcast_to(unit, (q, corners, corners))
    rates = [(4.0 * b[:, i, None] - 1.0) * unit[i] for i in range(corners)]
    rates += [4.0 * (b[:, i, None] * unit[j] + b[:, j, None] * unit[i]) for i, j in EDGES[corners - 1]]
    return np.stack(rates, axis=1)


def order_of(mesh: Mesh) -> int:
    """1 for linear cells, 2 for quadratic ones."""
    return 1 if mesh.cells.shape[1] == mesh.dim + 1 else 2


class Field:
    """Places and shape functions at the quadrature points of a mesh with straight cells.

    Attributes:
        x: places (cells, q, dim).
        w: weights times volume (cells, q).
        N: shape functions (q, points of a cell).
        dN: their gradients (cells, q, points of a cell, dim).
    """

    def __init__(self, mesh: Mesh, points: int = 4) -> None:
        b, w = quadrature(mesh.dim, points)
        corners = mesh.points[mesh.cells[:, : mesh.dim + 1]]
        spans = np.swapaxes(corners[:, 1:] - corners[:, :1], 1, 2)
        inverse = np.linalg.inv(spans)  # rows: the gradients of b_1..b_dim
        slopes = np.concatenate([-inverse.sum(axis=1, keepdims=True), inverse], axis=1)
        self.mesh = mesh
        self.x = np.einsum("qk,ckj->cqj", b, corners)
        volumes = np.linalg.det(spans) / (2.0 if mesh.dim == 2 else 6.0)
        self.w = volumes[:, None] * w
        self.N = shapes(b, order_of(mesh))
        self.dN = np.einsum("qab,cbj->cqaj", shape_rates(b, order_of(mesh)), slopes)

    def values(self, u: np.ndarray) -> np.ndarray:
        """A field given at the points of the mesh (n, k), at the quadrature points (cells, q, k)."""
        return np.einsum("qa,cak->cqk", self.N, u[self.mesh.cells])

    def gradients(self, u: np.ndarray) -> np.ndarray:
        """Its gradient (cells, q, k, dim)."""
        return np.einsum("cqaj,cak->cqkj", self.dN, u[self.mesh.cells])

    def loads(self, density: np.ndarray) -> np.ndarray:
        """The forces on the points (n, dim) of a force per volume at the quadrature points (cells, q, dim)."""
        own = np.einsum("cq,qa,cqk->cak", self.w, self.N, density)
        return _gathered(self.mesh, self.mesh.cells, own)


def boundary_quadrature(mesh: Mesh, points: int = 4) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Quadrature on the boundary faces.

    Returns:
        Places (faces, q, dim), weights times area (faces, q), shape functions of the face's cell there (faces, q,
        points of a cell), outward unit normals (faces, dim).
    """
    b, w = quadrature(mesh.dim - 1, points)
    cells = mesh.cells[mesh.face_cells]
    face = mesh.boundary_faces[:, : mesh.dim]
    local = (face[:, :, None] == cells[:, None, : mesh.dim + 1]).argmax(axis=2)
    inside = np.zeros((len(face), len(b), mesh.dim + 1))
    for k in range(mesh.dim):
        np.put_along_axis(inside, np.broadcast_to(local[:, k, None, None], (len(face), len(b), 1)), b[:, k : k + 1], 2)
    x = np.einsum("qk,fkj->fqj", b, mesh.points[face])
    N = shapes(inside.reshape(-1, mesh.dim + 1), order_of(mesh)).reshape(len(face), len(b), -1)
    return x, mesh.boundary_face_areas[:, None] * w, N, mesh.boundary_face_normals


def boundary_loads(mesh: Mesh, traction: np.ndarray, weights: np.ndarray, N: np.ndarray) -> np.ndarray:
    """The forces on the points (n, dim) of a traction (faces, q, dim) at the points of :func:`boundary_quadrature`."""
    own = np.einsum("fq,fqa,fqk->fak", weights, N, traction)
    return _gathered(mesh, mesh.cells[mesh.face_cells], own)


def _gathered(mesh: Mesh, cells: np.ndarray, own: np.ndarray) -> np.ndarray:
    total = np.zeros((mesh.point_count, own.shape[2]))
    np.add.at(total, cells, own)
    return total
