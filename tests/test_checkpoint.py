"""Runs that are killed, interrupted or resumed: nothing is lost, and the result is that of one run, bit for bit."""

from __future__ import annotations

import itertools
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
import warp as wp
from pxr import Sdf

import warpfem as wf
from warpfem.checkpoint import Checkpoint, checkpoint_path
from warpfem.cli import main, parser
from warpfem.commands.run import _recipe
from warpfem.commands.session import FAILED, OK, WRONG_USE
from warpfem.failure import failure_path
from warpfem.files import settle
from warpfem.scene_file import load_scene
from warpfem.simulation import Summary
from warpfem.usd import Animation, partial_path

FRAMES = 9
WALL_TIMES = ("setup_seconds", "stepping_seconds")
SOLVERS = {
    "backward_euler": wf.BackwardEuler(),
    "linearised": wf.BackwardEuler.linearised(),
    "implicit_midpoint": wf.ImplicitMidpoint(),
    "sdirk3": wf.SDIRK3(),
    "error target": wf.SDIRK2(error=1e-2),
    "velocity_verlet": wf.VelocityVerlet(),
    "symplectic_euler": wf.SymplecticEuler(),
}


def push(rest: np.ndarray, time: float) -> np.ndarray:
    return rest + np.array((0.3, -0.4)) * time


def press(rest: np.ndarray, time: float) -> np.ndarray:
    return rest + np.array((0.3, -0.5)) * time


def pushed_block(solver: wf.solvers.base.Solver = SOLVERS["velocity_verlet"], **settings) -> wf.Scene:
    """A block that is pushed over a rough floor by its lid: contact, friction, prescribed motion and damping."""
    settings = {"frames": FRAMES, "fps": 20.0, "damping": 0.5, "gravity": (0.0, -9.81), **settings}
    body = {
        "mesh": wf.Mesh.rectangle((1.0, 0.5), (4, 2), (0.0, 0.01)),
        "material": wf.StableNeoHookean(E=2e4, nu=0.3),
        "supports": [wf.PrescribedMotion("top", push)],
        "loads": [wf.Traction("left", (50.0, 0.0))],
        "velocity": (0.1, 0.0),
    }
    own = (*body, "density", "displacement", "element")
    body |= {name: settings.pop(name) for name in list(settings) if name in own}
    floor = settings.pop("floor", wf.Plane((0.0, 0.0), (0.0, 1.0), friction=0.4))
    return wf.Scene([wf.Body("block", **body)], solver, obstacles=[floor], **settings)


def text(path: Path) -> str:
    """Every attribute of every prim, with all samples."""
    return Sdf.Layer.OpenAsAnonymous(str(path)).ExportToString()


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def figures(summary: Summary) -> dict:
    return {name: value for name, value in summary.totals().items() if name not in WALL_TIMES}


def stop(simulation: wf.Simulation, out: Path, last: int, **settings) -> None:
    """Runs up to a frame and closes the file, as Ctrl-C does."""
    with closing(wf.record(simulation, out, **settings)) as frames:
        for frame in frames:
            if frame.index == last:
                break


def kill(scene: wf.Scene, out: Path, last: int, every: int, dtype="float32", **settings) -> None:
    """Leaves in the folder of ``out`` what a kill right after a frame does."""
    elsewhere = out.parent / "elsewhere"
    elsewhere.mkdir()
    with closing(
        wf.record(wf.Simulation(scene, dtype=dtype), elsewhere / out.name, checkpoint_every=every, **settings)
    ) as frames:
        next(frame for frame in frames if frame.index == last)
        for path in elsewhere.iterdir():
            (shutil.copytree if path.is_dir() else shutil.copy)(path, out.parent / path.name)
    shutil.rmtree(elsewhere)


def finish(scene: wf.Scene, out: Path, **settings) -> wf.Simulation:
    simulation = wf.Simulation(scene, dtype=settings.pop("dtype", "float32"))
    for _ in wf.record(simulation, out, **settings):
        pass
    return simulation


