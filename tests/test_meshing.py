"""Meshes from files and from closed surfaces."""

import sys
from pathlib import Path

import numpy as np
import pytest

from warpfem.errors import MeshError, MissingExtraError
from warpfem.mesh import Mesh
from warpfem.meshing import read_mesh, read_solid_file, read_surface, tetrahedralize

BOX = Mesh.box((1.0, 2.0, 1.0), (2, 3, 2))
RECTANGLE = Mesh.rectangle((2.0, 1.0), (3, 2))

# Gmsh 2.2 and 4.1 in ASCII, by the format's description: two tetrahedra on a triangle, the second of them
# inverted, and a point (number 6) that no cell uses. Physical groups: a face and an edge with a name, one
# volume with and one without, a point without; in 2.2 an edge in no group, in 4.1 a volume with its boundary.
GMSH_22 = """\
$MeshFormat
2.2 0 8
$EndMeshFormat
$PhysicalNames
3
1 3 "ridge"
2 7 "base side"
3 1 "lower"
$EndPhysicalNames
$Nodes
6
1 0 0 0
2 1 0 0
3 0 1 0
4 0 0 1
5 1 1 1
6 9 9 9
$EndNodes
$Elements
6
1 15 2 4 1 5
2 1 2 3 1 1 2
3 2 2 7 1 1 2 3
4 4 2 1 1 1 2 3 4
5 4 2 9 2 2 3 5 4
6 1 2 0 2 2 3
$EndElements
"""
GMSH_41 = """\
$MeshFormat
4.1 0 8
$EndMeshFormat
$PhysicalNames
3
1 3 "ridge"
2 7 "base side"
3 1 "lower"
$EndPhysicalNames
$Entities
1 1 1 2
5 1 1 1 1 4
1 0 0 0 1 0 0 1 3 0
1 0 0 0 1 1 0 1 7 0
1 0 0 0 1 1 1 1 1 1 1
2 0 0 0 1 1 1 1 9 0
$EndEntities
$Nodes
1 6 1 6
3 1 0 6
1
2
3
4
5
6
0 0 0
1 0 0
0 1 0
0 0 1
1 1 1
9 9 9
$EndNodes
$Elements
5 5 1 5
0 5 15 1
1 5
1 1 1 1
2 1 2
2 1 2 1
3 1 2 3
3 1 4 1
4 1 2 3 4
3 2 4 1
5 2 3 5 4
$EndElements
"""


def write(path, points, cells, **arguments):
    meshio = pytest.importorskip("meshio")
    meshio.write_points_cells(path, np.asarray(points, dtype=float), cells, **arguments)
    return path


def write_mesh(path, mesh, **arguments):
    points = np.pad(mesh.points, ((0, 0), (0, 3 - mesh.dim)))
    return write(path, points, [("tetra" if mesh.dim == 3 else "triangle", mesh.cells)], **arguments)


def cube_surface():
    """Points and triangles of the unit cube, outwards."""
    box = Mesh.box((1.0, 1.0, 1.0), (1, 1, 1))
    return box.points, box.boundary_faces


# ---- mesh files


@pytest.mark.parametrize("mesh", [BOX, RECTANGLE], ids=["3D", "2D"])
@pytest.mark.parametrize(
    ("name", "arguments"),
    [
        ("mesh.msh", {"file_format": "gmsh22", "binary": True}),
        ("mesh.msh", {"file_format": "gmsh", "binary": True}),
        ("mesh.vtu", {}),
        ("MESH.VTU", {"binary": False}),
        ("mesh.vtk", {}),
        ("mesh.mesh", {}),
        ("mesh.inp", {}),
    ],
)
def test_reads_back_what_was_written(tmp_path, mesh, name, arguments):
    read = read_mesh(str(write_mesh(tmp_path / name, mesh, **arguments)))
    assert read.dim == mesh.dim
    np.testing.assert_allclose(read.points, mesh.points, rtol=1e-11)  # some formats write 12 digits
    np.testing.assert_array_equal(read.cells, mesh.cells)


@pytest.mark.parametrize("text", [GMSH_22, GMSH_41], ids=["2.2", "4.1"])
def test_physical_groups_become_sets(tmp_path, text):
    pytest.importorskip("meshio")
    path = tmp_path / "groups.msh"
    path.write_text(text)
    mesh = read_mesh(path)
    assert mesh.point_count == 5
    np.testing.assert_array_equal(mesh.cells, [[0, 1, 2, 3], [1, 2, 3, 4]])
    assert {name: s.tolist() for name, s in mesh.cell_sets.items()} == {"lower": [0], "volume_9": [1]}
    assert {name: s.tolist() for name, s in mesh.point_sets.items()} == {
        "ridge": [0, 1],
        "base side": [0, 1, 2],
        "point_4": [4],
    }


