"""The scene in front of the camera: obstacles with shadows on them, and the bodies frame by frame."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from warpfem.errors import OutputError
from warpfem.preview.camera import SAMPLES, USUAL, View, camera_axes
from warpfem.preview.canvas import Canvas, covered
from warpfem.preview.coloring import Coloring
from warpfem.preview.obstacles import Obstacle, normals_of

_LIGHT = np.array([-0.4, 0.7, 0.6])
"""Where the light comes from, in the axes of the image: right, up, towards the viewer."""
_OBSTACLE = np.array([0.84, 0.84, 0.85])
_INSIDE_OUT = np.array([1.0, 0.0, 1.0])
_TILE, _SHADOW, _PANE = 0.94, 0.76, 0.2
"""Factors of every other tile and of shadows; opacity of a plane that is seen from behind."""
_EDGE_ON, _BAND = 1e-3, 4.0 * SAMPLES
"""Sine of the angle below which a plane is seen from its side; the width that it then has [samples]."""


class Scene:
    """A motion in front of a camera: draws its frames."""

    def __init__(self, coloring: Coloring, camera: tuple[float, float] | None) -> None:
        """Fits the view to the whole motion, which is read through for it.

        Args:
            coloring: the motion, and the colours of the bodies.
            camera: azimuth and elevation [degrees]; ``None`` for the usual ones.

        Raises:
            OutputError: a camera for a 2D scene.
        """
        self._coloring = coloring
        self._stage = stage = coloring.stage
        self._flat = stage.is_flat
        counts = [len(triangles.points) for triangles in stage.triangles]
        self._has_inside = np.repeat(stage.has_insides, counts)
        if self._flat and camera is not None:
            raise OutputError("the scene is 2D, which has no other camera than the usual one: leave it out")
        self._up = np.eye(3)[1 if self._flat or stage.up_axis == "Y" else 2]
        obstacles = [Obstacle.whole(own.corners, own.is_plane, self._flat) for own in stage.standing]
        lean = sum(obstacle.normal[0] for obstacle in obstacles if obstacle.is_plane)
        if camera is None:
            azimuth, elevation = USUAL
            camera = (-azimuth if lean < -1e-6 else azimuth), elevation
        axes = np.eye(3) if self._flat else camera_axes(self._up, *camera)
        both = np.concatenate([np.eye(3), axes])  # bounds are needed in the world and in the image
        lower, upper = np.full(6, np.inf), np.full(6, -np.inf)
        for index in range(stage.frame_count):
            for body in stage.frame(index):
                along = body.points @ both.T
                lower, upper = np.minimum(lower, along.min(axis=0)), np.maximum(upper, along.max(axis=0))
        nearby = [obstacle.near(lower[:3], upper[:3]) for obstacle in obstacles]
        obstacles = [obstacle for obstacle in nearby if len(obstacle.corners)]
        seen = [np.stack([lower[3:], upper[3:]]), *(obstacle.corners.reshape(-1, 3) @ axes.T for obstacle in obstacles)]
        self.view = View.around(axes, np.concatenate(seen))
        self._draw_obstacles(obstacles)

    def image(self, index: int) -> np.ndarray:
        """Draws a frame: (height, width, 3) uint8."""
        frame = self._stage.frame(index)
        pairs = zip(frame, self._stage.triangles, strict=True)
        corners = np.concatenate([own.points[triangles.points] for own, triangles in pairs])
        values = np.concatenate(self._coloring.values(index, frame))
        colors = self._coloring.scale.srgb(values.ravel()).reshape(corners.shape)
        normals = normals_of(corners)
        canvas = self._backdrop.copy()
        for floor, visible in self._floors:
            drop = (corners - floor.corners[0, 0]) @ floor.normal / (self._up @ floor.normal)
            shadow = (corners - drop[..., None] * self._up)[normals @ self._up > 0.0]
            canvas.color[covered(self.view.project(shadow), self.view) & visible] *= _SHADOW

        away = normals @ self.view.axes[2] < 0.0
        colors[away & self._has_inside], normals[away] = _INSIDE_OUT, -normals[away]
        samples = self.view.project(corners)
        samples[away, :, 2] -= 0.5  # along its outline one sees a body's front
        canvas.draw(samples, colors * self._shade(normals), lines=0.5 if self._flat else 0.3)
        for pane in self._panes:
            canvas.color[pane] += _PANE * (0.7 * _OBSTACLE - canvas.color[pane])
        return canvas.image()

    def _draw_obstacles(self, obstacles: Sequence[Obstacle]) -> None:
        """Draws what does not move; finds the planes that get shadows, and those that are seen from behind."""
        view = self.view
        self._backdrop = canvas = Canvas(view)
        self._floors: list[tuple[Obstacle, np.ndarray]] = []
        self._panes: list[np.ndarray] = []
        owner = np.full(len(canvas.depth), -1)
        for index, obstacle in enumerate(obstacles):
            samples, normals = view.project(obstacle.corners), normals_of(obstacle.corners)
            toward = obstacle.normal @ view.axes[2] if obstacle.is_plane and not self._flat else 1.0
            if abs(toward) < _EDGE_ON:
                samples, normals = _band(samples, view.axes @ obstacle.normal), np.tile(obstacle.normal, (2, 1))
            if toward <= -_EDGE_ON:
                self._panes.append(covered(samples, view))
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


def _band(samples: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """What stands for a plane that is seen from its side.

    Args:
        samples: (k, 3, 3) corners of its triangles in the image [samples].
        normal: (3,) its unit normal to the right, up and towards the viewer.

    Returns:
        (2, 3, 3) corners of a band behind its surface [samples].
    """
    points = samples.reshape(-1, 3)
    away = _BAND * np.array([-normal[0], normal[1], 0.0])
    along = points[:, :2] @ np.array([away[1], -away[0]])
    first, last = points[along.argmin()].copy(), points[along.argmax()].copy()
    first[2] = last[2] = points[:, 2].min()
    corners = np.stack([first, last, last + away, first + away])
    return corners[[(0, 1, 2), (0, 2, 3)]]
