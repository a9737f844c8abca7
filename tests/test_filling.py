"""Tetrahedra inside surfaces: what is made, kept and said."""

import os
import sys
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


def test_the_bear_of_the_warp_package():
    """The demo: default settings give a mesh of a few thousand cells that fits the surface."""
    pytetwild()
    assets = pytest.importorskip("warp.examples").get_asset_directory()
    points, triangles = read_surface(Path(assets) / "bear.usd")
    mesh = tetrahedralize(points, triangles)
    corners = points[triangles]
    inside = np.linalg.det(corners).sum() / 6.0  # divergence theorem
    assert mesh.cell_volumes.sum() == pytest.approx(abs(inside), rel=1e-2)
    assert 2_000 < mesh.cell_count < 10_000
    assert mesh.quality.min() > 0.05
