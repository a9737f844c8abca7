"""Places carried along by a body: where they are, and how their normals turn, as the body deforms."""

from __future__ import annotations

import numpy as np

from warpfem.mesh import Mesh
from warpfem.places import Places, locate


class Embedding:
    """Places fixed to the cells of a mesh of tetrahedra by barycentric coordinates.

    Places outside move with the nearest cell, as if it went on. A motion x = A X + b of the mesh moves them exactly so.
    """

    def __init__(self, mesh: Mesh, places: np.ndarray) -> None:
        """Finds the cells of the places.

        Args:
            mesh: linear tetrahedra.
            places: (k, 3) positions [m] that belong to the mesh's points.
        """
        self._places: Places = locate(mesh, places, extrapolate=True)
        self._inverse = np.linalg.inv(_edges(mesh.points, self._places.cells))

    def points(self, x: np.ndarray) -> np.ndarray:
        """The places (k, 3) when the mesh's points are at ``x`` (point_count, 3); likewise their velocities."""
        return self._places.values(x)

    def normals(self, x: np.ndarray, places: np.ndarray, normals: np.ndarray) -> np.ndarray:
        """Unit normals of a surface through some places when the mesh's points are at ``x``.

        They turn as areas do, by cof F of the place's cell, which is exact for the surface in that cell.

        Args:
            x: (point_count, 3) positions [m].
            places: (n,) indices of the places that the normals are at.
            normals: (n, 3) in the shape of which the places were found.
        """
        F = (self._inverse @ _edges(x, self._places.cells)).transpose(0, 2, 1)
        a, b, c = F[:, :, 0], F[:, :, 1], F[:, :, 2]
        cofactors = np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)], axis=-1)
        turned = np.einsum("kij,kj->ki", cofactors[places], normals)
        lengths = np.linalg.norm(turned, axis=1, keepdims=True)
        return turned / np.where(lengths > 0.0, lengths, 1.0)


def _edges(x: np.ndarray, cells: np.ndarray) -> np.ndarray:
    """The edges from each cell's first corner, as rows (k, 3, 3) [m]."""
    corners = x[cells]
    return corners[:, 1:] - corners[:, :1]
