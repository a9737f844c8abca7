"""Elastic moduli: all pairs lead to the same solid, and what describes no solid is refused."""

import dataclasses
import itertools
from typing import Any

import numpy as np
import pytest

from warpfem.errors import MaterialError
from warpfem.moduli import elastic_moduli

NAMES = ("E", "nu", "K", "lam", "mu", "K_plane_strain")
PAIRS = list(itertools.combinations(NAMES, 2))
pairs = pytest.mark.parametrize("pair", PAIRS, ids="-".join)

NU = np.concatenate([np.linspace(-0.9, 0.49, 60), [0.499]])
NU = NU[np.abs(NU) > 1e-3]  # nu = 0 has a test of its own: with lam = 0 it does not determine E


def textbook(E: float, nu: np.ndarray | float) -> dict[str, Any]:
    """All moduli, from Hooke's law in terms of E and nu."""
    return {
        "E": E + 0.0 * nu,
        "nu": nu,
        "K": E / (3.0 * (1.0 - 2.0 * nu)),
        "lam": E * nu / ((1.0 + nu) * (1.0 - 2.0 * nu)),
        "mu": E / (2.0 * (1.0 + nu)),
        "K_plane_strain": E / (2.0 * (1.0 + nu) * (1.0 - 2.0 * nu)),
    }


def sensitivity(nu: np.ndarray) -> dict[str, np.ndarray]:
    """d(log modulus) / d(log E, nu), (n, 2), by differences of step h."""
    h = 1e-6
    ahead, behind = textbook(1.0, nu + h), textbook(1.0, nu - h)
    unit = {name: np.ones_like(nu) for name in NAMES} | {"nu": np.zeros_like(nu)}
    here = textbook(1.0, nu)
    return {n: np.stack([unit[n], (ahead[n] - behind[n]) / (2.0 * h * here[n])], axis=-1) for n in NAMES}


@pairs
def test_any_two_give_all(pair):
    """To a few roundings of the two that are given, and of mu and lam, which they are turned into."""
    nu = NU[NU > -0.2] if pair == ("E", "K_plane_strain") else NU
    expected = textbook(2.5e6, nu)
    moduli = dataclasses.asdict(elastic_moduli(**{name: expected[name] for name in pair}))
    rates = sensitivity(nu)
    lame = np.stack([rates["mu"], rates["lam"]], axis=1)
    lame_condition = 1.0 + np.abs(lame @ np.linalg.inv(np.stack([rates[name] for name in pair], axis=1))).sum(axis=2)
    for name in NAMES:
        condition = np.einsum("ni,ni->n", np.abs(rates[name][:, None] @ np.linalg.inv(lame))[:, 0], lame_condition)
        error = np.abs(moduli[name] / expected[name] - 1.0)
        assert (error < 4.0 * np.finfo(float).eps * (1.0 + condition)).all(), name


@pairs
def test_given_moduli_come_back_to_the_last_bit(pair):
    given = {name: textbook(3.3e5, 0.37)[name] for name in pair}
    moduli = elastic_moduli(**given)
    assert {name: getattr(moduli, name) for name in pair} == given
    assert all(type(getattr(moduli, name)) is float for name in NAMES)


@pytest.mark.parametrize("pair", [pair for pair in PAIRS if pair != ("nu", "lam")], ids="-".join)
def test_zero_poisson_ratio(pair):
    given = {name: value for name, value in textbook(2e5, 0.0).items() if name in pair}
    moduli = elastic_moduli(**given)
    assert pytest.approx(2e5, rel=1e-14) == moduli.E
    assert moduli.mu == pytest.approx(1e5, rel=1e-14)
    assert moduli.nu == pytest.approx(0.0, abs=1e-15)
    assert moduli.p_wave == pytest.approx(2e5, rel=1e-14)


def test_plane_strain_bulk_modulus_is_area_stiffness():
    """An equal stretch eps in the plane needs the stress 2 K_plane_strain eps."""
    moduli = elastic_moduli(E=1e5, nu=0.3)
    eps = np.diag([1.0, 1.0, 0.0])
    sigma = 2.0 * moduli.mu * eps + moduli.lam * np.trace(eps) * np.eye(3)
    assert sigma[0, 0] == pytest.approx(2.0 * moduli.K_plane_strain)


