"""Explicit steps: the stability limit and its estimate, damping."""

import re

import numpy as np
import pytest
import warp as wp
from helpers import irregular_mesh
from stepping import EXPLICIT, MATERIALS, advance, dense_stiffness, mean, modes, ready, slab, solver_name

from warpfem.boundary import BoxWalls, Pin, Plane, PrescribedMotion
from warpfem.errors import SimulationError, TimeStepError
from warpfem.materials import LinearElasticity, NeoHookean, StableNeoHookean
from warpfem.mesh import Mesh
from warpfem.model import Model
from warpfem.profiling import observe_launches
from warpfem.scene import Body, Scene
from warpfem.simulation import Simulation
from warpfem.solvers import SymplecticEuler, VelocityVerlet
from warpfem.solvers.stability import Watch, largest_frequency


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
        stepper._look = lambda *_: None
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


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("solver", EXPLICIT, ids=solver_name)
def test_an_unstable_run_is_stopped_within_some_steps(solver, dim):
    noise = 1e-9 * np.random.default_rng(1).normal(size=irregular_mesh(dim).points.shape)
    model, state, stepper = ready(Scene([irregular(dim, velocity=noise)], solver))
    stepper._limit = np.inf  # as if the body had become stiffer since
    stepper._interval = 10**9  # the alarm of fast points alone
    true = 2.0 / modes(model)[0][-1]
    with pytest.raises(TimeStepError, match="of the deformed bodies") as error:
        advance(stepper, state, 1.05 * true, 20)  # the fastest mode grows by 1.88 a step
    dt, limit = re.findall(r"([\d.]+) s[ :]", str(error.value))[1:3]
    assert (float(dt), float(limit)) == pytest.approx((1.05 * true, true), rel=2e-3)
    assert np.abs(state.velocity).max() < 1e-3


@pytest.mark.parametrize("solver", EXPLICIT, ids=solver_name)
def test_a_state_that_is_not_finite_is_named_at_the_next_step(solver):
    _, state, stepper = ready(Scene([slab(2)], solver))
    advance(stepper, state, 1e-4, 3)
    velocity = state.velocity
    velocity[4, 1] = np.nan
    state.v.assign(velocity)
    state.revision += 1
    with pytest.raises(
        SimulationError, match=r"t = 0\.0004 s: the displacement of point \d of body 'slab' is not finite"
    ):
        stepper.step(state, 1e-4)


def test_energy_out_of_nothing_is_a_blow_up():
    model, state, _ = ready(Scene([slab(2, velocity=(1.0, 0.0))], SymplecticEuler(), gravity=(0.0, -10.0)))
    watch = Watch(model, state)
    fallen = model.rest_points * 0.0 - [0.0, 5.0]
    state.assign(displacement=fallen, velocity=np.broadcast_to([1.0, -10.0], fallen.shape))
    watch.require_bounded(state, 1e-3)  # what gravity gave
    state.assign(velocity=np.broadcast_to([200.0, -10.0], fallen.shape))
    with pytest.raises(SimulationError, match=r"its energy has grown by .* fastest point is 0 of body 'slab'"):
        watch.require_bounded(state, 1e-3)


def squeezed(solver, dt):
    """A block between plates that squeeze it to a quarter."""

    def press(rest, time):
        return rest * [1.0, 1.0 - 0.75 * min(time / 0.4, 1.0)]

    body = slab(2, material=NeoHookean(E=1e7, nu=0.3), supports=[Pin("bottom"), PrescribedMotion("top", press)])
    return Scene([body], solver, dt=dt, fps=50.0, frames=20)


@pytest.mark.parametrize("solver", EXPLICIT, ids=solver_name)
def test_the_limit_is_followed_as_the_body_deforms(solver):
    limit = ready(squeezed(solver, "auto"))[2].stable_dt()
    strained = Simulation(squeezed(solver, 0.99 * limit), dtype="float64")
    with pytest.raises(TimeStepError, match=r"above the stability limit of the deformed bodies, 0\.0"):
        list(strained.frames())
    assert 0.1 < strained.state.time < 0.4

    simulation = Simulation(squeezed(solver, "auto"), dtype="float64")
    frames = list(simulation.frames())
    assert frames[-1].time == pytest.approx(0.4)
    assert simulation.summary.dt < simulation.summary.stable_dt < 0.7 * limit
    assert frames[-1].jacobian.min() == pytest.approx(0.25, rel=0.3)


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
    assert mean(model, state.velocity)[1] == pytest.approx(-g / alpha, rel=1e-10)


