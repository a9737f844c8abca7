"""All solvers alike: order of accuracy, conservation, free fall, refused steps, and nothing that a scene lacks."""

import re
import subprocess
import sys

import numpy as np
import pytest
import stepping
import warp as wp
from stepping import EXPLICIT, MIDPOINT, SOLVERS, advance, mean, ready, slab, solver_name

from warpfem.boundary import Pin, Plane, PointForce, PrescribedMotion
from warpfem.errors import SimulationError
from warpfem.scene import Scene
from warpfem.solvers import SOLVERS as REGISTRY
from warpfem.solvers import BackwardEuler, SymplecticEuler, VelocityVerlet


def swing(x):
    """A smooth initial velocity of bodies pinned at x = 0."""
    v = np.zeros_like(x)
    v[:, 1] = 0.3 * x[:, 0] ** 2
    v[:, 0] = 0.1 * x[:, 0]
    return v


def push(rest, time):
    """The end at x = 0 moves on a smooth path from rest."""
    return rest + np.array([0.0, 0.1 * (1.0 - np.cos(8.0 * time)), 0.0])[: rest.shape[1]]


CASES = {
    "free": dict(supports=[Pin("left")]),
    "damped": dict(supports=[Pin("left")], damping=3.0),
    "driven": dict(supports=[PrescribedMotion("left", push)]),
}


def swung(solver, case, dim, steps, duration=0.32):
    """Positions of the free points after the swing."""
    settings = dict(CASES[case])
    damping = settings.pop("damping", 0.0)
    body = slab(dim, velocity=swing, **settings)
    _, state, stepper = ready(Scene([body], solver, gravity=(1.0, -2.0, 0.5)[:dim], damping=damping))
    advance(stepper, state, duration / steps, steps)
    return state.displacement


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("dim", [2, pytest.param(3, marks=pytest.mark.slow)])
@pytest.mark.parametrize("solver", SOLVERS, ids=solver_name)
def test_order_in_dt(solver, dim, case):
    # Prescribed motion keeps the order: positions of held points are exact at every step. (Their velocities
    # are the mean over the step, of first order, but no force depends on them.)
    steps = {1: 192, 2: 96 if solver in EXPLICIT else 48, 3: 24}[solver.order]
    reference = swung(VelocityVerlet(), case, dim, 1536)
    coarse, fine = (np.abs(swung(solver, case, dim, n) - reference).max() for n in (steps, 2 * steps))
    assert np.log2(coarse / fine) == pytest.approx(solver.order, abs=0.12)
    assert fine < 0.05 * np.abs(reference).max()


def test_registry_names_the_solvers():
    assert {name: cls().order for name, cls in REGISTRY.items()} == {
        "symplectic_euler": 1,
        "velocity_verlet": 2,
        "backward_euler": 1,
        "implicit_midpoint": 2,
        "sdirk2": 2,
        "sdirk3": 3,
        "quasistatic": 0,
    }


def spin(x):
    v = np.cross([0.3, -0.5, 2.0], x - [1.0, 0.5, 0.5])
    return v + 0.2 * np.sin(3.0 * x[:, ::-1])


def angular_momentum(model, state):
    x = model.rest_points + state.displacement
    return np.sum(model.lumped_mass[:, None] * np.cross(x, state.velocity), axis=0)


@pytest.mark.parametrize("solver", SOLVERS, ids=solver_name)
def test_free_flight_conserves_momentum(solver):
    model, state, stepper = ready(Scene([slab(3, velocity=spin)], solver))
    linear, angular = mean(model, state.velocity), angular_momentum(model, state)
    advance(stepper, state, 0.01, 60)
    # 1e-10: the tolerance of the implicit solves; explicit steps have rounding alone
    rounding = 1e-13 if solver in EXPLICIT else 1e-10
    np.testing.assert_allclose(mean(model, state.velocity), linear, rtol=0, atol=rounding)
    if solver in EXPLICIT:  # both conserve it exactly: x_n+1 - x_n is along v, and internal torques sum to 0
        np.testing.assert_allclose(angular_momentum(model, state), angular, rtol=1e-12)
    elif solver == MIDPOINT:
        np.testing.assert_allclose(angular_momentum(model, state), angular, rtol=0, atol=1e-10 * np.abs(angular).max())
    else:
        assert np.linalg.norm(angular_momentum(model, state)) < (1.0 - 1e-6) * np.linalg.norm(angular)