def test_sets_of_several_blocks_are_joined(tmp_path):
    pytest.importorskip("meshio")
    path = tmp_path / "sets.inp"
    path.write_text(
        "*NODE\n1, 0, 0, 0\n2, 1, 0, 0\n3, 1, 1, 0\n4, 0, 1, 0\n5, 2, 0, 0\n6, 2, 1, 0\n"
        "*ELEMENT, TYPE=CPS3, ELSET=first\n1, 1, 2, 3\n2, 1, 3, 4\n"
        "*ELEMENT, TYPE=CPS3, ELSET=second\n3, 2, 5, 3\n4, 5, 6, 3\n"
        "*NSET, NSET=end\n5, 6\n"
    )
    mesh = read_mesh(path)
    assert (mesh.dim, mesh.cell_count) == (2, 4)
    assert {name: s.tolist() for name, s in mesh.cell_sets.items()} == {"first": [0, 1], "second": [2, 3]}
    assert mesh.select_points("end").tolist() == [4, 5]


def test_a_plane_of_constant_z_is_2d(tmp_path):
    points = np.column_stack([RECTANGLE.points, np.full(RECTANGLE.point_count, 3.0)])
    points = np.append(points, [[0.0, 0.0, 9.0]], axis=0)  # used by no cell
    mesh = read_mesh(write(tmp_path / "plane.vtu", points, [("triangle", RECTANGLE.cells[:, ::-1])]))
    np.testing.assert_array_equal(mesh.points, RECTANGLE.points)
    assert mesh.cell_volumes.sum() == pytest.approx(2.0)


@pytest.mark.parametrize(
    ("cells", "message"),
    [
        ([("triangle", [[0, 1, 2], [0, 1, 3]])], r"constant z: they are a surface; .*tetrahedralize"),
        ([("tetra", [[0, 1, 2, 3]]), ("tetra10", [range(10)])], "mixes cells of types tetra and tetra10"),
        (
            [("tetra", [[0, 1, 2, 3]]), ("hexahedron", [range(8)])],
            "1 cells of type 'hexahedron': only triangles",
        ),
        ([("quad", [[0, 1, 2, 4]])], "1 cells of type 'quad': only triangles"),
        ([("line", [[0, 1]])], "no triangles or tetrahedra"),
        ([("tetra", [[0, 1, 2, 3]] * 2)], "cell 1 has the same points as cell 0"),
        ([("tetra", [[0, 1, 2, 77]])], "cell 0 refers to a point outside"),
    ],
)
def test_files_with_other_contents_are_refused_by_name(tmp_path, cells, message):
    points = np.random.default_rng(3).random((10, 3))
    path = write(tmp_path / "other.vtu", points, [(kind, np.array(rows)) for kind, rows in cells])
    with pytest.raises(MeshError, match=message) as caught:
        read_mesh(path)
    assert str(caught.value).startswith(f"{path}: ")


@pytest.mark.parametrize("read", [read_mesh, read_surface])
def test_a_path_that_is_no_file(tmp_path, read):
    with pytest.raises(MeshError, match=r"absent\.msh: no such file"):
        read(tmp_path / "absent.msh")
    with pytest.raises(MeshError, match=r"absent\.usda: no such file"):
        read(tmp_path / "absent.usda")
    with pytest.raises(MeshError, match="is a directory, not a file"):
        read(tmp_path)


@pytest.mark.parametrize("read", [read_mesh, read_surface])
@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("a.xyz", b"hello"),
        ("noextension", b""),
        ("a.msh", b""),
        ("a.msh", b"$MeshFormat\n9.9 0 8\n$EndMeshFormat\n"),
        ("a.msh", b"\xff\xfe\x00\n$EndNodes\n"),
        ("a.vtu", b"<VTKFile>"),
        ("a.vtk", b"\0" * 100),
        ("a.ply", b"ply\nformat ascii 1.0\n"),  # without end_header, meshio reads on for ever
        ("a.off", b"OFF\n# "),  # so it does here
        ("a.mdpa", b"Begin Nodes\n1 0 0 0\n"),  # and here
        ("a.stl", b"solid"),
        ("a.obj", b"v 0 0\nf 1 2 3\n"),
    ],
)
def test_garbage_is_a_mesh_error_and_prints_nothing(tmp_path, capfd, read, name, content):
    pytest.importorskip("meshio")
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(MeshError, match=name):
        read(path)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize(
    ("name", "arguments"),
    [
        ("mesh.msh", {"file_format": "gmsh22", "binary": True}),
        ("mesh.msh", {"file_format": "gmsh", "binary": True}),
        ("mesh.vtu", {}),
        ("ascii22.msh", None),
        ("ascii41.msh", None),
    ],
)
@pytest.mark.filterwarnings("ignore:.*not closed by:UserWarning")
def test_a_truncated_file_is_never_read_as_a_mesh(tmp_path, capfd, name, arguments):
    pytest.importorskip("meshio")
    path = tmp_path / name
    if arguments is None:
        path.write_text(GMSH_22 if "22" in name else GMSH_41)
    else:
        write_mesh(path, BOX, **arguments)
    capfd.readouterr()
    content = path.read_bytes()
    last = content.rfind(b"$End") + 4 if path.suffix == ".msh" else content.rfind(b"</VTKFile>")
    for length in {*np.linspace(0, last, 60, dtype=int), *range(last - 25, last + 1)}:
        path.write_bytes(content[:length])
        with pytest.raises(MeshError):
            Mesh.repaired(*read_solid_file(str(path)))  # as read_mesh does, without a process for each
    with pytest.raises(MeshError, match=path.name):
        read_mesh(path)
    assert capfd.readouterr() == ("", "")


