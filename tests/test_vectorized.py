"""Forces of several cells at a time: those of one at a time, with the same bits on any number of threads."""

import dataclasses
import functools
import gc
import signal
import threading
import time
import weakref

import numpy as np
import pytest

import warpfem as wf
from warpfem.barrier import Barriers
from warpfem.linear import tangent_operator
from warpfem.solvers import explicit, implicit
from warpfem.solvers.stability import Watch
from warpfem.strips import STRIP, cut_into_strips
from warpfem.subnormals import SubnormalsFlushed
from warpfem.threads import Team, share
from warpfem.vectorized import VectorizedForce

MESHES = {
    "box": wf.Mesh.box((1, 1, 1), (6, 6, 6)),
    "box of six": wf.Mesh.box((1, 1, 1), (3, 2, 2), split=6),
    "one cube": wf.Mesh.box((1, 1, 1), (1, 1, 1)),
    "rectangle": wf.Mesh.rectangle((2, 1), (30, 20)),
    "two triangles": wf.Mesh.rectangle((1, 1), (1, 1)),
}


@pytest.mark.parametrize("mesh", MESHES.values(), ids=MESHES)
def test_strips_hold_each_cell_once_with_its_points_in_a_row(mesh):
    strips = cut_into_strips(mesh.points, mesh.cells)
    assert sorted(strips.cells[strips.cells >= 0]) == list(range(mesh.cell_count))
    for k in range(STRIP):
        real = strips.cells[:, k] >= 0
        own = np.sort(strips.points[real, k : k + mesh.dim + 1], axis=1)
        np.testing.assert_array_equal(own, np.sort(mesh.cells[strips.cells[real, k]], axis=1))


def test_most_strips_are_full():
    mesh = MESHES["box"]
    assert mesh.cell_count / len(cut_into_strips(mesh.points, mesh.cells).cells) > 2.8


@pytest.mark.parametrize("axes", [(0, 1, 2), (1, 2, 0), (2, 0, 1)])
def test_a_half_of_the_strips_is_about_a_half_of_the_points(axes):
    """Along whichever axis points are numbered: threads would wait for what another one has just written."""
    mesh = wf.Mesh.box((1, 1, 1), (10, 10, 10))
    strips = cut_into_strips(mesh.points[:, axes], mesh.cells)
    of_strips = np.arange(len(strips.points)) < len(strips.points) // 2
    of_points = strips.points < len(mesh.points) // 2
    assert (of_points != of_strips[:, None]).mean() < 0.1


def _scene(mesh, material, **settings):
    return wf.Scene(
        [wf.Body("body", mesh, material)], wf.SymplecticEuler(), gravity=(0, -9.81, 0)[: mesh.dim], **settings
    )


@pytest.mark.parametrize(
    ("kind", "case"),
    [
        (wf.StableNeoHookean, "3D, single precision, one modulus"),
        (wf.NeoHookean, "2D, double precision, moduli per cell"),
        (wf.StableNeoHookean, "curved 3D, double precision, moduli per cell"),
        *(
            pytest.param(kind, case, marks=pytest.mark.slow)
            for kind in (
                wf.LinearElasticity,
                wf.StVenantKirchhoff,
                wf.NeoHookean,
                wf.StableNeoHookean,
                wf.FixedCorotated,
            )
            for case in (
                "3D, double precision, moduli per cell",
                "2D, single precision, one modulus",
                "curved 3D, single precision, one modulus",
                "curved 2D, double precision, moduli per cell",
            )
        ),
    ],
)
def test_the_forces_are_those_of_the_plain_kernel(kind, case):
    mesh = MESHES["box" if "3D" in case else "rectangle"]
    if "curved" in case:  # quadratic cells, whose gradients differ from one quadrature point to another
        straight = mesh.quadratic()
        bent = 0.1 * mesh.mean_edge_length * np.sin(7.0 * straight.points[:, ::-1])
        mesh = wf.Mesh(straight.points + bent, straight.cells)
    dtype, limit = ("float32", 2e-6) if "single" in case else ("float64", 1e-14)
    E = 1e5 if "one" in case else np.linspace(1e5, 1e6, mesh.cell_count)
    model = wf.Model(_scene(mesh, kind(E=E, nu=0.3)), device="cpu", dtype=dtype)
    state = model.state()
    state.assign(displacement=0.03 * mesh.mean_edge_length * np.random.default_rng(0).normal(size=mesh.points.shape))
    plain = model.internal_force(state)
    model.vectorize(explicit.VECTORIZED_CELLS)
    assert model.blocks[0].vectorized is not None
    difference = np.abs(model.internal_force(state) - plain).max()
    assert 0.0 < difference <= limit * np.abs(plain).max()  # equal bits would be those of the plain kernel


