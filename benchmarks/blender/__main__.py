"""Whether other programs see what warpfem has computed: Blender, and NVIDIA's asset validator.

    python benchmarks/blender [--scene NAME ...] [--out output/blender] [--install]

Each scene is run, and its frames are kept apart from the file. Blender, without a window, then imports the file, and
every frame is compared with what was kept: the vertices to the last bit, the colours, the range of frames. One frame is
rendered by Cycles, to be looked at. The validator judges the file by all its rules but one, and warpfem reads it back.
The exit code is 1 if anything differs.

``--install`` makes an environment for each of the two first (1 GB, Python 3.11); it is no part of the tests.
"""

import argparse
import json
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp
from pxr import Usd

import warpfem as wf
from warpfem.errors import WarpfemError
from warpfem.scene_file import load_scene
from warpfem.usd import read_animation

HERE = Path(__file__).resolve().parent
SCENES = HERE.parents[1] / "scenes"
TOOLS = {
    "bpy": ("bpy==5.0.1",),
    "omni": ("omniverse-asset-validator[usd,numpy]==1.18.0",),
}
"""What is installed to have a module."""

IGNORED_RULES = {
    "IndexedPrimvarChecker": "values that repeat in one frame, as all do at rest, do not in the next",
}
"""Rules of the validator that are left out, and why."""


def interpreter(module: str, folder: Path, install: bool) -> Path:
    """The interpreter of the environment that has a module.

    Raises:
        SystemExit: it is not there and is not to be made.
    """
    python = folder / module / "bin" / "python"
    if install and not python.exists():
        base = shutil.which("python3.11") or sys.executable
        subprocess.run([base, "-m", "venv", folder / module], check=True)
        subprocess.run([python, "-m", "pip", "install", "--quiet", *TOOLS[module]], check=True)
    if not python.exists():
        sys.exit(f"{python} is missing: run with --install, which makes an environment with {TOOLS[module][0]}")
    return python


def run(name: str, path: Path) -> None:
    """Runs a shipped scene; keeps what its surfaces should look like in each frame in an .npz file beside it."""
    scene = load_scene(SCENES / f"{name}.py")
    simulation = wf.Simulation(scene)
    surfaces = [_surface(body.mesh) for body in scene.bodies]
    kept: dict[str, list[np.ndarray]] = {body.name: [] for body in scene.bodies}
    for frame in wf.record(simulation, path):
        x = simulation.model.rest_points + frame.displacement
        for body, used, (own, _) in zip(scene.bodies, surfaces, simulation.model.body_slices, strict=True):
            kept[body.name].append(_in_space(x[own][used]).astype(np.float32))
    stage = Usd.Stage.Open(str(path))
    arrays: dict[str, Any] = {"names": list(kept), "fps": scene.fps, "up_axis": scene.up_axis}
    for body, points in kept.items():
        colors = stage.GetAttributeAtPath(f"/World/{body}/{body}_surface.primvars:displayColor")
        arrays[f"{body}.points"] = np.array(points)
        arrays[f"{body}.colors"] = np.array([colors.Get(index) for index in range(len(points))])
    np.savez(path.with_suffix(".npz"), **arrays)


def _surface(mesh: wf.Mesh) -> np.ndarray:
    """The points of a mesh that its surface shows."""
    return np.unique(mesh.linear_boundary_faces if mesh.dim == 3 else mesh.linear_cells)


def _in_space(points: np.ndarray) -> np.ndarray:
    return np.pad(points, ((0, 0), (0, 3 - points.shape[1])))


def read_back(path: Path) -> list[str]:
    """What warpfem does not find in its own file again."""
    kept = np.load(path.with_suffix(".npz"))
    animation = read_animation(path)
    problems = []
    for index in range(animation.frame_count):
        for body, frame in zip(animation.bodies, animation.frame(index), strict=True):
            used = np.unique(body.surface_faces)
            if not np.array_equal(frame.points[used].astype(np.float32), kept[f"{body.name}.points"][index]):
                problems.append(f"read_animation: frame {index} of {body.name} differs")
    bodies = load_scene(SCENES / f"{path.stem}.py").bodies
    if len(bodies) == 1 and bodies[0].mesh.dim == 3 and path.stem != "bear":  # which is another mesh each time
        mesh, own = wf.load_mesh(path), bodies[0].mesh
        if not (np.array_equal(mesh.cells, own.linear_cells) and np.array_equal(mesh.points, np.float32(own.points))):
            problems.append("load_mesh: the mesh differs")
    return problems


def ask(python: Path, script: str, *arguments: object) -> dict[str, Any]:
    """What a script says, under the interpreter that can run it: its last line, as JSON."""
    command = [python, HERE / script, *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    lines = done.stdout.strip().splitlines()
    if done.returncode or not lines:
        return {"problems": [f"{script} failed: {(done.stderr or done.stdout).strip()[-500:]}"]}
    return json.loads(lines[-1])


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scene", nargs="+", default=["jelly_drop", "twist", "bear"], help="shipped scenes")
    parser.add_argument("--out", type=Path, default=Path("output/blender"), help="files and pictures")
    parser.add_argument("--peers", type=Path, default=Path(".peers"), help="the environments (.peers)")
    parser.add_argument("--install", action="store_true", help="make the environments that are missing")
    options = parser.parse_args()
    blender, validator = (interpreter(module, options.peers.resolve(), options.install) for module in TOOLS)
    wp.config.log_level = wp.LOG_WARNING
    options.out.mkdir(parents=True, exist_ok=True)
    sound = True
    for name in options.scene:
        path = (options.out / f"{name}.usdc").resolve()
        try:
            run(name, path)
        except WarpfemError as error:
            sys.exit(f"{name}: {error}")
        picture = path.with_suffix(".png")
        seen = ask(blender, "in_blender.py", path, path.with_suffix(".npz"), picture)
        judged = ask(validator, "in_validator.py", path, *IGNORED_RULES)
        problems = [*seen["problems"], *judged["problems"], *read_back(path)]
        print(f"{name}: {seen.get('summary', '')}; {judged.get('summary', '')}; picture in {picture}")
        for problem in problems:
            print(f"  {problem}")
        sound &= not problems
    for rule, reason in IGNORED_RULES.items():
        print(f"left out: the validator's {rule}: {reason}")
    return 0 if sound else 1


if __name__ == "__main__":
    sys.exit(main())
