"""Obstacles: derivatives of the penalty and of friction, resting depth, sliding, holding, bouncing."""

import numpy as np
import pytest
import warp as wp
from stepping import EXPLICIT, LINEARISED, MATERIALS, advance, mean, ready, solver_name

from warpfem.boundary import Box, BoxWalls, Plane, Sphere
from warpfem.contact import FLAT, SMALL, SPARED, STEEP
from warpfem.errors import SceneError
from warpfem.materials import LinearElasticity, StableNeoHookean
from warpfem.mesh import Mesh
from warpfem.model import Model
from warpfem.scene import Body, Scene
from warpfem.solvers import SDIRK2, BackwardEuler, SymplecticEuler, VelocityVerlet

G = 10.0
STEPS = {SymplecticEuler(): 1e-3, VelocityVerlet(): 1e-3, BackwardEuler(): 1e-2, LINEARISED: 1e-2, SDIRK2(): 1e-2}
FAMILIES = [SymplecticEuler(), BackwardEuler()]


def brick(dim, stiffness_of_body=1e6, height=0.125, cells=4, **settings):
    """A flat body of 1 m (x 1 m) on the plane y = 0.

    Flat, because nothing damps explicit steps: friction makes a higher block rock and hop as it slides, which
    no time step cures (Adams 1995).
    """
    if dim == 2:
        mesh, material = Mesh.rectangle((1.0, height), (cells, 1)), LinearElasticity(E=stiffness_of_body, nu=0.3)
    else:
        mesh, material = Mesh.box((1.0, height, 1.0), (cells, 1, cells)), StableNeoHookean(E=stiffness_of_body, nu=0.3)
    return Body("brick", mesh, material, **settings)


def plane(dim, **settings):
    return Plane((0.0,) * dim, (0.0, 1.0, 0.0)[:dim], **settings)


def contact_force(model, state):
    out = model.zeros()
    model.contact.add_force(state.u, out)
    return out.numpy().astype(np.float64)


# ---- derivatives

TILTED = {2: (0.6, 0.8), 3: (0.48, 0.8, 0.36)}
TURNED = {2: ((0.8, -0.6), (1.2, 1.6)), 3: ((0.8, -0.6, 0.0), (0.48, 0.64, 0.6), (-0.36, -0.48, 0.8))}
OBSTACLES = {
    "plane": lambda dim, **more: Plane((0.3, 0.2, 0.1)[:dim], TILTED[dim], **more),
    "sphere": lambda dim, **more: Sphere((0.4, -0.7, 0.5)[:dim], 1.0, **more),
    "box": lambda dim, **more: Box((0.4, -0.15, 0.5)[:dim], (0.9, 0.5, 0.8)[:dim], TURNED[dim], **more),
    "walls": lambda dim, **more: BoxWalls((0.05,) * dim, (0.6,) * dim, **more),
}


def spared_depth(body, stiffness):
    """g_0 [m]."""
    moduli = body.material.moduli
    return np.sqrt(SPARED * (moduli.lam + 2.0 * moduli.mu) * body.mesh.mean_edge_length / stiffness)


class Probe:
    """The contact of a body that dips into an obstacle, evaluated at any displacement."""

    def __init__(self, kind, dim, rng, E=1e6, element="linear"):
        obstacle = OBSTACLES[kind](dim, friction=0.4, stiffness=1e4)
        body = Body("brick", brick(dim, cells=2).mesh, StableNeoHookean(E=E, nu=0.3), element=element)
        self.model, self.state, _ = ready(Scene([body], SymplecticEuler(), obstacles=[obstacle]))
        self.contact = self.model.contact
        self.shape = (self.model.point_count, dim)
        self.u = rng.normal(scale=0.05, size=self.shape)
        self.start = self.vector(self.u + rng.normal(scale=2e-3, size=self.shape))
        self.contact.limit_friction(self.vector(self.u))
        self.dt = 2e-3 / self.contact.slip_speed  # slips on both sides of the limit of the smoothed law

    def vector(self, u):
        return wp.array(u, dtype=self.model.types.vector, device=self.model.device)

    def _sum(self, add, u, *args, blocks=False):
        t = self.model.types
        out = wp.zeros(self.shape[0], dtype=t.matrix if blocks else t.vector, device=self.model.device)
        add(*args, self.vector(u), out)
        return out.numpy()

    def _energy(self, add, u, *args):
        out = wp.zeros(1, dtype=wp.float64, device=self.model.device)
        add(*args, self.vector(u), out)
        return out.numpy()[0]

    def terms(self, friction):
        """Functions of u: the energy, the force and the blocks."""
        c = self.contact
        if friction:
            adders, args = (c.add_friction_energy, c.add_friction_force, c.add_friction_blocks), (self.start, self.dt)
        else:
            adders, args = (c.add_energy, c.add_force, c.add_blocks), ()
        energy, force, blocks = adders
        return (
            lambda u: self._energy(energy, u, *args),
            lambda u: self._sum(force, u, *args),
            lambda u: self._sum(blocks, u, *args, blocks=True),
        )