@pytest.mark.parametrize("order", [1, 2])
def test_cells_that_the_direct_stress_leaves_out_have_that_of_the_plain_kernel(order):
    """Fixed corotated from strains of 1e-7 to cells flattened and turned inside out."""
    mesh = MESHES["box"] if order == 1 else wf.Mesh.box((1, 1, 1), (4, 4, 4)).quadratic()
    model = wf.Model(_scene(mesh, wf.FixedCorotated(E=1e5, nu=0.3)), device="cpu")
    noise = np.random.default_rng(0).normal(size=mesh.points.shape)
    flattened = -mesh.points * (0.0, 0.0, 1.0)
    motions = [1e-8 * noise, 0.01 * noise, flattened + 0.01 * noise, 0.1 * noise, noise]
    states = [model.state() for _ in motions]
    for state, motion in zip(states, motions, strict=True):
        state.assign(displacement=motion)
    expected = [model.internal_force(state) for state in states]
    model.vectorize(explicit.VECTORIZED_CELLS)
    known = []
    for state, plain in zip(states, expected, strict=True):
        difference = np.abs(model.internal_force(state) - plain).max()
        assert 0.0 < difference <= 2e-6 * np.abs(plain).max()
        known.append(model.blocks[0].vectorized.known.numpy().copy())
    full = 2 ** (STRIP if order == 1 else mesh.shape.quadrature_count) - 1
    assert all((of_rows == full).all() for of_rows in known[:3])
    assert 0.0 < (known[4] < full).mean() < 1.0


@pytest.mark.parametrize(
    ("kind", "case"),
    [
        (wf.FixedCorotated, "3D, single precision, one modulus"),
        (wf.NeoHookean, "2D, double precision, moduli per cell"),
        *(
            pytest.param(kind, case, marks=pytest.mark.slow)
            for kind in (wf.LinearElasticity, wf.StVenantKirchhoff, wf.StableNeoHookean, wf.FixedCorotated)
            for case in ("3D, double precision, moduli per cell", "2D, single precision, one modulus")
        ),
    ],
)
def test_the_stiffness_is_that_of_the_plain_kernel(kind, case):
    """Also of cells turned inside out, whose rotation is not known without branches."""
    mesh = MESHES["box" if "3D" in case else "rectangle"]
    dtype, limit = ("float32", 2e-6) if "single" in case else ("float64", 1e-14)
    E = 1e5 if "one" in case else np.linspace(1e5, 1e6, mesh.cell_count)
    model = wf.Model(_scene(mesh, kind(E=E, nu=0.3)), device="cpu", dtype=dtype, threads=1)
    noise = np.random.default_rng(0).normal(size=mesh.points.shape)
    sizes = [0.03 * mesh.mean_edge_length, *([1.0] if kind is wf.FixedCorotated else [])]
    plain = tangent_operator(model, "assembled", external=False)
    model.vectorize(explicit.VECTORIZED_CELLS)
    vectorized = tangent_operator(model, "assembled", external=False)
    for size in sizes:
        state = model.state()
        state.assign(displacement=size * noise)
        for operator in (plain, vectorized):
            operator.linearize(state.u, 0.0)
        expected = plain.assembly.blocks.numpy()
        difference = np.abs(vectorized.assembly.blocks.numpy() - expected).max()
        assert 0.0 < difference <= limit * np.abs(expected).max()


