"""Tetrahedra inside surfaces: what is made, kept and said."""

import io
import os
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

import warpfem as wf
from warpfem.errors import MeshError, MissingExtraError
from warpfem.mesh import Mesh
from warpfem.meshing import cache, filling, load_mesh, read_surface, tetrahedralize, waiting

RECTANGLE = Mesh.rectangle((2.0, 1.0), (3, 2))


def cube_surface():
    """Points and triangles of the unit cube, outwards."""
    box = Mesh.box((1.0, 1.0, 1.0), (1, 1, 1))
    return box.points, box.boundary_faces


CUBE = cube_surface()
SHEET = np.column_stack([RECTANGLE.points, np.zeros(RECTANGLE.point_count)]), RECTANGLE.cells


@pytest.mark.parametrize(
    ("surface", "message"),
    [
        ((CUBE[0][:, :2], CUBE[1]), r"points of a surface must be an array \(k, 3\)"),
        ((CUBE[0], CUBE[1][:, :2]), r"triangles of a surface must be an array \(k, 3\)"),
        ((CUBE[0], CUBE[1][:0]), r"triangles of a surface must be an array \(k, 3\), k > 0"),
        ((CUBE[0], CUBE[1] + 0.0), "triangles must be .* not of type float64"),
        (
            (CUBE[0], CUBE[1] + 3),
            r"triangle 0 refers to a point outside 0\.\.7 \(10 of 12 triangles in all\)",
        ),
        ((CUBE[0], CUBE[1] - 1), r"triangle 1 refers to a point outside 0\.\.7 \(6 of 12"),
        ((np.where(CUBE[0] > 0.5, np.nan, CUBE[0]), CUBE[1]), r"point 1 is not finite \(7 of 8 points"),
        (SHEET, "the surface is flat"),
        ((np.zeros((3, 3)), [[0, 1, 2]]), "the surface is flat"),
        ((np.outer([0, 1, 2], [1, 1, 1]), [[0, 1, 2]]), "the surface is flat"),
        ((CUBE[0], np.repeat(CUBE[1][:, :1], 3, axis=1)), "the surface is flat"),
    ],
)
def test_surfaces_that_could_crash_the_mesher_are_refused_before(surface, message):
    with pytest.raises(MeshError, match=message):
        tetrahedralize(*surface)


@pytest.mark.parametrize("edge_length", [0.0, -1.0, 1.8, np.nan, np.inf])
def test_edge_length_has_a_domain(edge_length):
    with pytest.raises(MeshError, match=r"edge_length must be above 0 and at most .* 1.73205 m"):
        tetrahedralize(*CUBE, edge_length=edge_length)


@pytest.mark.parametrize("envelope", [0.0, -1.0, 0.6, np.nan, "fine"])
def test_envelope_has_a_domain(envelope):
    with pytest.raises(MeshError, match=r"envelope must be above 0 and at most the edge length, 0.5 m"):
        tetrahedralize(*CUBE, edge_length=0.5, envelope=envelope)


def pytetwild():
    pytest.importorskip("pytetwild", exc_type=ImportError)


def test_a_cube_is_filled(tmp_path, monkeypatch, capfd):
    pytetwild()
    monkeypatch.chdir(tmp_path)
    points, triangles = CUBE
    unused = np.append(points, [[50.0, 0.0, 0.0]], axis=0)
    mesh = tetrahedralize(1e-3 * unused + 7.0, triangles[:, ::-1], edge_length=0.3e-3)
    assert mesh.cell_volumes.sum() == pytest.approx(1e-9, rel=2e-2)
    np.testing.assert_allclose(mesh.bounding_box, [[7.0] * 3, [7.001] * 3], atol=0.03e-3)
    assert 0.15e-3 < mesh.mean_edge_length < 0.45e-3
    assert mesh.quality.min() > 0.1
    assert mesh.boundary_face_areas.sum() == pytest.approx(6e-6, rel=2e-2)
    assert Path.cwd() == tmp_path
    assert not list(tmp_path.iterdir())
    assert capfd.readouterr() == ("", "")


def test_triangles_that_share_no_points_still_close():
    pytetwild()
    points, triangles = CUBE
    mesh = tetrahedralize(points[triangles].reshape(-1, 3), np.arange(36).reshape(-1, 3), edge_length=0.4)
    assert mesh.cell_volumes.sum() == pytest.approx(1.0, rel=2e-2)


def test_an_open_surface_is_refused():
    pytetwild()
    points, triangles = CUBE
    side = (points[triangles][:, :, 0] == 1.0).all(axis=1)
    with pytest.raises(MeshError, match="the surface is open"):
        tetrahedralize(points, triangles[~side], edge_length=0.4)