def assert_same(resumed: wf.Simulation, out: Path, whole: wf.Simulation, reference: Path) -> None:
    for name in ("u", "v"):
        ours, theirs = (getattr(one.state, name).numpy() for one in (resumed, whole))
        assert ours.tobytes() == theirs.tobytes()
    assert resumed.state.time == whole.state.time
    assert text(out) == text(reference)
    assert figures(resumed.summary) == figures(whole.summary)


@pytest.fixture(scope="module")
def reference(tmp_path_factory) -> tuple[wf.Simulation, Path]:
    """The block's run without a stop."""
    out = tmp_path_factory.mktemp("reference") / "run.usdc"
    return finish(pushed_block(), out), out


@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize("solver", SOLVERS)
def test_a_resumed_run_is_the_uninterrupted_one_bit_for_bit(tmp_path: Path, solver: str, dtype: str) -> None:
    scene, whole_file, out = pushed_block(SOLVERS[solver]), tmp_path / "whole.usdc", tmp_path / "run.usdc"
    whole = finish(scene, whole_file, dtype=dtype, checkpoint_every=3)
    assert whole.summary.largest_penetration > 0.0  # it does touch the floor
    kill(scene, out, last=5, every=3, dtype=dtype)
    assert Checkpoint.read(checkpoint_path(out)).frame == 3
    assert not out.exists()
    resumed = wf.Simulation(scene, dtype=dtype)
    frames = list(wf.record(resumed, out, resume=True))
    assert [frame.index for frame in frames] == [4, 5, 6, 7, 8, 9]
    assert_same(resumed, out, whole, whole_file)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["run.usdc", "whole.usdc"]


@pytest.mark.parametrize("suffix", [".usdc", ".usda"])
def test_an_interrupted_run_goes_on_from_its_last_frame(tmp_path: Path, reference, suffix: str) -> None:
    out = tmp_path / f"run{suffix}"
    stop(wf.Simulation(pushed_block()), out, 4, checkpoint_every=3)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["run.checkpoint.npz", out.name]
    assert Animation(out).frame_count == 5
    stop(wf.Simulation(pushed_block()), out, 7, checkpoint_every=30, resume=True)  # and once more
    assert Animation(out).frame_count == 8
    resumed = wf.Simulation(pushed_block())
    assert [frame.index for frame in wf.record(resumed, out, resume=True)] == [8, 9]
    whole, whole_file = reference
    whole_text = text(whole_file)
    if suffix == ".usdc":
        assert_same(resumed, out, whole, whole_file)
    else:
        again = tmp_path / "again.usda"
        Sdf.Layer.OpenAsAnonymous(str(whole_file)).Export(str(again))
        assert again.read_text() == out.read_text() and whole_text
    assert not checkpoint_path(out).exists()


def test_an_interrupted_run_without_new_checkpoints_goes_on_from_the_old_one(tmp_path: Path, reference) -> None:
    out = tmp_path / "run.usdc"
    kill(pushed_block(), out, last=5, every=3)
    stop(wf.Simulation(pushed_block()), out, 7, resume=True)
    assert Checkpoint.read(checkpoint_path(out)).frame == 3
    assert Animation(out).frame_count == 8
    assert_same(finish(pushed_block(), out, resume=True), out, *reference)


def test_a_run_can_be_made_longer_but_not_shorter_than_its_checkpoint(tmp_path: Path, reference) -> None:
    out = tmp_path / "run.usdc"
    kill(pushed_block(frames=6), out, last=6, every=2)
    before = contents(tmp_path)
    with pytest.raises(wf.OutputError, match=r"of frame 6, but the run has only 5 frames"):
        finish(pushed_block(frames=5), out, resume=True)
    assert contents(tmp_path) == before
    assert_same(finish(pushed_block(), out, resume=True), out, *reference)


def test_a_checkpoint_at_the_last_frame_leaves_only_the_file_to_finish(tmp_path: Path, reference) -> None:
    out = tmp_path / "run.usdc"
    kill(pushed_block(), out, last=FRAMES, every=3)
    resumed = wf.Simulation(pushed_block())
    assert list(wf.record(resumed, out, resume=True)) == []
    assert_same(resumed, out, *reference)


