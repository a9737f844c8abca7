"""Backward Euler: one mode, one linear system, Newton's method and how it ends."""

from dataclasses import replace

import numpy as np
import pytest
import warp as wp
from helpers import custom_neo_hookean
from stepping import EXPLICIT, LINEARISED, MATERIALS, TIGHT, advance, all_forces, dense_stiffness, modes, ready, slab
from stepping import solver_name as name

from warpfem.boundary import BoxWalls, Pin, Plane, PrescribedMotion
from warpfem.errors import SceneError, SimulationError
from warpfem.materials import LinearElasticity, NeoHookean
from warpfem.mesh import Mesh
from warpfem.scene import Body, Scene
from warpfem.solvers import BackwardEuler
from warpfem.solvers.newton import SETTLED_LIMIT

ROUTES = [
    ("assembled", "absolute"),
    ("assembled", "exact"),
    ("closed", "clamped"),
    ("closed", "exact"),
    ("tape", "exact"),
]


def twisted(x):
    """A smooth large displacement that leaves the face x = 0 alone."""
    u = np.zeros_like(x)
    u[:, 1] = 0.15 * x[:, 0] ** 2
    u[:, 0] = -0.05 * x[:, 0] * x[:, 1]
    if x.shape[1] == 3:
        u[:, 2] = 0.1 * x[:, 0] * x[:, 1]
    return u


# ---- what a step is


@pytest.mark.parametrize("solver", [TIGHT, LINEARISED], ids=name)
@pytest.mark.parametrize("mode", [0, 5])
@pytest.mark.parametrize("omega_dt", [0.1, 3.0])
def test_amplitude_of_a_linear_mode(solver, mode, omega_dt):
    scene = Scene([slab(2, supports=[Pin("left")])], solver)
    model, state, stepper = ready(scene)
    free = model.rest_points[:, :1] > 0.0
    omega, shapes = modes(model, np.broadcast_to(free, (model.point_count, 2)))
    omega, shape = omega[mode], shapes[mode]
    weights = model.lumped_mass[:, None] * shape  # shapes have mass 1
    state.assign(displacement=0.01 * shape)
    dt = omega_dt / omega

    def amplitude():
        return np.hypot(omega * np.sum(weights * state.displacement), np.sum(weights * state.velocity))

    history = [amplitude()]
    advance(stepper, state, dt, 5, lambda: history.append(amplitude()))
    ratios = np.array(history[1:]) / history[:-1]
    np.testing.assert_allclose(ratios, (1.0 + omega_dt**2) ** -0.5, rtol=1e-8)
    coefficient = np.sum(weights * state.displacement)
    np.testing.assert_allclose(state.displacement, coefficient * shape, rtol=0, atol=1e-8 * 0.01 * np.abs(shape).max())


@pytest.mark.parametrize("damping", [0.0, 4.0])
@pytest.mark.parametrize("route", ["assembled", "closed", "tape"])
def test_linearised_step_is_the_lectures_linear_system(route, damping):
    # (M (1 + alpha dt) + dt^2 K) v = M v_t + dt f, with f and K at x_t
    solver = BackwardEuler.linearised(route, linear_tolerance=1e-14)
    body = slab(3, supports=[Pin("left")], displacement=twisted, velocity=lambda x: 3.0 * twisted(x)[:, ::-1])
    model, state, stepper = ready(Scene([body], solver, gravity=(0.0, -9.0, 1.0), damping=damping))
    dt = 0.02
    mass = np.repeat(model.lumped_mass, 3)
    free = np.repeat(model.rest_points[:, 0] > 0.0, 3)
    A = np.diag((1.0 + damping * dt) * mass) + dt**2 * dense_stiffness(model, state)
    b = mass * state.velocity.ravel() + dt * all_forces(model, state).ravel()
    v = np.zeros_like(b)
    v[free] = np.linalg.solve(A[np.ix_(free, free)], b[free])
    start = state.displacement
    report = stepper.step(state, dt)
    assert report.converged
    assert report.newton_iterations == 1
    np.testing.assert_allclose(state.velocity.ravel(), v, rtol=0, atol=1e-11 * np.abs(v).max())
    np.testing.assert_allclose(state.displacement, start + dt * state.velocity, rtol=0, atol=1e-14)


