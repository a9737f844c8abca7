"""Stresses at points from those within cells: patch recovery (after Zienkiewicz and Zhu 1992).

To the samples in the cells about an inner corner, its patch, a polynomial is fitted by least squares and taken at the
corner. Points on the boundary and midpoints take the mean of the polynomials of the inner corners next to them, whose
patches lie about them on all sides. A point that has none next to it gets a patch of its own, which grows by the cells
about it.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations_with_replacement
from typing import TypeAlias

import numpy as np

SURPLUS = 1.5
"""Samples for each coefficient of its polynomial that a patch needs."""

LEAST_EIGENVALUE = 1e-4
"""Smallest eigenvalue of a patch's normal matrix, relative to the largest, that determines a coefficient."""

MOST_AMPLIFICATION = 1.0
"""Variance of a polynomial's value for independent errors of variance 1 in the samples; patches that give more are
too lopsided."""

MOST_RINGS = 3
"""Rings of points about a point in the largest patch; coefficients that it does not determine are left out."""

POINTS_PER_PART = 2048
"""Points whose patches are held at a time."""

_Pairs: TypeAlias = tuple[np.ndarray, np.ndarray]
"""Numbers of patches, sorted, and a member of the patch for each."""


def recover(
    points: np.ndarray,
    cells: np.ndarray,
    boundary: np.ndarray,
    places: np.ndarray,
    sample_cells: np.ndarray,
    values: np.ndarray,
    degree: int = 1,
) -> np.ndarray:
    """Values at the points of a mesh from samples within its cells.

    A field that is a polynomial of the degree comes out exactly where there are cells enough to determine it.

    Args:
        points: rest positions of the points, (n, d) [m].
        cells: the points of each cell, (m, k), its d + 1 corners first.
        boundary: numbers of the points on the boundary.
        places: rest positions of the samples, (s, d) [m]; every cell has one at least.
        sample_cells: the cell of each sample, (s,).
        values: the samples, (s, ...).
        degree: that of the polynomials: 1 for linear cells, 2 for quadratic ones.

    Returns:
        (n, ...) float64.
    """
    patches = _Patches(points, cells, places, sample_cells, np.asarray(values).reshape(len(places), -1), degree)
    result = np.empty((len(points), patches.values.shape[1]))
    central = np.zeros(len(points), dtype=bool)
    central[cells[:, : points.shape[1] + 1]] = True
    central[boundary] = False
    centers = np.flatnonzero(central)
    fits = [patches.grown(part, 0) for part in _parts(centers)]
    for part, fit in zip(_parts(centers), fits, strict=True):
        result[part], _ = fit.at(np.arange(len(part)), points[part])
    number = np.cumsum(central) - 1
    polynomials = _Polynomials.joined(fits) if fits else None
    for part in _parts(np.flatnonzero(~central)):
        found = np.zeros(len(part), dtype=bool)
        if polynomials is not None:
            owners, near = patches.ring((np.arange(len(part)), part))
            owners, near = owners[central[near]], near[central[near]]
            fitted, good = polynomials.at(number[near], points[part[owners]])
            counts = np.bincount(owners[good], minlength=len(part))
            found = counts > 0
            result[part] = _sums(owners[good], fitted[good], len(part)) / np.maximum(counts, 1)[:, None]
        alone = part[~found]
        if len(alone) > 0:
            result[alone], _ = patches.grown(alone, 1).at(np.arange(len(alone)), points[alone])
    return result.reshape(len(points), *np.shape(values)[1:])


def _parts(numbers: np.ndarray) -> list[np.ndarray]:
    """Numbers in parts whose patches fit into memory."""
    return [numbers[start : start + POINTS_PER_PART] for start in range(0, len(numbers), POINTS_PER_PART)]


