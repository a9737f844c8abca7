"""Meshes and surfaces from files."""

import sys

import numpy as np
import pytest

import warpfem as wf
from warpfem.child import DAMAGED
from warpfem.errors import MeshError, MissingExtraError, WarpfemError
from warpfem.mesh import Mesh
from warpfem.meshing import load_mesh, meshio_files, read_surface

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


TWO_TETRAHEDRA = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1]]


def write(path, points, cells, **arguments):
    meshio = pytest.importorskip("meshio")
    meshio.write_points_cells(path, np.asarray(points, dtype=float), cells, **arguments)
    return path


def write_mesh(path, mesh, **arguments):
    points = np.pad(mesh.points, ((0, 0), (0, 3 - mesh.dim)))
    return write(path, points, [("tetra" if mesh.dim == 3 else "triangle", mesh.cells)], **arguments)


def load_here(path):
    """What ``load_mesh`` does of a file that meshio reads, without a child process."""
    found = meshio_files.read_solid_or_surface(str(path))
    return Mesh.repaired(found.points, found.cells, found.point_sets, found.cell_sets, found.cell_data)


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
    read = load_mesh(str(write_mesh(tmp_path / name, mesh, **arguments)))
    assert read.dim == mesh.dim
    np.testing.assert_allclose(read.points, mesh.points, rtol=1e-11)  # some formats write 12 digits
    np.testing.assert_array_equal(read.cells, mesh.cells)


@pytest.mark.parametrize("text", [GMSH_22, GMSH_41], ids=["2.2", "4.1"])
def test_physical_groups_become_sets(tmp_path, text):
    pytest.importorskip("meshio")
    path = tmp_path / "groups.msh"
    path.write_text(text)
    mesh = load_mesh(path)
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
    mesh = load_mesh(path)
    assert (mesh.dim, mesh.cell_count) == (2, 4)
    assert {name: s.tolist() for name, s in mesh.cell_sets.items()} == {"first": [0, 1], "second": [2, 3]}
    assert mesh.select_points("end").tolist() == [4, 5]


def test_a_plane_of_constant_z_is_2d(tmp_path):
    points = np.column_stack([RECTANGLE.points, np.full(RECTANGLE.point_count, 3.0)])
    points = np.append(points, [[0.0, 0.0, 9.0]], axis=0)  # used by no cell
    mesh = load_mesh(write(tmp_path / "plane.vtu", points, [("triangle", RECTANGLE.cells[:, ::-1])]))
    np.testing.assert_array_equal(mesh.points, RECTANGLE.points)
    assert mesh.cell_volumes.sum() == pytest.approx(2.0)


@pytest.mark.parametrize(
    ("cells", "message"),
    [
        ([("tetra", [[0, 1, 2, 3]]), ("tetra10", [range(10)])], "mixes cells of types tetra and tetra10"),
        (
            [("tetra", [[0, 1, 2, 3]]), ("hexahedron", [range(8)])],
            "1 cells of type 'hexahedron': only triangles",
        ),
        ([("line", [[0, 1]])], "no triangles or tetrahedra"),
        ([("tetra", [[0, 1, 2, 3]] * 2)], "cell 1 has the same points as cell 0"),
        ([("tetra", [[0, 1, 2, 77]])], "cell 0 refers to a point outside"),
    ],
)
def test_files_with_other_contents_are_refused_by_name(tmp_path, cells, message):
    points = np.random.default_rng(3).random((10, 3))
    path = write(tmp_path / "other.vtu", points, [(kind, np.array(rows)) for kind, rows in cells])
    with pytest.raises(MeshError, match=message) as caught:
        load_mesh(path)
    assert str(caught.value).startswith(f"{path}: ")


def test_quadrilaterals_in_a_plane_are_refused(tmp_path):
    square = [[0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]]
    with pytest.raises(MeshError, match="1 cells of type 'quad': only triangles"):
        load_here(write(tmp_path / "a.vtu", square, [("quad", np.array([[0, 1, 2, 3]]))]))


@pytest.mark.parametrize("read", [load_mesh, read_surface])
def test_a_path_that_is_no_file(tmp_path, read):
    with pytest.raises(MeshError, match=r"absent\.msh: no such file"):
        read(tmp_path / "absent.msh")
    with pytest.raises(MeshError, match=r"absent\.usda: no such file"):
        read(tmp_path / "absent.usda")
    with pytest.raises(MeshError, match="is a directory, not a file"):
        read(tmp_path)


@pytest.mark.parametrize("read", [load_mesh, read_surface])
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
        ("a.mdpa", b"Begin Nodes\n1 0 0 0\n"),  # and here
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
            load_here(path)
    with pytest.raises(MeshError, match=path.name):
        load_mesh(path)
    assert capfd.readouterr() == ("", "")


def test_what_meshio_prints_becomes_a_warning(tmp_path, capfd):
    path = write_mesh(tmp_path / "mesh.meshb", BOX)
    path.write_bytes(path.read_bytes()[:-12])  # without its end mark, which meshio only remarks on
    with pytest.warns(UserWarning, match=r"mesh.meshb: meshio says: .*GmfEnd"):
        load_mesh(path)
    assert capfd.readouterr() == ("", "")


