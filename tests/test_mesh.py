"""Mesh: what it computes from positions and cells, what it refuses, sets, and the builders."""

import copy
import pickle
import re

import numpy as np
import pytest

from warpfem.errors import MeshError
from warpfem.mesh import MIN_QUALITY, Mesh

pytestmark = pytest.mark.filterwarnings("error")

TRIANGLE = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
TETRAHEDRON = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])

GRIDS = {
    "rectangle": (Mesh.rectangle((2.0, 3.0), (4, 5), origin=(-1.0, 7.0)), 6.0),
    "box-5": (Mesh.box((1.0, 2.0, 3.0), (2, 3, 4), origin=(5.0, -1.0, 0.5)), 6.0),
    "box-6": (Mesh.box((1.0, 2.0, 3.0), (3, 2, 3), split=6), 6.0),
}
grids = pytest.mark.parametrize(("mesh", "volume"), GRIDS.values(), ids=GRIDS)


def one_cell(points, **sets):
    return Mesh(points, [range(len(points))], **sets)


# ---- builders, and what follows from positions and cells


@grids
def test_cells_of_a_grid_fill_it(mesh, volume):
    assert mesh.cell_volumes.min() > 0.0
    assert mesh.cell_volumes.sum() == pytest.approx(volume, rel=1e-13)


@grids
def test_neighbours_share_whole_faces(mesh, volume):
    """A face lies on the box or belongs to two cells: a crack shows as a boundary face inside."""
    corners = mesh.points[mesh.boundary_faces]
    lower, upper = mesh.bounding_box
    on_a_side = (corners == lower).all(axis=1) | (corners == upper).all(axis=1)
    assert on_a_side.any(axis=1).all()

    faces = np.concatenate([np.delete(mesh.cells, k, axis=1) for k in range(mesh.dim + 1)])
    counts = np.unique(np.sort(faces, axis=1), axis=0, return_counts=True)[1]
    assert set(counts) == {1, 2}
    assert len(mesh.boundary_faces) == (counts == 1).sum()


@grids
def test_boundary_is_closed_and_outward(mesh, volume):
    normals, areas = mesh.boundary_face_normals, mesh.boundary_face_areas
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, rtol=1e-14)
    np.testing.assert_allclose(areas @ normals, 0.0, atol=1e-12)
    centroids = mesh.points[mesh.boundary_faces].mean(axis=1)
    flux = areas @ (normals * centroids).sum(axis=1)  # divergence theorem: the divergence of x is dim
    assert flux / mesh.dim == pytest.approx(volume, rel=1e-12)


@grids
def test_winding_of_boundary_faces_gives_the_normal(mesh, volume):
    corners = mesh.points[mesh.boundary_faces]
    along = corners[:, 1] - corners[:, 0]
    if mesh.dim == 2:
        outward = np.stack([along[:, 1], -along[:, 0]], axis=1)
    else:
        outward = np.cross(along, corners[:, 2] - corners[:, 0]) / 2.0
    expected = mesh.boundary_face_normals * mesh.boundary_face_areas[:, None]
    np.testing.assert_allclose(outward, expected, atol=1e-15)


@grids
def test_each_boundary_face_is_a_face_of_its_cell(mesh, volume):
    of_cell = mesh.cells[mesh.face_cells]
    assert (mesh.boundary_faces[:, :, None] == of_cell[:, None, :]).any(axis=2).all()
    away = mesh.points[of_cell].mean(axis=1) - mesh.points[mesh.boundary_faces].mean(axis=1)
    assert ((away * mesh.boundary_face_normals).sum(axis=1) < 0.0).all()
    assert set(mesh.boundary_points) == set(mesh.boundary_faces.ravel())


@grids
def test_inverse_shape_matrices_recover_a_deformation_gradient(mesh, volume):
    gradient = np.random.default_rng(1).normal(size=(mesh.dim, mesh.dim))
    corners = (mesh.points @ gradient.T)[mesh.cells]
    spans = (corners[:, 1:] - corners[:, :1]).transpose(0, 2, 1)
    recovered = spans @ mesh.inverse_shape_matrices
    np.testing.assert_allclose(recovered, np.broadcast_to(gradient, recovered.shape), atol=1e-12)