def test_stiff_thin_cells_set_the_limit():
    thin = Mesh.rectangle((1.0, 0.01), (4, 1))
    limits = []
    for mesh in (thin, thin.transformed(2.0)):
        scene = Scene([Body("thin", mesh, LinearElasticity(E=1e5, nu=0.3), supports=[Pin("left")])], SymplecticEuler())
        limits.append(ready(scene)[2].stable_dt())
    assert limits[1] == pytest.approx(2.0 * limits[0])  # a length over a wave speed
    assert limits[0] < 0.01 / np.sqrt(1e5 / 1000.0)


@pytest.mark.parametrize("dim", [2, 3])
def test_the_estimate_of_the_limit_turns_with_the_body(dim):
    body = slab(dim, material=StableNeoHookean(E=1e5, nu=0.49))
    model, state, _ = ready(Scene([body], SymplecticEuler()))
    at_rest = Watch(model, state).stable_dt(state.u)
    x = model.rest_points
    turned = np.column_stack([-x[:, 1], x[:, 0], *x[:, 2:].T])
    state.assign(displacement=turned - x)
    assert Watch(model, state).stable_dt(state.u) == pytest.approx(at_rest, rel=1e-6)
    assert at_rest == pytest.approx(2.0 / largest_frequency(model), rel=0.02)


def test_a_state_that_is_given_another_velocity_is_no_blow_up():
    _, state, stepper = ready(Scene([slab(2)], VelocityVerlet()))
    advance(stepper, state, 1e-4, 5)
    state.assign(velocity=np.broadcast_to([30.0, 0.0], state.velocity.shape))
    advance(stepper, state, 1e-4, 5)
    assert state.time == pytest.approx(1e-3)


def test_a_body_that_rides_with_its_support_is_no_blow_up():
    def ride(rest, time):
        return rest + np.array([1e4 * time, 0.0])

    body = slab(2, supports=[PrescribedMotion("left", ride)], velocity=(1e4, 0.0))
    simulation = Simulation(Scene([body], VelocityVerlet(), fps=100.0, frames=3), dtype="float64")
    *_, last = simulation.frames()
    assert np.abs(last.displacement[:, 0] - 300.0).max() < 0.1


def test_reactions_of_pins_raise_no_alarm(monkeypatch):
    """What a held point would do without its support looks fast; each alarm costs as much as some steps."""
    alarms = []
    bounded = Watch.require_bounded
    monkeypatch.setattr(Watch, "require_bounded", lambda *arguments: (alarms.append(1), bounded(*arguments)))
    mesh = Mesh.box((1, 0.2, 0.2), (20, 4, 4))
    body = Body("beam", mesh, StableNeoHookean(E=1e6, nu=0.3), supports=[Pin("left")])
    model = Model(Scene([body], VelocityVerlet(), gravity=(0, -9.81, 0)), device="cpu")
    stepper, state = VelocityVerlet().stepper(model), model.state()
    dt = 0.5 * stepper.stable_dt(state)
    for _ in range(3000):
        stepper.step(state, dt)
    assert len(alarms) < 30  # twice as fast each time


@pytest.mark.parametrize("solver", EXPLICIT, ids=solver_name)
def test_steps_that_come_again_are_graphs_with_the_same_bits(monkeypatch, solver):
    """With all that a step may consist of: loads, contact, friction, damping, and a moving support."""
    graphs = []
    launch = wp.capture_launch
    monkeypatch.setattr(wp, "capture_launch", lambda graph: (graphs.append(graph), launch(graph)))

    def slide(rest, time):
        return rest + np.array([time, 0.0])

    body = slab(2, supports=[PrescribedMotion("left", slide)], velocity=(1.0, 0.0))
    floor = Plane((0.0, 0.01), (0.0, 1.0), friction=0.3)
    scene = Scene([body], solver, gravity=(0, -9.81), damping=0.5, obstacles=[floor])
    results = []
    for as_graph in (False, True):
        _, state, stepper = ready(scene)
        stepper._as_graph = as_graph
        limit = stepper.stable_dt()
        for fraction in (0.25, 0.125, 0.25):
            advance(stepper, state, fraction * limit, 20)
        results.append((state.displacement, state.velocity))
        assert bool(graphs) == as_graph
    assert len(graphs) > 30  # a step of another length, or in which points become fast, is launched first
    np.testing.assert_array_equal(results[0], results[1])
    assert np.abs(results[0][0]).max() > 1e-3


