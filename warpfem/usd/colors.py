"""Colour scales: from a stress or a volume ratio to what the eye sees."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np

ColorQuantity: TypeAlias = Literal["von_mises", "jacobian"]

# sRGB anchors at equal distances. Their lightness rises evenly (von Mises), or falls evenly from the middle
# to both ends (J: blue is compressed, red is stretched), so that equal steps look equal.
_ANCHORS = {
    "von_mises": np.array(
        [
            (0.157, 0.110, 0.345),
            (0.192, 0.200, 0.510),
            (0.165, 0.318, 0.588),
            (0.118, 0.431, 0.604),
            (0.106, 0.537, 0.580),
            (0.192, 0.643, 0.518),
            (0.412, 0.741, 0.420),
            (0.667, 0.824, 0.322),
            (0.965, 0.890, 0.251),
        ]
    ),
    "jacobian": np.array(
        [
            (0.086, 0.227, 0.514),
            (0.227, 0.427, 0.706),
            (0.463, 0.624, 0.820),
            (0.710, 0.804, 0.902),
            (0.949, 0.941, 0.929),
            (0.937, 0.765, 0.690),
            (0.878, 0.553, 0.463),
            (0.753, 0.310, 0.275),
            (0.549, 0.063, 0.149),
        ]
    ),
}


@dataclass(frozen=True)
class ColorScale:
    """A quantity, and the values at the two ends of its colour table.

    Attributes:
        quantity: ``"von_mises"`` [Pa] or ``"jacobian"`` (J, no unit); chooses the table.
        lower, upper: the values that get the first and the last colour; what lies outside is clipped.
    """

    quantity: ColorQuantity
    lower: float
    upper: float

    @classmethod
    def from_spread(cls, quantity: ColorQuantity, spread: float) -> ColorScale:
        """The scale for values within ``spread`` of rest: 0..spread for von Mises, 1 ± spread for J."""
        width = spread if spread > 0.0 else 1.0
        return cls(quantity, 0.0, width) if quantity == "von_mises" else cls(quantity, 1.0 - width, 1.0 + width)

    def srgb(self, values: np.ndarray) -> np.ndarray:
        """Colours for a screen or a picture file.

        Args:
            values: (n,) values of the quantity.

        Returns:
            (n, 3) sRGB colours in 0..1.
        """
        anchors = _ANCHORS[self.quantity]
        position = (np.asarray(values, float) - self.lower) / (self.upper - self.lower) * (len(anchors) - 1)
        return np.column_stack([np.interp(position, range(len(anchors)), channel) for channel in anchors.T])

    def linear(self, values: np.ndarray) -> np.ndarray:
        """The colours of :meth:`srgb` in linear light, as ``displayColor`` holds them: (n, 3) float32."""
        srgb = self.srgb(values)
        linear = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
        return linear.astype(np.float32)


def spread_of(quantity: ColorQuantity, values: np.ndarray) -> float:
    """How far values go from rest, less the outermost 0.5 %: one singular corner is not the picture."""
    rest = 0.0 if quantity == "von_mises" else 1.0
    return float(np.percentile(np.abs(values - rest), 99.5, method="higher"))
