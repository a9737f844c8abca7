"""What is known of warpfem on CUDA without a GPU: compiled kernels, and step times predicted from bytes and flops.

    python benchmarks/gpu.py --out docs/gpu.md

Every kernel that the shipped scenes launch is compiled for sm_80 and sm_90, and assembled by ``ptxas`` (of the CUDA
toolkit on PATH, or of the wheel nvidia-cuda-nvcc), which tells its registers and spills. The time of a step is then
predicted for GPUs whose bandwidth and peak rates are in their data sheets.
"""

import argparse
import contextlib
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from unittest import mock

import numpy as np
import warp as wp
from launches import Launches, launches_of, recorded

import warpfem as wf
import warpfem.model
from warpfem.linear import BlockJacobi, ConjugateGradients, cell_sums, operators, tangent_operator
from warpfem.scene_file import load_scene

ARCHITECTURES = (80, 90)
SCENES = Path(__file__).parent.parent / "scenes"
SETTINGS = {
    "bear": {"edge_length": "0.4"},
    "cantilever": {"cells": "2"},
    "jelly_drop": {"cells": "2"},
    "twist": {"cells": "1"},
}
"""Of shipped scenes that are large: the kernels are the same."""

ON_THE_CPU_ALONE = {"warpfem.subnormals"}
"""Modules of settings of the processor."""

EFFICIENCY = 0.8
"""The part of the bandwidth in the data sheet that streaming kernels usually reach."""


@dataclass(frozen=True)
class Gpu:
    """What a data sheet says: memory bandwidth [B/s], peak rates in float32 and float64 outside tensor cores [1/s]."""

    name: str
    bandwidth: float
    float32: float
    float64: float
    source: str


GPUS = (
    Gpu("A100 80 GB SXM", 2039e9, 19.5e12, 9.7e12, "NVIDIA A100 Tensor Core GPU, data sheet, 2021"),
    Gpu("H100 SXM", 3350e9, 67e12, 34e12, "NVIDIA H100 Tensor Core GPU, data sheet, 2023"),
    Gpu("RTX 4090", 1008e9, 82.6e12, 1.29e12, "NVIDIA Ada GPU Architecture, white paper, 2022"),
)


@dataclass(frozen=True)
class Resources:
    """What ``ptxas`` says of a kernel: registers of a thread; its stack, stores and loads of spilled ones [B]."""

    registers: int
    stack: int
    spill_stores: int
    spill_loads: int

    @property
    def warps(self) -> int:
        """Warps on a multiprocessor of 65536 registers and at most 64 warps, in blocks of 256 threads."""
        by_registers = 65536 // (8 * -(-self.registers // 8) * 256)
        return 8 * min(8, by_registers)


def shipped_kernels() -> dict[wp.Kernel, str]:
    """The kernels that the shipped scenes launch, with the scene that does so first."""
    result: dict[wp.Kernel, str] = {}
    for path in sorted(SCENES.glob("*.py")):
        for kernel in kernels_of(load_scene(path, SETTINGS.get(path.stem, {}))):
            result.setdefault(kernel, path.stem)
    return result


def kernels_of(scene: wf.Scene) -> list[wp.Kernel]:
    """The kernels that a scene launches up to its first frame."""

    def work() -> None:
        frames = wf.Simulation(scene, device="cpu").frames()
        next(frames)
        next(frames, None)

    with as_on_cuda():
        kernels = launches_of(work).kernels()
    return [kernel for kernel in kernels if kernel.module.name not in ON_THE_CPU_ALONE]


@contextlib.contextmanager
def as_on_cuda() -> Iterator[None]:
    """A context in which models on the CPU use the kernels that they use on CUDA: one cell or row to a task."""
    with (
        mock.patch.object(warpfem.model.CellBlock, "vectorize"),
        mock.patch.object(operators, "SLICED_POINTS", sys.maxsize),
        mock.patch.object(cell_sums, "GROUP_BLOCKS", sys.maxsize),
    ):
        yield


def compile_module(module: wp.Module, architecture: int, folder: str | Path) -> str:
    """Compiles a module for a GPU; returns it in PTX, the assembly language of CUDA."""
    (path,) = wp.compile_aot_module(module, arch=architecture, module_dir=folder, use_ptx=True)
    return path.read_text().rstrip("\0")


