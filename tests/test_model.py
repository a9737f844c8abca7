"""Model and State: what a finalised scene answers, and what it refuses."""

import numpy as np
import pytest
import warp as wp
from helpers import irregular_mesh, model_of, random_rotation, solid

from warpfem.boundary import Pin, Plane, PointForce, PrescribedMotion, Sphere, Traction
from warpfem.errors import MaterialError, SceneError, SimulationError, WarpfemError
from warpfem.materials import LinearElasticity, NeoHookean, StableNeoHookean, StVenantKirchhoff
from warpfem.mesh import Mesh
from warpfem.model import Model, State, device_bytes
from warpfem.scene import Body, Scene
from warpfem.solvers import SymplecticEuler

dims = pytest.mark.parametrize("dim", [pytest.param(2, id="2D"), pytest.param(3, id="3D")])
dtypes = pytest.mark.parametrize("dtype", ["float32", "float64"])
SOFT = StableNeoHookean(E=1e4, nu=0.4)
STIFF = StableNeoHookean(E=2e5, nu=0.3)


def scene_of(*bodies: Body, **settings) -> Scene:
    return Scene(list(bodies), SymplecticEuler(), **settings)


def square(cells: int = 1) -> Mesh:
    return Mesh.rectangle((1.0, 1.0), (cells, cells))


def block(dim: int) -> Mesh:
    return Mesh.rectangle((2.0, 1.0), (4, 2)) if dim == 2 else Mesh.box((2.0, 1.0, 1.0), (4, 2, 2))


def three_bodies(dim: int) -> Scene:
    """Two bodies share a material's kernels, with different parameters; the third is of another material."""
    meshes = [irregular_mesh(dim, seed) for seed in (1, 2, 3)]
    materials = [SOFT, NeoHookean(E=5e4, nu=0.2), STIFF]
    bodies = [Body(f"body {i}", mesh, m) for i, (mesh, m) in enumerate(zip(meshes, materials, strict=True))]
    return scene_of(*bodies)


def shaken(model: Model, size: float = 0.04) -> State:
    state = model.state()
    state.assign(displacement=size * np.random.default_rng(1).uniform(-1, 1, model.rest_points.shape))
    return state


# ---- mass


@dims
def test_lumped_mass_is_that_of_the_bodies(dim):
    mesh = irregular_mesh(dim)
    density = np.random.default_rng(1).uniform(500, 2000, mesh.cell_count)
    model = Model(scene_of(Body("a", mesh, SOFT, density), Body("b", mesh, SOFT, 3.0)), dtype="float64")
    a, b = np.split(model.lumped_mass, [mesh.point_count])
    assert a.sum() == pytest.approx(density @ mesh.cell_volumes, rel=1e-14)
    assert b.sum() == pytest.approx(3.0 * mesh.cell_volumes.sum(), rel=1e-14)
    # each cell's share sits at its corners: the centre of mass is that of the cells
    centroids = mesh.points[mesh.cells].mean(axis=1)
    np.testing.assert_allclose(a @ mesh.points, (density * mesh.cell_volumes) @ centroids, rtol=1e-13)
    np.testing.assert_array_equal(model.mass.numpy(), model.lumped_mass)
    np.testing.assert_allclose(model.inverse_mass.numpy() * model.lumped_mass, 1.0, rtol=1e-15)


def test_lumped_mass_is_a_copy():
    model = model_of(SOFT, square())
    model.lumped_mass[:] = 0.0
    assert model.lumped_mass.sum() == pytest.approx(1000.0)


# ---- bodies


@dims
def test_bodies_do_not_know_of_each_other(dim):
    """Forces, stresses and energy of three bodies in one scene are those of each alone."""
    scene = three_bodies(dim)
    model = Model(scene, dtype="float64")
    assert len(model.blocks) == 2  # by material, not by body
    state = shaken(model)
    force, stresses = model.internal_force(state), model.stresses(state)
    energy = 0.0
    for i, body in enumerate(scene.bodies):
        alone = Model(scene_of(body), dtype="float64")
        points = slice(model.point_starts[i], model.point_starts[i + 1])
        cells = slice(model.cell_starts[i], model.cell_starts[i + 1])
        own = alone.state()
        own.assign(displacement=state.displacement[points])
        np.testing.assert_allclose(force[points], alone.internal_force(own), atol=1e-13 * np.abs(force).max())
        expected = alone.stresses(own)
        np.testing.assert_array_equal(stresses.first_piola_kirchhoff[cells], expected.first_piola_kirchhoff)
        np.testing.assert_array_equal(stresses.deformation_gradient[cells], expected.deformation_gradient)
        np.testing.assert_array_equal(model.tractions(state, i), alone.tractions(own))
        energy += alone.elastic_energy(own.u)
    assert model.elastic_energy(state.u) == pytest.approx(energy, rel=1e-14)


