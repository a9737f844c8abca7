"""The verification suite in its quick form, and the parts that it is made of."""

import numpy as np
import pytest

pytest.importorskip("scipy", reason="the verification suite needs the extra 'bench'")
pytest.importorskip("skfem", reason="the verification suite needs the extra 'bench'")

from verification import report
from verification.cases import CASES
from verification.core import Case, Check, Table, at_most, between, orders, run_case
from verification.hyperelastic import STRESSES, lame, tangent
from verification.principal import CLOSED_FORMS, free_stretch, stretches
from verification.simplex import quadrature, shape_rates, shapes
from verification.spectral import box, graded, quadrilateral


@pytest.mark.parametrize("name", CASES)
def test_no_check_fails(name):
    outcome = run_case(CASES[name], quick=True)
    assert not outcome.failures, report.text(outcome)


# ---- the references


@pytest.mark.parametrize("dim", [1, 2, 3])
def test_quadrature_is_exact_to_degree_7(dim):
    b, w = quadrature(dim)
    factorial = np.cumprod([1.0, *range(1, 20)])
    exact = factorial[7] * factorial[dim] / factorial[7 + dim]  # of b_0^7 over a simplex of volume 1
    np.testing.assert_allclose(w @ b**7, np.full(dim + 1, exact), rtol=1e-13)
    np.testing.assert_allclose(b.sum(axis=1), 1.0, rtol=1e-15)


@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize("dim", [2, 3])
def test_shape_functions_and_their_rates(dim, order, rng):
    b = rng.dirichlet(np.ones(dim + 1), 4)
    np.testing.assert_allclose(shapes(b, order).sum(axis=1), 1.0, rtol=1e-14)
    for k in range(dim + 1):
        step = np.zeros(dim + 1)
        step[k] = 1e-6
        difference = (shapes(b + step, order) - shapes(b - step, order)) / 2e-6
        np.testing.assert_allclose(shape_rates(b, order)[:, :, k], difference, atol=1e-8)


def test_tangent_by_complex_steps(rng):
    F = np.eye(3) + 0.2 * rng.normal(size=(3, 3))
    direction = rng.normal(size=(3, 3))
    for stress in STRESSES.values():
        difference = (stress(F + 1e-6 * direction, 2.0, 3.0) - stress(F - 1e-6 * direction, 2.0, 3.0)) / 2e-6
        found = np.einsum("ijkl,kl->ij", tangent(stress, F, 2.0, 3.0), direction)
        np.testing.assert_allclose(found, difference, rtol=1e-6, atol=1e-8)


@pytest.mark.parametrize("name", CLOSED_FORMS)
def test_free_stretch_bears_no_stress(name):
    free = free_stretch(name, "uniaxial", 0.8, 1.0, 2.0)
    given, *others = stretches("uniaxial", 0.8, free)
    assert CLOSED_FORMS[name].principal((others[0], given, others[1]), 1.0, 2.0) == pytest.approx(0.0, abs=1e-12)


def test_free_stretches_are_those_of_stable_equilibria_alone():
    assert free_stretch("linear", "uniaxial", 4.0, *lame(1.0, 0.3)) == pytest.approx(0.1)
    assert free_stretch("linear", "uniaxial", 5.0, *lame(1.0, 0.3)) is None  # it would be -0.2
    assert free_stretch("fixed_corotated", "uniaxial", 3.0, *lame(1.0, 0.3)) is not None
    assert free_stretch("fixed_corotated", "uniaxial", 10.0, *lame(1.0, 0.3)) is None


def test_spectral_elements_solve_a_polynomial_exactly():
    # u = (xy, 0): sigma = [[(2 mu + lam) y, mu x], [mu x, lam y]] and Div sigma = (0, mu + lam)
    mu, lam = 1.0, 2.0
    grid = box((2.0, 1.0), [graded(2), graded(2)], 3)
    inner = (~np.isclose(grid.points, 0.0) & ~np.isclose(grid.points, (2.0, 1.0))).all(axis=1)
    exact = np.stack([grid.points.prod(axis=1), np.zeros(len(grid.points))], axis=1)
    force, K = grid.force_and_stiffness(exact, STRESSES["linear"], mu, lam)
    load = grid.body_load((0.0, -(mu + lam)))
    np.testing.assert_allclose((force - load)[inner], 0.0, atol=1e-12)
    np.testing.assert_allclose((K @ exact.ravel()).reshape(exact.shape), force, atol=1e-12)


def test_spectral_elements_on_a_bilinear_map():
    grid = quadrilateral([(0, 0), (4, 4), (4, 5), (0, 3)], [graded(2), graded(2, "left")], 4)
    assert grid.weights.sum() == pytest.approx(0.5 * (3.0 + 1.0) * 4.0)
    field = grid.points @ np.array([[1.0, 2.0], [3.0, 4.0]])
    np.testing.assert_allclose(grid.value(field, (1.0, 0.5)), (4.0 + 3.0 * 4.5, 8.0 + 4.0 * 4.5), rtol=1e-13)
    np.testing.assert_allclose(grid.side_load(0, -1, (0.0, 3.0)).sum(axis=0), (0.0, 3.0), atol=1e-12)


# ---- the report


def test_checks_refuse_what_is_no_number():
    assert at_most("a", 1.0, 1.0).passed
    assert not at_most("a", 1.1, 1.0).passed
    assert not at_most("a", float("nan"), 1.0).passed
    assert not between("a", float("nan"), 0.0, 1.0).passed
    assert between("a", 1.0, 0.0, 1.0).passed
    assert orders([1.0, 0.5, 0.25], [8.0, 2.0, 1.0]) == pytest.approx([2.0, 1.0])


def test_a_case_that_crashes_or_checks_nothing_fails():
    def crash(quick):
        yield at_most("a", 0.0, 1.0)
        raise ZeroDivisionError("no")

    def case(run):
        return Case("name", "A title", "what", "reference", "criterion", run)

    crashed = run_case(case(crash), quick=True)
    assert len(crashed.checks) == 2
    assert "ZeroDivisionError" in crashed.failures[0].measured
    assert run_case(case(lambda quick: iter(())), quick=True).failures
    fine = run_case(case(lambda quick: iter([Table("t", ["a"], [["1 | 2"]]), Check("c", "1", "2", True)])), quick=True)
    page = report.markdown([fine, crashed], quick=False)
    assert "| [name](#a-title) | A title | 1 | 1 |" in page
    assert r"1 \| 2" in page
    assert "| c | 1 | 2 | PASS |" in page
    assert "FAIL the rest of the case" in report.text(crashed)
