"""Static equilibrium: known answers, and what has none."""

import numpy as np
import pytest
from stepping import MATERIALS, all_forces, slab

from warpfem.boundary import Pin, Plane, PointForce, PrescribedMotion, Traction
from warpfem.errors import SceneError, SimulationError
from warpfem.materials import NeoHookean, StableNeoHookean
from warpfem.mesh import Mesh
from warpfem.model import Model
from warpfem.scene import Body, Scene
from warpfem.solvers import BackwardEuler, Quasistatic, StaticEquilibrium


def solved(body, **settings):
    model = Model(Scene([body], BackwardEuler(), **settings), device="cpu", dtype="float64")
    state = model.state()
    report = StaticEquilibrium(tolerance=1e-9).solve(model, state)
    assert report.converged
    return model, state


def test_forces_that_float32_does_not_resolve_are_warned_of():
    """A strip a hundred times as long as high, whose internal forces are far larger than its weight."""
    mesh = Mesh.rectangle((100.0, 1.0), (100, 2))
    body = Body("strip", mesh, NeoHookean(E=1e6, nu=0.3), supports=[Pin("left")])
    scene = Scene([body], BackwardEuler(), gravity=(0.0, -0.1))
    model = Model(scene, device="cpu", dtype="float32")
    with pytest.warns(UserWarning, match=r'only to a residual of .*: take dtype="float64"'):
        report = StaticEquilibrium().solve(model, model.state())
    assert report.residual > 1e-3


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
    model = Model(Scene([crushed], BackwardEuler()), device="cpu", dtype="float64")
    state = model.state()
    start = np.full((model.point_count, 2), 1e-4)
    state.assign(displacement=start)
    with pytest.raises(SimulationError, match=r"% of the load, none at .* inverted cells: cell \d of body 'crushed'"):
        StaticEquilibrium().solve(model, state)
    np.testing.assert_array_equal(state.displacement, start)


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
    with pytest.raises(SceneError, match="StaticEquilibrium: load_steps must be an integer >= 1"):
        StaticEquilibrium(load_steps=0 if value == 1 else value)


ROLLERS = [Pin("left", axes=(0,)), Pin("bottom", axes=(1,)), Pin("back", axes=(2,))]


@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize(("nu", "factor"), [(0.3, 3.0), (0.3, 0.3), (0.4999, 3.0), (0.4999, 0.3)])
def test_a_block_stretched_to_3_and_compressed_to_03(factor, nu, dtype):
    """All at once: the motion is the same at all times, and the first cells are inverted by it if it shortens."""
    material = NeoHookean(E=1e5, nu=nu)

    def motion(rest, time):
        return rest * (factor, 1.0, 1.0)

    supports = [*ROLLERS, PrescribedMotion("right", motion, axes=(0,))]
    body = Body("block", Mesh.box((1.0, 1.0, 1.0), (2, 2, 2)), material, supports=supports)
    model = Model(Scene([body], BackwardEuler()), device="cpu", dtype=dtype)
    state = model.state()
    report = StaticEquilibrium().solve(model, state)
    assert report.converged
    assert (report.parts > 1) == (factor < 1.0)
    F = model.stresses(state).deformation_gradient
    across = F[0, 1, 1]
    atol = 1e-4 if dtype == "float64" else 3e-3
    np.testing.assert_allclose(F, np.broadcast_to(np.diag([factor, across, across]), F.shape), atol=atol)
    free = np.linspace(0.2, 2.0, 180001)  # the stretch across without a force
    free = free[np.argmin(np.abs(material.mu * (free**2 - 1.0) + material.lam * np.log(factor * free**2)))]
    assert across == pytest.approx(free, abs=atol)


def test_a_clamped_block_of_quadratic_cells_compressed_to_03():
    """Nearly incompressible, and bulging; linear cells lock, and turn unstable on the way."""

    def motion(rest, time):
        return rest * (0.3, 1.0, 1.0)

    mesh = Mesh.box((1.0, 1.0, 1.0), (2, 2, 2))
    supports = [Pin("left"), PrescribedMotion("right", motion)]
    body = Body("block", mesh, NeoHookean(E=1e5, nu=0.49), supports=supports, element="quadratic")
    model = Model(Scene([body], BackwardEuler()), device="cpu", dtype="float64")
    state = model.state()
    (*_, last) = StaticEquilibrium().increments(model, state)
    assert last.stable and last.report.residual <= 1e-5
    assert model.diagnostics(state)[0].min() > 0.5
    (bulge,) = np.ptp((model.rest_points + state.displacement)[:, 1:2], axis=0)
    assert bulge > 1.5