def test_numbering_runs_through_the_bodies():
    model = Model(scene_of(Body("a", square(1), SOFT), Body("b", square(2), NeoHookean(1e4, 0.3))))
    assert list(model.point_starts) == [0, 4, 13]
    assert list(model.cell_starts) == [0, 2, 10]
    assert [model.body_of_point(i)[1] for i in (0, 3, 4, 12)] == [0, 3, 0, 8]
    assert [model.body_of_cell(i)[0].name for i in (0, 1, 2, 9)] == ["a", "a", "b", "b"]
    assert [model.body_of_cell(i)[1] for i in (0, 1, 2, 9)] == [0, 1, 0, 7]


def test_uniform_parameters_are_stored_once():
    """An array of stride 0: 8 bytes for any number of cells."""
    uniform = model_of(SOFT, square(5), "float32").blocks[0].arguments["parameters"]
    assert uniform.shape == (50,)
    assert uniform.strides == (0,)
    assert device_bytes([uniform]) == 8
    per_cell = model_of(StableNeoHookean(np.full(50, 1e4), 0.4), square(5), "float32").blocks[0].arguments["parameters"]
    assert device_bytes([per_cell]) == 50 * 8
    np.testing.assert_array_equal(uniform.numpy(), per_cell.numpy())


def test_a_term_that_the_scene_lacks_is_none():
    model = model_of(SOFT, square())
    assert (model.dead_load, model.supports, model.contact) == (None, None, None)


# ---- stresses


@dims
@dtypes
def test_stresses_follow_from_p(dim, dtype):
    model = model_of(NeoHookean(E=1e5, nu=0.3), irregular_mesh(dim), dtype)
    state = shaken(model)
    stresses = model.stresses(state)
    mesh = model.scene.bodies[0].mesh
    x = mesh.points + state.displacement
    edges = (x[mesh.cells[:, 1:]] - x[mesh.cells[:, :1]]).transpose(0, 2, 1)
    rest = (mesh.points[mesh.cells[:, 1:]] - mesh.points[mesh.cells[:, :1]]).transpose(0, 2, 1)
    F = solid(edges @ np.linalg.inv(rest))
    rounding = model.types.epsilon
    np.testing.assert_allclose(stresses.deformation_gradient, F, atol=20 * rounding)
    J = np.linalg.det(F)
    # Neo-Hookean in spatial form: tau = mu (b - I) + lam ln(J) I
    mu, lam = 1e5 / 2.6, 1e5 * 0.3 / (1.3 * 0.4)
    tau = mu * (F @ F.transpose(0, 2, 1) - np.eye(3)) + (lam * np.log(J))[:, None, None] * np.eye(3)
    sigma = tau / J[:, None, None]
    size = 100 * rounding * 1e5
    np.testing.assert_allclose(stresses.kirchhoff, tau, atol=size)
    np.testing.assert_allclose(stresses.cauchy, sigma, atol=size)
    np.testing.assert_allclose(stresses.first_piola_kirchhoff, tau @ np.linalg.inv(F).transpose(0, 2, 1), atol=size)
    s = sigma
    differences = (s[:, 0, 0] - s[:, 1, 1]) ** 2 + (s[:, 1, 1] - s[:, 2, 2]) ** 2 + (s[:, 2, 2] - s[:, 0, 0]) ** 2
    shears = s[:, 0, 1] ** 2 + s[:, 1, 2] ** 2 + s[:, 0, 2] ** 2
    von_mises = np.sqrt(0.5 * differences + 3.0 * shears)
    np.testing.assert_allclose(stresses.von_mises, von_mises, atol=size)
    np.testing.assert_allclose(stresses.jacobian, J, rtol=100 * rounding)
    jacobian, kernel_von_mises = model.diagnostics(state)
    np.testing.assert_allclose(jacobian, J, rtol=100 * rounding)
    np.testing.assert_allclose(kernel_von_mises, von_mises, atol=size)


