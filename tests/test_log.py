"""Logs of runs: what a line says, that none is lost or doubled, and what is refused."""

from __future__ import annotations

import json
import os
import shutil
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

import warpfem as wf
from warpfem.cli import main
from warpfem.commands.session import OK, WRONG_USE
from warpfem.errors import OutputError, SceneError
from warpfem.log import RunLog
from warpfem.log_file import FIGURES, read_log
from warpfem.usd import read_animation

BARS = str(Path(__file__).parent.parent / "scenes" / "two_materials.py")
G = 9.81


def block(name: str = "block", tip: str = "tip", **settings) -> wf.Scene:
    """A block that falls, and turns about nothing."""
    mesh = wf.Mesh.rectangle((1.0, 0.5), (4, 2), (0.0, 0.01)).with_point_set(tip, lambda x: x[:, 0] > 0.9)
    body = wf.Body(name, mesh, wf.StableNeoHookean(E=2e4, nu=0.3), velocity=lambda x: x**2 * (0.4, -0.2))
    return wf.Scene([body], wf.VelocityVerlet(), gravity=(0.0, -G), fps=20.0, frames=9, **settings)


@pytest.mark.parametrize("suffix", [".csv", ".jsonl"])
def test_a_line_says_what_the_frame_is(tmp_path: Path, suffix: str) -> None:
    """The centre of mass falls as gravity wills, whatever the block does; sets have the mean of their points."""
    path = tmp_path / "logs" / f"run{suffix}"
    simulation = wf.Simulation(block(), dtype="float64")
    frames, steps = [], []
    for frame in wf.record(simulation, tmp_path / "run.usdc", log=path):
        frames.append(frame)
        steps.append(simulation.summary.steps)
        assert len(path.read_text().splitlines()) == len(frames) + (suffix == ".csv")  # at once, not at the end
    table = read_log(path)
    assert table.names[: len(FIGURES)] == FIGURES
    times = table.column("time [s]")
    assert times == pytest.approx(np.arange(10) / 20.0)
    x = simulation.model.rest_points
    start = np.average(x**2 * (0.4, -0.2), axis=0, weights=simulation.model.host_mass)  # the velocity of the centre
    assert table.column("block ux [m]") == pytest.approx(start[0] * times, abs=1e-12)
    assert table.column("block uy [m]") == pytest.approx(start[1] * times - 0.5 * G * times**2, abs=1e-12)
    for name, members in (("tip", x[:, 0] > 0.9), ("top", x[:, 1] > 0.5), ("left", x[:, 0] == 0.0)):
        for axis in range(2):
            expected = [frame.displacement[members, axis].mean() for frame in frames]
            assert table.column(f"block.{name} u{'xy'[axis]} [m]") == pytest.approx(expected, abs=1e-14)
    expected_figures = {
        "frame": range(10),
        "time [s]": [frame.time for frame in frames],
        "kinetic energy [J]": [frame.energies.kinetic for frame in frames],
        "elastic energy [J]": [frame.energies.elastic for frame in frames],
        "load energy [J]": [frame.energies.load for frame in frames],
        "contact energy [J]": [0.0] * 10,
        "total energy [J]": [frame.energies.total for frame in frames],
        "largest von Mises stress [Pa]": [frame.von_mises.max() for frame in frames],
        "least J": [frame.jacobian.min() for frame in frames],
        "penetration [m]": [0.0] * 10,
        "steps": steps,
        "Newton iterations": [0] * 10,
        "CG iterations": [0] * 10,
        "unconverged steps": [0] * 10,
    }
    assert tuple(expected_figures) == FIGURES
    for name, values in expected_figures.items():
        assert np.array_equal(table.column(name), list(values)), name  # to the last bit
    assert len(table.names) == len(FIGURES) + 2 * (1 + 5)
    assert not (tmp_path / "logs" / f"writing.run{suffix}").exists()


@pytest.mark.parametrize("suffix", [".csv", ".jsonl"])
def test_a_killed_run_goes_on_in_the_same_log(tmp_path: Path, suffix: str) -> None:
    """What a kill leaves is what is on the disk while the run waits: rows after the checkpoint, and half of one."""
    whole, killed, left = (tmp_path / name for name in ("whole", "killed", "left"))
    wf.run(block(), whole / "run.usdc", log=whole / f"run{suffix}")
    simulation = wf.Simulation(block())
    recording = wf.record(simulation, killed / "run.usdc", checkpoint_every=3, log=killed / f"run{suffix}")
    with closing(recording) as frames:
        for frame in frames:
            if frame.index == 5:  # the last checkpoint is that of frame 3
                shutil.copytree(killed, left)
                break
    log = left / f"run{suffix}"
    assert len(read_log(log).values) == 6
    lines = (whole / f"run{suffix}").read_text().splitlines()
    with log.open("a") as file:
        file.write(lines[-3][:20])
    assert len(read_log(log).values) == 6  # half a line is none
    wf.run(block(), left / "run.usdc", checkpoint_every=3, resume=True, log=log)
    assert log.read_text() == (whole / f"run{suffix}").read_text()
    assert read_animation(left / "run.usdc").frame_count == 10


