"""The command line: what it prints, writes and returns."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

import warpfem as wf
from warpfem.cli import main
from warpfem.commands.session import FAILED, OK, WRONG_USE
from warpfem.usd import read_animation

SCENES = Path(__file__).parent.parent / "scenes"
BARS = str(SCENES / "two_materials.py")


@pytest.fixture
def scene_file(tmp_path):
    def write(body: str, name: str = "small.py") -> str:
        path = tmp_path / name
        path.write_text("import warpfem as wf\n" + body)
        return str(path)

    return write


def test_run_writes_the_animation_and_a_summary(tmp_path, capsys):
    out = tmp_path / "bars.usdc"
    assert main(["run", BARS, "--out", str(out), "--frames", "3", "--fps", "12", "--set", "cells=1"]) == OK
    printed = capsys.readouterr().out
    for text in ("4 frames, 12 steps", "energy [J]: kinetic 0", "largest von Mises stress", "Newton", f"wrote {out}"):
        assert text in printed
    assert "penetration" not in printed  # the scene has no obstacles
    animation = read_animation(out)
    assert (animation.frame_count, animation.fps) == (4, 12)
    assert [body.name for body in animation.bodies] == ["stiff", "soft"]
    assert list(tmp_path.iterdir()) == [out]


def test_frames_in_the_file_are_those_of_the_simulation(tmp_path):
    from warpfem.scene_file import load_scene

    out = tmp_path / "bars.usdc"
    assert main(["run", BARS, "--out", str(out), "--frames", "2", "--set", "cells=1", "--quiet"]) == OK
    scene = load_scene(BARS, {"cells": "1"})
    simulation = wf.Simulation(scene, device="cpu")
    frames = simulation.frames()
    animation = read_animation(out)
    for index in range(3):
        expected = simulation.model.rest_points + next(frames).displacement
        stored = np.concatenate([body.points for body in animation.frame(index)])
        np.testing.assert_array_equal(stored.astype(np.float32), expected.astype(np.float32))


def test_json_is_the_only_output(tmp_path, capsys):
    out = tmp_path / "bars.usdc"
    assert main(["run", BARS, "--out", str(out), "--frames", "1", "--set", "cells=1", "--json"]) == OK
    captured = capsys.readouterr()
    summary = json.loads(captured.out)
    assert summary["frames"] == 2
    assert summary["steps"] == 2
    assert summary["newton_iterations"] > 0
    assert summary["unconverged_steps"] == 0
    assert summary["last_energies"]["elastic"] > 0.0
    assert summary["file"] == str(out)
    assert captured.err == ""


def test_quiet_prints_nothing(tmp_path, capsys):
    assert main(["run", BARS, "--out", str(tmp_path / "a.usdc"), "--frames", "0", "--quiet"]) == OK
    assert capsys.readouterr() == ("", "")


def test_quiet_prints_nothing_in_a_process_of_its_own(tmp_path):
    command = [sys.executable, "-m", "warpfem", "run", BARS, "--out", str(tmp_path / "a.usdc"), "--frames", "0"]
    result = subprocess.run([*command, "--quiet"], capture_output=True, text=True, check=True)
    assert (result.stdout, result.stderr) == ("", "")


def test_default_output_is_named_after_the_scene(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["run", BARS, "--frames", "0", "--quiet"]) == OK
    assert (tmp_path / "output" / "two_materials.usdc").is_file()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["run", "missing.py"], "no scene file 'missing.py'"),
        (["run", "scenes"], "no scene file"),
        (["run", BARS, "--set", "cell=2"], "no parameter 'cell'; did you mean 'cells'?"),
        (["run", BARS, "--set", "cells=two"], "cells must be of type int, like 2, not 'two'"),
        (["run", BARS, "--set", "cells"], "--set takes NAME=VALUE"),
        (["run", BARS, "--set", "cells=0"], "cells"),
        (["run", BARS, "--set", "E=-1"], "E must be finite and > 0: got -1"),
        (["run", BARS, "--frames", "-1"], "frames must be an integer >= 0"),
        (["run", BARS, "--fps", "0"], "fps must be a finite number > 0"),
        (["run", BARS, "--fps", "nan"], "fps must be a finite number > 0"),
        (["run", BARS, "--fps", "1e308"], "fps must be a number between"),
        (["run", BARS, "--set", "E=" + "9" * 400], "E must be of type float"),
        (["run", BARS, "--set", "cells=" + "[" * 5000], "cells must be of type int"),
        (["run", "a" * 5000 + ".py"], "no scene file"),
        (["run", BARS, "--device", "gpu"], "no device 'gpu'"),
        (["run", BARS, "--out", "/dev/null/a.usdc"], "/dev/null"),
        (["run", BARS, "--out", "a.txt"], "a.txt"),
        (["preview", "missing.usdc", "--out", "a.png"], "missing.usdc"),
    ],
)
def test_wrong_use_is_one_message_and_no_file(tmp_path, monkeypatch, capsys, arguments, message):
    monkeypatch.chdir(tmp_path)
    if arguments[0] == "run" and "--out" not in arguments:
        arguments = [*arguments, "--out", "a.usdc"]
    assert main(arguments) == WRONG_USE
    errors = [line for line in capsys.readouterr().err.splitlines() if line.startswith("warpfem:")]
    assert len(errors) == 1
    assert message in errors[0]
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("body", "message"),
    [
        ("def scene(:\n", "line 2"),
        ("x = 1\n", "does not define a function scene"),
        ("def scene():\n    return 3\n", "must return a warpfem.Scene, not int"),
        ("def scene():\n    return wf.Scene([], wf.BackwardEuler())\n", "at least one warpfem.Body"),
        ("def scene():\n    return wf.NeoHookean(e=1, nu=0.3)\n", "line 3"),
        ("def scene():\n    return wf.NeoHookean(E=1, nu=0.5)\n", "line 3"),
        ("def scene(cells):\n    return cells\n", "give it with --set cells=VALUE"),
        ("raise SystemExit(3)\n", "line 2"),
        ("def scene():\n\n    return 1 / 0\n", "ZeroDivisionError: division by zero"),
        ("def scene():\n    return scene()\n", "RecursionError"),
        ("scene = dict\n", "scene must be a function scene(**parameters) -> Scene"),
        ("class Odd(BaseException):\n    pass\n\ndef scene():\n    raise Odd('hm')\n", "Odd: hm"),
        ("def scene():\n    raise ValueError('one\\ntwo')\n", "ValueError: one two ("),
        ("class E(Exception):\n    def __str__(self):\n        return 1 / 0\n\nraise E\n", "E: without a text"),
    ],
)
def test_errors_in_a_scene_file_name_file_and_line(scene_file, capsys, body, message):
    path = scene_file(body)
    assert main(["run", path, "--quiet"]) == WRONG_USE
    printed = capsys.readouterr().err
    assert path in printed or "at least one" in message
    assert message in printed
    assert "Traceback" not in printed


@pytest.mark.parametrize("content", [b"", b"\0\1\2", b"# \xe9\n", "x = 1".encode("utf-16"), b"# coding: odd\n", None])
@pytest.mark.parametrize("command", ["run", "explain"])
def test_a_scene_file_that_is_none_is_one_line(tmp_path, capsys, command, content):
    path = tmp_path / "odd.py"
    path.mkdir() if content is None else path.write_bytes(content)
    assert main([command, str(path)]) == WRONG_USE
    printed = capsys.readouterr().err
    assert printed.startswith("warpfem: ") and str(path) in printed and printed.count("\n") == 1


@pytest.mark.parametrize("name", ["a.usdc", "a.usda", "a.usdz", "a.png", "a"])
def test_a_preview_of_garbage_is_one_line(tmp_path, capfd, name):
    pytest.importorskip("matplotlib")
    path = tmp_path / name
    path.write_bytes(b"PXR-USDC" + bytes(range(200)))
    assert main(["preview", str(path), "--out", str(tmp_path / "out.png")]) == WRONG_USE
    printed = capfd.readouterr().err
    assert printed.startswith("warpfem: ") and str(path) in printed and printed.count("\n") == 1


DIVERGING = """
import numpy as np