def test_ambiguous_pair_takes_the_larger_nu():
    """nu = -0.1 and the nu with the same E / K_plane_strain = 2 (1 + nu)(1 - 2 nu), -0.4, are told apart."""
    for nu in (-0.1, -0.4):
        given = textbook(1e5, nu)
        moduli = elastic_moduli(E=1e5, K_plane_strain=given["K_plane_strain"])
        assert moduli.nu == pytest.approx(-0.1)


def test_one_value_per_cell():
    young = np.array([1e5, 2e5, 4e5])
    moduli = elastic_moduli(E=young, nu=0.25)
    np.testing.assert_allclose(moduli.mu, young / 2.5, rtol=1e-15)
    assert moduli.nu == 0.25
    both = elastic_moduli(E=young, nu=np.array([0.0, 0.25, 0.4]))
    np.testing.assert_allclose(both.K, young / (3.0 * (1.0 - 2.0 * both.nu)), rtol=1e-14)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({}, r"exactly two .*\(got none\)"),
        ({"E": 1e5}, r"exactly two .*\(got E\)"),
        ({"E": 1e5, "nu": 0.3, "mu": 1e5}, r"exactly two .*\(got E, nu, mu\)"),
        ({"E": 0.0, "nu": 0.3}, "E must be finite and > 0: got 0"),
        ({"E": -1e5, "nu": 0.3}, "E must be finite and > 0: got -100000"),
        ({"E": np.inf, "nu": 0.3}, "E must be finite and > 0: got inf"),
        ({"E": 1e5, "nu": 0.5}, r"nu must be in \(-1, 0.5\): got 0.5"),
        ({"E": 1e5, "nu": -1.0}, r"nu must be in \(-1, 0.5\): got -1"),
        ({"E": 1e5, "nu": np.nan}, r"nu must be in \(-1, 0.5\): got nan"),
        ({"mu": 0.0, "lam": 1e5}, "mu must be finite and > 0"),
        ({"mu": 1e5, "lam": np.nan}, "lam must be finite"),
        ({"K": -1.0, "mu": 1e5}, "K must be finite and > 0"),
        ({"lam": -0.7e5, "mu": 1e5}, r"no stable solid has lam=-70000, mu=100000: mu > 0, K > 0"),
        ({"E": 9.1e5, "K": 1e5}, "no stable solid has E=910000, K=100000"),
        ({"E": 3.1e5, "mu": 1e5}, "no stable solid has"),
        ({"E": 3e5, "K_plane_strain": 1e5}, "no stable solid has"),
        ({"nu": -0.2, "lam": 1e5}, "no stable solid has"),
        ({"nu": 0.0, "lam": 0.0}, "no stable solid has"),
        ({"K": 1e5, "lam": 1e5}, "no stable solid has"),
        ({"K": 2e5, "K_plane_strain": 1e5}, "no stable solid has"),
        ({"mu": 4e5, "K_plane_strain": 1e5}, "no stable solid has"),
        ({"E": np.array([1e5, -1.0, 0.0]), "nu": 0.3}, r"E must be finite and > 0: cell 1 has -1 \(2 in all\)"),
        (
            {"mu": 1e5, "lam": np.array([0.0, -1e5])},
            r"has lam=-100000, mu=100000 in cell 1 \(1 in all\)",
        ),
        ({"E": "stiff", "nu": 0.3}, "E must be a number or one number per cell, not 'stiff'"),
        ({"E": np.ones(2), "nu": np.full(3, 0.3)}, "E is given for 2 cells but nu for 3"),
        ({"E": np.ones((2, 2)), "nu": 0.3}, r"E must be a number or one number per cell, .* shape \(2, 2\)"),
    ],
)
def test_refuses_what_is_no_solid(given, message):
    with pytest.raises(MaterialError, match=message):
        elastic_moduli(**given)