@pytest.mark.parametrize("kind", [wf.StableNeoHookean, wf.FixedCorotated])
def test_the_stability_limit_is_that_of_the_plain_kernel(kind):
    """Also of cells turned inside out, whose rotation is not known without branches: then all are looked at again."""
    mesh = MESHES["box"]
    model = wf.Model(_scene(mesh, kind(E=np.linspace(1e5, 1e6, mesh.cell_count), nu=0.3)), device="cpu")
    noise = np.random.default_rng(0).normal(size=mesh.points.shape)
    states = [model.state() for _ in range(3)]
    for state, size in zip(states, (0.0, 0.03 * mesh.mean_edge_length, 1.0), strict=True):
        state.assign(displacement=size * noise)
    plain = Watch(model, states[0])
    model.vectorize(explicit.VECTORIZED_CELLS)
    vectorized = Watch(model, states[0])
    for state in states:
        expected = plain.stable_dt(state.u)
        assert vectorized.stable_dt(state.u) == pytest.approx(expected, rel=1e-5)
        known = vectorized._largest_square(state.u, together=True)
        assert (known is None) == (kind is wf.FixedCorotated and state is states[2])
        if known is not None:
            assert 2.0 / np.sqrt(known) != expected  # equal bits would be those of the plain kernel


def test_small_bodies_and_materials_with_branches_keep_the_plain_kernel():
    class Branching(wf.StableNeoHookean):
        functions = dataclasses.replace(wf.StableNeoHookean.functions, branchless=False)

    small = wf.Model(_scene(MESHES["one cube"], wf.StableNeoHookean(E=1e5, nu=0.3)), device="cpu")
    branching = wf.Model(_scene(MESHES["box"], Branching(E=1e5, nu=0.3)), device="cpu")
    for model in (small, branching):
        model.vectorize(explicit.VECTORIZED_CELLS)
        assert model.blocks[0].vectorized is None


@pytest.mark.parametrize(
    "solver",
    [wf.SymplecticEuler(), wf.VelocityVerlet(), wf.BackwardEuler()],
    ids=["symplectic Euler", "Verlet", "backward Euler"],
)
def test_the_number_of_threads_changes_no_bit(monkeypatch, solver):
    """With a body that is large enough for all threads, and a quadratic one that is too small for that."""
    for module in (explicit, implicit):
        monkeypatch.setattr(module, "VECTORIZED_CELLS", 64)
    monkeypatch.setattr("warpfem.model.CELLS_PER_THREAD", 256)
    monkeypatch.setattr("warpfem.row_blocks.BLOCK", 1)
    monkeypatch.setattr(explicit, "RECORDING", 1)
    monkeypatch.setattr("warpfem.linear.cell_sums.GROUP_BLOCKS", 640)
    monkeypatch.setattr("warpfem.linear.operators.SLICED_POINTS", 64)
    monkeypatch.setattr("warpfem.linear.slices.SLICES_PER_THREAD", 1)
    mesh = MESHES["box"]
    mesh = mesh.with_point_set("bottom", np.flatnonzero(mesh.points[:, 1] == 0.0))
    results = []
    for threads in (1, 2, 3):
        body = wf.Body("body", mesh, wf.StableNeoHookean(E=1e5, nu=0.3), supports=[wf.Pin("bottom")])
        small = wf.Body("small", MESHES["box of six"], wf.LinearElasticity(E=1e5, nu=0.3), element="quadratic")
        lid = wf.Plane((0, 0.99, 0), (0, -1, 0.1), friction=0.3)
        scene = wf.Scene([body, small], solver, gravity=(0, -9.81, 0), damping=1.0, obstacles=[lid])
        model = wf.Model(scene, device="cpu", threads=threads)
        stepper, state = solver.stepper(model), model.state()
        assert model.team.size == threads and model.blocks[0].vectorized
        dt = 0.5 * (stepper.stable_dt(state) or 0.02)
        left = 20
        while left:
            left -= stepper.advance(state, dt, left)[0]
        results.append((state.displacement, state.velocity, stepper.estimate_stable_dt(state)))
    for displacement, velocity, limit in results[1:]:
        np.testing.assert_array_equal(displacement, results[0][0])
        np.testing.assert_array_equal(velocity, results[0][1])
        assert limit == results[0][2]


