"""Quadratic cells: shape functions, meshes, forces, what they solve exactly, and that all else works with them."""

import numpy as np
import pytest
from helpers import REFERENCES, assert_routes_agree, filtered, irregular_mesh, model_of, random_rotation, solid

import warpfem as wf
from warpfem.elements import element_kernels
from warpfem.errors import MeshError, SceneError
from warpfem.folds import folds
from warpfem.materials import MATERIALS
from warpfem.mesh import Mesh
from warpfem.model import Model
from warpfem.shapes import shape
from warpfem.solvers.stability import Watch, largest_frequency

E, NU = 2.0e5, 0.35
SHAPES = [pytest.param(shape(dim, order), id=f"{dim}D-P{order}") for dim in (1, 2, 3) for order in (1, 2)]
dims = pytest.mark.parametrize("dim", [pytest.param(2, id="2D"), pytest.param(3, id="3D")])
QUICK = {("linear", 2), ("neo_hookean", 2), ("stable_neo_hookean", 3)}  # the rest of the matrix is slow
MATERIALS_DIMS = [
    pytest.param(name, dim, marks=[] if (name, dim) in QUICK else [pytest.mark.slow], id=f"{name}-{dim}D")
    for name in MATERIALS
    for dim in (2, 3)
]
materials = pytest.mark.parametrize(("name", "dim"), MATERIALS_DIMS)


def curved_mesh(dim: int) -> Mesh:
    """Irregular corners, and midpoints off the middles of their edges."""
    mesh = irregular_mesh(dim).quadratic()
    corner_count = irregular_mesh(dim).point_count
    points = mesh.points.copy()
    points[corner_count:] += 0.015 * np.random.default_rng(5).uniform(-1, 1, points[corner_count:].shape)
    return Mesh(points, mesh.cells, mesh.point_sets)


def block(dim: int, cells: int = 2) -> Mesh:
    if dim == 2:
        return Mesh.rectangle((1.0, 1.0), (cells, cells))
    return Mesh.box((1.0, 1.0, 1.0), (cells, cells, cells))


def cell_gradients(mesh: Mesh, displacement: np.ndarray) -> np.ndarray:
    """F (m, q, d, d) by isoparametric maps, one cell and one quadrature point after the other."""
    own = mesh.shape
    F = np.empty((mesh.cell_count, own.quadrature_count, mesh.dim, mesh.dim))
    for c, cell in enumerate(mesh.cells):
        for q, by_lambda in enumerate(own.gradients(own.quadrature_places)):
            now = (mesh.points[cell] + displacement[cell]).T @ by_lambda
            F[c, q] = now @ np.linalg.inv(mesh.points[cell].T @ by_lambda)
    return F


# ---- shape functions


@pytest.mark.parametrize("own", SHAPES)
def test_shape_functions_are_one_at_their_point_and_add_up_to_one(own):
    np.testing.assert_allclose(own.values(own.places), np.eye(own.point_count), atol=1e-15)
    places = np.random.default_rng(0).dirichlet(np.ones(own.dim + 1), 5)
    np.testing.assert_allclose(own.values(places).sum(axis=1), 1.0)
    np.testing.assert_allclose(own.gradients(places).sum(axis=1), 0.0, atol=1e-14)


@pytest.mark.parametrize("own", SHAPES)
def test_gradients_are_those_of_the_values(own):
    place = np.random.default_rng(1).dirichlet(np.ones(own.dim + 1), 1)
    for k in range(own.dim):
        step = 1e-6 * (np.eye(own.dim + 1)[k + 1] - np.eye(own.dim + 1)[0])
        difference = (own.values(place + step) - own.values(place - step)) / 2e-6
        np.testing.assert_allclose(own.gradients(place)[0, :, k], difference[0], atol=1e-9)


@pytest.mark.parametrize("own", SHAPES)
def test_quadrature_is_exact_to_twice_the_degree_of_gradients(own):
    """For the integral of lambda_0^a lambda_1^b over a simplex: a! b! d! / (a + b + d)! of its volume."""
    places = own.quadrature_places
    d = own.dim
    assert places[:, 0].mean() == pytest.approx(1.0 / (d + 1))
    if own.order == 2:
        assert (places[:, 0] ** 2).mean() == pytest.approx(2.0 / ((d + 1) * (d + 2)))
        assert (places[:, 0] * places[:, 1]).mean() == pytest.approx(1.0 / ((d + 1) * (d + 2)))


