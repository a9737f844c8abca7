"""Files beside an output, and how they are written: all or nothing."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import numpy as np


def beside(output: Path, ending: str) -> Path:
    """The file that belongs to an output: ``run.usdc`` and "checkpoint.npz" give ``run.checkpoint.npz``."""
    return output.with_name(f"{output.stem}.{ending}")


def _temporary(path: Path) -> Path:
    return path.with_name(f"writing.{path.name}")


def settle(temporary: Path, path: Path) -> None:
    """Moves a complete file to where it belongs, at one stroke, once it is on the disk for good.

    Raises:
        OSError: the file cannot be written out or moved.
    """
    with open(temporary, "rb+") as file:
        os.fsync(file.fileno())
    os.replace(temporary, path)


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Gives a temporary file to write; when the block ends it takes the place of ``path``.

    If the block raises, ``path`` stays as it was and the temporary file is removed.

    Raises:
        OSError: the file cannot be written out or moved.
    """
    temporary = _temporary(path)
    try:
        yield temporary
        settle(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def remove(path: Path) -> None:
    """Removes a file if there is one, and what a kill in the middle of writing it left.

    Raises:
        OSError: it cannot be removed.
    """
    path.unlink(missing_ok=True)
    _temporary(path).unlink(missing_ok=True)


def save_arrays(path: Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Writes arrays as ``.npz``; at any moment ``path`` is the old file or the new one.

    Raises:
        OSError: the file cannot be written.
    """
    with replacing(path) as temporary, open(temporary, "wb") as file:
        np.savez(file, **arrays)  # type: ignore[arg-type]