def test_steps_of_other_lengths_record_no_forces_anew(monkeypatch):
    """With dt="auto" the length changes every some tens of steps."""
    recorded = []
    record = VectorizedForce.record
    monkeypatch.setattr(VectorizedForce, "record", lambda *args: recorded.append(1) or record(*args))
    model = wf.Model(_scene(MESHES["box"], wf.StableNeoHookean(E=1e5, nu=0.3)), device="cpu", threads=1)
    stepper, state = wf.SymplecticEuler().stepper(model), model.state()
    dt = 0.5 * stepper.stable_dt(state)
    for part in (1.0, 1.0, 0.9, 0.9, 0.8, 0.7):
        stepper.step(state, part * dt)
    assert len(recorded) == 1


def test_threads_beside_a_body_without_strips_change_no_bit(monkeypatch):
    """Such steps are not divided as a whole: threads share the forces of the body with strips alone."""
    monkeypatch.setattr("warpfem.model.CELLS_PER_THREAD", 256)
    bodies = [
        wf.Body("body", MESHES["box"], wf.StableNeoHookean(E=1e5, nu=0.3), velocity=(0, 1, 0)),
        wf.Body("small", MESHES["one cube"], wf.LinearElasticity(E=1e5, nu=0.3)),
    ]
    results = []
    for threads in (1, 3):
        model = wf.Model(wf.Scene(bodies, wf.SymplecticEuler(), gravity=(0, -9.81, 0)), device="cpu", threads=threads)
        stepper, state = wf.SymplecticEuler().stepper(model), model.state()
        assert [bool(block.vectorized) for block in model.blocks] == [True, False]
        state.assign(displacement=1e-3 * np.random.default_rng(0).normal(size=(model.point_count, 3)))
        for _ in range(5):
            stepper.step(state, 1e-3)
        results.append(state.displacement)
    np.testing.assert_array_equal(*results)


