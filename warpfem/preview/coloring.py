"""What colours a picture: a quantity of the file, its values at the surface, and the range of the colours."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from warpfem.errors import OutputError
from warpfem.usd import ColorQuantity, ColorScale, PicturedStage, SurfaceFrame, spread_of

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
        stage: where it comes from.
        name: a primvar of the surfaces, or one of ``DERIVED``.
        scale: the range of the colours; of its ``quantity`` only the table of colours counts here.
    """

    stage: PicturedStage
    name: str
    scale: ColorScale

    @classmethod
    def of(cls, stage: PicturedStage, name: str | None) -> Coloring:
        """The colours of a quantity; ``None`` for those that warpfem wrote the file with, or else the displacement.

        Raises:
            OutputError: the file has no such quantity.
        """
        if name is None and stage.color is not None:
            return cls(stage, *stage.color)
        name = name or "displacement"
        moving = DERIVED if all(own.velocities is not None for own in stage.frame(0)) else DERIVED[:1]
        known = (*stage.primvars, *moving)
        if name not in known:
            raise OutputError(f"the file has nothing named {name!r} to colour by: it has {', '.join(known)}")
        coloring = cls(stage, name, ColorScale("von_mises", 0.0, 1.0))
        return replace(coloring, scale=coloring._widest())

    @property
    def label(self) -> str:
        """What is written beside the colours."""
        return _LABELS.get(self.name, (self.name, ""))[0]

    @property
    def unit(self) -> str:
        """What numbers are followed by, with prefixes such as k and M; "" if there is none, or none is known."""
        return _LABELS.get(self.name, (self.name, ""))[1]

    @cached_property
    def _rest(self) -> list[np.ndarray]:
        return self.stage.rest()

    def values(self, index: int, frames: Sequence[SurfaceFrame]) -> list[np.ndarray]:
        """The quantity at the corners of the surfaces' triangles.

        Args:
            index: number of the frame.
            frames: what each surface is in it.

        Returns:
            (k, 3) per surface.
        """
        if self.name in self.stage.primvars:
            return self.stage.values(self.name, index)
        vectors: list = (
            [own.points - rest for own, rest in zip(frames, self._rest, strict=True)]
            if self.name == "displacement"
            else [own.velocities for own in frames]
        )
        pairs = zip(vectors, self.stage.triangles, strict=True)
        return [np.linalg.norm(own, axis=1)[triangles.points] for own, triangles in pairs]

    def _widest(self) -> ColorScale:
        """The range that all frames have in common."""
        lower, upper, spread = np.inf, -np.inf, 0.0
        own: ColorQuantity = "jacobian" if self.name in ("J", "JPoint") else "von_mises"
        for index in range(self.stage.frame_count):
            for values in self.values(index, self.stage.frame(index)):
                lower = min(lower, float(np.percentile(values, _TAIL, method="lower")))
                upper = max(upper, float(np.percentile(values, 100.0 - _TAIL, method="higher")))
                spread = max(spread, spread_of(own, values))
        if self.name in _LABELS:
            return ColorScale.from_spread(own, spread)
        return ColorScale("von_mises", lower, upper if upper > lower else lower + max(abs(lower), 1.0))
