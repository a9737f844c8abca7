"""Pins, rollers and prescribed motion."""

import numpy as np
import pytest
from stepping import EXPLICIT, LINEARISED, advance, ready, slab, solver_name

from warpfem.boundary import Pin, PrescribedMotion
from warpfem.errors import SceneError
from warpfem.mesh import Mesh
from warpfem.model import Model
from warpfem.scene import Body, Scene
from warpfem.solvers import SDIRK2, BackwardEuler, ImplicitMidpoint, SymplecticEuler

SOLVERS = [*EXPLICIT, BackwardEuler(), LINEARISED, ImplicitMidpoint(), SDIRK2()]
GRAVITY = (1.0, -9.0, 2.0)


def turn(rest, time):
    """Turns about z through the origin, and moves along x."""
    c, s = np.cos(4.0 * time), np.sin(4.0 * time)
    x = rest.copy()
    x[:, :2] = rest[:, :2] @ [[c, s], [-s, c]]
    x[:, 0] += 0.5 * time
    return x


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("solver", SOLVERS, ids=solver_name)
def test_pinned_points_stay_and_the_others_move(solver, dim):
    body = slab(dim, supports=[Pin("left")], velocity=(0.5,) * dim)
    model, state, stepper = ready(Scene([body], solver, gravity=GRAVITY[:dim]))
    pinned = body.mesh.select_points("left")
    free = np.setdiff1d(np.arange(model.point_count), pinned)
    np.testing.assert_array_equal(state.velocity[pinned], 0.0)  # the initial velocity does not move them
    advance(stepper, state, 0.01, 5)
    np.testing.assert_array_equal(state.displacement[pinned], 0.0)
    np.testing.assert_array_equal(state.velocity[pinned], 0.0)
    assert (np.abs(state.displacement[free]) > 1e-4).any(axis=1).all()


@pytest.mark.parametrize("solver", SOLVERS, ids=solver_name)
def test_a_roller_holds_its_axes_alone(solver):
    # a body on rollers falls freely along them
    supports = [Pin("bottom", axes=(1,)), Pin("back", axes=[2])]
    g = np.array([3.0, 0.0, 0.0])
    model, state, stepper = ready(Scene([slab(3, supports=supports)], solver, gravity=g))
    advance(stepper, state, 0.01, 10)
    np.testing.assert_allclose(state.velocity, np.tile(0.1 * g, (model.point_count, 1)), rtol=0, atol=1e-6)
    body = slab(3, supports=supports)
    np.testing.assert_array_equal(state.displacement[body.mesh.select_points("bottom"), 1], 0.0)


@pytest.mark.parametrize("dtype", ["float64", "float32"])
@pytest.mark.parametrize("solver", SOLVERS, ids=solver_name)
def test_prescribed_motion_is_exact_at_every_step(solver, dtype):
    body = slab(3, supports=[PrescribedMotion("left", turn)])
    model, state, stepper = ready(Scene([body], solver, gravity=GRAVITY), dtype)
    moved = body.mesh.select_points("left")
    rest = body.mesh.points[moved]
    dt = 0.01
    digits = dict(rtol=0, atol=4 * model.types.epsilon)

    def check():
        now, before = turn(rest, state.time), turn(rest, state.time - dt)
        np.testing.assert_allclose(state.displacement[moved], now - rest, **digits)
        np.testing.assert_allclose(state.velocity[moved], (now - before) / dt, rtol=0, atol=1e3 * model.types.epsilon)

    advance(stepper, state, dt, 12, check)
    others = np.setdiff1d(np.arange(model.point_count), moved)
    assert np.abs(state.displacement[others]).max(axis=1).min() > 1e-4


@pytest.mark.parametrize("solver", SOLVERS, ids=solver_name)
def test_prescribed_components_leave_the_others_free(solver):
    def lift(rest, time):
        return rest + np.array([100.0, time])  # the component x is not prescribed

    body = slab(2, supports=[PrescribedMotion("left", lift, axes=(1,))])
    _, state, stepper = ready(Scene([body], solver, gravity=(2.0, 0.0)))
    advance(stepper, state, 0.005, 10)
    left = body.mesh.select_points("left")
    np.testing.assert_allclose(state.displacement[left, 1], 0.05, rtol=1e-13)
    assert 0.0 < state.displacement[left, 0].max() < 0.02


def test_the_initial_state_takes_the_motion_at_time_0():
    body = slab(
        2, supports=[PrescribedMotion("left", lambda rest, time: rest + np.array([0.0, 0.25]))], velocity=(1.0, 0.0)
    )
    model, state, _ = ready(Scene([body], SymplecticEuler()))
    left = body.mesh.select_points("left")
    np.testing.assert_array_equal(state.displacement[left], [[0.0, 0.25]] * len(left))
    np.testing.assert_array_equal(state.velocity[left], 0.0)
    assert np.count_nonzero(state.velocity) == model.point_count - len(left)


