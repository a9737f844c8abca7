"""The choice of linear solvers, their answers against NumPy's, and how long their set-up is kept."""

from dataclasses import replace

import numpy as np
import pytest
import warp as wp

from warpfem.boundary import Pin, Plane
from warpfem.errors import SceneError
from warpfem.linear import METHODS, LinearSolver, LinearStatus, TangentOperator, tangent_operator
from warpfem.linear import solver as choice
from warpfem.materials import NeoHookean, StableNeoHookean
from warpfem.mesh import Mesh
from warpfem.model import Model
from warpfem.scene import Body, Scene
from warpfem.solvers import BackwardEuler
from warpfem.solvers.static import StaticEquilibrium

PACKAGES = {"cholesky": "pypardiso", "multigrid": "pyamg"}
methods = pytest.mark.parametrize("method", METHODS[1:])


def strip(dtype: str = "float64", nu: float = 0.3, cells=(24, 6), size=(4.0, 1.0), **options) -> Model:
    """A block of 2D, held at its left side, that has sunk into a floor."""
    body = Body("strip", Mesh.rectangle(size, cells), NeoHookean(1e5, nu), supports=[Pin("left")], **options)
    floor = Plane((0.0, 0.02), (0.0, 1.0))
    return Model(Scene([body], BackwardEuler(), obstacles=[floor]), device="cpu", dtype=dtype)


def tangent(model: Model, size: float = 0.0, weight: float = 0.0) -> TangentOperator:
    """That of a state whose points are shaken by ``size``."""
    operator = tangent_operator(model, "assembled")
    state = model.state()
    state.assign(displacement=size * np.random.default_rng(1).uniform(-1, 1, model.rest_points.shape))
    model.supports.hold(state.u, state.v)
    operator.linearize(state.u, weight, precondition=True)
    return operator


def dense(operator: TangentOperator) -> np.ndarray:
    model = operator.model
    columns, out = [], model.zeros()
    for column in np.eye(model.rest_points.size).reshape(-1, *model.rest_points.shape):
        operator.apply(wp.array(column, dtype=model.types.vector, device="cpu"), out)
        columns.append(out.numpy().astype(np.float64).ravel())
    return np.stack(columns, axis=1)


def force(model: Model) -> wp.array:
    """Random, and zero where held."""
    b = wp.array(np.random.default_rng(2).normal(size=model.rest_points.shape), dtype=model.types.vector, device="cpu")
    model.supports.project(b)
    return b


def solved(solver: LinearSolver, tolerance: float = 1e-10, max_iterations: int = 5000):
    """(x, result) for a random force."""
    model = solver.operator.model
    x = model.zeros()
    x.fill_(np.nan)
    result = solver.solve(force(model), x, tolerance=tolerance, max_iterations=max_iterations)
    return x.numpy().astype(np.float64), result


@methods
@pytest.mark.parametrize(
    ("dtype", "element"), [("float64", "linear"), ("float32", "linear"), ("float64", "averaged")], ids=str
)
def test_each_method_finds_the_solution_of_the_dense_matrix(method, dtype, element):
    """With contact, with components held, and with the couplings of averaged cells."""
    if method in PACKAGES:
        pytest.importorskip(PACKAGES[method])
    model = strip(dtype, element=element)
    operator = tangent(model, 0.01)
    x, result = solved(LinearSolver(operator, method, static=True), 1e-10 if dtype == "float64" else 1e-5)
    assert result.status is LinearStatus.CONVERGED
    A = dense(operator)
    held = np.repeat(model.rest_points[:, 0] == 0.0, 2)
    A[held], A[:, held] = 0.0, 0.0
    A[held, held] = 1.0
    expected = np.linalg.solve(A, force(model).numpy().astype(np.float64).ravel()).reshape(x.shape)
    accuracy = 1e-8 if dtype == "float64" else 3e-3
    np.testing.assert_allclose(x, expected, atol=accuracy * np.abs(expected).max())
    if method == "cholesky":
        assert result.iterations <= (1 if dtype == "float64" else 3)
    elif method == "multigrid":
        assert result.iterations < 40


def test_the_true_residual_is_reported():
    """Where float32 cannot reach the tolerance, whatever the recursion of conjugate gradients says."""
    model = strip("float32", cells=(240, 4), size=(60.0, 1.0))
    operator = tangent(model)
    x, result = solved(LinearSolver(operator, "conjugate_gradients", static=True), 1e-5, 20_000)
    assert result.status is LinearStatus.ROUNDED
    own = operator.assembly
    rows = np.repeat(np.arange(model.point_count), np.diff(own.pattern.row_starts))
    product = np.zeros_like(x)
    np.add.at(product, rows, np.einsum("kij,kj->ki", own.blocks.numpy().astype(np.float64), x[own.pattern.columns]))
    b = force(model).numpy().astype(np.float64)
    residual = np.linalg.norm(b - product) / np.linalg.norm(b)
    assert result.residual == pytest.approx(residual, rel=1e-3)
    assert residual > 1e-5


