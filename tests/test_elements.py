"""Element kernels on irregular meshes: forces, stiffness, patch test, rigid motions and balance."""

import numpy as np
import pytest
from helpers import REFERENCES, custom_neo_hookean, irregular_mesh, model_of, random_rotation, solid

from warpfem.elements import element_kernels
from warpfem.materials import MATERIALS, Material
from warpfem.model import Model, State
from warpfem.shapes import shape

E, NU = 2.0e5, 0.35
CUSTOM = "psi alone"
NAMES = [*MATERIALS, CUSTOM]
# Every (material, dim) in float64.
SETTINGS = [pytest.param(name, dim, id=f"{name}-{dim}D") for name in NAMES for dim in (2, 3)]
ROTATING = [setting for setting in SETTINGS if setting.values[0] != "linear"]
# With those, every (material, dtype) and (dim, dtype).
SINGLE = [
    pytest.param(name, dim, marks=[] if dim == 2 + index % 2 else [pytest.mark.slow], id=f"{name}-{dim}D")
    for index, name in enumerate(NAMES)
    for dim in (2, 3)
]
settings = pytest.mark.parametrize(("name", "dim"), SETTINGS)
dims = pytest.mark.parametrize("dim", [pytest.param(2, id="2D"), pytest.param(3, id="3D")])


def material(name: str) -> Material:
    if name != CUSTOM:
        return MATERIALS[name](E, NU)
    moduli = MATERIALS["neo_hookean"](E, NU).moduli
    return custom_neo_hookean(moduli.mu, moduli.lam)


def deformed(name: str, dim: int, dtype: str = "float64", size: float = 0.04) -> tuple[Model, State]:
    """A model of an irregular mesh with random displacements, no cell inverted."""
    model = model_of(material(name), irregular_mesh(dim), dtype)
    state = model.state()
    state.assign(displacement=size * np.random.default_rng(1).uniform(-1, 1, model.rest_points.shape))
    return model, state


def moved(model: Model, displacement: np.ndarray) -> State:
    state = model.state()
    state.assign(displacement=displacement)
    return state


# ---- energy, force and stiffness are derivatives of each other


@settings
def test_energy_is_the_volume_weighted_density(name, dim):
    model, state = deformed(name, dim)
    mesh = model.scene.bodies[0].mesh
    x = model.rest_points + state.displacement
    edges = x[mesh.cells[:, 1:]] - x[mesh.cells[:, :1]]
    rest = mesh.points[mesh.cells[:, 1:]] - mesh.points[mesh.cells[:, :1]]
    F = np.linalg.solve(rest, edges).transpose(0, 2, 1)  # rows: F e = e'
    moduli = MATERIALS["neo_hookean"](E, NU)
    psi = REFERENCES[name if name != CUSTOM else "neo_hookean"].energy_density
    expected = sum(V * psi(solid(f), moduli.mu, moduli.lam) for V, f in zip(mesh.cell_volumes, F, strict=True))
    assert model.elastic_energy(state.u) == pytest.approx(expected, rel=1e-12)


@settings
def test_force_is_minus_the_energy_gradient(name, dim):
    """Every component of some points' forces, by central differences."""
    model, state = deformed(name, dim)
    force = model.internal_force(state)
    u = state.displacement
    h = 1e-6
    for point in np.random.default_rng(2).choice(len(u), 6, replace=False):
        for axis in range(dim):
            energy = []
            for step in (-h, h):
                shifted = u.copy()
                shifted[point, axis] += step
                energy.append(model.elastic_energy(moved(model, shifted).u))
            assert -(energy[1] - energy[0]) / (2 * h) == pytest.approx(
                force[point, axis], abs=1e-7 * np.abs(force).max()
            )


@settings
def test_differential_is_the_force_gradient(name, dim, rng):
    model, state = deformed(name, dim)
    p = rng.normal(size=model.rest_points.shape)
    h = 1e-6
    ahead, behind = (model.internal_force(moved(model, state.displacement + s * h * p)) for s in (1, -1))
    df = model.force_differential(state, p, "assembled")  # test_linear.py compares the routes
    np.testing.assert_allclose((ahead - behind) / (2 * h), df, atol=1e-7 * np.abs(df).max())


@settings
def test_element_stiffness_adds_up_to_the_differential(name, dim, rng):
    """K_e p_e of the cells, summed over the cells by NumPy."""
    model, state = deformed(name, dim)
    p = rng.normal(size=model.rest_points.shape)
    (stiffness,) = model.element_stiffness(state.u)
    cells = model.scene.bodies[0].mesh.cells
    product = np.zeros_like(p)
    np.add.at(product, cells, np.einsum("caibj,cbj->cai", stiffness, p[cells]))
    df = model.force_differential(state, p, "assembled")
    np.testing.assert_allclose(-product, df, atol=1e-13 * np.abs(df).max())


@pytest.mark.parametrize(("name", "dim"), SINGLE)
def test_single_precision_agrees_with_double(name, dim, rng):
    double, state = deformed(name, dim)
    single, rounded = deformed(name, dim, "float32")
    assert single.elastic_energy(rounded.u) == pytest.approx(double.elastic_energy(state.u), rel=1e-5)
    force = double.internal_force(state)
    np.testing.assert_allclose(single.internal_force(rounded), force, atol=1e-5 * np.abs(force).max())
    p = rng.normal(size=force.shape)
    df = double.force_differential(state, p, "assembled")
    np.testing.assert_allclose(single.force_differential(rounded, p, "assembled"), df, atol=1e-5 * np.abs(df).max())