@pytest.mark.parametrize("own", SHAPES)
def test_parts_fill_the_cell(own):
    corners = own.places[own.parts][:, :, 1:]
    spans = corners[:, 1:] - corners[:, :1]
    np.testing.assert_allclose(np.linalg.det(spans), 1.0 / len(own.parts))


@dims
def test_lumped_mass_is_proportional_to_the_integrals_of_the_squares(dim):
    """By the integrals of products of barycentric coordinates, corner (2 l^2 - l)^2 and midpoint 16 l^2 m^2."""
    from math import factorial as f

    def integral(a: int, b: int = 0) -> float:
        return f(a) * f(b) * f(dim) / f(a + b + dim)

    corner = 4 * integral(4) - 4 * integral(3) + integral(2)
    middle = 16 * integral(2, 2)
    shares = shape(dim, 2).mass_shares
    assert shares.sum() == pytest.approx(1.0)
    assert shares[0] / shares[-1] == pytest.approx(corner / middle)


# ---- meshes


@dims
def test_quadratic_meshes_have_the_volume_the_surface_and_the_sets_of_the_linear_one(dim):
    linear = irregular_mesh(dim)
    mesh = linear.quadratic()
    assert (linear.order, mesh.order) == (1, 2)
    assert mesh.point_count == linear.point_count + len(linear.edges)
    assert mesh.quadratic() is mesh
    np.testing.assert_array_equal(mesh.corners, linear.cells)
    np.testing.assert_allclose(mesh.cell_volumes, linear.cell_volumes)
    np.testing.assert_allclose(mesh.boundary_face_areas, linear.boundary_face_areas)
    np.testing.assert_allclose(mesh.boundary_face_normals, linear.boundary_face_normals)
    np.testing.assert_allclose(mesh.boundary_face_shares.sum(axis=1), linear.boundary_face_areas)
    for name in linear.point_sets:
        faces = linear.select_faces(name)
        np.testing.assert_array_equal(mesh.select_faces(name), faces)
        np.testing.assert_array_equal(np.unique(mesh.boundary_faces[faces]), mesh.select_points(name))
    parts = mesh.points[mesh.linear_cells]
    assert np.linalg.det(parts[:, 1:] - parts[:, :1]).min() > 0.0
    assert len(mesh.linear_boundary_faces) == len(mesh.boundary_faces) * 2 ** (dim - 1)


def test_curved_edges_follow_a_circle():
    """The area of a disk of 6 x n triangles: an error of order 2 with straight edges, 4 with curved ones."""
    errors = {1: [], 2: []}
    for n in (2, 4):
        angles = np.arange(6 * n) * np.pi / (3 * n)
        ring = np.stack([np.cos(angles), np.sin(angles)], axis=1)
        points = np.concatenate([[[0.0, 0.0]], ring])
        k = np.arange(6 * n)
        straight = Mesh(points, np.stack([0 * k, 1 + k, 1 + (k + 1) % (6 * n)], axis=1))
        mesh = straight.quadratic()
        moved = mesh.points.copy()
        outer = np.unique(mesh.boundary_faces)
        moved[outer] /= np.linalg.norm(moved[outer], axis=1, keepdims=True)
        curved = Mesh(moved, mesh.cells)
        errors[1].append(np.pi - straight.cell_volumes.sum())
        errors[2].append(np.pi - curved.cell_volumes.sum())
        radial = moved[curved.boundary_faces[:, -1]]
        np.testing.assert_allclose(curved.boundary_face_normals, radial, atol=1e-12)
    assert np.log2(errors[1][0] / errors[1][1]) == pytest.approx(2.0, abs=0.1)
    assert np.log2(errors[2][0] / errors[2][1]) == pytest.approx(4.0, abs=0.1)