@dims
def test_tractions_on_a_closed_surface_sum_to_zero(dim, rng):
    """For a uniform stress: sum of traction times current area."""
    model = model_of(NeoHookean(E=1e5, nu=0.3), irregular_mesh(dim), "float64")
    mesh = model.scene.bodies[0].mesh
    F = random_rotation(rng, dim) @ (np.eye(dim) + 0.2 * rng.normal(size=(dim, dim)))
    state = model.state()
    state.assign(displacement=mesh.points @ (F - np.eye(dim)).T)
    tractions = model.tractions(state)
    x = (mesh.points @ F.T)[mesh.boundary_faces]
    edges = x[:, 1:] - x[:, :1]
    if dim == 2:
        areas = np.linalg.norm(edges[:, 0], axis=1)
    else:
        areas = 0.5 * np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1)
    assert np.abs(areas @ tractions).max() < 1e-12 * (areas @ np.abs(tractions)).max()


@dims
def test_traction_of_uniaxial_stretch(dim):
    """Neo-Hookean at lateral rest: sigma_xx = (mu (s^2 - 1) + lam ln s)/s on the ends, lam ln(s)/s on the sides."""
    stretch = 1.5
    material = NeoHookean(E=1e5, nu=0.3)
    model = model_of(material, block(dim), "float64")
    mesh = model.scene.bodies[0].mesh
    state = model.state()
    state.assign(displacement=mesh.points * np.array([stretch - 1.0, 0.0, 0.0])[:dim])
    normals = mesh.boundary_face_normals
    axial = (material.mu * (stretch**2 - 1.0) + material.lam * np.log(stretch)) / stretch
    lateral = material.lam * np.log(stretch) / stretch
    expected = normals * np.where(np.arange(dim) == 0, axial, lateral)
    np.testing.assert_allclose(model.tractions(state), expected, atol=1e-12 * axial)


# ---- loads


@dims
def test_dead_load(dim):
    """Gravity, point forces and tractions, and their potential."""
    mesh = block(dim)
    down, pull = np.eye(dim)[1] * -9.81, np.eye(dim)[0] * 7.0
    loads = [Traction("right", 100.0 * np.eye(dim)[0]), PointForce([0, 1], pull)]
    model = Model(scene_of(Body("a", mesh, SOFT, loads=loads), gravity=tuple(down)), dtype="float64")
    load = model.dead_load.numpy()
    right = mesh.select_points("right")
    area = 1.0
    mass = 1000.0 * mesh.cell_volumes.sum()
    np.testing.assert_allclose(load.sum(axis=0), mass * down + 2.0 * pull + 100.0 * area * np.eye(dim)[0], rtol=1e-13)
    others = np.setdiff1d(np.arange(mesh.point_count), [*right, 0, 1])
    np.testing.assert_allclose(load[others], model.lumped_mass[others, None] * down, rtol=1e-14)
    state = shaken(model)
    assert model.energies(state).load == pytest.approx(-np.sum(load * state.displacement), rel=1e-12)
    total = model.zeros()
    total.fill_(np.nan)
    model.force(state.u, total)
    np.testing.assert_allclose(total.numpy(), load + model.internal_force(state), rtol=1e-12, atol=1e-9)


def test_energies():
    model = model_of(SOFT, square(3), velocity=(2.0, 0.0))
    energies = model.energies(model.state())
    assert energies.kinetic == pytest.approx(0.5 * 1000.0 * 4.0)
    assert (energies.elastic, energies.load, energies.contact) == (0.0, 0.0, 0.0)
    assert energies.total == energies.kinetic


def test_energy_of_many_cells_keeps_its_digits():
    """Sums in float64: 0.1 million equal cells in single precision add up to their number."""
    mesh = Mesh.rectangle((400.0, 300.0), (400, 300))
    model = model_of(SOFT, mesh, "float32", velocity=(0.1, 0.0))
    one = model_of(SOFT, square(), "float32")
    states = [m.state() for m in (model, one)]
    for m, state in zip((model, one), states, strict=True):
        state.assign(displacement=m.rest_points * np.array([0.25, 0.0]))
    elastic = [m.elastic_energy(state.u) for m, state in zip((model, one), states, strict=True)]
    assert elastic[0] == pytest.approx(400 * 300 * elastic[1], rel=1e-6)
    assert model.energies(states[0]).kinetic == pytest.approx(0.5 * 1000.0 * 400 * 300 * 0.01, rel=1e-6)