def differences(f, u, step=1e-6):
    """d f / d u_ik by central differences, first axes (i, k)."""
    result = []
    for index in np.ndindex(u.shape):
        offset = np.zeros_like(u)
        offset[index] = step
        result.append((f(u + offset) - f(u - offset)) / (2.0 * step))
    return np.array(result).reshape(*u.shape, *np.shape(result[0]))


@pytest.mark.parametrize("friction", [False, True], ids=["normal", "friction"])
@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("kind", OBSTACLES)
def test_force_and_blocks_are_derivatives_of_the_energy(kind, dim, friction, rng):
    probe = Probe(kind, dim, rng)
    energy, force, blocks = probe.terms(friction)
    expected = -differences(energy, probe.u)
    K = blocks(probe.u)
    touching = K.any(axis=(1, 2))
    assert 0 < np.count_nonzero(touching) < len(touching)
    scale = np.abs(expected).max()
    np.testing.assert_allclose(force(probe.u), expected, rtol=0, atol=1e-5 * scale)

    eigenvalues = np.linalg.eigvalsh(K)
    assert eigenvalues.min() > -1e-12 * eigenvalues.max()
    if not friction:  # the blocks are those of the normal forces, whatever turns faces and curves surfaces
        return
    slope = -np.einsum("ikil->ikl", differences(force, probe.u))
    np.testing.assert_allclose(K, slope, rtol=0, atol=2e-5 * np.abs(K).max())


@pytest.mark.parametrize("element", ["linear", "quadratic"])
@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("kind", OBSTACLES)
def test_forces_on_steep_faces_that_are_deep_are_derivatives_of_the_energy(kind, dim, element, rng):
    probe = Probe(kind, dim, rng, E=40.0, element=element)
    limit = spared_depth(probe.model.scene.bodies[0], 1e4)
    depth = probe.contact.depth(probe.u)
    assert depth > 2.0 * limit
    energy, force, _ = probe.terms(friction=False)
    expected = -differences(energy, probe.u)
    np.testing.assert_allclose(force(probe.u), expected, rtol=0, atol=1e-5 * np.abs(expected).max())


@pytest.mark.parametrize("dim", [2, 3])
def test_the_energy_of_a_point_that_slides_round_the_edge_of_a_box_does_not_jump(dim):
    mesh = Mesh.rectangle((1.0, 0.2), (4, 1)) if dim == 2 else Mesh.box((1.0, 0.2, 1.0), (4, 1, 4))
    box = Box((0.5, -0.5, 0.5)[:dim], (1.0, 1.0, 1.0)[:dim], stiffness=1e4)
    model, state, _ = ready(Scene([Body("b", mesh, MATERIALS[dim])], SymplecticEuler(), obstacles=[box]))
    energies = []
    for x in np.linspace(0.0, 0.4, 401):
        state.assign(displacement=np.tile([x, -0.1, 0.0][:dim], (model.point_count, 1)))
        energies.append(model.contact_energy(state.u))
    assert np.abs(np.diff(energies)).max() < 0.02 * max(energies)


def test_friction_law_is_smooth_below_the_slip_limit_and_coulombs_above():
    model, state, _ = ready(Scene([brick(2)], SymplecticEuler(), obstacles=[plane(2, friction=0.5)]))
    u = np.tile([0.0, -0.01], (model.point_count, 1))
    state.assign(displacement=u)
    contact = model.contact
    normal = contact_force(model, state)[:, 1].sum()
    contact.limit_friction(state.u)
    dt = 0.01
    for slip, expected in ((0.0, 0.0), (0.5, 0.75), (0.999, 1.0), (1.0, 1.0), (30.0, 1.0)):
        moved = wp.array(u + np.array([slip * contact.slip_speed * dt, 0.003]), dtype=wp.vec2d, device=model.device)
        out = model.zeros()
        contact.add_friction_force(state.u, dt, moved, out)
        total = out.numpy().sum(axis=0)
        assert total[0] == pytest.approx(-0.5 * normal * expected, rel=1e-5, abs=1e-12)
        assert total[1] == 0.0


def test_a_point_at_the_centre_of_a_sphere_is_pushed_out():
    mesh = Mesh.rectangle((1.0, 1.0), (2, 2))
    ball = Sphere(tuple(mesh.points[0]), 0.2, stiffness=1e4)
    model, state, _ = ready(Scene([Body("b", mesh, MATERIALS[2])], SymplecticEuler(), obstacles=[ball]))
    force = contact_force(model, state)
    assert np.isfinite(force).all()
    assert np.linalg.norm(force[0]) > 0.0


