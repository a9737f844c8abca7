"""Every shipped scene runs, and shows the number that its header states."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import warpfem as wf
from warpfem.scene_file import load_scene

SCENES = Path(__file__).parent.parent / "scenes"


def run(name: str, **settings) -> tuple[wf.Simulation, list[wf.Frame]]:
    scene = load_scene(SCENES / f"{name}.py", {key: str(value) for key, value in settings.items()})
    simulation = wf.Simulation(scene, device="cpu")
    frames = list(simulation.frames())
    assert simulation.summary.unconverged_steps == 0
    return simulation, frames


def displacement(simulation: wf.Simulation, frame: wf.Frame, body: int, points: str) -> np.ndarray:
    own, _ = simulation.model.body_slices[body]
    return frame.displacement[own][simulation.scene.bodies[body].mesh.select_points(points)]


@pytest.mark.parametrize("path", sorted(SCENES.glob("*.py")), ids=lambda path: path.stem)
def test_every_scene_has_a_header_and_a_test(path):
    text = path.read_text()
    assert text.startswith('"""')
    for word in ("Physics:", "Units:", "Tested:"):
        assert word in text.split('"""')[1]
    assert f"def test_{path.stem}" in Path(__file__).read_text()


def test_jelly_drop():
    simulation, frames = run("jelly_drop", cells=4, damping=6.0)
    mesh = simulation.model.scene.bodies[0].mesh
    bottom = mesh.boundary_face_normals[:, 1] < -0.999
    x = mesh.points + frames[-1].displacement
    depth = np.maximum(-x[mesh.boundary_faces[bottom], 1], 0.0)
    weighted_depth = (mesh.boundary_face_shares[bottom] * depth).sum()  # the bottom has an area of 1 m^2
    stiffness = simulation.model.contact.surface.stiffness[0]
    assert stiffness == pytest.approx(
        simulation.scene.bodies[0].material.moduli.p_wave / simulation.scene.bodies[0].mesh.mean_edge_length
    )
    assert weighted_depth == pytest.approx(1000 * 9.81 / stiffness, rel=0.02)
    assert min(frame.displacement[:, 1].min() for frame in frames) < -0.3  # it fell and was squashed


def test_fem99():
    _, frames = run("fem99", damping=0.0)
    total = np.array([frame.energies.total for frame in frames])
    fastest = max(frame.energies.kinetic for frame in frames)
    assert np.abs(total - total[0]).max() < 0.005 * fastest
    assert max(frame.penetration for frame in frames) < 0.25 / 12  # a cell


def test_cantilever():
    E, nu, rho, g, L, h = 2e7, 0.3, 1000.0, 9.81, 4.0, 1.0
    G = E / (2 * (1 + nu))
    sag = rho * g * L**4 * 12 / (8 * E * h**2) + rho * g * L**2 / (2 * (5 / 6) * G)
    ratios = []
    for cells in (2, 4):
        simulation, frames = run("cantilever", cells=cells, E=E, nu=nu)
        ratios.append(-displacement(simulation, frames[-1], 0, "right")[:, 1].mean() / sag)
    assert ratios[0] < ratios[1]
    assert 0.8 < ratios[1] < 1.0
    simulation, frames = run("cantilever", cells=2, E=E, nu=nu, element="quadratic")
    assert -displacement(simulation, frames[-1], 0, "right")[:, 1].mean() == pytest.approx(sag, rel=0.04)


def test_twist():
    simulation, frames = run("twist", cells=2, dt=1 / 24)  # coming to rest, where no force is more than noise
    assert simulation.summary.unconverged_steps == 0
    simulation, frames = run("twist", cells=2)
    mesh = simulation.scene.bodies[0].mesh
    x = mesh.points + frames[-1].displacement
    complex_rest = mesh.points[:, 2] + 1j * mesh.points[:, 0]  # turning about y
    complex_now = x[:, 2] + 1j * x[:, 0]
    middle = np.isclose(mesh.points[:, 1], 2.0)
    angle = np.angle((complex_now[middle] * complex_rest[middle].conj()).sum())
    assert math.degrees(angle) == pytest.approx(90.0, rel=0.02)
    top = mesh.select_points("top")
    np.testing.assert_allclose(complex_now[top], -complex_rest[top], atol=1e-6)


def test_stretch():
    strain = 0.005
    simulation, frames = run("stretch", strain=strain)
    length = np.array(
        [
            displacement(simulation, f, 0, "right")[:, 0].mean() - displacement(simulation, f, 0, "left")[:, 0].mean()
            for f in frames
        ]
    )
    assert length[0] == pytest.approx(4 * strain)
    first = int(np.argmax(length < 0.0))
    time = np.interp(0.0, [length[first], length[first - 1]], [frames[first].time, frames[first - 1].time])
    speed = math.sqrt(1e6 / 1000)
    assert time == pytest.approx(4.0 / (2 * speed), rel=0.02)
    total = np.array([frame.energies.total for frame in frames])
    np.testing.assert_allclose(total, total[0], rtol=1e-3)


def test_two_materials():
    simulation, frames = run("two_materials")
    for body in range(2):
        growth = -displacement(simulation, frames[-1], body, "bottom")[:, 1].mean()
        E = simulation.scene.bodies[body].material.E
        assert growth == pytest.approx(1000 * 9.81 * 2.0**2 / (2 * E), rel=0.02)


def test_custom_material():
    pull, K, mu = 1e3, 2e6, 2 * (1e5 + 5e4)
    simulation, frames = run("custom_material", pull=pull)
    E = 9 * K * mu / (3 * K + mu)
    assert displacement(simulation, frames[-1], 0, "top")[:, 1].mean() == pytest.approx(pull / E, rel=0.01)


def test_bear(capsys, monkeypatch):
    """With a box in the bear's place, as it runs without pytetwild."""
    monkeypatch.setitem(__import__("sys").modules, "pytetwild", None)
    scene = load_scene(SCENES / "bear.py", {"edge_length": "0.25"})
    assert "a box takes the bear's place" in capsys.readouterr().err
    _check_bear(scene)


@pytest.mark.slow
def test_bear_itself():
    pytest.importorskip("pytetwild")
    scene = load_scene(SCENES / "bear.py")
    assert scene.bodies[0].mesh.boundary_faces.shape[0] > 500
    _check_bear(scene)


def _check_bear(scene: wf.Scene) -> None:
    simulation = wf.Simulation(replace(scene, frames=60), device="cpu")
    *_, last = simulation.frames()
    y = simulation.model.rest_points[:, 1] + last.displacement[:, 1]
    height = np.ptp(simulation.model.rest_points[:, 1])
    assert abs(y.min()) < 0.02 * height
    assert last.penetration > 0.0  # it touches the floor
    assert np.linalg.norm(last.velocity, axis=1).max() < 3.0
