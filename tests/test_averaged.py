"""Averaged cells: patches, the energy and its derivatives, what does not lock, and that all else works with them."""

import numpy as np
import pytest
import warp as wp
from helpers import REFERENCES, assert_routes_agree, custom_neo_hookean, irregular_mesh, model_of, solid

import warpfem as wf
from warpfem.errors import SceneError
from warpfem.linear import tangent_operator
from warpfem.materials import MATERIALS
from warpfem.mesh import Mesh
from warpfem.model import Model
from warpfem.patches import cell_patches
from warpfem.profiling import observe_launches
from warpfem.solvers.stability import Watch, largest_frequency

E, NU = 2.0e5, 0.45
dims = pytest.mark.parametrize("dim", [pytest.param(2, id="2D"), pytest.param(3, id="3D")])
QUICK = {("linear", 2), ("neo_hookean", 3), ("stable_neo_hookean", 2)}  # a kind of measure each; the rest is slow
materials = pytest.mark.parametrize(
    ("name", "dim"),
    [
        pytest.param(name, dim, marks=[] if (name, dim) in QUICK else [pytest.mark.slow], id=f"{name}-{dim}D")
        for name in MATERIALS
        for dim in (2, 3)
    ],
)
MEASURES = {
    "linear": lambda F: np.trace(F) - 3.0,
    "st_venant_kirchhoff": lambda F: 0.5 * (np.sum(F * F) - 3.0),
    "neo_hookean": lambda F: np.log(np.linalg.det(F)),
    "fixed_corotated": lambda F: np.linalg.det(F) - 1.0,
    "stable_neo_hookean": lambda F: np.linalg.det(F) - 1.0,
}


def jittered(mesh: Mesh, size: float) -> Mesh:
    """The mesh with its inner points off the grid."""
    points = mesh.points.copy()
    inner = np.setdiff1d(np.arange(mesh.point_count), mesh.boundary_points)
    points[inner] += size * np.random.default_rng(4).uniform(-1, 1, points[inner].shape)
    return Mesh(points, mesh.cells, mesh.point_sets)


def deformed(name: str, dim: int, size: float = 0.04, element: str = "averaged", **settings):
    """A random state of a body of several patches whose cells differ in stiffness."""
    mesh = irregular_mesh(dim)
    young = E * np.random.default_rng(7).uniform(1.0, 1.8, mesh.cell_count)
    model = model_of(MATERIALS[name](young, NU), mesh, element=element, **settings)
    state = model.state()
    state.assign(displacement=size * np.random.default_rng(1).uniform(-1, 1, mesh.points.shape))
    return model, state


def gradients(mesh: Mesh, displacement: np.ndarray) -> np.ndarray:
    """F (m, 3, 3) of linear cells."""
    x = mesh.points + displacement
    edges, rest = (p[mesh.cells[:, 1:]] - p[mesh.cells[:, :1]] for p in (x, mesh.points))
    return np.array([solid(f) for f in np.linalg.solve(rest, edges).transpose(0, 2, 1)])


# ---- patches


@pytest.mark.parametrize(
    "mesh",
    [
        pytest.param(Mesh.rectangle((2.0, 1.0), (14, 9)), id="rectangle"),
        pytest.param(Mesh.box((2.0, 1.0, 1.0), (6, 4, 3)), id="box5"),
        pytest.param(Mesh.box((2.0, 1.0, 1.0), (6, 4, 3), split=6), id="box6"),
    ],
)
def test_patches_are_connected_and_of_like_size(mesh):
    patch = cell_patches(mesh, np.ones(mesh.cell_count))
    least = 2**mesh.dim
    sizes = np.bincount(patch)
    assert sizes.min() >= least
    assert sizes.mean() < 1.6 * least
    assert sizes.max() < 3 * least
    for members in (np.flatnonzero(patch == g) for g in range(len(sizes))):
        reached = {members[0]}
        rest = set(members[1:])
        while near := {c for c in rest if any(shared(mesh, c, d) == mesh.dim for d in reached)}:
            reached |= near
            rest -= near
        assert not rest
    np.testing.assert_array_equal(patch, cell_patches(mesh, np.ones(mesh.cell_count)))


def shared(mesh: Mesh, a: int, b: int) -> int:
    return len(set(mesh.cells[a].tolist()) & set(mesh.cells[b].tolist()))