@pytest.mark.parametrize(("differential", "hessian"), ROUTES)
def test_newton_solves_the_step_by_every_route(differential, hessian):
    solver = BackwardEuler(tolerance=1e-9, differential=differential, hessian=hessian)
    body = slab(3, supports=[Pin("left")], displacement=twisted)
    damping, dt = 2.0, 0.02
    model, state, stepper = ready(Scene([body], solver, gravity=(0.0, -9.0, 1.0), damping=damping))
    start, v_start = state.displacement, state.velocity
    report = stepper.step(state, dt)
    assert report.converged and report.residual <= 1e-9
    mass = model.lumped_mass[:, None]
    force = all_forces(model, state)
    unbalanced = mass * (state.velocity - v_start) / dt + damping * mass * state.velocity - force
    free = model.rest_points[:, 0] > 0.0
    assert np.linalg.norm(unbalanced[free]) < 1e-9 * np.linalg.norm(force)
    np.testing.assert_allclose(state.velocity, (state.displacement - start) / dt, rtol=0, atol=1e-12)


@pytest.mark.parametrize("solver", [TIGHT, LINEARISED], ids=name)
def test_damping_of_a_free_body(solver):
    alpha, dt, n = 5.0, 0.05, 10
    start = np.array([1.0, -2.0])
    _, state, stepper = ready(Scene([slab(2, velocity=start)], solver, damping=alpha))
    advance(stepper, state, dt, n)
    expected = np.tile(start / (1.0 + alpha * dt) ** n, (len(state.velocity), 1))
    np.testing.assert_allclose(state.velocity, expected, rtol=1e-9)


# ---- Newton's method


@pytest.mark.parametrize("friction", [0.0, 0.5])
def test_iterations_do_not_depend_on_units(friction):
    # the same scene in m, kg, s and in mm, t, s
    def run(length, mass):
        mesh = Mesh.rectangle((2.0, 1.0), (4, 2), origin=(0.0, 0.05)).transformed(length)
        pressure = mass / length  # of 1 Pa
        body = Body(
            "slab",
            mesh,
            LinearElasticity(E=1e5 * pressure, nu=0.3),
            density=1000.0 * mass / length**3,
            velocity=(1.0 * length, -2.0 * length),
        )
        floor = Plane((0.0, 0.0), (0.0, 1.0), friction=friction)
        _, state, stepper = ready(Scene([body], BackwardEuler(), gravity=(0.0, -9.8 * length), obstacles=[floor]))
        reports = advance(stepper, state, 0.02, 15)
        return [(r.newton_iterations, r.cg_iterations) for r in reports], state.displacement / length

    meters, x = run(1.0, 1.0)
    millimeters, y = run(1e3, 1e-3)
    assert max(newton for newton, _ in meters) > 3
    assert millimeters == meters
    np.testing.assert_allclose(y, x, rtol=0, atol=1e-10)


def test_reports_that_it_has_not_converged():
    solver = BackwardEuler(max_iterations=2, hessian="exact", unconverged="accept")
    scene = Scene([slab(3, supports=[Pin("left")], displacement=lambda x: 4.0 * twisted(x))], solver)
    _, state, stepper = ready(scene)
    report = stepper.step(state, 0.2)
    assert not report.converged
    assert report.newton_iterations == 2
    assert report.residual > scene.solver.tolerance
    assert report.note == "stopped after 2 Newton iterations"
    assert state.time == 0.2  # the step is taken with what there is

    patient = Scene(scene.bodies, BackwardEuler())
    _, state, stepper = ready(patient)
    report = stepper.step(state, 0.2)
    assert report.converged and report.newton_iterations > 2


def test_a_step_that_fails_is_done_in_parts():
    body = slab(3, supports=[Pin("left")], displacement=lambda x: 4.0 * twisted(x))
    _, state, stepper = ready(Scene([body], BackwardEuler(max_iterations=4)))
    report = stepper.step(state, 0.2)
    assert report.converged and report.parts == 3  # two quarters, then a half
    assert report.newton_iterations >= report.parts
    assert state.time == 0.2

    _, same, stepper = ready(Scene([body], BackwardEuler()))
    for dt in (0.05, 0.05, 0.1):
        advance(stepper, same, dt, 1)
    np.testing.assert_allclose(state.displacement, same.displacement, atol=1e-4)
    assert np.abs(state.displacement).max() > 0.1