def test_planes_far_from_their_point_keep_their_digits():
    # only the height over the plane counts, also in float32 and 10 km along it
    normal = np.array([0.6, 0.8, 0.0])
    point = 1e4 * np.array([0.8, -0.6, 0.0])
    floor = Plane(tuple(point), tuple(normal), stiffness=1e4)
    model, state, _ = ready(Scene([brick(3)], SymplecticEuler(), obstacles=[floor]), "float32")
    state.assign(displacement=np.tile([0.0, -1.0, 0.0], (model.point_count, 1)))
    near = Plane((0.0, 0.0, 0.0), tuple(normal), stiffness=1e4)
    same, same_state, _ = ready(Scene([brick(3)], SymplecticEuler(), obstacles=[near]))
    same_state.assign(displacement=state.displacement)
    expected = contact_force(same, same_state)
    np.testing.assert_allclose(contact_force(model, state), expected, rtol=1e-5, atol=1e-4)


# ---- rest


def settle(scene, dt=0.05, steps=40):
    """The state at rest, by strongly damped backward Euler steps."""
    scene = Scene(
        scene.bodies, BackwardEuler(tolerance=1e-8), gravity=scene.gravity, obstacles=scene.obstacles, damping=50.0
    )
    model, state, stepper = ready(scene)
    advance(stepper, state, dt, steps)
    return model, state


@pytest.mark.parametrize("dim", [2, 3])
def test_a_resting_body_sinks_by_pressure_over_stiffness(dim):
    depths = {}
    for stiffness in (1e6, 4e6):
        scene = Scene(
            [brick(dim)], BackwardEuler(), gravity=(0.0, -G, 0.0)[:dim], obstacles=[plane(dim, stiffness=stiffness)]
        )
        model, state = settle(scene)
        pressure = 1000.0 * G * 0.125
        depths[stiffness] = model.contact.depth(state.displacement)
        # the deepest point bears a little more than the mean, because the body is not rigid
        base = state.displacement[model.scene.bodies[0].mesh.select_points("bottom"), 1]
        assert -base.mean() == pytest.approx(pressure / stiffness, rel=0.03)
        assert depths[stiffness] == -base.min() == pytest.approx(pressure / stiffness, rel=0.08)
        weight = model.lumped_mass.sum() * G
        np.testing.assert_allclose(
            contact_force(model, state).sum(axis=0), [0.0, weight, 0.0][:dim], atol=1e-5 * weight
        )
    assert depths[1e6] / depths[4e6] == pytest.approx(4.0, rel=0.05)


@pytest.mark.parametrize("dim", [2, 3])
def test_default_stiffness_is_the_p_wave_modulus_over_the_edge_length(dim):
    model, state, _ = ready(Scene([brick(dim)], SymplecticEuler(), obstacles=[plane(dim)]))
    state.assign(displacement=np.full((model.point_count, dim), [0.0, -0.001, 0.0][:dim]))
    body = model.scene.bodies[0]
    moduli = body.material.moduli
    modulus = moduli.lam + 2.0 * moduli.mu
    # a base of area 1 at depth 0.001 m: the sides do not count on its rim
    expected = 0.001 * modulus / body.mesh.mean_edge_length
    assert contact_force(model, state)[:, 1].sum() == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("dim", [2, 3])
def test_default_stiffness_stops_a_thrown_body_within_a_quarter_of_its_thickness(dim):
    thrown = brick(dim, stiffness_of_body=1e5, velocity=(0.0, -100.0, 0.0)[:dim])
    model, state, stepper = ready(Scene([thrown], BackwardEuler(), obstacles=[plane(dim)]))
    state.assign(displacement=np.full((model.point_count, dim), [0.0, -0.001, 0.0][:dim]))
    expected = 0.001 * 1000.0 * 100.0**2 / (0.25**2 * 0.125)  # force on the base of area 1: k depth
    assert contact_force(model, state)[:, 1].sum() == pytest.approx(expected, rel=1e-12)
    state.assign(displacement=np.zeros((model.point_count, dim)))
    depths = []
    advance(stepper, state, 1e-4, 20, lambda: depths.append(model.contact.depth(state.displacement)))
    assert 0.0 < max(depths) < 0.25 * 0.125