def test_patches_do_not_mix_stiff_and_soft_cells():
    mesh = Mesh.rectangle((2.0, 1.0), (10, 6))
    stiff = mesh.points[mesh.cells].mean(axis=1)[:, 0] > 0.9
    mixed = {}
    for ratio in (1.0, 1.5, 3.0):
        patch = cell_patches(mesh, np.where(stiff, ratio, 1.0))
        mixed[ratio] = len(set(patch[stiff]) & set(patch[~stiff]))
    assert mixed[1.0] == mixed[1.5] > 0
    assert mixed[3.0] == 0


# ---- energy, force and stiffness


@materials
def test_energy_is_that_of_cells_and_patches(name, dim):
    model, state = deformed(name, dim)
    mesh, (block,) = model.scene.bodies[0].mesh, model.blocks
    moduli = model.scene.bodies[0].material
    kept = moduli.lam * moduli.mu / (moduli.lam + moduli.mu)
    F, V = gradients(mesh, state.displacement), mesh.cell_volumes
    psi = np.array([REFERENCES[name].energy_density(*row) for row in zip(F, moduli.mu, kept, strict=True)])
    weight = (moduli.lam - kept) * V
    theta = np.array([MEASURES[name](f) for f in F])
    assert 1 < block.patch_count < mesh.cell_count
    mean = np.bincount(block.patch, weight * theta) / np.bincount(block.patch, weight)
    expected = psi + 0.5 * (moduli.lam - kept) * mean[block.patch] ** 2
    assert model.elastic_energy(state.u) == pytest.approx((V * expected).sum(), rel=1e-12)
    np.testing.assert_allclose(model.energy_densities(state), expected, rtol=1e-11)


@materials
def test_force_is_minus_the_energy_gradient(name, dim):
    model, state = deformed(name, dim)
    force, u, h = model.internal_force(state), state.displacement, 1e-6
    for point in np.random.default_rng(2).choice(len(u), 5, replace=False):
        for axis in range(dim):
            energy = []
            for step in (-h, h):
                moved = model.state()
                shifted = u.copy()
                shifted[point, axis] += step
                moved.assign(displacement=shifted)
                energy.append(model.elastic_energy(moved.u))
            difference = (energy[1] - energy[0]) / (2 * h)
            assert -difference == pytest.approx(force[point, axis], abs=1e-7 * np.abs(force).max())


@materials
def test_routes_to_the_differential_agree_with_differences_of_forces(name, dim, rng):
    model, state = deformed(name, dim)
    assert_routes_agree(model, state, rng.normal(size=model.rest_points.shape), rounding=1e-12)


def test_operators_keep_their_state_while_forces_are_taken_elsewhere(rng):
    model, state = deformed("stable_neo_hookean", 3)
    p = model.zeros()
    p.assign(rng.normal(size=model.rest_points.shape))
    for route in ("tape", "closed", "assembled"):
        operator = tangent_operator(model, route)
        operator.linearize(state.u, 0.0)
        before, after = model.zeros(), model.zeros()
        operator.apply(p, before)
        model.add_internal_force(p, model.zeros())
        operator.apply(p, after)
        np.testing.assert_array_equal(after.numpy(), before.numpy())


def matrix(model: Model, u: wp.array, route: str, hessian: str) -> np.ndarray:
    operator = tangent_operator(model, route)
    operator.linearize(u, 0.0, hessian=hessian, precondition=True)
    columns = []
    for row in np.eye(model.point_count * model.dim):
        product = model.zeros()
        operator.apply(wp.array(row.reshape(-1, model.dim), dtype=model.types.vector, device="cpu"), product)
        columns.append(product.numpy().ravel().copy())
    K = np.array(columns)
    d = model.dim
    for point, inverse in enumerate(operator.inverse_diagonal.numpy()):  # the preconditioner's blocks are K's
        own = K[point * d : (point + 1) * d, point * d : (point + 1) * d]
        if np.linalg.eigvalsh(own).min() > 1e-3 * np.abs(own).max():
            np.testing.assert_allclose(inverse @ own, np.eye(d), atol=1e-9)
    return K


@pytest.mark.parametrize("route", ["closed", "assembled"])
def test_filtered_stiffness_is_positive_semi_definite(route):
    model, state = deformed("stable_neo_hookean", 2, size=0.3)
    exact = matrix(model, state.u, route, "exact")
    np.testing.assert_allclose(exact, exact.T, atol=1e-10 * np.abs(exact).max())
    assert np.linalg.eigvalsh(exact).min() < -1e-2 * np.abs(exact).max()
    for kind in ("absolute", "clamped"):
        K = matrix(model, state.u, route, kind)
        np.testing.assert_allclose(K, K.T, atol=1e-10 * np.abs(K).max())
        assert np.linalg.eigvalsh(K).min() > -1e-10 * np.abs(K).max()