def test_what_vanishes_is_told_of():
    """A cube, and a stick beside it that is thinner than the envelope."""
    pytetwild()
    points, triangles = CUBE
    stick = points * (0.02, 3.0, 0.02) + (1.5, 0.0, 0.0)
    both = np.concatenate([points, stick]), np.concatenate([triangles, triangles + len(points)])
    with pytest.warns(UserWarning, match=r"% of the surface is not near the mesh: .* envelope, 0.04 m, vanish"):
        mesh = tetrahedralize(*both, edge_length=0.4, envelope=0.04)
    assert mesh.bounding_box[1, 0] < 1.4


def test_thin_parts_stay_without_an_envelope(recwarn):
    """The envelope that is taken then knows that the body is thin."""
    pytetwild()
    points, triangles = CUBE
    mesh = tetrahedralize(points * (0.04, 4.0, 0.04), triangles, edge_length=1.0)
    assert mesh.cell_volumes.sum() == pytest.approx(0.0064, rel=0.2)
    assert not recwarn.list


# ---- what is made once


PROBLEM = {"points": np.eye(3), "triangles": np.arange(3, dtype=np.int32)}
MADE = np.eye(3), np.arange(4, dtype=np.int32)[None]


def same(first, second):
    return all(np.array_equal(a, b) and a.dtype == b.dtype for a, b in zip(first, second, strict=True))


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setenv("WARPFEM_CACHE_DIR", str(tmp_path / "cache"))
    return tmp_path / "cache" / "meshes"


def test_a_surface_is_filled_once(folder, monkeypatch):
    pytetwild()
    first = tetrahedralize(*CUBE, edge_length=0.4)
    calls = []
    call_in_child = filling.call_in_child
    monkeypatch.setattr(filling, "call_in_child", lambda *a: calls.append(a) or call_in_child(*a))
    again = tetrahedralize(*CUBE, edge_length=0.4)
    assert not calls and same((first.points, first.cells), (again.points, again.cells))
    tetrahedralize(*CUBE, edge_length=0.4, envelope=0.05)
    assert len(calls) == 1


def test_keys_are_of_the_contents():
    key = cache.key("maker 1", PROBLEM)
    assert key == cache.key("maker 1", {name: PROBLEM[name].copy() for name in reversed(PROBLEM)})
    others = [{**PROBLEM, "points": np.nextafter(np.eye(3), 2.0)}, {**PROBLEM, "triangles": np.arange(3)}]
    assert len({key, cache.key("maker 2", PROBLEM), *(cache.key("maker 1", other) for other in others)}) == 4


def test_the_first_of_two_makers_is_right(folder):
    """Both go on with the mesh that is kept."""
    other = 2.0 * MADE[0], MADE[1]
    assert cache.recall("a") is None
    assert same(cache.keep("a", *MADE), MADE)
    assert same(cache.keep("a", *other), MADE)
    assert same(cache.recall("a"), MADE)
    assert [path.name for path in folder.iterdir()] == ["a.npz"]


def test_many_makers_at_once_agree(folder):
    def keep_all(maker: int) -> list[float]:
        return [cache.keep(f"{name}", np.full((500, 3), float(maker)), MADE[1])[0][0, 0] for name in range(30)]

    with ThreadPoolExecutor(8) as makers:
        first, *others = makers.map(keep_all, range(8))
    assert all(other == first for other in others)
    assert len(list(folder.iterdir())) == 30


@pytest.mark.parametrize(
    "damage", [lambda whole: b"", lambda whole: whole[:-30], lambda whole: whole[:150] + b"x" + whole[151:]]
)
def test_damaged_meshes_are_made_again(folder, damage):
    cache.keep("a", *MADE)
    path = folder / "a.npz"
    path.write_bytes(damage(path.read_bytes()))
    assert cache.recall("a") is None
    other = 2.0 * MADE[0], MADE[1]
    assert same(cache.keep("a", *other), other)
    assert same(cache.recall("a"), other)


def test_a_disk_that_refuses_is_warned_of(folder):
    folder.parent.write_text("a file where the folder should be")
    with pytest.warns(UserWarning, match=r"could not be kept for the next time: .*WARPFEM_CACHE_DIR"):
        assert same(cache.keep("a", *MADE), MADE)


def test_where_meshes_are_kept(monkeypatch, tmp_path):
    monkeypatch.setenv("WARPFEM_CACHE_DIR", "")
    assert cache.folder() is None and cache.recall("a") is None and same(cache.keep("a", *MADE), MADE)
    monkeypatch.delenv("WARPFEM_CACHE_DIR")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert cache.folder() == tmp_path / "warpfem" / "meshes"
    monkeypatch.setenv("XDG_CACHE_HOME", "relative")  # to be ignored, by its specification
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    assert cache.folder() == tmp_path / "home" / ".cache" / "warpfem" / "meshes"