@pytest.mark.parametrize("solver", FAMILIES, ids=solver_name)
@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("kind", ["sphere", "box", "walls"])
def test_obstacles_carry_a_body(kind, dim, solver):
    # on the top of a sphere or of a larger box, and in a box with a tilted gravity
    if kind == "sphere":
        obstacle, gravity = Sphere((0.5, -2.0, 0.5)[:dim], 2.0), (0.0, -G, 0.0)[:dim]
    elif kind == "box":
        obstacle, gravity = Box((0.5, -0.1, 0.5)[:dim], (3.0, 0.2, 3.0)[:dim]), (0.0, -G, 0.0)[:dim]
    else:
        obstacle, gravity = BoxWalls((-0.01,) * dim, (1.01,) * dim), (-3.0, -G, 2.0)[:dim]
    model, state, stepper = ready(Scene([brick(dim)], solver, gravity=gravity, obstacles=[obstacle], damping=20.0))
    dt = STEPS[solver]
    advance(stepper, state, dt, round(1.5 / dt))
    weight = -model.lumped_mass.sum() * np.array(gravity)
    np.testing.assert_allclose(
        contact_force(model, state).sum(axis=0), weight, rtol=0, atol=2e-3 * np.abs(weight).max()
    )
    assert 0.0 < model.contact.depth(state.displacement) < 0.02
    if kind == "walls":
        x = model.rest_points + state.displacement
        assert (x[:, :2].min(axis=0) < -0.01).all()
        assert dim == 2 or x[:, 2].max() > 1.01


def test_depth_is_zero_without_contact():
    model, state, _ = ready(Scene([brick(2)], SymplecticEuler(), obstacles=[Plane((0.0, -1.0), (0.0, 1.0))]))
    assert model.contact.depth(state.displacement) == 0.0
    assert model.energies(state).contact == 0.0


# ---- friction


def parabola(solver, t):
    """t^2 as the scheme has it: twice the distance at unit acceleration from rest."""
    dt = STEPS[solver]
    return t * (t + dt) if solver.order == 1 else t * t


def slide(solver, dim, mu, slope, seconds, speed=0.0):
    """How far a brick slides down an incline, from rest (held by friction until then) or from a speed.

    The brick and its floor are axis-parallel, and gravity is inclined.
    """
    angle = np.arctan(slope)
    gravity = G * np.array([np.sin(angle), -np.cos(angle), 0.0])[:dim]
    _, held = settle(Scene([brick(dim)], solver, gravity=gravity, obstacles=[plane(dim, friction=5.0)]))
    model, state, stepper = ready(Scene([brick(dim)], solver, gravity=gravity, obstacles=[plane(dim, friction=mu)]))
    start = held.displacement
    velocity = np.zeros_like(start)
    velocity[:, 0] = speed
    state.assign(displacement=start, velocity=velocity)
    dt = STEPS[solver]
    advance(stepper, state, dt, round(seconds / dt))
    moved = mean(model, state.displacement - start)
    assert abs(moved[1]) < 1e-3
    return moved[0], G * (np.sin(angle) - mu * np.cos(angle)), model.contact.slip_speed


@pytest.mark.parametrize(("dim", "solver"), [(2, s) for s in STEPS if s is not LINEARISED] + [(3, BackwardEuler())])
def test_slides_above_the_angle_of_friction(dim, solver):
    distance, acceleration, _ = slide(solver, dim, 0.4, 1.05 * 0.4, 1.0)
    # 5 % of the distance is 0.25 % of the friction: what vibrations and, in implicit steps, the smoothed law
    # take off it
    assert distance == pytest.approx(0.5 * acceleration * parabola(solver, 1.0), rel=0.05)


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("solver", STEPS, ids=solver_name)
def test_a_sliding_brick_accelerates_by_coulombs_law(solver, dim):
    speed, t = 1.0, 0.2
    distance, acceleration, _ = slide(solver, dim, 0.4, 0.1, t, speed)
    assert acceleration == pytest.approx(-3.0, rel=0.01)
    # compared with the scheme's own parabola; the linearised drag takes its speed from the step before
    tolerance = 0.1 if solver is LINEARISED else 0.02
    assert speed * t - distance == pytest.approx(-0.5 * acceleration * parabola(solver, t), rel=tolerance)


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("solver", STEPS, ids=solver_name)
def test_holds_below_the_angle_of_friction(solver, dim):
    seconds = 1.0
    distance, _, slip_speed = slide(solver, dim, 0.4, 0.95 * 0.4, seconds)
    assert slip_speed < 5e-3
    if solver in EXPLICIT:  # friction stops: what is left is the body's own vibration
        assert abs(distance) < 2e-4
    else:
        # the smoothed law carries 95 % of its limit at 1 - sqrt(0.05) = 0.78 of the slip speed
        assert 0.4 < distance / (slip_speed * seconds) < 1.0
    if solver in EXPLICIT:
        twice, _, _ = slide(solver, dim, 0.4, 0.95 * 0.4, 2.0 * seconds)
        assert abs(twice - distance) < 1e-4


@pytest.mark.parametrize("solver", STEPS, ids=solver_name)
def test_without_friction_it_slides_as_on_ice(solver):
    seconds = 0.5
    distance, acceleration, _ = slide(solver, 2, 0.0, 0.3, seconds)
    # nothing but rounding and the tolerance of implicit steps comes in
    assert distance == pytest.approx(0.5 * acceleration * parabola(solver, seconds), rel=1e-4)


