"""What colours a picture: a quantity of the file, its values at the surface, and the range of the colours."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from warpfem.errors import OutputError
from warpfem.usd import AnimatedFrame, Animation, ColorQuantity, ColorScale, spread_of

DERIVED = ("displacement", "speed")
"""Quantities that are computed from positions and velocities: their magnitudes."""

_LABELS = {
    "vonMises": ("von Mises stress", "Pa"),
    "vonMisesPoint": ("von Mises stress", "Pa"),
    "J": ("volume ratio J", ""),
    "JPoint": ("volume ratio J", ""),
    "displacement": ("displacement", "m"),
    "speed": ("speed", "m/s"),
}
_TAIL = 0.5
"""The part of the values beyond either end of the colours [%]: one singular corner is not the picture."""


@dataclass(frozen=True, eq=False)
class Coloring:
    """A quantity, and what colours its values have.

    Attributes:
        animation: where it comes from.
        name: a primvar of the surfaces, or one of ``DERIVED``.
        scale: the range of the colours; of its ``quantity`` only the table of colours counts here.
    """

    animation: Animation
    name: str
    scale: ColorScale

    @classmethod
    def of(cls, animation: Animation, name: str | None) -> Coloring:
        """The colours of a quantity, or those that the file was written with.

        Raises:
            OutputError: the animation has no such quantity.
        """
        if name is None:
            return cls(animation, animation.color_primvar, animation.scale)
        known = (*animation.primvars, *DERIVED)
        if name not in known:
            raise OutputError(f"the animation has nothing named {name!r} to colour by: it has {', '.join(known)}")
        coloring = cls(animation, name, animation.scale)
        return replace(coloring, scale=coloring._widest())

    @property
    def label(self) -> str:
        """What is written beside the colours."""
        return _LABELS.get(self.name, (self.name, ""))[0]

    @property
    def unit(self) -> str:
        """What numbers are followed by, with prefixes such as k and M; "" if there is none, or none is known."""
        return _LABELS.get(self.name, (self.name, ""))[1]

    def values(self, index: int, frames: Sequence[AnimatedFrame]) -> list[np.ndarray]:
        """The quantity at the corners of the surfaces' faces.

        Args:
            index: number of the frame.
            frames: what each body is in it.

        Returns:
            (k, 3) per body.
        """
        if self.name in self.animation.primvars:
            return self.animation.surface_values(self.name, index)
        bodies = self.animation.bodies
        vectors: Callable[[int], np.ndarray] = (
            (lambda body: frames[body].points - bodies[body].rest_points)
            if self.name == "displacement"
            else (lambda body: frames[body].velocities)
        )
        return [np.linalg.norm(vectors(i), axis=1)[body.surface_faces] for i, body in enumerate(bodies)]

    def _widest(self) -> ColorScale:
        """The range that all frames have in common."""
        lower, upper, spread = np.inf, -np.inf, 0.0
        own: ColorQuantity = "jacobian" if self.name in ("J", "JPoint") else "von_mises"
        for index in range(self.animation.frame_count):
            for values in self.values(index, self.animation.frame(index)):
                lower = min(lower, float(np.percentile(values, _TAIL, method="lower")))
                upper = max(upper, float(np.percentile(values, 100.0 - _TAIL, method="higher")))
                spread = max(spread, spread_of(own, values))
        if self.name in _LABELS:
            return ColorScale.from_spread(own, spread)
        return ColorScale("von_mises", lower, upper if upper > lower else lower + max(abs(lower), 1.0))