@pytest.mark.parametrize("solver", EXPLICIT, ids=solver_name)
def test_kernels_that_are_observed_are_not_hidden_in_graphs(solver):
    _, state, stepper = ready(Scene([slab(2)], solver))
    with observe_launches() as seen:
        advance(stepper, state, 1e-4, 5)
    uses = {use.name: use.launches for use in seen.kernels.values()}
    assert uses["kick_drift"] >= 5
    assert not any("graph" in name for name in uses)


def test_steps_of_automatic_length_come_again():
    """What is left of a frame differs by roundings: as lengths of their own these would be launched and kept anew."""
    simulation = Simulation(Scene([slab(2)], VelocityVerlet(), gravity=(0.0, -9.81), dt="auto", frames=2))
    lengths = []
    take = simulation.stepper.advance

    def noted(state, dt, most):
        count, report = take(state, dt, most)
        lengths.extend([dt] * count)
        return count, report

    simulation.stepper.advance = noted
    *_, last = simulation.frames()
    assert last.time == pytest.approx(2 / 24, abs=1e-10)
    assert len(set(lengths)) < 0.2 * len(lengths)


@pytest.mark.parametrize("supports", [[Pin("left")], [PrescribedMotion("left", lambda rest, time: rest + 0.1 * time)]])
@pytest.mark.parametrize("solver", EXPLICIT, ids=solver_name)
def test_steps_taken_several_at_a_time_have_the_bits_of_single_ones(monkeypatch, solver, supports):
    """Where supports move, each step has its own place for them: then steps are taken one by one."""
    monkeypatch.setattr("warpfem.solvers.explicit.RECORDING", 1)
    floor = Plane((0.0, 0.01), (0.0, 1.0), friction=0.3)
    scene = Scene([slab(2, supports=supports, velocity=(1.0, 0.0))], solver, gravity=(0, -9.81), obstacles=[floor])
    states, counts = [], []
    for most in (1, 100):
        _, state, stepper = ready(scene)
        dt, left = 0.25 * stepper.stable_dt(), 53
        while left:
            count, _ = stepper.advance(state, dt, min(most, left))
            counts.append(count)
            left -= count
        states.append(state)
    assert max(counts) == (16 if isinstance(supports[0], Pin) else 1)
    assert states[0].time == states[1].time
    np.testing.assert_array_equal(states[0].displacement, states[1].displacement)
    np.testing.assert_array_equal(states[0].velocity, states[1].velocity)


def test_no_look_at_the_stability_is_passed_over(monkeypatch):
    """Whatever number of steps a caller asks for: a blow-up is to be seen where single steps would see it."""
    monkeypatch.setattr("warpfem.solvers.explicit.RECORDING", 1)
    _, state, stepper = ready(Scene([slab(2)], VelocityVerlet()))
    seen = []
    monkeypatch.setattr(Watch, "is_unstable", lambda *_: seen.append(stepper._steps))
    dt = 0.25 * stepper.stable_dt()
    while stepper._steps < 100:
        stepper.advance(state, dt, 12)
    assert seen == list(range(stepper._interval, 100, stepper._interval))


def test_graphs_of_many_steps_are_made_where_many_steps_are_taken():
    """Making one takes as long as some hundred steps of so small a body."""
    _, state, stepper = ready(Scene([slab(2)], VelocityVerlet()))
    dt, counts = 0.25 * stepper.stable_dt(), []
    while sum(counts) < 20000:
        counts.append(stepper.advance(state, dt, 100)[0])
    assert counts[:200] == [1] * 200 and counts[-1] == 16
