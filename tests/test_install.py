"""The source distribution installs into an empty environment, where a scene runs that is given by its path."""

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent

SCENE = """
import warpfem as wf


def scene(cells: int = 2) -> wf.Scene:
    mesh = wf.Mesh.box(size=(1, 1, 1), cells=(cells, cells, cells))
    block = wf.Body("block", mesh, wf.StableNeoHookean(E=1e5, nu=0.3), supports=[wf.Pin("bottom")])
    return wf.Scene([block], wf.BackwardEuler(), dt=1 / 24, gravity=(0, -9.81, 0), frames=2)
"""

BUILD = "import sys; from setuptools import build_meta; print(build_meta.build_sdist(sys.argv[1]))"


def run(*command: object, folder: Path) -> str:
    """Runs a command in a folder; returns what it prints."""
    done = subprocess.run([str(part) for part in command], cwd=folder, capture_output=True, text=True, timeout=900)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.mark.slow
def test_the_source_distribution_installs_and_runs(tmp_path):
    source = tmp_path / "source"
    listed = run("git", "ls-files", "-co", "--exclude-standard", folder=ROOT).split()
    for name in listed:
        (source / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(ROOT / name, source / name)
    run(sys.executable, "-m", "venv", "environment", folder=tmp_path)
    python = tmp_path / "environment" / "bin" / "python"
    run(python, "-m", "pip", "install", "--quiet", "setuptools>=77", folder=tmp_path)
    archive = tmp_path / run(python, "-c", BUILD, tmp_path, folder=source).splitlines()[-1]
    shutil.unpack_archive(archive, tmp_path / "unpacked")
    unpacked = next((tmp_path / "unpacked").iterdir())
    assert {name for name in listed if not (unpacked / name).exists()} <= {".gitignore", "MANIFEST.in"}

    run(python, "-m", "pip", "install", "--quiet", archive, folder=tmp_path)
    (tmp_path / "block.py").write_text(SCENE)
    command = tmp_path / "environment" / "bin" / "warpfem"
    run(command, "run", tmp_path / "block.py", "--set", "cells=1", "--out", "block.usdc", folder=tmp_path)
    count = "from pxr import Usd; print(Usd.Stage.Open('block.usdc').GetEndTimeCode())"
    assert float(run(python, "-c", count, folder=tmp_path)) == 2.0
