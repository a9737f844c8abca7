"""Opening USD files, and telling what went wrong with one."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from pxr import Sdf, Tf, Usd, UsdGeom

from warpfem.errors import WarpfemError


@contextlib.contextmanager
def reporting(what: str, error: type[WarpfemError]) -> Iterator[None]:
    """Turns what the system or the USD library raises into ``error``, as "what: reason"."""
    try:
        yield
    except WarpfemError:
        raise
    except Tf.ErrorException as problem:
        reasons = [item.commentary.strip() for item in problem.args]
        raise error(f"{what}: {'; '.join(reasons)}") from problem
    except OSError as problem:
        raise error(f"{what}: {problem}") from problem


def open_stage(path: str | Path, error: type[WarpfemError]) -> Usd.Stage:
    """Opens a USD file as it is on disk now, even if an older state of it is open elsewhere in the process.

    Raises:
        error: the file is missing, or not readable as USD.
    """
    if not Path(path).is_file():
        raise error(f"{path}: there is no such file")
    with reporting(f"{path} cannot be read as USD", error):
        layer = Sdf.Layer.FindOrOpen(str(path))
        layer.Reload()
        stage = Usd.Stage.Open(layer)
        stage.Reload()
    return stage


def at_rest(attribute: Usd.Attribute) -> Any:
    """The default value of an attribute, or its first sample if there is no default."""
    value = attribute.Get()
    return attribute.Get(Usd.TimeCode.EarliestTime()) if value is None else value


def world_matrix(prim: Usd.Prim) -> np.ndarray:
    """The (4, 4) float64 matrix that takes row vectors from the prim to the world, in metres.

    The stage's unit counts where the file states one; where it does not, numbers are metres.
    """
    stage = prim.GetStage()
    stated = stage.HasAuthoredMetadata(UsdGeom.Tokens.metersPerUnit)
    matrix = np.array(UsdGeom.XformCache(Usd.TimeCode.EarliestTime()).GetLocalToWorldTransform(prim))
    matrix[:, :3] *= UsdGeom.GetStageMetersPerUnit(stage) if stated else 1.0
    return matrix
