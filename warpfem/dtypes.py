"""Warp types for each dimension and floating-point precision."""

import functools
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import warp as wp

from warpfem.errors import WarpfemError

FloatName = Literal["float32", "float64"]


@dataclass(frozen=True)
class Types:
    """The Warp types of one (dimension, precision).

    Attributes:
        dim: 2 or 3.
        scalar: ``wp.float32`` or ``wp.float64``.
        vector: vector of length ``dim``.
        matrix: ``dim`` x ``dim`` matrix.
        numpy: the NumPy scalar type.
    """

    dim: int
    scalar: type
    vector: type
    matrix: type
    numpy: type

    @property
    def name(self) -> FloatName:
        """The precision by its name."""
        return "float32" if self.scalar is wp.float32 else "float64"

    @property
    def epsilon(self) -> float:
        """Distance from 1 to the next larger number."""
        return float(np.finfo(self.numpy).eps)


@functools.cache
def types(dim: int, dtype: str) -> Types:
    """Returns the types for ``dim`` (2 or 3) and ``dtype`` ("float32" or "float64").

    Raises:
        WarpfemError: for any other dimension or dtype.
    """
    scalars = {"float32": wp.float32, "float64": wp.float64}
    if dim not in (2, 3):
        raise WarpfemError(f"dim must be 2 or 3, not {dim!r}")
    if dtype not in scalars:
        raise WarpfemError(f"dtype must be 'float32' or 'float64', not {dtype!r}")
    scalar = scalars[dtype]
    return Types(
        dim=dim,
        scalar=scalar,
        vector=wp.types.vector(length=dim, dtype=scalar),
        matrix=wp.types.matrix(shape=(dim, dim), dtype=scalar),
        numpy=np.float32 if dtype == "float32" else np.float64,
    )


def uniform_array(value: Any, count: int, dtype: type, device: Any) -> wp.array:
    """An array of ``count`` equal entries that stores the entry once (stride 0).

    Args:
        value: the entry, as NumPy data of shape (1, ...).
        count: apparent length.
        dtype: Warp type of an entry.
        device: Warp device.
    """
    stored = wp.array(value, dtype=dtype, device=device)
    view = wp.array(ptr=stored.ptr, dtype=dtype, shape=(count,), strides=(0,), device=device)
    view._stored = stored  # keeps the memory alive as long as the view
    return view


def part_of(array: wp.array, part: slice) -> wp.array:
    """A part of an array, which may be a :func:`uniform_array`."""
    view = array[part]
    if hasattr(array, "_stored"):
        view._stored = array._stored
    return view