def test_a_tilted_plane_is_the_same_as_a_tilted_gravity():
    angle = 0.5
    c, s = np.cos(angle), np.sin(angle)
    down = np.array([[c, s], [-s, c]])  # rows: the incline's directions along and up, in the world
    results = []
    for rotation in (np.eye(2), down.T):
        mesh = brick(2).mesh
        body = Body("b", Mesh(mesh.points @ rotation.T, mesh.cells), LinearElasticity(E=1e7, nu=0.3))
        gravity = rotation @ (G * np.array([s, -c]))
        floor = Plane((0.0, 0.0), tuple(rotation @ [0.0, 1.0]), friction=0.2)
        model, state, stepper = ready(
            Scene([body], BackwardEuler(tolerance=1e-8), gravity=tuple(gravity), obstacles=[floor])
        )
        advance(stepper, state, 0.01, 20)
        results.append(mean(model, state.displacement) @ rotation)
    np.testing.assert_allclose(results[1], results[0], rtol=1e-3, atol=1e-6)
    assert results[0][0] > 0.05


@pytest.mark.parametrize("solver", [*EXPLICIT, BackwardEuler(tolerance=1e-8)], ids=solver_name)
@pytest.mark.parametrize("dim", [2, 3])
def test_an_oblique_impact_takes_mu_times_the_normal_impulse(solver, dim):
    mu = 0.3
    velocity = (30.0, -1.0, -20.0)[:dim]  # it slides all through the impact, much faster than it vibrates
    body = brick(dim, velocity=velocity)
    dt = 5e-4 if solver in EXPLICIT else 5e-3
    model, state, stepper = ready(Scene([body], solver, obstacles=[plane(dim, friction=mu)]))
    start = mean(model, state.velocity)
    advance(stepper, state, dt, round(0.1 / dt))
    change = mean(model, state.velocity) - start
    assert not contact_force(model, state).any()  # it has left
    along = np.array(velocity) * [1.0, 0.0, 1.0][:dim]
    along /= np.linalg.norm(along)
    assert change[1] > 0.5
    # explicit: to rounding, but that the direction of sliding differs a little from point to point in 3D;
    # implicit: the limits follow Newton's iterates, to its tolerance
    tolerance = 1e-10 if dim == 2 and solver in EXPLICIT else 2e-3
    assert -change @ along == pytest.approx(mu * change[1], rel=tolerance)


def test_implicit_friction_has_the_normal_force_of_its_own_step():
    # steps as long as the impact: a limit from the step before would miss the first of them
    mu = 0.3
    body = brick(2, velocity=(30.0, -1.0))
    floor = plane(2, friction=mu)
    model, state, stepper = ready(Scene([body], BackwardEuler(tolerance=1e-8), obstacles=[floor]))
    changes = []
    before = mean(model, state.velocity)
    for _ in range(3):
        advance(stepper, state, 5e-3, 1)
        after = mean(model, state.velocity)
        changes.append(after - before)
        before = after
    assert min(change[1] for change in changes) > 0.1
    np.testing.assert_allclose([-change[0] / change[1] for change in changes], mu, rtol=1e-3)


@pytest.mark.parametrize("dim", [2, 3])
def test_a_linearised_slider_stops_where_coulomb_says_and_stays(dim):
    speed, mu = 1.0, 0.5
    body = brick(dim, velocity=(speed, 0.0, 0.0)[:dim])
    floor = plane(dim, friction=mu, stiffness=1e7)
    scene = Scene([body], LINEARISED, gravity=(0.0, -G, 0.0)[:dim], obstacles=[floor])
    _, rest = settle(scene)
    model, state, stepper = ready(scene)
    state.assign(displacement=rest.displacement - [mean(model, rest.displacement)[0], *[0.0] * (dim - 1)])
    base = body.mesh.select_points("bottom")
    speeds = []
    advance(stepper, state, 0.005, 80, lambda: speeds.append(state.velocity[base, 0].mean()))
    assert mean(model, state.displacement)[0] == pytest.approx(speed**2 / (2.0 * mu * G), rel=0.1)
    assert min(speeds) > -model.contact.slip_speed  # a drag does not turn the body round
    assert abs(speeds[-1]) < model.contact.slip_speed


# ---- bouncing


@pytest.mark.parametrize("dim", [2, 3])
def test_a_bounce_restores_the_height(dim):
    # a penalty conserves energy: all that is lost to the height is vibration, little if the body is far
    # stiffer than the floor
    body = brick(dim, stiffness_of_body=1e7, velocity=(0.0, -1.0, 0.0)[:dim])
    scene = Scene([body], VelocityVerlet(), gravity=(0.0, -G, 0.0)[:dim], obstacles=[plane(dim, stiffness=5e5)])
    model, state, stepper = ready(scene)
    energy = model.energies(state).total
    dt = 2.5e-4
    heights, energies = [], []

    def record():
        heights.append(mean(model, state.displacement)[1])
        energies.append(model.energies(state).total)

    advance(stepper, state, dt, round(0.2 / dt), record)
    assert min(heights) < -0.01
    assert max(heights) == pytest.approx(1.0 / (2.0 * G), rel=0.05)
    np.testing.assert_allclose(energies, energy, rtol=0, atol=2e-3 * energy)