# ---- what is said meanwhile


def test_a_terminal_is_told_how_long_it_takes(monkeypatch):
    said = io.StringIO()
    said.isatty = lambda: True
    monkeypatch.setattr(sys, "stderr", said)
    monkeypatch.setattr(waiting, "PATIENCE", 0.01)
    with waiting.telling_time("filling"):
        time.sleep(0.1)
    assert "\rfilling: 0 s\r" in said.getvalue()
    assert said.getvalue().endswith("\r" + " " * len("filling: 0 s") + "\r")
    monkeypatch.setattr(sys, "stderr", silent := io.StringIO())
    with waiting.telling_time("filling"):  # no terminal
        time.sleep(0.05)
    silent.isatty = lambda: True
    with waiting.telling_time("filling", wanted=False):
        time.sleep(0.05)
    assert not silent.getvalue()


# ---- what goes wrong


def crash(path: str) -> None:
    os.abort()


def test_a_crash_of_the_mesher_is_an_error(folder, monkeypatch):
    pytetwild()
    monkeypatch.setattr(filling, "fill", crash)
    with pytest.raises(
        MeshError, match=r"fTetWild could not fill the surface \(its process crashed with SIGABRT\): try"
    ):
        tetrahedralize(*CUBE)


def test_a_missing_mesher_names_its_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "pytetwild", None)
    with pytest.raises(MissingExtraError, match=r"'pytetwild': pip install 'warpfem\[tet\]'"):
        tetrahedralize(*CUBE)


def test_a_mesher_that_lacks_one_of_its_own_names_that(tmp_path, folder, monkeypatch):
    """As pytetwild 0.3 and 0.4 do, which need pyvista without saying so."""
    (tmp_path / "pytetwild.py").write_text("import lacking")
    (tmp_path / "pytetwild-0.4.dist-info").mkdir()
    (tmp_path / "pytetwild-0.4.dist-info" / "METADATA").write_text("Name: pytetwild\nVersion: 0.4\n")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "pytetwild", raising=False)
    with pytest.raises(MissingExtraError, match=r"'lacking': pip install 'warpfem\[tet\]'"):
        tetrahedralize(*CUBE)


# ---- the surfaces that come with Warp


def asset(name):
    return Path(pytest.importorskip("warp.examples").get_asset_directory()) / f"{name}.usd"


def test_the_bear_of_the_warp_package():
    """Default settings give a mesh of a few thousand cells that fits the surface."""
    pytetwild()
    points, triangles = read_surface(asset("bear"))
    mesh = load_mesh(asset("bear"))
    inside = np.linalg.det(points[triangles]).sum() / 6.0  # divergence theorem
    assert mesh.cell_volumes.sum() == pytest.approx(abs(inside), rel=1e-2)
    assert 2_000 < mesh.cell_count < 10_000
    assert mesh.quality.min() > 0.05


def test_a_cloth_is_refused():
    with pytest.raises(MeshError, match=r"square_cloth\.usd: the surface is flat and encloses no volume"):
        load_mesh(asset("square_cloth"))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "volume"), [("sphere", 3.93), ("bear", 98.4), ("bunny", 0.876), ("rocks", 4034.0), ("nonuniform", 3.30)]
)
def test_surfaces_of_the_warp_package_fall(name, volume):
    """Coarse meshes of them: rocks has edges with three triangles, nonuniform thin rods far from a fine ball."""
    pytetwild()
    points, _ = read_surface(asset(name))
    mesh = load_mesh(asset(name), edge_length=np.linalg.norm(np.ptp(points, axis=0)) / 5.0)
    assert mesh.cell_volumes.sum() == pytest.approx(volume, rel=0.08)
    size, low = np.ptp(mesh.points[:, 1]), mesh.points[:, 1].min() - 0.1
    floor = wf.Plane((0.0, low, 0.0), (0.0, 1.0, 0.0), friction=0.5)
    body = wf.Body(name, mesh, wf.StableNeoHookean(E=1e5 * size, nu=0.4), density=1000.0)
    scene = wf.Scene([body], wf.BackwardEuler(), dt=1 / 48, gravity=(0.0, -9.81, 0.0), obstacles=[floor], frames=6)
    simulation = wf.Simulation(scene, dtype="float64")
    frames = list(simulation.frames())
    assert simulation.summary.unconverged_steps == 0
    lowest = (mesh.points + frames[-1].displacement)[:, 1].min()
    assert frames[-1].displacement[:, 1].mean() < -0.1
    assert low - 0.1 * size < lowest < low + 0.05