def moments(monkeypatch: pytest.MonkeyPatch, folder: Path, snapshots: Path, action) -> int:
    """Copies a folder each time before and after a file is moved or removed in it while ``action`` runs."""
    count = itertools.count()

    def spied(function):
        def call(path, *arguments, **settings):
            if folder in Path(path).parents and Path(path).exists():
                shutil.copytree(folder, snapshots / str(next(count)))
                function(path, *arguments, **settings)
                shutil.copytree(folder, snapshots / str(next(count)))
            else:
                function(path, *arguments, **settings)

        return call

    with monkeypatch.context() as patch:
        patch.setattr("warpfem.files.os.replace", spied(os.replace))
        patch.setattr(Path, "unlink", spied(Path.unlink))
        patch.setattr("warpfem.usd.chunks.shutil.rmtree", spied(shutil.rmtree))
        action()
    return next(count)


@pytest.mark.parametrize("left_by", ["kill", "interrupt"])
def test_a_kill_at_any_moment_of_a_resumed_run_loses_nothing(tmp_path, monkeypatch, reference, left_by: str) -> None:
    """What is on the disk can be resumed at each moment from the first to the last."""
    monkeypatch.setattr("warpfem.usd.saved.read_animation", Animation)  # looks at nothing twice, which takes long
    folder, snapshots = tmp_path / "folder", tmp_path / "snapshots"
    folder.mkdir()
    out = folder / "run.usdc"
    if left_by == "kill":
        kill(pushed_block(), out, last=5, every=3)
    else:
        stop(wf.Simulation(pushed_block()), out, 3, checkpoint_every=3)
    count = moments(
        monkeypatch, folder, snapshots, lambda: finish(pushed_block(), out, checkpoint_every=3, resume=True)
    )
    assert count > 20
    finished, distinct = 0, set()
    for index in range(count):
        folder = snapshots / str(index)
        out = folder / "run.usdc"
        if not checkpoint_path(out).exists():  # the run had come to its end
            finished += 1
            assert text(out) == text(reference[1]) and len(list(folder.iterdir())) == 1
            continue
        frame = Checkpoint.read(checkpoint_path(out)).frame
        found = [Animation(path).frame_count for path in (partial_path(out), out) if path.exists()]
        assert max(found) > frame
        state = str(sorted(contents(folder).items()))
        if state not in distinct:
            distinct.add(state)
            finish(pushed_block(), out, resume=True)
            assert text(out) == text(reference[1])
    assert finished == 1 and len(distinct) > 8


# ---- what cannot be resumed


def other_bodies(**settings) -> wf.Scene:
    scene = pushed_block()
    body = wf.Body("brick", scene.bodies[0].mesh, scene.bodies[0].material, supports=scene.bodies[0].supports)
    return wf.Scene([body], scene.solver, frames=FRAMES, fps=20.0)


DIFFERENT = {
    "the solver": lambda: pushed_block(wf.SymplecticEuler()),
    "fps": lambda: pushed_block(fps=21.0),
    "dt": lambda: pushed_block(dt=1 / 160),
    "gravity": lambda: pushed_block(gravity=(0.0, -9.8)),
    "damping": lambda: pushed_block(damping=0.6),
    "the obstacles": lambda: pushed_block(floor=wf.Plane((0.0, 0.0), (0.0, 1.0), friction=0.5)),
    "color_by": lambda: pushed_block(color_by="jacobian"),
    "up_axis": lambda: pushed_block(up_axis="Z"),
    "the names of the bodies": other_bodies,
    "body 'block': the mesh": lambda: pushed_block(mesh=wf.Mesh.rectangle((1.0, 0.5), (4, 2), (0.0, 0.011))),
    "body 'block': the material": lambda: pushed_block(material=wf.StableNeoHookean(E=2e4, nu=0.31)),
    "body 'block': the element": lambda: pushed_block(element="averaged"),
    "body 'block': the density": lambda: pushed_block(density=1001.0),
    "body 'block': the supports": lambda: pushed_block(supports=[wf.PrescribedMotion("top", push, axes=(0,))]),
    "body 'block': the prescribed motion": lambda: pushed_block(supports=[wf.PrescribedMotion("top", press)]),
    "body 'block': the loads": lambda: pushed_block(loads=[wf.Traction("left", (51.0, 0.0))]),
    "body 'block': the initial displacement": lambda: pushed_block(displacement=(0.0, 0.0)),
    "body 'block': the initial velocity": lambda: pushed_block(velocity=(0.0, 0.0)),
}


