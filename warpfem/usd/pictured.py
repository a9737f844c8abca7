"""Any stage as a picture needs it: which surfaces move, where they are in each frame, and what stands around them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pxr import Usd, UsdGeom

from warpfem.child import existing, read_in_child
from warpfem.errors import MeshError, OutputError
from warpfem.usd.animation import LARGEST
from warpfem.usd.colors import ColorScale
from warpfem.usd.meshes import triangles_of
from warpfem.usd.prims import OBSTACLES, POINT_PRIMVARS, WORLD
from warpfem.usd.solids import is_solid, solid_corners
from warpfem.usd.stages import at_rest, is_trusted, open_stage, read_attributes, reporting, trust, world_matrix

_SCALARS = ("half", "float", "double", "int", "uint", "int64", "uint64")


@dataclass(frozen=True, eq=False)
class Triangles:
    """The faces of a mesh, as triangles around their first corners.

    Attributes:
        points: the points of each, (k, 3) int, counter-clockwise as seen from outside.
        corners: which of the mesh's face corners they are, (k, 3) int.
        faces: which face each is a part of, (k,) int.
    """

    points: np.ndarray
    corners: np.ndarray
    faces: np.ndarray


@dataclass(frozen=True, eq=False)
class SurfaceFrame:
    """One surface in one frame.

    Attributes:
        points: (n, 3) float64 positions in the world [m].
        velocities: (n, 3) float64 [m/s], or ``None`` if the file has none.
    """

    points: np.ndarray
    velocities: np.ndarray | None


@dataclass(frozen=True, eq=False)
class Standing:
    """What does not move.

    Attributes:
        corners: (k, 3, 3) corners of its triangles in the world [m].
        is_plane: whether it stands for an infinite plane.
    """

    corners: np.ndarray
    is_plane: bool


class PicturedStage:
    """The surfaces of a stage that move; frames are read when they are asked for.

    Of a file that warpfem wrote these are the bodies; of others, such as a layer over an artist's stage, all meshes
    that are meant to be seen and whose points have time samples, and the boundaries of tetrahedral meshes beside which
    no such mesh moves. Frames are at the time samples.

    Attributes:
        fps: frames per second.
        frame_count: the number of frames.
        up_axis: ``"Y"`` or ``"Z"``.
        is_flat: whether it is a 2D scene of warpfem.
        equilibria: whether frames are equilibria on the way to the full load, and not moments in time.
        triangles: of each surface.
        has_insides: of each surface whether its back should not be seen.
        standing: the meshes, planes, cubes and spheres whose points do not move, as they are at the start.
        primvars: names of the scalar primvars that every surface has.
        color: the primvar that the file's own colours show, and their scale, if warpfem wrote it.
    """

    def __init__(self, path: str | Path) -> None:
        """Opens the file, without regard to whether it could end the process: see :func:`read_pictured_stage`.

        Raises:
            OutputError: a file that is missing, unreadable, or without surfaces that move.
        """
        self._path = path
        self._stage = stage = open_stage(path, OutputError)
        with reporting(f"{path} cannot be read as USD", OutputError):
            self.up_axis: str = UsdGeom.GetStageUpAxis(stage)
            world = stage.GetPrimAtPath(WORLD)
            stated = world.GetCustomData().get("warpfem") if world else None
            seen = [prim for prim in stage.Traverse(Usd.TraverseInstanceProxies()) if _is_seen(prim)]
            meshes = [prim for prim in seen if prim.IsA(UsdGeom.Mesh) or prim.IsA(UsdGeom.TetMesh)]
            self._prims = _without_doubles([prim for prim in meshes if _samples(prim) or (stated and _is_body(prim))])
            if not self._prims:
                raise OutputError(f"{path} has no mesh whose points move, so that there is nothing to draw")
            self._times: list[float] = sorted({time for prim in self._prims for time in _samples(prim)})
            self.frame_count = len(self._times)
            self.fps = self._rate()
            tets = [prim for prim in stage.Traverse() if prim.IsA(UsdGeom.TetMesh)]
            self.is_flat = stated is not None and not tets
            self.color: tuple[str, ColorScale] | None = None if stated is None else self._stated_color(stated)
            self.equilibria = bool(stated and stated.get("equilibria"))
            self.triangles = tuple(self._triangles(prim) for prim in self._prims)
            self.has_insides = tuple(self.is_flat or not _is_double_sided(prim) for prim in self._prims)
            scalars = [{var.GetPrimvarName() for var in _primvars(prim) if _is_scalar(var)} for prim in self._prims]
            self.primvars = tuple(sorted(set.intersection(*scalars)))
            self._require(self.color is None or self.color[0] in self.primvars, "the primvar of its colours")
            moving = {prim.GetPath() for prim in self._prims}
            self.standing = tuple(
                self._standing(prim)
                for prim in seen
                if prim.GetPath() not in moving and (is_solid(prim) or (prim.IsA(UsdGeom.Mesh) and self._count(prim)))
            )

    def frame(self, index: int) -> list[SurfaceFrame]:
        """Reads a frame: one entry per surface.

        Raises:
            OutputError: the file cannot be read any more, or is damaged.
        """
        with reporting(f"frame {index} cannot be read", OutputError):
            return [self._frame(prim, self._times[index]) for prim in self._prims]

    def rest(self) -> list[np.ndarray]:
        """Where the points of each surface are in the world at rest, (n, 3) float64 [m].

        Raises:
            OutputError: the file is damaged.
        """
        with reporting(f"the rest shape in {self._path} cannot be read", OutputError):
            default = Usd.TimeCode.Default()
            ready = all(UsdGeom.PointBased(prim).GetPointsAttr().Get(default) for prim in self._prims)
            return [self._frame(prim, default if ready else self._times[0]).points for prim in self._prims]

    def values(self, primvar: str, index: int) -> list[np.ndarray]:
        """Reads a primvar of the surfaces in a frame.

        Args:
            primvar: one of :attr:`primvars`, of any interpolation.
            index: the frame.

        Returns:
            Per surface (k, 3) float64 values at the corners of its triangles.

        Raises:
            OutputError: the values do not fit the surface, or are not finite.
        """
        with reporting(f"frame {index} cannot be read", OutputError):
            pairs = zip(self._prims, self.triangles, strict=True)
            return [self._values(prim, triangles, primvar, self._times[index]) for prim, triangles in pairs]

    def read_through(self) -> list[str]:
        """Reads all that this class can be asked for; returns the files that it is in."""
        for index, time in enumerate(self._times):
            self.frame(index)
            for prim in self._prims:
                read_attributes(prim, time)
        return [layer.realPath for layer in self._stage.GetUsedLayers() if layer.realPath]

    def _require(self, holds: bool, what: str) -> None:
        if not holds:
            raise OutputError(f"{self._path}: the file is damaged: it lacks {what}")

    def _rate(self) -> float:
        rate = self._stage.GetTimeCodesPerSecond()
        if self.frame_count > 1:
            rate *= (self.frame_count - 1) / (self._times[-1] - self._times[0])
        self._require(0.0 < rate < np.inf, "a number of frames per second that is finite and > 0")
        return rate

    def _stated_color(self, stated: dict) -> tuple[str, ColorScale]:
        """The colours that warpfem says its own files have."""
        quantity: Any = stated.get("colorBy")
        limits: Any = stated.get("colorRange")
        good = quantity in POINT_PRIMVARS and limits is not None and -LARGEST < limits[0] < limits[1] < LARGEST
        self._require(good, "a range of colours")
        return POINT_PRIMVARS[quantity], ColorScale(quantity, *limits)

    def _triangles(self, prim: Usd.Prim) -> Triangles:
        if prim.IsA(UsdGeom.TetMesh):
            tets = UsdGeom.TetMesh(prim)
            stated = at_rest(tets.GetSurfaceFaceVertexIndicesAttr())
            earliest = Usd.TimeCode.EarliestTime()
            points = np.array(stated or UsdGeom.TetMesh.ComputeSurfaceFaces(tets, earliest), np.int64).reshape(-1, 3)
            found = Triangles(points, np.arange(points.size).reshape(-1, 3), np.arange(len(points)))
        else:
            mesh = UsdGeom.Mesh(prim)
            counts = np.array(at_rest(mesh.GetFaceVertexCountsAttr()) or [], np.int64)
            indices = np.array(at_rest(mesh.GetFaceVertexIndicesAttr()) or [], np.int64)
            fits = counts.size > 0 and counts.min() >= 3 and counts.sum() == len(indices)
            self._require(bool(fits), f"faces of at least three corners in {prim.GetPath()}")
            fans = counts - 2
            first = np.repeat(np.cumsum(counts) - counts, fans)
            step = np.arange(fans.sum()) - np.repeat(np.cumsum(fans) - fans, fans)
            corners = np.column_stack([first, first + step + 1, first + step + 2])
            found = Triangles(indices[corners], corners, np.repeat(np.arange(len(counts)), fans))
        left_handed = at_rest(UsdGeom.Gprim(prim).GetOrientationAttr()) == UsdGeom.Tokens.leftHanded
        if left_handed != bool(np.linalg.det(world_matrix(prim)[:3, :3]) < 0.0):
            found = Triangles(found.points[:, ::-1], found.corners[:, ::-1], found.faces)
        count = self._count(prim)
        inside = found.points.size > 0 and found.points.min() >= 0 and found.points.max() < count
        self._require(bool(inside), f"indices of its {count} points in {prim.GetPath()}")
        return found

    def _count(self, prim: Usd.Prim) -> int:
        return len(at_rest(UsdGeom.PointBased(prim).GetPointsAttr()) or [])

    def _standing(self, prim: Usd.Prim) -> Standing:
        own_plane = prim.GetName().startswith("Plane_") and not _is_body(prim)
        if is_solid(prim):
            standing = Standing(solid_corners(prim), prim.IsA(UsdGeom.Plane))
        else:
            try:
                points, faces = triangles_of(UsdGeom.Mesh(prim))
            except MeshError as error:
                raise OutputError(str(error)) from error
            standing = Standing(points[faces], own_plane)
        self._require(bool((np.abs(standing.corners) < LARGEST).all()), f"finite points in {prim.GetPath()}")
        return standing

    def _frame(self, prim: Usd.Prim, time: float | Usd.TimeCode) -> SurfaceFrame:
        based = UsdGeom.PointBased(prim)
        matrix = world_matrix(prim, time)
        points = self._vectors(prim, based.GetPointsAttr(), time)
        self._require(len(points) == self._count(prim), f"the same number of points of {prim.GetPath()} at all times")
        points = points @ matrix[:3, :3] + matrix[3, :3]
        self._require(bool(np.abs(points).max() < LARGEST), f"finite points in {prim.GetPath()} at {time}")
        velocities = None
        if based.GetVelocitiesAttr().HasAuthoredValue():
            velocities = self._vectors(prim, based.GetVelocitiesAttr(), time) @ matrix[:3, :3]
            self._require(len(velocities) == len(points), f"velocities of all points of {prim.GetPath()} at {time}")
        return SurfaceFrame(points, velocities)

    def _vectors(self, prim: Usd.Prim, attribute: Usd.Attribute, time: float | Usd.TimeCode) -> np.ndarray:
        values = np.array(attribute.Get(time) or [])
        good = values.dtype.kind == "f" and values.ndim == 2 and values.shape[1] == 3 and np.isfinite(values).all()
        self._require(bool(good), f"{attribute.GetName()} of {prim.GetPath()} at {time}")
        return values.astype(np.float64)

    def _values(self, prim: Usd.Prim, triangles: Triangles, name: str, time: float) -> np.ndarray:
        primvar = UsdGeom.PrimvarsAPI(prim).GetPrimvar(name)
        values = np.array(primvar.ComputeFlattened(time))
        kinds = {
            UsdGeom.Tokens.constant: np.zeros_like(triangles.points),
            UsdGeom.Tokens.uniform: np.repeat(triangles.faces[:, None], 3, axis=1),
            UsdGeom.Tokens.faceVarying: triangles.corners,
        }
        places = kinds.get(primvar.GetInterpolation(), triangles.points)
        good = values.dtype.kind in "fiu" and values.size > places.max() and bool(np.isfinite(values).all())
        self._require(good, f"{primvar.GetName()} of {prim.GetPath()} at {time}, one number for each of its elements")
        return values.reshape(-1).astype(np.float64)[places]


def read_pictured_stage(path: str | Path) -> PicturedStage:
    """Opens a stage for pictures, a partial one of warpfem too, also while it is being written.

    A file that this process has neither written nor read is read through in a child process first, because the
    USD library may end the process on a damaged file.

    Raises:
        OutputError: a file that is missing, unreadable or damaged, or has no surfaces that move.
    """
    path = existing(path, OutputError)
    if not is_trusted(path):
        trust(path, read_in_child(read_through, path, OutputError))
    return PicturedStage(path)


def read_through(path: str) -> list[str]:
    """Reads all frames; returns the files that they are in. Called in a child process."""
    return PicturedStage(path).read_through()


def _is_seen(prim: Usd.Prim) -> bool:
    """Whether a prim is a shape that is meant to be seen."""
    if not prim.IsA(UsdGeom.Gprim):
        return False
    imageable = UsdGeom.Imageable(prim)
    hidden = imageable.ComputeVisibility(Usd.TimeCode.EarliestTime()) == UsdGeom.Tokens.invisible
    return not hidden and imageable.ComputePurpose() in (UsdGeom.Tokens.default_, UsdGeom.Tokens.render)


def _is_body(prim: Usd.Prim) -> bool:
    """Whether a mesh in a file of warpfem is that of a body, which may have no frames yet."""
    return OBSTACLES not in prim.GetPath().GetParentPath().pathString.split("/")


def _without_doubles(prims: list[Usd.Prim]) -> list[Usd.Prim]:
    """The prims without the tetrahedral meshes that move together with a surface below the same parent."""
    meshes = [prim.GetPath() for prim in prims if prim.IsA(UsdGeom.Mesh)]

    def is_double(prim: Usd.Prim) -> bool:
        parent = prim.GetPath().GetParentPath()
        siblings = [other for other in prims if other.IsA(UsdGeom.TetMesh) and other.GetPath().HasPrefix(parent)]
        return len(siblings) == 1 and any(path.HasPrefix(parent) for path in meshes)

    return [prim for prim in prims if prim.IsA(UsdGeom.Mesh) or not is_double(prim)]


def _samples(prim: Usd.Prim) -> list[float]:
    return UsdGeom.PointBased(prim).GetPointsAttr().GetTimeSamples()


def _is_double_sided(prim: Usd.Prim) -> bool:
    return bool(at_rest(UsdGeom.Gprim(prim).GetDoubleSidedAttr()))


def _primvars(prim: Usd.Prim) -> list[UsdGeom.Primvar]:
    return UsdGeom.PrimvarsAPI(prim).GetPrimvarsWithValues()


def _is_scalar(primvar: UsdGeom.Primvar) -> bool:
    by_cell = primvar.GetAttr().GetPrim().IsA(UsdGeom.TetMesh) and primvar.GetInterpolation() == UsdGeom.Tokens.uniform
    return str(primvar.GetTypeName().scalarType) in _SCALARS and not by_cell
