"""Tangent operators by three routes, and conjugate gradients, against dense matrices of NumPy."""

import functools

import numpy as np
import pytest
import warp as wp
from helpers import custom_neo_hookean, irregular_mesh, model_of

from warpfem.boundary import Pin, Plane, PrescribedMotion
from warpfem.errors import SimulationError
from warpfem.linear import (
    BlockJacobi,
    ConjugateGradients,
    LinearStatus,
    TangentOperator,
    operators,
    slices,
    tangent_operator,
)
from warpfem.linear.operators import operator_kernels
from warpfem.materials import (
    FixedCorotated,
    LinearElasticity,
    NeoHookean,
    StableNeoHookean,
    StVenantKirchhoff,
)
from warpfem.mesh import Mesh
from warpfem.model import Model, State
from warpfem.scene import Body, Scene
from warpfem.solvers import SymplecticEuler

ROUTES = ("assembled", "closed", "tape")
routes = pytest.mark.parametrize("route", ROUTES)
dims = pytest.mark.parametrize("dim", [pytest.param(2, id="2D"), pytest.param(3, id="3D")])
settings = pytest.mark.parametrize(
    ("dim", "dtype"), [(2, "float64"), (3, "float64"), (2, "float32")], ids=lambda value: str(value)
)
E, NU = 1e5, 0.35
ALL = (LinearElasticity, StVenantKirchhoff, NeoHookean, FixedCorotated, StableNeoHookean)
SOME = (NeoHookean, StableNeoHookean)


@functools.cache
def bodies_of(dim: int, dtype: str, materials: tuple, **scene) -> Model:
    """One irregular body for each material, held at its left side."""
    bodies = [
        Body(m.__name__, irregular_mesh(dim, seed), m(E, NU), supports=[Pin("left")])
        for seed, m in enumerate(materials)
    ]
    return Model(Scene(bodies, SymplecticEuler(), **scene), device="cpu", dtype=dtype)


def shaken(model: Model, size: float = 0.05) -> State:
    state = model.state()
    state.assign(displacement=size * np.random.default_rng(1).uniform(-1, 1, model.rest_points.shape))
    return state


def squashed(model: Model) -> State:
    """So far compressed along x that some stiffness is negative."""
    state = model.state()
    state.assign(displacement=model.rest_points * np.array([-0.7, 0.1, 0.1])[: model.dim])
    return state


def product(operator: TangentOperator, p: np.ndarray) -> np.ndarray:
    model = operator.model
    out = model.zeros()
    out.fill_(np.nan)
    operator.apply(wp.array(p, dtype=model.types.vector, device=model.device), out)
    return out.numpy().astype(np.float64)


def dense(operator: TangentOperator) -> np.ndarray:
    """A, column by column."""
    shape = operator.model.rest_points.shape
    columns = np.eye(shape[0] * shape[1]).reshape(-1, *shape)
    return np.stack([product(operator, column).ravel() for column in columns], axis=1)


def free_components(model: Model) -> np.ndarray:
    """Indices into the flattened vectors of what no support holds."""
    free = np.ones(model.rest_points.shape, dtype=bool)
    if model.supports is not None:
        free[model.supports.host_points] = model.supports.held.numpy() == 0.0
    return np.flatnonzero(free)


# ---- operators


@pytest.mark.parametrize(
    ("dim", "dtype", "materials"),
    [
        pytest.param(3, "float64", ALL, id="3D-float64"),
        pytest.param(2, "float32", ALL, id="2D-float32"),
        pytest.param(2, "float64", ALL, id="2D-float64", marks=pytest.mark.slow),
        pytest.param(3, "float32", ALL, id="3D-float32", marks=pytest.mark.slow),
        pytest.param(2, "float64", SOME, id="2D-float64-some"),
    ],
)
def test_three_routes_agree(dim, dtype, materials, rng):
    """To rounding, for bodies of all materials with a written P together."""
    model = bodies_of(dim, dtype, materials)
    state = shaken(model)
    p = rng.normal(size=model.rest_points.shape)
    assembled, closed, tape = (model.force_differential(state, p, route) for route in ROUTES)
    rounding = 30.0 * model.types.epsilon * np.abs(closed).max()
    np.testing.assert_allclose(assembled, closed, atol=rounding)
    np.testing.assert_allclose(tape, closed, atol=rounding)


