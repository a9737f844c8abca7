"""Reads animations back, frame by frame, for pictures and tests."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pxr import Usd, UsdGeom

from warpfem.errors import OutputError
from warpfem.usd.colors import ColorScale
from warpfem.usd.meshes import triangles_of
from warpfem.usd.prims import CELL_PRIMVARS, OBSTACLES, POINT_PRIMVARS, TETS, WORLD, surface_name
from warpfem.usd.stages import open_stage, reporting, world_matrix


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
        colors: (n, 3) sRGB colours of the points, in 0..1.
    """

    points: np.ndarray
    velocities: np.ndarray
    von_mises: np.ndarray
    jacobian: np.ndarray
    colors: np.ndarray


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
        """Opens the file.

        Raises:
            OutputError: a file that is missing, unreadable, or not of this kind.
        """
        self._stage = stage = open_stage(path, OutputError)
        self.fps: float = stage.GetFramesPerSecond()
        self.up_axis: str = UsdGeom.GetStageUpAxis(stage)
        world = stage.GetPrimAtPath(WORLD)
        stated = world.GetCustomData().get("warpfem") if world else None
        children = world.GetChildren() if world else []
        surfaces = [surface for child in children if (surface := child.GetChild(surface_name(child.GetName())))]
        if not stated or not surfaces:
            raise OutputError(f"{path} is not an animation that warpfem wrote")
        self.scale = ColorScale(stated["colorBy"], *stated["colorRange"])
        self._prims = [surface.GetParent().GetChild(TETS) or surface for surface in surfaces]
        self._matrices = [world_matrix(prim) for prim in self._prims]
        self.frame_count: int = UsdGeom.PointBased(surfaces[0]).GetPointsAttr().GetNumTimeSamples()
        self.bodies = tuple(self._body(index) for index in range(len(self._prims)))
        obstacles = stage.GetPrimAtPath(WORLD.AppendChild(OBSTACLES))
        drawn = obstacles.GetChildren() if obstacles else []
        self.obstacles = tuple(triangles_of(UsdGeom.Mesh(prim)) for prim in drawn)

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

    def _body(self, body: int) -> AnimatedBody:
        prim = self._prims[body]
        rest = self._points(body, Usd.TimeCode.Default())
        if prim.IsA(UsdGeom.TetMesh):
            tets = UsdGeom.TetMesh(prim)
            cells = np.array(tets.GetTetVertexIndicesAttr().Get())
            faces = np.array(tets.GetSurfaceFaceVertexIndicesAttr().Get())
        else:
            cells = faces = np.array(UsdGeom.Mesh(prim).GetFaceVertexIndicesAttr().Get()).reshape(-1, 3)
        return AnimatedBody(prim.GetParent().GetDisplayName(), rest, cells, faces)

    def _frame(self, body: int, index: int) -> AnimatedFrame:
        def primvar(name: str) -> np.ndarray:
            return np.array(self._prims[body].GetAttribute(f"primvars:{name}").Get(index))

        return AnimatedFrame(
            points=self._points(body, index),
            velocities=np.array(UsdGeom.PointBased(self._prims[body]).GetVelocitiesAttr().Get(index)),
            von_mises=primvar(CELL_PRIMVARS["von_mises"]),
            jacobian=primvar(CELL_PRIMVARS["jacobian"]),
            colors=self.scale.srgb(primvar(POINT_PRIMVARS[self.scale.quantity])),
        )

    def _points(self, body: int, time: float | Usd.TimeCode) -> np.ndarray:
        points = np.array(UsdGeom.PointBased(self._prims[body]).GetPointsAttr().Get(time), np.float64)
        return points @ self._matrices[body][:3, :3] + self._matrices[body][3, :3]


def read_animation(path: str | Path) -> Animation:
    """Opens an animation that :class:`UsdWriter` wrote, finished or partial, also while it is being written.

    Raises:
        OutputError: a file that is missing, unreadable, or not of this kind.
    """
    return Animation(path)
