"""Gravity, point forces and tractions."""

import numpy as np
import pytest
from helpers import irregular_mesh
from stepping import MATERIALS, advance, ready, slab

from warpfem.boundary import Pin, PointForce, Traction
from warpfem.errors import SceneError
from warpfem.mesh import Mesh
from warpfem.model import Model
from warpfem.scene import Body, Scene
from warpfem.solvers import BackwardEuler, SymplecticEuler

VECTOR = (3.0, -2.0, 1.0)


def dead_load(scene):
    return Model(scene, device="cpu", dtype="float64").dead_load.numpy()


def moment(points, force):
    """sum x_i f_j - x_j f_i."""
    return points.T @ force - force.T @ points


@pytest.mark.parametrize("dim", [2, 3])
def test_gravity_is_the_weight(dim):
    mesh = irregular_mesh(dim)
    density = np.linspace(500.0, 2000.0, mesh.cell_count)
    g = np.array(VECTOR[:dim])
    load = dead_load(Scene([Body("body", mesh, MATERIALS[dim], density=density)], SymplecticEuler(), gravity=g))
    weight = density * mesh.cell_volumes
    np.testing.assert_allclose(load.sum(axis=0), weight.sum() * g, rtol=1e-13)
    centroids = mesh.points[mesh.cells].mean(axis=1)
    expected = moment(centroids, weight[:, None] * g)
    np.testing.assert_allclose(moment(mesh.points, load), expected, rtol=0, atol=1e-13 * np.abs(expected).max())


@pytest.mark.parametrize("dim", [2, 3])
def test_resultant_of_a_traction_is_traction_times_area(dim):
    mesh = irregular_mesh(dim)
    t = np.array(VECTOR[:dim])
    load = dead_load(Scene([Body("body", mesh, MATERIALS[dim], loads=[Traction("right", t)])], SymplecticEuler()))
    faces = mesh.boundary_faces[mesh.select_faces("right")]
    corners = mesh.points[faces]
    if dim == 2:
        areas = np.linalg.norm(corners[:, 1] - corners[:, 0], axis=1)
    else:
        areas = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    assert len(faces) == {2: 3, 3: 8}[dim]
    np.testing.assert_allclose(load.sum(axis=0), areas.sum() * t, rtol=1e-13)
    expected = moment(corners.mean(axis=1), np.outer(areas, t))
    np.testing.assert_allclose(moment(mesh.points, load), expected, rtol=0, atol=1e-13)
    np.testing.assert_array_equal(np.flatnonzero(load.any(axis=1)), np.unique(faces))


def test_point_forces_add_up_with_all_other_loads():
    g, f, t = np.array([0.0, -9.0]), np.array([2.0, 1.0]), np.array([0.0, 5.0])
    bodies = [
        slab(2),
        Body("other", Mesh.rectangle((1.0, 1.0), (1, 1)), MATERIALS[2], loads=[
            PointForce([0, 3], f), PointForce([3], f), Traction("top", t)
        ]),
    ]  # fmt: skip
    model = Model(Scene(bodies, SymplecticEuler(), gravity=g), device="cpu", dtype="float64")
    load = model.dead_load.numpy() - model.lumped_mass[:, None] * g
    own = load[model.point_starts[1] :]
    np.testing.assert_allclose(load[: model.point_starts[1]], 0.0, atol=1e-12)
    expected = np.array([f, [0.0, 0.0], [0.0, 0.0], 2.0 * f])
    expected[bodies[1].mesh.select_points("top")] += t / 2.0
    np.testing.assert_allclose(own, expected, atol=1e-12)


@pytest.mark.parametrize("dim", [2, 3])
def test_a_bar_under_end_load_takes_its_stress(dim):
    # on rollers the stress is uniform: P_xx = t exactly, whatever the mesh
    t = 2e4
    rollers = [Pin(side, axes=(axis,)) for axis, side in enumerate(("left", "bottom", "back")[:dim])]
    body = slab(dim, supports=rollers, loads=[Traction("right", (t, 0.0, 0.0)[:dim])])
    solver = BackwardEuler(tolerance=1e-9)
    model, state, stepper = ready(Scene([body], solver, damping=50.0))
    advance(stepper, state, 1.0, 25)
    stresses = model.stresses(state)
    nominal = np.zeros((dim, dim))
    nominal[0, 0] = t
    in_plane = stresses.first_piola_kirchhoff[:, :dim, :dim]
    np.testing.assert_allclose(in_plane, np.broadcast_to(nominal, in_plane.shape), rtol=0, atol=1e-6 * t)
    F = stresses.deformation_gradient
    if dim == 3:
        np.testing.assert_allclose(stresses.cauchy[:, 0, 0], t / (F[:, 1, 1] * F[:, 2, 2]), rtol=1e-6)
    else:  # Hooke's law in plane strain
        E, nu = MATERIALS[2].E, MATERIALS[2].nu
        np.testing.assert_allclose(F[:, 0, 0] - 1.0, t * (1.0 - nu**2) / E, rtol=1e-6)
    # a moment later nothing moves: the work of the load is twice the energy of a linear body
    energies = model.energies(state)
    assert energies.kinetic < 1e-12 * energies.elastic
    if dim == 2:
        assert energies.load == pytest.approx(-2.0 * energies.elastic, rel=1e-6)


@pytest.mark.parametrize(
    ("loads", "message"),
    [
        ([PointForce("nowhere", (1.0, 0.0))], "body 'slab', PointForce: .*nowhere"),
        ([Traction("nowhere", (1.0, 0.0))], "body 'slab', Traction: .*nowhere"),
        ([Traction([0], (1.0, 0.0))], "body 'slab', Traction: "),
        ([PointForce("left", (1.0, 0.0, 0.0))], "must have 2 components"),
        (["left"], "'left' is not a PointForce or Traction"),
    ],
)
def test_refuses_loads(loads, message):
    with pytest.raises(SceneError, match=message):
        Model(Scene([slab(2, loads=loads)], SymplecticEuler()), dtype="float64")


@pytest.mark.parametrize("value", [(1.0,), (np.nan, 0.0), "up", 3.0, None])
@pytest.mark.parametrize("kind", [PointForce, Traction])
def test_refuses_a_force_that_is_not_a_vector(kind, value):
    with pytest.raises(SceneError, match=f"{kind.__name__}: .* must be a (finite )?vector"):
        kind("left", value)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (dict(gravity=(0.0, 0.0, -9.8)), "gravity must be a finite vector of length 2"),
        (dict(gravity=(0.0, np.inf)), "gravity"),
        (dict(damping=-1.0), "damping must be a finite number >= 0"),
        (dict(damping=np.nan), "damping"),
    ],
)
def test_refuses_gravity_and_damping(settings, message):
    with pytest.raises(SceneError, match=message):
        Scene([slab(2)], SymplecticEuler(), **settings)
