"""The solver for Newton: the moduli that one asks for, and what a Newton model says besides its tetrahedra."""

import numpy as np
import pytest
import warp as wp

import warpfem as wf

newton = pytest.importorskip("newton")

from warpfem.interop.newton import SolverWarpfem  # noqa: E402

E, NU, DENSITY, G = 1e6, 0.3, 1000.0, 9.81
MODULI = wf.elastic_moduli(E=E, nu=NU)
BAR = wf.Mesh.box(size=(0.2, 1.0, 0.2), cells=(2, 10, 2))
BLOCK = wf.Mesh.box(size=(0.2, 0.2, 0.2), cells=(1, 1, 1), origin=(0.0, 0.5, 0.0))


def add(builder, mesh=BAR, held=(), k_mu=MODULI.mu, k_lambda=MODULI.lam, k_damp=0.0):
    start = builder.particle_count
    builder.add_soft_mesh(
        pos=wp.vec3(0.0, 0.0, 0.0),
        rot=wp.quat_identity(),
        scale=1.0,
        vel=wp.vec3(0.0, 0.0, 0.0),
        vertices=mesh.points.tolist(),
        indices=mesh.cells.ravel().tolist(),
        density=DENSITY,
        k_mu=k_mu,
        k_lambda=k_lambda,
        k_damp=k_damp,
    )
    for point in held:
        builder.particle_mass[start + int(point)] = 0.0


def finalized(builder):
    model = builder.finalize(device="cpu")
    model.particle_grid = None  # no contact between particles, which are nearer to each other than their radius
    return model


def model_of(mesh=BAR, held="top", **moduli):
    builder = newton.ModelBuilder(up_axis=newton.Axis.Y)
    add(builder, mesh, mesh.point_sets[held] if held else (), **moduli)
    builder.color()
    return finalized(builder)


def run(solver, model, dt, steps, kept_speed=1.0):
    """The state after some steps, each of which may lose a part of the speed."""
    state, other, control = model.state(), model.state(), model.control()
    for _ in range(steps):
        state.clear_forces()
        solver.step(state, other, control, None, dt)
        state, other = other, state
        state.particle_qd.assign(kept_speed * state.particle_qd.numpy())
    return state


def measured_moduli(state):
    """E and nu of the hanging bar, from what it is stretched by its weight, and thinned in its middle.

    Between 0.2 and 0.8 m from its lower end it has the strain rho g y / E, far from the end that holds it.
    """
    moved = state.particle_q.numpy() - BAR.points
    y = BAR.points[:, 1]
    lower, upper, middle = (np.isclose(y, place) for place in (0.2, 0.8, 0.5))
    stretch = moved[upper, 1].mean() - moved[lower, 1].mean()
    modulus = DENSITY * G * (0.8**2 - 0.2**2) / 2 / stretch
    thinning = np.polyfit(BAR.points[middle, 0], moved[middle, 0], 1)[0]
    return modulus, -thinning / (DENSITY * G * 0.5 / modulus)


def test_hanging_bar_has_the_moduli_asked_for():
    state = run(SolverWarpfem(model_of()), model_of(), dt=1.0, steps=6)  # backward Euler damps it to rest
    assert measured_moduli(state) == pytest.approx((E, NU), rel=5e-3)


def test_newtons_descent_finds_the_same_bar():
    model = model_of()
    solver = newton.solvers.SolverVBD(
        model, iterations=40, particle_enable_self_contact=False, particle_enable_tile_solve=False
    )
    assert measured_moduli(run(solver, model, dt=1 / 200, steps=60, kept_speed=0.9)) == pytest.approx((E, NU), rel=1e-2)


