"""Richardson extrapolation: the limit of a sequence of ever finer solutions, its order and an error band.

Solutions of an error C h^p on three levels h_1 > h_2 > h_3 have differences in the ratio
(h_1^p - h_2^p) / (h_2^p - h_3^p), which tells p, and the limit u_3 + (u_3 - u_2) / ((h_2 / h_3)^p - 1) (Richardson
1911; Roache, "Perspective: a method for uniform reporting of grid refinement studies", 1994). With three levels the
error band claims no more of it than that it is twice as accurate as the finest level. With four, the limits of the
first and of the last three show what extrapolation is worth: where single terms C h^p do not describe the error, as of
edges whose singularity comes to light on fine meshes, the limit moves on. What it still has to go is taken to be what
it has moved by, or more where levels are close, as if limits were of an order one above that of their levels.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

LEAST_ORDER, MOST_ORDER = 0.5, 4.0
"""Observed orders out of this range are taken for accidents: nothing is extrapolated below, none claimed above."""

CLAIM = 0.5
"""The part of the correction that remains in the error band where three levels are all there is. At re-entrant corners
and clamps, where errors of coarse meshes fall faster than they go on to, a third of it has been seen to remain."""

LEAST_CLAIM = 0.2
"""The part of the correction that remains in any error band: two limits can agree by accident."""

SAFETY = 1.25
"""Factor of estimates from the levels' own scatter (Roache 1994)."""

UNCLEAR, LARGEST_UNCLEAR = 1.5, 2.0
"""Factors of estimates where no order is seen, as after impacts, and of those of the largest vector: bodies that fell
on a floor have been off by 1.3 and 1.6 times the estimate."""

ALIGNED = 0.5
"""Cosine between two differences of fields from which on both go the same way."""

ROUNDING = 1e-12
"""Differences below this part of the values are none."""


@dataclass(frozen=True)
class Extrapolated:
    """The limit of a sequence.

    Attributes:
        value: the limit, or the finest level where nothing was extrapolated; of the shape of the levels.
        order: the observed order; ``None`` if there is none to be trusted.
        band: bound of what the limit is off by, a root mean square over the vectors of a field.
        largest_band: the same for the largest vector of a field, of whose correction no part is claimed.
        remark: why nothing was extrapolated; empty if something was.
    """

    value: np.ndarray
    order: float | None
    band: float
    largest_band: float
    remark: str = ""


def extrapolate(levels: Sequence[np.ndarray], sizes: Sequence[float]) -> Extrapolated:
    """The limit of a sequence of fields or numbers, from its last three; a fourth tells how good that is.

    Args:
        levels: from coarse to fine, two at least: vectors in the last axis of an array, or arrays of length 1.
        sizes: the size h of each level, falling.
    """
    own = _of_three(levels[-3:], sizes[-3:])
    if own.order is None or len(levels) < 4:
        return own
    before = _of_three(levels[-4:-1], sizes[-4:-1])
    if before.order is None:
        return own
    moved = SAFETY * max(1.0, _weight(own.order + 1.0, sizes)) * _rms(own.value - before.value)
    return replace(own, band=max(moved, LEAST_CLAIM * _rms(own.value - levels[-1])))