# ---- cell data

CELL_DATA = {"E": [1e5, 2e5], "region": [3, 7], "density": [900.0, 1100.0], "gradient": [[1.0, 0.0, 0.0]] * 2}


@pytest.mark.parametrize("name", ["data.vtu", "data.vtk"])
def test_cell_data_become_sets_and_values_per_cell(tmp_path, name):
    cells = [("triangle", [[0, 1, 2]]), ("tetra", [[0, 1, 2, 3], [1, 2, 3, 4]])]
    data = {key: [values[:1], values] for key, values in CELL_DATA.items()}  # the face has some, too
    mesh = load_mesh(write(tmp_path / name, TWO_TETRAHEDRA, cells, cell_data=data))
    values = {key: mesh.cell_data[key].tolist() for key in mesh.cell_data}
    assert values == {key: CELL_DATA[key] for key in ("E", "region", "density")}
    assert {key: s.tolist() for key, s in mesh.cell_sets.items()} == {"region_3": [0], "region_7": [1]}
    assert {key: s.tolist() for key, s in mesh.point_sets.items()} == {"region_3": [0, 1, 2]}
    body = wf.Body("body", mesh, wf.NeoHookean(mesh.cell_data["E"], 0.3), density=mesh.cell_data["density"])
    np.testing.assert_array_equal(body.material.E, [1e5, 2e5])
    np.testing.assert_array_equal(body.density, [900.0, 1100.0])


def test_element_data_of_gmsh_are_cell_data(tmp_path):
    cells = [("tetra", [[0, 1, 2, 3], [1, 2, 3, 4]])]
    path = write(tmp_path / "a.msh", TWO_TETRAHEDRA, cells, cell_data={"E": [[1e5, 2e5]]}, file_format="gmsh22")
    assert load_here(path).cell_data["E"].tolist() == [1e5, 2e5]


def test_references_of_medit_are_groups(tmp_path):
    cells = [("triangle", [[1, 2, 3]]), ("tetra", [[0, 1, 2, 3], [1, 2, 3, 4]])]
    path = write(tmp_path / "a.mesh", TWO_TETRAHEDRA, cells, cell_data={"medit:ref": [[5], [0, 2]]})
    mesh = load_mesh(path)
    assert {name: s.tolist() for name, s in mesh.cell_sets.items()} == {"volume_2": [1]}
    assert {name: s.tolist() for name, s in mesh.point_sets.items()} == {"surface_5": [1, 2, 3]}
    assert not mesh.cell_data


def test_whole_numbers_that_count_the_cells_are_no_regions(tmp_path):
    mesh = Mesh.rectangle((1.0, 1.0), (12, 12))
    read = load_mesh(write_mesh(tmp_path / "a.vtu", mesh, cell_data={"number": [np.arange(mesh.cell_count)]}))
    assert not read.cell_sets
    np.testing.assert_array_equal(read.cell_data["number"], np.arange(mesh.cell_count))


# ---- units and axes


def test_coordinates_are_scaled(tmp_path):
    path = write_mesh(tmp_path / "a.vtu", BOX)
    np.testing.assert_allclose(load_mesh(path, scale=1e-3).points, 1e-3 * BOX.points)
    np.testing.assert_array_equal(load_mesh(path, up_axis="Z").points, BOX.points)  # it does not state one


@pytest.mark.parametrize("stated", ["Y", "Z", None])
@pytest.mark.parametrize("wanted", ["Y", "Z"])
def test_usd_comes_in_metres_and_turned(tmp_path, monkeypatch, stated, wanted):
    monkeypatch.setattr("warpfem.usd.meshes.read_in_child", lambda read, path, error: read(str(path)))
    path = tmp_path / "a.usda"
    header = f'(\n    metersPerUnit = 0.01\n    upAxis = "{stated}"\n)' if stated else "(\n    metersPerUnit = 0.01\n)"
    path.write_text(f"""#usda 1.0
{header}
def TetMesh "a" {{
    point3f[] points = [(0, 0, 0), (100, 0, 0), (0, 200, 0), (0, 0, 300)]
    int4[] tetVertexIndices = [(0, 1, 2, 3)]
}}
""")
    turned = {("Z", "Y"): [[1, 0, 0], [0, 0, -2], [0, 3, 0]], ("Y", "Z"): [[1, 0, 0], [0, 0, 2], [0, -3, 0]]}
    expected = turned.get((stated, wanted), [[1, 0, 0], [0, 2, 0], [0, 0, 3]])
    mesh = load_mesh(path, up_axis=wanted)
    np.testing.assert_allclose(mesh.points[1:], expected, atol=1e-12)
    assert mesh.cells.tolist() == [[0, 1, 2, 3]]  # turned, not mirrored


