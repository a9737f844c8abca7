"""Conversions among the elastic moduli of an isotropic solid."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from warpfem.errors import MaterialError

Parameter: TypeAlias = float | np.ndarray
"""One value, or one value per cell as an array of shape (cell_count,)."""


@dataclass(frozen=True, eq=False)
class ElasticModuli:
    """The moduli of an isotropic linearly elastic solid, each a scalar or an array (cell_count,).

    Attributes:
        E: Young's modulus [Pa], > 0.
        nu: Poisson's ratio, in (-1, 0.5).
        K: bulk modulus of the solid [Pa], > 0: lam + 2/3 mu.
        lam: Lamé's first parameter [Pa].
        mu: Lamé's second parameter, the shear modulus [Pa], > 0.
        K_plane_strain: bulk modulus of plane strain [Pa]: lam + mu.
    """

    E: Parameter
    nu: Parameter
    K: Parameter
    lam: Parameter
    mu: Parameter
    K_plane_strain: Parameter

    @property
    def p_wave(self) -> Parameter:
        """P-wave modulus lam + 2 mu [Pa]."""
        return self.lam + 2.0 * self.mu


def elastic_moduli(
    *,
    E: Parameter | None = None,
    nu: Parameter | None = None,
    K: Parameter | None = None,
    lam: Parameter | None = None,
    mu: Parameter | None = None,
    K_plane_strain: Parameter | None = None,
) -> ElasticModuli:
    """Returns all moduli from any two (Bonet and Wood 2008, appendix; Slaughter 2002, table 5.1).

    The pair (E, K_plane_strain) has two solutions for nu < 0; the one with nu >= -0.25 is returned.

    Raises:
        MaterialError: unless exactly two are given, both are finite and describe a stable solid
            (mu > 0 and K > 0, which is nu in (-1, 0.5) and E > 0).
    """
    given = {
        name: _values(name, value)
        for name, value in dict(E=E, nu=nu, K=K, lam=lam, mu=mu, K_plane_strain=K_plane_strain).items()
        if value is not None
    }
    if len(given) != 2:
        names = ", ".join(given) or "none"
        raise MaterialError(
            f"give exactly two of E, nu, K, lam, mu, K_plane_strain (got {names}), for example E=1e5, nu=0.45"
        )
    for name, value in given.items():
        positive = name not in ("nu", "lam")
        bad = ~np.isfinite(value) | (positive & (value <= 0.0))
        if name == "nu":
            bad |= (value <= -1.0) | (value >= 0.5)
        if bad.any():
            domain = "in (-1, 0.5)" if name == "nu" else "finite and > 0" if positive else "finite"
            raise MaterialError(f"{name} must be {domain}: {_offender(value, bad)}")
    first, second = given
    a, b = given[first], given[second]
    if a.ndim == b.ndim == 1 and len(a) != len(b):
        raise MaterialError(f"{first} is given for {len(a)} cells but {second} for {len(b)}")
    with np.errstate(all="ignore"):
        shear, first_lame = _lame_parameters(first, a, second, b)
        bulk = first_lame + 2.0 / 3.0 * shear
        bad = ~(np.isfinite(shear) & np.isfinite(first_lame) & (shear > 0.0) & (bulk > 0.0))
    if bad.any():
        pair = np.broadcast_arrays(a, b)
        where = "" if bad.ndim == 0 else f" in cell {int(np.argmax(bad))} ({int(bad.sum())} in all)"
        shown = ", ".join(f"{name}={value.flat[np.argmax(bad)]:g}" for name, value in zip(given, pair, strict=True))
        raise MaterialError(f"no stable solid has {shown}{where}: mu > 0, K > 0 and nu in (-1, 0.5) must hold")
    young = 9.0 * bulk * shear / (3.0 * bulk + shear)
    poisson = first_lame / (2.0 * (first_lame + shear))
    values = dict(E=young, nu=poisson, K=bulk, lam=first_lame, mu=shear, K_plane_strain=first_lame + shear)
    values.update(given)  # what the user gave comes back to the last bit
    return ElasticModuli(**{name: _plain(value) for name, value in values.items()})


def _lame_parameters(first: str, a: np.ndarray, second: str, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(mu, lam) from two moduli named in the order of :class:`ElasticModuli`."""
    match first, second:
        case "E", "nu":
            return a / (2.0 * (1.0 + b)), a * b / ((1.0 + b) * (1.0 - 2.0 * b))
        case "E", "K":
            mu = 3.0 * b * a / (9.0 * b - a)
            return mu, b - 2.0 / 3.0 * mu
        case "E", "lam":
            root = np.sqrt(a * a + 9.0 * b * b + 2.0 * a * b)
            excess = 3.0 * b - a  # the two forms are equal: each is free of cancellation on one side
            return np.where(excess > 0.0, 2.0 * a * b / (excess + root), (root - excess) / 4.0), b
        case "E", "mu":
            return b, b * (a - 2.0 * b) / (3.0 * b - a)
        case "E", "K_plane_strain":
            mu = 2.0 * a / (3.0 + np.sqrt(9.0 - 4.0 * a / b))
            return mu, b - mu
        case "nu", "K":
            return 1.5 * b * (1.0 - 2.0 * a) / (1.0 + a), 3.0 * b * a / (1.0 + a)
        case "nu", "lam":
            return b * (1.0 - 2.0 * a) / (2.0 * a), b
        case "nu", "mu":
            return b, 2.0 * b * a / (1.0 - 2.0 * a)
        case "nu", "K_plane_strain":
            return b * (1.0 - 2.0 * a), 2.0 * b * a
        case "K", "lam":
            return 1.5 * (a - b), b
        case "K", "mu":
            return b, a - 2.0 / 3.0 * b
        case "K", "K_plane_strain":
            mu = 3.0 * (b - a)
            return mu, b - mu
        case "lam", "mu":
            return b, a
        case "lam", "K_plane_strain":
            return b - a, a
        case _:  # mu, K_plane_strain
            return a, b - a


def _values(name: str, value: Parameter) -> np.ndarray:
    try:
        array = np.array(value, dtype=np.float64)  # a copy: what the caller does to theirs later has no effect
    except (TypeError, ValueError, OverflowError):
        raise MaterialError(f"{name} must be a number or one number per cell, not {value!r}") from None
    if array.ndim > 1 or not array.size:
        raise MaterialError(f"{name} must be a number or one number per cell, not an array of shape {array.shape}")
    return array


def _offender(value: np.ndarray, bad: np.ndarray) -> str:
    if value.ndim == 0:
        return f"got {float(value):g}"
    return f"cell {int(np.argmax(bad))} has {value.flat[np.argmax(bad)]:g} ({int(bad.sum())} in all)"


def _plain(value: np.ndarray) -> Parameter:
    return float(value) if np.ndim(value) == 0 else value