def test_newtons_semi_implicit_solver_makes_another_solid_of_the_same_numbers():
    model = model_of()
    solver = newton.solvers.SolverSemiImplicit(model, enable_tri_contact=False)
    other = wf.elastic_moduli(mu=0.75 * MODULI.mu, lam=MODULI.lam - 0.625 * MODULI.mu)
    state = run(solver, model, dt=5e-4, steps=1200, kept_speed=0.95)
    assert measured_moduli(state) == pytest.approx((other.E, other.nu), rel=1e-2)
    assert other.E < 0.75 * E


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_steps_are_those_of_a_scene(dtype):
    model = model_of(BLOCK, "top")
    state = run(SolverWarpfem(model, dtype=dtype), model, dt=1 / 960, steps=8)
    body = wf.Body("block", BLOCK, wf.StableNeoHookean(E=E, nu=NU), DENSITY, supports=[wf.Pin("top")])
    scene = wf.Scene([body], wf.BackwardEuler(), dt=1 / 960, gravity=(0, -G, 0), fps=120, frames=1)
    last = list(wf.Simulation(scene, dtype=dtype).frames())[-1]
    sag = np.abs(last.displacement).max()
    assert sag > 1e-4 and np.abs(last.velocity).max() > 1e-2
    np.testing.assert_allclose(state.particle_q.numpy(), BLOCK.points + last.displacement, rtol=0, atol=1e-3 * sag)
    np.testing.assert_allclose(
        state.particle_qd.numpy(), last.velocity, rtol=0, atol=1e-3 * np.abs(last.velocity).max()
    )


def test_displacements_keep_the_digits_that_positions_have_no_room_for():
    far = wf.Mesh(BLOCK.points + np.array([0.0, 1000.0, 0.0]), BLOCK.cells, BLOCK.point_sets)
    model = model_of(far, held=None)
    model.set_gravity((0.0, 0.0, 0.0))
    solver, state = SolverWarpfem(model), model.state()
    state.particle_qd.fill_(wp.vec3(0.0, 1e-5, 0.0))
    for _ in range(20):
        solver.step(state, state, None, None, 1.0)  # by less than float32 can tell at 1 km
    np.testing.assert_allclose(solver.state.displacement[:, 1], 2e-4, rtol=1e-3)
    np.testing.assert_allclose(state.particle_q.numpy()[:, 1] - far.points[:, 1], 2e-4, atol=6.2e-5)


def test_held_particles_are_where_the_state_has_them():
    model = model_of(BLOCK, "top")
    solver = SolverWarpfem(model)
    state, other = model.state(), model.state()
    q = state.particle_q.numpy()
    q[BLOCK.point_sets["top"]] += (0.1, 0.0, 0.0)
    state.particle_q.assign(q)
    for _ in range(6):
        solver.step(state, other, None, None, 1.0)
        state, other = other, state
    moved = state.particle_q.numpy() - BLOCK.points
    np.testing.assert_allclose(moved[BLOCK.point_sets["top"]], [(0.1, 0.0, 0.0)] * 4, atol=1e-7)
    np.testing.assert_allclose(moved[BLOCK.point_sets["bottom"], 0], 0.1, atol=2e-4)
    assert np.isin(np.arange(8), solver.solid.supports.host_points).sum() == 4


def test_forces_on_particles_and_gravity_act_as_they_are_at_the_step():
    model = model_of(BLOCK, held=None)
    solver = SolverWarpfem(model)
    state = model.state()
    force = np.tile([3.0, 0.0, 0.0], (8, 1)) * model.particle_mass.numpy()[:, None]
    state.particle_f.assign(force)
    solver.step(state, state, None, None, 0.1)
    np.testing.assert_allclose(state.particle_qd.numpy(), [(0.3, -0.981, 0.0)] * 8, atol=1e-5)
    state.clear_forces()
    model.set_gravity((0.0, 1.0, 0.0))
    solver.step(state, state, None, None, 0.1)
    np.testing.assert_allclose(state.particle_qd.numpy(), [(0.3, -0.881, 0.0)] * 8, atol=1e-5)


def test_velocities_given_by_others_are_taken_over():
    model = model_of(BLOCK, held=None)
    solver = SolverWarpfem(model)
    state = model.state()
    solver.step(state, state, None, None, 0.1)
    state.particle_qd.fill_(wp.vec3(1.0, 0.0, 0.0))
    solver.step(state, state, None, None, 0.1)
    np.testing.assert_allclose(state.particle_qd.numpy()[:, 0], 1.0, rtol=1e-5)