@dataclass(frozen=True)
class _Polynomials:
    """Least squares polynomials of patches, in places relative to the mean of each patch's samples.

    Attributes:
        degree: of all of them.
        origins: means of the samples' places, (p, d).
        sizes: their root mean square distances from that, (p,).
        inverses: inverses of the normal matrices, (p, q, q), without what the samples do not determine.
        coefficients: (p, q, m).
        determined: whether the samples determine each of them, (p,).
    """

    degree: int
    origins: np.ndarray
    sizes: np.ndarray
    inverses: np.ndarray
    coefficients: np.ndarray
    determined: np.ndarray

    @classmethod
    def fitted(cls, places: np.ndarray, values: np.ndarray, samples: _Pairs, count: int, degree: int) -> _Polynomials:
        """The polynomials of ``count`` patches, each with one sample at least, of which pairs are given."""
        owners, members = samples
        counts = np.bincount(owners, minlength=count)
        origins = _sums(owners, places[members], count) / counts[:, None]
        x = places[members] - origins[owners]
        sizes = np.sqrt(_sums(owners, (x**2).sum(axis=1), count) / counts)
        sizes[sizes == 0.0] = 1.0  # a single sample
        terms = _monomials(x / sizes[owners, None], degree)
        terms_count = terms.shape[1]
        normal = np.empty((count, terms_count, terms_count))
        for a in range(terms_count):
            for b in range(a, terms_count):
                normal[:, a, b] = normal[:, b, a] = _sums(owners, terms[:, a] * terms[:, b], count)
        eigenvalues, vectors = np.linalg.eigh(normal)
        known = eigenvalues > LEAST_EIGENVALUE * eigenvalues[:, -1:]
        reciprocals = np.divide(1.0, eigenvalues, out=np.zeros_like(eigenvalues), where=known)
        inverses = (vectors * reciprocals[:, None, :]) @ vectors.transpose(0, 2, 1)
        field = values[members]
        sums = np.stack([_sums(owners, terms[:, a, None] * field, count) for a in range(terms_count)], axis=1)
        determined = known.all(axis=1) & (counts >= SURPLUS * terms_count)
        return cls(degree, origins, sizes, inverses, inverses @ sums, determined)

    @classmethod
    def joined(cls, parts: list[_Polynomials]) -> _Polynomials:
        """All polynomials of the parts."""
        names = ("origins", "sizes", "inverses", "coefficients", "determined")
        return cls(parts[0].degree, *(np.concatenate([getattr(part, name) for part in parts]) for name in names))

    def at(self, numbers: np.ndarray, places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The values of some of them at a place for each, (k, m), and whether they are to be trusted, (k,)."""
        terms = _monomials((places - self.origins[numbers]) / self.sizes[numbers, None], self.degree)
        amplification = np.einsum("ka,kab,kb->k", terms, self.inverses[numbers], terms, optimize=True)
        values = np.einsum("ka,kam->km", terms, self.coefficients[numbers])
        return values, self.determined[numbers] & (amplification <= MOST_AMPLIFICATION)

    def replace(self, numbers: np.ndarray, others: _Polynomials) -> None:
        """Puts the others in the place of some of them."""
        for name in ("origins", "sizes", "inverses", "coefficients", "determined"):
            getattr(self, name)[numbers] = getattr(others, name)


class _Patches:
    """The neighbourhoods of points in a mesh, with the samples in them."""

    def __init__(
        self,
        points: np.ndarray,
        cells: np.ndarray,
        places: np.ndarray,
        sample_cells: np.ndarray,
        values: np.ndarray,
        degree: int,
    ) -> None:
        self.points = points
        self.cells = cells
        self.places = places
        self.values = values
        self.degree = degree
        self._about_point = _groups(cells.ravel(), len(points), np.repeat(np.arange(len(cells)), cells.shape[1]))
        self._in_cell = _groups(sample_cells, len(cells), np.arange(len(places)))

    def grown(self, targets: np.ndarray, least_rings: int) -> _Polynomials:
        """The polynomials of the patches of points, which grow ring by ring until they can be trusted there."""
        near: _Pairs = (np.arange(len(targets)), targets)
        for _ in range(least_rings):
            near = self.ring(near)
        result = self._fitted(near, len(targets))
        _, good = result.at(np.arange(len(targets)), self.points[targets])
        left = np.arange(len(targets))
        for _ in range(least_rings, MOST_RINGS):
            if good.all():
                break
            keep = ~good[near[0]]
            near = self.ring(((np.cumsum(~good) - 1)[near[0][keep]], near[1][keep]))
            left = left[~good]
            result.replace(left, self._fitted(near, len(left)))
            _, good = result.at(left, self.points[targets[left]])
        return result

    def ring(self, near: _Pairs) -> _Pairs:
        """Patches of points with their neighbours."""
        owners, about = self._cells_about(near)
        return _unique(np.repeat(owners, self.cells.shape[1]), self.cells[about].ravel())

    def _cells_about(self, near: _Pairs) -> _Pairs:
        return _unique(*_expand(near, self._about_point))

    def _fitted(self, near: _Pairs, count: int) -> _Polynomials:
        samples = _expand(self._cells_about(near), self._in_cell)
        return _Polynomials.fitted(self.places, self.values, samples, count, self.degree)


def _groups(keys: np.ndarray, count: int, members: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Members by key, in compressed rows: where each key's begin (count + 1,), and all of them."""
    order = np.argsort(keys, kind="stable")
    return np.searchsorted(keys[order], np.arange(count + 1)), members[order]


def _expand(pairs: _Pairs, groups: tuple[np.ndarray, np.ndarray]) -> _Pairs:
    """For pairs of an owner and a key the pairs of the owner and each of the key's members."""
    (owners, keys), (starts, members) = pairs, groups
    counts = starts[keys + 1] - starts[keys]
    ends = np.cumsum(counts)
    return np.repeat(owners, counts), members[np.arange(counts.sum()) + np.repeat(starts[keys] - ends + counts, counts)]


def _unique(owners: np.ndarray, members: np.ndarray) -> _Pairs:
    """The pairs, sorted, each once."""
    bound = int(members.max(initial=0)) + 1
    keys = np.sort(owners.astype(np.int64) * bound + members)
    keys = keys[np.diff(keys, prepend=-1) > 0]
    return keys // bound, keys % bound


def _sums(owners: np.ndarray, rows: np.ndarray, count: int) -> np.ndarray:
    """The sums of the rows of each owner; owners are sorted."""
    result = np.zeros((count, *rows.shape[1:]))
    if len(owners) > 0:
        starts = np.flatnonzero(np.diff(owners, prepend=-1))
        result[owners[starts]] = np.add.reduceat(rows, starts, axis=0)
    return result


def _monomials(x: np.ndarray, degree: int) -> np.ndarray:
    """1 and all products of up to ``degree`` components of x (k, d), in columns."""
    columns = [np.ones(len(x))]
    for order in range(1, degree + 1):
        for axes in combinations_with_replacement(range(x.shape[1]), order):
            columns.append(np.prod(x[:, axes], axis=1))
    return np.stack(columns, axis=1)
