"""Places at rest, motions at them, and quantities of interest: none depends on the mesh."""

import numpy as np
import pytest

import warpfem as wf
from warpfem.errors import MeshError, SceneError, SimulationError
from warpfem.motion import Motion
from warpfem.places import locate, spread_places


def cubic(x: np.ndarray) -> np.ndarray:
    return np.stack([x[:, 0] ** 2 + x[:, 1], x[:, 0] * x[:, 1]], axis=1)


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("order", [1, 2])
def test_fields_of_the_order_of_the_cells_are_exact_at_places(rng, dim, order):
    mesh = wf.Mesh.rectangle((2, 1), (3, 2)) if dim == 2 else wf.Mesh.box((2, 1, 1), (3, 2, 2))
    mesh = mesh if order == 1 else mesh.quadratic()
    places = rng.uniform(size=(50, dim)) * mesh.bounding_box[1]
    field = cubic if order == 2 else (lambda x: x @ np.arange(1.0, dim + 1.0))
    found = locate(mesh, places).values(field(mesh.points))
    np.testing.assert_allclose(found, field(places), atol=1e-12)


def test_places_in_curved_cells_are_where_they_are_said_to_be(rng):
    flat = wf.Mesh.rectangle((1, 1), (2, 2)).quadratic()
    bent = flat.points + 0.1 * np.sin(3.0 * flat.points[:, ::-1])
    mesh = wf.Mesh(bent, flat.cells)
    inner = mesh.points[mesh.corners].mean(axis=1)
    assert np.abs(locate(mesh, inner).values(mesh.points) - inner).max() < 1e-12


def test_places_beside_a_coarse_mesh_are_extrapolated_to_and_far_ones_refused():
    mesh = wf.Mesh.rectangle((1, 1), (4, 4))
    place = np.array([[1.02, 0.5]])
    np.testing.assert_allclose(locate(mesh, place).values(mesh.points), place)
    with pytest.raises(MeshError, match="not in the body"):
        locate(mesh, np.array([[1.5, 0.5]]))
    with pytest.raises(MeshError, match="rows of 2"):
        locate(mesh, np.array([[0.5, 0.5, 0.5]]))


def test_spread_places_stand_for_equal_volumes():
    mesh = wf.Mesh.rectangle((4, 1), (7, 2))
    mesh = wf.Mesh(mesh.points**2, mesh.cells)  # cells of very different size
    places = spread_places(mesh, 4000)
    assert locate(mesh, places).weights.min() > -1e-9  # inside
    fraction = (places[:, 0] < 4.0).mean()  # of a body that is 16 m long
    assert fraction == pytest.approx(0.25, abs=0.01)


def pulled(cells: int) -> Motion:
    """A column pulled down, without swinging: the stress is the pull everywhere, on any mesh."""
    mesh = wf.Mesh.rectangle((1, 2), (cells, 2 * cells))
    body = wf.Body(
        "column",
        mesh,
        wf.LinearElasticity(E=1e6, nu=0.0),
        supports=[wf.Pin("top")],
        loads=[wf.Traction("bottom", (0, -3e4))],
    )
    scene = wf.Scene([body], wf.BackwardEuler(tolerance=1e-9), fps=1e-3, frames=1)
    return Motion.of(wf.Simulation(scene, device="cpu", dtype="float64"))


def test_quantities_do_not_depend_on_the_mesh():
    at = (0.4, 0.53)
    for cells in (1, 3):
        motion = pulled(cells)
        sag = wf.quantities.final_displacement("column", at, axis=1)(motion)
        assert sag == pytest.approx(-3e4 * (2.0 - 0.53) / 1e6, rel=1e-5)
        assert wf.quantities.final_von_mises("column", at)(motion) == pytest.approx(3e4, rel=1e-5)
        assert wf.quantities.peak_von_mises("column", at)(motion) == pytest.approx(3e4, rel=1e-5)
    assert motion.displacement("column", [at, at]).shape == (2, 2, 2)
    with pytest.raises(SceneError, match="did you mean 'column'"):
        motion.displacement("colum", at)
    with pytest.raises(MeshError, match="body 'column': the place"):
        motion.displacement("column", (9.0, 9.0))