@pytest.fixture(scope="module")
def killed(tmp_path_factory) -> Path:
    """A run that was killed after its frame 5, with a checkpoint of its frame 3."""
    out = tmp_path_factory.mktemp("killed") / "run.usdc"
    kill(pushed_block(), out, last=5, every=3)
    return out


@pytest.mark.parametrize("part", DIFFERENT)
def test_a_checkpoint_of_another_scene_is_refused_by_the_part_that_differs(killed: Path, part: str) -> None:
    before = contents(killed.parent)
    with pytest.raises(wf.OutputError) as caught:
        finish(DIFFERENT[part](), killed, resume=True)
    named = str(caught.value).split("of another run: ")[1].split(" differ")[0].split(", ")
    assert part in named
    allowed = {
        "fps": {"dt", "body 'block': the prescribed motion"},
        "body 'block': the mesh": {"body 'block': the prescribed motion"},  # known by the places it gives
        "the names of the bodies": None,  # many more
    }.get(part, set())
    assert allowed is None or set(named) - {part} <= allowed
    assert contents(killed.parent) == before


def test_a_checkpoint_of_another_precision_or_energy_is_refused(killed: Path) -> None:
    with pytest.raises(wf.OutputError, match="of another run: the precision differs"):
        finish(pushed_block(), killed, dtype="float64", resume=True)


@pytest.mark.parametrize("bytes_left", [0, 1, 100, 1000, -1])
def test_a_truncated_checkpoint_is_refused(killed: Path, tmp_path: Path, bytes_left: int) -> None:
    shutil.copytree(killed.parent, tmp_path, dirs_exist_ok=True)
    out = tmp_path / killed.name
    path = checkpoint_path(out)
    path.write_bytes(path.read_bytes()[:bytes_left])
    before = contents(tmp_path)
    with pytest.raises(wf.OutputError, match=r"run\.checkpoint\.npz is damaged"):
        finish(pushed_block(), out, resume=True)
    assert contents(tmp_path) == before


def test_a_checkpoint_with_a_wrong_byte_is_refused_or_harmless(killed: Path, tmp_path: Path) -> None:
    whole = checkpoint_path(killed).read_bytes()
    good = Checkpoint.read(checkpoint_path(killed))
    path = tmp_path / "run.checkpoint.npz"
    refused = 0
    for position in random.Random(0).sample(range(len(whole)), 200):
        path.write_bytes(whole[:position] + bytes([whole[position] ^ 0x10]) + whole[position + 1 :])
        try:
            found = Checkpoint.read(path)
        except wf.OutputError as error:
            assert "damaged" in str(error)
            refused += 1
        else:
            np.testing.assert_array_equal(found.displacement, good.displacement)
            assert (found.frame, found.time, found.parts) == (good.frame, good.time, good.parts)
    assert refused > 100


def test_other_files_are_no_checkpoints(tmp_path: Path) -> None:
    path = tmp_path / "run.checkpoint.npz"
    with pytest.raises(wf.OutputError, match=r"there is no checkpoint .*--checkpoint-every"):
        Checkpoint.read(path)
    np.savez(path, header=np.array(json.dumps({"format": 99})))
    with pytest.raises(wf.OutputError, match="has format 99; this warpfem reads 1"):
        Checkpoint.read(path)
    np.savez(path, u=np.zeros(3))
    with pytest.raises(wf.OutputError, match="damaged"):
        Checkpoint.read(path)


