"""Explicit steps: the stability limit and its estimate, damping."""

import numpy as np
import pytest
import warp as wp
from helpers import irregular_mesh
from stepping import EXPLICIT, MATERIALS, advance, dense_stiffness, mean, modes, ready, slab, solver_name

from warpfem.boundary import BoxWalls, Pin, Plane
from warpfem.errors import SimulationError
from warpfem.materials import LinearElasticity, NeoHookean
from warpfem.mesh import Mesh
from warpfem.scene import Body, Scene
from warpfem.solvers import SymplecticEuler, VelocityVerlet


def irregular(dim, **settings):
    density = np.linspace(500.0, 2000.0, irregular_mesh(dim).cell_count)
    return Body("body", irregular_mesh(dim), MATERIALS[dim], density=density, **settings)


def cell_limit(model):
    """2 / omega of the stiffest cell on its own, by dense eigenvalues."""
    (block,) = model.blocks
    body = model.scene.bodies[0]
    mass = body.density * body.mesh.cell_volumes / (model.dim + 1)
    size = model.dim * (model.dim + 1)
    values = np.linalg.eigvalsh(model.element_stiffness()[0].reshape(block.count, size, size) / mass[:, None, None])
    return 2.0 / np.sqrt(values.max())


@pytest.mark.parametrize(("dim", "slack"), [(2, 0.07), (3, 0.12)])
def test_estimate_is_a_lower_bound_near_the_limit_of_the_stiffest_cell(dim, slack):
    model, _, stepper = ready(Scene([irregular(dim)], SymplecticEuler()))
    estimate, cell = stepper.stable_dt(), cell_limit(model)
    true = 2.0 / modes(model)[0][-1]
    assert (1.0 - slack) * cell <= estimate <= cell <= true
    assert estimate > 0.6 * true  # cells share their points with others that are less stiff


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("solver", EXPLICIT, ids=solver_name)
def test_true_limit_separates_stable_from_unstable(solver, dim):
    def energy_growth(fraction, steps):
        rng = np.random.default_rng(1)
        noise = 1e-9 * rng.normal(size=irregular_mesh(dim).points.shape)  # small: about rest everything is linear
        model, state, stepper = ready(Scene([irregular(dim, velocity=noise)], solver))
        stepper._limit = np.inf  # the estimate is below the limit that is tried
        start = model.energies(state).total
        advance(stepper, state, fraction * 2.0 / modes(model)[0][-1], steps)
        return model.energies(state).total / start

    assert energy_growth(0.9, 300) < 10.0  # bounded: the scheme conserves another energy, near this one
    assert energy_growth(1.05, 20) > 1e6  # the fastest mode grows by 1.88 a step


@pytest.mark.parametrize("solver", EXPLICIT, ids=solver_name)
def test_refuses_a_dt_above_the_limit(solver):
    _, state, stepper = ready(Scene([slab(2, velocity=(1.0, 0.0))], solver))
    limit = stepper.stable_dt()
    stepper.step(state, 0.999 * limit)
    before = state.displacement
    with pytest.raises(SimulationError) as error:
        stepper.step(state, 1.001 * limit)
    for number in (f"dt = {1.001 * limit:.4g} s", f"{limit:.4g} s:", "BackwardEuler"):
        assert number in str(error.value)
    np.testing.assert_array_equal(state.displacement, before)
    assert state.time == pytest.approx(0.999 * limit)