def test_a_step_that_fails_in_all_parts_leaves_the_state():
    def tear(rest, time):  # in any part of the step through the opposite face
        return rest + np.array([1.5 if time > 0.1 else 0.0, 0.0])

    body = Body("soft", Mesh.rectangle((1.0, 1.0), (2, 2)), SOFT, supports=[PrescribedMotion("left", tear)])
    _, state, stepper = ready(Scene([body], BackwardEuler()))
    advance(stepper, state, 0.1, 1)
    u, v = state.displacement, state.velocity
    with pytest.raises(SimulationError, match=r"t = 0\.1 s: the step of 0\.1 s cannot be solved, nor in parts of"):
        stepper.step(state, 0.1)
    np.testing.assert_array_equal(state.displacement, u)
    np.testing.assert_array_equal(state.velocity, v)
    assert state.time == 0.1
    assert stepper.attempt.shape == state.u.shape


def test_the_step_limit_ends_before_a_cell_inverts():
    rng = np.random.default_rng(4)
    for dim, mesh in ((2, Mesh.rectangle((1.0, 1.0), (2, 2))), (3, Mesh.box((1.0, 1.0, 1.0), (1, 1, 1)))):
        model, state, _ = ready(Scene([Body("soft", mesh, SOFT)], BackwardEuler()))
        met = 0
        for size in 10.0 ** rng.uniform(-2.0, 1.0, 40):
            direction = size * rng.normal(size=mesh.points.shape)
            p = wp.array(direction, dtype=model.types.vector, device="cpu")
            limit = wp.array([1.0], dtype=model.types.scalar, device="cpu")
            model.blocks[0].launch("step_limit", [state.u, p], [limit])
            s = float(limit.numpy()[0])
            edges = (np.linspace(0.0, 1.0, 2001)[:, None, None, None] * direction[mesh.cells]).transpose(1, 0, 2, 3)
            F = np.eye(dim) + np.einsum(
                "ctki,ckj->ctij", edges[:, :, 1:] - edges[:, :, :1], mesh.inverse_shape_matrices
            )
            inverted = (np.linalg.det(F) <= 0.0).any(axis=0)
            first = np.argmax(inverted) / 2000 if inverted.any() else 1.0
            met += inverted.any()
            assert 0.9 * (first - 1 / 2000) <= s <= first + 1e-12
        assert 10 < met < 40


def test_linearised_step_reports_that_its_linear_solve_stopped():
    solver = replace(LINEARISED, linear_iterations=2)
    _, state, stepper = ready(Scene([slab(2, supports=[Pin("left")])], solver, gravity=(0.0, -9.0)))
    report = stepper.step(state, 0.1)
    assert not report.converged
    assert (report.cg_iterations, report.note) == (2, "conjugate gradients stopped at the iteration limit")
    assert report.residual > solver.linear_tolerance


SOFT = NeoHookean(E=1e4, nu=0.3)


@pytest.mark.parametrize("material", [SOFT, custom_neo_hookean(SOFT.mu, SOFT.lam)], ids=["neo_hookean", "custom"])
def test_a_barrier_material_never_inverts(material):
    # thrown at a stiff floor at ten times its wave speed, with a step that would carry it through
    mesh = Mesh.rectangle((1.0, 1.0), (2, 2))
    floor = Plane((0.0, 0.0), (0.0, 1.0), stiffness=1e7)
    body = Body("soft", mesh, material, velocity=(0.0, -30.0))
    model, state, stepper = ready(Scene([body], BackwardEuler(), obstacles=[floor]))
    smallest = []
    for _ in range(10):
        stepper.step(state, 0.02)
        smallest.append(model.diagnostics(state)[0].min())
    assert 0.0 < min(smallest) < 0.3
    assert np.isfinite(model.energies(state).total)


def inverted_corner(mesh):
    u = np.zeros_like(mesh.points)
    u[-1] = -0.6
    return u