# ---- balance


@settings
def test_forces_and_torques_sum_to_zero(name, dim):
    model, state = deformed(name, dim)
    force = model.internal_force(state)
    size = np.abs(force).sum()
    assert (np.abs(force.sum(axis=0)) < 1e-14 * size).all()
    # linear elasticity takes its moments about the rest positions
    lever = model.rest_points + (0.0 if name == "linear" else state.displacement)
    torque = np.einsum("ni,nj->ij", lever, force)
    assert np.abs(torque - torque.T).max() < 1e-14 * size
    assert size > 1.0


@pytest.mark.parametrize(("name", "dim"), ROTATING)
def test_rigid_motion_has_no_force(name, dim, rng):
    model = model_of(material(name), irregular_mesh(dim))
    X = model.rest_points
    state = moved(model, X @ random_rotation(rng, dim).T + rng.normal(size=dim) - X)
    rounding = 1e-14 * E * X.size
    assert np.abs(model.internal_force(state)).max() < rounding
    assert np.abs(model.stresses(state).first_piola_kirchhoff).max() < rounding
    assert abs(model.elastic_energy(state.u)) < rounding


@dims
def test_rotation_loads_linear_elasticity(dim, rng):
    """The documented flaw: it takes a rotation for a strain. Translations are free."""
    model = model_of(material("linear"), irregular_mesh(dim))
    X = model.rest_points
    assert np.abs(model.internal_force(moved(model, X @ random_rotation(rng, dim).T - X))).max() > 1e-3 * E
    assert np.abs(model.internal_force(moved(model, np.ones_like(X)))).max() == 0.0


@pytest.mark.parametrize(("name", "dim"), SINGLE)
def test_rest_far_from_the_origin_costs_nothing(name, dim):
    """A float32 body 10 km away: rest shapes enter by their edges alone."""
    mesh = irregular_mesh(dim)
    away = mesh.transformed(offset=[1e4] * dim)
    displacement = 0.01 * np.random.default_rng(1).uniform(-1, 1, mesh.points.shape)
    near, far = (model_of(material(name), m, "float32") for m in (mesh, away))
    force = near.internal_force(moved(near, displacement))
    np.testing.assert_allclose(far.internal_force(moved(far, displacement)), force, atol=1e-6 * np.abs(force).max())


@dims
def test_force_scales_with_the_size_of_the_body(dim):
    """f(s X, s u) = s^(dim - 1) f(X, u): from a millimetre to a kilometre."""
    mesh = irregular_mesh(dim)
    displacement = 0.04 * np.random.default_rng(1).uniform(-1, 1, mesh.points.shape)
    force = model_of(material("neo_hookean"), mesh)
    expected = force.internal_force(moved(force, displacement))
    for scale in (1e-3, 1e3):
        model = model_of(material("neo_hookean"), mesh.transformed(scale))
        actual = model.internal_force(moved(model, scale * displacement))
        np.testing.assert_allclose(actual / scale ** (dim - 1), expected, atol=1e-12 * np.abs(expected).max())


# ---- patch test


@settings
def test_affine_patch(name, dim):
    """A linear displacement field: uniform stress, and no force on any point inside."""
    model = model_of(material(name), irregular_mesh(dim))
    mesh = model.scene.bodies[0].mesh
    F = np.eye(dim) + 0.2 * np.random.default_rng(4).normal(size=(dim, dim))
    state = moved(model, mesh.points @ (F - np.eye(dim)).T + 0.3)
    inside = np.setdiff1d(np.arange(mesh.point_count), mesh.boundary_points)
    assert len(inside) > 0
    force = model.internal_force(state)
    assert np.abs(force[inside]).max() < 1e-13 * np.abs(force).max()
    moduli = MATERIALS["neo_hookean"](E, NU)
    P = REFERENCES[name if name != CUSTOM else "neo_hookean"].stress(solid(F), moduli.mu, moduli.lam)
    stresses = model.stresses(state)
    np.testing.assert_allclose(
        stresses.first_piola_kirchhoff, np.broadcast_to(P, (mesh.cell_count, 3, 3)), atol=1e-12 * E
    )
    # the forces on the boundary are those of the traction P N
    expected = np.zeros_like(force)
    share = mesh.boundary_face_normals @ P[:dim, :dim].T * mesh.boundary_face_areas[:, None] / dim
    for corner in range(dim):
        np.add.at(expected, mesh.boundary_faces[:, corner], -share)
    np.testing.assert_allclose(force, expected, atol=1e-12 * np.abs(force).max())


# ---- kernels


def test_kernels_are_made_once_and_on_request():
    kernels = element_kernels(MATERIALS["linear"].functions, shape(2, 1), "float64")
    assert element_kernels(MATERIALS["linear"].functions, shape(2, 1), "float64") is kernels
    assert element_kernels(MATERIALS["linear"].functions, shape(2, 1), "float32") is not kernels
    assert kernels.energy is kernels.energy
    fresh = type(kernels)(MATERIALS["linear"].functions, shape(2, 1), "float64")
    assert not {"energy", "force", "differential", "stiffness", "stress"} & set(vars(fresh))
