"""What a run compiles: the kernels that its scene needs, and no others."""

import re
import subprocess
import sys

import pytest

SCENES = {
    "a held body, explicit": (
        "wf.SymplecticEuler(), dt=1e-5",
        {
            "element_diagnostics",
            "element_energy",
            "element_force",
            "element_frequency",  # of the watch over stability
            "element_frequency_bound",
            "kick_drift",
            "warpfem.points_3_float32",
            "warpfem.subnormals",
            "warpfem.supports_3_float32",
        },
    ),
    "a held body, implicit": (
        "wf.BackwardEuler(), dt=1e-2",
        {
            "element_diagnostics",
            "element_energy",
            "element_force",
            "element_stiffness",
            "warpfem.assembly_3_float32",
            "warpfem.conjugate_gradients_3_float32",
            "warpfem.implicit_3_float32",
            "warpfem.operators_3_float32",
            "warpfem.points_3_float32",
            "warpfem.supports_3_float32",
        },
    ),
}

RUN = """
import warpfem as wf
mesh = wf.Mesh.box((1, 1, 1), (1, 1, 1))
body = wf.Body("cube", mesh, wf.StableNeoHookean(E=1e5, nu=0.3), density=1000, supports=[wf.Pin("bottom")])
for _ in wf.Simulation(wf.Scene([body], {settings}, fps=100, frames=1, gravity=(0, -1, 0)), device="cpu").frames():
    pass
"""


@pytest.mark.parametrize("name", SCENES)
def test_a_scene_compiles_what_it_needs(name):
    settings, expected = SCENES[name]
    command = [sys.executable, "-c", RUN.format(settings=settings)]
    run = subprocess.run(command, capture_output=True, text=True, check=True)
    modules = re.findall(r"Module (\S+) \w+ load on device", run.stdout + run.stderr)
    assert {re.sub(r"^.*__locals__(\w+)_\w{8}$", r"\1", module) for module in modules} == expected


def test_importing_analyses_no_derivative():
    """Warp takes as long for that of the rotation as for the import of the rest."""
    program = (
        "import warp._src.codegen as codegen\n"
        "import warp\n"
        "def build(self, builder): raise AssertionError(self.fun_name)\n"
        "codegen.Adjoint.build = build\n"
        "import warpfem\n"
    )
    subprocess.run([sys.executable, "-c", program], check=True, capture_output=True)