def test_far_from_the_origin_costs_only_the_rounding_of_the_positions():
    near = Mesh.box((1.0, 1.0, 1.0), (2, 2, 2))
    far = near.transformed(offset=(2.0**20, -(2.0**20), 2.0**20))  # exact in float64
    np.testing.assert_array_equal(far.inverse_shape_matrices, near.inverse_shape_matrices)
    np.testing.assert_array_equal(far.cell_volumes, near.cell_volumes)
    np.testing.assert_array_equal(far.quality, near.quality)


@pytest.mark.parametrize(("split", "per_cube"), [(5, 5), (6, 6)])
def test_counts_of_a_box(split, per_cube):
    mesh = Mesh.box((1.0, 1.0, 1.0), (2, 3, 4), split=split)
    assert (mesh.dim, mesh.point_count, mesh.cell_count) == (3, 3 * 4 * 5, per_cube * 2 * 3 * 4)
    assert len(mesh.boundary_faces) == 2 * 2 * (2 * 3 + 3 * 4 + 4 * 2)
    faces = (4 * mesh.cell_count + len(mesh.boundary_faces)) // 2
    assert mesh.point_count - len(mesh.edges) + faces - mesh.cell_count == 1  # Euler's formula of a ball


def test_rectangle_alternates_its_diagonals():
    mesh = Mesh.rectangle((2.0, 2.0), (2, 2))
    assert (mesh.point_count, mesh.cell_count, len(mesh.edges)) == (9, 8, 16)
    spans = np.diff(mesh.points[mesh.edges], axis=1)[:, 0]
    diagonals = spans[np.abs(spans).min(axis=1) > 0.0]
    assert sorted(diagonals[:, 0] * diagonals[:, 1]) == [-1.0, -1.0, 1.0, 1.0]


def test_sides_of_a_grid():
    mesh = Mesh.box((1.0, 2.0, 3.0), (2, 2, 2), origin=(5.0, 6.0, 7.0))
    sides = {"left": (0, 5.0), "right": (0, 6.0), "bottom": (1, 6.0), "top": (1, 8.0)}
    sides |= {"back": (2, 7.0), "front": (2, 10.0)}
    assert set(mesh.point_sets) == set(sides)
    for name, (axis, value) in sides.items():
        np.testing.assert_array_equal(mesh.select_points(name), np.flatnonzero(mesh.points[:, axis] == value))
    assert set(Mesh.rectangle((1.0, 1.0), (1, 1)).point_sets) == {"left", "right", "bottom", "top"}


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: Mesh.rectangle((1.0, 0.0), (1, 1)), "size must be positive"),
        (lambda: Mesh.rectangle((1.0, -2.0), (1, 1)), "size must be positive"),
        (lambda: Mesh.rectangle((1.0, np.inf), (1, 1)), "size must be 2 finite numbers"),
        (lambda: Mesh.rectangle((1.0, 1.0, 1.0), (1, 1)), "size must be 2 finite numbers"),
        (lambda: Mesh.rectangle("ab", (1, 1)), "size must be 2 numbers"),
        (lambda: Mesh.rectangle((1.0, 1.0), (1.0, 2.0)), "cells must be 2 whole numbers"),
        (lambda: Mesh.rectangle((1.0, 1.0), (True, True)), "cells must be 2 whole numbers"),
        (lambda: Mesh.rectangle((1.0, 1.0), 3), "cells must be 2 whole numbers"),
        (lambda: Mesh.box((1.0, 1.0, 1.0), (1, 0, 1)), "cells must be 3 whole numbers"),
        (lambda: Mesh.box((1.0, 1.0, 1.0), (1, 1, 1), origin=(0.0, 0.0)), "origin must be 3 finite numbers"),
        (lambda: Mesh.box((1.0, 1.0, 1.0), (1, 1, 1), split=4), "split must be 5 or 6"),
    ],
)
def test_builders_refuse(build, message):
    with pytest.raises(MeshError, match=message):
        build()


