"""Pictures of an animation: a contact sheet or a GIF, to see at a glance what a run did.

They are drawn in numpy with a depth buffer, so that what is hidden is hidden: a floor cuts off what sank into
it. Matplotlib adds what is around: times, the colour bar and a scale bar.
"""

from __future__ import annotations

import copy
import io
import math
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from warpfem.errors import MissingExtraError, OutputError
from warpfem.usd import AnimatedFrame, Animation, ColorQuantity, read_animation

if TYPE_CHECKING:
    from matplotlib.axes import Axes

MOST_FRAMES = {".png": 6, ".gif": 120}
"""Frames in a preview, unless another number is asked for."""

_LABELS: dict[ColorQuantity, str] = {"von_mises": "von Mises stress [Pa]", "jacobian": "volume ratio J"}
_SHORTEST = 0.02
"""Seconds that a GIF shows a frame at least: viewers slow down shorter ones."""

_NEAR, _WHOLE = 0.2, 2.5
"""In sizes of the motion: how near obstacles are drawn, and how large ones are drawn whole."""

_PANEL_PIXELS = 200_000
_SAMPLES = 2
"""Samples per pixel along each axis."""
_BATCH = 1_000_000
"""Samples that are drawn together."""

_AZIMUTH, _ELEVATION = math.radians(28.0), math.radians(20.0)
_LIGHT = np.array([-0.4, 0.7, 0.6])
"""Where the light comes from, in the axes of the image: right, up, towards the viewer."""
_LINE = 0.4 * _SAMPLES
"""Half of the width of an edge [samples]."""
_BACKGROUND = np.array([0.975, 0.98, 0.985], np.float32)
_OBSTACLE = np.array([0.84, 0.84, 0.85])
_INSIDE_OUT = np.array([1.0, 0.0, 1.0])
_TILE, _SHADOW, _PANE = 0.94, 0.76, 0.2
"""Factors of every other tile and of shadows; opacity of a plane that is seen from behind."""


def preview(path: str | Path, out: str | Path, *, frames: int | None = None) -> Path:
    """Draws an animation that warpfem wrote.

    One camera without perspective fits the whole motion and what obstacles are near it. It looks straight at 2D
    scenes; at 3D ones from the front, above and the right, or from the left if planes lean to that side. Colours
    are those of the animation's scale, shaded in 3D; parts of a body that are inside out are magenta. The tiles of
    a plane are as wide as the scale bar is long, a body's shadow lies straight below it, and planes that are seen
    from behind are glass.

    Args:
        path: an animation, finished or partial.
        out: the file to write. ``.png``: a sheet of evenly spaced frames, first and last included.
            ``.gif``: the animation in real time, without the frames that would be too many or shown for
            less than 20 ms.
        frames: the most frames to draw; ``None``: 6 in a ``.png``, 120 in a ``.gif``.

    Returns:
        The path of the picture.

    Raises:
        OutputError: ``out`` has another suffix or cannot be written, ``frames`` is below 1, or ``path`` is
            missing, not an animation, or has no frames.
        MissingExtraError: Matplotlib or Pillow is not installed.
    """
    if not isinstance(out, str | os.PathLike):
        raise OutputError(f"the name of a preview must be a str or a path, not {out!r}")
    out = Path(out)
    _check_settings(out, frames)
    try:
        import matplotlib.figure  # noqa: F401
        import PIL.Image  # noqa: F401
    except ImportError as error:
        raise MissingExtraError("drawing a preview", error.name or "matplotlib", "plot") from error
    animation = read_animation(path)
    if not animation.frame_count:
        raise OutputError(f"{path} has no frames to draw: the run ended before the first one was saved")

    draw = _sheet if out.suffix == ".png" else _film
    picture = draw(animation, _Scene(animation), frames or MOST_FRAMES[out.suffix])
    try:
        out.write_bytes(picture)
    except OSError as error:
        raise OutputError(f"{out} cannot be written: {error}") from error
    return out