@pytest.mark.parametrize("left", ["nothing", "another run", "a lost chunk", "too few frames"])
def test_frames_that_are_missing_are_said_before_anything_is_changed(killed, tmp_path, left: str) -> None:
    shutil.copytree(killed.parent, tmp_path, dirs_exist_ok=True)
    out = tmp_path / killed.name
    if left == "a lost chunk":
        (tmp_path / "run.partial" / "000000.usdc").unlink()
    else:
        partial_path(out).unlink()
        shutil.rmtree(tmp_path / "run.partial")
    if left == "another run":
        finish(pushed_block(velocity=(0.2, 0.0)), tmp_path / "other.usdc")
        settle(tmp_path / "other.usdc", out)
    if left == "too few frames":
        finish(pushed_block(frames=2), tmp_path / "other.usdc")
        settle(tmp_path / "other.usdc", out)
    before = contents(tmp_path)
    message = {
        "nothing": r"run\.usdc: .*no such file",
        "another run": r"run\.usdc is of another run: its .* differs in frame 3",
        "a lost chunk": r"run\.partial",
        "too few frames": r"run\.usdc holds 3 of the 4 frames",
    }[left]
    with pytest.raises(wf.OutputError, match=rf"the frames up to 3 are missing: .*{message}"):
        finish(pushed_block(), out, resume=True)
    assert contents(tmp_path) == before


def test_a_run_that_is_not_resumed_replaces_what_was_left(killed: Path, tmp_path: Path, reference) -> None:
    shutil.copytree(killed.parent, tmp_path, dirs_exist_ok=True)
    out = tmp_path / killed.name
    failure_path(out).write_text("an old one")
    for name in ("run.checkpoint.npz", "run.partial.usda", "run.failed.npz"):
        (tmp_path / f"writing.{name}").write_text("left by a kill in the middle of writing")
    assert_same(finish(pushed_block(), out), out, *reference)
    assert [path.name for path in tmp_path.iterdir()] == ["run.usdc"]


@pytest.mark.parametrize("every", [0, -1, 1.5, "3"])
def test_checkpoints_come_every_so_many_frames(tmp_path: Path, every) -> None:
    with pytest.raises(wf.OutputError, match="checkpoint_every must be a number of frames of at least 1"):
        finish(pushed_block(), tmp_path / "run.usdc", checkpoint_every=every)
    assert list(tmp_path.iterdir()) == []


def test_a_simulation_can_be_restored_without_a_file() -> None:
    first, whole, totals = wf.Simulation(pushed_block()), [], {}
    for frame in first.frames():
        whole.append(frame)
        if frame.index == 4:
            totals = first.summary.totals()
    simulation = wf.Simulation(pushed_block())
    state = whole[4]
    restored = simulation.restore(4, state.time, state.displacement, state.velocity)
    simulation.summary.take_up(totals)
    np.testing.assert_array_equal(restored.von_mises, state.von_mises)
    rest = list(simulation.frames())
    assert [frame.index for frame in rest] == [5, 6, 7, 8, 9]
    np.testing.assert_array_equal(rest[-1].displacement, whole[-1].displacement)


# ---- runs that fail


def collapse(rest: np.ndarray, time: float) -> np.ndarray:
    return rest * (1.0, 1.0 - 40.0 * time)


def failing(solver=None) -> wf.Scene:
    body = wf.Body(
        "square",
        wf.Mesh.rectangle((1.0, 1.0), (2, 2)),
        wf.NeoHookean(E=1e5, nu=0.3),
        supports=[wf.Pin("bottom"), wf.PrescribedMotion("top", collapse)],
    )
    return wf.Scene([body], solver or wf.VelocityVerlet(), dt=1e-3, fps=100, frames=10)