def test_transformed_scales_then_moves():
    mesh = Mesh.rectangle((1.0, 2.0), (1, 2)).with_cell_set("c", [0])
    moved = mesh.transformed(scale=3.0, offset=(1.0, -1.0))
    np.testing.assert_allclose(moved.points, 3.0 * mesh.points + [1.0, -1.0])
    assert moved.cell_volumes.sum() == pytest.approx(18.0)
    assert set(moved.point_sets) == set(mesh.point_sets)
    assert set(moved.cell_sets) == {"c"}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"scale": 0.0}, "scale must be a positive number"),
        ({"scale": -1.0}, "scale must be a positive number"),
        ({"scale": np.nan}, "scale must be a positive number"),
        ({"scale": (1.0, 2.0)}, "scale must be a positive number"),
        ({"offset": (1.0, 2.0, 3.0)}, "offset must be 2 finite numbers"),
    ],
)
def test_transformed_refuses(arguments, message):
    with pytest.raises(MeshError, match=message):
        one_cell(TRIANGLE).transformed(**arguments)


# ---- shape


def test_quality_of_regular_cells_is_one():
    triangle = one_cell([[0.0, 0.0], [1.0, 0.0], [0.5, np.sqrt(0.75)]])
    tetrahedron = one_cell(1e-3 * np.array([[1.0, 1, 1], [-1, 1, -1], [1, -1, -1], [-1, -1, 1]]))
    assert triangle.quality == pytest.approx([1.0], rel=1e-14)
    assert tetrahedron.quality == pytest.approx([1.0], rel=1e-14)


def test_quality_of_a_corner_and_of_slivers():
    assert one_cell(TETRAHEDRON).quality == pytest.approx([12.0 * 0.5 ** (2 / 3) / 9.0], rel=1e-13)
    for height in (1e-1, 1e-3, 1e-6):
        sliver = one_cell([[0, 0, 0], [1, 1, 0], [0, 1, height], [1, 0, height]])
        volume, squares = height / 3.0, 2.0 * 2.0 + 4.0 * (1.0 + height**2)
        assert sliver.cell_volumes == pytest.approx([volume], rel=1e-9)
        assert sliver.quality == pytest.approx([12.0 * (3.0 * volume) ** (2 / 3) / squares], rel=1e-9)


@pytest.mark.parametrize("size", [1e-30, 1.0, 1e30])
@pytest.mark.parametrize("dim", [2, 3])
def test_the_least_volume_depends_on_shape_alone(dim, size):
    """Cells of quality 1e-7 pass and those of 1e-9 do not, of whatever size."""

    def needle(quality):
        points = (TRIANGLE if dim == 2 else TETRAHEDRON).copy()
        height = quality / (2.0 * np.sqrt(3.0) / 2.0) if dim == 2 else (quality * 6.0 / 12.0) ** 1.5 / 0.5
        points[dim, dim - 1] = height
        return one_cell(size * points)

    mesh = needle(1e-7)
    assert MIN_QUALITY < mesh.quality[0] < 2e-7
    assert np.isfinite(mesh.inverse_shape_matrices).all()
    with pytest.raises(MeshError, match=r"cell 0 has no volume at rest \(quality below 1e-08\) \(1 of 1 cells"):
        needle(1e-9)


def test_quality_summary():
    mesh = Mesh([[0, 0], [1, 0], [0.5, np.sqrt(0.75)], [2.5, 0.0]], [[0, 1, 2], [1, 3, 2]])
    summary = mesh.quality_summary()
    assert summary.worst_cell == 1
    assert summary.worst == pytest.approx(4 * np.sqrt(3) * 0.75 * np.sqrt(0.75) / (1 + 2.25 + 4.75))
    assert summary.mean == pytest.approx((1.0 + summary.worst) / 2.0)
    assert summary.shortest_edge == pytest.approx(1.0)
    assert summary.longest_edge == pytest.approx(np.sqrt(4.75))
    assert mesh.mean_edge_length == pytest.approx((3 * 1.0 + 1.5 + np.sqrt(4.75)) / 5)
    assert str(summary) == "quality 0.562 (cell 1) to mean 0.781, edges 1 to 2.18 m"


