"""Implicit Runge-Kutta schemes: their coefficients, one mode, what they conserve, and what they bear."""

import numpy as np
import pytest
from stepping import MIDPOINT, SDIRK, TIGHT, advance, modes, ready, slab, solver_name

from warpfem.boundary import Pin, Plane, PrescribedMotion
from warpfem.errors import SceneError, SimulationError
from warpfem.materials import LinearElasticity, NeoHookean, StableNeoHookean
from warpfem.mesh import Mesh
from warpfem.scene import Body, Scene
from warpfem.solvers import SDIRK2, SDIRK3, BackwardEuler, ImplicitMidpoint

SCHEMES = [TIGHT, MIDPOINT, *SDIRK]


def coefficients(solver):
    """A and b of the tableau."""
    rows, weights = solver.tableau.rows, solver.tableau.weights
    A = np.zeros((len(rows), len(rows)))
    for index, row in enumerate(rows):
        A[index, : len(row)] = row
    return A, A[-1] if weights is None else np.array(weights)


def stability_function(solver, z):
    """R(z): what a step multiplies the solution of y' = lambda y with, z = lambda dt."""
    A, b = coefficients(solver)
    one = np.ones(len(b))
    return 1.0 + z * b @ np.linalg.solve(np.eye(len(b)) - z * A, one)


@pytest.mark.parametrize("solver", SCHEMES, ids=solver_name)
def test_the_coefficients_meet_the_conditions_of_their_order_and_of_no_higher_one(solver):
    A, b = coefficients(solver)
    one = np.ones(len(b))
    c = A @ one
    conditions = {1: [b @ one - 1.0], 2: [b @ c - 1 / 2], 3: [b @ c**2 - 1 / 3, b @ A @ c - 1 / 6]}
    conditions[4] = [b @ c**3 - 1 / 4, b @ (c * (A @ c)) - 1 / 8, b @ A @ c**2 - 1 / 12, b @ A @ A @ c - 1 / 24]
    for order in range(1, solver.order + 1):
        np.testing.assert_allclose(conditions[order], 0.0, atol=1e-15)
    assert np.abs(conditions[solver.order + 1]).max() > 1e-3


@pytest.mark.parametrize("solver", SCHEMES, ids=solver_name)
def test_no_mode_grows_and_all_but_the_midpoint_rule_end_what_is_fastest(solver):
    gain = [abs(stability_function(solver, 1j * y)) for y in np.logspace(-2, 6, 200)]
    assert max(gain) < 1.0 + 1e-12
    if solver == MIDPOINT:
        assert min(gain) > 1.0 - 1e-9
    else:
        assert gain[-1] < 1e-5


@pytest.mark.parametrize("solver", SCHEMES[1:], ids=solver_name)
@pytest.mark.parametrize("omega_dt", [0.3, 2.0, 30.0])
def test_a_linear_mode_follows_the_stability_function(solver, omega_dt):
    model, state, stepper = ready(Scene([slab(2, supports=[Pin("left")])], solver))
    free = model.rest_points[:, :1] > 0.0
    omega, shapes = modes(model, np.broadcast_to(free, (model.point_count, 2)))
    omega, shape = omega[2], shapes[2]
    weights = model.lumped_mass[:, None] * shape  # shapes have mass 1
    state.assign(displacement=0.01 * shape)

    def phase():  # y = v + i omega u obeys y' = i omega y
        return np.sum(weights * state.velocity) + 1j * omega * np.sum(weights * state.displacement)

    start = phase()
    advance(stepper, state, omega_dt / omega, 5)
    expected = stability_function(solver, 1j * omega_dt) ** 5
    assert abs(phase() / start - expected) < 1e-7


def spin(x):
    """Three quarters of a turn a second about the middle, and vibration."""
    v = np.cross([0.0, 0.0, 5.0], x - [1.0, 0.5, 0.5])
    return v + 0.2 * np.sin(3.0 * x[:, ::-1])


def lost_angular_momentum(solver, dt, steps, dtype="float64"):
    """The part of it that a free body loses."""
    model, state, stepper = ready(Scene([slab(3, velocity=spin)], solver), dtype)
    mass, history = model.lumped_mass, []
    for _ in range(2):
        x = model.rest_points + state.displacement
        history.append(np.sum(mass[:, None] * np.cross(x - mass @ x / mass.sum(), state.velocity), axis=0))
        if len(history) == 1:
            advance(stepper, state, dt, steps)
    return np.linalg.norm(history[1] - history[0]) / np.linalg.norm(history[0])


def test_a_free_spin_keeps_its_angular_momentum():
    # one second in 20 steps, with the default tolerance of 1e-4
    lost = {
        type(s): lost_angular_momentum(s, 0.05, 20) for s in (BackwardEuler(), SDIRK2(), SDIRK3(), ImplicitMidpoint())
    }
    assert lost[BackwardEuler] > 0.2
    assert lost[SDIRK2] < 0.05 and lost[SDIRK3] < 0.05
    assert lost[ImplicitMidpoint] < 1e-4
    assert lost_angular_momentum(ImplicitMidpoint(), 0.05, 20, "float32") < 1e-4