@pytest.mark.parametrize("solver", [wf.VelocityVerlet(), wf.BackwardEuler()], ids=["explicit", "implicit"])
def test_a_failed_run_keeps_the_good_frames_and_the_failing_state(tmp_path: Path, solver) -> None:
    out = tmp_path / "run.usdc"
    simulation = wf.Simulation(failing(solver))
    good = []
    with pytest.raises(wf.SimulationError) as caught:
        for frame in wf.record(simulation, out, checkpoint_every=1):
            good.append(frame)
    assert any(f"the state in which it failed is in {failure_path(out)}" in note for note in caught.value.__notes__)
    animation = Animation(out)
    assert animation.frame_count == len(good) >= 1
    stored = animation.frame(len(good) - 1)[0].points[:, :2]
    expected = simulation.model.rest_points + good[-1].displacement
    np.testing.assert_array_equal(stored.astype(np.float32), expected.astype(np.float32))
    with np.load(failure_path(out)) as failed:
        assert str(failed["message"]) == str(caught.value)
        assert failed["time"] == simulation.state.time >= good[-1].time
        assert failed["step"] == simulation.summary.steps
        np.testing.assert_array_equal(failed["displacement"], simulation.state.displacement)
        np.testing.assert_array_equal(failed["velocity"], simulation.state.velocity)
        np.testing.assert_array_equal(failed["rest_points"], simulation.model.rest_points)
        np.testing.assert_array_equal(failed["cells_0"], simulation.scene.bodies[0].mesh.cells)
        assert failed["bodies"].tolist() == ["square"] and failed["jacobian"].shape == (8,)
    assert Checkpoint.read(checkpoint_path(out)).frame == len(good) - 1


def test_the_failing_state_keeps_numbers_that_are_not_finite_and_the_attempt(tmp_path: Path, monkeypatch) -> None:
    simulation = wf.Simulation(pushed_block())

    def fail(state, dt, most):
        broken = state.displacement
        broken[3] = np.nan
        state.u.assign(broken.astype(np.float32))
        simulation.stepper.attempt = wp.full(len(broken), np.inf, dtype=wp.vec2f)
        raise wf.SimulationError("it broke")

    with pytest.raises(wf.SimulationError), closing(wf.record(simulation, tmp_path / "run.usdc")) as frames:
        next(frames)
        monkeypatch.setattr(simulation.stepper, "advance", fail)
        next(frames)
    with np.load(failure_path(tmp_path / "run.usdc")) as failed:
        assert np.isnan(failed["displacement"][3]).all() and np.isfinite(failed["displacement"][4]).all()
        assert np.isnan(failed["jacobian"]).any()
        assert np.isinf(failed["attempted_displacement"]).all()
    assert Animation(tmp_path / "run.usdc").frame_count == 1


# ---- the command


SCENE = """
import warpfem as wf

def lift(rest, time):
    return rest + (0.1 * time, 0, 0)

def scene(E: float = 1e4, frames: int = {frames}):
    mesh = wf.Mesh.box((1, 1, 1), (4, 4, 4), (0, 0.05, 0))
    body = wf.Body("cube", mesh, wf.StableNeoHookean(E=E, nu=0.3), supports=[wf.PrescribedMotion("left", lift, (0,))])
    floor = wf.Plane((0, 0, 0), (0, 1, 0), friction=0.5)
    return wf.Scene([body], wf.VelocityVerlet(), obstacles=[floor], gravity=(0, -9.81, 0), fps=100, frames=frames)
"""


@pytest.fixture
def scene_file(tmp_path: Path) -> Path:
    path = tmp_path / "cube.py"
    path.write_text(SCENE.format(frames=60))
    return path


def command(scene: Path, out: Path, *options: str) -> list[str]:
    every = ["--checkpoint-every", "4"]
    return [sys.executable, "-m", "warpfem", "run", str(scene), "--out", str(out), "--quiet", *every, *options]


