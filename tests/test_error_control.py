"""Implicit steps by an error target: the estimate, the steps that follow it, and runs that use it."""

import numpy as np
import pytest
from stepping import modes, ready, slab, solver_name

import warpfem as wf
from warpfem.commands.run import _summary_text
from warpfem.explain import explain
from warpfem.solvers.error_control import controlled_step
from warpfem.solvers.stability import largest_frequency

SCHEMES = [wf.SDIRK2, wf.SDIRK3]


def names(scheme):
    return scheme.name


@pytest.mark.parametrize("scheme", SCHEMES, ids=names)
def test_the_estimate_is_the_error_of_a_step_of_a_linear_mode(scheme):
    solver = scheme(error=1.0, tolerance=1e-12)
    model, state, stepper = ready(wf.Scene([slab(2, supports=[wf.Pin("left")])], solver))
    free = model.rest_points[:, :1] > 0.0
    omega, shapes = modes(model, np.broadcast_to(free, (model.point_count, 2)))
    omega, shape = omega[1], shapes[1]
    phase = 0.7
    dt = 0.05 / omega
    state.assign(displacement=0.01 * np.cos(phase) * shape, velocity=-0.01 * omega * np.sin(phase) * shape)
    report = stepper.try_step(state, dt)
    error = state.displacement - 0.01 * np.cos(phase + omega * dt) * shape
    mass = model.lumped_mass
    norm = np.sqrt(mass @ (error**2).sum(axis=1) / mass.sum()) / np.hypot(2.0, 1.0)
    assert report.error * dt == pytest.approx(norm, rel=0.1)  # both grow with dt^(order + 1), up to higher powers


def swing(x):
    v = np.zeros_like(x)
    v[:, 1] = 0.6 * x[:, 0] ** 2
    return v


def swung(solver, duration, frames, **scene):
    """A cantilever's displacement after a swing, the steps taken, and the body's size."""
    body = slab(2, velocity=swing, supports=[wf.Pin("left")])
    _, state, stepper = ready(wf.Scene([body], solver, **scene))
    interval, steps = duration / frames, []
    wanted = interval
    for frame in range(1, frames + 1):
        while (left := frame * interval - state.time) > 1e-9 * interval:
            step = controlled_step(stepper, solver.order, state, left, wanted, interval)
            assert step.report.error <= 1.0
            wanted = step.wanted
            steps.append(step.dt)
    assert state.time == pytest.approx(duration, rel=1e-12)
    return state.displacement, np.array(steps)


@pytest.mark.parametrize("scheme", SCHEMES, ids=names)
def test_the_error_follows_the_target(scheme):
    duration, errors = 0.5, []
    body = slab(2, velocity=swing, supports=[wf.Pin("left")])
    model, state, stepper = ready(wf.Scene([body], wf.VelocityVerlet()))
    count = int(np.ceil(duration * largest_frequency(model) / 0.05))
    for _ in range(count):
        stepper.step(state, duration / count)
    mass = model.lumped_mass
    for target in (1e-1, 1e-2, 1e-3):
        u, _ = swung(scheme(error=target, tolerance=1e-7), duration, 4)
        difference = ((u - state.displacement) ** 2).sum(axis=1)
        errors.append(np.sqrt(mass @ difference / mass.sum()) / np.hypot(2.0, 1.0) / (target * duration))
    assert 0.05 < min(errors[1:]) and max(errors) < 2.0  # the first is that of the longest step allowed


def falling_block(solver, **settings):
    mesh = wf.Mesh.rectangle((1.0, 0.5), (4, 2), origin=(0.0, 0.2))
    block = wf.Body("block", mesh, wf.LinearElasticity(E=1e5, nu=0.3))
    floor = wf.Plane((0.0, 0.0), (0.0, 1.0))
    settings = {"gravity": (0.0, -9.81), "obstacles": [floor], "fps": 20.0, "frames": 10, **settings}
    return wf.Scene([block], solver, **settings)


@pytest.mark.parametrize("scheme", SCHEMES, ids=names)
def test_steps_shrink_at_an_impact_and_grow_after_it(scheme):
    # it falls for 0.2 s, and bounces until damping ends it
    simulation = wf.Simulation(falling_block(scheme(error=1e-2), damping=6.0, frames=40), dtype="float64")
    lengths, times = [], []
    while simulation.state.time < 2.0 - 1e-9:
        before = simulation.state.time
        simulation.step_towards(0.05 * (int(before / 0.05 + 1e-9) + 1))
        lengths.append(simulation.dt)
        times.append(before)
    lengths, times = np.array(lengths), np.array(times)
    impact = lengths[(times > 0.15) & (times < 0.5)].min()
    assert lengths[times > 1.8].min() > 4.0 * impact
    assert lengths[times < 0.09].max() > 2.0 * impact
    assert simulation.summary.rejected_steps > 0


