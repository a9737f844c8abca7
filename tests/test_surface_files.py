"""Surfaces from files that trimesh reads, and from faces in mesh files."""

import numpy as np
import pytest

from warpfem.child import DAMAGED
from warpfem.errors import MeshError
from warpfem.mesh import Mesh
from warpfem.meshing import files, load_mesh, read_surface, trimesh_files
from warpfem.meshing.filling import checked_surface

BLOCK = Mesh.box((1.0, 2.0, 1.0), (1, 2, 1))

SURFACE_FILES = {
    "a.obj": {},
    "a.stl": {},
    "text.stl": {"file_type": "stl_ascii"},
    "a.ply": {},
    "text.ply": {"encoding": "ascii"},
    "a.off": {},
    "a.glb": {},
    "a.gltf": {"embed_buffers": True},
}


def write(path, arguments, points=BLOCK.points, triangles=BLOCK.boundary_faces):
    trimesh = pytest.importorskip("trimesh")
    surface = trimesh.Trimesh(points, triangles, process=False)
    is_scene = path.suffix in (".glb", ".gltf")
    (trimesh.Scene(surface) if is_scene else surface).export(path, **arguments)
    return path


def corners(path):
    """The corners of the triangles, as ``read_surface`` finds them, without a child process."""
    found = trimesh_files.read(str(path))
    points, triangles = checked_surface(found.points, found.triangles)
    return points[triangles]


EXPECTED = BLOCK.points[BLOCK.boundary_faces]


@pytest.mark.parametrize(("name", "arguments"), SURFACE_FILES.items(), ids=str)
def test_surfaces_read_back(tmp_path, name, arguments):
    np.testing.assert_allclose(corners(write(tmp_path / name, arguments)), EXPECTED, atol=1e-7)


def test_surfaces_are_scaled(tmp_path):
    points, triangles = read_surface(write(tmp_path / "a.stl", {}).rename(tmp_path / "A.STL"), scale=1e-3)
    assert (points.dtype, triangles.dtype) == (np.float64, np.int32)
    np.testing.assert_allclose(points[triangles], 1e-3 * EXPECTED, atol=1e-10)


@pytest.mark.parametrize(("name", "arguments"), SURFACE_FILES.items(), ids=str)
def test_a_broken_surface_file_is_one_error(tmp_path, capfd, name, arguments):
    path = write(tmp_path / name, arguments)
    whole = path.read_bytes()
    broken = [b"", b"once upon a time\n", np.random.default_rng(1).bytes(1000), whole[: len(whole) // 2]]
    if path.suffix != ".obj":  # whose text has no end mark: what is missing is a hole
        broken += [whole[: int(share * len(whole))] for share in (0.8, 0.9, 0.95, 0.99)]
    for content in broken:
        path.write_bytes(content)
        with pytest.raises(MeshError, match=rf"^{path}: ") as caught:
            corners(path)
        assert DAMAGED in str(caught.value) or "the file holds no faces" in str(caught.value)
        assert "\n" not in str(caught.value)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("a.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 4\n"),
        ("a.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 0 1 2\n"),
        ("a.obj", "v 0 0 nan\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"),
        ("a.off", "OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 3\n"),
        ("a.stl", "solid\nfacet\nouter loop\nvertex 0 0 0\nvertex 1 x 0\nvertex 0 1 0\nendloop\nendfacet\nendsolid\n"),
        (
            "a.ply",
            "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
            "element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n1 0 0\n0 1 0\n3 0 1 3\n",
        ),
        (
            "a.gltf",
            '{"asset": {"version": "2.0"}, "buffers": [{"uri": "missing.bin", "byteLength": 36}], "meshes": '
            '[{"primitives": [{"attributes": {"POSITION": 0}}]}], "accessors": [{"bufferView": 0, "componentType": '
            '5126, "count": 3, "type": "VEC3"}], "bufferViews": [{"buffer": 0, "byteLength": 36}], "nodes": '
            '[{"mesh": 0}], "scenes": [{"nodes": [0]}]}',
        ),
    ],
)
def test_wrong_numbers_are_refused(tmp_path, name, content):
    pytest.importorskip("trimesh")
    path = tmp_path / name
    path.write_text(content)
    with pytest.raises(MeshError, match=r"damaged|refers to a point outside 0\.\.2|is not finite"):
        corners(path)


