"""A rasteriser in numpy with a depth buffer, so that what is hidden is hidden."""

from __future__ import annotations

import copy
from collections.abc import Iterator

import numpy as np

from warpfem.preview.camera import SAMPLES, View

BACKGROUND = np.array([0.975, 0.98, 0.985], np.float32)

_LINE = 0.4 * SAMPLES
"""Half of the width of an edge [samples]."""
_BATCH = 1_000_000
"""Samples that are drawn together."""


class Canvas:
    """An image with a depth buffer: ``color`` (n, 3) and ``depth`` (n,) of its samples, row after row."""

    def __init__(self, view: View) -> None:
        self.view = view
        self.color = np.tile(BACKGROUND, (view.width * view.height, 1))
        self.depth = np.full(len(self.color), -np.inf)

    def copy(self) -> Canvas:
        """An independent copy."""
        other = copy.copy(self)
        other.color, other.depth = self.color.copy(), self.depth.copy()
        return other

    def draw(self, corners: np.ndarray, colors: np.ndarray, lines: float = 0.0) -> np.ndarray:
        """Draws triangles, where nothing that was drawn before is nearer.

        Args:
            corners: (k, 3, 3) positions [samples].
            colors: colours of the corners, (k, 3, 3) or what broadcasts to it.
            lines: how much edges are darkened, 0..1; less in small triangles.

        Returns:
            The samples that changed, some repeatedly.
        """
        colors = np.broadcast_to(colors, corners.shape)
        heights = _heights(corners)
        darkness = lines * np.minimum(heights.min(axis=0) / (16.0 * _LINE), 1.0)
        changed = [np.zeros(0, int)]
        for triangle, sample, weights in _fragments(corners, self.view):
            depth = (weights * corners[triangle, :, 2].T).sum(axis=0)
            np.maximum.at(self.depth, sample, depth)
            seen = np.flatnonzero(self.depth[sample] == depth)
            triangle, sample, weights = triangle[seen], sample[seen], weights[:, seen]
            on_line = (weights * heights[:, triangle]).min(axis=0) < _LINE
            brightness = weights * (1.0 - darkness[triangle] * on_line)
            self.color[sample] = np.einsum("cn,ncd->nd", brightness, colors[triangle])
            changed.append(sample)
        return np.concatenate(changed)

    def image(self) -> np.ndarray:
        """The picture, one pixel for each block of samples: (height, width, 3) uint8."""
        color = self.color.reshape(self.view.height, self.view.width, 3)
        parts = [color[row::SAMPLES, column::SAMPLES] for row, column in np.ndindex(SAMPLES, SAMPLES)]
        return np.round(255.0 / len(parts) * sum(parts)).astype(np.uint8)


def covered(corners: np.ndarray, view: View) -> np.ndarray:
    """The mask (n,) of the samples that triangles (k, 3, 3) [samples] cover."""
    mask = np.zeros(view.width * view.height, bool)
    for _, sample, _ in _fragments(corners, view):
        mask[sample] = True
    return mask


def _heights(corners: np.ndarray) -> np.ndarray:
    """(3, k) height of each corner of triangles (k, 3, 3) above the opposite side, in the image [samples]."""
    sides = (np.roll(corners, -1, axis=1) - np.roll(corners, -2, axis=1))[..., :2]
    doubled_areas = np.abs(np.linalg.det(sides[:, :2]))
    return doubled_areas / np.maximum(np.linalg.norm(sides, axis=2), 1e-9).T


def _fragments(corners: np.ndarray, view: View) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """The samples that triangles (k, 3, 3) [samples] cover, in batches.

    Yields:
        Of every sample within a triangle: the triangle, the sample, and the weights (3, n) of the corners.
    """
    flat = corners[..., :2] - 0.5  # samples are now at whole numbers
    matrices = np.concatenate([flat, np.ones((*flat.shape[:2], 1))], axis=2)
    doubled_areas = np.abs(np.linalg.det(matrices))
    solid = np.flatnonzero(doubled_areas > 1e-3)
    by_x, by_y, at_zero = np.linalg.inv(matrices[solid]).transpose(1, 2, 0)
    tops = np.clip(np.ceil(flat[solid, :, 1].min(axis=1)), 0, view.height).astype(int)
    row_counts = np.clip(np.floor(flat[solid, :, 1].max(axis=1)) + 1, tops, view.height).astype(int) - tops
    work = np.cumsum(0.5 * doubled_areas[solid] + row_counts)
    for batch in np.split(np.arange(len(solid)), np.flatnonzero(np.diff(work // _BATCH)) + 1):
        triangle, down = _runs(batch, row_counts[batch])
        y = tops[triangle] + down
        slopes, at_row = by_x[:, triangle], at_zero[:, triangle] + y * by_y[:, triangle]
        crossings = -at_row / np.where(slopes == 0.0, 1.0, slopes)
        left = np.where(slopes > 0.0, crossings, -np.inf).max(axis=0) - 1e-6
        right = np.where(slopes < 0.0, crossings, np.inf).min(axis=0) + 1e-6
        start = np.clip(np.ceil(left), 0, view.width).astype(int)
        row, along = _runs(np.arange(len(y)), np.clip(np.floor(right) + 1, start, view.width).astype(int) - start)
        x = start[row] + along
        yield solid[triangle[row]], y[row] * view.width + x, at_row[:, row] + x * slopes[:, row]


def _runs(values: np.ndarray, counts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Each of the (n,) values as often as (n,) ``counts`` say, and the place 0, 1, ... of each in its run."""
    starts = np.cumsum(counts) - counts
    return np.repeat(values, counts), np.arange(counts.sum()) - np.repeat(starts, counts)
