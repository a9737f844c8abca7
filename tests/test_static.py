"""Static equilibrium: known answers, and what has none."""

import numpy as np
import pytest
from stepping import MATERIALS, all_forces, slab

from warpfem.boundary import Pin, Plane, PointForce, PrescribedMotion, Traction
from warpfem.errors import SceneError, SimulationError
from warpfem.materials import NeoHookean
from warpfem.mesh import Mesh
from warpfem.model import Model
from warpfem.scene import Body, Scene
from warpfem.solvers import BackwardEuler, StaticEquilibrium


def solved(body, **settings):
    model = Model(Scene([body], BackwardEuler(), **settings), device="cpu", dtype="float64")
    state = model.state()
    report = StaticEquilibrium(tolerance=1e-9).solve(model, state)
    assert report.converged
    return model, state


def test_uniaxial_stretch_of_a_neo_hookean_bar():
    material = NeoHookean(E=1e5, nu=0.3)
    mesh = Mesh.box((2.0, 1.0, 1.0), (2, 1, 1))
    rollers = [Pin("left", axes=(0,)), Pin("bottom", axes=(1,)), Pin("back", axes=(2,))]
    pull = 5e4
    model, state = solved(Body("bar", mesh, material, supports=rollers, loads=[Traction("right", (pull, 0.0, 0.0))]))
    F = model.stresses(state).deformation_gradient
    long, across = F[:, 0, 0], F[:, 1, 1]
    np.testing.assert_allclose(F, np.broadcast_to(np.diag([long[0], across[0], across[0]]), F.shape), atol=1e-9)
    log_j = np.log(long[0] * across[0] ** 2)
    mu, lam = material.mu, material.lam
    assert mu * (long[0] - 1 / long[0]) + lam * log_j / long[0] == pytest.approx(pull, rel=1e-8)
    assert mu * (across[0] - 1 / across[0]) + lam * log_j / across[0] == pytest.approx(0.0, abs=1e-5 * pull)
    assert long[0] > 1.3


@pytest.mark.parametrize("dim", [2, 3])
def test_forces_balance_with_prescribed_places_and_an_obstacle(dim):
    body = slab(
        dim,
        supports=[Pin("left"), PrescribedMotion("right", lambda rest, time: rest + 0.1)],
        velocity=np.ones(dim),
    )
    floor = Plane((0.0,) * dim, (0.0, 1.0, 0.0)[:dim])
    model, state = solved(body, gravity=(0.0, -50.0, 0.0)[:dim], obstacles=[floor])
    free = (model.rest_points[:, 0] > 0.0) & (model.rest_points[:, 0] < 2.0)
    forces = all_forces(model, state)
    assert np.abs(forces[free]).max() < 1e-7 * np.abs(forces[~free]).max()
    assert not state.velocity.any()
    np.testing.assert_allclose(state.displacement[model.rest_points[:, 0] == 2.0], 0.1)


FREE = {
    2: ["translation along x", "translation along y", "rotation about (1, 0.5)"],
    3: [
        "translation along x",
        "translation along y",
        "translation along z",
        "rotation about x through (1, 0.5, 0.5)",
        "rotation about y through (1, 0.5, 0.5)",
        "rotation about z through (1, 0.5, 0.5)",
    ],
}


@pytest.mark.parametrize("dim", [2, 3])
def test_a_free_body_has_no_equilibrium(dim):
    with pytest.raises(SceneError) as error:
        solved(slab(dim), gravity=(0.0, -9.8, 0.0)[:dim])
    assert f"body 'slab' can move freely: {'; '.join(FREE[dim])}." in str(error.value)


@pytest.mark.parametrize(
    ("supports", "modes"),
    [
        ([Pin("left", axes=(0,))], "translation along y; translation along z; rotation about x through"),
        ([Pin([0])], "rotation about x through (0, 0, 0); rotation about y through (0, 0, 0); rotation about z"),
        ([Pin([0, 2])], "freely: rotation about y through (0, 0.5, 0)."),
        ([Pin("bottom", axes=(1,))], "translation along x; translation along z; rotation about y through"),
        ([Pin([0, 11])], "freely: rotation about (1, 0.5, 0.5) through"),
    ],
)
def test_the_motions_that_supports_leave_free_are_named(supports, modes):
    with pytest.raises(SceneError) as error:
        solved(slab(3, supports=supports))
    assert modes in str(error.value)


def test_friction_and_failures_are_refused():
    held = slab(2, supports=[Pin("left")])
    with pytest.raises(SceneError, match="depends on the way there"):
        solved(held, obstacles=[Plane((0.0, 0.0), (0.0, 1.0), friction=0.5)])
    crushed = Body(
        "crushed",
        Mesh.rectangle((1.0, 1.0), (1, 1)),
        MATERIALS[2],
        supports=[Pin("left")],
        loads=[PointForce("right", (-1e6, 0.0))],
    )
    with pytest.raises(SimulationError, match=r"2 inverted cells: cell \d of body 'crushed' has J = -"):
        solved(crushed)


def test_every_part_of_a_body_needs_supports():
    one = Mesh.rectangle((1.0, 1.0), (1, 1))
    two = Mesh(
        np.concatenate([one.points, one.points + np.array([3.0, 0.0])]),
        np.concatenate([one.cells, one.cells + one.point_count]),
    )
    body = Body("pair", two, MATERIALS[2], supports=[Pin(np.arange(4))])
    with pytest.raises(SceneError, match="body 'pair', the part with point 4, can move freely: translation along x"):
        solved(body)


@pytest.mark.parametrize("value", [1, 2.5, None, True])
def test_refuses_settings(value):
    with pytest.raises(SceneError, match="StaticEquilibrium: max_iterations must be an integer >= 2"):
        StaticEquilibrium(max_iterations=value)
