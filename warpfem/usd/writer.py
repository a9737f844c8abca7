"""The writer: frames in, one USD file out, and a partial one that opens while the run goes."""

from __future__ import annotations

import contextlib
import math
import shutil
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Literal

import numpy as np
from pxr import Gf, Sdf, Usd

from warpfem.boundary import Obstacle
from warpfem.errors import OutputError
from warpfem.files import beside, existing_folder, require_writable
from warpfem.usd.bodies import BodyFrame, UsdBody, in_space
from warpfem.usd.chunks import ChunkedLayer, Samples
from warpfem.usd.colors import ColorQuantity, ColorScale, spread_of
from warpfem.usd.obstacles import define_obstacles
from warpfem.usd.prims import POINT_PRIMVARS, BodyPrims, define_world, prim_names
from warpfem.usd.saved import Chunk, partial_path, saved_chunks
from warpfem.usd.stages import reporting, trust

SUFFIXES = (".usdc", ".usd", ".usda")

_TEXT_RATIO = 3.5
"""Bytes of a number as text over those of a float32."""


class UsdWriter:
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
            kept = [] if keep is None else self._find_kept(*keep)
            self._check_room(rest, expected_frames)
            self._layer = ChunkedLayer(self.path, static, rest, frames_per_chunk, self._metadata(), kept)

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
        with self._saving():
            self._layer.append(self._samples(frames, where), self._metadata())

    def flush(self) -> None:
        """Saves the frames that still wait in memory.

        Raises:
            OutputError: the disk takes no more.
        """
        with self._saving():
            self._layer.flush(self._metadata())

    def close(self) -> Path:
        """Merges the frames into the output file and removes the partial one; a second call does nothing.

        Returns:
            The path of the output file.

        Raises:
            OutputError: the file cannot be written; the partial one stays.
        """
        if not self._closed:
            with self._saving():
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
            if error is not None and self._layer.frame_count == 0:  # an older file is worth more than an empty one
                self._layer.discard()
                self._closed = True
            self.close()
        except OutputError as output_error:
            if error is None or kind is GeneratorExit:  # which nobody gets to see
                raise
            if str(error) != str(output_error):
                error.add_note(str(output_error))

    def _saving(self) -> contextlib.AbstractContextManager[None]:
        saved = f"what was saved of its frames is in {self._layer.path}"
        return reporting(f"{self.path} cannot be written ({saved})", OutputError)

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

    def _check_room(self, rest: Samples, frame_count: int) -> None:
        """The partial file and the merged one are on the disk together at the end."""
        folder = existing_folder(self.path)
        frame_bytes = sum(np.asarray(value).nbytes for value in rest.values())
        old = [path for path in beside(self.path, "partial").glob("*") if path.is_file()]
        free = shutil.disk_usage(folder).free + sum(path.stat().st_size for path in old)
        copies = 2.0 + (_TEXT_RATIO if self.path.suffix == ".usda" else 0.0)
        needed = copies * frame_count * frame_bytes
        if needed > free:
            raise OutputError(
                f"{self.path} has no room: its {frame_count} frames need {_size(needed)} while they are merged at the "
                f"end, and {folder} has {_size(free)} free: take another folder, fewer frames or a coarser mesh"
            )

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

    def _colors(self, samples: Samples) -> Samples:
        colors: Samples = {}
        for body in self._bodies:
            colors |= body.colors(samples, self._scale)
        return colors


def check_path(path: str | Path) -> None:
    """Checks what can be told of an output without writing anything.

    Raises:
        OutputError: a name without one of ``SUFFIXES``, or one that USD cannot bear; a folder, a file that is
            write-protected, or a place that cannot be written to.
    """
    path = Path(path)
    if path.suffix not in SUFFIXES:
        raise OutputError(f"{str(path)!r}: the name of the output must end in {', '.join(SUFFIXES)}")
    odd = _odd_part(path)
    if odd:
        raise OutputError(f"{str(path)!r} cannot be written: USD does not bear {odd} in the name of a file")
    with (
        reporting(f"{path} cannot be written", OutputError),
        contextlib.suppress(FileNotFoundError, NotADirectoryError),
    ):
        beside(path, "writing.checkpoint.npz").stat()  # as long as the longest name beside it
    require_writable(path)


def _odd_part(path: Path) -> str:
    """What USD's references to files do not bear in a path, or ""."""
    whole = path.absolute().as_posix()
    try:
        whole.encode()
    except UnicodeEncodeError:
        return "bytes that are not UTF-8"
    odd = [text for text in ("\0", "\\", ":SDF_FORMAT_ARGS:") if text in whole]
    odd += [character for character in path.name if ord(character) < 32 or ord(character) == 127]
    return repr(odd[0]) if odd else ""


def _size(byte_count: float) -> str:
    """Bytes as a person reads them."""
    unit, name = (1e9, "GB") if byte_count >= 1e9 else (1e6, "MB")
    return f"{byte_count / unit:.3g} {name}"


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