def test_edges_of_one_cell():
    mesh = one_cell(TETRAHEDRON)
    np.testing.assert_array_equal(mesh.edges, [[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]])
    np.testing.assert_allclose(mesh.edge_lengths, np.sqrt([1, 1, 1, 2, 2, 2]))
    np.testing.assert_array_equal(mesh.bounding_box, [[0, 0, 0], [1, 1, 1]])


# ---- what is stored


@pytest.mark.parametrize(("scalar", "index"), [(np.float64, np.int32), (np.float32, np.uint64)])
def test_arrays_are_copies_of_the_documented_types_and_read_only(scalar, index):
    points, chosen = TETRAHEDRON.astype(scalar), np.array([2, 0])
    cells = np.arange(4, dtype=index)[None]
    mesh = Mesh(points, cells, {"some": chosen}, {"all": [0]})
    points[:], cells[:], chosen[:] = 7.0, 7, 7
    np.testing.assert_array_equal(mesh.points, TETRAHEDRON)
    np.testing.assert_array_equal(mesh.cells, [[0, 1, 2, 3]])
    np.testing.assert_array_equal(mesh.point_sets["some"], [0, 2])
    names = ["cell_volumes", "inverse_shape_matrices", "edges", "edge_lengths", "bounding_box", "quality"]
    names += [
        "points",
        "cells",
        "boundary_faces",
        "face_cells",
        "boundary_face_areas",
        "boundary_face_normals",
    ]
    names += ["boundary_points"]
    integers = {"cells", "edges", "boundary_faces", "face_cells", "boundary_points"}
    for name in names:
        array = getattr(mesh, name)
        assert array.dtype == (np.int32 if name in integers else np.float64), name
        with pytest.raises(ValueError, match="read-only"):
            array[...] = 0
    with pytest.raises(ValueError, match="read-only"):
        mesh.point_sets["some"][0] = 1
    with pytest.raises(TypeError):
        mesh.point_sets["more"] = np.array([1])
    with pytest.raises(AttributeError):
        mesh.points = points


@pytest.mark.parametrize("duplicate", [copy.deepcopy, lambda mesh: pickle.loads(pickle.dumps(mesh))])
def test_survives_copy_and_pickle(duplicate):
    mesh = duplicate(Mesh.rectangle((1.0, 1.0), (2, 1)).with_cell_set("half", [0, 1]))
    np.testing.assert_array_equal(mesh.select_cells("half"), [0, 1])
    assert not mesh.points.flags.writeable
    assert repr(mesh) == "Mesh(2D, 6 points, 4 cells, point sets: left, right, bottom, top, cell sets: half)"


# ---- what is refused

FIVE = np.array([*TETRAHEDRON, [1.0, 1.0, 1.0]])
TWO = [[0, 1, 2, 3], [1, 2, 3, 4]]