@dims
def test_inverted_quadratic_cells_are_turned_round(dim):
    mesh = curved_mesh(dim)
    cells = mesh.cells.copy()
    cells[::2] = cells[::2][:, mesh.shape.mirrored]
    with pytest.raises(MeshError, match="cell 0 is inverted at rest"):
        Mesh(mesh.points, cells)
    np.testing.assert_array_equal(Mesh.repaired(mesh.points, cells).cells, mesh.cells)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda points, cells: cells.__setitem__((0, 3), cells[1, 2]), "midpoint that is the corner of a cell"),
        (lambda points, cells: points.__setitem__(cells[0, 3], (0.9, 0.9)), "cell 0 is folded by its midpoints"),
        (lambda points, cells: cells.__setitem__((0, slice(3, 6)), cells[0, [4, 5, 3]]), "one midpoint"),
    ],
)
def test_wrong_midpoints_are_refused(change, message):
    mesh = block(2).quadratic()
    points, cells = mesh.points.copy(), mesh.cells.copy()
    change(points, cells)
    with pytest.raises(MeshError, match=message):
        Mesh(points, cells)


@pytest.mark.parametrize(("suffix", "dim"), [(".msh", 3), (".vtu", 3), (".inp", 3), (".vtu", 2)])
def test_quadratic_files_keep_their_curved_edges(suffix, dim, tmp_path):
    meshio = pytest.importorskip("meshio")
    mesh = curved_mesh(dim)
    path = tmp_path / f"curved{suffix}"
    points = np.pad(mesh.points, ((0, 0), (0, 3 - dim)))
    kind = "tetra10" if dim == 3 else "triangle6"
    formats = {".msh": "gmsh", ".vtu": "vtu", ".inp": "abaqus"}
    meshio.write(path, meshio.Mesh(points, [(kind, mesh.cells)]), file_format=formats[suffix])
    again = wf.load_mesh(path)
    assert again.order == 2
    np.testing.assert_array_equal(again.cells, mesh.cells)
    np.testing.assert_allclose(again.points, mesh.points, rtol=1e-12)


@dims
def test_folds_are_seen_between_the_parts(dim):
    mesh = block(dim).quadratic()
    assert len(folds(mesh, mesh.points)) == 0


# ---- forces and stiffness


def deformed(name: str, dim: int, dtype: str = "float64"):
    model = model_of(MATERIALS[name](E, NU), curved_mesh(dim), dtype)
    state = model.state()
    state.assign(displacement=0.012 * np.random.default_rng(1).uniform(-1, 1, model.rest_points.shape))
    return model, state


@materials
def test_energy_force_and_stress_are_those_of_the_quadrature_points(name, dim):
    model, state = deformed(name, dim)
    mesh = model.scene.bodies[0].mesh
    moduli = MATERIALS["neo_hookean"](E, NU)
    F = cell_gradients(mesh, state.displacement)
    V = mesh.quadrature_volumes.reshape(F.shape[:2])
    reference = REFERENCES[name]
    psi = np.array([[reference.energy_density(solid(f), moduli.mu, moduli.lam) for f in cell] for cell in F])
    assert model.elastic_energy(state.u) == pytest.approx((V * psi).sum(), rel=1e-12)
    np.testing.assert_allclose(model.energy_densities(state), (V * psi).sum(axis=1) / V.sum(axis=1), rtol=1e-11)
    P = np.array([[reference.stress(solid(f), moduli.mu, moduli.lam) for f in cell] for cell in F])
    stresses = model.stresses(state)
    scale = np.abs(P).max()
    np.testing.assert_allclose(stresses.first_piola_kirchhoff, P.reshape(-1, 3, 3), atol=1e-12 * scale)
    np.testing.assert_allclose(stresses.volumes, V.ravel())
    by_lambda = mesh.shape.quadrature_gradients
    expected = np.zeros_like(state.displacement)
    for c, cell in enumerate(mesh.cells):
        for q in range(len(by_lambda)):
            gradients = by_lambda[q] @ np.linalg.inv(mesh.points[cell].T @ by_lambda[q])
            np.add.at(expected, cell, -V[c, q] * gradients @ P[c, q, :dim, :dim].T)
    np.testing.assert_allclose(model.internal_force(state), expected, atol=1e-12 * np.abs(expected).max())
    jacobian, von_mises = model.diagnostics(state)
    np.testing.assert_allclose(jacobian, np.linalg.det(F).min(axis=1), rtol=1e-12)
    np.testing.assert_allclose(von_mises, stresses.von_mises.reshape(V.shape).mean(axis=1), rtol=1e-9)


