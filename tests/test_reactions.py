"""Reactions: they balance loads, obstacles and inertia, in force and in moment."""

import numpy as np
import pytest
from stepping import slab

from warpfem.boundary import BoxWalls, Pin, Plane, PointForce, PrescribedMotion, Sphere, Traction
from warpfem.errors import SimulationError
from warpfem.materials import LinearElasticity, NeoHookean
from warpfem.mesh import Mesh
from warpfem.model import Model
from warpfem.reactions import reactions
from warpfem.scene import Body, Scene
from warpfem.solvers import BackwardEuler, StaticEquilibrium

TOLERANCE = {"float32": 1e-4, "float64": 1e-9}


def scene(dim: int) -> Scene:
    """Two bodies with all kinds of supports and loads, pressed on a floor, a ball and walls."""
    zero = (0.0,) * (dim - 2)
    mesh = Mesh.rectangle((2.0, 1.0), (4, 2)) if dim == 2 else Mesh.box((2.0, 1.0, 1.0), (2, 1, 1))
    up = (0.0, 1.0, *zero)
    held = slab(
        dim,
        material=NeoHookean(E=1e5, nu=0.3),
        supports=[Pin("left"), PrescribedMotion("right", lambda rest, time: rest + 0.1 * time)],
        loads=[Traction("top", (50.0, -300.0, *zero))],
    )
    other = Body(
        "other",
        mesh.transformed(offset=(2.5, *[0.0] * (dim - 1))),
        NeoHookean(E=1e5, nu=0.3),
        supports=[Pin("left", axes=(0,)), Pin("left", axes=(0, 1) if dim == 2 else (1, 2))],
        loads=[PointForce("right", (20.0, -30.0, *zero))],
        element="quadratic",
    )
    return Scene(
        [held, other],
        BackwardEuler(tolerance=1e-9),
        gravity=(0.0, -50.0, *zero),
        damping=0.5,
        obstacles=[
            Plane((0.0, 0.02, *zero), up),
            Sphere((4.0, -0.6, *(0.5,) * (dim - 2)), 0.61),
            BoxWalls((-1.0,) * dim, (4.49,) * dim),
        ],
    )


def at_rest(dim: int, dtype: str = "float64"):
    model = Model(scene(dim), device="cpu", dtype=dtype)
    state = model.state()
    StaticEquilibrium(TOLERANCE[dtype] * 0.1).solve(model, state, time=1.0)
    return model, state, reactions(model, state)


@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize("dim", [2, 3])
def test_all_forces_balance(dim, dtype):
    model, _, found = at_rest(dim, dtype)
    scale = max(np.abs(part.total).max() for part in found.parts)
    assert np.abs(found.total).max() < TOLERANCE[dtype] * scale
    for about in (None, np.arange(1.0, dim + 1.0)):
        assert np.abs(found.moment(about)).max() < 4.0 * TOLERANCE[dtype] * scale  # with arms of up to 4 m
    assert not found.inertia.forces.any()
    for part in found.obstacles:
        assert np.linalg.norm(part.total) > 1e-3 * scale, part.name  # all take part
    assert found.obstacles[0].total[1] > 0.0
    assert found.obstacles[2].total[0] < 0.0
    weight = -50.0 * model.lumped_mass.sum()
    top = 2.0 * -300.0
    corners = -30.0 * len(model.scene.bodies[1].mesh.select_points("right"))
    assert found.loads.total[1] == pytest.approx(weight + top + corners, rel=1e-5)


@pytest.mark.parametrize("dim", [2, 3])
def test_names_and_what_each_support_holds(dim):
    _, _, found = at_rest(dim)
    first, second = ("x", "xy") if dim == 2 else ("x", "yz")
    assert [part.name for part in found.supports] == [
        "body 'slab', Pin 'left'",
        "body 'slab', PrescribedMotion 'right'",
        f"body 'other', Pin 'left' along {first}",
        f"body 'other', Pin 'left' along {second}",
    ]
    assert [part.name for part in found.obstacles] == [
        "obstacle 0, Plane",
        "obstacle 1, Sphere",
        "obstacle 2, BoxWalls",
    ]
    by_x, by_others = found.supports[2:]
    assert by_x.forces[:, 0].any() and not by_x.forces[:, 1:].any()
    assert by_others.forces[:, 1].any() and not by_others.forces[:, 0].any()  # x is the first pin's