@pytest.mark.parametrize(
    ("points", "cells", "message"),
    [
        ([["a", "b"]], [[0, 1, 2]], "points must be .* not of type <U1"),
        (TRIANGLE > 0.0, [[0, 1, 2]], "points must be .* not of type bool"),
        ([[0.0, 0.0], [1.0]], [[0, 1, 2]], "points must be .* not equally long"),
        (TRIANGLE.ravel(), [[0, 1, 2]], r"points must be .* not of shape \(6,\)"),
        (np.zeros((3, 4)), [[0, 1, 2]], r"points must be .* not of shape \(3, 4\)"),
        (TRIANGLE, [[0.0, 1.0, 2.0]], "cells must be .* not of type float64"),
        (TRIANGLE, [0, 1, 2], r"cells must be \(m, 3\) or \(m, 6\) triangles for points in 2D, not of shape \(3,\)"),
        (TRIANGLE, [[0, 1, 2, 0]], r"cells must be \(m, 3\) or \(m, 6\) triangles for points in 2D"),
        (TETRAHEDRON, [[0, 1]], r"cells must be \(m, 4\) or \(m, 10\) tetrahedra for points in 3D"),
        (TETRAHEDRON, [[0, 1, 2]], "surface, not a solid: .*warpfem.tetrahedralize"),
        (TRIANGLE, [], "the mesh has no cells"),
        (TRIANGLE, np.empty((0, 3), dtype=int), "the mesh has no cells"),
        (np.where(FIVE == 1.0, np.nan, FIVE), TWO, r"point 1 is not finite \(4 of 5 points in all\)"),
        ([[0, 0], [1, 0], [0, np.inf]], [[0, 1, 2]], r"point 2 is not finite \(1 of 3 points in all\)"),
        (FIVE, [[0, 1, 2, 3], [0, 1, 2, 5], [9, 1, 2, 3]], r"cell 1 refers .*outside 0\.\.4 \(2 of 3 cells"),
        (FIVE, [[0, 1, 2, 2**40], [0, 1, 2, 3]], r"cell 0 refers to a point outside 0\.\.4 \(1 of 2"),
        (FIVE, [[0, 1, 2, -1]], r"cell 0 refers to a point outside 0\.\.4 \(1 of 1"),
        (FIVE, [*TWO, [1, 4, 4, 2]], r"cell 2 repeats a point \(1 of 3 cells in all\)"),
        (FIVE, [*TWO, [1, 2, 0, 3]], r"cell 2 has the same points as cell 0 \(1 of 3 cells in all\)"),
        (FIVE, [*TWO, TWO[1], TWO[0], TWO[0]], r"cell 2 has the same points as cell 1 \(3 of 5 cells"),
        (np.ones((4, 3)), [[0, 1, 2, 3]], "cell 0 has no volume at rest"),
        ([[0.0, 0.0], [0.1, 0.3], [0.2, 0.6]], [[0, 1, 2]], "cell 0 has no volume at rest"),
        (FIVE, [[0, 1, 2, 3], [1, 2, 4, 3]], r"cell 1 is inverted at rest \(1 of 2 .*Mesh.repaired"),
        (FIVE, [[0, 1, 2, 3]], r"point 4 belongs to no cell \(1 of 5 points in all\): Mesh.repaired"),
    ],
)
def test_refuses_and_says_where(points, cells, message):
    with pytest.raises(MeshError, match=message):
        Mesh(points, cells)


@pytest.mark.parametrize("kind", ["point", "cell"])
@pytest.mark.parametrize(
    ("sets", "message"),
    [
        ({"a": [0, 9, 11]}, r"KIND set 'a' refers to KIND 9 \(2 of 3 in all\): KINDs go from 0 to "),
        ({"a": [-1]}, "KIND set 'a' refers to KIND -1"),
        ({"a": [0.5]}, "KIND set 'a' must be KIND indices .* not of type float64"),
        ({"a": np.array([True, False])}, r"KIND set 'a' must be .*np.flatnonzero\(mask\).* not of type bool"),
        ({"a": [[0], [0]]}, r"KIND set 'a' must be a row of KIND indices, not of shape \(2, 1\)"),
        ({"": [0]}, "the name of a KIND set must be a non-empty str, not ''"),
        ({3: [0]}, "the name of a KIND set must be a non-empty str, not 3"),
    ],
)
def test_refuses_sets(kind, sets, message):
    with pytest.raises(MeshError, match=message.replace("KIND", kind)):
        Mesh(FIVE, TWO, **{f"{kind}_sets": sets})


# ---- repair


def test_repaired_turns_cells_and_drops_points():
    points = np.array([[9.0, 9.0, 9.0], *FIVE[:2], [8.0, 8.0, 8.0], *FIVE[2:]])
    cells = [[1, 2, 4, 5], [2, 4, 6, 5]]  # the second is inverted; points 0 and 3 are unused
    mesh = Mesh.repaired(points, cells, {"ends": [0, 1, 6], "gone": [3]}, {"second": [1]})
    np.testing.assert_array_equal(mesh.points, FIVE)
    np.testing.assert_array_equal(mesh.cells, TWO)
    np.testing.assert_array_equal(mesh.point_sets["ends"], [0, 4])
    assert not len(mesh.point_sets["gone"])
    np.testing.assert_array_equal(mesh.cell_sets["second"], [1])


