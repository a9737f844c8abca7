"""Files beside an output, and how they are written: all or nothing."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from warpfem.errors import OutputError


def beside(output: Path, ending: str) -> Path:
    """The file that belongs to an output: ``run.usdc`` and "checkpoint.npz" give ``run.checkpoint.npz``."""
    return output.with_name(f"{output.stem}.{ending}")


def require_writable(path: Path) -> None:
    """Checks what can be told of a file to write without writing anything.

    Raises:
        OutputError: a folder, a file that is write-protected, a name that the system does not bear, or a place that
            cannot be written to.
    """
    try:
        if path.is_dir():
            raise OutputError(f"{path} is a folder: give the name of a file")
        if path.exists() and not os.access(path, os.W_OK):
            raise OutputError(f"{path} cannot be written: it is write-protected")
        folder = existing_folder(path)
        if not folder.is_dir() or not os.access(folder, os.W_OK | os.X_OK):
            raise OutputError(f"{path} cannot be written: {folder} is not a folder that can be written to")
    except (OSError, ValueError) as problem:
        if isinstance(problem, OutputError):
            raise
        raise OutputError(f"{path} cannot be written: {problem}") from problem


def existing_folder(path: Path) -> Path:
    """The folder of a path, or the one that it will be made in."""
    folder = path.absolute().parent
    while not folder.exists():
        folder = folder.parent
    return folder


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