@dims
def test_three_routes_agree_for_psi_alone(dim, rng):
    """To its central differences. Warp cannot differentiate its stress: the tape takes them instead."""
    moduli = NeoHookean(E, NU).moduli
    mesh = irregular_mesh(dim)
    custom = custom_neo_hookean(moduli.mu, moduli.lam)
    models = []
    for material in (custom, NeoHookean(E, NU)):  # beside a body that the tape does differentiate
        bodies = [Body("a", mesh, material), Body("b", mesh, StableNeoHookean(E, NU))]
        models.append(Model(Scene(bodies, SymplecticEuler()), device="cpu", dtype="float64"))
    p = rng.normal(size=models[0].rest_points.shape)
    expected = models[1].force_differential(shaken(models[1]), p)
    for route in ROUTES:
        actual = models[0].force_differential(shaken(models[0]), p, route)
        np.testing.assert_allclose(actual, expected, atol=1e-8 * np.abs(expected).max())


@routes
@dims
def test_operator_is_symmetric_and_has_the_mass(dim, route):
    model = bodies_of(dim, "float64", SOME)
    state = shaken(model)
    operator = tangent_operator(model, route, external=False)
    operator.linearize(state.u, mass_weight=0.0)
    K = dense(operator)
    assert np.abs(K - K.T).max() < 1e-13 * np.abs(K).max()
    weight = 1e3
    operator.linearize(state.u, mass_weight=weight)
    mass = np.repeat(model.lumped_mass, dim)
    np.testing.assert_allclose(dense(operator), K + weight * np.diag(mass), atol=1e-13 * np.abs(K).max())


def test_tape_may_be_linearized_again():
    """One tape for all states: the second tangent is not that of the first."""
    model = bodies_of(2, "float64", SOME)
    p = np.random.default_rng(1).normal(size=model.rest_points.shape)
    operator = tangent_operator(model, "tape", external=False)
    for size in (0.0, 0.05):
        state = shaken(model, size)
        operator.linearize(state.u, mass_weight=0.0)
        expected = -model.force_differential(state, p)
        np.testing.assert_allclose(product(operator, p), expected, atol=1e-13 * np.abs(expected).max())
        np.testing.assert_allclose(product(operator, p), expected, atol=1e-13 * np.abs(expected).max())


@dims
@pytest.mark.parametrize("hessian", ["absolute", "clamped"])
def test_filtered_operators_agree_and_are_positive(dim, hessian):
    model = bodies_of(dim, "float64", SOME)
    state = squashed(model)
    matrices = []
    for route in ("assembled", "closed"):
        operator = tangent_operator(model, route, external=False)
        operator.linearize(state.u, mass_weight=0.0, hessian=hessian)
        matrices.append(dense(operator))
    assembled, closed = matrices
    size = np.abs(assembled).max()
    assert np.abs(assembled - closed).max() < 1e-13 * size
    assert np.linalg.eigvalsh(assembled)[0] > -1e-12 * size
    exact = tangent_operator(model, "assembled", external=False)
    exact.linearize(state.u, mass_weight=0.0)
    assert np.linalg.eigvalsh(dense(exact))[0] < -1e-3 * size  # there was something to filter


def test_tape_cannot_be_filtered():
    model = bodies_of(2, "float64", SOME)
    with pytest.raises(ValueError, match="hessian='exact'"):
        tangent_operator(model, "tape").linearize(model.zeros(), 0.0, hessian="absolute")


def test_unknown_route():
    with pytest.raises(SimulationError, match="'assembled', 'closed', 'tape', not 'dense'"):
        tangent_operator(bodies_of(2, "float64", SOME), "dense")  # type: ignore[arg-type]


@routes
def test_contact_belongs_to_the_operator(route, rng):
    """A p is the change of all forces, with a floor that the body has sunk into."""
    mesh = irregular_mesh(2)
    floor = Plane((0.0, 0.1), (0.1, 1.0))
    model = Model(Scene([Body("a", mesh, NeoHookean(E, NU))], SymplecticEuler(), obstacles=[floor]), dtype="float64")
    state = shaken(model)
    p = rng.normal(size=mesh.points.shape)
    forces = []
    for step in (1e-6, -1e-6):
        moved = model.state()
        moved.assign(displacement=state.displacement + step * p)
        out = model.zeros()
        model.force(moved.u, out)
        forces.append(out.numpy())
    expected = -(forces[0] - forces[1]) / 2e-6
    operator = tangent_operator(model, route)
    operator.linearize(state.u, mass_weight=0.0)
    np.testing.assert_allclose(product(operator, p), expected, atol=1e-6 * np.abs(expected).max())
    without = tangent_operator(model, route, external=False)
    without.linearize(state.u, mass_weight=0.0)
    assert np.abs(product(without, p) - expected).max() > 0.01 * np.abs(expected).max()


# ---- supports


def partly_held(dim: int) -> Model:
    """Points held in all, in one and in another component."""
    motion = PrescribedMotion("right", lambda X, t: X, axes=(0,))
    supports = [Pin("left"), Pin("bottom", axes=(1,)), motion]
    body = Body("a", irregular_mesh(dim), StableNeoHookean(E, NU), supports=supports)
    return Model(Scene([body], SymplecticEuler()), device="cpu", dtype="float64")


