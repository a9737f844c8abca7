"""What is around the pictures: times, the bar of the colours and that of the lengths, drawn by Matplotlib."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from warpfem.preview.camera import SAMPLES, View
from warpfem.preview.coloring import Coloring

if TYPE_CHECKING:
    from matplotlib.axes import Axes


class Page:
    """Panels with their times, and at the right the bars that tell what colours and lengths mean."""

    def __init__(self, coloring: Coloring, view: View, count: int) -> None:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.cm import ScalarMappable
        from matplotlib.colors import ListedColormap, Normalize
        from matplotlib.figure import Figure
        from matplotlib.ticker import EngFormatter

        width, height = view.width // SAMPLES, view.height // SAMPLES
        gap, title, margin = 8, 24, 136
        columns = min(range(1, count + 1), key=lambda columns: _awkwardness(count, columns, width / height))
        total_width = columns * (width + gap) + gap + margin
        total_height = math.ceil(count / columns) * (height + title) + gap
        self.figure = Figure(figsize=(total_width / 100, total_height / 100), dpi=100)
        self._canvas = FigureCanvasAgg(self.figure)
        self._stage = coloring.stage
        self._images, self._titles = [], []

        def place(left: float, top: float, width: float, height: float) -> Axes:
            bottom = 1.0 - (top + height) / total_height
            return self.figure.add_axes((left / total_width, bottom, width / total_width, height / total_height))

        for panel in range(count):
            row, column = divmod(panel, columns)
            axes = place(gap + column * (width + gap), title + row * (height + title), width, height)
            axes.set_axis_off()
            self._titles.append(axes.set_title("", fontsize=10, pad=4))
            self._images.append(axes.imshow(np.zeros((height, width, 3)), interpolation="nearest"))

        scale, left = coloring.scale, total_width - margin + 10
        colors = ListedColormap(scale.srgb(np.linspace(scale.lower, scale.upper, 256)))
        bar = self.figure.colorbar(
            ScalarMappable(Normalize(scale.lower, scale.upper), colors),
            cax=place(left, title, 14, min(total_height - title - 60, 300)),
            format=EngFormatter(coloring.unit) if coloring.unit else None,
        )
        bar.set_label(coloring.label)
        ruler = place(left, total_height - 2 * gap, view.tile * view.scale / SAMPLES, 2)
        ruler.set(facecolor="black", xticks=[], yticks=[])
        ruler.set_title(f"{view.tile:g} m", fontsize=10, pad=3)

    def show(self, images: Sequence[np.ndarray], frames: Sequence[int], remark: str = "") -> None:
        """Puts images (height, width, 3) uint8 into the panels, and the times of the frames with these numbers."""
        for panel, title, image, frame in zip(self._images, self._titles, images, frames, strict=True):
            panel.set_data(image)
            title.set_text(self._moment(frame) + remark)

    def _moment(self, frame: int) -> str:
        if self._stage.equilibria:
            return f"load step {frame} of {self._stage.frame_count - 1}" if frame else "start"
        fps = self._stage.fps
        return f"{frame / fps:.{max(1, math.ceil(math.log10(fps)))}f} s"

    def pixels(self) -> np.ndarray:
        """The page as it is now: (height, width, 3) uint8."""
        self._canvas.draw()
        return np.array(self._canvas.buffer_rgba())[..., :3]


def _awkwardness(count: int, columns: int, aspect: float) -> float:
    """How far panels of this width per height, in so many columns, are from a full landscape page."""
    rows = math.ceil(count / columns)
    return abs(math.log(columns * aspect / rows / 1.6)) + (rows * columns - count) / count