# ---- assembly


def test_the_assembled_matrix_is_the_sum_of_the_cells():
    model = strip(cells=(5, 3))
    operator = tangent_operator(model, "assembled", external=False)
    operator.linearize(model.zeros(), 0.0)
    n = model.rest_points.size
    expected = np.zeros((n, n))
    for block, stiffness in zip(model.blocks, model.element_stiffness(), strict=True):
        unknowns = (block.host_cells[:, :, None] * 2 + np.arange(2)).reshape(block.count, -1)
        for own, K in zip(unknowns, stiffness.reshape(block.count, 6, 6), strict=True):
            expected[np.ix_(own, own)] += K
    np.testing.assert_allclose(dense(operator), expected, atol=1e-14 * np.abs(expected).max())


def test_the_assembled_matrix_is_symmetric_to_the_last_bit():
    A = dense(tangent(strip("float32"), 0.02))
    assert np.array_equal(A, A.T)


# ---- choice


@pytest.mark.parametrize(
    ("static", "nu", "most", "first", "then"),
    [
        (True, 0.3, 10**6, "cholesky", None),
        (True, 0.3, 10, "multigrid", None),
        (True, 0.49, 10, "cholesky", None),
        (False, 0.3, 10**6, "conjugate_gradients", "cholesky"),
        (False, 0.3, 10, "conjugate_gradients", "multigrid"),
    ],
)
def test_the_choice_follows_size_inertia_and_incompressibility(monkeypatch, static, nu, most, first, then):
    monkeypatch.setattr(choice, "find_spec", lambda name: True)
    monkeypatch.setitem(choice.MOST_FACTORED, 2, most)
    monkeypatch.setattr(choice, "SMALL", 0)
    chosen = choice.choose(strip(nu=nu), "auto", assembled=True, static=static)
    assert (chosen.first, chosen.then) == (first, then)
    assert "350 unknowns in 2D" in chosen.reason


def test_small_equilibria_load_no_library_unless_they_are_hard(monkeypatch):
    monkeypatch.setattr(choice, "find_spec", lambda name: True)
    chosen = choice.choose(strip(), "auto", assembled=True, static=True)
    assert (chosen.first, chosen.then) == ("conjugate_gradients", "cholesky")


def test_without_the_packages_conjugate_gradients_are_left(monkeypatch):
    monkeypatch.setattr(choice, "find_spec", lambda name: None)
    chosen = choice.choose(strip(), "auto", assembled=True, static=True)
    assert (chosen.first, chosen.then) == ("conjugate_gradients", None)
    assert "pip install 'warpfem[solvers]'" in chosen.reason
    with pytest.raises(SceneError, match=r"'cholesky' needs pypardiso: pip install 'warpfem\[solvers\]'"):
        replace(BackwardEuler(), linear_solver="cholesky").stepper(strip())
    with pytest.raises(SceneError, match=r"'multigrid' needs pyamg"):
        StaticEquilibrium(linear_solver="multigrid").solve(strip(), strip().state())


def test_matrix_free_tangents_are_left_to_conjugate_gradients():
    assert choice.choose(strip(), "auto", assembled=False, static=True).first == "conjugate_gradients"
    with pytest.raises(SceneError, match="linear_solver='cholesky' needs differential='assembled'"):
        BackwardEuler(differential="closed", linear_solver="cholesky")
    with pytest.raises(SceneError, match=r"linear_solver must be 'auto', .* not 'direct'"):
        BackwardEuler(linear_solver="direct")


# ---- reuse


def counted(monkeypatch, solver: LinearSolver) -> list[int]:
    """A list that grows by 1 with each factor."""
    from warpfem.linear.factor import SparseFactor

    factors: list[int] = []
    update = SparseFactor.update
    monkeypatch.setattr(SparseFactor, "update", lambda self, shift=0.0: factors.append(1) or update(self, shift))
    return factors


def test_a_hard_system_makes_it_change_to_a_factor(monkeypatch):
    """Once iterations with block Jacobi have cost as much as one."""
    pytest.importorskip("pypardiso")
    solver = LinearSolver(tangent(strip(cells=(60, 6), size=(20.0, 1.0))), "auto", static=False)
    factors = counted(monkeypatch, solver)
    _, easy = solved(solver, 1e-2, max_iterations=50)
    assert (solver.method, factors) == ("conjugate_gradients", [])
    assert easy.iterations == 50
    x, result = solved(solver)
    assert (solver.method, factors) == ("cholesky", [1])
    assert choice.EASY["cholesky"] < result.iterations <= choice.EASY["cholesky"] + 2
    again, second = solved(solver)
    assert (factors, second.iterations) == ([1], 1)
    np.testing.assert_allclose(again, x, atol=1e-8 * np.abs(x).max())