def test_a_log_that_does_not_fit_is_not_gone_on_with(tmp_path: Path) -> None:
    log, out = tmp_path / "run.csv", tmp_path / "run.usdc"

    def begin(path: Path | None) -> None:
        with closing(wf.record(wf.Simulation(block()), out, checkpoint_every=3, log=path)) as frames:
            for frame in frames:
                if frame.index == 4:
                    break

    def go_on(message: str) -> None:
        before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
        with pytest.raises(OutputError, match=message):
            wf.run(block(), out, resume=True, log=log)
        assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before

    begin(None)
    go_on("the log .*run.csv cannot be read: .*No such file")
    begin(log)
    lines = log.read_text().splitlines(keepends=True)
    log.write_text("".join(lines[:3]))
    go_on("not one of the frames up to 4 of this run: leave --log out, or run anew")
    log.write_text("".join(line.replace("tip", "top2") for line in lines))
    go_on("not one of the frames up to 4 of this run")
    log.write_text("".join(lines[:2] + lines[3:]))
    go_on("its frames are not 0, 1, 2")


def test_names_make_columns_that_can_be_told_apart(tmp_path: Path) -> None:
    path = tmp_path / "run.csv"
    wf.run(block('two\nlines, "quoted"', "Körper, 1"), tmp_path / "run.usdc", log=path)
    assert 'two lines, "quoted".Körper, 1 ux [m]' in read_log(path).names
    mesh = block().bodies[0].mesh
    bodies = [wf.Body(name, mesh, wf.StableNeoHookean(E=2e4, nu=0.3)) for name in ("a", "a.tip")]
    simulation = wf.Simulation(wf.Scene(bodies, wf.VelocityVerlet(), frames=1))
    with pytest.raises(SceneError, match=r"two columns 'a\.tip ux \[m\]'"):
        RunLog(path, simulation)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("run.txt", r"must end in \.csv or \.jsonl"),
        ("run", r"must end in \.csv or \.jsonl"),
        ("folder.csv", "is a folder"),
        ("file/run.csv", "not a folder"),
        ("x" * 300 + ".csv", "cannot be written"),
    ],
)
def test_a_log_that_cannot_be_written_is_refused_before_anything_is(tmp_path, monkeypatch, capsys, name, message):
    monkeypatch.chdir(tmp_path)
    Path("folder.csv").mkdir()
    Path("file").touch()
    assert main(["run", BARS, "--out", "a.usdc", "--log", name]) == WRONG_USE
    printed = capsys.readouterr().err
    assert message.replace("\\", "") in printed and printed.count("\n") == 1
    assert sorted(os.listdir()) == ["file", "folder.csv"]


def test_a_log_that_exists_is_replaced_only_when_told_so(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    command = ["run", BARS, "--set", "cells=1", "--frames", "2", "--out", "a.usdc", "--log", "a.csv"]
    Path("a.csv").write_text("precious\n")
    assert main(command) == WRONG_USE
    assert "a.csv exists: use --overwrite to replace it, or another --log" in capsys.readouterr().err
    assert Path("a.csv").read_text() == "precious\n"
    assert main([*command, "--overwrite"]) == OK
    assert "wrote a.usdc and a.csv" in capsys.readouterr().out
    assert len(read_log("a.csv").values) == 3
    assert "stiff.bottom uy [m]" in read_log("a.csv").names
    assert main(command) == WRONG_USE
    assert "a.usdc exists, and a.csv exists: use" in capsys.readouterr().err


def test_numbers_that_are_not_finite_are_null_in_json(tmp_path: Path) -> None:
    from warpfem.log_file import row

    values = [*range(len(FIGURES) - 1), float("inf")]
    text = row(tmp_path / "a.jsonl", FIGURES, values)
    assert json.loads(text)[FIGURES[-1]] is None
    assert row(tmp_path / "a.csv", FIGURES, values).endswith(",inf\n")


HEAD = ",".join(FIGURES)
LINE = ",".join(["0"] * len(FIGURES))


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.csv", "x,y\n1,2\n", "no column 'frame'"),
        ("a.csv", f"{HEAD}\n1,2\n", "line 2 has 2 entries, the first one 14"),
        ("a.csv", f"{HEAD}\n{LINE[:-1]}x\n", "could not convert string to float"),
        ("a.csv", f"{HEAD}\n1{LINE[1:]}\n", "its frames are not 0, 1, 2"),
        ("a.csv", "\0\1\2\n", "no log of a run, or damaged"),
        ("a.jsonl", "3\n", "line 1 is not an object"),
        ("a.jsonl", '{"frame": 0}\n', "no column 'time [s]'"),
        ("a.jsonl", "{\n", "Expecting property name"),
        ("a.jsonl", "[" * 100_000 + "\n", "no log of a run, or damaged"),
        (
            "a.jsonl",
            json.dumps(dict.fromkeys(FIGURES, 0)) + '\n{"frame": 1}\n',
            "line 2 is not an object with the keys",
        ),
        ("a.jsonl", json.dumps({name: [0] for name in FIGURES}) + "\n", "no log of a run, or damaged"),
        ("a.csv", b"\xff\xfe\n", "cannot be read"),
        ("a.csv", None, "cannot be read"),
    ],
)
def test_what_is_no_log_is_one_error(tmp_path: Path, name: str, content, message: str) -> None:
    path = tmp_path / name
    if content is not None:
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(OutputError) as caught:
        read_log(path)
    assert message in str(caught.value) and str(path) in str(caught.value)