def beam(tip_force):
    return Body(
        "beam",
        Mesh.box((10.0, 1.0, 1.0), (20, 2, 2)),
        NeoHookean(E=1e6, nu=0.3),
        supports=[Pin("left")],
        loads=[PointForce("right", (0.0, -tip_force / 9.0, 0.0))],
    )


def test_load_steps_lead_through_equilibria_under_parts_of_the_load():
    model = Model(Scene([beam(4e3)], BackwardEuler()), device="cpu", dtype="float64")
    load = model.dead_load.numpy().copy()
    state = model.state()
    solver = StaticEquilibrium(1e-8, load_steps=4)
    found = [(increment.fraction, state.displacement) for increment in solver.increments(model, state)]
    assert [fraction for fraction, _ in found] == [0.25, 0.5, 0.75, 1.0]
    np.testing.assert_array_equal(model.dead_load.numpy(), load)
    for fraction, displacement in found:
        _, direct = solved(beam(4e3 * fraction))
        np.testing.assert_allclose(displacement, direct.displacement, atol=1e-5)
    assert -found[-1][1][:, 1].min() > 5.0  # a large deflection


def test_no_load_steps_where_none_are_needed(monkeypatch):
    monkeypatch.setattr(StaticEquilibrium, "_climb", None)
    model, _ = solved(beam(1e4))
    assert model.static_load is model.dead_load


def turn(rest, time):
    """Half a turn about y within a second."""
    c, s = np.cos(np.pi * time), np.sin(np.pi * time)
    return rest @ np.array([[c, 0.0, -s], [0.0, 1.0, 0.0], [s, 0.0, c]])


def test_increments_follow_motions_through_time():
    """Straight on, the top of the column would be a line half way."""
    mesh = Mesh.box((1.0, 3.0, 1.0), (2, 6, 2), origin=(-0.5, 0.0, -0.5))
    supports = [Pin("bottom"), PrescribedMotion("top", turn)]
    body = Body("column", mesh, NeoHookean(E=1e5, nu=0.3), supports=supports)
    model = Model(Scene([body], BackwardEuler()), device="cpu", dtype="float64")
    state = model.state()
    top = mesh.select_points("top")
    fractions = []
    for increment in StaticEquilibrium(load_steps=4).increments(model, state, time=1.0):
        fractions.append(increment.fraction)
        assert state.time == increment.fraction
        x = mesh.points + state.displacement
        np.testing.assert_allclose(x[top], turn(mesh.points[top], increment.fraction), atol=1e-12)
    assert fractions[-1] == 1.0 and increment.stable
    assert model.diagnostics(state)[0].min() > 0.5


@pytest.mark.parametrize("turns", [0.5, 1.0])
def test_turns_are_followed_without_being_told_to(turns):
    """After a full turn the top is where it is at rest, but the column is twisted."""
    mesh = Mesh.box((1.0, 6.0, 1.0), (2, 12, 2), origin=(-0.5, 0.0, -0.5))
    supports = [Pin("bottom"), PrescribedMotion("top", lambda rest, time: turn(rest, 2.0 * turns * time))]
    body = Body("column", mesh, StableNeoHookean(E=1e5, nu=0.3), supports=supports)
    model = Model(Scene([body], BackwardEuler()), device="cpu", dtype="float64")
    state = model.state()
    middle = (mesh.points[:, 1] == 3.0) & (np.abs(mesh.points[:, [0, 2]]).max(axis=1) > 0.4)
    angle, before = 0.0, mesh.points
    for _ in StaticEquilibrium().increments(model, state, time=1.0):
        now = mesh.points + state.displacement
        a, b = (x[middle, 2] + 1j * x[middle, 0] for x in (before, now))
        angle, before = angle + float(np.degrees(np.angle((b * a.conj()).sum()))), now
    assert angle == pytest.approx(180.0 * turns, rel=0.02)  # half of the top's


def test_supports_alone_are_solved_to_the_tolerance():
    """Where no load acts, the residual is compared with what the supports exert."""
    stretched = slab(3, supports=[Pin("left"), PrescribedMotion("right", lambda rest, time: 1.25 * rest)])
    model = Model(Scene([stretched], BackwardEuler()), device="cpu", dtype="float64")
    report = StaticEquilibrium(1e-6).solve(model, model.state())
    assert report.residual <= 1e-6 and report.note == ""
    assert report.newton_iterations < 10