def test_repaired_turns_triangles():
    mesh = Mesh.repaired(TRIANGLE, [[0, 2, 1]])
    np.testing.assert_array_equal(mesh.cells, [[0, 1, 2]])


def test_repaired_leaves_its_input_alone_and_refuses_the_rest():
    cells = np.array([[0, 2, 1]], dtype=np.int32)
    Mesh.repaired(TRIANGLE, cells)
    np.testing.assert_array_equal(cells, [[0, 2, 1]])
    with pytest.raises(MeshError, match="has no volume"):
        Mesh.repaired([[0.0, 0.0], [1.0, 0.0], [2.0, 0.0]], cells)
    with pytest.raises(MeshError, match="has the same points as cell 0"):
        Mesh.repaired(TRIANGLE, [[0, 1, 2], [0, 2, 1]])
    with pytest.raises(MeshError, match="point set 'a' refers to point 3"):
        Mesh.repaired(TRIANGLE, cells, {"a": [3]})


# ---- sets


@pytest.fixture
def box():
    return Mesh.box((2.0, 1.0, 1.0), (4, 2, 2))


def test_sets_from_indices_and_functions(box):
    mesh = box.with_point_set("end", lambda points: points[:, 0] > 1.9).with_cell_set(
        "half", lambda centroids: centroids[:, 0] > 0.9
    )
    np.testing.assert_array_equal(mesh.select_points("end"), box.select_points("right"))
    assert mesh.cell_volumes[mesh.select_cells("half")].sum() == pytest.approx(1.0)
    assert mesh.select_cells("half").dtype == np.int32
    assert mesh.with_point_set("end", [7, 3, 7]).select_points("end").tolist() == [3, 7]
    assert set(box.point_sets) == set(mesh.point_sets) - {"end"}
    assert not box.cell_sets


def test_a_new_set_keeps_what_was_computed(box):
    volumes = box.cell_volumes
    assert box.with_point_set("one", [0]).cell_volumes is volumes


def test_selecting_by_index(box):
    assert box.select_points([5, 1, 5]).tolist() == [1, 5]
    assert box.select_points(np.int64(3)).tolist() == [3]
    assert box.select_cells(range(2)).tolist() == [0, 1]
    assert box.select_points(np.array([4], dtype=np.uint8)).dtype == np.int32


def test_selected_faces_cover_the_side(box):
    for name, normal, area in (("right", (1, 0, 0), 1.0), ("top", (0, 1, 0), 2.0), ("back", (0, 0, -1), 2.0)):
        faces = box.select_faces(name)
        assert box.boundary_face_areas[faces].sum() == pytest.approx(area)
        np.testing.assert_allclose(box.boundary_face_normals[faces], np.tile(normal, (len(faces), 1)))


@pytest.mark.parametrize(
    ("use", "message"),
    [
        (
            lambda m: m.select_points("lift"),
            "no point set 'lift'; did you mean 'left'? Known point sets: 'left', ",
        ),
        (
            lambda m: m.select_points("zzz"),
            "the mesh has no point set 'zzz'. Known point sets: 'left', 'right'",
        ),
        (lambda m: m.select_cells("a"), "no cell set 'a'. Known cell sets: none (add one by with_cell_set)"),
        (lambda m: m.select_points([]), "the point selection is empty"),
        (lambda m: m.select_points("empty"), "point set 'empty' is empty: select at least one point"),
        (lambda m: m.select_points([45]), "the point selection refers to point 45 (1 of 1 in all)"),
        (lambda m: m.select_cells([-1]), "the cell selection refers to cell -1"),
        (lambda m: m.select_points([1.0]), "the point selection must be point indices (integers"),
        (lambda m: m.select_faces([0]), "no boundary face has all its points in the point selection"),
        (lambda m: m.select_faces("inside"), "no boundary face has all its points in point set 'inside'"),
        (lambda m: m.select_faces("missing"), "no point set 'missing'"),
        (lambda m: m.with_point_set("a", []), "point set 'a' is empty: it must"),
        (lambda m: m.with_point_set("a", lambda p: p[:, 0] > 9.0), "point set 'a' is empty: it must"),
        (lambda m: m.with_point_set("a", [99]), "point set 'a' refers to point 99"),
        (lambda m: m.with_point_set("", [0]), "must be a non-empty str, not ''"),
        (lambda m: m.with_point_set("a", lambda p: p[:, 0]), "must return a boolean mask of shape (45,)"),
        (lambda m: m.with_point_set("a", lambda p: p > 0.0), "not bool of shape (45, 3)"),
        (
            lambda m: m.with_cell_set("a", lambda c: c[:3, 0] > 0.0),
            "must return a boolean mask of shape (80,)",
        ),
    ],
)
def test_selections_refuse(box, use, message):
    inside = np.setdiff1d(np.arange(box.point_count), box.boundary_points)
    mesh = Mesh(box.points, box.cells, {**box.point_sets, "empty": [], "inside": inside})
    with pytest.raises(MeshError, match=re.escape(message)):
        use(mesh)