def test_the_moment_of_a_clamp():
    mesh = Mesh.rectangle((2.0, 0.5), (8, 2))
    tip = PointForce("right", (0.0, -1.0))
    body = Body("beam", mesh, NeoHookean(E=1e8, nu=0.3), supports=[Pin("left")], loads=[tip])
    model = Model(Scene([body], BackwardEuler()), device="cpu", dtype="float64")
    state = model.state()
    StaticEquilibrium(1e-9).solve(model, state)
    (clamp,) = reactions(model, state).supports
    np.testing.assert_allclose(clamp.total, (0.0, 3.0), atol=1e-6)
    assert clamp.moment((0.0, 0.25)) == pytest.approx(6.0, rel=1e-4)  # three tip forces with arms of 2 m


@pytest.mark.parametrize("dim", [2, 3])
def test_reactions_of_a_step_balance_inertia(dim):
    model = Model(scene(dim), device="cpu", dtype="float64")
    state = model.state()
    stepper = model.scene.solver.stepper(model)
    dt = 1e-3
    for _ in range(3):
        before = state.velocity
        assert stepper.step(state, dt).parts == 1
    acceleration = (state.velocity - before) / dt
    found = reactions(model, state, acceleration)
    scale = max(np.abs(part.total).max() for part in found.parts)
    assert np.abs(found.total).max() < 1e-7 * scale
    assert np.abs(found.moment()).max() < 4e-7 * scale
    assert np.abs(found.inertia.total).max() > 1e-2 * scale
    statics = reactions(model, state)
    assert np.abs(statics.total).max() > 1e-2 * scale


def test_refuses_friction_and_wrong_accelerations():
    floor = Plane((0.0, 0.0), (0.0, 1.0), friction=0.5)
    model = Model(Scene([slab(2)], BackwardEuler(), obstacles=[floor]), device="cpu")
    with pytest.raises(SimulationError, match="depends on the way to a state"):
        reactions(model, model.state())
    model = Model(Scene([slab(2)], BackwardEuler()), device="cpu")
    with pytest.raises(SimulationError, match=r"acceleration must have shape \(15, 2\), not \(3,\)"):
        reactions(model, model.state(), np.zeros(3))


@pytest.mark.parametrize("dim", [2, 3])
def test_linear_elasticity_balances_at_the_rest_shape_and_knows_one_stress(dim):
    mesh = Mesh.rectangle((4.0, 1.0), (4, 1)) if dim == 2 else Mesh.box((4.0, 1.0, 1.0), (4, 1, 1))
    load = Traction("right", (200.0, -1e3, 0.0)[:dim])
    body = Body("beam", mesh, LinearElasticity(E=1e5, nu=0.3), supports=[Pin("left")], loads=[load])
    model = Model(Scene([body], BackwardEuler()), dtype="float64")
    state = model.state()
    StaticEquilibrium(tolerance=1e-10).solve(model, state)
    assert np.abs(state.displacement).max() > 0.5  # where rest and current places differ much
    found = reactions(model, state)
    np.testing.assert_allclose(found.total, 0.0, atol=1e-6)
    np.testing.assert_allclose(found.moment(), 0.0, atol=1e-5)
    assert np.abs(found.supports[0].moment()[-1] - (1e3 * 4.0 + 200.0 * 0.5)) < 1e-5
    stresses = model.stresses(state)
    np.testing.assert_array_equal(stresses.cauchy, stresses.first_piola_kirchhoff)
    _, von_mises = model.diagnostics(state)
    np.testing.assert_allclose(von_mises, stresses.von_mises, rtol=1e-10)
    faces = mesh.select_faces("right")
    P = stresses.first_piola_kirchhoff[mesh.face_cells[faces]]
    np.testing.assert_allclose(model.tractions(state)[faces], P[:, :dim, 0], atol=1e-9)