class Swing:
    """A motion of one place."""

    def __init__(self, period: float, frames: int) -> None:
        self.times = np.arange(frames) / 30.0
        self._u = 0.2 + np.cos(2.0 * np.pi * (self.times - 0.01) / period)

    def displacement(self, body: str, at: object) -> np.ndarray:
        return np.stack([np.zeros_like(self._u), self._u], axis=1)


def test_period_and_extreme_of_a_swing_between_frames():
    swing = Swing(period=0.73, frames=90)
    assert wf.quantities.period("bar", (0, 0), axis=1)(swing) == pytest.approx(0.73, rel=1e-3)
    assert wf.quantities.largest_displacement("bar", (0, 0), axis=1)(swing) == pytest.approx(1.2, rel=1e-4)
    with pytest.raises(SimulationError, match="simulate more frames"):
        wf.quantities.period("bar", (0, 0), axis=1)(Swing(period=7.3, frames=90))


@pytest.mark.parametrize("wrong", [{"sag": 3.0}, {"": len}, [len]])
def test_quantities_of_a_scene_are_named_functions(wrong):
    body = wf.Body("a", wf.Mesh.rectangle((1, 1), (1, 1)), wf.LinearElasticity(E=1.0, nu=0.0))
    with pytest.raises(SceneError, match="quantities must"):
        wf.Scene([body], wf.BackwardEuler(), quantities=wrong)


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("element", ["linear", "quadratic"])
def test_a_refined_body_is_the_same_solid(dim, element):
    """Mass, load, supports and start are those of the body, and the parts of a cell have its material."""
    mesh = wf.Mesh.rectangle((2, 1), (2, 1)) if dim == 2 else wf.Mesh.box((2, 1, 1), (2, 1, 1))
    mesh = mesh.with_cell_set("first", [0])
    per_cell = np.linspace(1.0, 2.0, mesh.cell_count)
    body = wf.Body(
        "a",
        mesh,
        wf.NeoHookean(E=1e5 * per_cell, nu=0.3),
        density=1000.0 * per_cell,
        supports=[wf.Pin("left"), wf.Pin(mesh.select_points("left"), axes=(0,))],
        loads=[wf.PointForce("right", (1.0,) * dim), wf.Traction("right", (2.0,) * dim)],
        element=element,
        velocity=lambda x: x,
    )
    body = wf.Body(**{**vars(body), "displacement": 0.01 * body.mesh.points})
    fine = body.refined()
    parts = 4 if dim == 2 else 8
    assert fine.mesh.cell_count == parts * mesh.cell_count
    assert fine.mesh.order == body.mesh.order
    np.testing.assert_allclose(
        fine.mesh.cell_volumes.reshape(-1, parts).sum(axis=1), body.mesh.cell_volumes, rtol=1e-12
    )
    np.testing.assert_array_equal(fine.mesh.select_cells("first"), np.arange(parts))
    np.testing.assert_allclose(fine.material.E, np.repeat(1e5 * per_cell, parts))
    np.testing.assert_allclose(fine.initial_displacement(), 0.01 * fine.mesh.points, atol=1e-15)
    models = [wf.Model(wf.Scene([own], wf.BackwardEuler()), device="cpu", dtype="float64") for own in (body, fine)]
    assert models[1].lumped_mass.sum() == pytest.approx(models[0].lumped_mass.sum())
    loads = [model.dead_load.numpy().sum(axis=0) for model in models]
    np.testing.assert_allclose(loads[1], loads[0])
    held = [fine.mesh.points[fine.mesh.select_points(pin.points)][:, 0] for pin in fine.supports]
    assert (held[0] == 0.0).all()
    assert (held[1] == 0.0).all()
    assert len(held[0]) == len(held[1])


def test_places_are_found_among_cells_of_very_different_sizes_and_far_apart():
    small = wf.Mesh.box((1e-3, 1e-3, 1e-3), (1, 1, 1))
    large = wf.Mesh.box((1e4, 1e4, 1e4), (1, 1, 1), (1e9, 1e9, 1e9))
    mesh = wf.Mesh(np.concatenate([small.points, large.points]), np.concatenate([small.cells, large.cells + 8]))
    places = mesh.points[mesh.cells].mean(axis=1)
    np.testing.assert_array_equal(locate(mesh, places).cells, mesh.cells)