def entry_name(kernel: wp.Kernel) -> str:
    """The name of a kernel in PTX."""
    return f"{kernel.get_mangled_name()}_cuda_kernel_forward"


def find_ptxas(ptx: str) -> str | None:
    """An assembler that is new enough for a module: of the wheel nvidia-cuda-nvcc, or on PATH."""
    spec = find_spec("nvidia")
    folders = spec.submodule_search_locations or [] if spec else []
    candidates = [str(path) for folder in folders for path in sorted(Path(folder).glob("*/bin/ptxas"))]
    for path in filter(None, [*candidates, shutil.which("ptxas")]):
        with contextlib.suppress(subprocess.CalledProcessError):
            resources(path, ptx, ARCHITECTURES[0])
            return path
    return None


def resources(ptxas: str, ptx: str, architecture: int) -> dict[str, Resources]:
    """What ``ptxas -v`` says of each kernel of a module.

    Raises:
        subprocess.CalledProcessError: it does not assemble the module.
    """
    with tempfile.NamedTemporaryFile("w", suffix=".ptx") as file:
        file.write(ptx)
        file.flush()
        command = [ptxas, "-v", f"-arch=sm_{architecture}", file.name, "-o", "/dev/null"]
        text = subprocess.run(command, capture_output=True, text=True, check=True).stderr
    found = re.findall(
        r"Compiling entry function '(\w+)'.*?(\d+) bytes stack frame, (\d+) bytes spill stores, (\d+) bytes spill loads"
        r".*?Used (\d+) registers",
        text,
        re.DOTALL,
    )
    return {
        name: Resources(int(registers), int(stack), int(stores), int(loads))
        for name, stack, stores, loads, registers in found
    }


def flops(ptx: str, entry: str) -> Counter[str]:
    """Floating-point operations in the text of a kernel, by type: a loop counts as one round.

    Those of fused multiply-adds count 2; divisions, roots and functions, which take several, count 8.
    """
    _, _, body = ptx.partition(f".entry {entry}(")
    body = body.partition("\n}")[0]
    counts: Counter[str] = Counter()
    for operation, kind in re.findall(
        r"^\s(?:@!?%p\d+ )?(fma|add|sub|mul|div|rcp|sqrt|rsqrt|lg2|ex2)\.[\w.]*?(f32|f64)\s", body, re.MULTILINE
    ):
        counts[kind] += 2 if operation == "fma" else 1 if operation in ("add", "sub", "mul") else 8
    return counts


@dataclass(frozen=True)
class Work:
    """What a step costs per cell: bytes, operations in float32 and in float64; with its launches and host reads."""

    bytes: float
    float32: float
    float64: float
    launches: int
    reads: int

    def seconds(self, gpu: Gpu, cells: float) -> float:
        """The predicted time: whichever of memory and arithmetic takes longer."""
        return cells * max(
            self.bytes / (EFFICIENCY * gpu.bandwidth), self.float32 / gpu.float32 + self.float64 / gpu.float64
        )


def work_of(launches: Launches, cells: int) -> Work:
    """The work of what has been launched on a mesh."""
    size, single, double = 0, 0, 0
    with tempfile.TemporaryDirectory() as folder:
        modules = {kernel.module for kernel in launches.kernels()}
        text = {module: compile_module(module, ARCHITECTURES[0], folder) for module in modules}
    for launch, count in launches.counts.items():
        size += count * launch.bytes
        if launch.kernel is not None:
            own = flops(text[launch.kernel.module], entry_name(launch.kernel))
            single += count * launch.tasks * own["f32"]
            double += count * launch.tasks * own["f64"]
    return Work(size / cells, single / cells, double / cells, launches.counts.total(), launches.reads)


def block_scene(cells: int, solver: wf.SymplecticEuler | wf.BackwardEuler) -> wf.Scene:
    """A block of 5 n^3 tetrahedra above a floor."""
    body = wf.Body("block", wf.Mesh.box((1, 1, 1), (cells,) * 3), wf.StableNeoHookean(E=1e5, nu=0.4), density=1000)
    return wf.Scene([body], solver, dt=1e-5, gravity=(0, -9.81, 0), obstacles=[wf.Plane((0, -0.01, 0), (0, 1, 0))])