# ---- refusals


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Plane((0.0, 0.0), (0.0, 0.0)), "normal .* must be non-zero"),
        (lambda: Plane((0.0, 0.0, 0.0), (0.0, 1.0)), "as long as point"),
        (lambda: Plane((0.0, np.nan), (0.0, 1.0)), "point must be a finite vector"),
        (lambda: Plane((0.0, 0.0), (0.0, 1.0), friction=-0.1), "Plane: friction must be a finite number of at least 0"),
        (lambda: Plane((0.0, 0.0), (0.0, 1.0), stiffness=0.0), "stiffness must be a finite number above 0"),
        (lambda: Sphere((0.0, 0.0), 0.0), "Sphere: radius must be a finite number above 0"),
        (lambda: Sphere((0.0, 0.0), 1.0, friction=np.inf), "Sphere: friction"),
        (lambda: Box((0.0, 0.0), (1.0, 0.0)), "Box: size .* must be 2 numbers above 0"),
        (lambda: Box((0.0, 0.0), (1.0, 1.0, 1.0)), "Box: size"),
        (lambda: Box((0.0, 0.0), (1.0, 1.0), ((1.0, 0.0), (1.0, 1.0))), "Box: axes must be 2 directions"),
        (lambda: Box((0.0, 0.0), (1.0, 1.0), ((1.0, 0.0), (0.0, 0.0))), "Box: axes"),
        (lambda: Box((0.0, 0.0), (1.0, 1.0), ((1.0, 0.0), (0.0, 1.0, 0.0))), "Box: axes"),
        (lambda: Box((0.0, 0.0), (1.0, 1.0), 5.0), "Box: axes"),
        (lambda: BoxWalls((0.0, 0.0), (1.0, 0.0)), "must be below upper"),
        (
            lambda: Scene([brick(2)], SymplecticEuler(), obstacles=[plane(3)]),
            "Plane: its place must be a finite vector of length 2",
        ),
        (lambda: Scene([brick(2)], SymplecticEuler(), obstacles=["floor"]), "must be a Plane, Sphere, Box or BoxWalls"),
    ],
)
def test_refuses_obstacles(make, message):
    with pytest.raises(SceneError, match=message):
        make()


@pytest.mark.parametrize("dim", [2, 3])
def test_a_box_stops_the_way_into_its_core(dim, rng):
    box = OBSTACLES["box"](dim)
    model, _, _ = ready(Scene([brick(dim)], BackwardEuler(), obstacles=[box]))
    contact, surface = model.contact, model.contact.surface
    u = rng.normal(scale=0.6, size=(model.point_count, dim))
    way = box.center - model.rest_points - u + rng.normal(scale=0.1, size=u.shape)  # more or less to its centre
    limit = wp.full(1, 2.0, dtype=model.types.scalar, device=model.device)
    vectors = [wp.array(own, dtype=model.types.vector, device=model.device) for own in (u, way)]
    contact.limit_step(*vectors, limit)

    steps = np.linspace(0.0, 2.0, 20001)[:, None, None]
    x = (surface.rest + u[surface.host_points]) + steps * way[surface.host_points]
    inside = (np.abs((x - box.center) @ box.shape.T) < 0.5).all(axis=2)
    enters = inside[:, ~inside[0]].any(axis=1)
    assert inside[0].any() and enters.any()
    assert limit.numpy()[0] == pytest.approx(steps[np.argmax(enters), 0, 0], abs=2e-4)


def test_a_normal_may_have_any_length():
    assert Plane((0.0, 0.0), (0.0, 5.0)).normal == (0.0, 1.0)


def test_slip_speed_follows_the_scene():
    def speed(**settings):
        return Model(
            Scene([brick(2)], SymplecticEuler(), obstacles=[plane(2)], **settings), device="cpu"
        ).contact.slip_speed

    size = np.hypot(1.0, 0.125)
    assert speed(gravity=(0.0, -G)) == pytest.approx(1e-3 * np.sqrt(G * size))
    assert speed() == pytest.approx(1e-3 * size)