@pytest.mark.parametrize("solver", [BackwardEuler(), LINEARISED], ids=name)
def test_a_start_from_infinite_energy_is_an_error(solver):
    # both starts are inverted: the old state, and free flight, which the velocity 0 leaves where it is
    mesh = Mesh.rectangle((1.0, 1.0), (2, 2))
    body = Body("soft", mesh, SOFT, displacement=inverted_corner(mesh))
    _, state, stepper = ready(Scene([body], solver))
    message = r"cell \d of body 'soft' has J = -0\.2.*StableNeoHookean" if solver is not LINEARISED else "not finite"
    with pytest.raises(SimulationError, match=message):
        stepper.step(state, 0.01)
    np.testing.assert_array_equal(state.displacement, body.displacement)
    np.testing.assert_array_equal(state.velocity, 0.0)
    assert (state.time, state.revision) == (0.0, 0)


def test_a_support_that_inverts_a_cell_is_named_by_its_j_after_the_move():
    mesh = Mesh.rectangle((1.0, 1.0), (2, 2))

    def jump(rest, time):
        return rest + np.array([0.6 if time > 0.15 else 0.0, 0.0])

    body = Body("soft", mesh, SOFT, supports=[PrescribedMotion("left", jump)])
    _, state, stepper = ready(Scene([body], BackwardEuler()))
    advance(stepper, state, 0.1, 1)
    before = state.displacement
    parts = r"t = 0\.1 s: the step of 0\.1 s cannot be solved, nor in parts of 9\.77e-05 s: "
    with pytest.raises(SimulationError, match=parts + r".*infinite energy; cell \d of body 'soft' has J = -0\.2"):
        stepper.step(state, 0.1)
    np.testing.assert_array_equal(state.displacement, before)
    assert state.time == pytest.approx(0.1)


@pytest.mark.parametrize("solver", [*EXPLICIT, BackwardEuler(tolerance=1e-8), LINEARISED], ids=name)
def test_a_material_of_psi_alone_runs_in_every_solver(solver):
    def run(material):
        body = Body("soft", Mesh.rectangle((1.0, 1.0), (2, 2)), material, supports=[Pin("left")])
        _, state, stepper = ready(Scene([body], solver, gravity=(0.5, -5.0)))
        advance(stepper, state, 0.01, 10)
        return state.displacement

    built_in, custom = run(SOFT), run(custom_neo_hookean(SOFT.mu, SOFT.lam))
    # explicit: P by wp.grad is exact; implicit: the differential's difference, 1e-9, or Newton's tolerance
    assert np.abs(custom - built_in).max() < 1e-7 * np.abs(built_in).max()


@pytest.mark.parametrize("hessian", ["exact", "clamped", "absolute"])
def test_newton_leaves_a_state_of_negative_curvature(hessian):
    # a column squashed to a third buckles: its exact stiffness is indefinite
    body = slab(3, supports=[Pin("left")], displacement=lambda x: x * [-0.65, 0.0, 0.0])
    model, state, stepper = ready(Scene([body], BackwardEuler(hessian=hessian)))
    mass = np.diag(np.repeat(model.lumped_mass, 3))
    assert np.linalg.eigvalsh(mass / 0.5**2 + dense_stiffness(model, state))[0] < 0.0
    before = model.energies(state).total
    advance(stepper, state, 0.5, 1)
    assert model.energies(state).total < 0.5 * before


# ---- float32


def tumbling(solver):
    """Sticks, slides and tumbles on a rough floor, far enough for a coarse float32."""
    mesh = Mesh.box((1.0, 1.0, 1.0), (2, 2, 2), origin=(0.0, 0.2, 0.0))
    body = Body("box", mesh, MATERIALS[3], velocity=lambda x: np.cross([0.0, 0.0, -6.0], x - [0.5, 0.7, 0.5]))
    room = BoxWalls((-1.0, 0.0, -1.0), (3.0, 3.0, 3.0), friction=1.0)
    return Scene([body], solver, gravity=(0.0, -9.8, 0.0), obstacles=[room])


def test_float32_stops_by_rounding_and_not_by_the_iteration_limit():
    results = {}
    for dtype in ("float32", "float64"):
        _, state, stepper = ready(tumbling(BackwardEuler()), dtype)
        reports = advance(stepper, state, 0.01, 60)
        results[dtype] = state.displacement, np.mean([r.newton_iterations for r in reports])
        assert max(r.newton_iterations for r in reports) < 30
    (single, single_iterations), (double, double_iterations) = results.values()
    assert np.abs(single - double).max() < 5e-3
    assert single_iterations < 1.2 * double_iterations


