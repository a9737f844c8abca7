"""Reads the animations that warpfem wrote back, frame by frame: to go on with them, and to compare."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pxr import Usd, UsdGeom

from warpfem.child import existing, read_in_child
from warpfem.errors import MeshError, OutputError
from warpfem.usd.colors import ColorScale
from warpfem.usd.meshes import triangles_of
from warpfem.usd.prims import CELL_PRIMVARS, OBSTACLES, POINT_PRIMVARS, TETS, WORLD, surface_name
from warpfem.usd.stages import is_trusted, open_stage, read_attributes, reporting, trust, world_matrix

LARGEST = 1e30
"""Coordinates above this are no lengths [m]: what is computed of them would overflow."""


@dataclass(frozen=True, eq=False)
class AnimatedBody:
    """What never changes about a body.

    Attributes:
        name: its name, as it was given to the writer.
        rest_points: (n, 3) float64 rest positions [m]; z = 0 in 2D.
        cells: (m, 3) triangles in 2D or (m, 4) tetrahedra in 3D, int32.
        surface_faces: (k, 3) int32 triangles to draw, outward in 3D; they index ``rest_points``.
    """

    name: str
    rest_points: np.ndarray
    cells: np.ndarray
    surface_faces: np.ndarray


@dataclass(frozen=True, eq=False)
class AnimatedFrame:
    """One body in one frame.

    Attributes:
        points: (n, 3) float64 positions [m], as exact as float32 is.
        velocities: (n, 3) float32 [m/s].
        von_mises: (m,) float32 von Mises stress per cell [Pa].
        jacobian: (m,) float32 J per cell.
    """

    points: np.ndarray
    velocities: np.ndarray
    von_mises: np.ndarray
    jacobian: np.ndarray


class Animation:
    """An animation in a file; frames are read when they are asked for.

    Attributes:
        fps: frames per second.
        frame_count: the number of frames.
        up_axis: ``"Y"`` or ``"Z"``.
        scale: the quantity that colours show, with its range.
        bodies: what never changes, per body.
        obstacles: world points (n, 3) float64 [m] and triangles (k, 3) int32 of each obstacle.
    """

    def __init__(self, path: str | Path) -> None:
        """Opens the file, without regard to whether it could end the process: see :func:`read_animation`.

        Raises:
            OutputError: a file that is missing, unreadable, or not of this kind.
        """
        self._path = path
        self._stage = stage = open_stage(path, OutputError)
        with reporting(f"{path} cannot be read as USD", OutputError):
            self.fps: float = stage.GetFramesPerSecond()
            self.up_axis: str = UsdGeom.GetStageUpAxis(stage)
            world = stage.GetPrimAtPath(WORLD)
            stated = world.GetCustomData().get("warpfem") if world else None
            children = world.GetChildren() if world else []
            surfaces = [surface for child in children if (surface := child.GetChild(surface_name(child.GetName())))]
            if not stated or not surfaces:
                raise OutputError(f"{path} is not an animation that warpfem wrote")
            self._require(0.0 < self.fps < np.inf, "a number of frames per second that is finite and > 0")
            self.scale = ColorScale(stated["colorBy"], *stated["colorRange"])
            self._require(
                self.scale.quantity in POINT_PRIMVARS and -LARGEST < self.scale.lower < self.scale.upper < LARGEST,
                "a range of colours",
            )
            self._surfaces = surfaces
            self._prims = [surface.GetParent().GetChild(TETS) or surface for surface in surfaces]
            self._matrices = [world_matrix(prim) for prim in self._prims]
            times = [UsdGeom.PointBased(prim).GetPointsAttr().GetTimeSamples() for prim in self._prims]
            self.frame_count: int = len(times[0])
            self._require(all(t == list(range(self.frame_count)) for t in times), "the same frames for each body")
            self.bodies = tuple(self._body(index) for index in range(len(self._prims)))
            obstacles = stage.GetPrimAtPath(WORLD.AppendChild(OBSTACLES))
            self.obstacles = tuple(self._obstacle(prim) for prim in (obstacles.GetChildren() if obstacles else []))

    def frame(self, index: int) -> list[AnimatedFrame]:
        """Reads a frame: one entry per body.

        Raises:
            IndexError: there is no such frame.
            OutputError: the file cannot be read any more.
        """
        if not 0 <= index < self.frame_count:
            raise IndexError(f"frame {index} of an animation of {self.frame_count} frames")
        with reporting(f"frame {index} cannot be read", OutputError):
            return [self._frame(body, index) for body in range(len(self._prims))]

    def read_surfaces(self, index: int) -> None:
        """Reads what viewers show in a frame, to see whether the USD library bears it."""
        for surface in self._surfaces:
            read_attributes(surface, index)

    def layers(self) -> list[str]:
        """The files that have been read from."""
        return [layer.realPath for layer in self._stage.GetUsedLayers() if layer.realPath]

    def _require(self, holds: bool, what: str) -> None:
        if not holds:
            raise OutputError(f"{self._path}: the file is damaged: it lacks {what}")

    def _body(self, body: int) -> AnimatedBody:
        prim = self._prims[body]
        rest = self._points(body, Usd.TimeCode.Default())
        if prim.IsA(UsdGeom.TetMesh):
            tets = UsdGeom.TetMesh(prim)
            cells = self._indices(prim, tets.GetTetVertexIndicesAttr(), 4, len(rest))
            faces = self._indices(prim, tets.GetSurfaceFaceVertexIndicesAttr(), 3, len(rest))
        else:
            cells = faces = self._indices(prim, UsdGeom.Mesh(prim).GetFaceVertexIndicesAttr(), 3, len(rest))
        return AnimatedBody(prim.GetParent().GetDisplayName(), rest, cells, faces)

    def _obstacle(self, prim: Usd.Prim) -> tuple[np.ndarray, np.ndarray]:
        try:
            points, faces = triangles_of(UsdGeom.Mesh(prim))
        except MeshError as error:
            raise OutputError(str(error)) from error
        self._require(bool(np.abs(points).max() < LARGEST), f"finite points in {prim.GetPath()}")
        return points, faces

    def _frame(self, body: int, index: int) -> AnimatedFrame:
        prim, points = self._prims[body], self._points(body, index)
        cell_count = len(self.bodies[body].cells)

        def primvar(name: str, count: int) -> np.ndarray:
            return self._numbers(prim, prim.GetAttribute(f"primvars:{name}"), index, (count,))

        return AnimatedFrame(
            points=points,
            velocities=self._numbers(prim, UsdGeom.PointBased(prim).GetVelocitiesAttr(), index, points.shape),
            von_mises=primvar(CELL_PRIMVARS["von_mises"], cell_count),
            jacobian=primvar(CELL_PRIMVARS["jacobian"], cell_count),
        )

    def _points(self, body: int, time: float | Usd.TimeCode) -> np.ndarray:
        prim = self._prims[body]
        shape = (len(self.bodies[body].rest_points) if hasattr(self, "bodies") else None, 3)
        points = self._numbers(prim, UsdGeom.PointBased(prim).GetPointsAttr(), time, shape).astype(np.float64)
        points = points @ self._matrices[body][:3, :3] + self._matrices[body][3, :3]
        self._require(bool(np.abs(points).max() < LARGEST), f"finite points in {prim.GetPath()}")
        return points

    def _numbers(
        self, prim: Usd.Prim, attribute: Usd.Attribute, time: float | Usd.TimeCode, shape: tuple[int | None, ...]
    ) -> np.ndarray:
        """A value of an attribute: finite numbers in this shape, of which the first length may be free."""
        value = np.array(attribute.Get(time) if attribute else None)
        expected = (value.shape[0], *shape[1:]) if shape[0] is None and value.ndim else shape
        good = value.dtype.kind in "fiu" and value.shape == expected and value.size > 0 and np.isfinite(value).all()
        self._require(bool(good), f"{attribute.GetName()} of {prim.GetPath()} at {time}")
        return value

    def _indices(self, prim: Usd.Prim, attribute: Usd.Attribute, corners: int, point_count: int) -> np.ndarray:
        """(k, corners) point indices."""
        value = np.array(attribute.Get() or [])
        good = value.dtype.kind == "i" and value.size % corners == 0 and 0 <= value.min() <= value.max() < point_count
        self._require(bool(good), f"indices in {attribute.GetName()} of {prim.GetPath()}")
        return value.reshape(-1, corners)


def read_animation(path: str | Path) -> Animation:
    """Opens an animation that :class:`UsdWriter` wrote, finished or partial, also while it is being written.

    A file that this process has neither written nor read is read through in a child process first, because the
    USD library may end the process on a damaged file.

    Raises:
        OutputError: a file that is missing, unreadable, damaged or not of this kind.
    """
    path = existing(path, OutputError)
    if not is_trusted(path):
        trust(path, read_in_child(read_through, path, OutputError))
    return Animation(path)


def read_through(path: str) -> list[str]:
    """Reads all frames; returns the files that they are in. Called in a child process."""
    animation = Animation(path)
    for index in range(animation.frame_count):
        animation.frame(index)
        animation.read_surfaces(index)
    return animation.layers()