def penalty(mesh, x, gap, normals, stiffness, deep):
    """The energy of the penalty, and k A of each point where it bears, from the definition."""
    faces = mesh.boundary_faces
    corners = x[faces[:, : mesh.dim]]
    e = corners[:, 1:] - corners[:, :1]
    area = 0.5 * np.cross(e[:, 0], e[:, 1]) if mesh.dim == 3 else e[:, 0, ::-1] * (1.0, -1.0)
    size = np.sqrt((area**2).sum(axis=1) + (SMALL * mesh.boundary_face_areas) ** 2)
    outward = area / size[:, None]
    squared_sine = (outward**2).sum(axis=1)[:, None] - np.einsum("fi,fji->fj", outward, normals[faces]) ** 2
    s = np.clip((STEEP - squared_sine) / (STEEP - FLAT), 0.0, 1.0)
    c = s * s * (3.0 - 2.0 * s)
    g = np.maximum(-gap[faces], 0.0)
    first = np.where(g > deep, 2.0 * (g - deep) ** 2, 0.0)
    square = np.where(g > 2.0 * deep, g**2 - 2.0 * deep**2, first)
    rate = np.select([g > 2.0 * deep, g > deep], [1.0, 2.0], 0.0)
    weight = stiffness * np.outer(mesh.boundary_face_areas, mesh.shape.face.mass_shares)
    blocks = np.zeros(len(x))
    np.add.at(blocks, faces, weight * (c + (1.0 - c) * rate) * (g > 0.0))
    return 0.5 * (weight * (c * g**2 + (1.0 - c) * square)).sum(), blocks


@pytest.mark.parametrize("element", ["linear", "quadratic"])
@pytest.mark.parametrize("dim", [2, 3])
def test_faces_bear_that_lie_along_the_obstacle_whichever_way_a_body_lies(dim, element, rng):
    body = Body("b", brick(dim, cells=3).mesh, StableNeoHookean(E=1e6, nu=0.3), element=element)
    model, state, _ = ready(Scene([body], SymplecticEuler(), obstacles=[plane(dim, stiffness=1e4)]))
    mesh = model.scene.bodies[0].mesh
    normals = np.tile([0.0, 1.0, 0.0][:dim], (model.point_count, 1))
    seen = 0
    for _ in range(12):
        x = (mesh.points + rng.normal(scale=3e-3, size=mesh.points.shape)) @ np.linalg.qr(rng.normal(size=(dim, dim)))[
            0
        ]
        x[:, 1] -= x[:, 1].min() + rng.uniform(0.05, 0.2)
        state.assign(displacement=x - mesh.points)
        energy, stiffness = penalty(mesh, x, x[:, 1], normals, 1e4, spared_depth(body, 1e4))
        assert model.contact_energy(state.u) == pytest.approx(energy, rel=1e-10)
        blocks = wp.zeros(model.point_count, dtype=model.types.matrix, device=model.device)
        model.contact.add_blocks(state.u, blocks)
        np.testing.assert_allclose(blocks.numpy()[:, 1, 1], stiffness, rtol=1e-10, atol=1e-9)
        seen += np.count_nonzero(stiffness)
    assert seen > 20


def test_faces_of_linear_elasticity_keep_their_directions_at_rest():
    for material, bears in ((LinearElasticity(E=1e6, nu=0.3), True), (StableNeoHookean(E=1e6, nu=0.3), False)):
        body = Body("b", Mesh.rectangle((1.0, 1.0), (1, 1)), material)
        model, state, _ = ready(Scene([body], SymplecticEuler(), obstacles=[plane(2, stiffness=1e4)]))
        x = body.mesh.points
        steep = np.stack([0.1 * x[:, 0], x[:, 1] - x[:, 0]], axis=1)  # the base stands nearly upright
        state.assign(displacement=steep - x - [0.0, -0.985])
        assert (np.abs(contact_force(model, state)).max() > 1.0) == bears


@pytest.mark.parametrize("dim", [2, 3])
def test_a_block_that_has_sunk_in_is_pushed_by_its_base_alone_unless_it_sinks_away(dim):
    cells = (4, 40) if dim == 2 else (2, 40, 2)
    mesh = Mesh.rectangle((1.0, 1.0), cells) if dim == 2 else Mesh.box((1.0, 1.0, 1.0), cells)
    body = Body("b", mesh, MATERIALS[dim])
    stiffness = spared_depth(body, 1.0) ** 2 / 0.1**2  # for which it is 0.1 m
    model, state, _ = ready(Scene([body], SymplecticEuler(), obstacles=[plane(dim, stiffness=stiffness)]))
    base = mesh.select_points("bottom")
    for depth, held in ((0.099, False), (0.2, True)):
        state.assign(displacement=np.tile([0.0, -depth, 0.0][:dim], (model.point_count, 1)))
        force = contact_force(model, state)
        sides = np.delete(force, base, axis=0)
        assert sides.any() == held
        assert held or force[base, 1].sum() == pytest.approx(stiffness * depth, rel=1e-12)


