"""Stores frames in a thread, while the run computes the next ones."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from types import TracebackType

from warpfem.usd.bodies import BodyFrame
from warpfem.usd.frames import FrameWriter


class BackgroundWriter:
    """A :class:`FrameWriter` that works in a thread: one frame at a time, in order.

    What goes wrong with a frame is raised by the next call, or at the end of the ``with`` block. After it all frames
    before that one are in the file, as with the writer itself.
    """

    def __init__(self, writer: FrameWriter) -> None:
        self._writer = writer
        self._thread: threading.Thread | None = None
        self._error: Exception | None = None

    def write_frame(self, frames: Sequence[BodyFrame]) -> None:
        """Waits for the frame before, then adds this one in the background.

        Args:
            frames: one per body; the arrays must stay as they are.

        Raises:
            OutputError: the frame before could not be stored: see :meth:`FrameWriter.write_frame`.
        """
        self._wait()
        self._thread = threading.Thread(target=self._write, args=(frames,), name="UsdWriter")
        self._thread.start()

    def flush(self) -> None:
        """Saves all frames so far.

        Raises:
            OutputError: one of them could not be stored, or the disk takes no more.
        """
        self._wait()
        self._writer.flush()

    def __enter__(self) -> BackgroundWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        try:
            self._wait()
        except Exception as late:  # as whatever stores the frame has raised it
            if error is None or kind is GeneratorExit:  # which nobody gets to see
                self._writer.__exit__(type(late), late, late.__traceback__)
                raise
            error.add_note(str(late) or type(late).__name__)
        self._writer.__exit__(kind, error, traceback)

    def _write(self, frames: Sequence[BodyFrame]) -> None:
        try:
            self._writer.write_frame(frames)
        except Exception as error:
            self._error = error

    def _wait(self) -> None:
        if self._thread is not None:
            self._thread.join()
            self._thread = None
        error, self._error = self._error, None
        if error is not None:
            raise error