def test_threads_look_for_the_stability_limit_in_all_cells(monkeypatch):
    monkeypatch.setattr("warpfem.model.CELLS_PER_THREAD", 256)
    mesh, limits = MESHES["box"], []
    for threads in (1, 3):
        model = wf.Model(_scene(mesh, wf.StableNeoHookean(E=1e5, nu=0.3)), device="cpu", threads=threads)
        assert model.team.size == threads
        stepper, state = wf.SymplecticEuler().stepper(model), model.state()
        limits.append([stepper.estimate_stable_dt(state)])
        for cell in (0, mesh.cell_count // 2, mesh.cell_count - 1):  # one is larger, and so stiffer, than all others
            u = np.zeros_like(mesh.points)
            corners = mesh.cells[cell]
            u[corners] = 0.5 * (mesh.points[corners] - mesh.points[corners].mean(axis=0))
            state.assign(displacement=u)
            limits[-1] += [stepper.estimate_stable_dt(state), stepper.stable_dt(state)]
    assert limits[0] == limits[1]
    assert max(limits[0][1:]) < 0.99 * limits[0][0]


def test_steps_of_vectorised_bodies_follow_those_of_plain_ones(monkeypatch):
    motions = []
    for least in (1, 10**9):
        monkeypatch.setattr(explicit, "VECTORIZED_CELLS", least)
        model = wf.Model(_scene(MESHES["box"], wf.StableNeoHookean(E=1e5, nu=0.3)), device="cpu")
        state = model.state()
        state.assign(velocity=np.random.default_rng(0).normal(size=state.velocity.shape))
        stepper = wf.VelocityVerlet().stepper(model)
        dt = 0.5 * stepper.stable_dt(state)
        for _ in range(20):
            stepper.step(state, dt)
        motions.append(state.displacement)
    assert np.abs(motions[0] - motions[1]).max() < 1e-5 * np.abs(motions[1]).max()


@pytest.mark.parametrize("threads", [0, -1, 1.5, True])
def test_a_bad_number_of_threads_is_refused(threads):
    with pytest.raises(wf.SceneError, match="threads must be a whole number from 1 on"):
        wf.Model(_scene(MESHES["one cube"], wf.StableNeoHookean(E=1e5, nu=0.3)), device="cpu", threads=threads)


def test_a_team_runs_all_jobs_and_passes_on_a_failure():
    team, seen = Team(3), []
    team.run([lambda: seen.append(0), lambda: seen.append(1), lambda: seen.append(2)])
    assert sorted(seen) == [0, 1, 2]

    def fail():
        raise ValueError("a job")

    with pytest.raises(ValueError, match="a job"):
        team.run([lambda: None, fail])
    team.run([lambda: seen.append(3)])
    assert seen[-1] == 3


def test_no_thread_passes_a_barrier_before_all_have_come():
    """With more threads than most machines for tests have cores."""
    barriers, seen = Barriers(Team(5), 2), []
    waits = [[barriers.record(index, thread) for index in range(2)] for thread in range(5)]

    def work(first, second):
        seen.append("before")
        first.launch()
        seen.append("between")
        second.launch()
        seen.append("after")

    for _ in range(20):
        barriers.run([functools.partial(work, *own) for own in waits])
    assert seen == (["before"] * 5 + ["between"] * 5 + ["after"] * 5) * 20


@pytest.mark.parametrize("failing", [0, 2])
@pytest.mark.parametrize("failure", [ValueError, KeyboardInterrupt])
def test_a_thread_that_fails_holds_no_other_at_a_barrier(failing, failure):
    barriers = Barriers(Team(3), 1)
    waits = [barriers.record(0, thread) for thread in range(3)]

    def fail():
        time.sleep(0.01)
        raise failure("a job")

    with pytest.raises(failure, match="a job"):
        barriers.run([fail if thread == failing else waits[thread].launch for thread in range(3)])
    barriers.run([wait.launch for wait in waits])


@pytest.mark.usefixtures("interrupts")
@pytest.mark.parametrize("where", ["while the caller waits", "as news reach the caller"])
def test_an_interrupted_team_waits_for_all_before_it_tells(where):
    team, seen = Team(2), []

    def interrupt():
        time.sleep(0.05)
        waiting = where == "while the caller waits"  # else its wait goes on until the job has ended
        signal.pthread_kill(threading.main_thread().ident if waiting else threading.get_ident(), signal.SIGINT)
        time.sleep(0.05)
        seen.append(1)

    with pytest.raises(KeyboardInterrupt):
        team.run([lambda: None, interrupt])
    assert seen == [1]
    team.run([lambda: None, lambda: (time.sleep(0.05), seen.append(2))])  # waits for this job, not that before
    assert seen == [1, 2]


def test_an_explicit_stepper_goes_with_its_last_reference():
    model = wf.Model(_scene(MESHES["box"], wf.StableNeoHookean(E=1e5, nu=0.3)), device="cpu")
    stepper, state = model.scene.solver.stepper(model), model.state()
    for _ in range(3):
        stepper.advance(state, 0.5 * stepper.stable_dt(state), 8)
    known = weakref.ref(stepper)
    gc.collect()
    gc.disable()
    try:
        del stepper
        assert known() is None
    finally:
        gc.enable()


def test_shares_cover_all_and_begin_at_whole_units():
    parts = share(1000, 3, unit=64)
    assert [i for part in parts for i in part] == list(range(1000))
    assert all(part.start % 64 == 0 for part in parts)


def test_subnormal_numbers_are_zero_only_within_the_context():
    small = np.full(4, 1e-38, dtype=np.float32)
    flushed = SubnormalsFlushed()
    with flushed:
        within = float((small * np.float32(0.01)).max())
    assert within in (0.0, float(np.float32(1e-40)))  # processors other than x86 keep them
    assert float((small * np.float32(0.01)).max()) == float(np.float32(1e-40))