@pytest.mark.parametrize("solver", STEPS, ids=solver_name)
def test_obstacles_stop_a_body_on_which_nothing_else_acts(solver):
    # no gravity, no strain: the penalty is the only force there is
    walls = BoxWalls((-0.05, -1.0), (1.05, 1.0))
    model, state, stepper = ready(Scene([brick(2, velocity=(1.0, 0.0))], solver, obstacles=[walls]))
    depths = []
    dt = 0.5 * STEPS[solver]
    advance(stepper, state, dt, round(0.5 / dt), lambda: depths.append(model.contact.depth(state.displacement)))
    assert 0.0 < max(depths) < 0.05
    assert np.abs(mean(model, state.displacement)).max() < 0.1


@pytest.mark.parametrize("E", [1e2, 1e4])
def test_the_default_obstacle_stops_a_soft_body_that_falls(E):
    """A body far too soft to bear its own fall flattens on the floor, but does not sink through it."""
    mesh = Mesh.rectangle((1.0, 1.0), (3, 3), origin=(0.0, 0.3))
    floor = Plane((0.0, 0.0), (0.0, 1.0))
    scene = Scene(
        [Body("jelly", mesh, StableNeoHookean(E=E, nu=0.3))], BackwardEuler(), gravity=(0.0, -9.81), obstacles=[floor]
    )
    model, state, stepper = ready(scene)
    deepest = 0.0
    for _ in range(40):
        stepper.step(state, 0.02)
        deepest = max(deepest, model.contact.depth(state.displacement))
    assert 0.0 < deepest < 0.25


@pytest.mark.parametrize("E", [1e4, 1e6])
def test_a_thin_box_holds_a_soft_body_that_falls(E):
    """With the stiffness of a floor it would sink through the middle, and come out below."""
    mesh = Mesh.rectangle((1.0, 1.0), (3, 3), origin=(0.0, 0.3))
    slab = Box((0.5, -0.05), (4.0, 0.1))
    scene = Scene(
        [Body("jelly", mesh, StableNeoHookean(E=E, nu=0.3))], BackwardEuler(), gravity=(0.0, -9.81), obstacles=[slab]
    )
    model, state, stepper = ready(scene)
    deepest = 0.0
    for _ in range(40):
        stepper.step(state, 0.02)
        deepest = max(deepest, model.contact.depth(state.displacement))
    assert 1e-4 < deepest < 0.025


@pytest.mark.parametrize("kind", ["sphere", "box"])
@pytest.mark.parametrize("dim", [2, 3])
def test_a_long_step_does_not_leap_over_an_obstacle(dim, kind):
    mesh = (
        Mesh.rectangle((0.4, 0.4), (2, 2), (-0.2, 0.1))
        if dim == 2
        else Mesh.box((0.4,) * 3, (2, 2, 2), (-0.2, 0.1, -0.2))
    )
    body = Body("cube", mesh, StableNeoHookean(E=1e9, nu=0.3), velocity=(0.0, -100.0, 0.0)[:dim])
    below = (0.0, -1.0, 0.0)[:dim]
    obstacle = Sphere(below, 1.0) if kind == "sphere" else Box(below, (4.0, 2.0, 3.0)[:dim])
    model, state, stepper = ready(Scene([body], BackwardEuler(), obstacles=[obstacle]))
    stepper.step(state, 1.0 / 24.0)  # by itself the body would fly 4 m, to the far side
    x = model.rest_points + state.displacement
    assert x[:, 1].min() > -0.1


def test_a_linearised_step_into_contact_says_so():
    floor = Plane((0.0, 0.0), (0.0, 1.0), stiffness=1e9)
    mesh = Mesh.rectangle((1.0, 1.0), (2, 2), (0.0, 0.01))
    body = Body("block", mesh, StableNeoHookean(E=1e6, nu=0.3), velocity=(0.0, -10.0))
    model, state, stepper = ready(Scene([body], LINEARISED, obstacles=[floor]))
    before = model.energies(state).total
    report = stepper.step(state, 0.01)
    assert model.energies(state).total > before  # it did not see the floor
    assert not report.converged
    assert "above the potential of standing still" in report.note


def test_a_body_that_gives_way_does_not_creep_round_a_sphere_within_a_step():
    """Newton's method finds the way round if the body is soft: in such long steps the far side has less potential."""
    mesh = Mesh.rectangle((0.4, 0.4), (3, 3), (-0.2, 0.1))
    body = Body("jelly", mesh, StableNeoHookean(E=1e5, nu=0.3), velocity=(0.0, -100.0))
    model, state, stepper = ready(Scene([body], BackwardEuler(), obstacles=[Sphere((0.0, -1.0), 1.0)]), "float32")
    report = stepper.step(state, 1.0 / 24.0)
    x = model.rest_points + state.displacement
    assert report.parts > 1
    assert not ((x[:, 1] < -1.0) & (np.abs(x[:, 0]) < 1.0)).any()