def _check_settings(out: Path, frames: int | None) -> None:
    if out.suffix not in MOST_FRAMES:
        raise OutputError(f"{out}: the name of a preview must end in {' or '.join(MOST_FRAMES)}")
    if os.path.isdir(out):
        raise OutputError(f"{out} is a folder: give the name of a file")
    if not os.access(out if os.path.exists(out) else out.parent, os.W_OK):
        raise OutputError(f"{out} cannot be written: its folder does not exist, or writing is not permitted")
    if frames is not None and (isinstance(frames, bool) or not isinstance(frames, int) or frames < 1):
        raise OutputError(f"{out}: a preview has at least 1 frame, not {frames!r}")


# ---- the two kinds of pictures


def _sheet(animation: Animation, scene: _Scene, most: int) -> bytes:
    count = min(most, animation.frame_count)
    chosen = np.linspace(0, animation.frame_count - 1, count).round().astype(int).tolist()
    page = _Page(animation, scene.view, count)
    page.show([scene.image(animation.frame(index)) for index in chosen], chosen)
    buffer = io.BytesIO()
    page.figure.savefig(buffer, format="png")
    return buffer.getvalue()


def _film(animation: Animation, scene: _Scene, most: int) -> bytes:
    from PIL import Image

    stride = max(math.ceil(animation.frame_count / most), math.ceil(_SHORTEST * animation.fps))
    chosen = range(0, animation.frame_count, stride)
    page = _Page(animation, scene.view, 1)
    images = []
    for index in chosen:
        page.show([scene.image(animation.frame(index))], [index])
        images.append(Image.fromarray(page.pixels()))
    some = np.concatenate([np.asarray(image) for image in images[:: math.ceil(len(images) / 8)]])
    palette = Image.fromarray(some).quantize(
        256, Image.Quantize.FASTOCTREE
    )  # one for all frames, or colours would flicker
    images = [image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images]
    # GIF counts hundredths of a second: rounding the times keeps the pace where rounding the delays would not.
    times = 10 * np.round(100.0 / animation.fps * np.array([*chosen, animation.frame_count])).astype(int)
    buffer = io.BytesIO()
    images[0].save(buffer, "GIF", save_all=True, append_images=images[1:], duration=np.diff(times).tolist(), loop=0)
    return buffer.getvalue()


class _Page:
    """Panels with their times, and at the right the bars that tell what colours and lengths mean."""

    def __init__(self, animation: Animation, view: _View, count: int) -> None:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.cm import ScalarMappable
        from matplotlib.colors import ListedColormap, Normalize
        from matplotlib.figure import Figure
        from matplotlib.ticker import EngFormatter

        width, height = view.width // _SAMPLES, view.height // _SAMPLES
        gap, title, margin = 8, 24, 116
        columns = min(range(1, count + 1), key=lambda columns: _awkwardness(count, columns, width / height))
        total_width = columns * (width + gap) + gap + margin
        total_height = math.ceil(count / columns) * (height + title) + gap
        self.figure = Figure(figsize=(total_width / 100, total_height / 100), dpi=100)
        self._canvas = FigureCanvasAgg(self.figure)
        self._fps = animation.fps
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

        scale, left = animation.scale, total_width - margin + 10
        colors = ListedColormap(scale.srgb(np.linspace(scale.lower, scale.upper, 256)))
        bar = self.figure.colorbar(
            ScalarMappable(Normalize(scale.lower, scale.upper), colors),
            cax=place(left, title, 14, min(total_height - title - 60, 300)),
            format=EngFormatter() if scale.quantity == "von_mises" else None,
        )
        bar.set_label(_LABELS[scale.quantity])
        ruler = place(left, total_height - 2 * gap, view.tile * view.scale / _SAMPLES, 2)
        ruler.set(facecolor="black", xticks=[], yticks=[])
        ruler.set_title(f"{view.tile:g} m", fontsize=10, pad=3)

    def show(self, images: Sequence[np.ndarray], frames: Sequence[int]) -> None:
        """Puts images (height, width, 3) uint8, and the times of the frames with these numbers, into the panels."""
        digits = max(1, math.ceil(math.log10(self._fps)))
        for panel, title, image, frame in zip(self._images, self._titles, images, frames, strict=True):
            panel.set_data(image)
            title.set_text(f"{frame / self._fps:.{digits}f} s")

    def pixels(self) -> np.ndarray:
        """The page as it is now: (height, width, 3) uint8."""
        self._canvas.draw()
        return np.array(self._canvas.buffer_rgba())[..., :3]