@materials
def test_routes_to_the_differential_agree_with_differences_of_forces(name, dim, rng):
    model, state = deformed(name, dim)
    assert_routes_agree(model, state, rng.normal(size=model.rest_points.shape), rounding=1e-13)


@dims
def test_filtered_stiffness_is_that_of_the_filtered_tangents(dim):
    """A folded state, against NumPy's eigenvalues of each quadrature point's tangent."""
    from warpfem.linear import tangent_operator

    mesh = curved_mesh(dim)
    model = model_of(MATERIALS["stable_neo_hookean"](E, NU), mesh)
    state = model.state()
    state.assign(displacement=0.3 * np.random.default_rng(2).uniform(-1, 1, mesh.points.shape))
    moduli = MATERIALS["neo_hookean"](E, NU)
    F = cell_gradients(mesh, state.displacement)
    V = mesh.quadrature_volumes.reshape(F.shape[:2])
    p = np.random.default_rng(3).normal(size=mesh.points.shape)
    expected = np.zeros_like(p)
    by_lambda = mesh.shape.quadrature_gradients
    for c, cell in enumerate(mesh.cells):
        for q in range(len(by_lambda)):
            gradients = by_lambda[q] @ np.linalg.inv(mesh.points[cell].T @ by_lambda[q])
            tangent = REFERENCES["stable_neo_hookean"].tangent(solid(F[c, q]), moduli.mu, moduli.lam)
            dP = np.einsum("ijkl,kl->ij", filtered(tangent[:dim, :dim, :dim, :dim], "absolute"), p[cell].T @ gradients)
            np.add.at(expected, cell, V[c, q] * gradients @ dP.T)
    import warp as wp

    for route in ("closed", "assembled"):
        operator = tangent_operator(model, route, external=False)
        operator.linearize(state.u, 0.0, hessian="absolute")
        product = model.zeros()
        operator.apply(wp.array(p, dtype=model.types.vector, device="cpu"), product)
        np.testing.assert_allclose(product.numpy(), expected, atol=1e-10 * np.abs(expected).max())


@dims
def test_rigid_motion_makes_no_force(dim, rng):
    mesh = curved_mesh(dim)
    model = model_of(MATERIALS["stable_neo_hookean"](E, NU), mesh)
    state = model.state()
    state.assign(displacement=mesh.points @ random_rotation(rng, dim).T + 3.0 - mesh.points)
    assert np.abs(model.internal_force(state)).max() < 1e-10 * E


@dims
def test_stable_steps_are_those_of_the_stiffest_cell(dim):
    model = model_of(MATERIALS["stable_neo_hookean"](E, NU), curved_mesh(dim))
    mesh = model.scene.bodies[0].mesh
    (stiffness,) = model.element_stiffness()
    mass = np.outer(1000.0 * mesh.cell_volumes, np.repeat(mesh.shape.mass_shares, dim))
    K = stiffness.reshape(*mass.shape, -1) / np.sqrt(mass[:, :, None] * mass[:, None, :])
    exact = np.sqrt(np.linalg.eigvalsh(K).max())
    assert exact <= largest_frequency(model) * (1 + 1e-12) <= 1.02 * exact
    watch = Watch(model, model.state())
    assert exact >= 2.0 / watch.stable_dt(model.zeros()) * (1 - 1e-12) >= 0.96 * exact
    assert 2.0 / watch.certain_limit(model.state()) <= exact


# ---- what they solve