def test_dot_sums_in_double_precision():
    model = model_of(SOFT, square(40), "float32")
    a = wp.full(model.point_count, wp.vec2f(0.1, 1e-3), dtype=wp.vec2f)
    exact = np.float64(np.float32(0.1)) ** 2 + np.float64(np.float32(1e-3)) ** 2
    assert model.dot(a, a) == pytest.approx(model.point_count * exact, rel=1e-12)


# ---- initial state and State


@dims
@dtypes
def test_initial_conditions(dim, dtype):
    mesh = irregular_mesh(dim)
    field = np.random.default_rng(1).uniform(-0.01, 0.01, mesh.points.shape)
    shift, spin = np.arange(1.0, dim + 1), lambda X: 2.0 * X
    bodies = [
        Body("array", mesh, SOFT, displacement=field, velocity=shift),
        Body("function", mesh, SOFT, displacement=tuple(shift), velocity=spin),
        Body("rest", mesh, SOFT),
    ]
    model = Model(scene_of(*bodies), dtype=dtype)
    state = model.state()
    zero = np.zeros_like(field)
    n = model.types.numpy
    np.testing.assert_array_equal(state.displacement, np.concatenate([field, zero + shift, zero]).astype(n))
    np.testing.assert_array_equal(state.velocity, np.concatenate([zero + shift, 2.0 * mesh.points, zero]).astype(n))
    assert state.time == 0.0


def test_initial_state_obeys_the_supports():
    mesh = square(2)
    motion = PrescribedMotion("right", lambda X, t: X + np.array([0.5, 0.25]))
    body = Body(
        "a", mesh, SOFT, supports=[Pin("left", axes=(0,)), motion], displacement=(1.0, 2.0), velocity=(3.0, 4.0)
    )
    state = Model(scene_of(body)).state()
    left, right = mesh.select_points("left"), mesh.select_points("right")
    np.testing.assert_array_equal(state.displacement[left], [[0.0, 2.0]] * 3)
    np.testing.assert_array_equal(state.velocity[left], [[0.0, 4.0]] * 3)
    np.testing.assert_array_equal(state.displacement[right], [[0.5, 0.25]] * 3)


def test_states_are_independent():
    model = model_of(SOFT, square())
    first = model.state()
    second = first.copy()
    second.assign(displacement=np.ones((4, 2)), velocity=np.ones((4, 2)))
    assert not first.displacement.any()
    assert not model.state().displacement.any()
    assert second.revision == 1
    first.displacement[:] = 7.0  # a copy
    assert not first.displacement.any()


@pytest.mark.parametrize("wrong", [np.zeros((3, 2)), np.zeros((4, 3)), np.zeros(8), 0.0])
def test_state_refuses_other_shapes(wrong):
    state = model_of(SOFT, square()).state()
    with pytest.raises(SimulationError, match=r"\(4, 2\)"):
        state.assign(displacement=wrong)


@pytest.mark.parametrize("wrong", [np.full((4, 2), np.nan), np.full((4, 2), np.inf), [["a", "b"]] * 4])
def test_state_refuses_what_is_no_number(wrong):
    state = model_of(SOFT, square()).state()
    with pytest.raises(SimulationError, match="velocity"):
        state.assign(displacement=np.ones((4, 2)), velocity=wrong)
    assert not state.displacement.any()  # nothing is half done
    assert state.revision == 0


@pytest.mark.parametrize("shape", [(3, 2), (4, 3), (4,), (8,), (4, 2, 1), ()])
def test_differential_refuses_other_shapes(shape):
    model = model_of(SOFT, square())
    with pytest.raises(SimulationError, match=r"the direction must have shape \(4, 2\)"):
        model.force_differential(model.state(), np.zeros(shape))


def test_differential_refuses_unknown_routes():
    model = model_of(SOFT, square())
    with pytest.raises(WarpfemError, match="route must be one of 'assembled', 'closed', 'tape', not 'magic'"):
        model.force_differential(model.state(), np.zeros((4, 2)), "magic")


# ---- what a scene refuses