def test_a_factor_is_kept_until_it_takes_too_many_iterations(monkeypatch):
    pytest.importorskip("pypardiso")
    model = strip()
    operator = tangent(model)
    solver = LinearSolver(operator, "cholesky", static=False)
    factors = counted(monkeypatch, solver)
    solved(solver)
    u = wp.array(1e-4 * model.rest_points, dtype=model.types.vector, device="cpu")
    operator.linearize(u, 0.0, precondition=True)
    _, near = solved(solver)
    assert factors == [1]
    assert 1 < near.iterations <= choice.PATIENCE["cholesky"]
    for expected in (2, 2):  # inertia that outweighs the stiffness at first, and then stays
        operator.linearize(u, 1e6, precondition=True)
        _, far = solved(solver)
        assert far.status is LinearStatus.CONVERGED
        assert len(factors) == expected
    assert far.iterations == 1


def test_a_factor_shows_that_the_tangent_is_not_positive_definite():
    """What comes back descends all the same; patches of averaged cells do not count."""
    pytest.importorskip("pypardiso")
    model = strip(element="averaged")
    operator = tangent(model)
    solver = LinearSolver(operator, "cholesky", static=True)
    assert solver.definite(0.0)
    squashed = model.rest_points * np.array([-0.5, 0.0])
    operator.linearize(wp.array(squashed, dtype=model.types.vector, device="cpu"), 0.0, precondition=True)
    assert np.linalg.eigvalsh(dense(operator))[0] < 0.0
    assert not solver.definite(0.0)
    x, result = solved(solver)
    assert result.status is LinearStatus.CURVATURE
    assert np.sum(x * force(model).numpy()) > 0.0


@pytest.mark.parametrize("element", ["linear", "averaged"])
def test_equilibria_do_not_depend_on_the_method(element):
    pytest.importorskip("pypardiso")
    found = []
    for method in ("conjugate_gradients", "cholesky"):
        body = Body(
            "strip",
            Mesh.rectangle((4.0, 1.0), (16, 4)),
            StableNeoHookean(1e5, 0.49),
            supports=[Pin("left")],
            element=element,
        )
        model = Model(Scene([body], BackwardEuler(), gravity=(0.0, -3.0)), device="cpu", dtype="float64")
        state = model.state()
        (last,) = StaticEquilibrium(tolerance=1e-9, linear_solver=method).increments(model, state)
        assert last.stable
        assert "as asked for" in last.linear_solver
        found.append(state.displacement)
    np.testing.assert_allclose(found[0], found[1], atol=1e-7 * np.abs(found[0]).max())


def test_a_step_does_not_depend_on_the_factors_before_it():
    """So that a run that is taken up again has the same bits."""
    pytest.importorskip("pypardiso")
    solver = BackwardEuler(linear_solver="cholesky")
    body = Body("strip", Mesh.rectangle((4.0, 1.0), (16, 4)), StableNeoHookean(1e5, 0.3), supports=[Pin("left")])
    model = Model(Scene([body], solver, gravity=(0.0, -9.8)), device="cpu")
    used, state = solver.stepper(model), model.state()
    for _ in range(3):
        used.step(state, 0.1)
    other = state.copy()
    used.step(state, 0.1)
    solver.stepper(model).step(other, 0.1)
    np.testing.assert_array_equal(state.displacement, other.displacement)


def test_a_factor_has_the_same_bits_whatever_the_number_of_threads():
    pypardiso = pytest.importorskip("pypardiso")
    operator = tangent(strip(cells=(60, 30)))
    library = pypardiso.PyPardisoSolver().libmkl
    found, before = [], library.MKL_Get_Max_Threads()
    for threads in (1, 2):
        library.MKL_Set_Num_Threads(threads)
        x, _ = solved(LinearSolver(operator, "cholesky", static=True))
        found.append(x)
    library.MKL_Set_Num_Threads(before)
    np.testing.assert_array_equal(*found)


def test_what_was_chosen_is_told():
    from warpfem.explain import explain

    body = Body("strip", Mesh.rectangle((4.0, 1.0), (16, 4)), StableNeoHookean(1e5, 0.3), supports=[Pin("left")])
    told = str(explain(Scene([body], BackwardEuler(), gravity=(0.0, -9.8), frames=2), device="cpu"))
    assert "linear systems: conjugate gradients with block Jacobi (" in told
    assert "iteration of conjugate gradients (a graph of the kernels)" in told