def _awkwardness(count: int, columns: int, aspect: float) -> float:
    """How far panels of this width per height, in so many columns, are from a full landscape page."""
    rows = math.ceil(count / columns)
    return abs(math.log(columns * aspect / rows / 1.6)) + (rows * columns - count) / count


# ---- the scene


class _Scene:
    """An animation in front of a camera: draws its frames."""

    def __init__(self, animation: Animation) -> None:
        self._faces = [body.surface_faces for body in animation.bodies]
        self._flat = all(body.cells.shape[1] == 3 for body in animation.bodies)
        self._up = np.eye(3)[1 if self._flat or animation.up_axis == "Y" else 2]
        obstacles = [_Obstacle.whole(points[faces], self._flat) for points, faces in animation.obstacles]
        lean = sum(obstacle.normal[0] for obstacle in obstacles if obstacle.is_plane)
        axes = np.eye(3) if self._flat else _tilted(self._up, -_AZIMUTH if lean < -1e-6 else _AZIMUTH)
        both = np.concatenate([np.eye(3), axes])  # bounds are needed in the world and in the image
        lower, upper = np.full(6, np.inf), np.full(6, -np.inf)
        for index in range(animation.frame_count):
            for body in animation.frame(index):
                along = body.points @ both.T
                lower, upper = np.minimum(lower, along.min(axis=0)), np.maximum(upper, along.max(axis=0))
        nearby = [obstacle.near(lower[:3], upper[:3]) for obstacle in obstacles]
        obstacles = [obstacle for obstacle in nearby if len(obstacle.corners)]
        seen = [np.stack([lower[3:], upper[3:]]), *(obstacle.corners.reshape(-1, 3) @ axes.T for obstacle in obstacles)]
        self.view = _View.around(axes, np.concatenate(seen))
        self._draw_obstacles(obstacles)

    def image(self, frame: Sequence[AnimatedFrame]) -> np.ndarray:
        """Draws a frame: (height, width, 3) uint8."""
        corners = np.concatenate([body.points[faces] for body, faces in zip(frame, self._faces, strict=True)])
        colors = np.concatenate([body.colors[faces] for body, faces in zip(frame, self._faces, strict=True)])
        normals = _normals(corners)
        canvas = self._backdrop.copy()
        for floor, visible in self._floors:
            drop = (corners - floor.corners[0, 0]) @ floor.normal / (self._up @ floor.normal)
            shadow = (corners - drop[..., None] * self._up)[normals @ self._up > 0.0]
            canvas.color[_covered(self.view.project(shadow), self.view) & visible] *= _SHADOW

        away = normals @ self.view.axes[2] < 0.0
        colors[away], normals[away] = _INSIDE_OUT, -normals[away]
        samples = self.view.project(corners)
        samples[away, :, 2] -= 0.5  # along its outline one sees a body's front
        canvas.draw(samples, colors * self._shade(normals), lines=0.5 if self._flat else 0.3)
        for pane in self._panes:
            canvas.color[pane] += _PANE * (0.7 * _OBSTACLE - canvas.color[pane])
        return canvas.image()

    def _draw_obstacles(self, obstacles: Sequence[_Obstacle]) -> None:
        """Draws what does not move; finds the planes that get shadows, and those that are seen from behind."""
        view = self.view
        self._backdrop = canvas = _Canvas(view)
        self._floors: list[tuple[_Obstacle, np.ndarray]] = []
        self._panes: list[np.ndarray] = []
        owner = np.full(len(canvas.depth), -1)
        for index, obstacle in enumerate(obstacles):
            samples, normals = view.project(obstacle.corners), _normals(obstacle.corners)
            if obstacle.is_plane and obstacle.normal @ view.axes[2] < 0.0:
                self._panes.append(_covered(samples, view))
            else:
                owner[canvas.draw(samples, self._shade(normals) * _OBSTACLE)] = index
        for index, obstacle in enumerate(obstacles):
            if obstacle.is_plane and not self._flat:
                visible = np.flatnonzero(owner == index)
                points = view.unproject(visible, canvas.depth[visible])
                tiles = np.floor(np.delete(points, np.abs(obstacle.normal).argmax(), axis=1) / view.tile)
                canvas.color[visible[tiles.sum(axis=1) % 2 == 1]] *= _TILE
                if obstacle.normal @ self._up > 0.2:
                    self._floors.append((obstacle, owner == index))

    def _shade(self, normals: np.ndarray) -> np.ndarray:
        """(k, 1, 1) brightness of surfaces with these (k, 3) normals."""
        light = normals @ (_LIGHT @ self.view.axes) / np.linalg.norm(_LIGHT)
        return np.ones((len(normals), 1, 1)) if self._flat else (0.72 + 0.28 * light)[:, None, None]