def _of_three(levels: Sequence[np.ndarray], sizes: Sequence[float]) -> Extrapolated:
    """The limit that three levels tell, or why they, or two, tell none."""
    *rest, b, c = levels
    last, largest = norms(c - b)
    scale = max(_rms(b), _rms(c))
    if last <= ROUNDING * scale:
        return Extrapolated(c, None, last, largest, "the levels agree to rounding")
    if not rest:
        return _unclear(c, last, largest, "two levels tell no order")
    a = rest[0]
    first = _rms(b - a)
    if not last < first:
        return _unclear(c, last, largest, f"it does not converge: changes of {first:.2e} and then {last:.2e}")
    h = [float(size) for size in sizes]
    if not h[0] > h[1] > h[2]:  # meshes that follow the details of a surface have as many cells whatever is asked for
        return _unclear(c, last, largest, "the levels do not get finer one by one")
    order = observed_order(first / last, h)
    cosine = float(((b - a) * (c - b)).sum() / np.sqrt(((b - a) ** 2).sum() * ((c - b) ** 2).sum()))
    if cosine < ALIGNED:
        shrink = max((h[2] / h[1]) ** LEAST_ORDER, last / first) if order is None else (h[2] / h[1]) ** order
        ahead = max(1.0, _sum_of_changes(shrink, max(cosine, 0.0)))
        return _unclear(c, ahead * last, ahead * largest, "the changes shrink, but do not go the same way")
    if order is None:
        slow = last / (1.0 - last / first)  # the sum of all changes to come, if they go on to shrink like this
        return Extrapolated(c, None, slow, slow * largest / last, f"it converges at an order below {LEAST_ORDER:g}")
    weight = _weight(order, h)
    before = b + (b - a) / ((h[0] / h[1]) ** order - 1.0)
    value = c + weight * (c - b)
    drift = value - before  # what the limit has changed by, which shrinks faster than the error
    shrink = (h[1] / h[2]) ** -order
    # the largest error is where the field is least smooth: of single vectors the limit claims nothing
    return Extrapolated(
        value,
        order,
        max(CLAIM * weight * last, SAFETY * shrink * _rms(drift)),
        max(weight * largest, SAFETY * shrink * _most(drift)),
    )


def _unclear(finest: np.ndarray, off: float, largest: float, remark: str) -> Extrapolated:
    """The finest level, of which changes say no more than about how far it is off."""
    return Extrapolated(finest, None, UNCLEAR * off, LARGEST_UNCLEAR * largest, remark)


def _sum_of_changes(shrink: float, cosine: float) -> float:
    """The expected length of the sum of all changes to come, over that of the last.

    Each is ``shrink`` times as long as the one before, and has the same cosine with it: those of i and j have its
    power |i - j|, as if directions were forgotten step by step.
    """
    turn = shrink * cosine
    return shrink * math.sqrt((1.0 + turn) / ((1.0 - shrink**2) * (1.0 - turn)))


def _weight(order: float, sizes: Sequence[float]) -> float:
    """The error of the last level over its change from the last but one."""
    return 1.0 / ((sizes[-2] / sizes[-1]) ** order - 1.0)


def observed_order(ratio: float, sizes: Sequence[float]) -> float | None:
    """The order at which differences of three levels have a ratio, at most ``MOST_ORDER``.

    Args:
        ratio: the first difference over the second.
        sizes: h_1 > h_2 > h_3.

    Returns:
        The order, or ``None`` if it is less than ``LEAST_ORDER``.
    """

    def expected(p: float) -> float:
        return (sizes[0] ** p - sizes[1] ** p) / (sizes[1] ** p - sizes[2] ** p)

    if ratio < expected(LEAST_ORDER):
        return None
    if ratio > expected(MOST_ORDER):
        return MOST_ORDER
    low, high = LEAST_ORDER, MOST_ORDER
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if expected(middle) < ratio else (low, middle)
    return 0.5 * (low + high)


def order_text(order: float) -> str:
    """An observed order for people; none beyond the one up to which they are told apart is claimed."""
    return f"{order:.1f}" if order < MOST_ORDER else f"{MOST_ORDER:.0f} or more"


def norms(field: np.ndarray) -> tuple[float, float]:
    """The root mean square and the largest length of vectors in the last axis."""
    squares = (field**2).sum(axis=-1)
    return float(np.sqrt(squares.mean())), float(np.sqrt(squares.max()))


def _rms(field: np.ndarray) -> float:
    return norms(field)[0]


def _most(field: np.ndarray) -> float:
    return norms(field)[1]
