"""Ladders of ever finer runs in space and in time, and the limit of both together."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from warpfem.trade.extrapolation import extrapolate, norms
from warpfem.trade.outcome import Outcome
from warpfem.trade.problem import Setting


@dataclass(frozen=True, eq=False)
class Rung:
    """A level of a ladder."""

    setting: Setting
    size: float
    outcome: Outcome


@dataclass(frozen=True)
class Part:
    """What one ladder, or the algebra, leaves open of a quantity.

    Attributes:
        order: observed; ``None`` if there is none.
        band: relative to the scale of the quantity.
        remark: why there is no order.
    """

    order: float | None
    band: float
    remark: str = ""


class LadderSum:
    """The limit in space and what is missing in time, of one field or number.

    What is missing in time is that of the first mesh, and the change of that from the first mesh to the second: as much
    again may be missing on finer ones.

    Attributes:
        value: the reference's.
        limits: of each ladder.
        cross: the root mean square and the largest of that change.
    """

    def __init__(
        self,
        space: list[Rung],
        time: list[Rung],
        crossed: list[Outcome],
        rough: list[Outcome],
        value: Callable[[Outcome], np.ndarray],
    ) -> None:
        self.limits = {"space": extrapolate([value(r.outcome) for r in space], [r.size for r in space])}
        self.value = self.limits["space"].value
        self.cross = (0.0, 0.0)
        self._rough = [norms(value(outcome) - value(space[0].outcome)) for outcome in rough]
        if time:
            self.limits["time"] = extrapolate([value(r.outcome) for r in time], [r.outcome.longest_dt for r in time])
            missing = self.limits["time"].value - value(space[0].outcome)
            for outcome in crossed:
                change = value(outcome) - value(space[1].outcome) - value(time[-1].outcome) + value(space[0].outcome)
                self.cross = norms(change)
                missing = missing + change
            self.value = self.value + missing

    def parts(self, scale: float, which: int) -> dict[str, Part]:
        """The bands of the ladders and of the algebra, over a scale; of the root mean square (0) or the largest (1)."""
        parts = {}
        for kind, limit in self.limits.items():
            band = (limit.band, limit.largest_band)[which] + (self.cross[which] if kind == "time" else 0.0)
            parts[kind] = Part(limit.order, band / scale, limit.remark)
        for rough in self._rough:
            parts["algebra"] = Part(None, rough[which] / scale)
        return parts