@dims
def test_linear_fields_are_reproduced(dim, rng):
    """The patch test: boundary points at x = A X, the inner ones found by equilibrium.

    In 2D with curved edges too; in 3D four quadrature points do not integrate the gradients of curved cells exactly.
    """
    mesh = curved_mesh(2) if dim == 2 else irregular_mesh(3).quadratic()
    A = np.eye(dim) + 0.1 * rng.normal(size=(dim, dim))
    mesh = mesh.with_point_set("boundary", mesh.boundary_points)
    support = wf.PrescribedMotion("boundary", lambda rest, time: rest @ A.T)
    body = wf.Body("patch", mesh, wf.StableNeoHookean(E, NU), supports=[support])
    model = Model(wf.Scene([body], wf.BackwardEuler()), dtype="float64")
    state = model.state()
    wf.StaticEquilibrium(tolerance=1e-10).solve(model, state)
    np.testing.assert_allclose(model.rest_points + state.displacement, mesh.points @ A.T, atol=1e-9)


@dims
def test_a_bar_that_hangs_by_its_weight_is_exact(dim):
    """u = rho g (L x - x^2/2) / E for nu = 0: quadratic, so no mesh is needed but two cells across."""
    L, density, g, young = 2.0, 1000.0, 10.0, 1e6
    mesh = Mesh.rectangle((L, 0.5), (2, 1)) if dim == 2 else Mesh.box((L, 0.5, 0.5), (2, 1, 1))
    body = wf.Body(
        "bar", mesh, wf.LinearElasticity(young, 0.0), density, supports=[wf.Pin("left")], element="quadratic"
    )
    model = Model(wf.Scene([body], wf.BackwardEuler(), gravity=(g,) + (0.0,) * (dim - 1)), dtype="float64")
    state = model.state()
    wf.StaticEquilibrium(tolerance=1e-11).solve(model, state)
    x = model.rest_points[:, 0]
    np.testing.assert_allclose(state.displacement[:, 0], density * g * (L * x - x**2 / 2) / young, atol=1e-11)
    np.testing.assert_allclose(state.displacement[:, 1:], 0.0, atol=1e-11)


@dims
def test_pure_bending_is_exact(dim):
    """u = k (-x y, x^2/2) for nu = 0, by the tractions sigma_xx = -E k y of a couple at the end."""
    k, young = 0.01, 1e5
    mesh = (
        Mesh.rectangle((2.0, 1.0), (2, 1), (0.0, -0.5))
        if dim == 2
        else Mesh.box((2.0, 1.0, 1.0), (2, 1, 1), (0, -0.5, 0))
    )
    mesh = mesh.quadratic()

    def bent(rest: np.ndarray) -> np.ndarray:
        u = np.zeros_like(rest)
        u[:, 0], u[:, 1] = -k * rest[:, 0] * rest[:, 1], 0.5 * k * rest[:, 0] ** 2
        return u

    ends = mesh.with_point_set("ends", lambda x: (x[:, 0] < 1e-9) | (x[:, 0] > 2.0 - 1e-9))
    support = wf.PrescribedMotion("ends", lambda rest, time: rest + bent(rest))
    body = wf.Body("beam", ends, wf.LinearElasticity(young, 0.0), supports=[support])
    model = Model(wf.Scene([body], wf.BackwardEuler()), dtype="float64")
    state = model.state()
    wf.StaticEquilibrium(tolerance=1e-11).solve(model, state)
    np.testing.assert_allclose(state.displacement, bent(model.rest_points), atol=1e-12)
    strain = -k * model.stresses(state).points[:, 1]
    stress = model.stresses(state).first_piola_kirchhoff
    np.testing.assert_allclose(stress[:, 0, 0], young * strain, atol=1e-12 * young)
    np.testing.assert_allclose(stress[:, 0, 1], 0.0, atol=1e-12 * young)


@dims
def test_tractions_at_faces_extrapolate_the_quadrature_points(dim):
    """Where F is linear in the rest place, the linear material's P is too, and known at the centroid of a face."""
    mesh = block(dim).quadratic()
    model = model_of(wf.LinearElasticity(E, NU), mesh)
    state = model.state()
    u = np.zeros_like(mesh.points)
    u[:, 0] = 1e-4 * mesh.points[:, 0] ** 2
    state.assign(displacement=u)
    faces = mesh.select_faces("right")
    moduli = wf.LinearElasticity(E, NU)
    expected = (float(moduli.lam) + 2.0 * float(moduli.mu)) * 2e-4
    np.testing.assert_allclose(model.tractions(state)[faces, 0], expected, rtol=1e-9)