def scene():
    def motion(rest, time):
        return rest + (0, 0.1, 0) if time < 0.3 else rest * np.nan
    mesh = wf.Mesh.box((1, 1, 1), (1, 1, 1))
    body = wf.Body("cube", mesh, wf.StableNeoHookean(E=1e5, nu=0.3), supports=[wf.PrescribedMotion("top", motion)])
    return wf.Scene([body], wf.VelocityVerlet(), dt=1e-3, fps=10, frames=10)
"""


def test_a_failed_run_keeps_its_frames(tmp_path, scene_file, capsys):
    out = tmp_path / "cube.usdc"
    assert main(["run", scene_file(DIVERGING), "--out", str(out), "--quiet"]) == FAILED
    printed = capsys.readouterr().err
    assert "not finite at t = 0.3" in printed
    assert f"3 frames are in {out}" in printed
    assert read_animation(out).frame_count == 3


LATE = """
def scene():
    def motion(rest, time):
        return rest if time < 0.3 else undefined_name
    mesh = wf.Mesh.box((1, 1, 1), (1, 1, 1))
    body = wf.Body("cube", mesh, wf.StableNeoHookean(E=1e5, nu=0.3), supports=[wf.PrescribedMotion("top", motion)])
    return wf.Scene([body], wf.BackwardEuler(), fps=10, frames=10)
