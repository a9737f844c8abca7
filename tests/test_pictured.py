"""Stages that others made, as pictures need them: what moves in them, where, and what stands."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from warpfem.errors import OutputError
from warpfem.preview import preview
from warpfem.usd import read_pictured_stage

HEAD = '#usda 1.0\n(\n    metersPerUnit = 0.01\n    upAxis = "Z"\n    timeCodesPerSecond = 48\n)\n'

# A square metre of two quads that is lifted, in centimetres and in a turning parent; all else stands, or is not seen.
STAGE = (
    HEAD
    + """
def Xform "set" {
    double3 xformOp:translate.timeSamples = { 10: (0, 0, 0), 20: (100, 0, 0) }
    uniform token[] xformOpOrder = ["xformOp:translate"]
    def Mesh "sheet" {
        int[] faceVertexCounts = [4, 3, 3]
        int[] faceVertexIndices = [0, 1, 4, 3, 1, 2, 4, 2, 5, 4]
        point3f[] points.timeSamples = {
            10: [(0, 0, 0), (50, 0, 0), (100, 0, 0), (0, 100, 0), (50, 100, 0), (100, 100, 0)],
            14: [(0, 0, 9), (50, 0, 9), (100, 0, 9), (0, 100, 9), (50, 100, 9), (100, 100, 9)],
            18: [(0, 0, 50), (50, 0, 50), (100, 0, 50), (0, 100, 50), (50, 100, 50), (100, 100, 50)],
        }
        uniform token orientation = "rightHanded"
        uniform bool doubleSided = 1
        float[] primvars:heat = [1, 2, 3] (interpolation = "uniform")
    }
    def Mesh "hidden" {
        token visibility = "invisible"
        int[] faceVertexCounts = [3]
        int[] faceVertexIndices = [0, 1, 2]
        point3f[] points.timeSamples = { 10: [(0, 0, 0), (1, 0, 0), (0, 1, 0)], 11: [(0, 0, 0), (1, 0, 0), (0, 1, 1)] }
    }
}
def Mesh "empty" {
}
def Mesh "ground" {
    int[] faceVertexCounts = [4]
    int[] faceVertexIndices = [0, 1, 2, 3]
    point3f[] points = [(-100, -100, -10), (300, -100, -10), (300, 300, -10), (-100, 300, -10)]
}
"""
)

TETS = """
def Xform "body" {
    def TetMesh "simulation" {
        int4[] tetVertexIndices = [(0, 1, 2, 3)]
        point3f[] points.timeSamples = {
            0: [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)],
            1: [(0, 0, 1), (1, 0, 1), (0, 1, 1), (0, 0, 2)],
        }
        float[] primvars:heat = [5] (interpolation = "uniform")
    }
    %s
}
"""
SURFACE = (
    TETS.split("{", 1)[1]
    .rsplit("%s", 1)[0]
    .replace('TetMesh "simulation"', 'Mesh "render"')
    .replace(
        "int4[] tetVertexIndices = [(0, 1, 2, 3)]",
        "int[] faceVertexCounts = [3, 3, 3, 3]\n int[] faceVertexIndices = [0, 2, 1, 0, 1, 3, 1, 2, 3, 0, 3, 2]",
    )
)


def write(folder: Path, text: str) -> Path:
    path = folder / "stage.usda"
    path.write_text(text)
    return path


def test_what_moves_is_taken_to_the_world_in_metres(tmp_path: Path) -> None:
    stage = read_pictured_stage(write(tmp_path, STAGE))
    assert (stage.frame_count, stage.fps, stage.up_axis) == (3, 12.0, "Z")  # every 4th of 48 time codes per second
    assert (stage.is_flat, stage.equilibria, stage.color) == (False, False, None)
    assert stage.has_insides == (False,)
    (triangles,) = stage.triangles
    assert triangles.points.tolist() == [[0, 1, 4], [0, 4, 3], [1, 2, 4], [2, 5, 4]]
    sheet = np.array([(0, 0, 0), (0.5, 0, 0), (1, 0, 0), (0, 1, 0), (0.5, 1, 0), (1, 1, 0)])
    for index, offset in enumerate([(0, 0, 0), (0.4, 0, 0.09), (0.8, 0, 0.5)]):
        (frame,) = stage.frame(index)
        assert frame.points == pytest.approx(sheet + offset)
        assert frame.velocities is None
    assert stage.rest()[0] == pytest.approx(sheet)
    assert stage.primvars == ("heat",)
    assert stage.values("heat", 2)[0].tolist() == [[1] * 3, [1] * 3, [2] * 3, [3] * 3]
    (ground,) = stage.standing
    assert not ground.is_plane
    assert ground.corners.reshape(-1, 3).min(axis=0).tolist() == [-1.0, -1.0, -0.1]


@pytest.mark.parametrize("mirrored", ["xformOp:scale = (-1, 1, 1)", 'orientation = "leftHanded"'])
def test_faces_are_turned_as_the_stage_says(tmp_path: Path, mirrored: str) -> None:
    text = STAGE.replace('orientation = "rightHanded"', 'orientation = "leftHanded"')
    if "scale" in mirrored:
        text = STAGE.replace('["xformOp:translate"]', '["xformOp:translate", "xformOp:scale"]').replace(
            "double3 xformOp:translate", "double3 xformOp:scale = (-1, 1, 1)\n    double3 xformOp:translate"
        )
    (triangles,) = read_pictured_stage(write(tmp_path, text)).triangles
    assert triangles.points.tolist() == [[4, 1, 0], [3, 4, 0], [4, 2, 1], [4, 5, 2]]


def test_a_tetrahedral_mesh_shows_its_boundary_unless_a_surface_moves_with_it(tmp_path: Path) -> None:
    alone = read_pictured_stage(write(tmp_path, "#usda 1.0\n" + TETS % ""))
    (triangles,) = alone.triangles
    (frame,) = alone.frame(0)
    a, b, c = frame.points[triangles.points].transpose(1, 0, 2)
    outward = np.einsum("ki,ki->k", np.cross(b - a, c - a), (a + b + c) / 3 - frame.points.mean(axis=0))
    assert len(triangles.points) == 4 and (outward > 0).all()
    assert alone.primvars == ()  # a number per cell is none at the boundary
    both = read_pictured_stage(write(tmp_path, "#usda 1.0\n" + TETS % SURFACE))
    assert len(both.triangles) == 1
    assert both.primvars == ("heat",)


def test_a_stage_of_others_is_drawn(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    image = pytest.importorskip("PIL.Image")
    path = write(tmp_path, STAGE.replace('"rightHanded"', '"leftHanded"'))  # seen from behind, which is no inside
    with image.open(preview(path, tmp_path / "out.png")) as file:
        picture = np.asarray(file.convert("RGB")).astype(int)[:, :-136]  # without the bars
    colored = np.ptp(picture, axis=2) > 25
    magenta = (picture[..., 0] > 140) & (picture[..., 1] < 40) & (picture[..., 2] > 140)
    assert colored.mean() > 0.005 and not magenta.any()
    with pytest.raises(OutputError, match="nothing named 'speed' to colour by: it has heat, displacement"):
        preview(path, tmp_path / "out.png", color="speed")


SOLIDS = """
def Plane "floor" {
    uniform token axis = "%s"
}
def Cube "block" {
    double size = 3
    double3 xformOp:scale = (%s, 2, 1)
    double3 xformOp:translate = (100, 0, 0)
    uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:scale"]
}
def Sphere "ball" {
    double radius = 50
}
def Cone "cone" {
}
"""


@pytest.mark.parametrize(("axis", "scale"), [("X", 1), ("Y", -1), ("Z", 1)])
def test_solids_stand_where_they_are(tmp_path: Path, axis: str, scale: int) -> None:
    stage = read_pictured_stage(write(tmp_path, STAGE + SOLIDS % (axis, scale)))
    _, floor, block, ball = stage.standing
    assert [own.is_plane for own in stage.standing] == [False, True, False, False]
    a, b, c = floor.corners.transpose(1, 0, 2)
    assert np.cross(b - a, c - a)[:, "XYZ".index(axis)] == pytest.approx([4e-4, 4e-4])  # a square of 2 cm
    for own, volume, middle in ((block, 54e-6, (1.0, 0.0, 0.0)), (ball, 4 / 3 * np.pi * 0.125, (0.0, 0.0, 0.0))):
        assert np.linalg.det(own.corners - middle).sum() / 6 == pytest.approx(volume, rel=0.02)  # outward
        assert 0.5 * (own.corners.min(axis=(0, 1)) + own.corners.max(axis=(0, 1))) == pytest.approx(middle, abs=1e-9)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("points.timeSamples", "other.timeSamples", "no mesh whose points move"),
        ("[4, 3, 3]", "[4, 3, 2]", "lacks faces of at least three corners in /set/sheet"),
        ("[4, 3, 3]", "[4, 3, 4]", "lacks faces of at least three corners in /set/sheet"),
        ("[0, 1, 4, 3,", "[0, 1, 9, 3,", "lacks indices of its 6 points in /set/sheet"),
        ("(100, 100, 50)]", "(100, 100, inf)]", "lacks points of /set/sheet at 18"),
        (", (100, 100, 50)]", "]", "lacks the same number of points of /set/sheet at all times"),
        ("[0, 1, 2, 3]", "[0, 1, 2, 4]", "indices are outside of its 4 points"),
        ("timeCodesPerSecond = 48", "timeCodesPerSecond = -1", "lacks a number of frames per second"),
    ],
)
def test_damaged_stages_are_refused(tmp_path: Path, old: str, new: str, message: str) -> None:
    text = STAGE.replace(old, new)
    assert text != STAGE
    with pytest.raises(OutputError, match=message):
        read_pictured_stage(write(tmp_path, text))