@materials
def test_no_state_has_more_energy_than_with_linear_cells(name, dim):
    for size in (0.001, 0.06):
        energies = {}
        for element in ("averaged", "linear"):
            model, state = deformed(name, dim, size, element)
            energies[element] = model.elastic_energy(state.u)
        assert energies["averaged"] < 0.9 * energies["linear"]


@materials
def test_a_uniform_deformation_is_that_of_linear_cells(name, dim, rng):
    """Where all cells agree there is nothing to average: energies, forces and stresses are the same."""
    H = 0.1 * rng.normal(size=(dim, dim))
    answers = []
    for element in ("averaged", "linear"):
        model = model_of(MATERIALS[name](E, NU), irregular_mesh(dim), element=element)
        state = model.state()
        state.assign(displacement=model.rest_points @ H.T)
        stresses = model.stresses(state)
        answers.append(
            (model.energy_densities(state), model.internal_force(state), stresses.cauchy, model.diagnostics(state)[1])
        )
    for own, expected in zip(*answers, strict=True):
        np.testing.assert_allclose(own, expected, atol=1e-11 * np.abs(expected).max())


@dims
@pytest.mark.parametrize("size", [0.0, 0.05])
def test_stability_limits_hold_for_the_whole(dim, size):
    model, state = deformed("stable_neo_hookean", dim, size)
    K = matrix(model, state.u, "closed", "exact")
    mass = np.repeat(model.lumped_mass, dim)
    exact = np.sqrt(np.linalg.eigvalsh(K / np.sqrt(np.outer(mass, mass))).max())
    assert exact <= largest_frequency(model, state.u) <= 3.0 * exact
    watch = Watch(model, model.state())
    assert exact <= 2.0 / watch.stable_dt(state.u)
    assert 2.0 / watch.certain_limit(state) == pytest.approx(exact, rel=0.02)


def test_an_inverted_cell_of_a_barrier_material_has_infinite_energy():
    model, state = deformed("neo_hookean", 2, size=0.5)
    assert model.diagnostics(state)[0].min() < 0.0
    assert model.elastic_energy(state.u) == np.inf
    assert np.isinf(model.energy_densities(state)).any()
    assert not np.isnan(model.energy_densities(state)).any()


# ---- locking


def tip(mesh: Mesh, element: str, nu: float) -> float:
    """How far the end of a cantilever sags under its weight."""
    body = wf.Body("beam", mesh, wf.LinearElasticity(1e6, nu), 100.0, supports=[wf.Pin("left")], element=element)
    gravity = (0.0, -9.81, 0.0)[: mesh.dim]
    model = Model(wf.Scene([body], wf.BackwardEuler(), gravity=gravity), dtype="float64")
    state = model.state()
    wf.StaticEquilibrium(tolerance=1e-6).solve(model, state)
    return -float(state.displacement[model.rest_points[:, 0] > 4.0 - 1e-9, 1].mean())


def test_a_nearly_incompressible_cantilever_bends():
    """Irregular tetrahedra, three across. Linear cells are as good where nu = 0.3, and bend hardly at all here.

    The deflections to converge to are those of ``benchmarks/locking.py cantilever``.
    """
    mesh = jittered(Mesh.box((4.0, 1.0, 1.0), (12, 3, 3), split=6), 0.06)
    loss = {}
    for nu, exact in ((0.3, 0.40183), (0.499, 0.38719)):
        for element in ("linear", "averaged"):
            loss[element, nu] = 1.0 - tip(mesh, element, nu) / (exact * 0.981)
    assert loss["linear", 0.499] > 0.85
    assert 0.2 < loss["averaged", 0.499] < loss["linear", 0.3] < 0.35
    assert 0.2 < loss["averaged", 0.3] < loss["linear", 0.3]


def roughness(element: str) -> float:
    """The part of the cells' pressures that differs from the mean of the cells about, in a block that is squashed."""
    mesh = jittered(Mesh.rectangle((1.0, 1.0), (12, 12)), 0.02)
    supports = [wf.Pin("bottom"), wf.PrescribedMotion("top", lambda rest, time: rest - (0.0, 0.01))]
    body = wf.Body("block", mesh, wf.LinearElasticity(1e6, 0.4999), supports=supports, element=element)
    model = Model(wf.Scene([body], wf.BackwardEuler()), dtype="float64")
    state = model.state()
    wf.StaticEquilibrium(tolerance=1e-6).solve(model, state)
    pressure = np.trace(model.stresses(state).cauchy, axis1=1, axis2=2)
    V, corners = mesh.cell_volumes, mesh.cells.ravel()
    at_points = np.bincount(corners, np.repeat(V * pressure, 3)) / np.bincount(corners, np.repeat(V, 3))
    rough = pressure - at_points[mesh.cells].mean(axis=1)
    return float(np.sqrt((V * rough**2).sum() / (V * pressure**2).sum()))