def test_wrong_indices_in_binary_files_are_refused(tmp_path):
    triangles = BLOCK.boundary_faces.copy()
    triangles[3, 1] = 99
    for name in ("a.ply", "a.glb"):
        path = write(tmp_path / name, {}, triangles=triangles)
        with pytest.raises(MeshError, match=r"triangle \d+ refers to a point outside"):
            corners(path)


def test_a_scene_has_its_transforms_and_comes_upright(tmp_path):
    """Two instances of a geometry in nodes below each other, the second one mirrored."""
    trimesh = pytest.importorskip("trimesh")
    scene = trimesh.Scene()
    move = trimesh.transformations.translation_matrix
    surface = trimesh.Trimesh(BLOCK.points, BLOCK.boundary_faces, process=False)
    scene.add_geometry(surface, node_name="arm", geom_name="block", transform=move([5, 0, 0]))
    scene.graph.update("hand", "arm", geometry="block", matrix=move([0, 3, 0]) @ np.diag([-2.0, 1.0, 1.0, 1.0]))
    path = tmp_path / "a.glb"
    scene.export(path)
    points, triangles = read_surface(path)
    arm, hand = EXPECTED + np.array([5, 0, 0]), EXPECTED * (-2, 1, 1) + (5, 3, 0)
    expected = sorted(np.concatenate([arm, hand]).mean(axis=1).tolist())
    np.testing.assert_allclose(sorted(points[triangles].mean(axis=1).tolist()), expected, atol=1e-6)
    turned, _ = read_surface(path, up_axis="Z")
    x, y, z = points.T
    np.testing.assert_array_equal(turned, np.column_stack([x, -z, y]))


def test_polygons_are_cut_into_triangles(tmp_path):
    pytest.importorskip("trimesh")
    path = tmp_path / "house.obj"
    path.write_text("v 0 0 0\nv 1 0 0\nv 1 1 0\nv .5 2 0\nv 0 1 0\nf 1 2 3 4 5\nf 1 2 3 5\nf 3 4 5\n")
    found = corners(path)
    areas = 0.5 * np.linalg.norm(np.cross(found[:, 1] - found[:, 0], found[:, 2] - found[:, 0]), axis=1)
    assert len(areas) == 6 and areas.sum() == pytest.approx(2 * 1.5)


def test_points_alone_are_no_surface(tmp_path):
    pytest.importorskip("trimesh")
    (tmp_path / "a.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\n")
    with pytest.raises(MeshError, match=r"a\.obj: the file holds no faces"):
        read_surface(tmp_path / "a.obj")


# ---- faces in mesh files


def write_mesh_file(path, cells):
    meshio = pytest.importorskip("meshio")
    points = np.random.default_rng(3).random((10, 3))
    meshio.write_points_cells(path, points, [(kind, np.array(rows)) for kind, rows in cells])
    return points


def test_faces_in_a_mesh_file_are_a_surface(tmp_path, monkeypatch):
    path = tmp_path / "a.vtu"
    quadratic = [5, 6, 7, 1, 2, 3]
    points = write_mesh_file(path, [("triangle", [[0, 1, 2]]), ("quad", [[1, 2, 3, 4]]), ("triangle6", [quadratic])])
    read_points, triangles = read_surface(path)
    np.testing.assert_array_equal(read_points, points)
    assert triangles.tolist() == [[0, 1, 2], [1, 2, 3], [1, 3, 4], [5, 6, 7]]
    filled = []
    monkeypatch.setattr(files, "tetrahedralize", lambda *arguments: filled.append(arguments))
    load_mesh(path, scale=2.0, edge_length=0.3, envelope=0.1, progress=False)
    ((surface_points, surface_triangles, *options),) = filled
    np.testing.assert_array_equal(surface_points, 2.0 * points)
    assert (surface_triangles.tolist(), options) == (triangles.tolist(), [0.3, 0.1, False])


def test_a_file_without_faces_is_no_surface(tmp_path):
    path = tmp_path / "solid.vtu"
    write_mesh_file(path, [("tetra", [[0, 1, 2, 3]])])
    with pytest.raises(MeshError, match=r"solid.vtu: the file holds no triangles"):
        read_surface(path)


def test_a_wrong_index_of_a_face_is_refused(tmp_path):
    path = tmp_path / "a.vtu"
    write_mesh_file(path, [("triangle", [[0, 1, 2], [0, 1, 77]])])
    with pytest.raises(MeshError, match=r"a\.vtu: cell 1 refers to a point outside 0\.\.9"):
        load_mesh(path)