"""


def test_an_error_in_a_prescribed_motion_names_body_time_and_line(tmp_path, scene_file, capsys):
    out = tmp_path / "cube.usdc"
    path = scene_file(LATE)
    assert main(["run", path, "--out", str(out), "--quiet"]) == FAILED
    printed = capsys.readouterr().err
    assert "body 'cube', prescribed motion at t = 0.3 s: NameError: name 'undefined_name'" in printed
    assert f"({path}, line 5)" in printed
    assert f"3 frames are in {out}" in printed
    assert read_animation(out).frame_count == 3


def test_what_can_be_checked_is_checked_before_preparing(tmp_path, capsys):
    assert main(["run", BARS, "--out", str(tmp_path / "a.txt")]) == WRONG_USE
    assert "preparing" not in capsys.readouterr().err


def test_a_body_that_starts_inside_an_obstacle_is_pointed_out(tmp_path, scene_file, capsys):
    body = """
def scene():
    body = wf.Body("cube", wf.Mesh.box((1, 1, 1), (1, 1, 1)), wf.StableNeoHookean(E=1e5, nu=0.3))
    return wf.Scene([body], wf.BackwardEuler(), frames=1, obstacles=[wf.Plane((0, 0.25, 0), (0, 1, 0))])
"""
    assert main(["run", scene_file(body), "--out", str(tmp_path / "a.usdc")]) == OK
    assert "(0.25 m at the start)" in capsys.readouterr().out


def test_a_dt_above_the_limit_is_refused_before_anything_is_written(tmp_path, capsys):
    out = tmp_path / "bar.usdc"
    assert main(["run", str(SCENES / "stretch.py"), "--set", "dt=0.5", "--out", str(out)]) == WRONG_USE
    assert "above the stability limit" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def long_run(out: Path, **streams) -> subprocess.Popen:
    """The command in a process of its own, at work for long enough to be ended from outside."""
    scene = str(SCENES / "jelly_drop.py")
    command = [sys.executable, "-m", "warpfem", "run", scene, "--out", str(out), "--frames", "2000"]
    return subprocess.Popen(command, stdout=subprocess.DEVNULL, **streams)


def test_a_killed_run_leaves_its_frames(tmp_path):
    out = tmp_path / "jelly.usdc"
    process = long_run(out, stderr=subprocess.DEVNULL)
    partial = tmp_path / "jelly.partial.usda"
    frames = 0
    deadline = time.monotonic() + 120
    while frames < 3 and time.monotonic() < deadline and process.poll() is None:
        time.sleep(0.2)
        if partial.is_file():
            frames = read_animation(partial).frame_count
    assert process.poll() is None, "the run ended before it could be killed"
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    assert not out.exists()
    left = read_animation(partial)
    assert left.frame_count >= 3
    for index in range(left.frame_count):
        (body,) = left.frame(index)
        assert np.isfinite(body.points).all()
    heights = [left.frame(index)[0].points[:, 1].mean() for index in range(3)]
    assert heights[0] > heights[1] > heights[2]  # it falls


def test_interrupt_ends_cleanly(tmp_path):
    out = tmp_path / "jelly.usdc"
    process = long_run(out, stderr=subprocess.PIPE, text=True)
    partial = tmp_path / "jelly.partial.usda"
    while process.poll() is None and not (partial.is_file() and read_animation(partial).frame_count >= 2):
        time.sleep(0.2)
    process.send_signal(signal.SIGINT)
    _, printed = process.communicate(timeout=60)
    assert process.returncode == FAILED
    assert "interrupted" in printed and "Traceback" not in printed
    assert read_animation(out).frame_count >= 2


def test_explain_says_what_is_on_and_off(capsys):
    assert main(["explain", BARS, "--set", "cells=1", "--frames", "1"]) == OK
    printed = capsys.readouterr().out
    lines = {line.split()[0]: line.split()[1] for line in printed.splitlines() if line.startswith("  ")}
    assert lines["gravity"] == lines["supports"] == lines["damping"] == lines["elasticity"] == "on"
    assert lines["contact"] == lines["friction"] == lines["loads"] == "off"
    assert "linear (48 cells)" not in printed and "linear (20 cells)" in printed
    assert "element_stiffness" in printed
    assert "Device memory" in printed


def test_info(capsys):
    assert main(["info"]) == OK
    printed = capsys.readouterr().out
    for text in (f"warpfem {wf.__version__}", "warp-lang", "numpy", "usd-core", "devices: cpu"):
        assert text in printed


def test_help_names_every_command(capsys):
    with pytest.raises(SystemExit) as end:
        main(["--help"])
    assert end.value.code == 0
    printed = capsys.readouterr().out
    for command in ("run", "static", "explain", "preview", "info"):
        assert command in printed


def test_missing_command_is_wrong_use(capsys):
    with pytest.raises(SystemExit) as end:
        main([])
    assert end.value.code == WRONG_USE