def test_planes_spheres_and_boxes_are_obstacles():
    builder = newton.ModelBuilder(up_axis=newton.Axis.Y)
    add(builder, BLOCK)
    builder.add_ground_plane(height=0.3)
    builder.add_shape_sphere(-1, xform=wp.transform((5.0, 0.0, 0.0), wp.quat_identity()), radius=0.5)
    turn = wp.quat_from_axis_angle(wp.vec3(0.0, 0.0, 1.0), 0.5)
    builder.add_shape_box(-1, xform=wp.transform((-5.0, 0.0, 0.0), turn), hx=0.1, hy=0.2, hz=0.3)
    model = finalized(builder)
    solver = SolverWarpfem(model)
    plane, sphere, box = solver.solid.scene.obstacles
    assert plane.point == pytest.approx((0.0, 0.3, 0.0)) and plane.normal == pytest.approx((0.0, 1.0, 0.0), abs=1e-6)
    assert sphere.center == pytest.approx((5.0, 0.0, 0.0)) and sphere.radius == 0.5
    assert box.size == pytest.approx((0.2, 0.4, 0.6)) and box.axes[0] == pytest.approx((np.cos(0.5), np.sin(0.5), 0.0))
    mu = builder.default_shape_cfg.mu
    assert plane.friction == pytest.approx(np.sqrt(model.soft_contact_mu * mu))
    state = run(solver, model, dt=1 / 24, steps=36)
    assert state.particle_q.numpy()[:, 1].min() == pytest.approx(0.3, abs=2e-3)


def test_explicit_steps_run_and_refuse_what_is_too_long():
    model = model_of(BLOCK, "top")
    solver = SolverWarpfem(model, wf.VelocityVerlet())
    limit = wf.VelocityVerlet().stepper(solver.solid).stable_dt()
    sags = []
    state = model.state()
    for _ in range(400):
        solver.step(state, state, None, None, 0.5 * limit)
        sags.append(BLOCK.points[0, 1] - state.particle_q.numpy()[0, 1])
    rest = DENSITY * G * 0.2**2 / (2 * E)  # it swings about its rest, from none to twice the sag
    assert np.mean(sags) == pytest.approx(rest, rel=0.2) and max(sags) == pytest.approx(2 * np.mean(sags), rel=0.1)
    with pytest.raises(wf.SimulationError, match="above the stability limit"):
        solver.step(state, state, None, None, 2.0 * limit)


def test_a_soft_grid_has_the_masses_that_newton_gives_it():
    builder = newton.ModelBuilder(up_axis=newton.Axis.Y)
    builder.add_soft_grid(
        pos=wp.vec3(0.0, 0.0, 0.0),
        rot=wp.quat_identity(),
        vel=wp.vec3(0.0, 0.0, 0.0),
        dim_x=2,
        dim_y=2,
        dim_z=2,
        cell_x=0.1,
        cell_y=0.1,
        cell_z=0.1,
        density=DENSITY,
        k_mu=MODULI.mu,
        k_lambda=MODULI.lam,
        k_damp=0.0,
        fix_left=True,
    )
    model = finalized(builder)
    solid = SolverWarpfem(model).solid
    given = model.particle_mass.numpy()
    np.testing.assert_allclose(solid.lumped_mass[given > 0], given[given > 0])
    (body,) = solid.scene.bodies
    shares = np.repeat((body.density * body.mesh.cell_volumes)[:, None] / 4, 4, axis=1)
    from_cells = np.bincount(body.mesh.cells.ravel(), shares.ravel())
    assert (from_cells[given > 0] <= given[given > 0] * (1 + 1e-6)).all()


def test_parts_that_are_not_connected_are_bodies_of_their_own():
    builder = newton.ModelBuilder(up_axis=newton.Axis.Y)
    add(builder, BLOCK)
    builder.add_particle(wp.vec3(9.0, 9.0, 9.0), wp.vec3(0.0, 0.0, 0.0), 1.0)
    add(
        builder,
        wf.Mesh(BLOCK.points + np.array([2.0, 0.0, 0.0]), BLOCK.cells),
        k_mu=5 * MODULI.mu,
        k_lambda=5 * MODULI.lam,
    )
    model = finalized(builder)
    with pytest.warns(UserWarning, match="particles of no tetrahedron stay where they are .1 in all"):
        solver = SolverWarpfem(model)
    assert [body.material.E for body in solver.solid.scene.bodies] == pytest.approx([E, 5 * E])
    assert solver.particles.numpy().tolist() == [*range(8), *range(9, 17)]
    state = run(solver, model, dt=0.1, steps=2)
    assert state.particle_q.numpy()[8].tolist() == [9.0, 9.0, 9.0]