@pytest.mark.parametrize("solver", EXPLICIT, ids=solver_name)
def test_explicit_energy_stays_bounded(solver):
    def errors(dt, steps):
        model, state, stepper = ready(Scene([slab(3, velocity=spin)], solver))
        start = model.energies(state).total
        history = []
        advance(stepper, state, dt, steps, lambda: history.append(model.energies(state).total / start - 1.0))
        return np.abs(history)

    dt = 0.008
    coarse, fine = errors(dt, 2000), errors(dt / 2, 1000)
    assert coarse[1000:].max() < 1.2 * coarse[:1000].max()  # no drift
    assert coarse.max() < 0.05
    # the shadow energy is off by dt^order
    assert np.log2(coarse[:500].max() / fine.max()) == pytest.approx(solver.order, abs=0.4)


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("solver", SOLVERS, ids=solver_name)
def test_free_fall_is_the_parabola_of_the_scheme(solver, dim):
    g = np.array([1.0, -9.0, 2.0][:dim])
    start = np.array([0.5, 2.0, -1.0][:dim])
    dt, n = 0.01, 40
    _, state, stepper = ready(Scene([slab(dim, velocity=start)], solver, gravity=g))
    advance(stepper, state, dt, n)
    parabola = n * (n + 1) if solver.order == 1 else n * n
    expected = start * n * dt + 0.5 * g * dt * dt * parabola
    # implicit: each step's CG leaves 1e-13, or Newton 1e-10, of the force
    tolerance = 1e-12 if solver in EXPLICIT else 1e-9
    np.testing.assert_allclose(state.displacement, np.tile(expected, (len(state.displacement), 1)), rtol=tolerance)
    np.testing.assert_allclose(
        state.velocity, np.tile(start + n * dt * g, (len(state.velocity), 1)), rtol=0, atol=10 * tolerance
    )
    assert state.time == pytest.approx(n * dt)


@pytest.mark.parametrize("dt", [0.0, -0.01, np.nan, np.inf])
@pytest.mark.parametrize("solver", SOLVERS[1:3], ids=solver_name)
def test_refuses_a_dt_that_is_not_positive(solver, dt):
    _, state, stepper = ready(Scene([slab(2)], solver))
    with pytest.raises(SimulationError, match="dt must be a finite number > 0"):
        stepper.step(state, dt)
    assert (state.time, state.revision) == (0.0, 0)


@pytest.mark.parametrize("solver", SOLVERS, ids=solver_name)
def test_one_stepper_serves_several_states(solver):
    model, first, stepper = ready(Scene([slab(2, velocity=swing, supports=[Pin("left")])], solver))
    results = []
    for used in (stepper, solver.stepper(model)):
        other = model.state()
        other.assign(displacement=0.01 * model.rest_points)
        if used is stepper:
            advance(stepper, first, 0.005, 1)
            assert first.revision == other.revision  # nothing but the state itself tells the two apart
        advance(used, other, 0.005, 2)
        results.append(other.displacement)
    np.testing.assert_array_equal(*results)


def test_verlet_sees_that_a_state_was_changed():
    scene = Scene([slab(2, velocity=swing)], VelocityVerlet())
    model, state, stepper = ready(scene)
    advance(stepper, state, 0.005, 1)
    changed = np.random.default_rng(0).normal(scale=0.02, size=(model.point_count, 2))
    state.assign(displacement=changed)
    fresh = state.copy()
    advance(stepper, state, 0.005, 1)
    advance(scene.solver.stepper(model), fresh, 0.005, 1)
    np.testing.assert_array_equal(state.displacement, fresh.displacement)


# ---- nothing that a scene does not require

FLOOR = Plane((0.0, 0.0), (0.0, 1.0))
ROUGH = Plane((0.0, 0.0), (0.0, 1.0), friction=0.5)