def test_float32_tells_that_it_stopped_by_rounding():
    _, state, stepper = ready(tumbling(BackwardEuler(tolerance=1e-9)), "float32")
    reports = advance(stepper, state, 0.01, 20)
    assert {r.note for r in reports} <= {"", "resolved only to the rounding of float32"}
    by_rounding = [r for r in reports if r.note]
    assert len(by_rounding) > 10
    assert all(1e-9 < r.residual < 1e-3 for r in by_rounding)


def test_rounding_is_no_failure_where_it_is_small_beside_the_reactions():
    """A body that supports stretch comes to rest under a load of which rounding leaves little."""

    def pull(rest, time):
        return rest * np.array([1.5, 1.0])

    body = slab(
        2, supports=[Pin("left"), PrescribedMotion("right", pull)], displacement=lambda x: x * np.array([0.5, 0.0])
    )
    solver = BackwardEuler(unconverged="accept")
    _, state, stepper = ready(Scene([body], solver, gravity=(0.0, -1e-4), damping=20.0), "float32")
    reports = advance(stepper, state, 0.05, 20)
    assert all(report.converged for report in reports)
    assert max(report.residual for report in reports) > SETTLED_LIMIT


# ---- settings


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (dict(tolerance=0.0), r"tolerance must be in \(0, 1\), not 0.0"),
        (dict(tolerance=np.nan), "tolerance"),
        (dict(linear_tolerance=2), "linear_tolerance"),
        (dict(max_iterations=0), "max_iterations must be an integer >= 1, not 0"),
        (dict(linear_iterations=2.5), "linear_iterations"),
        (dict(max_iterations=True), "max_iterations"),
        (dict(hessian="positive"), "'absolute', 'clamped' or 'exact', not 'positive'"),
        (dict(differential="dense"), "'assembled', 'closed' or 'tape', not 'dense'"),
        (dict(differential="tape"), "take hessian='exact'"),
    ],
)
def test_refuses_settings(settings, message):
    with pytest.raises(SceneError, match=message):
        BackwardEuler(**settings)


# ---- what the residual is measured against


def test_imposed_motion_does_not_hide_the_residual():
    """In a frame of 1000 m/s a cantilever sags as at rest: the forces that move its clamp are not its own."""

    def sag(speed):
        def ride(rest, time):
            return rest + np.array([speed * time, 0.0])

        body = slab(2, supports=[PrescribedMotion("left", ride)], velocity=(speed, 0.0))
        _, state, stepper = ready(Scene([body], BackwardEuler(), gravity=(0.0, -9.81)))
        advance(stepper, state, 2e-3, 50)
        return state.displacement[:, 1]

    np.testing.assert_allclose(sag(1000.0), sag(0.0), atol=1e-3 * np.abs(sag(0.0)).max())


def test_a_heavy_body_does_not_hide_the_residual_of_a_light_one():
    def sag(*others):
        light = slab(2, supports=[Pin("left")])
        model, state, stepper = ready(Scene([light, *others], BackwardEuler(), gravity=(0.0, -9.81)))
        advance(stepper, state, 0.02, 20)
        return state.displacement[: model.point_starts[1], 1]

    heavy = Body("heavy", slab(2).mesh, MATERIALS[2], density=1e9)
    np.testing.assert_allclose(sag(heavy), sag(), atol=1e-3 * np.abs(sag()).max())


def test_a_motion_that_raises_within_a_divided_step_leaves_the_state():
    def press(rest, time):
        if 0.1 < time < 0.2:
            raise ValueError("not here")
        return rest + np.array([0.6 if time > 0.15 else 0.0, 0.0])

    body = Body("soft", Mesh.rectangle((1.0, 1.0), (2, 2)), SOFT, supports=[PrescribedMotion("left", press)])
    _, state, stepper = ready(Scene([body], BackwardEuler()))
    advance(stepper, state, 0.1, 1)
    u = state.displacement
    with pytest.raises(SceneError, match="not here"):
        stepper.step(state, 0.1)
    np.testing.assert_array_equal(state.displacement, u)
    assert state.time == 0.1