# ---- numbers of cells


def test_cell_data_go_with_the_cells():
    mesh = Mesh.rectangle((1.0, 1.0), (1, 1))
    mesh = Mesh(mesh.points, mesh.cells, cell_sets={"a": [1]}, cell_data={"E": [1, 2], "new": [True, False]})
    assert mesh.cell_data["E"].dtype == np.float64 and not mesh.cell_data["E"].flags.writeable
    assert repr(mesh) == "Mesh(2D, 4 points, 2 cells, cell sets: a, cell data: E, new)"
    turned = Mesh.repaired(mesh.points, mesh.cells[:, ::-1], cell_data=mesh.cell_data)
    for same in (mesh.quadratic(), mesh.transformed(2.0), pickle.loads(pickle.dumps(mesh)), turned):
        assert same.cell_data["E"].tolist() == [1.0, 2.0] and same.cell_data["new"].tolist() == [1.0, 0.0]
    assert mesh.refined().cell_data["E"].tolist() == [1.0] * 4 + [2.0] * 4


@pytest.mark.parametrize(
    ("data", "message"),
    [
        ([1.0], "cell_data must be a dict"),
        ({"": [1.0]}, "the name of cell data must be a non-empty str, not ''"),
        ({"E": 1.0}, "cell data 'E' must have one number for each of 1 cells, not ()"),
        ({"E": [1.0, 2.0]}, "cell data 'E' must have one number for each of 1 cells, not (2,)"),
        ({"E": ["hard"]}, "cell data 'E' must be one number per cell, not of type <U4"),
    ],
)
def test_cell_data_are_one_number_per_cell(data, message):
    with pytest.raises(MeshError, match=re.escape(message)):
        one_cell(TRIANGLE, cell_data=data)


def test_values_of_sets_become_values_of_cells(box):
    mesh = box.with_cell_set("low", lambda c: c[:, 1] < 0.5).with_cell_set("high", lambda c: c[:, 1] >= 0.5)
    values = mesh.per_cell({"low": 1e5, "high": 2e5})
    np.testing.assert_array_equal(values, np.where(np.isin(np.arange(box.cell_count), mesh.cell_sets["low"]), 1e5, 2e5))
    refusals = {
        "cell 0 (40 in all) is in none of 'high'; other cell sets of the mesh: 'low', 'twin'": {"high": 1.0},
        "is in 'twin' and in another set with another value": {"low": 1.0, "high": 2.0, "twin": 3.0},
        "no cell set 'lowest'": {"lowest": 1.0},
        "the value of 'low' must be a finite number, not 'soft'": {"low": "soft"},
    }
    mesh = mesh.with_cell_set("twin", mesh.cell_sets["low"])
    np.testing.assert_array_equal(mesh.per_cell({"low": 1e5, "twin": 1e5, "high": 2e5}), values)
    for message, given in refusals.items():
        with pytest.raises(MeshError, match=re.escape(message)):
            mesh.per_cell(given)