def wait_for_frames(process: subprocess.Popen, out: Path, count: int) -> None:
    while process.poll() is None:
        if partial_path(out).is_file() and Animation(partial_path(out)).frame_count >= count:
            return
        time.sleep(0.05)
    raise AssertionError("the run ended before it could be stopped")


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGINT, signal.SIGTERM], ids=lambda number: number.name)
def test_a_stopped_command_is_resumed(tmp_path: Path, number: int) -> None:
    scene = tmp_path / "cube.py"
    scene.write_text(SCENE.format(frames=5000))
    out = tmp_path / "out" / "cube.usdc"
    process = subprocess.Popen(command(scene, out), stderr=subprocess.PIPE, text=True)
    wait_for_frames(process, out, 5)
    process.send_signal(number)
    _, printed = process.communicate(timeout=60)
    frame = Checkpoint.read(checkpoint_path(out)).frame
    if number == signal.SIGKILL:
        assert not out.exists()
    else:
        assert process.returncode == FAILED
        assert printed.startswith("warpfem: interrupted: ") and f"{frame + 1} frames are in {out}" in printed
        assert Animation(out).frame_count == frame + 1
        assert not partial_path(out).exists()
    total = str(frame + 6)
    whole = tmp_path / "whole.usdc"
    assert main(command(scene, whole, "--frames", total)[3:]) == OK
    assert main(command(scene, out, "--frames", total, "--resume")[3:]) == OK
    assert text(out) == text(whole)
    assert [path.name for path in out.parent.iterdir()] == ["cube.usdc"]


def last_change(folder: Path) -> int:
    return max((path.stat().st_mtime_ns for path in (folder, *folder.glob("*.partial")) if path.exists()), default=0)


@pytest.mark.slow
def test_twenty_kills_at_random_moments(scene_file: Path, tmp_path: Path) -> None:
    """Each run goes on where the one before was killed, and the file is that of a run without kills."""
    whole, out = tmp_path / "whole.usdc", tmp_path / "out" / "cube.usdc"
    options = ["--frames", "1500"]
    assert main(command(scene_file, whole, *options)[3:]) == OK
    moments = random.Random(4)
    kills, frames = 0, [0]
    while kills < 20:
        resume = ["--resume"] if checkpoint_path(out).exists() else ["--overwrite"]
        process = subprocess.Popen(command(scene_file, out, *options, *resume), stderr=subprocess.PIPE, text=True)
        before = last_change(out.parent)
        while process.poll() is None and last_change(out.parent) == before:
            time.sleep(0.005)
        time.sleep(moments.choice([0.0, moments.uniform(0.0, 0.5)]))
        if process.poll() is not None:
            break
        process.send_signal(signal.SIGKILL)
        _, printed = process.communicate()
        assert "Traceback" not in printed
        kills += 1
        if checkpoint_path(out).exists():
            frames.append(Checkpoint.read(checkpoint_path(out)).frame)
            assert frames[-1] >= frames[-2]
            found = [Animation(path).frame_count for path in (partial_path(out), out) if path.exists()]
            assert max(found) > frames[-1]
    assert kills >= 10
    if checkpoint_path(out).exists():
        assert main(command(scene_file, out, *options, "--resume")[3:]) == OK
    assert text(out) == text(whole)


WAYWARD = """
from pathlib import Path
import warpfem as wf

def scene(E: float = 1e4):
    path = Path({count!r})
    path.write_text(str(int(path.read_text()) + 1))
    size = 1 + 0.01 * int(path.read_text())
    mesh = wf.Mesh.box((size, 1, 1), (2, 2, 2)).with_point_set("base", lambda x: x[:, 1] < 0.1)
    body = wf.Body("cube", mesh, wf.StableNeoHookean(E=E, nu=0.3), supports=[wf.Pin("base")])
    return wf.Scene([body], wf.VelocityVerlet(), gravity=(0, -9.81, 0), fps=100, frames=4)
"""


