"""How long a run takes to start, what a first run compiles, and what storing frames costs.

    python benchmarks/start.py [--repeats N]

Each start is that of a process of its own, with the kernels in the cache: a block of 110k tetrahedra above a floor. The
first run is that of ``scenes/jelly_drop.py`` with an empty cache of kernels. The cost of storing is the difference
between explicit runs of a block of 51k points with and without, at 24 frames per second.
"""

import argparse
import json
import os
import re
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

START_CELLS, STORED_CELLS = 28, 36
"""Cubes of five tetrahedra along each edge of the blocks."""

SCENE = Path(__file__).parent.parent / "scenes" / "jelly_drop.py"


def timed_start(solver: str) -> dict[str, float]:
    """The seconds of each part of a start, from the first import on."""
    begin = time.perf_counter()
    import warpfem as wf

    imported = time.perf_counter()
    scene = _block(START_CELLS, solver)
    built = time.perf_counter()
    model = wf.Model(scene, device="cpu")
    finalised = time.perf_counter()
    assert model.cell_count > 100_000
    wf.Simulation(scene, device="cpu")
    ready = time.perf_counter()
    return {
        "import": imported - begin,
        "build": built - imported,
        "finalise": finalised - built,
        "import, build and finalise": finalised - begin,
        "simulation, with a model of its own and a first step": ready - finalised,
    }


def compiled_modules() -> dict[str, float]:
    """The seconds that each kernel module of ``jelly_drop`` takes to compile."""
    with tempfile.TemporaryDirectory() as folder:
        environment = {**os.environ, "WARP_CACHE_PATH": folder}
        command = [sys.executable, str(SCENE)]
        run = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=True)
    found = re.findall(r"Module (\S+) \w+ load on device 'cpu' took ([\d.]+) ms  \(compiled\)", run.stdout + run.stderr)
    return {name: float(milliseconds) / 1000.0 for name, milliseconds in found}


def storing_share(frames: int) -> tuple[float, float]:
    """The seconds of a frame without storing, and the part of a run that storing adds."""
    import warpfem as wf

    scene = _block(STORED_CELLS, "SymplecticEuler", dt="auto", frames=frames)
    simulation = wf.Simulation(scene, device="cpu")
    begin = time.perf_counter()
    for _ in simulation.frames():
        pass
    plain = time.perf_counter() - begin
    simulation = wf.Simulation(scene, device="cpu")
    with tempfile.TemporaryDirectory() as folder:
        begin = time.perf_counter()
        for _ in wf.record(simulation, Path(folder) / "run.usdc"):
            pass
        stored = time.perf_counter() - begin
    return plain / frames, 1.0 - plain / stored


def _block(cells: int, solver: str, **settings: float | str):
    import numpy as np
    import warp as wp

    import warpfem as wf

    wp.config.log_level = wp.LOG_ERROR
    mesh = wf.Mesh.box((1, 1, 1), (cells,) * 3, origin=(0, 0.01, 0))
    velocity = 0.01 * np.random.default_rng(0).normal(size=mesh.points.shape)  # strains every cell from the first step
    body = wf.Body("block", mesh, wf.StableNeoHookean(E=1e5, nu=0.4), density=1000, velocity=velocity)
    floor = wf.Plane((0, 0, 0), (0, 1, 0))
    return wf.Scene([body], getattr(wf, solver)(), gravity=(0, -9.81, 0), obstacles=[floor], **settings)


def _in_a_process(*arguments: str) -> dict[str, float]:
    command = [sys.executable, __file__, *arguments]
    return json.loads(subprocess.run(command, capture_output=True, text=True, check=True).stdout.splitlines()[-1])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--repeats", type=int, default=5, help="of each start; medians are printed")
    parser.add_argument("--start-of", metavar="SOLVER", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.start_of:
        print(json.dumps(timed_start(arguments.start_of)))
        return

    for solver in ("SymplecticEuler", "BackwardEuler"):
        _in_a_process("--start-of", solver)  # compiles
        starts = [_in_a_process("--start-of", solver) for _ in range(arguments.repeats)]
        print(f"{solver}, {5 * START_CELLS**3:,} tetrahedra [s]:")
        for part in starts[0]:
            times = [start[part] for start in starts]
            print(f"  {part}: {statistics.median(times):.2f} ({min(times):.2f} to {max(times):.2f})")
    modules = compiled_modules()
    print(f"first run of {SCENE.stem}: {len(modules)} modules compiled in {sum(modules.values()):.1f} s")
    for name, seconds in modules.items():
        print(f"  {seconds:.2f} s {name}")
    shares = [storing_share(frames=24) for _ in range(3)]
    frame, share = (statistics.median(values) for values in zip(*shares, strict=True))
    print(f"a frame of {(STORED_CELLS + 1) ** 3:,} points takes {frame:.2f} s; storing is {share:.0%} of the run")


if __name__ == "__main__":
    main()