def arch(force):
    """A shallow arch, clamped at both ends, with a force down on its middle, which it bears up to 219 N."""
    flat = Mesh.rectangle((10.0, 0.2), (40, 2))
    points = flat.points + np.stack([np.zeros(flat.point_count), 0.6 * np.sin(np.pi * flat.points[:, 0] / 10.0)], 1)
    sets = {name: flat.select_points(name) for name in ("left", "right")}
    mesh = Mesh(points, flat.cells, sets).with_point_set("middle", lambda x: (x[:, 0] == 5.0) & (x[:, 1] > 0.79))
    supports = [Pin("left"), Pin("right")]
    load = PointForce("middle", (0.0, -force))
    return Body("arch", mesh, NeoHookean(E=1e6, nu=0.3), supports=supports, loads=[load])


def test_snap_through_ends_with_the_load_that_was_borne():
    model = Model(Scene([arch(500.0)], BackwardEuler()), device="cpu", dtype="float64")
    state = model.state()
    with pytest.raises(SimulationError, match=r"up to .* % of the load, none .* \(snap-through or buckling\)") as error:
        for increment in StaticEquilibrium(load_steps=4).increments(model, state):
            borne = 500.0 * increment.fraction
    assert 5.0 * float(str(error.value).split("up to ")[1].split(" %")[0]) == pytest.approx(borne, rel=1e-3)
    assert 200.0 < borne < 230.0
    assert state.displacement[:, 1].min() > -0.4  # the last equilibrium, not yet through
    _, direct = solved(arch(borne))
    np.testing.assert_allclose(state.displacement, direct.displacement, atol=2e-3)
    _, beyond = solved(arch(500.0))  # descent leads to the equilibrium beyond
    assert beyond.displacement[:, 1].min() < -0.8


def test_an_unstable_equilibrium_is_pointed_out():
    """A straight column beyond Euler's load, which is at a strain of about 2 %."""
    mesh = Mesh.rectangle((10.0, 0.5), (20, 2))
    supports = [Pin("left"), PrescribedMotion("right", lambda rest, time: rest * (1.0 - 0.04 * time, 1.0))]
    body = Body("column", mesh, NeoHookean(E=1e6, nu=0.3), supports=supports)
    model = Model(Scene([body], BackwardEuler()), device="cpu", dtype="float64")
    state = model.state()
    with pytest.warns(UserWarning, match="unstable: its stiffness has a direction of negative curvature"):
        (*_, last) = StaticEquilibrium().increments(model, state, time=1.0)
    assert not last.stable
    state = model.state()
    (last,) = StaticEquilibrium().increments(model, state, time=0.1)
    assert last.stable


# ---- one equilibrium after the other


def test_quasistatic_steps_end_in_equilibria_and_do_not_repeat_what_they_found():
    def pull(rest, time):
        return rest + np.array([min(time, 0.2), 0.0])

    body = slab(2, supports=[Pin("left"), PrescribedMotion("right", pull)], velocity=(3.0, 0.0))
    scene = Scene([body], Quasistatic(tolerance=1e-9), gravity=(0.0, -50.0), damping=2.0)
    model = Model(scene, device="cpu", dtype="float64")
    state, expected = model.state(), model.state()
    stepper = scene.solver.stepper(model)
    iterations = []
    for time in (0.1, 0.2, 0.3):
        iterations.append(stepper.step(state, 0.1).newton_iterations)
        assert state.time == pytest.approx(time)
        StaticEquilibrium(tolerance=1e-9).solve(model, expected, time)
        np.testing.assert_allclose(state.displacement, expected.displacement, atol=1e-7)
    assert iterations[0] > 0 < iterations[1] and iterations[2] == 0
    assert not state.velocity.any()


def test_quasistatic_steps_between_pins_solve_once_until_the_state_is_another():
    scene = Scene([slab(2, supports=[Pin("left")])], Quasistatic(), gravity=(0.0, -50.0))
    model = Model(scene, device="cpu", dtype="float64")
    state = model.state()
    stepper = scene.solver.stepper(model)
    assert stepper.step(state, 0.1).residual > 0.0 == stepper.step(state, 0.1).residual
    sag = state.displacement
    state.assign(displacement=0.9 * sag)
    assert stepper.step(state, 0.1).newton_iterations > 0
    assert state.time == pytest.approx(0.3)
    np.testing.assert_allclose(state.displacement, sag, atol=1e-3 * np.abs(sag).max())


def test_quasistatic_steps_need_supports():
    model = Model(Scene([slab(2)], Quasistatic(), gravity=(0.0, -1.0)), device="cpu", dtype="float64")
    with pytest.raises(SceneError, match="can move freely"):
        model.scene.solver.stepper(model)