def body(**changes) -> Body:
    return Body(**{"name": "block", "mesh": square(), "material": SOFT, **changes})


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"name": ""}, "a body needs a name"),
        ({"name": " "}, "a body needs a name"),
        ({"name": 7}, "a body needs a name, not 7"),
        ({"mesh": np.zeros((3, 2))}, "'block': mesh must be a warpfem.Mesh, not ndarray"),
        ({"material": "rubber"}, "'block': material must be a warpfem material"),
        ({"material": StableNeoHookean}, "'block': material must be a warpfem material"),
        ({"material": StableNeoHookean(np.ones(3), 0.3)}, r"'block': .*shape \(3,\), but the mesh has 2 cells"),
        ({"density": 0.0}, "'block': density must be finite and > 0, not 0"),
        ({"density": -1.0}, "not -1"),
        ({"density": np.nan}, "not nan"),
        ({"density": np.array([1.0, -2.0])}, r"not -2 in cell 1 \(1 in all\)"),
        ({"density": np.ones(3)}, r"density has shape \(3,\), but the mesh has 2 cells"),
        ({"density": np.ones((2, 1))}, r"density has shape \(2, 1\)"),
        ({"density": "heavy"}, "density must be a number"),
        ({"density": None}, "density must be"),
        ({"displacement": np.zeros((3, 2))}, r"initial displacement has shape \(3, 2\); expected \(4, 2\) or \(2,\)"),
        ({"displacement": (0.0, 0.0, 0.0)}, r"initial displacement has shape \(3,\)"),
        ({"velocity": 1.0}, r"initial velocity has shape \(\)"),
        ({"velocity": lambda X: X[:, 0]}, r"initial velocity has shape \(4,\)"),
        ({"velocity": [[0, 0], [0, 0], [0, np.inf], [0, 0]]}, "initial velocity is not finite at index 2"),
        ({"velocity": (np.nan, 0.0)}, "initial velocity is not finite"),
        ({"velocity": "fast"}, "initial velocity must be"),
        ({"supports": [Pin("roof")]}, "'block', Pin: .*roof"),
        ({"supports": [Pin([4])]}, "'block', Pin: .*4"),
        ({"supports": [Pin("left", axes=(2,))]}, r"'block', Pin: axes \(2,\) must be among 0..1"),
        ({"supports": [Pin("left", axes=())]}, r"axes \(\) must be among 0..1"),
        ({"supports": [Pin("left", axes="x")]}, "axes 'x' must be among 0..1"),
        ({"supports": [Pin("left", axes=(0.0,))]}, r"axes \(0.0,\) must be among 0..1"),
        ({"supports": ["left"]}, "'left' is not a Pin or PrescribedMotion"),
        ({"supports": Pin("left")}, "supports must be a list"),
        ({"supports": [Pin("left"), PrescribedMotion("left", lambda X, t: X)]}, "choose one"),
        ({"supports": [PrescribedMotion("left", lambda X, t: X[:1])]}, r"returned shape \(1, 2\) at t = 0 s"),
        ({"supports": [PrescribedMotion("left", lambda X, t: X * np.nan)]}, "not finite at t = 0 s"),
        ({"loads": [PointForce("roof", (0.0, 1.0))]}, "'block', PointForce: .*roof"),
        ({"loads": [PointForce("left", (0.0, 1.0, 0.0))]}, "must have 2 components"),
        ({"loads": [Traction([0, 3], (0.0, 1.0))]}, "'block', Traction: no boundary face"),
        ({"loads": [Pin("left")]}, "is not a PointForce or Traction"),
        ({"loads": PointForce("left", (0.0, 1.0))}, "loads must be a list"),
    ],
)
def test_refuses_wrong_bodies(changes, message):
    with pytest.raises(SceneError, match=message):
        Model(scene_of(body(**changes))).state()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"bodies": []}, "at least one warpfem.Body"),
        ({"bodies": None}, "at least one warpfem.Body"),
        ({"bodies": body()}, "at least one warpfem.Body"),
        ({"bodies": ["block"]}, "at least one warpfem.Body"),
        ({"bodies": [body(), body(name="box", mesh=Mesh.box((1, 1, 1), (1, 1, 1)))]}, "all 2D, or all 3D|all bodies"),
        ({"bodies": [body(), body()]}, "2 bodies are named 'block'"),
        ({"solver": "explicit"}, "solver must be a warpfem solver"),
        ({"solver": SymplecticEuler}, "solver must be a warpfem solver"),
        ({"dt": 0.0}, "dt must be a finite number > 0, not 0.0"),
        ({"dt": -1e-3}, "dt must be"),
        ({"dt": np.nan}, "dt must be"),
        ({"dt": "fast"}, "dt must be"),
        ({"fps": 0}, "fps must be a finite number > 0"),
        ({"fps": np.inf}, "fps must be"),
        ({"damping": -1.0}, "damping must be a finite number >= 0"),
        ({"damping": True}, "damping must be"),
        ({"frames": -1}, "frames must be an integer >= 0"),
        ({"frames": 2.5}, "frames must be an integer >= 0"),
        ({"up_axis": "X"}, "up_axis must be 'Y' or 'Z'"),
        ({"color_by": "red"}, "color_by must be"),
        ({"gravity": (0.0, -9.81, 0.0)}, "gravity must be a finite vector of length 2"),
        ({"gravity": -9.81}, "gravity must be a finite vector of length 2"),
        ({"gravity": (0.0, np.nan)}, "gravity must be a finite vector"),
        ({"gravity": "down"}, "gravity must be a vector of 2 numbers"),
        ({"obstacles": [Plane((0, 0, 0), (0, 1, 0))]}, "Plane.* must be a finite vector of length 2"),
        ({"obstacles": ["floor"]}, "an obstacle must be"),
        ({"obstacles": Sphere((0, 0), 1.0)}, "obstacles must be a list"),
    ],
)
def test_refuses_wrong_scenes(changes, message):
    settings = {"bodies": [body()], "solver": SymplecticEuler(), **changes}
    with pytest.raises(SceneError, match=message):
        Scene(**settings)


