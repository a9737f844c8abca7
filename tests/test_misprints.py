"""The checks that docs/misprints.md refers to."""

import numpy as np
import pytest
from helpers import Samples, irregular_mesh, model_of

from warpfem.errors import MaterialError
from warpfem.materials import FixedCorotated, LinearElasticity, NeoHookean
from warpfem.moduli import elastic_moduli


def test_the_shear_modulus_is_mu_and_not_lam():
    """A simple shear gamma bears the stress mu gamma = E/(2 (1 + nu)) gamma, whatever lam is."""
    gamma = 1e-3
    F = np.eye(3) + gamma * np.outer([1.0, 0.0, 0.0], [0.0, 1.0, 0.0])
    for nu in (-0.3, 0.2, 0.45):
        material = LinearElasticity(E=2.0, nu=nu)
        assert Samples(material, F[None]).stress[0, 0, 1] == pytest.approx(2.0 / (2.0 * (1.0 + nu)) * gamma, rel=1e-12)
    for lam in (0.5, 50.0):
        stress = Samples(LinearElasticity(mu=3.0, lam=lam), F[None]).stress[0]
        assert stress[0, 1] == pytest.approx(3.0 * gamma, rel=1e-12)


def neo_hookean_energy(F: np.ndarray, mu: float, lam: float) -> float:
    log_j = np.log(np.linalg.det(F))
    return 0.5 * mu * (np.sum(F * F) - 3.0) - mu * log_j + 0.5 * lam * log_j**2


def test_the_neo_hookean_stress_has_inverse_transposes_in_both_terms(rng):
    mu, lam, h = 2.0, 3.0, 1e-6
    F = np.eye(3) + 0.3 * rng.normal(size=(3, 3))
    derivative = np.empty((3, 3))
    for i, j in np.ndindex(3, 3):
        step = np.zeros((3, 3))
        step[i, j] = h
        ahead, behind = (neo_hookean_energy(F + s * step, mu, lam) for s in (1.0, -1.0))
        derivative[i, j] = (ahead - behind) / (2.0 * h)
    G = np.linalg.inv(F).T
    pressure = lam * np.log(np.linalg.det(F))
    np.testing.assert_allclose(derivative, mu * (F - G) + pressure * G, atol=1e-8)
    np.testing.assert_allclose(Samples(NeoHookean(mu=mu, lam=lam), F[None]).stress[0], derivative, atol=1e-8)
    for wrong in (mu * (F - F.T) + pressure * G, mu * (F - G) + pressure * F.T, mu * (F - G.T) + pressure * G.T):
        assert np.abs(derivative - wrong).max() > 0.1


@pytest.mark.parametrize("dim", [2, 3])
def test_the_force_differential_is_minus_the_second_derivative_of_the_total_energy(dim, rng):
    """p . df = -d²U(u + h p)/dh², with the U that weights the density psi by the rest volumes."""
    model = model_of(NeoHookean(E=2.0, nu=0.3), irregular_mesh(dim))
    state = model.state()
    u = 0.02 * rng.normal(size=model.rest_points.shape)
    p = rng.normal(size=u.shape)
    state.assign(displacement=u)
    df = model.force_differential(state, p)
    volumes = model.scene.bodies[0].mesh.cell_volumes

    def total_energy(h: float) -> float:
        state.assign(displacement=u + h * p)
        return float(volumes @ model.energy_densities(state))

    h = 1e-4
    second = (total_energy(h) - 2.0 * total_energy(0.0) + total_energy(-h)) / h**2
    assert second > 0.0
    assert np.sum(p * df) == pytest.approx(-second, rel=1e-5)


def test_poissons_ratio_may_be_negative():
    for nu in (-0.99, -0.5, 0.0, 0.49):
        moduli = elastic_moduli(E=1.0, nu=nu)
        assert moduli.mu > 0.0 and moduli.K > 0.0  # which is all that stability asks
    for nu in (-1.0, 0.5):
        with pytest.raises(MaterialError, match="nu"):
            elastic_moduli(E=1.0, nu=nu)
    # stretched by 1 %, a solid of nu = -0.5 has no lateral stress where it is 0.5 % wider
    F = np.diag([1.01, 1.005, 1.005])
    P = Samples(LinearElasticity(E=1.0, nu=-0.5), F[None]).stress[0]
    np.testing.assert_allclose(P, np.diag([0.01, 0.0, 0.0]), atol=1e-15)
    with pytest.warns(UserWarning, match="nu"):
        FixedCorotated(E=1.0, nu=-0.5)  # but this energy has no lower bound then


def test_a_density_weighted_by_the_deformed_area_gives_forces_without_a_potential(rng):
    """The Jacobian of -A dpsi/dx is symmetric if A is the rest area, and is not if A is the deformed one."""
    rest = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    x = rest + 0.2 * rng.normal(size=(3, 2))
    h = 1e-5

    def area(x: np.ndarray) -> float:
        return 0.5 * float(np.linalg.det(x[1:] - x[0]))

    def density(x: np.ndarray) -> float:
        F = np.eye(3)
        F[:2, :2] = (x[1:] - x[0]).T
        return neo_hookean_energy(F, 1.0, 2.0)

    def differences(function, x: np.ndarray) -> np.ndarray:
        steps = h * np.eye(6).reshape(6, 3, 2)
        return np.array([(function(x + s) - function(x - s)) / (2.0 * h) for s in steps])

    for weight, symmetric in ((lambda x: area(rest), True), (area, False)):
        jacobian = differences(lambda x, weight=weight: -weight(x) * differences(density, x), x)
        skew = np.abs(jacobian - jacobian.T).max() / np.abs(jacobian).max()
        assert (skew < 1e-4) == symmetric, skew