def test_usd_subsets_and_primvars_become_sets_and_data(tmp_path):
    path = tmp_path / "a.usda"
    path.write_text("""#usda 1.0
def TetMesh "a" {
    point3f[] points = [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 1, 1)]
    int4[] tetVertexIndices = [(0, 1, 2, 3), (1, 2, 3, 4)]
    int3[] surfaceFaceVertexIndices = [(0, 1, 2), (1, 2, 4)]
    int[] primvars:region = [1, 2] ( interpolation = "uniform" )
    float[] primvars:youngsModulus = [1000, 2000] ( interpolation = "uniform" )
    float[] primvars:temperature = [1, 2, 3, 4, 5] ( interpolation = "vertex" )
    def GeomSubset "bone" {
        uniform token elementType = "tetrahedron"
        int[] indices = [1]
    }
    def GeomSubset "floor" {
        uniform token elementType = "face"
        int[] indices = [1]
    }
    def GeomSubset "tip" {
        uniform token elementType = "point"
        int[] indices = [4]
    }
}
""")
    mesh = load_mesh(path)
    assert {name: s.tolist() for name, s in mesh.cell_sets.items()} == {"bone": [1], "region_1": [0], "region_2": [1]}
    assert {name: s.tolist() for name, s in mesh.point_sets.items()} == {"floor": [1, 2, 4], "tip": [4]}
    assert {k: v.tolist() for k, v in mesh.cell_data.items()} == {"region": [1, 2], "youngsModulus": [1e3, 2e3]}


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"scale": 0.0}, "scale must be a positive number, not 0.0"),
        ({"scale": "mm"}, "scale must be a positive number, not 'mm'"),
        ({"up_axis": "X"}, "up_axis must be 'Y' or 'Z', not 'X'"),
        ({"up_axis": ["Y"]}, "up_axis must be 'Y' or 'Z'"),
        ({"edge_length": 1.0}, r"a\.vtu: edge_length and envelope are for surfaces, and the file holds cells"),
        ({"envelope": 1.0}, r"a\.vtu: edge_length and envelope are for surfaces"),
    ],
)
def test_options_have_a_domain(tmp_path, options, message):
    path = write_mesh(tmp_path / "a.vtu", BOX)
    with pytest.raises(MeshError, match=message):
        load_mesh(path, **options)


# ---- broken files


BINARY = {"binary": True}
MESH_FILES = {
    "22.msh": {"file_format": "gmsh22", **BINARY},
    "41.msh": {"file_format": "gmsh", **BINARY},
    "a.vtu": {},
    "text.vtu": {"binary": False},
    "a.vtk": {},
    "42.vtk": {"file_format": "vtk42"},
    "a.mesh": {},
    "a.inp": {},
}


@pytest.mark.parametrize(("name", "arguments"), MESH_FILES.items(), ids=str)
@pytest.mark.filterwarnings("ignore:.*not closed by:UserWarning")
def test_a_broken_mesh_file_is_one_error(tmp_path, capfd, name, arguments):
    path = write_mesh(tmp_path / name, BOX, **arguments)
    load_here(path)
    whole = path.read_bytes()
    broken = [b"", b"once upon a time\n", np.random.default_rng(1).bytes(1000), whole[: len(whole) // 2]]
    if name not in ("a.inp",):  # whose text has no end mark
        broken.append(whole[: int(0.95 * len(whole))])
    for content in broken:
        path.write_bytes(content)
        with pytest.raises(MeshError, match=rf"^{path}: ") as caught:
            load_here(path)
        assert DAMAGED in str(caught.value) or "no triangles" in str(caught.value)
        assert "\n" not in str(caught.value)
    write(path, BOX.points, [("tetra", [[0, 1, 2, 99]])], **arguments)
    with pytest.raises(WarpfemError, match=r"refers to a point outside 0\.\.35|damaged"):
        load_here(path)
    capfd.readouterr()  # what meshio says when it writes


# ---- optional packages


@pytest.mark.parametrize(("name", "package"), [("a.vtu", "meshio"), ("a.stl", "trimesh")])
@pytest.mark.parametrize("read", [load_mesh, read_surface])
def test_a_missing_package_names_its_extra(tmp_path, monkeypatch, read, name, package):
    (tmp_path / name).touch()
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(MissingExtraError, match=rf"reading {name} needs .*'{package}': pip install 'warpfem\[mesh\]'"):
        read(tmp_path / name)


# ---- what is in a file decides nothing about this process


def test_a_count_that_lies_takes_no_memory(tmp_path):
    pytest.importorskip("meshio")
    path = tmp_path / "lie.msh"
    path.write_text(GMSH_22.replace("$Nodes\n6\n", "$Nodes\n999999999999\n"))
    with pytest.raises(MeshError, match=r"lie\.msh: .*damaged"):
        load_mesh(path)


@pytest.mark.parametrize("read", [load_mesh, read_surface])
@pytest.mark.parametrize("path", [None, 0, 1.5, b"a.msh", ["a.msh"], "", "a" * 5000 + ".msh", "a\0.msh"], ids=repr)
def test_odd_names_are_refused(read, path):
    with pytest.raises(MeshError, match=r"no such file|the name of a file must be"):
        read(path)
