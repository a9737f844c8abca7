"""A layer over a stage: the motion of what was simulated and nothing else, so that all the rest stays as it is."""

from __future__ import annotations

import os
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from pxr import Sdf, Vt

from warpfem.child import read_in_child
from warpfem.embedding import Embedding
from warpfem.errors import OutputError
from warpfem.mesh import Mesh
from warpfem.usd.bodies import BodyFrame, as_float32
from warpfem.usd.chunks import ChunkedLayer, Samples
from warpfem.usd.clock import Clock
from warpfem.usd.frames import FrameWriter, check_path
from warpfem.usd.physics.data import Follower, Place, StageBody
from warpfem.usd.physics.reader import read_stage_scene
from warpfem.usd.prims import extent_of
from warpfem.usd.stages import reporting

_FRAMES_PER_CHUNK = 8


class OverWriter(FrameWriter):
    """Stores the motion of the deformables of a stage in a layer over it.

    The layer has the stage as its sublayer, and opinions about the prims that move alone: ``points``, ``velocities``
    and ``extent`` of the simulated meshes and of the meshes that they carry along, and ``normals`` of the latter where
    the stage has some; in the prims' own space and the stage's units. Frame 0 is at the stage's first time code.
    Instances that a moving prim is in are made editable. Frames are saved as those of :class:`UsdWriter` are.
    """

    _bodies: Sequence[OverBody]

    def __init__(
        self,
        path: str | Path,
        stage: str | Path,
        names: Sequence[str],
        *,
        fps: float,
        comment: str = "",
        expected_frames: int = 0,
    ) -> None:
        """Checks everything that can be checked and writes a partial file that has no frames yet.

        Args:
            path: the layer to write, ``.usdc``, ``.usd`` or ``.usda``.
            stage: the stage that it goes over.
            names: the bodies that come in each frame, by the names that the stage's bodies have.
            fps: frames per second, > 0.
            comment: stored in the layer as its comment.
            expected_frames: the number of frames to come in all, for which there must be room on the disk.

        Raises:
            SceneError: the stage cannot be read.
            OutputError: a path that cannot be written or is that of the stage, a body that the stage does not have,
                or too little room. Nothing is changed then.
        """
        self.path = Path(path)
        check_path(self.path)
        require_other_file(self.path, stage)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # they came when the scene was read
            own = {body.name: body for body in read_stage_scene(stage).bodies}
        for name in names:
            if name not in own:
                raise OutputError(f"{stage} has no body '{name}' to go over; it has: {', '.join(own)}")
        with reporting(f"{self.path} cannot be written", OutputError):
            self._bodies = [OverBody(own[name]) for name in names]
            base = Sdf.Layer.FindOrOpen(os.path.abspath(stage))
            static = Sdf.Layer.CreateAnonymous(".usdc")
            _take_info(static, base)
            static.comment = comment
            rest: Samples = {}
            for body in self._bodies:
                body.define(static)
                rest |= body.at_rest()
            self._check_room(rest, expected_frames)
            clock = _clock(base, fps)
            relative = Path(os.path.relpath(os.path.abspath(stage), os.path.abspath(self.path.parent))).as_posix()
            asset = relative if relative.startswith("../") else f"./{relative}"
            self._layer = ChunkedLayer(self.path, static, rest, clock, _FRAMES_PER_CHUNK, {}, base=asset)

    def _samples(self, frames: Sequence[BodyFrame], where: str) -> Samples:
        samples: Samples = {}
        for body, frame in zip(self._bodies, frames, strict=True):
            samples |= body.samples(frame, where)
        return samples


def require_other_file(path: Path, stage: str | Path) -> None:
    """Raises OutputError if an output would replace the stage that it comes from."""
    if path.exists() and os.path.exists(stage) and os.path.samefile(path, stage):
        raise OutputError(f"{path} is the stage that is to be simulated: take another output")


def frames_over(path: str | Path) -> int:
    """The number of frames in a layer over a stage, partial or finished.

    Raises:
        OutputError: it is missing, damaged or none that :class:`OverWriter` wrote.
    """
    return read_in_child(stated_frames, path, OutputError)


def stated_frames(path: str) -> int:
    """What :func:`frames_over` returns; called in a child process."""
    with reporting(f"{path} cannot be read as USD", OutputError):
        stated = Sdf.Layer.FindOrOpen(path).customLayerData.get("warpfem", {})
    if "frames" not in stated:
        raise OutputError(f"{path} is no layer over a stage that warpfem wrote")
    return int(stated["frames"])