@routes
@dims
def test_held_components_stay_out(dim, route, rng):
    """For p and results that are zero where held, A is the part of the matrix that is free."""
    model = partly_held(dim)
    free = free_components(model)
    state = shaken(model)
    operator = tangent_operator(model, route)
    operator.linearize(state.u, mass_weight=10.0)
    p = np.zeros(model.rest_points.size)
    p[free] = rng.normal(size=len(free))
    q = product(operator, p.reshape(-1, dim)).ravel()
    unheld = tangent_operator(model, route, external=False)
    unheld.linearize(state.u, mass_weight=10.0)
    expected = dense(unheld)[np.ix_(free, free)] @ p[free]
    np.testing.assert_allclose(q[free], expected, atol=1e-13 * np.abs(expected).max())
    assert not np.delete(q, free).any()


@routes
@dims
def test_block_jacobi_inverts_the_diagonal(dim, route):
    model = partly_held(dim)
    state = shaken(model)
    operator = tangent_operator(model, route)
    operator.linearize(state.u, mass_weight=10.0, precondition=True)
    unheld = tangent_operator(model, "assembled", external=False)
    unheld.linearize(state.u, mass_weight=10.0)
    A = dense(unheld)
    held = np.setdiff1d(np.arange(len(A)), free_components(model))
    A[held], A[:, held] = 0.0, 0.0
    A[held, held] = 1.0
    expected = np.stack([np.linalg.inv(A[i : i + dim, i : i + dim]) for i in range(0, len(A), dim)])
    np.testing.assert_allclose(operator.inverse_diagonal.numpy(), expected, rtol=1e-10, atol=1e-12 * expected.max())


@settings
def test_products_of_many_rows_at_a_time_are_those_of_one(dim, dtype, monkeypatch):
    """With rows of different lengths, held points and slices that are not full."""
    model = bodies_of(dim, dtype, SOME)
    rows = tangent_operator(model, "assembled")
    monkeypatch.setattr(operators, "SLICED_POINTS", 1)
    monkeypatch.setattr(slices, "WINDOW", 32)
    sliced = tangent_operator(model, "assembled")
    p, b = (
        wp.array(np.random.default_rng(k).normal(size=(model.point_count, dim)), dtype=model.types.vector)
        for k in (1, 2)
    )
    results = []
    for operator in (rows, sliced):
        operator.linearize(shaken(model).u, 3.0)
        product, difference = model.zeros(), model.zeros()
        operator.apply(p, product)
        operator.subtract_product(b, p, difference)
        results.append((product.numpy().copy(), difference.numpy().copy()))
    for expected, found in zip(*results, strict=True):
        assert np.abs(found - expected).max() <= 4.0 * model.types.epsilon * np.abs(expected).max()
    assert len(sliced.arrays()) > len(rows.arrays())


@pytest.mark.parametrize(
    ("block", "expected"),
    [
        (np.diag([4.0, 2.0, 1.0]), np.diag([0.25, 0.5, 1.0])),
        (np.diag([1e-20, 1e-20, 1e-20]), np.diag([1e20, 1e20, 1e20])),
        (np.diag([8.0, -1.0, -1.0]), np.eye(3) / 2.0),  # a positive determinant, but not definite
        (np.diag([1.0, 1.0, 0.0]), np.eye(3) * 1.5),
        (-np.eye(3), np.eye(3)),
        (np.zeros((3, 3)), np.eye(3)),
    ],
)
def test_preconditioner_is_positive_definite(block, expected):
    """For any diagonal block, also of an indefinite matrix."""
    blocks, diagonal = wp.array([block], dtype=wp.mat33d), wp.array([0], dtype=wp.int32)
    inverse, none, all_free = wp.zeros(1, dtype=wp.mat33d), wp.empty(0, dtype=wp.mat33d), wp.empty(0, dtype=wp.vec3d)
    kernel = operator_kernels(3, "float64").invert_diagonal
    wp.launch(kernel, 1, inputs=[blocks, diagonal, none, all_free], outputs=[inverse])
    np.testing.assert_allclose(inverse.numpy()[0], expected, rtol=1e-14)


# ---- conjugate gradients


def solve(model: Model, operator: TangentOperator, b: np.ndarray, tolerance: float = 1e-12, max_iterations: int = 2000):
    """(x, result), with an x that starts as NaN."""
    x = model.zeros()
    x.fill_(np.nan)
    right = wp.array(b, dtype=model.types.vector, device=model.device)
    result = ConjugateGradients(model).solve(
        operator, BlockJacobi(operator), right, x, tolerance=tolerance, max_iterations=max_iterations
    )
    return x.numpy().astype(np.float64), result


