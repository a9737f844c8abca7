"""Materials: what the element kernels compute, against NumPy references, differences and what physics demands."""

import itertools
from typing import Any

import numpy as np
import pytest
import warp as wp
from helpers import (
    REFERENCES,
    ReferenceSamples,
    Samples,
    custom_neo_hookean,
    filtered,
    irregular_mesh,
    model_of,
    neo_hookean_energy,
    random_rotation,
    relative_error,
)

from warpfem.errors import MaterialError, SceneError
from warpfem.materials import (
    MATERIALS,
    EnergyMaterial,
    FixedCorotated,
    NeoHookean,
    StableNeoHookean,
)
from warpfem.mesh import Mesh
from warpfem.tensor import differentiable_rotation

pytestmark = pytest.mark.filterwarnings("ignore:.*less energy than rest")  # for nu < 0, as is meant here

E = 3.0e5
DIMS = [pytest.param(2, id="2D"), pytest.param(3, id="3D")]
materials = pytest.mark.parametrize("name", MATERIALS)
dims = pytest.mark.parametrize("dim", DIMS)
poisson = pytest.mark.parametrize("nu", [-0.3, 0.0, 0.3, 0.48])

INVERTIBLE = sorted(set(MATERIALS) - {"neo_hookean"})
ISOTROPIC = sorted(set(MATERIALS) - {"linear"})
# Every (material, dim), (material, dtype) and (dim, dtype) runs: float64 in both dimensions, float32 in one.
SINGLE = [
    pytest.param(name, dim, marks=[] if dim == 2 + index % 2 else [pytest.mark.slow], id=f"{name}-{dim}D")
    for index, name in enumerate(MATERIALS)
    for dim in (2, 3)
]