def launched(monkeypatch, solver, supports=(), loads=(), **settings):
    """The model, and the kernels that making it, two steps and the energies launch, as "part.kernel"."""
    names = set()
    original = wp.launch

    def launch(kernel, *args, **kwargs):
        part = re.match(r"warpfem\.(\w+)_2_float64|", kernel.module.name).group(1) or "unique"
        names.add(f"{part}.{kernel.key.rpartition('__')[2]}")
        return original(kernel, *args, **kwargs)

    with monkeypatch.context() as patch:
        patch.setattr(wp, "launch", launch)
        body = slab(2, supports=supports, loads=loads, velocity=lambda x: x @ [[3.0, 1.0], [0.0, -5.0]])
        model, state, stepper = ready(Scene([body], solver, **settings))
        for _ in range(2):
            stepper.step(state, 1e-3)
        model.energies(state)
    return model, names


NORMAL = {"contact_plane.contact_force", "contact_plane.contact_energy"}
BLOCKS = {"contact_plane.contact_blocks"}
TERMS = {
    "gravity": (dict(gravity=(0.0, -9.8)), set(), {"implicit.free_flight"}),
    "load": (dict(loads=[PointForce("right", (1.0, 0.0))]), set(), {"implicit.free_flight"}),
    "damping": (dict(damping=1.0), set(), set()),
    "pin": (
        dict(supports=[Pin("left")]),
        {"supports.hold"},
        {"supports.hold", "supports.project"},
    ),
    "contact": (dict(obstacles=[FLOOR]), NORMAL, NORMAL | BLOCKS),
    "friction": (
        dict(obstacles=[ROUGH]),
        NORMAL | {"contact_plane.friction_limit", "contact_plane.friction_impulse"},
        NORMAL | BLOCKS | {f"contact_plane.friction_{part}" for part in ("limit", "energy", "force", "blocks")},
    ),
}


@pytest.mark.parametrize("term", TERMS)
@pytest.mark.parametrize("solver", [SymplecticEuler(), BackwardEuler()], ids=solver_name)
def test_a_term_adds_exactly_its_kernels(monkeypatch, solver, term):
    settings, explicit, implicit = TERMS[term]
    # the load's potential is a scalar product, which an explicit scene without loads has no use for
    explicit = explicit | ({"points.dot"} if term in ("gravity", "load") else set())
    _, without = launched(monkeypatch, solver)
    _, with_term = launched(monkeypatch, solver, **settings)
    assert with_term - without == (explicit if solver in EXPLICIT else implicit)
    assert without <= with_term


@pytest.mark.parametrize("solver", [SymplecticEuler(), BackwardEuler()], ids=solver_name)
def test_a_bare_scene_has_no_optional_term(monkeypatch, solver):
    model, names = launched(monkeypatch, solver)
    assert (model.supports, model.contact, model.dead_load) == (None, None, None)
    assert not [name for name in names if name.startswith(("contact", "supports"))]
    if solver in EXPLICIT:
        assert names == {
            "unique.element_force",
            "unique.kick_drift",
            "unique.flush_subnormals",
            "unique.restore_subnormals",
            "unique.element_frequency_bound",  # once, for the stability limit
            "unique.element_frequency",  # now and then, to follow it
            "unique.element_energy",  # of model.energies
            "points.kinetic_energy",
        }


BARE = """
import sys
sys.path[:0] = [{tests!r}]
from stepping import *
_, state, stepper = ready(Scene([slab(2)], {solver}))
stepper.step(state, 1e-3)
print(*sorted({{"warpfem.contact", "warpfem.supports", "warpfem.linear", "pxr"}} & set(sys.modules)))
"""


@pytest.mark.parametrize("solver", ["SymplecticEuler()", "BackwardEuler()"])
def test_a_bare_scene_does_not_import_optional_terms(solver):
    source = BARE.format(solver=solver, tests=stepping.__file__.rpartition("/")[0])
    result = subprocess.run([sys.executable, "-c", source], capture_output=True, text=True, check=True, timeout=300)
    loaded = result.stdout.splitlines()[-1].split() if result.stdout.strip() else []
    assert not {"warpfem.contact", "warpfem.supports"} & set(loaded)