def explicit_step(cells: int) -> Work:
    """One step of symplectic Euler, after the first, which looks at the limit of stability."""
    with as_on_cuda(), recorded() as launches:
        simulation = wf.Simulation(block_scene(cells, wf.SymplecticEuler()), device="cpu")
        stepper, state, dt = simulation.stepper, simulation.state, simulation.dt
        stepper.step(state, dt)
        before = launches.copy()
        stepper.step(state, dt)
    return work_of(launches - before, simulation.model.cell_count)


def conjugate_gradient_iteration(cells: int) -> Work:
    """One iteration of conjugate gradients on the assembled stiffness, with block Jacobi."""
    model = wf.Model(block_scene(cells, wf.BackwardEuler()), device="cpu")
    with as_on_cuda():
        operator = tangent_operator(model, "assembled")
    operator.linearize(model.state().u, mass_weight=1e4, precondition=True)
    solver, preconditioner, x = ConjugateGradients(model), BlockJacobi(operator), model.zeros()

    def iterate(count: int) -> None:
        solver.solve(operator, preconditioner, model.dead_load, x, tolerance=1e-9, max_iterations=count)

    with recorded() as launches:
        iterate(2)
        two = launches.copy()
        iterate(3)
    return work_of(launches - two - two, model.cell_count)


def implicit_step() -> Launches:
    """One step of backward Euler of a small block, after the first."""
    with recorded() as launches:
        simulation = wf.Simulation(block_scene(4, wf.BackwardEuler()), device="cpu")
        before = launches.copy()
        simulation.stepper.step(simulation.state, simulation.dt)
    return launches - before


def host_seconds() -> float:
    """What a step costs the host: the time of one explicit step of a block of five cells on the CPU [s]."""
    simulation = wf.Simulation(block_scene(1, wf.SymplecticEuler()), device="cpu")
    times = []
    for _ in range(2000):
        start = time.perf_counter()
        simulation.stepper.step(simulation.state, simulation.dt)
        times.append(time.perf_counter() - start)
    return float(np.median(times))


def kernel_rows() -> tuple[list[str], str]:
    """The rows of the table of kernels, and which assembler wrote them."""
    kernels = shipped_kernels()
    rows = {}
    assembled: dict[int, dict[str, Resources]] = {architecture: {} for architecture in ARCHITECTURES}
    with tempfile.TemporaryDirectory() as folder:
        ptxas = find_ptxas(compile_module(next(iter(kernels)).module, ARCHITECTURES[0], folder))
        for module in dict.fromkeys(kernel.module for kernel in kernels):
            for architecture in ARCHITECTURES:
                ptx = compile_module(module, architecture, folder)
                if ptxas is not None:
                    assembled[architecture] |= resources(ptxas, ptx, architecture)
    for kernel, scene in kernels.items():
        name = kernel.key.rpartition("__")[2]
        cells = []
        for architecture in ARCHITECTURES:
            own = assembled[architecture].get(entry_name(kernel))
            if own is None:
                cells.append("compiled | | | ")
            else:
                cells.append(f"{own.registers} | {own.stack} | {own.spill_stores}/{own.spill_loads} | {own.warps}")
        rows[name, scene] = f"| `{name}` | {scene} | {' | '.join(cells)} |"
    if ptxas is None:
        return list(rows.values()), "there is no `ptxas` here that is as new, so that registers are not known"
    version = subprocess.run([ptxas, "--version"], capture_output=True, text=True, check=True).stdout
    return list(rows.values()), f"assembled by `ptxas` {version.rpartition('V')[2].split()[0]}"


def time_rows(work: Work) -> list[str]:
    """The rows of a table of predicted times, a GPU each."""
    rows = []
    for gpu in GPUS:
        times = [work.seconds(gpu, cells) for cells in (1e6, 1e7)]
        limit = "memory" if work.bytes / (EFFICIENCY * gpu.bandwidth) >= times[0] / 1e6 else "arithmetic"
        rows.append(f"| {gpu.name} | {' | '.join(f'{1e6 * t:.0f}' for t in times)} | {limit} |")
    return rows


