"""The README's Python runs, and its commands and tables are those of the package."""

import re
from pathlib import Path

import numpy as np
import pytest

import warpfem as wf
from warpfem.cli import parser

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text()


def python_blocks() -> list[str]:
    return re.findall(r"```python\n(.*?)```", README, re.DOTALL)


def test_python_blocks_run(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    names: dict = {}
    for block in python_blocks():
        if "import newton" in block:
            continue  # in test_newton.py
        exec(compile(block.replace("frames=48", "frames=2"), "README.md", "exec"), names)
    printed = capsys.readouterr().out.splitlines()
    assert len(printed) == 3  # a line per frame
    # the last block grows a cube of 1 m by 10 % in a float64 model: psi of the default material by hand
    model, state = names["model"], names["state"]
    E, nu, J, length = 1e5, 0.45, 1.1**3, 3 * 1.1**2
    mu, lam = E / (2 * (1 + nu)), E * nu / ((1 + nu) * (1 - 2 * nu))
    mu_, lam_ = 4 / 3 * mu, lam + 5 / 6 * mu
    a = 1 + 3 * mu_ / (4 * lam_)

    def psi(I_C, J):
        return mu_ / 2 * (I_C - 3 - np.log(I_C + 1)) + lam_ / 2 * (J - a) ** 2

    assert model.energies(state).elastic == pytest.approx(psi(length, J) - psi(3, 1), rel=1e-9)


def test_commands_are_those_of_the_parser():
    blocks = README.split("```")[1::2]
    lines = [line for block in blocks for line in block.splitlines() if line.startswith("warpfem ")]
    assert len(lines) == 16
    for line in lines:
        parser().parse_args(line.split("#")[0].split()[1:])


def test_every_scene_and_every_material_is_in_a_table():
    for path in (ROOT / "scenes").glob("*.py"):
        assert f"| `{path.stem}` |" in README
    for material in wf.MATERIALS.values():
        assert f"| `{material.__name__}` |" in README
    for solver in wf.SOLVERS.values():
        assert f"| `{solver.__name__}()` |" in README


def test_every_extra_is_in_the_table():
    import tomllib

    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    for extra in extras:
        assert f"`{extra}`" in README