def test_frames_are_at_their_times_and_the_summary_tells_the_steps():
    simulation = wf.Simulation(falling_block(wf.SDIRK2(error=1e-2)))
    times = [frame.time for frame in simulation.frames()]
    np.testing.assert_allclose(times, np.arange(11) / 20.0, rtol=1e-12)
    summary = simulation.summary
    assert 0.0 < summary.shortest_dt < 0.5 * summary.longest_dt
    assert summary.longest_dt == pytest.approx(1.0 / 20.0)
    assert summary.rejected_steps > 0 and summary.steps > 20
    assert summary.unconverged_steps == 0


def test_the_command_tells_the_range_of_steps():
    simulation = wf.Simulation(falling_block(wf.SDIRK2(error=1e-2)))
    list(simulation.frames())
    summary = simulation.summary
    length = f"{summary.shortest_dt:.4g} to {summary.longest_dt:.4g} s"
    told = f"{summary.steps} steps of {length} ({summary.rejected_steps} more were tried and not taken)"
    assert told in _summary_text(summary, simulation)
    fixed = wf.Simulation(falling_block(wf.SDIRK2(), frames=2))
    list(fixed.frames())
    assert "3 frames, 2 steps of 0.05 s, 0.100 s simulated" in _summary_text(fixed.summary, fixed)


def test_explain_tells_the_range_of_steps():
    explanation = explain(falling_block(wf.SDIRK2(error=1e-2)))
    assert "dt follows the error target: 0.0" in explanation.stepping


def test_a_run_without_a_target_estimates_nothing():
    def arrays(solver):
        return len(wf.Simulation(falling_block(solver, dt="auto")).stepper.arrays())

    assert arrays(wf.SDIRK2()) == arrays(wf.SDIRK2(error=1e-2)) - 1
    fixed = wf.Simulation(falling_block(wf.SDIRK2(), frames=1))
    list(fixed.frames())
    assert fixed.summary.wanted_dt is None and fixed.summary.rejected_steps == 0
    assert fixed.summary.shortest_dt == fixed.summary.longest_dt == fixed.dt


def test_a_rejected_step_leaves_the_state():
    _, state, stepper = ready(wf.Scene([slab(2, velocity=swing, supports=[wf.Pin("left")])], wf.SDIRK2(error=1e-6)))
    u, v = state.displacement, state.velocity
    report = stepper.try_step(state, 0.05)
    assert report.error > 1.0
    np.testing.assert_array_equal(state.displacement, u)
    np.testing.assert_array_equal(state.velocity, v)
    assert (state.time, state.revision) == (0.0, 0)


def test_a_step_that_cannot_be_solved_is_shortened():
    # to bend this far takes more iterations than allowed unless the steps are short
    body = slab(2, velocity=lambda x: 8.0 * swing(x), supports=[wf.Pin("left")], material=wf.StableNeoHookean(1e5, 0.3))
    _, state, stepper = ready(wf.Scene([body], wf.SDIRK2(error=1e3, max_iterations=3)))
    step = controlled_step(stepper, 2, state, 0.2, 0.2, 0.2)
    assert step.rejected > 0 and step.dt < 0.2
    assert step.report.converged
    assert state.time == step.dt


def test_a_target_that_no_step_meets_ends_the_run():
    def shake(rest, time):  # at random: no step is short enough
        return rest + 0.1 * np.random.default_rng(hash(time) % 2**32).normal(size=2)

    body = slab(2, supports=[wf.PrescribedMotion("left", shake)])
    _, state, stepper = ready(wf.Scene([body], wf.SDIRK2(error=1e-9)))
    with pytest.raises(wf.SimulationError, match=r"t = 0 s: no step of more than .* s meets the error target"):
        controlled_step(stepper, 2, state, 0.05, 0.05, 0.05)
    np.testing.assert_array_equal(state.velocity, 0.0)
    assert state.time == 0.0


@pytest.mark.parametrize("solver", [wf.SDIRK2(error=1e-2)], ids=solver_name)
def test_a_dt_beside_a_target_is_refused(solver):
    with pytest.raises(wf.SceneError, match='SDIRK2 with an error target chooses dt: take dt="auto"'):
        wf.Simulation(falling_block(solver, dt=0.01))


@pytest.mark.parametrize("error", [0.0, -1.0, np.nan, np.inf, "small", True])
def test_refuses_a_target_that_is_not_positive(error):
    with pytest.raises(wf.SceneError, match="SDIRK3: error must be a finite number > 0, or None, not"):
        wf.SDIRK3(error=error)


def test_a_solver_that_estimates_nothing_says_so():
    _, state, stepper = ready(wf.Scene([slab(2)], wf.VelocityVerlet()))
    with pytest.raises(NotImplementedError, match="does not estimate errors"):
        stepper.try_step(state, 1e-3)