def test_pressures_do_not_alternate():
    assert roughness("linear") > 0.9
    assert roughness("averaged") < 0.1


# ---- scenes


def test_materials_without_a_volumetric_part_are_refused():
    mesh = Mesh.rectangle((1, 1), (2, 2))
    with pytest.raises(SceneError, match="EnergyMaterial does not state: take element='quadratic'"):
        wf.Body("block", mesh, custom_neo_hookean(1e5, 1e5), element="averaged")
    with pytest.raises(SceneError, match=r"is for nu >= 0.01, and the nu is 0: take element='linear'"):
        wf.Body("block", mesh, wf.NeoHookean(1e5, 0.0), element="averaged")
    nu = np.full(8, 0.3)
    nu[5] = -0.1
    with pytest.raises(SceneError, match=r"the nu of cell 5 \(1 in all\) is -0.1"):
        wf.Body("block", mesh, wf.StableNeoHookean(1e5, nu), element="averaged")
    with pytest.raises(SceneError, match="mesh is quadratic"):
        wf.Body("block", mesh.quadratic(), wf.NeoHookean(1e5, 0.4), element="averaged")


def scene(dim: int, solver, **settings) -> wf.Scene:
    """Bodies of each element above a rough floor, one of them pinned."""
    size = (0.4, 0.3, 0.4)[:dim]
    bodies = []
    for number, element in enumerate(("averaged", "linear", "averaged", "quadratic")):
        origin = (number * 0.6, 0.01, 0.0)[:dim]
        mesh = (Mesh.rectangle if dim == 2 else Mesh.box)(size, (3, 2, 3)[:dim], origin)
        material = wf.NeoHookean(5e4, 0.4) if number == 2 else wf.StableNeoHookean(5e4, 0.48)
        supports = [wf.Pin("top")] if number == 0 else []
        bodies.append(wf.Body(f"body{number}", mesh, material, supports=supports, element=element))
    floor = wf.Plane((0.0,) * dim, (0.0, 1.0, 0.0)[:dim], friction=0.5)
    return wf.Scene(bodies, solver, obstacles=[floor], gravity=(0.0, -9.81, 0.0)[:dim], **settings)


@dims
@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_explicit_and_implicit_runs_agree(dim, dtype):
    frames = {}
    for solver, dt in ((wf.VelocityVerlet(), "auto"), (wf.BackwardEuler(), 1e-3)):
        simulation = wf.Simulation(scene(dim, solver, dt=dt, fps=50, frames=3, damping=1.0), dtype=dtype)
        *_, frames[type(solver)] = simulation.frames()
        assert simulation.summary.unconverged_steps == 0
    verlet, euler = frames.values()
    size = np.abs(verlet.displacement).max()
    assert size > 0.01
    np.testing.assert_allclose(euler.displacement, verlet.displacement, atol=0.05 * size)
    assert (verlet.jacobian > 0.3).all()


def test_a_run_is_taken_up_again(tmp_path):
    def simulation() -> wf.Simulation:
        return wf.Simulation(scene(2, wf.BackwardEuler(), dt=0.01, fps=50, frames=4))

    *_, whole = simulation().frames()
    path = tmp_path / "bodies.usdc"
    frames = wf.record(simulation(), path, checkpoint_every=1)
    next(frames), next(frames), next(frames)
    frames.close()
    *_, again = wf.record(simulation(), path, resume=True)
    np.testing.assert_array_equal(again.displacement, whole.displacement)


def test_scenes_without_averaged_cells_pay_nothing_for_them():
    def seen(element: str) -> set[str]:
        body = wf.Body("block", Mesh.rectangle((1, 1), (3, 3)), wf.StableNeoHookean(1e5, 0.4), element=element)
        with observe_launches("cpu") as observed:
            list(wf.Simulation(wf.Scene([body], wf.BackwardEuler(), frames=1), device="cpu").frames())
        return {use.label for use in observed.kernels.values()}

    own = ("patch_", "coupling_", "cell_pressure")
    assert not [label for label in seen("linear") if any(name in label for name in own)]
    assert len([label for label in seen("averaged") if any(name in label for name in own)]) >= 4