def test_motion_gets_a_copy_of_the_rest_points():
    def careless(rest, time):
        rest += 1.0
        return rest

    body = slab(2, supports=[PrescribedMotion("left", careless)])
    _, state, stepper = ready(Scene([body], SymplecticEuler()))
    advance(stepper, state, 0.005, 2)
    np.testing.assert_array_equal(state.displacement[body.mesh.select_points("left")], 1.0)


def test_supports_of_a_second_body_hold_its_own_points():
    bodies = [slab(2), Body("other", Mesh.rectangle((1.0, 1.0), (2, 2)), slab(2).material, supports=[Pin([0, 4])])]
    model, state, stepper = ready(Scene(bodies, SymplecticEuler(), gravity=(0.0, -1.0)))
    advance(stepper, state, 0.005, 1)
    still = np.flatnonzero(~state.displacement.any(axis=1))
    np.testing.assert_array_equal(still, model.point_starts[1] + np.array([0, 4]))


def test_pins_may_overlap():
    body = slab(2, supports=[Pin("left"), Pin("bottom", axes=(1,)), Pin("left", axes=(0,))])
    model = Model(Scene([body], SymplecticEuler()), dtype="float64")
    mesh = body.mesh
    held = np.union1d(mesh.select_points("left"), mesh.select_points("bottom"))
    np.testing.assert_array_equal(model.supports.host_points, held)


@pytest.mark.parametrize("solver", [SymplecticEuler(), BackwardEuler()], ids=solver_name)
@pytest.mark.parametrize(
    ("motion", "message"),
    [
        (
            lambda rest, time: rest[:-1] if time > 0.015 else rest,
            r"returned shape \(2, 2\) at t = 0\.02 s; expected \(3, 2\)",
        ),
        (
            lambda rest, time: rest * (np.nan if time > 0.015 else 1.0),
            r"not finite at t = 0\.02 s for point 0 \(3 in all\)",
        ),
        (lambda rest, time: None if time > 0.015 else rest, r"returned object at t = 0\.02 s; expected numbers"),
        (lambda rest, time: "up" if time > 0.015 else rest, "expected numbers"),
    ],
)
def test_a_motion_that_goes_wrong_is_named_and_changes_nothing(solver, motion, message):
    body = slab(2, supports=[PrescribedMotion("left", motion)])
    _, state, stepper = ready(Scene([body], solver, gravity=(0.0, -1.0)))
    stepper.step(state, 0.01)
    before = state.displacement
    with pytest.raises(SceneError, match=f"body 'slab': the prescribed motion .*{message}"):
        stepper.step(state, 0.01)
    np.testing.assert_array_equal(state.displacement, before)
    assert state.time == 0.01


def test_a_motion_that_is_not_finite_names_the_meshs_point():
    def motion(rest, time):
        x = rest.copy()
        x[1] = np.inf
        return x

    body = slab(2, supports=[PrescribedMotion("right", motion)])
    point = body.mesh.select_points("right")[1]
    with pytest.raises(SceneError, match=rf"t = 0 s for point {point} \(1 in all\)"):
        Model(Scene([body], SymplecticEuler()), dtype="float64").state()


def still(rest, time):
    return rest


@pytest.mark.parametrize(
    ("supports", "message"),
    [
        ([Pin("nowhere")], "body 'slab', Pin: .*nowhere"),
        ([Pin([99])], "body 'slab', Pin: .*99"),
        ([PrescribedMotion("nowhere", still)], "body 'slab', PrescribedMotion: .*nowhere"),
        ([Pin("left", axes=(2,))], r"Pin: axes \(2,\) must be among 0..1"),
        ([Pin("left", axes=())], r"axes \(\) must be"),
        ([Pin("left", axes=(-1,))], "axes"),
        ([Pin("left", axes=(0.5,))], "axes"),
        ([Pin("left", axes="y")], "axes"),
        ([Pin("left"), PrescribedMotion("bottom", still)], "component 0 of point 0 .* Pin and by a PrescribedMotion"),
        (
            [PrescribedMotion("left", still), PrescribedMotion("left", turn)],
            "claimed by a PrescribedMotion and by a Pres",
        ),
        (["left"], "'left' is not a Pin or PrescribedMotion"),
    ],
)
def test_refuses_supports(supports, message):
    with pytest.raises(SceneError, match=message):
        Model(Scene([slab(2, supports=supports)], SymplecticEuler()), dtype="float64")


def test_a_pin_and_a_motion_of_other_components_go_together():
    supports = [Pin("left", axes=(0,)), PrescribedMotion("left", still, axes=(1,))]
    assert Model(Scene([slab(2, supports=supports)], SymplecticEuler()), dtype="float64").supports.count == 3


def test_refuses_a_motion_that_is_not_a_function():
    with pytest.raises(SceneError, match="must be a function"):
        PrescribedMotion("left", np.zeros(3))