def load(model: Model) -> np.ndarray:
    """Random forces, zero where held."""
    b = np.zeros(model.rest_points.size)
    free = free_components(model)
    b[free] = 100.0 * np.random.default_rng(3).normal(size=len(free))
    return b.reshape(model.rest_points.shape)


@routes
@settings
def test_solution_is_that_of_the_dense_matrix(dim, dtype, route):
    model = bodies_of(dim, dtype, SOME)
    free = free_components(model)
    state = shaken(model, 0.02)
    operator = tangent_operator(model, route)
    operator.linearize(state.u, mass_weight=100.0, precondition=True)
    b = load(model)
    tolerance = 1e-12 if dtype == "float64" else 1e-6
    x, result = solve(model, operator, b, tolerance)
    assert result.status is LinearStatus.CONVERGED
    assert result.residual <= tolerance
    assert 0 < result.iterations < 2 * len(free)
    A = dense(operator)
    expected = np.zeros_like(b).ravel()
    expected[free] = np.linalg.solve(A[np.ix_(free, free)], b.ravel()[free])
    accuracy = 1e-10 if dtype == "float64" else 1e-4
    np.testing.assert_allclose(x.ravel(), expected, atol=accuracy * np.abs(expected).max())
    assert not x.ravel()[np.setdiff1d(np.arange(x.size), free)].any()


def test_tolerance_is_that_of_the_true_residual():
    model = bodies_of(2, "float64", SOME)
    operator = tangent_operator(model, "closed")
    operator.linearize(shaken(model, 0.02).u, mass_weight=100.0, precondition=True)
    b = load(model)
    iterations = []
    for tolerance in (1e-2, 1e-5, 1e-8):
        x, result = solve(model, operator, b, tolerance)
        residual = np.linalg.norm(b - product(operator, x)) / np.linalg.norm(b)
        assert residual == pytest.approx(result.residual, rel=1e-4)
        assert residual <= tolerance
        iterations.append(result.iterations)
    assert iterations == sorted(set(iterations))


def test_iteration_limit_is_reported():
    model = bodies_of(2, "float64", SOME)
    operator = tangent_operator(model, "assembled")
    operator.linearize(shaken(model, 0.02).u, mass_weight=100.0, precondition=True)
    b = load(model)
    x, result = solve(model, operator, b, max_iterations=3)
    assert (result.status, result.iterations) == (LinearStatus.ITERATIONS, 3)
    residual = np.linalg.norm(b - product(operator, x)) / np.linalg.norm(b)
    assert residual == pytest.approx(result.residual, rel=1e-10)
    assert residual > 1e-12


def test_no_load_needs_no_iteration():
    model = bodies_of(2, "float64", SOME)
    operator = tangent_operator(model, "assembled")
    operator.linearize(shaken(model).u, mass_weight=0.0, precondition=True)
    x, result = solve(model, operator, np.zeros(model.rest_points.shape))
    assert (result.status, result.iterations, result.residual) == (LinearStatus.CONVERGED, 0, 0.0)
    assert not x.any()


@dims
def test_negative_curvature_is_reported(dim):
    """What comes back descends: b . x > 0."""
    model = bodies_of(dim, "float64", SOME)
    operator = tangent_operator(model, "assembled")
    operator.linearize(squashed(model).u, mass_weight=0.0, precondition=True)
    free = free_components(model)
    values, vectors = np.linalg.eigh(dense(operator)[np.ix_(free, free)])
    assert values[0] < 0.0
    b = load(model)
    x, result = solve(model, operator, b)
    assert result.status is LinearStatus.CURVATURE
    assert np.sum(b * x) > 0.0
    # along the most negative direction alone it stops in the first iteration
    worst = np.zeros(b.size)
    worst[free] = vectors[:, 0]
    b = np.linalg.solve(operator.inverse_diagonal.numpy(), worst.reshape(-1, dim, 1))[:, :, 0]
    x, result = solve(model, operator, b)
    assert (result.status, result.iterations) == (LinearStatus.CURVATURE, 0)
    assert np.sum(b * x) > 0.0


def test_not_a_number_is_reported():
    """A tangent that is not finite ends the solve as curvature, not as convergence."""
    model = model_of(NeoHookean(E, NU), Mesh.rectangle((1, 1), (1, 1)))
    state = model.state()
    state.assign(displacement=-2.0 * model.rest_points * np.array([1.0, 0.0]))  # turned inside out: J = -1
    operator = tangent_operator(model, "assembled")
    operator.linearize(state.u, mass_weight=0.0, precondition=True)
    _, result = solve(model, operator, np.ones((4, 2)))
    assert result.status is not LinearStatus.CONVERGED