def stretched(stretches: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """U diag(stretches) V^T with random rotations U and V."""
    dim = len(stretches)
    return random_rotation(rng, dim) @ np.diag(stretches) @ random_rotation(rng, dim).T


def regular_gradients(dim: int) -> np.ndarray:
    """(n, dim, dim) with det F > 0: special and random ones, also with equal and nearly equal singular values."""
    rng = np.random.default_rng(7)
    axes = np.eye(dim)
    special = [axes, 2.0 * axes, 0.6 * axes, 1.3 * random_rotation(rng, dim)]
    special += [random_rotation(rng, dim) for _ in range(3)]
    special += [np.diag([1.4, 1.4, 0.8][:dim]), np.diag([0.7, 1.2, 1.2][3 - dim :]), np.diag([1.5, 0.8, 1.5][:dim])]
    special += [axes + 1e-9 * np.ones((dim, dim)), axes + 0.5 * np.eye(dim, k=1), -axes if dim == 2 else axes]
    special += [stretched(np.array([1.3, 1.3 + 1e-9, 0.9][:dim]), rng), stretched(np.full(dim, 0.9), rng)]
    return np.stack(special + [stretched(rng.uniform(0.5, 1.7, dim), rng) for _ in range(12)])


def inverted_gradients(dim: int) -> np.ndarray:
    """(n, dim, dim) with det F < 0, sums of two signed singular values away from 0."""
    rng = np.random.default_rng(8)
    flips = [np.diag([1.0, 1.0, -0.5][3 - dim :]), np.diag([-0.3, 1.2, 0.9][:dim])]
    for _ in range(10):
        stretches = rng.uniform(0.8, 1.6, dim)
        stretches[-1] = -rng.uniform(0.05, 0.6)
        flips.append(stretched(stretches, rng))
    return np.stack(flips)


def check_against_reference(material: Any, F: np.ndarray, tolerance: float) -> None:
    """psi, P and dP agree, relative to themselves, or to the moduli where they vanish."""
    moduli = material.moduli.p_wave
    actual, expected = Samples(material, F), ReferenceSamples(material, F)
    assert relative_error(actual.energy_density, expected.energy_density, moduli) < tolerance
    assert relative_error(actual.stress, expected.stress, moduli) < tolerance
    assert relative_error(actual.solid_stress, expected.solid_stress, moduli) < tolerance
    assert relative_error(actual.tangent, expected.tangent) < tolerance


# ---- against the textbook forms


def test_every_material_has_a_reference():
    assert set(MATERIALS) == set(REFERENCES)


@poisson
@dims
@materials
def test_agrees_with_reference(name, dim, nu):
    check_against_reference(MATERIALS[name](E, nu), regular_gradients(dim), 1e-12)


@poisson
@dims
@pytest.mark.parametrize("name", INVERTIBLE)
def test_agrees_with_reference_when_inverted(name, dim, nu):
    check_against_reference(MATERIALS[name](E, nu), inverted_gradients(dim), 1e-12)


@pytest.mark.parametrize(("name", "dim"), SINGLE)
def test_agrees_with_reference_in_single_precision(name, dim):
    F = regular_gradients(dim).astype(np.float32)
    H = F - np.eye(dim, dtype=np.float32)
    material = MATERIALS[name](E, 0.3)
    moduli = material.moduli.p_wave
    actual, expected = Samples(material, F, "float32"), ReferenceSamples(material, np.eye(dim) + H.astype(float))
    assert relative_error(actual.energy_density, expected.energy_density, moduli) < 3e-6
    assert relative_error(actual.stress, expected.stress, moduli) < 3e-6
    assert relative_error(actual.tangent, expected.tangent) < 3e-6


@pytest.mark.parametrize("strain", [1e-7, 1e-5, 1e-3, 1e-2])
@pytest.mark.parametrize(("name", "dim"), SINGLE)
def test_stress_near_rest_in_single_precision(name, dim, strain, rng):
    """The textbook forms have no correct digit here at a strain of 1e-7."""
    H = (strain * rng.normal(size=(20, dim, dim))).astype(np.float32)
    material = MATERIALS[name](E, 0.3)
    actual = Samples(material, np.eye(dim) + H, "float32", H=H).stress
    expected = ReferenceSamples(material, np.eye(dim) + H.astype(np.float64)).stress
    assert relative_error(actual, expected) < 3e-6


@pytest.mark.parametrize(("name", "dim"), SINGLE)
def test_energy_near_rest_in_single_precision(name, dim, rng):
    """Along a line, where P = psi' is exact to first order: psi = H:P/2 (1 + O(strain))."""
    strain = 1e-5
    H = (strain * rng.normal(size=(20, dim, dim))).astype(np.float32)
    samples = Samples(MATERIALS[name](E, 0.3), np.eye(dim) + H, "float32", H=H)
    work = 0.5 * np.einsum("nij,nij->n", samples.stress, H)
    assert relative_error(samples.energy_density, work) < 20.0 * strain


# ---- derivatives


def test_differences_converge_with_order_two():
    """The differences below are what they claim to be: an error of h^2."""
    F = regular_gradients(3)[-6:]
    exact = ReferenceSamples(StableNeoHookean(E, 0.3), F).stress
    errors = []
    for step in (2e-2, 1e-2):
        errors.append(relative_error(energy_differences(StableNeoHookean(E, 0.3), F, step), exact))
    assert np.log2(errors[0] / errors[1]) == pytest.approx(2.0, abs=0.05)


def perturbed(F: np.ndarray, step: float) -> np.ndarray:
    """(n, d, d, 2, d, d): F with entry ij moved by -step and +step."""
    d = F.shape[-1]
    shifts = step * np.einsum("ik,jl->ijkl", np.eye(d), np.eye(d))
    return F[:, None, None, None] + np.stack([-shifts, shifts], axis=2)


def energy_differences(material: Any, F: np.ndarray, step: float) -> np.ndarray:
    d = F.shape[-1]
    energy = Samples(material, perturbed(F, step).reshape(-1, d, d)).energy_density.reshape(-1, d, d, 2)
    return (energy[..., 1] - energy[..., 0]) / (2.0 * step)


def stress_differences(material: Any, F: np.ndarray, step: float) -> np.ndarray:
    """dP_ij/dF_kl (n, d, d, d, d)."""
    d = F.shape[-1]
    stress = Samples(material, perturbed(F, step).reshape(-1, d, d)).stress.reshape(-1, d, d, 2, d, d)
    return ((stress[:, :, :, 1] - stress[:, :, :, 0]) / (2.0 * step)).transpose(0, 3, 4, 1, 2)


def gradients(name: str, dim: int) -> np.ndarray:
    F = regular_gradients(dim)
    return F if name == "neo_hookean" else np.concatenate([F, inverted_gradients(dim)])


@dims
@materials
def test_stress_is_the_derivative_of_energy(name, dim):
    material = MATERIALS[name](E, 0.35)
    F = gradients(name, dim)
    stress = Samples(material, F).stress
    assert relative_error(energy_differences(material, F, 1e-5), stress, material.mu) < 1e-8


@dims
@materials
def test_tangent_is_the_derivative_of_stress(name, dim):
    material = MATERIALS[name](E, 0.35)
    F = gradients(name, dim)
    tangent = Samples(material, F).tangent
    assert relative_error(stress_differences(material, F, 1e-5), tangent) < 1e-8


@dims
@materials
def test_tangent_is_symmetric(name, dim):
    tangent = Samples(MATERIALS[name](E, 0.35), gradients(name, dim)).tangent
    assert relative_error(tangent.transpose(0, 3, 4, 1, 2), tangent) < 1e-14


# ---- the tangent made positive semi-definite


def without_loose_twists(F: np.ndarray, tangent: np.ndarray) -> np.ndarray:
    """The tangent without the negative twists of the pairs with s_i + s_j < 1, which have no bound."""
    U, s, Vt = np.linalg.svd(F)
    orientation = np.sign(np.linalg.det(U) * np.linalg.det(Vt))
    s, U = s * np.append(np.ones(len(s) - 1), orientation), U * np.append(np.ones(len(s) - 1), orientation)
    for i, j in itertools.combinations(range(len(s)), 2):
        twist = (np.outer(U[:, i], Vt[j]) - np.outer(U[:, j], Vt[i])) / np.sqrt(2.0)
        value = np.einsum("ij,ijkl,kl", twist, tangent, twist)
        if s[i] + s[j] < 1.0 and value < 0.0:
            tangent = tangent - value * np.multiply.outer(twist, twist)
    return tangent


@poisson
@dims
@pytest.mark.parametrize("name", ISOTROPIC)
@pytest.mark.parametrize("kind", ["absolute", "clamped"])
def test_filtered_tangent_has_the_filtered_eigenvalues(name, dim, nu, kind):
    """At any F: by the singular value decomposition here, by the eigenvalues of the whole matrix there."""
    material = MATERIALS[name](E, nu)
    F = gradients(name, dim)
    samples, exact = Samples(material, F), ReferenceSamples(material, F).tangent
    bounded = [without_loose_twists(*pair) for pair in zip(F, exact, strict=True)] if "corotated" in name else exact
    expected = np.array([filtered(tangent, kind) for tangent in bounded])
    indefinite = np.array([not np.allclose(a, b, rtol=1e-9) for a, b in zip(exact, expected, strict=True)])
    assert 0 < indefinite.sum() < len(F)  # else nothing is filtered here, or everything
    scale = np.linalg.norm(exact.reshape(len(F), -1), axis=1)
    actual = samples.filtered_tangent(kind)
    assert relative_error(actual, expected, scale) < 1e-12
    assert relative_error(actual[~indefinite], samples.tangent[~indefinite]) < 1e-12


@dims
def test_linear_elasticity_needs_no_filter(dim):
    kernels = Samples(MATERIALS["linear"](E, 0.3), regular_gradients(dim)).model.blocks[0].kernels
    for kind in ("absolute", "clamped"):
        assert getattr(kernels, f"{kind}_stiffness") is kernels.stiffness
        assert getattr(kernels, f"{kind}_differential") is kernels.differential


@dims
@pytest.mark.parametrize("name", INVERTIBLE)
def test_collapsed_cells_stay_finite(name, dim):
    """Points, lines, sheets, and where the rotation of the polar decomposition is not unique."""
    rng = np.random.default_rng(11)
    shapes = [
        (0.0, 0.0, 0.0),
        (1.0, 0.0, 0.0),
        (1.0, 1.0, 0.0),
        (1.0, 0.5, -0.5),
        (1.0, 0.5, -0.5 + 1e-9),
        (2.0, 1.0, -1.0),
    ]
    F = np.stack([stretched(np.array(s[3 - dim :]), rng) for s in shapes])
    samples = Samples(MATERIALS[name](E, 0.35), F)
    for values in (samples.energy_density, samples.stress, samples.solid_stress, samples.tangent):
        assert np.isfinite(values).all()
    if name == "linear":
        return
    for kind in ("absolute", "clamped"):
        tangent = samples.filtered_tangent(kind).reshape(len(F), dim * dim, dim * dim)
        assert np.isfinite(tangent).all()
        eigenvalues = np.linalg.eigvalsh(0.5 * (tangent + tangent.transpose(0, 2, 1)))
        assert (eigenvalues[:, 0] >= -1e-12 * eigenvalues[:, -1]).all()
        assert eigenvalues.max() < 30.0 * E  # also where s_i + s_j = 0 and the exact one has no bound


@pytest.mark.parametrize("dtype", ["float32", "float64"])
@dims
def test_neo_hookean_under_extreme_compression(dim, dtype):
    """Squashed to 1e-3: J = 1e-6 or 1e-9, of which J - 1 keeps few digits or none."""
    material = NeoHookean(E=1.0, nu=0.3)
    F = 1e-3 * np.eye(dim)[None]
    samples, expected = Samples(material, F, dtype), ReferenceSamples(material, F)
    resolved = 20.0 * samples.model.types.epsilon / 1e-3  # H is stored, and F is I + H
    assert relative_error(samples.energy_density, expected.energy_density) <= resolved
    assert relative_error(samples.stress, expected.stress) <= resolved
    assert relative_error(samples.tangent, expected.tangent) <= resolved


@dims
def test_neo_hookean_ends_at_collapse(dim):
    F = np.concatenate([inverted_gradients(dim), [np.diag([1.0, 1.0, 0.0][3 - dim :])]])
    samples = Samples(NeoHookean(E, 0.3), F)
    assert np.isposinf(samples.energy_density).all()
    assert not np.isfinite(samples.stress).all(axis=(1, 2)).any()


# ---- what physics demands


@dims
@materials
def test_rest_has_no_energy_and_no_stress(name, dim):
    samples = Samples(MATERIALS[name](E, 0.35), np.eye(dim)[None])
    assert samples.energy_density == 0.0
    assert (samples.solid_stress == 0.0).all()
    assert (samples.stress == 0.0).all()


@dims
@pytest.mark.parametrize("name", ISOTROPIC)
def test_objective_and_isotropic(name, dim, rng):
    """psi(Q F R) = psi(F) and P(Q F R) = Q P(F) R for rotations Q and R."""
    material = MATERIALS[name](E, 0.35)
    F = gradients(name, dim)
    Q, R = random_rotation(rng, dim), random_rotation(rng, dim)
    samples, turned = Samples(material, F), Samples(material, Q @ F @ R)
    assert relative_error(turned.energy_density, samples.energy_density, material.mu) < 1e-13
    assert relative_error(turned.stress, Q @ samples.stress @ R, material.mu) < 1e-13


@dims
def test_linear_elasticity_is_isotropic_but_not_objective(dim, rng):
    material = MATERIALS["linear"](E, 0.35)
    F = regular_gradients(dim)
    Q = random_rotation(rng, dim)
    samples, turned = Samples(material, F), Samples(material, Q @ F @ Q.T)
    assert relative_error(turned.stress, Q @ samples.stress @ Q.T, material.mu) < 1e-13
    assert np.linalg.norm(Samples(material, Q[None]).stress) > material.mu


@poisson
@dims
@materials
def test_obeys_hookes_law_at_rest(name, dim, nu, rng):
    """For the E and nu given: eps = ((1 + nu) sigma - nu tr(sigma) I) / E, in plane strain with eps_zz = 0."""
    strain = 1e-7
    H = strain * rng.normal(size=(10, dim, dim))
    samples = Samples(MATERIALS[name](E, nu), np.eye(dim) + H, H=H)
    sigma = samples.solid_stress
    eps = ((1.0 + nu) * sigma - nu * np.trace(sigma, axis1=1, axis2=2)[:, None, None] * np.eye(3)) / E
    expected = np.zeros((10, 3, 3))
    expected[:, :dim, :dim] = 0.5 * (H + H.transpose(0, 2, 1))
    assert relative_error(eps, expected) < 100.0 * strain
    if dim == 2:
        np.testing.assert_allclose(sigma[:, 2, 2], nu * (sigma[:, 0, 0] + sigma[:, 1, 1]), atol=100.0 * strain**2 * E)


@dims
@materials
def test_softest_and_stiffest_moduli_obey_hookes_law(name, dim):
    """The tangent at rest is Hooke's, up to the ends of the domain of nu."""
    eye = np.eye(dim)
    for nu in (-0.99, 0.4999):
        material = MATERIALS[name](E, nu)
        mu, lam = E / (2.0 * (1.0 + nu)), E * nu / ((1.0 + nu) * (1.0 - 2.0 * nu))
        hooke = mu * (np.einsum("ik,jl->ijkl", eye, eye) + np.einsum("il,jk->ijkl", eye, eye))
        hooke += lam * np.einsum("ij,kl->ijkl", eye, eye)
        assert relative_error(Samples(material, eye[None]).tangent, hooke[None]) < 1e-13


# ---- parameters


@materials
@pytest.mark.parametrize(
    "moduli",
    [
        {},
        {"E": 1e5},
        {"E": 1e5, "nu": 0.3, "K": 1e5},
        {"E": 1e5, "nu": 0.5},
        {"E": -1.0, "nu": 0.3},
        {"E": np.nan, "nu": 0.3},
    ],
)
def test_refuses_wrong_moduli(name, moduli):
    with pytest.raises(MaterialError, match=MATERIALS[name].__name__):
        MATERIALS[name](**moduli)


def test_moduli_are_all_set():
    material = StableNeoHookean(mu=1e5, lam=2e5)
    assert (material.E, material.nu, material.K) == pytest.approx((8e5 / 3.0, 1.0 / 3.0, 8e5 / 3.0))


@pytest.mark.parametrize(
    "make", [NeoHookean, lambda E, nu: custom_neo_hookean(*_lame(E, nu))], ids=["built-in", "custom"]
)
def test_parameters_per_cell(make, rng):
    """A body whose cells differ equals bodies of one cell each."""
    mesh = irregular_mesh(3)
    young = rng.uniform(1e4, 1e6, mesh.cell_count)
    nu = rng.uniform(0.0, 0.45, mesh.cell_count)
    u = 0.05 * rng.normal(size=mesh.points.shape)
    expected = np.zeros_like(u)
    for cell in (0, 7, mesh.cell_count - 1):
        points = mesh.cells[cell]
        alone = model_of(make(young[cell], nu[cell]), Mesh(mesh.points[points], [range(4)]))
        state = alone.state()
        state.assign(displacement=u[points])
        mixed = model_of(make(young, nu), mesh)
        whole = mixed.state()
        whole.assign(displacement=u)
        expected = alone.stresses(state).first_piola_kirchhoff[0]
        np.testing.assert_allclose(mixed.stresses(whole).first_piola_kirchhoff[cell], expected, rtol=1e-12)


def _lame(E, nu):
    return E / (2.0 * (1.0 + nu)), E * nu / ((1.0 + nu) * (1.0 - 2.0 * nu))


def test_refuses_parameters_of_another_mesh():
    with pytest.raises(SceneError, match=r"shape \(7,\), but the mesh has 2 cells"):
        model_of(FixedCorotated(np.full(7, 1e5), 0.3), Mesh.rectangle((1, 1), (1, 1)))


# ---- a material given by psi alone


@dims
def test_psi_alone_equals_the_built_in(dim):
    """P by Warp's gradient, to rounding; dP by a central difference of it."""
    built_in = NeoHookean(E, 0.3)
    custom = custom_neo_hookean(built_in.mu, built_in.lam)
    F = regular_gradients(dim)
    ours, theirs = Samples(custom, F), Samples(built_in, F)
    assert relative_error(ours.energy_density, theirs.energy_density, built_in.mu) < 1e-13
    assert relative_error(ours.stress, theirs.stress, built_in.mu) < 1e-13
    assert relative_error(ours.solid_stress, theirs.solid_stress, built_in.mu) < 1e-13
    assert relative_error(ours.tangent, theirs.tangent) < 1e-8
    assert relative_error(ours.filtered_tangent("absolute"), theirs.filtered_tangent("absolute")) < 1e-8


def test_psi_alone_in_single_precision(rng):
    """Evaluated in float64: near rest it keeps the accuracy that a textbook psi would lose in float32."""
    built_in = NeoHookean(E, 0.3)
    custom = custom_neo_hookean(built_in.mu, built_in.lam)
    H = (1e-5 * rng.normal(size=(20, 2, 2))).astype(np.float32)
    expected = ReferenceSamples(built_in, np.eye(2) + H.astype(np.float64))
    actual = Samples(custom, np.eye(2) + H, "float32", H=H)
    assert relative_error(actual.stress, expected.stress) < 1e-6
    assert relative_error(actual.energy_density, expected.energy_density) < 1e-4  # psi/mu is 1e-10 here


def test_psi_alone_may_use_the_rotation(rng):
    """Fixed corotated by psi alone: the rotation carries its own derivative into Warp's gradient."""
    built_in = FixedCorotated(E, 0.3)
    custom = EnergyMaterial(corotated_energy, {"mu": built_in.mu, "lam": built_in.lam})
    F = gradients("fixed_corotated", 3)
    ours, expected = Samples(custom, F), ReferenceSamples(built_in, F)
    assert relative_error(ours.stress, expected.stress, built_in.mu) < 1e-12
    assert relative_error(ours.tangent, expected.tangent) < 1e-7


rotation = differentiable_rotation()


@wp.func
def corotated_energy(F: wp.mat33d, parameters: Any):
    strain = F - rotation(F)
    j = wp.determinant(F) - wp.float64(1.0)
    return parameters[0] * wp.ddot(strain, strain) + wp.float64(0.5) * parameters[1] * j * j


def test_psi_alone_may_be_anisotropic():
    """A fibre: P and dP are still the derivatives, and Newton's method is told not to use the principal axes."""
    material = EnergyMaterial(fibre_energy, {"mu": E, "stiffness": 5.0 * E}, isotropic=False)
    F = regular_gradients(3)
    samples = Samples(material, F)
    assert relative_error(energy_differences(material, F, 1e-5), samples.stress, E) < 1e-8
    assert relative_error(stress_differences(material, F, 1e-5), samples.tangent) < 1e-7
    kernels = samples.model.blocks[0].kernels
    assert kernels.clamped_stiffness is kernels.stiffness


@wp.func
def fibre_energy(F: wp.mat33d, parameters: wp.vec2d):
    one = wp.float64(1.0)
    fibre = F * wp.vector(wp.float64(0.6), wp.float64(0.8), wp.float64(0.0))
    stretch = wp.dot(fibre, fibre) - one
    j = wp.determinant(F) - one
    strain = wp.transpose(F) * F - wp.identity(n=3, dtype=wp.float64)
    return parameters[0] * (wp.ddot(strain, strain) + j * j) + parameters[1] * stretch * stretch


def scaled_energy(factor: float) -> wp.Function:
    weight = wp.float64(factor)

    @wp.func
    def psi(F: wp.mat33d, parameters: Any):
        return weight * parameters[0] * (wp.ddot(F, F) - wp.float64(3.0))

    return psi


def test_two_psi_of_one_name_are_two_materials():
    F = regular_gradients(2)[-3:]
    once, twice = (Samples(EnergyMaterial(scaled_energy(factor), {"mu": 1.0}), F).stress for factor in (1.0, 2.0))
    np.testing.assert_allclose(once, 2.0 * F, rtol=1e-14)
    np.testing.assert_allclose(twice, 4.0 * F, rtol=1e-14)


@wp.func
def single_precision_arguments(F: wp.mat33, parameters: wp.vec2):
    return 0.5 * parameters[0] * (wp.ddot(F, F) - 3.0)


@wp.func
def single_precision_numbers(F: wp.mat33d, parameters: Any):
    return 0.5 * parameters[0] * (wp.ddot(F, F) - 3.0)


@wp.func
def single_precision_result(F: wp.mat33d, parameters: Any):
    return wp.float32(wp.ddot(F, F))


@wp.func
def of_a_2x2_matrix(F: wp.mat22d, parameters: Any):
    return wp.ddot(F, F)


@wp.func
def of_three_parameters(F: wp.mat33d, parameters: wp.vec3d):
    return parameters[2] * wp.ddot(F, F)


@wp.func
def without_result(F: wp.mat33d, parameters: Any):
    wp.ddot(F, F)


@wp.func
def of_one_argument(F: wp.mat33d):
    return wp.ddot(F, F)


def undecorated(F, parameters):
    return F[0, 0]


@pytest.mark.parametrize(
    ("psi", "message"),
    [
        (undecorated, "decorated with @wp.func"),
        (of_one_argument, "'of_one_argument' must take two arguments"),
        (single_precision_arguments, r"wp.float64\(0.5\).*overload.*\[mat33d, vec2d\]"),
        (single_precision_numbers, r"all numbers in float64.*return 0.5 .*float32.*float64"),
        (single_precision_result, "-> wp.float64"),
        (of_a_2x2_matrix, "F: wp.mat33d"),
        (of_three_parameters, "2 parameters"),
        (without_result, "'without_result' must be"),
    ],
)
def test_refuses_psi(psi, message):
    with pytest.raises(MaterialError, match=f"(?s){message}"):
        EnergyMaterial(psi, {"mu": 1e5, "lam": 1e5})


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({}, "at least one parameter"),
        ({"mu": np.nan, "lam": 1.0}, "'mu' must be finite"),
        ({"mu": 1.0, "lam": np.array([1.0, np.inf])}, "'lam' must be finite"),
        ({"mu": "soft", "lam": 1.0}, "'mu' must be finite numbers, not 'soft'"),
    ],
)
def test_refuses_parameters_of_psi(values, message):
    with pytest.raises(MaterialError, match=message):
        EnergyMaterial(neo_hookean_energy, values)