def test_contact_is_part_of_the_limit():
    def limits(obstacles):
        model, state, stepper = ready(Scene([slab(2)], SymplecticEuler(), obstacles=obstacles))
        K = dense_stiffness(model).reshape(model.point_count, 2, model.point_count, 2)
        if model.contact is not None:
            state.assign(displacement=np.full((model.point_count, 2), -0.01))
            blocks = wp.zeros(model.point_count, dtype=model.types.matrix, device=model.device)
            model.contact.add_blocks(state.u, blocks)
            every = np.arange(model.point_count)
            K[every, :, every, :] += blocks.numpy()
        root = np.sqrt(np.repeat(model.lumped_mass, 2))
        size = 2 * model.point_count
        true = 2.0 / np.sqrt(np.linalg.eigvalsh(K.reshape(size, size) / np.outer(root, root))[-1])
        return stepper.stable_dt(), true

    free, _ = limits([])
    for stiffness in (None, 1e8):
        floor = Plane((0.0, 0.0), (0.0, 1.0), stiffness=stiffness)
        estimate, true = limits([floor])
        assert estimate <= true
        assert estimate < free
    assert estimate > 0.7 * true  # where contact is the stiffest of all
    # a point touches at most walls that are perpendicular, whose stiffnesses do not add up
    walls, _ = limits([BoxWalls((0.0, 0.0), (2.0, 1.0), stiffness=1e8)])
    assert walls == estimate
    two, _ = limits([floor, floor])
    assert two < 0.8 * estimate


def test_a_first_state_that_is_stiffer_than_rest_lowers_the_limit():
    stretched = Body("body", Mesh.box((1.0, 1.0, 1.0), (1, 1, 1)), MATERIALS[3], displacement=lambda x: 1.5 * x)
    _, state, stepper = ready(Scene([stretched], SymplecticEuler()))
    with pytest.raises(SimulationError, match="above the stability limit"):
        stepper.step(state, 0.95 * stepper.stable_dt())


@pytest.mark.parametrize("solver", EXPLICIT, ids=solver_name)
def test_refuses_a_first_state_without_a_stiffness(solver):
    mesh = Mesh.rectangle((1.0, 1.0), (2, 2))
    inverted = np.zeros((9, 2))
    inverted[8] = -0.6  # the corner (1, 1)
    _, state, stepper = ready(Scene([Body("soft", mesh, NeoHookean(E=1e4, nu=0.3), displacement=inverted)], solver))
    with pytest.raises(SimulationError, match=r"cell \d of body 'soft' has J = -0\.2"):
        stepper.step(state, 1e-4)
    np.testing.assert_array_equal(state.displacement, inverted)


@pytest.mark.parametrize("solver", EXPLICIT, ids=solver_name)
def test_damping_of_a_free_body_is_the_exact_decay(solver):
    alpha, dt, n = 5.0, 0.01, 30
    start = np.array([1.0, -2.0])
    model, state, stepper = ready(Scene([slab(2, velocity=start)], solver, damping=alpha))
    advance(stepper, state, dt, n)
    np.testing.assert_allclose(mean(model, state.velocity), np.exp(-alpha * n * dt) * start, rtol=1e-13)


@pytest.mark.parametrize("solver", EXPLICIT, ids=solver_name)
def test_damped_fall_reaches_the_terminal_velocity(solver):
    alpha, g = 20.0, 9.0
    model, state, stepper = ready(Scene([slab(2)], solver, gravity=(0.0, -g), damping=alpha))
    advance(stepper, state, 0.005, 300)
    # symplectic Euler kicks after the decay: dt g / (1 - exp(-alpha dt)); Verlet in the middle of it
    decay = np.exp(-alpha * 0.005)
    terminal = 0.005 * g / (1.0 - decay) * (np.sqrt(decay) if isinstance(solver, VelocityVerlet) else 1.0)
    assert mean(model, state.velocity)[1] == pytest.approx(-terminal, rel=1e-10)
    assert terminal == pytest.approx(g / alpha, rel=0.06)


def test_stiff_thin_cells_set_the_limit():
    thin = Mesh.rectangle((1.0, 0.01), (4, 1))
    limits = []
    for mesh in (thin, thin.transformed(2.0)):
        scene = Scene([Body("thin", mesh, LinearElasticity(E=1e5, nu=0.3), supports=[Pin("left")])], SymplecticEuler())
        limits.append(ready(scene)[2].stable_dt())
    assert limits[1] == pytest.approx(2.0 * limits[0])  # a length over a wave speed
    assert limits[0] < 0.01 / np.sqrt(1e5 / 1000.0)
