"""Static equilibria from the command line: what is printed, written and returned."""

import json
from pathlib import Path

import numpy as np
import pytest

import warpfem as wf
from warpfem.cli import main
from warpfem.commands.session import FAILED, OK, WRONG_USE
from warpfem.usd import read_animation, read_pictured_stage

SCENES = Path(__file__).parent.parent / "scenes"
BEAM = [str(SCENES / "cantilever.py"), "--set", "cells=2"]
TWIST = [str(SCENES / "twist.py"), "--set", "cells=1"]
WEIGHT = 4.0 * 1000.0 * 9.81


@pytest.fixture
def scene_file(tmp_path):
    def write(body: str) -> str:
        path = tmp_path / "small.py"
        path.write_text("import warpfem as wf\n\ndef scene(force=1.0):\n" + body)
        return str(path)

    return write


def test_prints_and_stores_an_equilibrium(tmp_path, capsys):
    out = tmp_path / "beam.usdc"
    assert main(["static", *BEAM, "--out", str(out), "--dtype", "float64"]) == OK
    printed = capsys.readouterr().out
    for text in (
        "equilibrium at t = 2 s, in 1 load step: ",
        "residual ",
        "energy [J]: elastic ",
        "largest displacement 0.132",
        "smallest J 0.98",
        "  body 'beam', Pin 'left'  ",
        "  loads ",
        "  sum ",
        f"wrote {out}",
    ):
        assert text in printed
    assert "obstacle" not in printed
    animation = read_animation(out)
    assert read_pictured_stage(out).equilibria
    assert animation.frame_count == 2
    (start,), (end,) = animation.frame(0), animation.frame(1)
    assert (start.points[:, 1] >= 0.0).all()
    assert (end.points - start.points)[:, 1].min() == pytest.approx(-0.131, abs=1e-3)


def test_json_names_the_reactions(tmp_path, capsys):
    out = tmp_path / "beam.usdc"
    assert main(["static", *BEAM, "--out", str(out), "--dtype", "float64", "--tolerance", "1e-9", "--json"]) == OK
    captured = capsys.readouterr()
    assert captured.err == ""
    summary = json.loads(captured.out)
    (pin,) = summary["supports"]
    assert pin["name"] == "body 'beam', Pin 'left'"
    np.testing.assert_allclose(pin["force"], (0.0, WEIGHT, 0.0), atol=1e-5 * WEIGHT)
    np.testing.assert_allclose(summary["loads"]["force"], (0.0, -WEIGHT, 0.0), rtol=1e-12)
    assert np.abs(summary["unbalanced"]["force"]).max() < 1e-8 * WEIGHT
    assert np.abs(summary["unbalanced"]["moment"]).max() < 1e-7 * WEIGHT
    assert summary["fractions"] == [1.0] and summary["stable"] is True
    assert summary["energies"]["elastic"] == pytest.approx(-0.5 * summary["energies"]["load"], rel=0.01)
    assert summary["file"] == str(out)


def test_quiet_prints_nothing(tmp_path, capsys):
    assert main(["static", *BEAM, "--out", str(tmp_path / "a.usdc"), "--quiet"]) == OK
    assert capsys.readouterr() == ("", "")


def test_motions_are_those_at_the_last_frame_or_at_the_time_given(tmp_path, capsys):
    out = tmp_path / "a.usda"
    command = ["static", *TWIST, "--out", str(out), "--quiet", "--overwrite"]
    assert main(command) == OK
    animation = read_animation(out)
    last = animation.frame(animation.frame_count - 1)[0].points
    assert main([*command, "--time", "0"]) == OK
    first = read_animation(out).frame(1)[0].points
    top = first[:, 1] > 3.99
    np.testing.assert_allclose(first[top][:, [0, 2]], -last[top][:, [0, 2]], atol=1e-6)  # half a turn about y


