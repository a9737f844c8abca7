"""The time codes of frames."""

from __future__ import annotations

from dataclasses import dataclass

from pxr import Sdf


@dataclass(frozen=True)
class Clock:
    """Which time code each frame has, and what a layer says of its time.

    Attributes:
        fps: frames per second, > 0.
        codes_per_second: time codes per second, > 0; ``None``: as many as frames.
        first: the time code of frame 0.
        least_end: the layer's last time code is at least this.
    """

    fps: float
    codes_per_second: float | None = None
    first: float = 0.0
    least_end: float = 0.0

    def code(self, frame: int) -> float:
        """The time code of a frame."""
        step = 1.0 if self.codes_per_second is None else self.codes_per_second / self.fps
        return self.first + step * frame

    def author(self, layer: Sdf.Layer, frame_count: int) -> None:
        """Authors the rates and the range of the time codes of so many frames."""
        layer.framesPerSecond = self.fps
        layer.timeCodesPerSecond = self.fps if self.codes_per_second is None else self.codes_per_second
        layer.startTimeCode = self.first
        layer.endTimeCode = max(self.code(max(frame_count - 1, 0)), self.least_end)
