"""A stage as a simulation looks at it: at its first time code, in SI units, and warning of what it passes over."""

from __future__ import annotations

import math
import warnings
from typing import Any

import numpy as np
from pxr import Sdf, Usd, UsdGeom, UsdPhysics, UsdShade

from warpfem.errors import SceneError, one_line
from warpfem.usd.physics.data import Place
from warpfem.usd.stages import metres_per_unit


class StageView:
    """Answers for the prims of a stage.

    Attributes:
        stage: the stage.
        prims: all its prims that are active and defined, also those of instances.
        start: the first time code, at which everything is read.
        length: metres per unit.
        mass: kilograms per unit.
    """

    def __init__(self, stage: Usd.Stage, path: str) -> None:
        """Raises SceneError for units that are none."""
        self.stage = stage
        self.path = path
        self.prims = list(stage.Traverse(Usd.TraverseInstanceProxies()))
        self.start = stage.GetStartTimeCode() if stage.HasAuthoredMetadata("startTimeCode") else 0.0
        self.length = metres_per_unit(stage)
        self.mass = UsdPhysics.GetStageKilogramsPerUnit(stage)
        for name, value in (("metersPerUnit", self.length), ("kilogramsPerUnit", self.mass)):
            if not (math.isfinite(value) and value > 0.0):
                raise SceneError(f"{path}: {name} must be a finite number above 0, not {value:g}")
        if not stage.HasAuthoredMetadata("metersPerUnit"):
            warnings.warn(f"{path}: it states no metersPerUnit: its numbers are taken as metres", stacklevel=2)
        self._transforms = UsdGeom.XformCache(self.start)

    def warn(self, prim: Usd.Prim, reason: str) -> None:
        """Says what of a prim is passed over."""
        warnings.warn(f"{self.path}, {prim.GetPath()}: {one_line(reason)}", stacklevel=2)

    def error(self, prim: Usd.Prim, reason: str) -> SceneError:
        """What is wrong with a prim."""
        return SceneError(f"{self.path}, {prim.GetPath()}: {reason}")

    def to_world(self, prim: Usd.Prim) -> np.ndarray:
        """The (4, 4) float64 matrix that takes row vectors from the prim's space to the world, in metres."""
        matrix = np.array(self._transforms.GetLocalToWorldTransform(prim))
        if not (np.isfinite(matrix).all() and np.linalg.det(matrix[:3, :3]) != 0.0):
            raise self.error(prim, "its transform is singular, or has numbers that are not finite")
        matrix[:, :3] *= self.length
        return matrix

    def is_carried(self, prim: Usd.Prim) -> bool:
        """Whether its transform to the world changes with time."""
        while prim and not prim.IsPseudoRoot():
            own = UsdGeom.Xformable(prim)
            if own and own.TransformMightBeTimeVarying():
                return True
            if own and own.GetResetXformStack():
                return False
            prim = prim.GetParent()
        return False

    def is_prototype(self, prim: Usd.Prim) -> bool:
        """Whether it stands for the instances of a ``PointInstancer``, and not for itself."""
        while prim and not prim.IsPseudoRoot():
            if prim.IsA(UsdGeom.PointInstancer):
                return True
            prim = prim.GetParent()
        return False

    def value(self, prim: Usd.Prim, name: str) -> Any:
        """What is authored for an attribute, at the start; else ``None``."""
        attribute = prim.GetAttribute(name)
        return attribute.Get(self.start) if attribute and attribute.HasAuthoredValue() else None

    def number(self, prim: Usd.Prim, name: str) -> float | None:
        """An authored number: the shortest of those that the file's float32 stands for.

        Raises:
            SceneError: it is none.
        """
        value = self.value(prim, name)
        if value is None:
            return None
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise self.error(prim, f"{name} must be a number, not {value!r}")
        is_single = prim.GetAttribute(name).GetTypeName() == Sdf.ValueTypeNames.Float
        return float(str(np.float32(value))) if is_single else float(value)

    def switch(self, prim: Usd.Prim, name: str, default: bool) -> bool:
        """An authored yes or no."""
        value = self.value(prim, name)
        return default if value is None else bool(value)

    def rows(self, prim: Usd.Prim, name: str, width: int = 3) -> np.ndarray | None:
        """An array of vectors, (n, width) float64, or of indices, int32, that is finite.

        Raises:
            SceneError: it is another kind of value.
        """
        attribute = prim.GetAttribute(name)
        value = attribute.Get(self.start) if attribute else None
        return None if value is None else self._rows(prim, name, value, width)

    def default_rows(self, prim: Usd.Prim, name: str) -> np.ndarray | None:
        """The default value of an array of vectors, (n, 3) float64, or that at the start if it has none."""
        attribute = prim.GetAttribute(name)
        value = attribute.Get() if attribute else None
        return self.rows(prim, name) if value is None else self._rows(prim, name, value, 3)

    def _rows(self, prim: Usd.Prim, name: str, value: Any, width: int) -> np.ndarray:
        array = np.array(value)
        if array.size == 0:
            return np.zeros((0, width))
        if array.dtype.kind not in "if" or array.ndim != 2 or array.shape[1] != width:
            raise self.error(prim, f"{name} must be an array of {width} numbers each")
        if not np.isfinite(array).all():
            raise self.error(prim, f"{name} has numbers that are not finite")
        return array.astype(np.int32 if array.dtype.kind == "i" else np.float64)

    def place(self, prim: Usd.Prim) -> Place:
        """Where the points of a prim are.

        Raises:
            SceneError: it has none, or they are not finite.
        """
        points = self.rows(prim, "points")
        if points is None or len(points) == 0:
            raise self.error(prim, "it has no points")
        return Place(str(prim.GetPath()), self.to_world(prim), points, _instances_above(prim))

    def material(self, prim: Usd.Prim) -> Usd.Prim | None:
        """The material bound to a prim for physics, or for all purposes, if it has physics on it."""
        material, _ = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial("physics")
        own = material.GetPrim() if material else None
        return own if own and any(name.startswith("Physics") for name in applied(own)) else None


def applied(prim: Usd.Prim) -> list[str]:
    """The names of the applied schemas, also of those that the library does not know."""
    return list(prim.GetPrimTypeInfo().GetAppliedAPISchemas())


def to_metres(points: np.ndarray, place: Place) -> np.ndarray:
    """World positions (n, 3) [m] of local ones."""
    return points @ place.to_world[:3, :3] + place.to_world[3, :3]


def _instances_above(prim: Usd.Prim) -> tuple[str, ...]:
    paths: list[Sdf.Path] = []
    while prim and not prim.IsPseudoRoot():
        if prim.IsInstance():
            paths.append(prim.GetPath())
        prim = prim.GetParent()
    return tuple(str(path) for path in reversed(paths))