def test_a_frame_for_every_load_step(tmp_path, capsys):
    out = tmp_path / "a.usdc"
    assert main(["static", *BEAM, "--out", str(out), "--load-steps", "4"]) == OK
    captured = capsys.readouterr()
    assert "in 4 load steps" in captured.out
    assert "equilibrium under 25 % of the load" in captured.err
    animation = read_animation(out)
    assert animation.frame_count == 5
    sags = [-animation.frame(index)[0].points[:, 1].min() for index in range(5)]
    np.testing.assert_allclose(sags, sags[-1] * np.linspace(0.0, 1.0, 5), rtol=0.05, atol=1e-6)


def test_obstacles_are_listed(tmp_path, capsys, scene_file):
    path = scene_file("""
    mesh = wf.Mesh.rectangle((1, 1), (2, 2))
    body = wf.Body("block", mesh, wf.NeoHookean(E=1e5, nu=0.3), supports=[wf.Pin("left", axes=(0,)), wf.Pin("top")])
    return wf.Scene([body], wf.BackwardEuler(), obstacles=[wf.Plane((0, 0.1), (0, 1))])
""")
    assert main(["static", path, "--out", str(tmp_path / "a.usdc")]) == OK
    printed = capsys.readouterr().out
    assert "deepest penetration of an obstacle" in printed
    assert "  obstacle 0, Plane" in printed


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        ([str(SCENES / "jelly_drop.py")], "body 'jelly' can move freely"),
        ([*BEAM, "--tolerance", "2"], "tolerance must be in (0, 1)"),
        ([*BEAM, "--load-steps", "0"], "load_steps must be an integer >= 1"),
        ([*BEAM, "--time", "-1"], "time must be a finite number >= 0"),
        ([*BEAM, "--time", "nan"], "time must be a finite number >= 0"),
    ],
)
def test_wrong_use_is_said_before_anything_is_written(tmp_path, capsys, arguments, text):
    assert main(["static", *arguments, "--out", str(tmp_path / "a.usdc")]) == WRONG_USE
    assert text in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_an_output_that_exists_is_kept(tmp_path, capsys, monkeypatch):
    out = tmp_path / "a.usdc"
    out.write_text("precious")
    assert main(["static", *BEAM, "--out", str(out)]) == WRONG_USE
    assert "use --overwrite" in capsys.readouterr().err
    assert out.read_text() == "precious"


CRUSHED = """
    mesh = wf.Mesh.rectangle((1, 1), (1, 1))
    push = wf.PointForce("right", (-force, 0))
    body = wf.Body("crushed", mesh, wf.LinearElasticity(E=1e5, nu=0.3), supports=[wf.Pin("left")], loads=[push])
    return wf.Scene([body], wf.BackwardEuler())
"""


def test_a_failed_solve_keeps_the_equilibria_found(tmp_path, capsys, scene_file):
    out = tmp_path / "a.usdc"
    assert main(["static", scene_file(CRUSHED), "--out", str(out), "--set", "force=1e5", "--quiet"]) == FAILED
    printed = capsys.readouterr().err
    assert "% of the load, none at " in printed and "inverted cells" in printed
    count = read_animation(out).frame_count
    assert f"{count} frames are in {out}" in printed
    assert count > 2


def test_nothing_is_written_without_any_equilibrium(tmp_path, capsys, scene_file):
    out = tmp_path / "a.usdc"
    assert main(["static", scene_file(CRUSHED), "--out", str(out), "--set", "force=1e9", "--quiet"]) == FAILED
    assert "up to 0 % of the load" in capsys.readouterr().err
    assert not out.exists()


def test_python_does_the_same(tmp_path):
    from warpfem.scene_file import load_scene

    scene = load_scene(SCENES / "cantilever.py", {"cells": "2"})
    summary = wf.run_static(scene, tmp_path / "a.usdc", wf.StaticEquilibrium(1e-9), dtype="float64")
    assert summary.residual <= 1e-9
    assert summary.largest_displacement == pytest.approx(0.1323, abs=1e-3)
    assert read_animation(tmp_path / "a.usdc").frame_count == 2
