"""Strips of cells: chains of cells that share faces, so that each cell needs fewer points.

In a strip of triangles or tetrahedra cell k has the strip's points k to k + dim: three tetrahedra have six points,
where alone they would have twelve. Whatever is read for each point of a cell, or added to it, halves.
"""

import functools
from dataclasses import dataclass

import numpy as np
import warp as wp

STRIP = 3
"""Cells in a strip: any chain of three can be numbered so; longer ones need more registers than there are."""


@dataclass(frozen=True, eq=False)
class Strips:
    """Cells in strips.

    Attributes:
        points: (count, STRIP + dim) int, points of each strip; the last is repeated where cells are missing.
        cells: (count, STRIP) int, the cells, -1 where one is missing.
    """

    points: np.ndarray
    cells: np.ndarray


def cut_into_strips(points: np.ndarray, cells: np.ndarray) -> Strips:
    """Divides linear cells into strips, neighbours in space close to one another in the list.

    Halves of the list are halves of the body along the axis by which the points are numbered first of all, so that
    threads that have a part of the strips and one of the points share few of them.

    Args:
        points: (point_count, dim) [m].
        cells: (cell_count, dim + 1) int.
    """
    order = order_in_space(points, cells)
    chains = _chains(_neighbours(cells[order]))
    found = chains >= 0
    chains = np.where(found, order[chains], -1)
    return Strips(_numbered(cells, chains, found.sum(axis=1)), chains)


def order_in_space(points: np.ndarray, cells: np.ndarray) -> np.ndarray:
    """The cells (count,) along a space-filling curve that divides the body as its points' numbers do first of all."""
    keys = _space_filling_keys(points[cells].mean(axis=1)[:, _numbering_axes(points)])
    return np.argsort(keys, kind="stable")


def _numbering_axes(points: np.ndarray) -> np.ndarray:
    """The axes, from that along which points are numbered last to that along which they are numbered first of all."""
    number = np.arange(len(points)) - 0.5 * (len(points) - 1)
    centred = points - points.mean(axis=0)
    spread = np.maximum(np.linalg.norm(centred, axis=0), np.finfo(np.float64).tiny)
    return np.argsort(np.abs(number @ centred) / spread, kind="stable")


def _space_filling_keys(places: np.ndarray) -> np.ndarray:
    """Keys along the curve of Morton (1966): the bits of the coordinates, interleaved, the last axis first."""
    dim, bits = places.shape[1], 20
    extent = max(float(np.ptp(places, axis=0).max()), np.finfo(np.float64).tiny)
    grid = ((places - places.min(axis=0)) / extent * (2**bits - 1)).astype(np.int64)
    keys = np.zeros(len(places), dtype=np.int64)
    for bit in range(bits):
        for k in range(dim):
            keys |= ((grid[:, k] >> bit) & 1) << (dim * bit + k)
    return keys


def _neighbours(cells: np.ndarray) -> np.ndarray:
    """(cell_count, dim + 1) int32, the cell across the face opposite to each corner, -1 at the boundary."""
    count, corners = cells.shape
    faces = np.sort(np.stack([np.delete(cells, k, axis=1) for k in range(corners)], axis=1), axis=2)
    faces = faces.reshape(count * corners, corners - 1)
    order = np.lexsort(faces.T)
    ordered = faces[order]
    pairs = np.flatnonzero((ordered[1:] == ordered[:-1]).all(axis=1))
    first, second = order[pairs], order[pairs + 1]
    result = np.full(count * corners, -1, dtype=np.int32)
    result[first], result[second] = second // corners, first // corners
    return result.reshape(count, corners)


@functools.cache
def _chain_kernel() -> wp.Kernel:
    @wp.func
    def next_cell(neighbours: wp.array2d(dtype=wp.int32), taken: wp.array(dtype=wp.int32), cell: int):
        """The free neighbour with the fewest free neighbours of its own, which would be the hardest to place later."""
        best = int(-1)
        fewest = int(99)
        for k in range(neighbours.shape[1]):
            candidate = neighbours[cell, k]
            if candidate >= 0 and taken[candidate] == 0:
                free = int(0)
                for j in range(neighbours.shape[1]):
                    other = neighbours[candidate, j]
                    if other >= 0 and taken[other] == 0:
                        free += 1
                if free < fewest:
                    fewest = free
                    best = candidate
        return best

    @wp.kernel(module="unique", enable_backward=False)
    def chain_cells(
        neighbours: wp.array2d(dtype=wp.int32),
        taken: wp.array(dtype=wp.int32),
        chains_out: wp.array2d(dtype=wp.int32),
        count_out: wp.array(dtype=wp.int32),
    ):
        """Takes cell by cell as the start of a chain that grows at its end, then at its start: one task for all."""
        count = int(0)
        for start in range(neighbours.shape[0]):
            if taken[start] == 0:
                taken[start] = 1
                a = int(start)
                b = next_cell(neighbours, taken, a)
                c = int(-1)
                if b >= 0:
                    taken[b] = 1
                    c = next_cell(neighbours, taken, b)
                    if c < 0:
                        before = next_cell(neighbours, taken, a)
                        if before >= 0:
                            c = b
                            b = a
                            a = before
                            taken[a] = 1
                    else:
                        taken[c] = 1
                chains_out[count, 0] = a
                chains_out[count, 1] = b
                chains_out[count, 2] = c
                count += 1
        count_out[0] = count

    return chain_cells


def _chains(neighbours: np.ndarray) -> np.ndarray:
    """(count, STRIP) int32: chains of neighbours that together hold each cell once, -1 where there is none."""
    cell_count = len(neighbours)
    chains, count = wp.empty((cell_count, STRIP), dtype=wp.int32, device="cpu"), wp.zeros(1, wp.int32, device="cpu")
    taken = wp.zeros(cell_count, dtype=wp.int32, device="cpu")
    own = wp.array(neighbours, dtype=wp.int32, device="cpu")
    wp.launch(_chain_kernel(), 1, inputs=[own, taken], outputs=[chains, count], device="cpu")
    return chains.numpy()[: count.numpy()[0]]


def _numbered(cells: np.ndarray, chains: np.ndarray, lengths: np.ndarray) -> np.ndarray:
    """The points of strips such that cell k has those from k on: (count, STRIP + dim)."""
    corners = cells.shape[1]
    result = np.empty((len(chains), STRIP + corners - 1), dtype=np.int64)
    for length in range(1, STRIP + 1):
        rows = np.flatnonzero(lengths == length)
        if not len(rows):
            continue
        a, b, c = (cells[chains[rows, k]] for k in range(STRIP))
        if length == 1:
            own = a
        else:
            in_a = (b[:, :, None] == a[:, None, :]).any(axis=2)
            in_b = (a[:, :, None] == b[:, None, :]).any(axis=2)
            if length == 2:  # any of the shared points may come first
                leaving = np.zeros_like(in_a)
                leaving[np.arange(len(rows)), in_a.argmax(axis=1)] = True
                last = b[~in_a]
            else:
                leaving = ~(b[:, :, None] == c[:, None, :]).any(axis=2)
                last = c[~(c[:, :, None] == b[:, None, :]).any(axis=2)]
            shared = b[in_a & ~leaving].reshape(len(rows), -1)
            own = np.column_stack([a[~in_b], b[leaving], shared, b[~in_a], last])
        result[rows] = np.pad(own, ((0, 0), (0, result.shape[1] - own.shape[1])), mode="edge")
    return result
