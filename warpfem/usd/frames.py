"""What all writers of frames share: a partial file that opens while the run goes, merged at the end."""

from __future__ import annotations

import contextlib
import shutil
from abc import ABC, abstractmethod
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Protocol, Self

import numpy as np

from warpfem.errors import OutputError
from warpfem.files import beside, existing_folder, require_writable
from warpfem.usd.bodies import BodyFrame
from warpfem.usd.chunks import ChunkedLayer, Samples
from warpfem.usd.stages import reporting, trust

SUFFIXES = (".usdc", ".usd", ".usda")

_TEXT_RATIO = 3.5
"""Bytes of a number as text over those of a float32."""


class FrameSource(Protocol):
    """A body whose frames are written."""

    def check(self, frame: BodyFrame, where: str) -> None:
        """Raises OutputError if the shapes of a frame are not those of the body."""


class FrameWriter(ABC):
    """Stores frames one by one in a USD file that opens at any moment.

    Attributes:
        path: the file.
    """

    path: Path
    _bodies: Sequence[FrameSource]
    _layer: ChunkedLayer
    _closed = False

    @abstractmethod
    def _samples(self, frames: Sequence[BodyFrame], where: str) -> Samples:
        """The values of all that is animated.

        Raises:
            OutputError: one of them is not finite.
        """

    def _metadata(self) -> dict[str, Any]:
        """Custom data of ``/World`` that stands for all frames so far."""
        return {}

    def _amended(self, samples: Samples) -> Samples:
        """What is to replace some of a frame's samples when all frames are known."""
        return {}

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
                self._layer.merge(self._metadata(), self._amended)
            trust(self.path)
            self._closed = True
        return self.path

    def __enter__(self) -> Self:
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