def test_a_mesh_that_comes_out_different_each_time_is_that_of_the_checkpoint(tmp_path: Path, capsys) -> None:
    """As long as the scene file and its parameters are the same; else it is another scene."""
    scene, out, count = tmp_path / "cube.py", tmp_path / "cube.usdc", tmp_path / "count"
    count.write_text("0")
    scene.write_text(WAYWARD.format(count=str(count)))
    assert main(command(scene, tmp_path / "whole.usdc")[3:]) == OK
    count.write_text("0")
    interrupted = wf.Simulation(load_scene(scene))
    recipe = _recipe(parser().parse_args(["run", str(scene)]))
    stop(interrupted, out, 2, checkpoint_every=1, recipe=recipe)
    assert main(command(scene, out, "--resume", "--set", "E=1e4")[3:]) == WRONG_USE
    assert "of another run: body 'cube': the mesh" in capsys.readouterr().err
    assert main(command(scene, out, "--resume")[3:]) == OK
    assert int(count.read_text()) == 3  # it did come out different
    assert text(out) == text(tmp_path / "whole.usdc")


def test_a_command_that_cannot_resume_says_so_before_it_prepares(scene_file: Path, tmp_path: Path, capsys) -> None:
    out = tmp_path / "cube.usdc"
    arguments = ["run", str(scene_file), "--out", str(out), "--resume"]
    assert main(arguments) == WRONG_USE
    assert capsys.readouterr().err.startswith(f"warpfem: there is no checkpoint {checkpoint_path(out)}")
    kill(wf.Scene([pushed_block().bodies[0]], wf.BackwardEuler(), frames=3), out, last=2, every=1)
    assert main([*arguments, "--quiet"]) == WRONG_USE
    assert "is of another run: the solver" in capsys.readouterr().err
    with pytest.raises(SystemExit) as end:
        main([*arguments, "--overwrite"])
    assert end.value.code == WRONG_USE


@pytest.fixture
def terminal(monkeypatch: pytest.MonkeyPatch):
    """Makes the standard streams a terminal at which somebody types an answer."""
    import io

    def use(answer: str) -> None:
        stream = io.StringIO(answer)
        stream.isatty = lambda: True  # type: ignore[method-assign]
        monkeypatch.setattr(sys, "stdin", stream)
        monkeypatch.setattr(sys.stderr, "isatty", lambda: True)

    return use


def test_an_output_that_exists_is_not_overwritten_unasked(scene_file: Path, tmp_path: Path, capsys, terminal) -> None:
    out = tmp_path / "out" / "cube.usdc"
    arguments = ["run", str(scene_file), "--out", str(out), "--frames", "0", "--quiet"]
    assert main(arguments) == OK
    before = out.read_bytes()
    out.write_bytes(before + b"x")  # no run writes this
    assert main(arguments) == WRONG_USE
    assert capsys.readouterr().err == f"warpfem: {out} exists: use --overwrite to replace it, or another --out\n"
    for answer in ("n\n", "\n", ""):
        terminal(answer)
        assert main(arguments) == WRONG_USE
        assert f"{out} exists: overwrite? [y/N] " in capsys.readouterr().err
    assert out.read_bytes() == before + b"x"
    terminal("y\n")
    assert main(arguments) == OK
    assert out.read_bytes() == before
    out.write_bytes(before + b"x")
    assert main([*arguments, "--overwrite"]) == OK
    assert out.read_bytes() == before


def test_what_a_killed_run_left_is_not_overwritten_unasked(killed: Path, scene_file, tmp_path, capsys) -> None:
    folder = tmp_path / "out"
    shutil.copytree(killed.parent, folder)
    out = folder / killed.name
    arguments = ["run", str(scene_file), "--out", str(out), "--frames", "0", "--quiet"]
    before = contents(folder)
    assert main(arguments) == WRONG_USE
    printed = capsys.readouterr().err
    assert f"4 frames are in {partial_path(out)}, of a run that was killed" in printed
    assert "use --resume" in printed and "--overwrite" in printed
    checkpoint = before.pop("run.checkpoint.npz")
    checkpoint_path(out).unlink()
    assert main(arguments) == WRONG_USE
    assert "--resume" not in capsys.readouterr().err
    assert contents(folder) == before and checkpoint
    assert main([*arguments, "--overwrite"]) == OK
    assert [path.name for path in folder.iterdir()] == ["run.usdc"]
