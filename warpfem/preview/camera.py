"""Where a motion is seen from, and where its points are then in the image."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from warpfem.errors import OutputError

CAMERAS: dict[str, tuple[float, float]] = {
    "front": (0.0, 0.0),
    "right": (90.0, 0.0),
    "back": (180.0, 0.0),
    "left": (270.0, 0.0),
    "top": (0.0, 90.0),
    "bottom": (0.0, -90.0),
}
"""Azimuth and elevation of the cameras that have names [degrees]."""

USUAL = 28.0, 20.0
"""Azimuth and elevation if none are asked for [degrees]."""

SAMPLES = 2
"""Samples per pixel along each axis."""
PANEL_PIXELS = 200_000


def parse_camera(text: str) -> tuple[float, float]:
    """Azimuth and elevation [degrees] of a camera: its name, or the two numbers with a comma between.

    Raises:
        OutputError: it is neither, or the elevation is beyond 90 degrees.
    """
    if text in CAMERAS:
        return CAMERAS[text]
    try:
        azimuth, elevation = map(float, text.split(","))
    except ValueError:
        azimuth = elevation = math.nan
    if not (math.isfinite(azimuth) and -90.0 <= elevation <= 90.0):
        raise OutputError(
            f"a camera is one of {', '.join(CAMERAS)}, or AZIMUTH,ELEVATION in degrees such as 30,20, with an "
            f"elevation between -90 and 90, not {text!r}"
        )
    return azimuth, elevation


def camera_axes(up: np.ndarray, azimuth: float, elevation: float) -> np.ndarray:
    """The axes of a view.

    Args:
        up: (3,) the unit vector along y or z that points up. The front is that of +z if y is up, of -y if z is.
        azimuth: how far the camera is turned from the front to the right [degrees].
        elevation: how far it is raised above the horizon [degrees].

    Returns:
        (3, 3) unit vectors to the right, up and towards the viewer.
    """
    azimuth, elevation = math.radians(azimuth), math.radians(elevation)
    right = np.array([1.0, 0.0, 0.0])
    front = np.cross(right, up)
    level = math.sin(azimuth) * right + math.cos(azimuth) * front
    toward = math.cos(elevation) * level + math.sin(elevation) * up
    across = np.cross(up, level)
    return np.stack([across, np.cross(toward, across), toward])


@dataclass(frozen=True, eq=False)
class View:
    """A camera without perspective.

    Attributes:
        axes: (3, 3) unit vectors to the right, up and towards the viewer.
        corner: (3,) where the upper left corner of the image is, along these axes [m].
        scale: samples per metre.
        width, height: of the image [samples], multiples of ``SAMPLES``.
        tile: a round length that takes up to 80 pixels [m].
    """

    axes: np.ndarray
    corner: np.ndarray
    scale: float
    width: int
    height: int
    tile: float

    @classmethod
    def around(cls, axes: np.ndarray, positions: np.ndarray) -> View:
        """The view that fits (n, 3) positions along ``axes`` [m]."""
        lower, upper = positions.min(axis=0), positions.max(axis=0)
        size = 1.06 * (upper - lower)[:2]
        size = np.maximum(size, size[::-1] / 2.2)
        scale = SAMPLES * math.sqrt(PANEL_PIXELS / size.prod())
        width, height = (SAMPLES * np.ceil(scale * size / SAMPLES).astype(int)).tolist()
        corner = 0.5 * (lower + upper) + 0.5 / scale * np.array([-width, height, 0.0])
        longest = 80.0 * SAMPLES / scale
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