@dims
def test_a_uniform_traction_gives_consistent_forces(dim):
    mesh = block(dim)
    value = (7.0, -3.0, 2.0)[:dim]
    body = wf.Body("block", mesh, wf.StableNeoHookean(E, NU), loads=[wf.Traction("right", value)], element="quadratic")
    model = Model(wf.Scene([body], wf.BackwardEuler()), dtype="float64")
    load = model.dead_load.numpy()
    np.testing.assert_allclose(load.sum(axis=0), value)
    arms = model.rest_points[:, 1]
    np.testing.assert_allclose((load[:, 0] * arms**2).sum(), value[0] / 3.0)  # quadratic moments too


@dims
@pytest.mark.parametrize(
    "solver", [wf.VelocityVerlet(), wf.BackwardEuler(), wf.BackwardEuler.linearised(linear_tolerance=1e-12)]
)
def test_free_fall_is_rigid(dim, solver):
    body = wf.Body("block", block(dim), wf.StableNeoHookean(E, NU), element="quadratic")
    g = (0.0, -10.0, 0.0)[:dim]
    simulation = wf.Simulation(wf.Scene([body], solver, gravity=g, dt=1e-3, fps=100, frames=2), dtype="float64")
    *_, frame = simulation.frames()
    np.testing.assert_allclose(frame.velocity - np.array(g) * frame.time, 0.0, atol=1e-12)
    assert simulation.model.lumped_mass.min() > 0.0
    assert simulation.model.lumped_mass.sum() == pytest.approx(1000.0)


# ---- scenes


def scene(dim: int, solver, **settings) -> wf.Scene:
    body = wf.Body(
        "block",
        block(dim).transformed(offset=(0.0, 0.05, 0.0)[:dim]),
        wf.StableNeoHookean(1e5, 0.4),
        supports=settings.pop("supports", []),
        element="quadratic",
    )
    return wf.Scene([body], solver, gravity=(0.0, -10.0, 0.0)[:dim], **settings)


@dims
def test_animations_draw_the_parts_of_quadratic_faces_and_cells(dim, tmp_path):
    from warpfem.usd import read_animation

    path = tmp_path / "block.usdc"
    floor = wf.Plane((0.0,) * dim, (0.0, 1.0, 0.0)[:dim])
    summary = wf.run(scene(dim, wf.BackwardEuler(), obstacles=[floor], dt=0.01, frames=8), path)
    assert summary.unconverged_steps == 0
    assert summary.largest_penetration > 0.0
    animation = read_animation(path)
    (body,) = animation.bodies
    mesh = block(dim).quadratic()
    assert len(body.cells) == mesh.cell_count * 2**dim
    assert len(body.surface_faces) == (len(mesh.boundary_faces) * 4 if dim == 3 else len(body.cells))
    (frame,) = animation.frame(8)
    assert len(frame.von_mises) == len(body.cells)
    assert (frame.von_mises.reshape(-1, 2**dim).T == frame.von_mises[:: 2**dim]).all()


@dims
def test_a_body_rests_with_its_weight_on_the_floor(dim):
    floor = wf.Plane((0.0,) * dim, (0.0, 1.0, 0.0)[:dim])
    simulation = wf.Simulation(
        scene(dim, wf.BackwardEuler(), obstacles=[floor], damping=5.0, dt=0.05, fps=2, frames=6), dtype="float64"
    )
    *_, frame = simulation.frames()
    force = simulation.model.zeros()
    simulation.model.contact.add_force(simulation.state.u, force)
    assert force.numpy()[:, 1].sum() == pytest.approx(1e4, rel=1e-3)
    assert frame.jacobian.min() > 0.5


def test_explicit_steps_of_quadratic_cells_keep_the_energy():
    simulation = wf.Simulation(scene(2, wf.VelocityVerlet(), supports=[wf.Pin("left")], frames=12), dtype="float64")
    totals = [frame.energies.total for frame in simulation.frames()]
    swing = max(frame for frame in totals) - min(totals)
    assert simulation.summary.last_energies.elastic > 10.0
    assert swing < 2e-3 * simulation.summary.last_energies.elastic


