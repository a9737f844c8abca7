"""Tetrahedra that were made before, on the disk, by what they were made of.

The folder is ``meshes`` in that of the environment variable ``WARPFEM_CACHE_DIR``, or in ``warpfem`` in that of
``XDG_CACHE_HOME``, or in ``~/.cache/warpfem``. It may be removed at any time. An empty ``WARPFEM_CACHE_DIR`` keeps
nothing.
"""

from __future__ import annotations

import hashlib
import os
import warnings
from collections.abc import Mapping
from pathlib import Path
from tempfile import NamedTemporaryFile

import numpy as np

_FORMAT = "1"


def folder() -> Path | None:
    """Where the meshes are, or ``None`` if none are to be kept."""
    own = os.environ.get("WARPFEM_CACHE_DIR")
    if own is None:
        base = os.environ.get("XDG_CACHE_HOME", "")
        own = os.path.join(base if os.path.isabs(base) else os.path.expanduser("~/.cache"), "warpfem")
    return Path(own) / "meshes" if own else None


def key(maker: str, problem: Mapping[str, np.ndarray]) -> str:
    """A name for what ``maker`` makes of the arrays, equal for equal ones alone."""
    digest = hashlib.sha256(f"{_FORMAT} {maker}".encode())
    for name, array in sorted(problem.items()):
        digest.update(f"{name} {array.dtype} {array.shape}".encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def recall(name: str) -> tuple[np.ndarray, np.ndarray] | None:
    """Points (n, 3) float64 and cells (m, 4) int32 that were kept by that name; ``None`` for none, or damaged ones."""
    where = folder()
    if where is None:
        return None
    try:
        with np.load(where / f"{name}.npz", allow_pickle=False) as kept:
            points, cells = kept["points"], kept["cells"]  # their checksums are compared
    except Exception:  # whatever damage leads to in a zip file or an array
        return None
    return points, cells


def keep(name: str, points: np.ndarray, cells: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Keeps a mesh by a name, and returns the one that is kept: that of another process if it came first.

    Where the disk refuses, a warning says so, and the mesh is returned.
    """
    where = folder()
    if where is None:
        return points, cells
    path = where / f"{name}.npz"
    try:
        where.mkdir(parents=True, exist_ok=True)
        with NamedTemporaryFile(dir=where, prefix="writing.", suffix=".npz", delete=False) as temporary:
            try:
                np.savez(temporary, points=points, cells=cells)
                temporary.close()
                try:
                    os.link(temporary.name, path)  # unlike a move, it does not replace what is there
                except OSError:  # something is there, or the disk knows no links
                    first = recall(name)
                    if first is not None:
                        return first
                    os.replace(temporary.name, path)
            finally:
                Path(temporary.name).unlink(missing_ok=True)
    except OSError as error:
        warnings.warn(
            f"the tetrahedra could not be kept for the next time: {error}; set WARPFEM_CACHE_DIR to another folder, or "
            "to nothing",
            stacklevel=2,
        )
    return points, cells