def test_what_meshio_prints_becomes_a_warning(tmp_path, capfd):
    path = write_mesh(tmp_path / "mesh.meshb", BOX)
    path.write_bytes(path.read_bytes()[:-12])  # without its end mark, which meshio only remarks on
    with pytest.warns(UserWarning, match=r"mesh.meshb: meshio says: .*GmfEnd"):
        read_mesh(path)
    assert capfd.readouterr() == ("", "")


# ---- surface files


@pytest.mark.parametrize("name", ["cube.obj", "cube.ply", "cube.stl", "cube.off", "cube.vtu"])
def test_surfaces_read_back(tmp_path, name):
    points, triangles = cube_surface()
    arguments = {"binary": True} if name.endswith("stl") else {}
    path = write(tmp_path / name, points, [("triangle", triangles)], **arguments)
    read_points, read_triangles = read_surface(path)
    assert (read_points.dtype, read_triangles.dtype) == (np.float64, np.int32)
    np.testing.assert_allclose(read_points[read_triangles], points[triangles])


def test_polygons_are_cut_into_fans(tmp_path):
    pytest.importorskip("meshio")
    path = tmp_path / "house.obj"
    path.write_text("v 0 0 0\nv 1 0 0\nv 1 1 0\nv .5 2 0\nv 0 1 0\nf 1 2 3 4 5\nf 1 2 3 5\nf 3 4 5\n")
    _, triangles = read_surface(path)
    expected = [[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 1, 2], [0, 2, 4], [2, 3, 4]]
    np.testing.assert_array_equal(triangles, expected)


def test_a_file_without_faces_is_no_surface(tmp_path):
    path = write_mesh(tmp_path / "solid.vtu", BOX)
    with pytest.raises(MeshError, match=r"solid.vtu: the file holds no triangles"):
        read_surface(path)


# ---- tetrahedra inside a surface

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


# ---- optional packages


@pytest.mark.parametrize(
    ("package", "extra", "use"),
    [
        ("meshio", "mesh", lambda path: read_mesh(path)),
        ("pytetwild", "tet", lambda path: tetrahedralize(*CUBE)),
    ],
)
def test_a_missing_package_names_its_extra(tmp_path, monkeypatch, package, extra, use):
    path = tmp_path / "a.vtu"
    path.touch()
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(MissingExtraError, match=rf"'{package}': pip install 'warpfem\[{extra}\]'"):
        use(path)


def test_a_package_that_lacks_one_of_its_own_names_that(tmp_path, monkeypatch):
    """As pytetwild 0.3 and 0.4 do, which need pyvista without saying so."""
    (tmp_path / "pytetwild.py").write_text("import lacking")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "pytetwild", raising=False)
    with pytest.raises(MissingExtraError, match=r"'lacking': pip install 'warpfem\[tet\]'"):
        tetrahedralize(*CUBE)


# ---- what is in a file decides nothing about this process


def test_a_count_that_lies_takes_no_memory(tmp_path):
    pytest.importorskip("meshio")
    path = tmp_path / "lie.msh"
    path.write_text(GMSH_22.replace("$Nodes\n6\n", "$Nodes\n999999999999\n"))
    with pytest.raises(MeshError, match=r"lie\.msh: .*damaged"):
        read_mesh(path)


@pytest.mark.parametrize("read", [read_mesh, read_surface])
@pytest.mark.parametrize("path", [None, 0, 1.5, b"a.msh", ["a.msh"], "", "a" * 5000 + ".msh", "a\0.msh"], ids=repr)
def test_odd_names_are_refused(read, path):
    with pytest.raises(MeshError, match=r"no such file|the name of a file must be"):
        read(path)