def test_worlds_have_gravity_of_their_own_and_share_obstacles():
    one = newton.ModelBuilder(up_axis=newton.Axis.Y)
    add(one, BLOCK)
    one.add_ground_plane(height=-1.0)
    builder = newton.ModelBuilder(up_axis=newton.Axis.Y)
    builder.replicate(one, 2)
    model = finalized(builder)
    assert model.world_count == 2 and model.shape_count == 2
    model.set_gravity([(0.0, -1.0, 0.0), (0.0, -2.0, 0.0)])
    solver = SolverWarpfem(model)
    assert len(solver.solid.scene.bodies) == 2 and len(solver.solid.scene.obstacles) == 1
    state = run(solver, model, dt=0.1, steps=1)
    np.testing.assert_allclose(state.particle_qd.numpy()[:, 1], [-0.1] * 8 + [-0.2] * 8, rtol=1e-4)
    other = newton.ModelBuilder(up_axis=newton.Axis.Y)
    add(other, BLOCK)
    builder.add_world(other)
    with pytest.warns(UserWarning, match="obstacles of some worlds are felt in all .1 in all"):
        SolverWarpfem(finalized(builder))


def test_what_is_left_out_is_named():
    builder = newton.ModelBuilder(up_axis=newton.Axis.Y)
    add(builder, BLOCK, k_damp=10.0)
    body = builder.add_body(mass=1.0)
    builder.add_shape_box(body, hx=0.1, hy=0.1, hz=0.1, label="brick")
    builder.add_shape_plane(width=2.0, length=2.0)
    builder.add_spring(0, 1, 1.0, 0.0, 0.0)
    builder.add_triangle(0, 1, 2, tri_ke=1.0)
    with pytest.warns(UserWarning) as told:
        SolverWarpfem(finalized(builder))
    text = "\n".join(str(one.message) for one in told)
    for part in (
        "the damping of tetrahedra (k_damp) is left out (5 in all)",
        "drag and lift of triangles are left out (1 in all)",
        "springs are left out (1 in all)",
        "rigid bodies stay where they are (1 in all)",
        "'brick' is a box of a body: solids pass through it",
        "plane with edges",
    ):
        assert part in text
    assert all(one.filename == __file__ for one in told), "a warning points to the line that makes the solver"


def test_models_that_cannot_be_stepped_are_refused():
    with pytest.raises(wf.SceneError, match="no tetrahedra"):
        SolverWarpfem(newton.ModelBuilder().finalize(device="cpu"))
    model = model_of(BLOCK)
    with pytest.raises(wf.SceneError, match="chooses its time steps"):
        SolverWarpfem(model, wf.SDIRK2(error=1e-2))
    with pytest.raises(wf.SceneError, match="material must be a class"):
        SolverWarpfem(model, material=wf.NeoHookean(E=1e5, nu=0.3))
    model.particle_q.assign(1.1 * model.particle_q.numpy())
    with pytest.raises(wf.SceneError, match=r"tetrahedron 0 .*\(5 in all\) is strained by 0.21"):
        SolverWarpfem(model)
    builder = newton.ModelBuilder()
    add(builder, BLOCK, held=range(8))
    with pytest.raises(wf.SceneError, match="all its particles are held"):
        SolverWarpfem(finalized(builder))
    with pytest.raises(wf.MaterialError, match="mu must be finite and > 0"):
        SolverWarpfem(model_of(BLOCK, k_mu=0.0))


def test_a_turned_model_is_at_rest():
    model = model_of(BLOCK)
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    model.particle_q.assign(model.particle_q.numpy() @ turn.T)
    SolverWarpfem(model)


def test_steps_are_not_captured():
    model = model_of(BLOCK)
    solver, state = SolverWarpfem(model), model.state()
    with pytest.raises(wf.SimulationError, match="cannot be captured"), wp.ScopedCapture("cpu"):
        solver.step(state, state, None, None, 0.01)
