"""Previews: what is in the pictures, where it is, and how long it is shown."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest
from pxr import Sdf, Usd, UsdGeom

from warpfem.boundary import BoxWalls, Obstacle, Plane, Sphere
from warpfem.cli import parser
from warpfem.errors import MissingExtraError, OutputError
from warpfem.mesh import Mesh
from warpfem.preview import CAMERAS, MOST_FRAMES, preview
from warpfem.preview.camera import USUAL
from warpfem.preview.coloring import Coloring
from warpfem.preview.page import Page
from warpfem.preview.scene import Scene
from warpfem.usd import BodyFrame, ColorScale, UsdBody, UsdWriter, read_pictured_stage

Image = pytest.importorskip("PIL.Image")
pytest.importorskip("matplotlib")

MESHES = {2: Mesh.rectangle((1.0, 1.0), (3, 3)), 3: Mesh.box((1.0, 1.0, 1.0), (3, 3, 3))}
OBSTACLES: dict[int, list[Obstacle]] = {
    2: [Plane((0.0, -0.1), (0.1, 1.0)), Sphere((1.5, 0.2), 0.4), BoxWalls((-1.0, -0.5), (3.0, 3.0))],
    3: [Plane((0, -0.1, 0), (0.1, 1, 0)), Sphere((1.5, 0.2, 0), 0.4), BoxWalls((-1, -0.5, -1), (3, 3, 3))],
}
PANEL = (249, 250, 251)
BARS = 136
"""Width of what is at the right of the panels."""


@pytest.fixture(autouse=True)
def small_panels(monkeypatch: pytest.MonkeyPatch) -> None:
    """A quarter of the usual number of pixels, for speed."""
    monkeypatch.setattr("warpfem.preview.camera.PANEL_PIXELS", 50_000)


def write(
    path: Path,
    dim: int = 3,
    frame_count: int = 8,
    move: Callable[[np.ndarray, int], np.ndarray] = lambda points, index: points + 0.1 * index,
    von_mises: float = 1e4,
    fps: float = 25.0,
    **settings,
) -> Path:
    """Writes a square or a cube that moves, with the same stress everywhere."""
    mesh = MESHES[dim]
    body = UsdBody("block", mesh.points, mesh.cells, mesh.boundary_faces if dim == 3 else mesh.cells)
    cells = np.ones(mesh.cell_count)
    with UsdWriter(path, [body], fps=fps, color_range=(0.0, 2e4), **settings) as writer:
        for index in range(frame_count):
            points = move(mesh.points, index)
            writer.write_frame([BodyFrame(points, np.zeros_like(points), von_mises * cells, cells)])
    return path


def pictures(path: Path) -> tuple[list[np.ndarray], list[int]]:
    """The frames of a picture without its bars, (height, width, 3) int, and their durations [ms]."""
    frames, durations = [], []
    with Image.open(path) as file:
        for index in range(getattr(file, "n_frames", 1)):
            file.seek(index)
            frames.append(np.asarray(file.convert("RGB")).astype(int)[:, :-BARS])
            durations.append(file.info.get("duration", 0))
    return frames, durations


def colored(picture: np.ndarray) -> np.ndarray:
    """The mask of the pixels that belong to bodies: all else is grey."""
    return np.ptp(picture, axis=2) > 25


def drawn(picture: np.ndarray) -> np.ndarray:
    """The mask of the pixels of the panels that are not background."""
    return (np.abs(picture - PANEL).max(axis=2) > 5)[24:-8, 8:-8]


def center(mask: np.ndarray) -> np.ndarray:
    """Mean row and column."""
    return np.argwhere(mask).mean(axis=0)


def panel_counts(picture: np.ndarray) -> tuple[int, int]:
    """Rows and columns of panels, along the margins inside of their left and upper borders."""
    lines = (picture[:, 9] == PANEL).all(axis=1), (picture[25] == PANEL).all(axis=1)
    rows, columns = (int(np.sum(line[1:] & ~line[:-1])) for line in lines)
    return rows, columns


def moved_by(*steps: Sequence[float]) -> Callable[[np.ndarray, int], np.ndarray]:
    return lambda points, index: points + steps[index]


@pytest.mark.parametrize("dim", [2, 3])
def test_a_sheet_shows_six_frames_and_clips_nothing(tmp_path: Path, dim: int) -> None:
    path = write(tmp_path / "run.usdc", dim, 14, obstacles=OBSTACLES[dim])
    out = tmp_path / "sheet.png"
    assert preview(path, out) == out
    (sheet,), _ = pictures(out)
    assert panel_counts(sheet) == (2, 3)
    height, width = (sheet.shape[0] - 8) // 2, (sheet.shape[1] - 8) // 3
    assert 48_000 < (height - 24) * (width - 8) < 52_000
    centers = []
    for row, column in np.ndindex(2, 3):
        panel = sheet[24 + row * height : (row + 1) * height, 8 + column * width : (column + 1) * width]
        for border in (panel[0], panel[-1], panel[:, 0], panel[:, -1]):
            assert (border == PANEL).all()
        assert colored(panel).mean() > 0.02
        centers.append(center(colored(panel)))
    assert (np.diff(centers, axis=0)[:, 0] < -2).all()  # it rises


@pytest.mark.parametrize(("frame_count", "frames", "panels"), [(1, None, 1), (4, None, 4), (9, 2, 2), (3, 100, 3)])
def test_a_sheet_has_as_many_panels_as_there_are_frames(tmp_path: Path, frame_count, frames, panels) -> None:
    path = write(tmp_path / "run.usdc", 2, frame_count)
    (sheet,), _ = pictures(preview(path, tmp_path / "sheet.png", frames=frames))
    assert np.prod(panel_counts(sheet)) == panels


@pytest.mark.parametrize(
    ("fps", "frame_count", "durations"),
    [
        (25.0, 3, [40, 40, 40]),
        (24.0, 6, [40, 40, 40, 50, 40, 40]),  # hundredths of a second, in step with the clock
        (200.0, 200, [20] * 50),  # every fourth frame
        (2.0, 1, [500]),
    ],
)
def test_a_gif_keeps_the_time(tmp_path: Path, fps: float, frame_count: int, durations: list[int]) -> None:
    path = write(tmp_path / "run.usdc", 2, frame_count, fps=fps)
    frames, found = pictures(preview(path, tmp_path / "film.gif"))
    assert found == durations
    assert sum(durations) == pytest.approx(1000.0 * frame_count / fps, abs=5.0)
    heights = [center(colored(frame))[0] for frame in frames]
    assert (np.diff(heights) < 0).all()


@pytest.mark.parametrize(
    ("fps", "frame_count", "each"),
    [(200.0, 10, 40), (1e5, 3, 40), (0.1, 2, 500)],  # runs of less than a second, and frames of more than half of one
)
def test_a_gif_is_slowed_down_or_sped_up_where_one_would_see_nothing(tmp_path: Path, fps, frame_count, each) -> None:
    path = write(tmp_path / "run.usdc", 2, frame_count, fps=fps)
    assert pictures(preview(path, tmp_path / "film.gif"))[1] == [each] * frame_count


def test_a_long_gif_is_thinned(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write(tmp_path / "run.usdc", 2, 11)
    assert MOST_FRAMES == {".png": 6, ".gif": 120, ".mp4": 480}
    monkeypatch.setitem(MOST_FRAMES, ".gif", 5)
    assert pictures(preview(path, tmp_path / "film.gif"))[1] == [120, 120, 120, 80]
    assert pictures(preview(path, tmp_path / "film.gif", frames=2))[1] == [240, 200]


@pytest.mark.parametrize(("dim", "up_axis"), [(2, "Y"), (3, "Y"), (3, "Z")])
def test_bodies_move_and_the_camera_does_not(tmp_path: Path, dim: int, up_axis: str) -> None:
    up = np.eye(dim)[1 if up_axis == "Y" else 2]
    along = np.eye(dim)[0]
    path = write(
        tmp_path / "run.usdc",
        dim,
        3,
        move=moved_by(0 * up, 2 * up, 2 * up + 2 * along),
        obstacles=[Plane(0 * up, up)],
        up_axis=up_axis,
    )
    (first, raised, shifted), _ = pictures(preview(path, tmp_path / "film.gif"))
    masks = [colored(frame) for frame in (first, raised, shifted)]
    size = np.ptp(np.argwhere(masks[0]), axis=0) + 1
    rise = center(masks[1]) - center(masks[0])
    shift = center(masks[2]) - center(masks[1])
    assert rise[1] == pytest.approx(0.0, abs=1.0)
    assert shift[1] > 0.0
    if dim == 2:
        assert [-rise[0], shift[1]] == pytest.approx(2 * size, rel=0.02)
        assert shift[0] == pytest.approx(0.0, abs=1.0)
        elsewhere = ~(masks[0] | masks[1])
        elsewhere[:24] = False  # the time
        assert np.abs(first - raised)[elsewhere].mean() < 0.5
    else:  # a cube seen from above at 20 degrees, 28 degrees from the side
        vertical, across, sideways = np.cos(np.radians(20)), np.cos(np.radians(28)), np.sin(np.radians(28))
        assert size[1] / -rise[0] == pytest.approx((across + sideways) / (2 * vertical), rel=0.02)
        assert shift[1] / -rise[0] == pytest.approx(across / vertical, rel=0.02)
        slope = np.sin(np.radians(20)) * sideways / vertical
        assert shift[0] / -rise[0] == pytest.approx(slope, rel=0.05)


@pytest.mark.parametrize("offset", [0.0, 1e5])
def test_the_view_fits_what_it_shows(tmp_path: Path, offset: float) -> None:
    path = write(tmp_path / "run.usdc", 2, 1, move=lambda points, index: points + offset)
    panel = drawn(pictures(preview(path, tmp_path / "sheet.png"))[0][0])
    first, last = (end(np.argwhere(panel), axis=0) for end in (np.min, np.max))
    assert first == pytest.approx(np.array(panel.shape) - 1 - last, abs=2)
    assert (last + 1 - first) / panel.shape == pytest.approx(1 / 1.06, abs=0.01)


@pytest.mark.parametrize("value", [4e3, 2e4])
def test_colors_are_those_of_the_scale(tmp_path: Path, value: float) -> None:
    expected = np.round(255 * ColorScale("von_mises", 0.0, 2e4).srgb(np.array([value])))[0]
    for dim in (2, 3):
        path = write(tmp_path / "run.usdc", dim, 1, von_mises=value)
        (sheet,), _ = pictures(preview(path, tmp_path / "sheet.png"))
        shades, counts = np.unique(sheet[colored(sheet)], axis=0, return_counts=True)
        shade = shades[counts.argmax()]
        assert (counts > 0.1 * counts.sum()).sum() == (1 if dim == 2 else 3)  # each face of the cube has its own
        if dim == 2:
            assert np.abs(shade - expected).max() <= 1
        else:  # the same hue, in light and shade
            assert shade / shade.max() == pytest.approx(expected / expected.max(), abs=0.02)
            assert 0.5 < shade.max() / expected.max() <= 1.0


def test_the_bar_shows_the_scale_of_the_animation(tmp_path: Path) -> None:
    bars = []
    for quantity in ("von_mises", "jacobian"):
        path = write(tmp_path / "run.usdc", 2, 1, color_by=quantity)
        with Image.open(preview(path, tmp_path / "sheet.png")) as sheet:
            bars.append(np.asarray(sheet.convert("RGB"))[:, -BARS:])
        scale = ColorScale(quantity, 0.0, 2e4)
        for value, row in ((2e4, 26), (0.0, len(bars[-1]) - 60 - 3)):
            found = bars[-1][row, 10 + 7]
            assert found == pytest.approx(255 * scale.srgb(np.array([value]))[0], abs=16)
    assert not np.array_equal(bars[0][:, 60:], bars[1][:, 60:])  # the words


def test_a_floor_hides_what_sank_into_it(tmp_path: Path) -> None:
    down = np.array([0.0, -0.8, 0.0])
    path = write(tmp_path / "run.usdc", 3, 2, move=moved_by(0 * down, down), obstacles=[Plane((0, 0, 0), (0, 1, 0))])
    (above, sunk), _ = pictures(preview(path, tmp_path / "film.gif"))
    runs = []
    for frame in (above, sunk):
        mask = colored(frame)
        column = mask[:, round(center(mask)[1])]
        runs.append(np.sum(column[1:] & ~column[:-1]))
    assert runs == [1, 2]  # one sees the floor between the parts above and below it


def test_a_shadow_lies_straight_below_the_body(tmp_path: Path) -> None:
    heights = np.array([[0.0, 0.0, 0.0], [0.0, 0.3, 0.0], [0.0, 0.6, 0.0]])
    path = write(tmp_path / "run.usdc", 3, 3, move=moved_by(*heights), obstacles=[Plane((0, -0.1, 0), (0, 1, 0))])
    frames, _ = pictures(preview(path, tmp_path / "film.gif"))
    shadows = [((frame.max(axis=2) < 170) & ~colored(frame))[24:] for frame in frames]
    floor = frames[2][(np.ptp(frames[2], axis=2) < 4) & (np.abs(frames[2][..., 0] - 195) < 20)]
    assert (np.unique(floor[:, 0], return_counts=True)[1] > 0.2 * len(floor)).sum() == 2  # tiles
    low, middle, high = (shadow.sum() for shadow in shadows)
    assert 0 < low < 0.7 * middle  # the body hides the rest
    assert middle == pytest.approx(high, rel=0.02)
    assert center(shadows[2]) == pytest.approx(center(shadows[1]), abs=1.0)
    assert center(shadows[2])[1] == pytest.approx(center(colored(frames[2]))[1], abs=1.0)


@pytest.mark.parametrize("dim", [2, 3])
def test_what_is_inside_out_is_magenta(tmp_path: Path, dim: int) -> None:
    mirror = np.array([-1.0, 1.0, 1.0])[:dim]
    path = write(tmp_path / "run.usdc", dim, 2, move=lambda points, index: points * mirror**index)
    frames, _ = pictures(preview(path, tmp_path / "film.gif"))
    magenta = [((frame[..., 0] > 140) & (frame[..., 1] < 40) & (frame[..., 2] > 140)).sum() for frame in frames]
    assert magenta[0] == 0
    assert magenta[1] > 0.7 * colored(frames[1]).sum()


@pytest.mark.parametrize("dim", [2, 3])
def test_obstacles_do_not_dwarf_the_body(tmp_path: Path, dim: int) -> None:
    alone = np.zeros(dim)
    up = np.eye(dim)[1]
    ground = [Plane(alone, up), Sphere(-100.0 * up, 100.0)]
    plain, near, far = (
        pictures(preview(write(tmp_path / "run.usdc", dim, 1, obstacles=obstacles), tmp_path / "sheet.png"))[0][0]
        for obstacles in ([], ground, [Sphere(40.0 * up, 1.0), Plane(-5.0 * up, up)])
    )
    assert np.array_equal(plain, far)
    assert drawn(near).sum() > 1.2 * colored(near).sum()
    assert colored(near).sum() > 0.3 * drawn(near).size * drawn(plain).mean()


def test_a_slope_is_seen_from_the_side_that_it_faces(tmp_path: Path) -> None:
    masks = []
    for side in (1.0, -1.0):
        mirror = np.array([side, 1.0, 1.0])
        path = write(
            tmp_path / "run.usdc",
            3,
            1,
            move=lambda points, index: points - 0.5,
            obstacles=[Plane((0, -1, 0), mirror * (0.6, 1.0, 0.0))],
        )
        masks.append(drawn(pictures(preview(path, tmp_path / "sheet.png"))[0][0]))
    assert (masks[0] == masks[1][:, ::-1]).mean() > 0.99
    assert 0.1 < masks[0].mean() < 0.9


def test_a_wall_in_front_is_glass(tmp_path: Path) -> None:
    walls = [[], [Plane((0.0, 0.0, 1.1), (0.0, 0.0, -1.0))]]
    open_view, through = (
        pictures(preview(write(tmp_path / "run.usdc", 3, 1, obstacles=wall), tmp_path / "sheet.png"))[0][0]
        for wall in walls
    )
    glass = np.abs(through - 0.8 * np.array(PANEL) - 0.2 * 150).max(axis=2) < 3
    assert glass.mean() > 0.05
    assert colored(through).mean() > 0.3 * colored(open_view).mean()


@pytest.mark.parametrize(
    ("camera", "right", "up"),
    [  # where x, y and z go in the image
        ("front", (1, 0, 0), (0, 1, 0)),
        ("0,0", (1, 0, 0), (0, 1, 0)),
        ("right", (0, 0, -1), (0, 1, 0)),
        ("back", (-1, 0, 0), (0, 1, 0)),
        ("left", (0, 0, 1), (0, 1, 0)),
        ("-90,0", (0, 0, 1), (0, 1, 0)),
        ("top", (1, 0, 0), (0, 0, -1)),
        ("bottom", (1, 0, 0), (0, 0, 1)),
        ("45,0", (0.5**0.5, 0, -(0.5**0.5)), (0, 1, 0)),
    ],
)
def test_the_camera_is_where_it_is_told_to_be(tmp_path: Path, camera: str, right, up) -> None:
    path = write(tmp_path / "run.usdc", 3, 4, move=moved_by((0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)))
    frames, _ = pictures(preview(path, tmp_path / "film.gif", camera=camera))
    places = [center(colored(frame)) for frame in frames]
    meter = np.ptp(np.argwhere(colored(frames[0]))[:, 0]) + 1  # the height of the cube
    for axis in range(3):
        down, across = (places[1 + axis] - places[0]) / meter
        assert [across, -down] == pytest.approx([right[axis], up[axis]], abs=0.03)


def test_the_camera_and_the_elevation_count_from_the_side_that_z_up_has_in_front(tmp_path: Path) -> None:
    path = write(tmp_path / "run.usdc", 3, 2, move=moved_by((0, 0, 0), (0, 0, 1)), up_axis="Z")
    frames, _ = pictures(preview(path, tmp_path / "film.gif", camera="front"))
    down, across = center(colored(frames[1])) - center(colored(frames[0]))
    assert down < -20 and abs(across) < 1


@pytest.mark.parametrize(("normal", "below"), [((0, 1, 0), True), ((0, -1, 0), False)])
def test_a_floor_that_is_seen_from_its_side_is_a_band(tmp_path: Path, normal, below: bool) -> None:
    path = write(tmp_path / "run.usdc", 3, 1, obstacles=[Plane((0, -0.05 if below else 1.05, 0), normal)])
    (sheet,), _ = pictures(preview(path, tmp_path / "sheet.png", camera="front"))
    band = drawn(sheet) & ~colored(sheet)[24:-8, 8:-8]
    body = np.argwhere(colored(sheet)[24:-8, 8:-8])
    rows = np.flatnonzero(band.mean(axis=1) > 0.8)
    assert 3 <= len(rows) <= 5
    assert (rows > body[:, 0].max()).all() if below else (rows < body[:, 0].min()).all()


@pytest.mark.parametrize("camera", ["side", "", "30", "30,20,10", "30,91", "nan,0", "inf,0", "a,b"])
def test_unknown_cameras_are_refused(tmp_path: Path, camera: str) -> None:
    with pytest.raises(OutputError, match="a camera is one of front, right, back, left, top, bottom, or AZIMUTH"):
        preview(tmp_path / "missing.usdc", tmp_path / "sheet.png", camera=camera)


def test_a_2d_animation_takes_no_camera(tmp_path: Path) -> None:
    path = write(tmp_path / "run.usdc", 2, 1)
    with pytest.raises(OutputError, match="is 2D, which has no other camera"):
        preview(path, tmp_path / "sheet.png", camera="top")
    assert list(tmp_path.iterdir()) == [path]


def test_colors_show_any_scalar_of_the_file(tmp_path: Path) -> None:
    """A number per face that an other program added: one colour per cell, from one end of the table to the other."""
    path = write(tmp_path / "run.usda", 2, 1)
    face_count = len(MESHES[2].cells)
    stage = Usd.Stage.Open(str(path))
    surface = stage.GetPrimAtPath("/World/block/block_surface")
    heat = UsdGeom.PrimvarsAPI(surface).CreatePrimvar("heat", Sdf.ValueTypeNames.IntArray, UsdGeom.Tokens.uniform)
    heat.Set([-3 if face % 2 else 7 for face in range(face_count)])
    stage.Save()
    (sheet,), _ = pictures(preview(path, tmp_path / "sheet.png", color="heat"))
    shades, counts = np.unique(sheet[colored(sheet)], axis=0, return_counts=True)
    table = 255 * ColorScale("von_mises", -3.0, 7.0).srgb(np.array([-3.0, 7.0]))
    for shade in table:
        assert np.abs(shades[counts > 0.3 * counts.sum()] - shade).max(axis=1).min() <= 1


@pytest.mark.parametrize(
    ("color", "lower", "upper"),
    [
        ("displacement", 0.0, 2.0 * 2.0**0.5),  # of the last frame
        ("speed", 0.0, 1.0),  # nothing moves: a range of some width
        ("vonMises", 0.0, 1e4),
        ("vonMisesPoint", 0.0, 1e4),
        ("J", 0.0, 2.0),
        (None, 0.0, 2e4),  # that of the file
    ],
)
def test_the_range_of_the_colors_is_that_of_all_frames(tmp_path: Path, color, lower: float, upper: float) -> None:
    path = write(tmp_path / "run.usdc", 2, 3, move=lambda points, index: points + index)
    scale = Coloring.of(read_pictured_stage(path), color).scale
    assert (scale.lower, scale.upper) == pytest.approx((lower, upper))


def test_unknown_colors_are_refused_with_those_that_there_are(tmp_path: Path) -> None:
    path = write(tmp_path / "run.usdc", 2, 1)
    for name in ("stress", "displayColor"):  # a colour is no number
        with pytest.raises(OutputError, match=f"nothing named '{name}' .* J, JPoint, vonMises, vonMisesPoint, displ"):
            preview(path, tmp_path / "sheet.png", color=name)


def test_equilibria_are_counted_and_shown_long_enough(tmp_path: Path) -> None:
    path = write(tmp_path / "run.usdc", 2, 3, equilibria=True)
    stage = read_pictured_stage(path)
    assert stage.equilibria
    assert not read_pictured_stage(write(tmp_path / "motion.usdc", 2, 3)).equilibria
    assert pictures(preview(path, tmp_path / "film.gif"))[1] == [500] * 3
    coloring = Coloring.of(stage, None)
    page = Page(coloring, Scene(coloring, None).view, 3)
    page.show([np.zeros((9, 9, 3))] * 3, range(3))
    assert [axes.get_title() for axes in page.figure.axes[:3]] == ["start", "load step 1 of 2", "load step 2 of 2"]


@pytest.mark.parametrize(
    ("fps", "frame_count", "shown", "rate"),
    [(24.0, 30, 30, 24.0), (100.0, 100, 50, 50.0), (0.1, 2, 2, 2.0)],
)
def test_an_mp4_shows_the_motion(tmp_path: Path, fps: float, frame_count: int, shown: int, rate: float) -> None:
    encoder = pytest.importorskip("imageio_ffmpeg")
    path = write(tmp_path / "run.usdc", 2, frame_count, fps=fps)
    film = encoder.read_frames(str(preview(path, tmp_path / "film.mp4")))
    facts = next(film)
    width, height = facts["size"]
    assert width % 2 == 0 and height % 2 == 0
    assert facts["fps"] == pytest.approx(rate, rel=1e-3)
    assert facts["codec"] == "h264"
    frames = [np.frombuffer(frame, np.uint8).reshape(height, width, 3)[:, :-BARS].astype(int) for frame in film]
    assert len(frames) == shown
    heights = [center(colored(frame))[0] for frame in frames]
    assert (np.diff(heights) < 0).all()
    assert sorted(tmp_path.iterdir()) == [tmp_path / "film.mp4", path]


def test_an_mp4_without_its_encoder_names_the_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with pytest.raises(MissingExtraError, match=r"a film as \.mp4 needs .*'imageio-ffmpeg'.*warpfem\[video\]"):
        preview(write(tmp_path / "run.usdc", 2, 1), tmp_path / "film.mp4")


def test_help_names_the_cameras(capsys: pytest.CaptureFixture) -> None:
    with pytest.raises(SystemExit):
        parser().parse_args(["preview", "--help"])
    text = " ".join(capsys.readouterr().out.split())
    for camera in CAMERAS:
        assert camera in text
    assert f"default: {USUAL[0]:g},{USUAL[1]:g}" in text


@pytest.mark.parametrize("package", ["matplotlib", "PIL"])
def test_missing_packages_name_the_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, package: str) -> None:
    path = write(tmp_path / "run.usdc", 2, 1)
    for module in [name for name in sys.modules if name.split(".")[0] == package]:
        monkeypatch.delitem(sys.modules, module)
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(MissingExtraError, match=r"drawing a preview needs .*warpfem\[plot\]"):
        preview(path, tmp_path / "sheet.png")


@pytest.mark.parametrize(
    ("out", "frames", "message"),
    [
        ("sheet.jpg", None, r"must end in \.png, \.gif, \.mp4"),
        ("sheet", None, r"must end in \.png, \.gif, \.mp4"),
        ("nowhere/sheet.png", None, "folder does not exist"),
        ("folder.png", None, "is a folder"),
        ("sheet.png", 0, "at least 1 frame, not 0"),
    ],
)
def test_pictures_that_cannot_be_written_are_refused_first(tmp_path: Path, out: str, frames, message: str) -> None:
    (tmp_path / "folder.png").mkdir()
    with pytest.raises(OutputError, match=message):
        preview(tmp_path / "missing.usdc", tmp_path / out, frames=frames)


def test_files_that_cannot_be_drawn_are_errors(tmp_path: Path) -> None:
    empty = write(tmp_path / "empty.usdc", 2, 0)
    other = tmp_path / "other.usda"
    other.write_text("#usda 1.0\n")
    for path, message in (
        (tmp_path / "missing.usdc", "no such file"),
        (other, "no mesh whose points move"),
        (empty, "no frames"),
    ):
        with pytest.raises(OutputError, match=message):
            preview(path, tmp_path / "sheet.png")
    assert not (tmp_path / "sheet.png").exists()