@dataclass(frozen=True, eq=False)
class _Obstacle:
    """An obstacle, or a part of one: ``corners`` (k, 3, 3) of its triangles [m], and whether it is a plane."""

    corners: np.ndarray
    is_plane: bool

    @classmethod
    def whole(cls, corners: np.ndarray, flat: bool) -> _Obstacle:
        """All of an obstacle in a file, which holds just a piece of a plane: two triangles.

        In 2D that piece is a strip on the solid side, and its first two corners are on the surface.
        """
        is_plane = len(corners) == 2
        if is_plane:
            middle = corners[0, :2].mean(axis=0) if flat else corners.mean(axis=(0, 1))
            corners = middle + 1e4 * (corners - middle)
        return cls(corners, is_plane)

    @cached_property
    def normal(self) -> np.ndarray:
        """(3,) unit normal of a plane."""
        normals = _normals(self.corners)
        return normals[np.abs(normals).sum(axis=1).argmax()]  # clipping makes triangles without area

    def near(self, lower: np.ndarray, upper: np.ndarray) -> _Obstacle:
        """What is near to a motion within (3,) bounds [m]: everything, if that is not much larger."""
        size = (upper - lower).max()
        lower, upper = lower - _NEAR * size, upper + _NEAR * size
        first, last = self.corners.min(axis=1), self.corners.max(axis=1)
        start, stop = first.min(axis=0), last.max(axis=0)
        if (start <= upper).all() and (stop >= lower).all() and (stop - start).max() < _WHOLE * size:
            return self
        inside = ((first >= lower) & (last <= upper)).all(axis=1)
        crossing = ((first <= upper) & (last >= lower)).all(axis=1) & ~inside
        parts = [_fan(_clipped(triangle, lower, upper)) for triangle in self.corners[crossing]]
        return _Obstacle(np.concatenate([self.corners[inside], *parts]), self.is_plane)