@pytest.mark.parametrize("dtype", ["float16", "double", np.float32, None, 64])
def test_refuses_other_dtypes(dtype):
    with pytest.raises(WarpfemError, match="dtype must be 'float32' or 'float64'"):
        Model(scene_of(body()), dtype=dtype)


@pytest.mark.parametrize("device", ["tpu", "cuda:99", 7])
def test_refuses_other_devices(device):
    with pytest.raises(SceneError, match="no device"):
        Model(scene_of(body()), device=device)


# ---- materials of several kinds


def test_parameters_of_bodies_that_share_kernels(rng):
    """One body with uniform parameters and one with parameters per cell, in one block."""
    mesh = irregular_mesh(2)
    young = rng.uniform(1e4, 1e5, mesh.cell_count)
    scene = scene_of(Body("uniform", mesh, SOFT), Body("graded", mesh, StableNeoHookean(young, 0.4)))
    (cells,) = Model(scene, dtype="float64").blocks
    parameters = cells.arguments["parameters"].numpy()
    mu = np.concatenate([np.full(mesh.cell_count, 1e4), young]) / 2.8
    np.testing.assert_allclose(parameters[:, 0], 4.0 / 3.0 * mu, rtol=1e-14)


def test_p_wave_modulus_of_every_material():
    """What contact stiffness is made from: lam + 2 mu, for the E and nu given."""
    for material in (SOFT, NeoHookean(1e5, 0.3), StVenantKirchhoff(1e5, 0.1), LinearElasticity(2e5, 0.2)):
        model = model_of(material, irregular_mesh(2))
        assert model._p_wave_moduli() == pytest.approx([material.moduli.p_wave], rel=1e-12)


def test_material_errors_name_the_body():
    with pytest.raises(MaterialError, match="StableNeoHookean"):
        StableNeoHookean(E=1e5, nu=0.6)


def test_arrays_given_by_the_user_are_copied():
    mesh = Mesh.box((1, 1, 1), (1, 1, 1))
    E, density = np.full(5, 1e5), np.full(5, 1000.0)
    body = Body("a", mesh, StableNeoHookean(E=E, nu=0.3), density=density)
    E[:], density[:] = 1.0, 1.0
    assert (body.material.E == 1e5).all()
    assert (body.density == 1000.0).all()


@pytest.mark.parametrize("dim", [2, 3])
def test_energy_densities_weighted_by_volume_are_the_energy(rng, dim):
    meshes = [Mesh.rectangle((1, 1), (2, 2)), Mesh.box((1, 1, 1), (1, 1, 1))]
    mesh = meshes[dim - 2]
    bodies = [
        Body("a", mesh, StableNeoHookean(E=np.linspace(1e5, 2e5, mesh.cell_count), nu=0.3)),
        Body("b", mesh, LinearElasticity(E=3e5, nu=0.2)),
    ]
    model = Model(Scene(bodies, SymplecticEuler()), dtype="float64", device="cpu")
    state = model.state()
    assert (model.energy_densities(state) == 0.0).all()
    state.assign(displacement=0.1 * rng.standard_normal((model.point_count, dim)))
    psi = model.energy_densities(state)
    assert (psi > 0.0).all()
    assert psi @ np.tile(mesh.cell_volumes, 2) == pytest.approx(model.energies(state).elastic, rel=1e-13)
