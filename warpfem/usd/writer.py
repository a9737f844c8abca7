"""The writer: frames in, one USD file out, and a partial one that opens while the run goes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pxr import Gf, Sdf, Usd

from warpfem.boundary import Obstacle
from warpfem.errors import OutputError
from warpfem.usd.bodies import BodyFrame, UsdBody, in_space
from warpfem.usd.chunks import ChunkedLayer, Samples
from warpfem.usd.clock import Clock
from warpfem.usd.colors import ColorQuantity, ColorScale, spread_of
from warpfem.usd.frames import FrameWriter, check_path
from warpfem.usd.obstacles import define_obstacles
from warpfem.usd.physics.author import ScenePhysics, author_physics
from warpfem.usd.prims import POINT_PRIMVARS, BodyPrims, define_world, prim_names
from warpfem.usd.saved import Chunk, partial_path, saved_chunks
from warpfem.usd.stages import reporting


class UsdWriter(FrameWriter):
    """Stores an animation of elastic bodies as one USD file.

    While the run goes, the frames are in ``<stem>.partial.usda`` (with the folder ``<stem>.partial`` beside
    it), which opens at any moment, also after the process was killed. A frame that comes half a second or
    more after the last save is saved at once; faster ones wait until they are ``frames_per_chunk``.
    :meth:`close` merges everything into ``path`` and removes the partial file; until then an older ``path``
    stays as it is. **The next writer of the same ``path`` removes a partial file that a killed run left**,
    unless it is told to keep its frames: else choose another ``path`` or move file and folder elsewhere.

    The file holds ``/World`` with an Xform per body. In it, ``NAME_surface`` is what viewers show; in 3D its
    sibling ``simulation`` is the tetrahedral mesh with all points. The rest shape is the default value,
    frame i the sample at time code i. Both have the primvars ``vonMises`` [Pa] and ``J`` per cell,
    ``vonMisesPoint`` and ``JPoint`` per point (averages weighted by rest volume). ``displayColor`` shows
    one of the latter; the custom data of ``/World`` says which, and the range of its colours. Points are
    float32; those of a body that is far from the origin for its size are relative to a double-precision
    translation of its Xform. ``/World/Physics`` says what was simulated, as far as UsdPhysics and the proposal for
    deformable bodies have words for it.

    Used as a context manager it closes also when the block raises, so that all finished frames are kept.
    """

    _bodies: Sequence[BodyPrims]

    def __init__(
        self,
        path: str | Path,
        bodies: Sequence[UsdBody],
        *,
        fps: float,
        up_axis: Literal["Y", "Z"] = "Y",
        obstacles: Sequence[Obstacle] = (),
        physics: ScenePhysics | None = None,
        color_by: ColorQuantity = "von_mises",
        color_range: tuple[float, float] | None = None,
        frames_per_chunk: int = 8,
        equilibria: bool = False,
        comment: str = "",
        keep: tuple[int, Sequence[BodyFrame]] | None = None,
        expected_frames: int = 0,
    ) -> None:
        """Checks everything that can be checked and writes a partial file that has no frames yet.

        Args:
            path: the file to write, ``.usdc``, ``.usd`` (both binary) or ``.usda`` (text: large and slow).
            bodies: the bodies, at least one.
            fps: frames per second, > 0: frame i is at i / fps seconds.
            up_axis: the axis that viewers show as up.
            obstacles: drawn as fixed prims.
            physics: what the file says of the scene, for other simulators and to be read as a stage; not in 2D.
            color_by: the quantity that ``displayColor`` shows.
            color_range: values of the first and last colour; ``None``: 0..s for von Mises, 1 - s..1 + s for
                J, with s such that at most 0.5 % of a body's surface points are beyond in any frame.
            frames_per_chunk: the most frames that wait in memory to be saved.
            equilibria: frames are equilibria on the way to the full load, and not moments in time.
            comment: stored in the file as its comment.
            keep: the last of the frames to keep that an earlier writer of the same ``path`` left, in its
                partial file or in ``path`` itself: its index, and what it holds, to know it by. Later frames
                are dropped. ``None`` keeps none.
            expected_frames: the number of frames to come in all, for which there must be room on the disk.

        Raises:
            OutputError: a path that cannot be written, too little room, no bodies, settings outside their
                domain, or no file that holds the frames to keep. Nothing is changed then.
        """
        self.path = Path(path)
        _check_settings(self.path, bodies, fps, up_axis, color_by, color_range, frames_per_chunk)
        self._quantity: ColorQuantity = color_by
        self._equilibria = equilibria
        self._fixed_range = color_range
        self._spread = 0.0
        with reporting(f"{self.path} cannot be written", OutputError):
            static = Sdf.Layer.CreateAnonymous(".usdc")
            stage = Usd.Stage.Open(static)
            define_world(stage, up_axis, comment)
            names = prim_names(body.name for body in bodies)
            self._bodies = [BodyPrims(stage, name, body) for name, body in zip(names, bodies, strict=True)]
            points = np.concatenate([in_space(body.rest_points) for body in bodies])
            define_obstacles(stage, obstacles, points.min(axis=0), points.max(axis=0))
            rest = self._samples([body.rest for body in self._bodies], "the rest shape")
            for attribute, value in rest.items():
                stage.GetAttributeAtPath(attribute).Set(value)
            meshes = [body.simulation for body in self._bodies if body.simulation is not None]
            if physics is not None and meshes:
                author_physics(stage, physics, meshes, obstacles)
            kept = [] if keep is None else self._find_kept(*keep)
            self._check_room(rest, expected_frames)
            self._layer = ChunkedLayer(self.path, static, rest, Clock(fps), frames_per_chunk, self._metadata(), kept)

    def _find_kept(self, last: int, frames: Sequence[BodyFrame]) -> list[Chunk]:
        """The chunks with the frames up to ``last``, which must be equal to ``frames``; minds their colours."""
        expected = self._samples(frames, f"frame {last}")
        for color in self._colors(expected):
            del expected[color]  # their range is that of the frames so far
        reasons = []
        for path in (partial_path(self.path), self.path):
            try:
                chunks = saved_chunks(path, last + 1, expected)
                layer = chunks[-1].open()
                for attribute, value in expected.items():
                    if not np.array_equal(value, layer.QueryTimeSample(attribute, last)):
                        raise OutputError(f"{path} is of another run: its {attribute} differs in frame {last}")
            except OutputError as error:
                reasons.append(str(error))
                continue
            for chunk in chunks:
                layer = chunk.open()
                for frame in chunk.frames:
                    attributes = [body.surface_attribute(self._quantity) for body in self._bodies]
                    self._see(*(layer.QueryTimeSample(attribute, frame) for attribute in attributes))
            return chunks
        raise OutputError(f"{self.path}: the frames up to {last} are missing: {'; '.join(reasons)}. Run it anew")

    @property
    def _scale(self) -> ColorScale:
        if self._fixed_range is not None:
            return ColorScale(self._quantity, *self._fixed_range)
        return ColorScale.from_spread(self._quantity, self._spread)

    def _metadata(self) -> dict[str, Any]:
        scale = self._scale
        primvar, limits = POINT_PRIMVARS[scale.quantity], Gf.Vec2d(scale.lower, scale.upper)
        stated = {"colorBy": scale.quantity, "colorPrimvar": primvar, "colorRange": limits}
        return {"warpfem": stated | ({"equilibria": True} if self._equilibria else {})}

    def _samples(self, frames: Sequence[BodyFrame], where: str) -> Samples:
        samples: Samples = {}
        for body, frame in zip(self._bodies, frames, strict=True):
            samples |= body.samples(frame, where)
        self._see(*(samples[body.surface_attribute(self._quantity)] for body in self._bodies))
        return samples | self._colors(samples)

    def _see(self, *surfaces: Any) -> None:
        """Widens the range of the colours to what the bodies' surfaces show."""
        self._spread = max(self._spread, *(spread_of(self._quantity, np.asarray(values)) for values in surfaces))

    def _amended(self, samples: Samples) -> Samples:
        return self._colors(samples)

    def _colors(self, samples: Samples) -> Samples:
        colors: Samples = {}
        for body in self._bodies:
            colors |= body.colors(samples, self._scale)
        return colors


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
