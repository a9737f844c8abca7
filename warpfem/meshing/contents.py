"""What a file holds, as a child process hands it over: plain arrays that nobody has checked."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, TypeAlias

import numpy as np

from warpfem.errors import MeshError

Axis: TypeAlias = Literal["Y", "Z"]

MAX_TAGS = 256
"""Whole numbers per cell with more different values than this number the cells rather than their regions."""


@dataclass(frozen=True)
class Surface:
    """Triangles in space.

    Attributes:
        points: (n, 3) positions, in metres if the format knows units.
        triangles: (k, 3) point indices.
        up_axis: the axis that points up, if the file says so.
    """

    points: np.ndarray
    triangles: np.ndarray
    up_axis: Axis | None = None


@dataclass(frozen=True)
class Solid:
    """Cells with their sets and data.

    Attributes:
        points: (n, dim) positions, in metres if the format knows units.
        cells: (m, k) point indices.
        point_sets: indices into ``points`` by name.
        cell_sets: indices into ``cells`` by name.
        cell_data: (m,) numbers by name.
        up_axis: the axis that points up, if the file says so.
    """

    points: np.ndarray
    cells: np.ndarray
    point_sets: Mapping[str, np.ndarray] = field(default_factory=dict)
    cell_sets: Mapping[str, np.ndarray] = field(default_factory=dict)
    cell_data: Mapping[str, np.ndarray] = field(default_factory=dict)
    up_axis: Axis | None = None


def tagged(name: str, tags: np.ndarray) -> Iterator[tuple[str, np.ndarray]]:
    """Sets by the whole number that each member has: ``NAME_TAG`` and its members; none of numbers that only count."""
    values = np.unique(tags) if tags.dtype.kind in "biu" else ()
    if len(values) <= MAX_TAGS:
        for value in values:
            yield f"{name}_{int(value)}", np.flatnonzero(tags == value)


@contextmanager
def naming(path: str | Path) -> Iterator[None]:
    """Put the file's name in front of errors about what is in it."""
    try:
        yield
    except MeshError as error:
        raise MeshError(f"{path}: {error}") from error
