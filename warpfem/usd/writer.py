"""The writer: frames in, one USD file out, and a partial one that opens while the run goes."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Literal

import numpy as np
from pxr import Gf, Sdf, Usd

from warpfem.boundary import Obstacle
from warpfem.errors import OutputError
from warpfem.usd.bodies import BodyFrame, UsdBody, in_space
from warpfem.usd.chunks import ChunkedLayer, Samples
from warpfem.usd.colors import ColorQuantity, ColorScale, spread_of
from warpfem.usd.obstacles import define_obstacles
from warpfem.usd.prims import POINT_PRIMVARS, BodyPrims, define_world, prim_names
from warpfem.usd.stages import reporting, trust

SUFFIXES = (".usdc", ".usd", ".usda")


class UsdWriter:
    """Stores an animation of elastic bodies as one USD file.

    While the run goes, the frames are in ``<stem>.partial.usda`` (with the folder ``<stem>.partial`` beside
    it), which opens at any moment, also after the process was killed. A frame that comes half a second or
    more after the last save is saved at once; faster ones wait until they are ``frames_per_chunk``.
    :meth:`close` merges everything into ``path`` and removes the partial file; until then an older ``path``
    stays as it is. **The next writer of the same ``path`` removes a partial file that a killed run left**:
    to keep it, choose another ``path`` or move file and folder elsewhere.

    The file holds ``/World`` with an Xform per body. In it, ``NAME_surface`` is what viewers show; in 3D its
    sibling ``simulation`` is the tetrahedral mesh with all points. The rest shape is the default value,
    frame i the sample at time code i. Both have the primvars ``vonMises`` [Pa] and ``J`` per cell,
    ``vonMisesPoint`` and ``JPoint`` per point (averages weighted by rest volume). ``displayColor`` shows
    one of the latter; the custom data of ``/World`` says which, and the range of its colours. Points are
    float32; those of a body that is far from the origin for its size are relative to a double-precision
    translation of its Xform.

    Used as a context manager it closes also when the block raises, so that all finished frames are kept.
    """

    def __init__(
        self,
        path: str | Path,
        bodies: Sequence[UsdBody],
        *,
        fps: float,
        up_axis: Literal["Y", "Z"] = "Y",
        obstacles: Sequence[Obstacle] = (),
        color_by: ColorQuantity = "von_mises",
        color_range: tuple[float, float] | None = None,
        frames_per_chunk: int = 8,
        comment: str = "",
    ) -> None:
        """Checks everything that can be checked and writes a partial file that has no frames yet.

        Args:
            path: the file to write, ``.usdc``, ``.usd`` (both binary) or ``.usda`` (text: large and slow).
            bodies: the bodies, at least one.
            fps: frames per second, > 0: frame i is at i / fps seconds.
            up_axis: the axis that viewers show as up.
            obstacles: drawn as fixed prims.
            color_by: the quantity that ``displayColor`` shows.
            color_range: values of the first and last colour; ``None``: 0..s for von Mises, 1 - s..1 + s for
                J, with s such that at most 0.5 % of a body's surface points are beyond in any frame.
            frames_per_chunk: the most frames that wait in memory to be saved.
            comment: stored in the file as its comment.

        Raises:
            OutputError: a path that cannot be written, no bodies, or settings outside their domain.
        """
        self.path = Path(path)
        _check_settings(self.path, bodies, fps, up_axis, color_by, color_range, frames_per_chunk)
        self._quantity: ColorQuantity = color_by
        self._fixed_range = color_range
        self._spread = 0.0
        self._closed = False
        with reporting(f"{self.path} cannot be written", OutputError):
            static = Sdf.Layer.CreateAnonymous(".usdc")
            stage = Usd.Stage.Open(static)
            define_world(stage, fps, up_axis, comment)
            names = prim_names(body.name for body in bodies)
            self._bodies = [BodyPrims(stage, name, body) for name, body in zip(names, bodies, strict=True)]
            points = np.concatenate([in_space(body.rest_points) for body in bodies])
            define_obstacles(stage, obstacles, points.min(axis=0), points.max(axis=0))
            rest = self._samples([body.rest for body in self._bodies], "the rest shape")
            for attribute, value in rest.items():
                stage.GetAttributeAtPath(attribute).Set(value)
            self._layer = ChunkedLayer(self.path, static, rest, frames_per_chunk, self._metadata())

    def write_frame(self, frames: Sequence[BodyFrame]) -> None:
        """Adds the next frame.

        Args:
            frames: one per body, in the order of the bodies; the arrays are copied.

        Raises:
            OutputError: another number of bodies, wrong shapes, values that are not finite (the frame is left
                out, those before it stay), a closed writer, or a disk that takes no more.
        """
        if self._closed:
            raise OutputError(f"{self.path} is closed: frames cannot be added")
        where = f"frame {self._layer.frame_count}"
        if len(frames) != len(self._bodies):
            raise OutputError(f"{where}: {len(frames)} bodies given, the file has {len(self._bodies)}")
        for body, frame in zip(self._bodies, frames, strict=True):
            body.check(frame, where)
        with reporting(f"{self.path} cannot be written", OutputError):
            self._layer.append(self._samples(frames, where), self._metadata())

    def close(self) -> Path:
        """Merges the frames into the output file and removes the partial one; a second call does nothing.

        Returns:
            The path of the output file.

        Raises:
            OutputError: the file cannot be written; the partial one stays.
        """
        if not self._closed:
            saved = f"the frames are in {self._layer.path}"
            with reporting(f"{self.path} cannot be written ({saved})", OutputError):
                self._layer.merge(self._metadata(), self._colors)
            trust(self.path)
            self._closed = True
        return self.path

    def __enter__(self) -> UsdWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        try:
            self.close()
        except OutputError as output_error:
            if error is None:
                raise
            error.add_note(str(output_error))

    @property
    def _scale(self) -> ColorScale:
        if self._fixed_range is not None:
            return ColorScale(self._quantity, *self._fixed_range)
        return ColorScale.from_spread(self._quantity, self._spread)

    def _metadata(self) -> dict[str, Any]:
        scale = self._scale
        primvar, limits = POINT_PRIMVARS[scale.quantity], Gf.Vec2d(scale.lower, scale.upper)
        return {"warpfem": {"colorBy": scale.quantity, "colorPrimvar": primvar, "colorRange": limits}}

    def _samples(self, frames: Sequence[BodyFrame], where: str) -> Samples:
        samples: Samples = {}
        for body, frame in zip(self._bodies, frames, strict=True):
            samples |= body.samples(frame, where)
        spreads = [spread_of(self._quantity, body.surface_values(samples, self._quantity)) for body in self._bodies]
        self._spread = max(self._spread, *spreads)
        return samples | self._colors(samples)

    def _colors(self, samples: Samples) -> Samples:
        colors: Samples = {}
        for body in self._bodies:
            colors |= body.colors(samples, self._scale)
        return colors


def check_path(path: str | Path) -> None:
    """Checks what can be told of an output without writing anything.

    Raises:
        OutputError: a name without one of ``SUFFIXES``, a folder, or a place that cannot be written to.
    """
    path = Path(path)
    if path.suffix not in SUFFIXES:
        raise OutputError(f"{path}: the name of the output must end in {', '.join(SUFFIXES)}")
    if path.is_dir():
        raise OutputError(f"{path} is a folder: give the name of a file")
    folder = path.absolute().parent
    while not folder.exists():  # it will be made
        folder = folder.parent
    if not folder.is_dir() or not os.access(folder, os.W_OK):
        raise OutputError(f"{path} cannot be written: {folder} is not a folder that can be written to")


def _check_settings(
    path: Path,
    bodies: Sequence[UsdBody],
    fps: float,
    up_axis: str,
    color_by: str,
    color_range: tuple[float, float] | None,
    frames_per_chunk: int,
) -> None:
    check_path(path)
    if not bodies:
        raise OutputError(f"{path}: there are no bodies to write")
    if not (math.isfinite(fps) and fps > 0.0):
        raise OutputError(f"{path}: fps must be a finite number above 0, not {fps!r}")
    if up_axis not in ("Y", "Z"):
        raise OutputError(f"{path}: up_axis must be 'Y' or 'Z', not {up_axis!r}")
    if color_by not in POINT_PRIMVARS:
        raise OutputError(f"{path}: color_by must be one of {', '.join(POINT_PRIMVARS)}, not {color_by!r}")
    if color_range is not None and not (np.isfinite(color_range).all() and color_range[0] < color_range[1]):
        raise OutputError(f"{path}: color_range must be two finite numbers, the smaller one first, not {color_range}")
    if frames_per_chunk < 1:
        raise OutputError(f"{path}: frames_per_chunk must be at least 1, not {frames_per_chunk}")
