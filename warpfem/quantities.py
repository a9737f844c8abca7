"""Quantities of interest: numbers of a motion that a scene can declare, for studies of its accuracy.

Any function ``(motion) -> float`` of a :class:`warpfem.motion.Motion` is one. These are the usual ones.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from warpfem.errors import SimulationError

if TYPE_CHECKING:
    from warpfem.motion import Motion

Quantity: TypeAlias = "Callable[[Motion], float]"
"""A number of a motion."""


def final_displacement(body: str, at: Sequence[float], axis: int) -> Quantity:
    """The displacement along an axis of a place of a body, in the last frame [m].

    Args:
        body: its name.
        at: rest position of the place (dim,) [m].
        axis: 0 for x, 1 for y, 2 for z.
    """
    return lambda motion: float(motion.displacement(body, at)[-1, axis])


def largest_displacement(body: str, at: Sequence[float], axis: int) -> Quantity:
    """The displacement along an axis of a place of a body that is largest in magnitude over time [m].

    Between frames it is that of the parabola through the largest and its neighbours.

    Args:
        body: its name.
        at: rest position of the place (dim,) [m].
        axis: 0 for x, 1 for y, 2 for z.
    """

    def value(motion: Motion) -> float:
        u = motion.displacement(body, at)[:, axis]
        k = int(np.argmax(np.abs(u)))
        if k in (0, len(u) - 1):
            return float(u[k])
        slope, curvature = 0.5 * (u[k + 1] - u[k - 1]), u[k + 1] - 2.0 * u[k] + u[k - 1]
        return float(u[k] - 0.5 * slope**2 / curvature) if curvature != 0.0 else float(u[k])

    return value


def period(body: str, at: Sequence[float], axis: int) -> Quantity:
    """The period of the oscillation along an axis of a place of a body [s].

    It is the mean distance of upward crossings of the middle between the extremes over time, and of downward ones,
    interpolated between frames: frames should be a tenth of the period apart, or less.

    Args:
        body: its name.
        at: rest position of the place (dim,) [m].
        axis: 0 for x, 1 for y, 2 for z.
    """

    def value(motion: Motion) -> float:
        u = motion.displacement(body, at)[:, axis]
        u = u - 0.5 * (u.max() + u.min())
        distances = []
        for sign in (1.0, -1.0):
            before = np.flatnonzero((sign * u[:-1] < 0.0) & (sign * u[1:] >= 0.0))
            fraction = u[before] / (u[before] - u[before + 1])
            crossings = motion.times[before] + fraction * (motion.times[before + 1] - motion.times[before])
            distances += np.diff(crossings).tolist()
        if not distances:
            raise SimulationError(f"body '{body}' does not swing through a period: simulate more frames")
        return float(np.mean(distances))

    return value


def final_von_mises(body: str, at: Sequence[float]) -> Quantity:
    """The von Mises stress at a place of a body in the last frame [Pa].

    Args:
        body: its name.
        at: rest position of the place (dim,) [m]; at re-entrant corners and ends of clamps no mesh is fine enough.
    """
    return lambda motion: float(motion.von_mises(body, at, frames=[-1])[0])


def peak_von_mises(body: str, at: Sequence[float]) -> Quantity:
    """The greatest von Mises stress over time at a place of a body [Pa].

    Args:
        body: its name.
        at: rest position of the place (dim,) [m]; at re-entrant corners and ends of clamps no mesh is fine enough.
    """
    return lambda motion: float(motion.von_mises(body, at).max())