@pytest.mark.parametrize("solver", [SDIRK2(), SDIRK3()], ids=solver_name)
@pytest.mark.parametrize("dt", [0.3, 0.04])
@pytest.mark.filterwarnings("ignore:.*inverted")
def test_steps_from_scrambled_points_lose_energy(solver, dt):
    scrambled = np.random.default_rng(0).uniform(-0.5, 0.5, (25, 2))
    mesh = Mesh.rectangle((1.0, 1.0), (4, 4))
    body = Body("block", mesh, StableNeoHookean(E=1e5, nu=0.3), displacement=scrambled)
    model, state, stepper = ready(Scene([body], solver))
    energy = [model.energies(state).total]
    advance(stepper, state, dt, 15, lambda: energy.append(model.energies(state).total))
    assert max(energy) < 1.2 * energy[0]
    assert energy[-1] < 0.1 * energy[0]


def test_a_midpoint_step_that_would_end_inverted_is_taken_in_parts():
    # the middle of the step bears J > 0, its end does not
    mesh = Mesh.rectangle((1.0, 1.0), (2, 2))
    soft = NeoHookean(E=1e3, nu=0.3)
    body = Body("soft", mesh, soft, velocity=lambda x: x * [-9.0, 0.0])
    model, state, stepper = ready(Scene([body], ImplicitMidpoint()))
    report = stepper.step(state, 0.2)
    assert report.converged and report.parts > 1
    assert model.diagnostics(state)[0].min() > 0.0


def test_a_stage_that_fails_leaves_the_state():
    def tear(rest, time):  # within the first step only, and there only at its end
        return rest + np.array([1.5 if time > 0.09999 else 0.0, 0.0])

    body = Body("soft", Mesh.rectangle((1.0, 1.0), (2, 2)), NeoHookean(E=1e4, nu=0.3), velocity=(0.1, 0.0))
    body = Body("soft", body.mesh, body.material, supports=[PrescribedMotion("left", tear)], velocity=(0.1, 0.0))
    _, state, stepper = ready(Scene([body], SDIRK2()))
    u, v = state.displacement, state.velocity
    with pytest.raises(SimulationError, match=r"t = 0 s: the step of 0\.1 s cannot be solved, nor in parts of"):
        stepper.step(state, 0.1)
    np.testing.assert_array_equal(state.displacement, u)
    np.testing.assert_array_equal(state.velocity, v)
    assert state.time == 0.0


@pytest.mark.parametrize("solver", [SDIRK2(), SDIRK3()], ids=solver_name)
def test_a_block_slides_as_coulomb_has_it(solver):
    # on a slope of tan = 0.5 with mu = 0.3, from its place of rest on the obstacle's springs
    g, mu = 10.0, 0.3
    mesh = Mesh.rectangle((1.0, 0.5), (4, 2))
    floor = Plane((0.0, 0.0), (0.0, 1.0), friction=mu, stiffness=1e7)
    depth = 1000.0 * 0.5 * g / 1e7
    body = Body("block", mesh, LinearElasticity(E=1e7, nu=0.0), displacement=(0.0, -depth))
    model, state, stepper = ready(Scene([body], solver, gravity=(0.5 * g, -g), obstacles=[floor], damping=0.5))
    time, steps = 0.4, 20
    advance(stepper, state, time / steps, steps)
    speed = (0.5 - mu) * g / 0.5 * (1.0 - np.exp(-0.5 * time))
    assert model.lumped_mass @ state.velocity[:, 0] / model.lumped_mass.sum() == pytest.approx(speed, rel=0.02)


@pytest.mark.parametrize("solver", [SDIRK2(), SDIRK3()], ids=solver_name)
def test_a_stiff_body_follows_its_support(solver):
    # its slowest period is a fifth of a step: it sways with the acceleration of the support, as in statics, by 1e-6 m
    def lift(rest, time):
        return rest + np.array([0.0, 0.05 * np.sin(time) ** 2])

    mesh = Mesh.rectangle((1.0, 0.25), (6, 2))
    body = Body("arm", mesh, StableNeoHookean(E=1e9, nu=0.3), supports=[PrescribedMotion("left", lift)])
    _, state, stepper = ready(Scene([body], solver))
    advance(stepper, state, 0.05, 20)
    np.testing.assert_allclose(state.displacement, np.tile([0.0, 0.05 * np.sin(1.0) ** 2], (21, 1)), atol=1e-5)
    np.testing.assert_allclose(state.velocity, np.tile([0.0, 0.05 * np.sin(2.0)], (21, 1)), atol=2e-3)


@pytest.mark.parametrize("scheme", [ImplicitMidpoint, SDIRK2, SDIRK3])
def test_refuses_settings(scheme):
    with pytest.raises(SceneError, match=rf"{scheme.__name__}: max_iterations must be an integer >= 2, not 1"):
        scheme(max_iterations=1)
    with pytest.raises(SceneError, match=rf"{scheme.__name__}: unconverged must be 'halve' or 'accept', not 'go on'"):
        scheme(unconverged="go on")
