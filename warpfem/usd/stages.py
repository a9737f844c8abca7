"""Opening USD files, and telling what went wrong with one."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, Literal, TypeAlias

import numpy as np
from pxr import Sdf, Tf, Usd, UsdGeom

from warpfem.child import existing
from warpfem.errors import WarpfemError, one_line

Stamp: TypeAlias = tuple[int, int, int]

_trusted: dict[str, dict[str, Stamp | None]] = {}
"""What was known of a file, and of the files that it refers to, when it was last read through or written."""


@contextlib.contextmanager
def reporting(what: str, error: type[WarpfemError]) -> Iterator[None]:
    """Turns what the system or the USD library raises into ``error``, as "what: reason"."""
    try:
        yield
    except WarpfemError:
        raise
    except Tf.ErrorException as problem:
        reasons = "; ".join(item.commentary.strip() for item in problem.args)
        raise error(f"{what}: {one_line(reasons)}") from problem
    except OSError as problem:
        raise error(f"{what}: {problem}") from problem


def open_stage(path: str | Path, error: type[WarpfemError]) -> Usd.Stage:
    """Opens a USD file as it is on disk now, even if an older state of it is open elsewhere in the process.

    A damaged file may end the process: open what others made in a child process first.

    Raises:
        error: the file is missing, or not readable as USD.
    """
    existing(path, error)
    with reporting(f"{path} cannot be read as USD", error):
        layer = Sdf.Layer.FindOrOpen(str(path))
        layer.Reload()
        stage = Usd.Stage.Open(layer)
        stage.Reload()
    return stage


def trust(path: str | Path, layers: Iterable[str] = ()) -> None:
    """Notes that a file is sound as it is now, with the other ``layers`` that it refers to."""
    _trusted[os.path.abspath(path)] = {file: _stamp(file) for file in map(os.path.abspath, (path, *layers))}


def is_trusted(path: str | Path) -> bool:
    """Whether nothing has changed since :func:`trust`."""
    files = _trusted.get(os.path.abspath(path))
    return files is not None and all(stamp and _stamp(file) == stamp for file, stamp in files.items())


def _stamp(path: str) -> Stamp | None:
    try:
        status = os.stat(path)
    except OSError:
        return None
    return status.st_size, status.st_mtime_ns, status.st_ino


def at_rest(attribute: Usd.Attribute) -> Any:
    """The default value of an attribute, or its first sample if there is no default."""
    value = attribute.Get()
    return attribute.Get(Usd.TimeCode.EarliestTime()) if value is None else value


def read_attributes(prim: Usd.Prim, time: float) -> None:
    """Reads all that is written of a prim at a time, to see whether the USD library bears it."""
    for attribute in prim.GetAuthoredAttributes():
        attribute.Get(time)


def stated_up_axis(stage: Usd.Stage) -> Literal["Y", "Z"] | None:
    """The axis that points up, if the file states it."""
    if not stage.HasAuthoredMetadata(UsdGeom.Tokens.upAxis):
        return None
    return "Z" if UsdGeom.GetStageUpAxis(stage) == UsdGeom.Tokens.z else "Y"


def metres_per_unit(stage: Usd.Stage) -> float:
    """The stage's unit of length [m]; where the file states none, numbers are metres."""
    stated = stage.HasAuthoredMetadata(UsdGeom.Tokens.metersPerUnit)
    return UsdGeom.GetStageMetersPerUnit(stage) if stated else 1.0


def world_matrix(prim: Usd.Prim, time: float | Usd.TimeCode | None = None) -> np.ndarray:
    """The (4, 4) float64 matrix that takes row vectors from the prim to the world, in metres.

    Args:
        prim: the prim.
        time: when; ``None`` for the earliest time.
    """
    cache = UsdGeom.XformCache(Usd.TimeCode.EarliestTime() if time is None else time)
    matrix = np.array(cache.GetLocalToWorldTransform(prim))
    matrix[:, :3] *= metres_per_unit(prim.GetStage())
    return matrix