def test_a_run_of_quadratic_cells_is_taken_up_again(tmp_path):
    def simulation() -> wf.Simulation:
        return wf.Simulation(scene(2, wf.BackwardEuler(), supports=[wf.Pin("left")], dt=0.02, fps=50, frames=4))

    *_, whole = simulation().frames()
    path = tmp_path / "block.usdc"
    frames = wf.record(simulation(), path, checkpoint_every=1)
    next(frames), next(frames), next(frames)
    frames.close()
    *_, again = wf.record(simulation(), path, resume=True)
    np.testing.assert_array_equal(again.displacement, whole.displacement)


def test_bodies_of_both_kinds_share_a_scene():
    bodies = [
        wf.Body(name, block(2).transformed(offset=(2.0 * k, 0.0)), wf.StableNeoHookean(E, NU), element=name)
        for k, name in enumerate(("linear", "quadratic"))
    ]
    model = Model(wf.Scene(bodies, wf.BackwardEuler()), dtype="float64")
    assert [block.shape.order for block in model.blocks] == [1, 2]
    alone = [Model(wf.Scene([body], wf.BackwardEuler()), dtype="float64") for body in bodies]
    u = 0.02 * np.random.default_rng(4).normal(size=model.rest_points.shape)
    state = model.state()
    state.assign(displacement=u)
    parts = []
    for own, (points, _) in zip(alone, model.body_slices, strict=True):
        single = own.state()
        single.assign(displacement=u[points])
        parts.append((own.internal_force(single), own.stresses(single), own.force_differential(single, u[points])))
    np.testing.assert_allclose(model.internal_force(state), np.concatenate([part[0] for part in parts]), rtol=1e-12)
    together = model.stresses(state)
    np.testing.assert_array_equal(together.cauchy, np.concatenate([part[1].cauchy for part in parts]))
    np.testing.assert_array_equal(together.cells, np.concatenate([np.arange(8), np.repeat(8 + np.arange(8), 3)]))
    df = model.force_differential(state, u, "assembled")
    np.testing.assert_allclose(df, np.concatenate([part[2] for part in parts]), atol=1e-12 * np.abs(df).max())


def test_a_body_says_what_its_cells_are():
    material = wf.StableNeoHookean(E, NU)
    assert wf.Body("block", block(2), material).element == "linear"
    assert wf.Body("block", block(2).quadratic(), material).element == "quadratic"
    assert wf.Body("block", block(2), material, element="quadratic").mesh.order == 2
    with pytest.raises(SceneError, match=r"'block': element='linear', but the mesh is quadratic"):
        wf.Body("block", block(2).quadratic(), material, element="linear")
    with pytest.raises(SceneError, match=r"element must be 'linear', 'quadratic' or 'averaged', not 'cubic'"):
        wf.Body("block", block(2), material, element="cubic")


def test_listed_points_are_held_and_loaded_with_the_midpoints_between_them():
    mesh = block(2)
    left, right = mesh.select_points("left"), mesh.select_points("right")

    def model(left, right):
        supports, loads = [wf.Pin(left)], [wf.Traction(right, (1.0, 0.0)), wf.PointForce([0], (0.0, 2.0))]
        body = wf.Body("b", mesh, wf.StableNeoHookean(E, NU), supports=supports, loads=loads, element="quadratic")
        return Model(wf.Scene([body], wf.BackwardEuler()), dtype="float64")

    named, listed = model("left", "right"), model(left, right)
    np.testing.assert_array_equal(listed.supports.host_points, named.supports.host_points)
    assert len(listed.supports.host_points) == 5
    np.testing.assert_array_equal(listed.dead_load.numpy(), named.dead_load.numpy())
    with pytest.raises(SceneError, match=r"'b', Pin: .* refers to point 99"):
        model([0, 99], right)


def test_linear_scenes_compile_nothing_of_quadratic_cells():
    model = model_of(wf.StableNeoHookean(E, NU), block(2))
    assert model.blocks[0].kernels is element_kernels(wf.StableNeoHookean.functions, shape(2, 1), "float64")
    assert {len(array) for array in model.blocks[0].arguments.values()} == {8}