class OverBody:
    """The prims of one body that move: its mesh, and those that it carries along."""

    def __init__(self, body: StageBody) -> None:
        """Finds the places of what it carries.

        Raises:
            MeshError: the bind pose has cells without volume.
        """
        self._body = body
        self._mesh = _MovingPoints(body.place)
        bound = Mesh.repaired(body.bind_points, body.cells) if body.followers else None
        self._followers = [(_Carried(follower, bound)) for follower in body.followers if bound is not None]

    def define(self, layer: Sdf.Layer) -> None:
        """Makes the prims and the attributes, without values."""
        for carried in self._followers:
            carried.define(layer)
        for moving in (self._mesh, *(carried.moving for carried in self._followers)):
            for path in moving.place.instances:
                Sdf.CreatePrimInLayer(layer, path).instanceable = False
            for name, kind in moving.attributes.items():
                Sdf.JustCreatePrimAttributeInLayer(layer, moving.path(name), kind)

    def at_rest(self) -> Samples:
        """Samples of the start."""
        body = self._body
        zeros = np.zeros(0)
        return self.samples(BodyFrame(body.start_points, body.velocities, zeros, zeros), "the start")

    def check(self, frame: BodyFrame, where: str) -> None:
        """Checks the shapes of a frame. It may have more points than the stage: midpoints come after the corners.

        Raises:
            OutputError: names ``where`` and the body.
        """
        count = len(self._body.rest_points)
        for field in ("points", "velocities"):
            shape = np.shape(getattr(frame, field))
            if len(shape) != 2 or shape[0] < count or shape[1] != 3:
                raise OutputError(
                    f"{where}, body {self._body.name!r}: {field} must be those of the {count} points of "
                    f"{self._body.place.path}, not of shape {shape}"
                )

    def samples(self, frame: BodyFrame, where: str) -> Samples:
        """The values of all that moves.

        Raises:
            OutputError: a value that is not finite in float32.
        """
        label = f"{where}, body {self._body.name!r}"
        count = len(self._body.rest_points)
        x, v = np.asarray(frame.points[:count], float), np.asarray(frame.velocities[:count], float)
        points = self._body.place.points.copy()  # some belong to no cell
        points[self._body.used] = self._mesh.to_local(x)
        velocities = np.zeros_like(points)
        velocities[self._body.used] = self._mesh.vectors_to_local(v)
        result = self._mesh.samples(label, points, velocities)
        for carried in self._followers:
            result |= carried.samples(label, x, v)
        return result


class _MovingPoints:
    """The points of a prim, from the world to its own space."""

    def __init__(self, place: Place, normals: str = "") -> None:
        self.place = place
        self.attributes = {
            "points": Sdf.ValueTypeNames.Point3fArray,
            "velocities": Sdf.ValueTypeNames.Vector3fArray,
            "extent": Sdf.ValueTypeNames.Float3Array,
        }
        if normals:
            self.attributes[normals] = Sdf.ValueTypeNames.Normal3fArray
        self._inverse = np.linalg.inv(place.to_world[:3, :3])

    def path(self, name: str) -> Sdf.Path:
        return Sdf.Path(self.place.path).AppendProperty(name)

    def to_local(self, points: np.ndarray) -> np.ndarray:
        """(n, 3) in the stage's units, of positions [m]."""
        return (points - self.place.to_world[3, :3]) @ self._inverse

    def vectors_to_local(self, vectors: np.ndarray) -> np.ndarray:
        return vectors @ self._inverse

    def samples(self, label: str, points: np.ndarray, velocities: np.ndarray) -> dict[Sdf.Path, Any]:
        single = as_float32(f"{label}, points of {self.place.path}", points)
        speeds = as_float32(f"{label}, velocities of {self.place.path}", velocities)
        return {
            self.path("points"): Vt.Vec3fArray.FromNumpy(single),
            self.path("velocities"): Vt.Vec3fArray.FromNumpy(speeds),
            self.path("extent"): extent_of(single),
        }


class _Carried:
    """A mesh that a body carries along."""

    def __init__(self, follower: Follower, bound: Mesh) -> None:
        self._name = "" if follower.normals is None else follower.normals_name
        self._indexed = follower.indexed
        self.moving = _MovingPoints(follower.place, self._name)
        self._embedding = Embedding(bound, follower.bind_points)
        self._at = follower.normal_points
        self._normals = None
        if follower.normals is not None:  # from the prim's space to the world
            self._normals = follower.normals @ np.linalg.inv(follower.place.to_world[:3, :3]).T

    def define(self, layer: Sdf.Layer) -> None:
        """Takes away the indices to normals, which have one for each corner now."""
        if self._indexed:
            path = self.moving.path(f"{self._name}:indices")
            Sdf.JustCreatePrimAttributeInLayer(layer, path, Sdf.ValueTypeNames.IntArray)
            layer.GetAttributeAtPath(path).default = Sdf.ValueBlock()

    def samples(self, label: str, x: np.ndarray, v: np.ndarray) -> Samples:
        """The values when the body's points are at ``x`` [m] with velocities ``v`` [m/s]."""
        points = self.moving.to_local(self._embedding.points(x))
        result = self.moving.samples(label, points, self.moving.vectors_to_local(self._embedding.points(v)))
        if self._normals is not None and self._at is not None:
            turned = self._embedding.normals(x, self._at, self._normals) @ self.moving.place.to_world[:3, :3].T
            lengths = np.maximum(np.linalg.norm(turned, axis=1, keepdims=True), np.finfo(float).tiny)
            normals = as_float32(f"{label}, normals of {self.moving.place.path}", turned / lengths)
            result[self.moving.path(self._name)] = Vt.Vec3fArray.FromNumpy(normals)
        return result


def _take_info(layer: Sdf.Layer, base: Sdf.Layer) -> None:
    """Repeats what a stage says of itself, such as its units: USD takes it from the first layer alone."""
    for key in base.pseudoRoot.ListInfoKeys():
        if key not in ("subLayers", "subLayerOffsets", "comment", "documentation"):
            layer.pseudoRoot.SetInfo(key, base.pseudoRoot.GetInfo(key))


def _clock(base: Sdf.Layer, fps: float) -> Clock:
    """Frame 0 is at the stage's first time code; its range stays, unless frames come after it."""
    codes = base.timeCodesPerSecond if base.HasTimeCodesPerSecond() or not base.HasFramesPerSecond() else None
    return Clock(
        fps,
        base.framesPerSecond if codes is None else codes,
        first=base.startTimeCode if base.HasStartTimeCode() else 0.0,
        least_end=base.endTimeCode if base.HasEndTimeCode() else 0.0,
    )