def _clipped(polygon: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """The part of a convex polygon (n, 3) within bounds, by Sutherland and Hodgman's method."""
    for axis, sign, bound in [(axis, sign, bound) for sign, bound in ((1, lower), (-1, upper)) for axis in range(3)]:
        depth = sign * (polygon[:, axis] - bound[axis])
        after, depth_after = np.roll(polygon, -1, axis=0), np.roll(depth, -1)
        crosses = (depth >= 0.0) != (depth_after >= 0.0)
        share = depth / np.where(crosses, depth - depth_after, 1.0)
        crossings = polygon + share[:, None] * (after - polygon)
        polygon = np.stack([polygon, crossings], axis=1)[np.column_stack([depth >= 0.0, crosses])]
    return polygon


def _fan(polygon: np.ndarray) -> np.ndarray:
    """The triangles (n - 2, 3, 3) of a convex polygon (n, 3)."""
    first = np.broadcast_to(polygon[:1], polygon.shape)
    return np.stack([first, polygon, np.roll(polygon, -1, axis=0)], axis=1)[1:-1]


def _normals(corners: np.ndarray) -> np.ndarray:
    """(k, 3) unit normals of triangles (k, 3, 3); zero where a triangle has no area."""
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    return normals / np.where(lengths > 0.0, lengths, 1.0)


# ---- from the scene to pixels


def _tilted(up: np.ndarray, azimuth: float) -> np.ndarray:
    """The axes of a view from above, turned from the front to the right; ``up`` (3,) is y or z."""
    right = np.array([1.0, 0.0, 0.0])
    front = np.cross(right, up)
    level = math.sin(azimuth) * right + math.cos(azimuth) * front
    toward = math.cos(_ELEVATION) * level + math.sin(_ELEVATION) * up
    across = np.cross(up, level)
    return np.stack([across, np.cross(toward, across), toward])


@dataclass(frozen=True, eq=False)
class _View:
    """A camera without perspective.

    Attributes:
        axes: (3, 3) unit vectors to the right, up and towards the viewer.
        corner: (3,) where the upper left corner of the image is, along these axes [m].
        scale: samples per metre.
        width, height: of the image [samples], multiples of ``_SAMPLES``.
        tile: a round length that takes up to 80 pixels [m].
    """

    axes: np.ndarray
    corner: np.ndarray
    scale: float
    width: int
    height: int
    tile: float

    @classmethod
    def around(cls, axes: np.ndarray, positions: np.ndarray) -> _View:
        """The view that fits (n, 3) positions along ``axes`` [m]."""
        lower, upper = positions.min(axis=0), positions.max(axis=0)
        size = 1.06 * (upper - lower)[:2]
        size = np.maximum(size, size[::-1] / 2.2)
        scale = _SAMPLES * math.sqrt(_PANEL_PIXELS / size.prod())
        width, height = (_SAMPLES * np.ceil(scale * size / _SAMPLES).astype(int)).tolist()
        corner = 0.5 * (lower + upper) + 0.5 / scale * np.array([-width, height, 0.0])
        longest = 80.0 * _SAMPLES / scale
        power = 10.0 ** math.floor(math.log10(longest))
        tile = max(step * power for step in (1, 2, 5) if step * power <= longest)
        return cls(axes, corner, scale, width, height, tile)

    def project(self, points: np.ndarray) -> np.ndarray:
        """Positions to the right, down and towards the viewer [samples] of (..., 3) points [m]."""
        return (points @ self.axes.T - self.corner) * (self.scale * np.array([1.0, -1.0, 1.0]))

    def unproject(self, samples: np.ndarray, depth: np.ndarray) -> np.ndarray:
        """(n, 3) points [m] that are seen at (n,) samples with these depths (n,)."""
        rows, columns = np.divmod(samples, self.width)
        return (np.column_stack([columns + 0.5, -0.5 - rows, depth]) / self.scale + self.corner) @ self.axes


class _Canvas:
    """An image with a depth buffer: ``color`` (n, 3) and ``depth`` (n,) of its samples, row after row."""

    def __init__(self, view: _View) -> None:
        self.view = view
        self.color = np.tile(_BACKGROUND, (view.width * view.height, 1))
        self.depth = np.full(len(self.color), -np.inf)

    def copy(self) -> _Canvas:
        """An independent copy."""
        other = copy.copy(self)
        other.color, other.depth = self.color.copy(), self.depth.copy()
        return other

    def draw(self, corners: np.ndarray, colors: np.ndarray, lines: float = 0.0) -> np.ndarray:
        """Draws triangles, where nothing that was drawn before is nearer.

        Args:
            corners: (k, 3, 3) positions [samples].
            colors: colours of the corners, (k, 3, 3) or what broadcasts to it.
            lines: how much edges are darkened, 0..1; less in small triangles.

        Returns:
            The samples that changed, some repeatedly.
        """
        colors = np.broadcast_to(colors, corners.shape)
        heights = _heights(corners)
        darkness = lines * np.minimum(heights.min(axis=0) / (16.0 * _LINE), 1.0)
        changed = [np.zeros(0, int)]
        for triangle, sample, weights in _fragments(corners, self.view):
            depth = (weights * corners[triangle, :, 2].T).sum(axis=0)
            np.maximum.at(self.depth, sample, depth)
            seen = np.flatnonzero(self.depth[sample] == depth)
            triangle, sample, weights = triangle[seen], sample[seen], weights[:, seen]
            on_line = (weights * heights[:, triangle]).min(axis=0) < _LINE
            brightness = weights * (1.0 - darkness[triangle] * on_line)
            self.color[sample] = np.einsum("cn,ncd->nd", brightness, colors[triangle])
            changed.append(sample)
        return np.concatenate(changed)

    def image(self) -> np.ndarray:
        """The picture, one pixel for each block of samples: (height, width, 3) uint8."""
        color = self.color.reshape(self.view.height, self.view.width, 3)
        parts = [color[row::_SAMPLES, column::_SAMPLES] for row, column in np.ndindex(_SAMPLES, _SAMPLES)]
        return np.round(255.0 / len(parts) * sum(parts)).astype(np.uint8)


def _covered(corners: np.ndarray, view: _View) -> np.ndarray:
    """The mask (n,) of the samples that triangles (k, 3, 3) [samples] cover."""
    mask = np.zeros(view.width * view.height, bool)
    for _, sample, _ in _fragments(corners, view):
        mask[sample] = True
    return mask


def _heights(corners: np.ndarray) -> np.ndarray:
    """(3, k) height of each corner of triangles (k, 3, 3) above the opposite side, in the image [samples]."""
    sides = (np.roll(corners, -1, axis=1) - np.roll(corners, -2, axis=1))[..., :2]
    doubled_areas = np.abs(np.linalg.det(sides[:, :2]))
    return doubled_areas / np.maximum(np.linalg.norm(sides, axis=2), 1e-9).T


def _fragments(corners: np.ndarray, view: _View) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """The samples that triangles (k, 3, 3) [samples] cover, in batches.

    Yields:
        Of every sample within a triangle: the triangle, the sample, and the weights (3, n) of the corners.
    """
    flat = corners[..., :2] - 0.5  # samples are now at whole numbers
    matrices = np.concatenate([flat, np.ones((*flat.shape[:2], 1))], axis=2)
    doubled_areas = np.abs(np.linalg.det(matrices))
    solid = np.flatnonzero(doubled_areas > 1e-3)
    by_x, by_y, at_zero = np.linalg.inv(matrices[solid]).transpose(1, 2, 0)
    tops = np.clip(np.ceil(flat[solid, :, 1].min(axis=1)), 0, view.height).astype(int)
    row_counts = np.clip(np.floor(flat[solid, :, 1].max(axis=1)) + 1, tops, view.height).astype(int) - tops
    work = np.cumsum(0.5 * doubled_areas[solid] + row_counts)
    for batch in np.split(np.arange(len(solid)), np.flatnonzero(np.diff(work // _BATCH)) + 1):
        triangle, down = _runs(batch, row_counts[batch])
        y = tops[triangle] + down
        slopes, at_row = by_x[:, triangle], at_zero[:, triangle] + y * by_y[:, triangle]
        crossings = -at_row / np.where(slopes == 0.0, 1.0, slopes)
        left = np.where(slopes > 0.0, crossings, -np.inf).max(axis=0) - 1e-6
        right = np.where(slopes < 0.0, crossings, np.inf).min(axis=0) + 1e-6
        start = np.clip(np.ceil(left), 0, view.width).astype(int)
        row, along = _runs(np.arange(len(y)), np.clip(np.floor(right) + 1, start, view.width).astype(int) - start)
        x = start[row] + along
        yield solid[triangle[row]], y[row] * view.width + x, at_row[:, row] + x * slopes[:, row]


def _runs(values: np.ndarray, counts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Each of the (n,) values as often as (n,) ``counts`` say, and the place 0, 1, ... of each in its run."""
    starts = np.cumsum(counts) - counts
    return np.repeat(values, counts), np.arange(counts.sum()) - np.repeat(starts, counts)