def page(cells: int) -> str:
    """The page."""
    rows, assembler = kernel_rows()
    explicit, iteration = explicit_step(cells), conjugate_gradient_iteration(cells)
    implicit = implicit_step()
    host = host_seconds()
    head = "| GPU | 1M cells [µs] | 10M cells [µs] | limit |\n|---|---|---|---|"
    sources = "\n".join(
        f"- {gpu.name}: {gpu.bandwidth / 1e9:.0f} GB/s, {gpu.float32 / 1e12:.3g} Tflop/s in float32, "
        f"{gpu.float64 / 1e12:.3g} in float64 ({gpu.source})"
        for gpu in GPUS
    )
    architectures = " | ".join(
        f"sm_{number}: registers | stack [B] | spill stores/loads [B] | warps of 64" for number in ARCHITECTURES
    )
    newline = "\n"
    return f"""# warpfem on CUDA

Written by `python benchmarks/gpu.py --out docs/gpu.md`. **Nothing here has been run on a GPU**: kernels are compiled
for GPUs on a machine without one, and times are predicted, so that a measurement can prove them wrong.

## Kernels

Every kernel that the shipped scenes launch up to their first frame, in float32 (a custom energy computes in float64),
compiled by Warp {wp.config.version} for compute capabilities {" and ".join(f"{a / 10}" for a in ARCHITECTURES)};
{assembler}. "Warps of 64" is how many the registers leave room for on a multiprocessor,
in blocks of 256 threads.

| kernel | first used by | {architectures} |
|---|---|{"---|" * (4 * len(ARCHITECTURES))}
{newline.join(rows)}

## Predicted times

A block of tetrahedra, stable Neo-Hookean, above a floor, float32, by the kernels that CUDA gets: one cell to a
task, forces added by atomics. The model:

- Each launch reads each array that it is given once from memory and writes each output once; outputs, to which most
  kernels add, count twice. So points that neighbouring cells share come from the cache. Counted on a block of
  {5 * cells**3:,} cells, per cell.
- Floating-point operations are those in the text of the compiled kernels: a fused multiply-add is 2, a division or a
  root 8.
- A GPU takes the longer of bytes over {EFFICIENCY:.0%} of its bandwidth, and operations over its peak rate.
{sources}

What the model leaves out makes a measurement slower: conflicts of the atomic additions at shared points, latency where
few warps fit, gaps between launches; a cache that holds much of what 1M cells need makes it faster. **At 10M cells, the
prediction is refuted by a time below {EFFICIENCY:.0%} of it or above twice of it**, once the host keeps up.

### One explicit step

{explicit.bytes:.0f} bytes and {explicit.float32:.0f} operations a cell, in {explicit.launches} launches and copies.

{head}
{newline.join(time_rows(explicit))}

The host takes {1e6 * host:.0f} µs to launch a step from Python (measured on the machine that wrote this page, by a step
of five cells on its CPU): where the GPU is faster than that, the host sets the pace, unless steps are recorded in a
CUDA graph.

### One iteration of conjugate gradients

On the assembled stiffness: {iteration.bytes:.0f} bytes, {iteration.float32:.0f} operations in float32 and
{iteration.float64:.1f} in float64 a cell, in {iteration.launches} launches and copies. Off the CPU the host then
reads two numbers, each of which waits for the GPU.

{head}
{newline.join(time_rows(iteration))}

## Written for the CPU, not run on CUDA

- The host reads {explicit.reads} arrays in an explicit step here and {implicit.reads} in one of backward Euler
  ({implicit.counts.total()} launches and copies, on a small block that falls): on the CPU that is free, on CUDA each
  waits for the device. Explicit steps read their alarm every 16th step there.
- Conjugate gradients decide after each iteration, on the host, whether to go on.
- Each frame brings displacements, velocities, J and the von Mises stress to the host, and USD is written there.
- `Watch.certain_limit`, the bound of quadratic cells and the preview of failures run in NumPy on the host.
- Cells several to a task, and threads, are for the CPU alone.
- Sums over points and cells by atomics come in any order, so that runs are not the same to the last bit on CUDA.
- Kernels are launched one by one, but for the iterations of conjugate gradients, which are one graph.
"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, help="the page to write; else it is printed")
    parser.add_argument("--cells", type=int, default=24, help="cubes of five cells along each edge of the block")
    arguments = parser.parse_args()
    wp.config.log_level = wp.LOG_ERROR
    text = page(arguments.cells)
    if arguments.out is None:
        sys.stdout.write(text)
    else:
        arguments.out.write_text(text)


if __name__ == "__main__":
    main()
