"""``warpfem run``."""

from __future__ import annotations

import argparse
import hashlib
import json
import sys
import time
from collections.abc import Iterable, Iterator
from contextlib import closing
from dataclasses import asdict
from pathlib import Path
from typing import Any

from warpfem.checkpoint import Checkpoint, checkpoint_path
from warpfem.commands.options import load, positive, scene_options, time_options
from warpfem.commands.output import kept, require_consent
from warpfem.commands.session import FAILED, OK, fail, held_interrupt, start_warp
from warpfem.errors import OutputError, SimulationError, WarpfemError
from warpfem.log_file import check_log_path
from warpfem.record import record
from warpfem.scene_file import source_digest
from warpfem.simulation import Frame, Simulation, Summary
from warpfem.stage import SUFFIXES


def add(commands: Any) -> None:
    """Adds the command to the parser."""
    run = commands.add_parser("run", help="run a scene file and store the animation", description=execute.__doc__)
    scene_options(run)
    time_options(run)
    run.add_argument("--out", type=Path, metavar="F", help="output .usdc, .usd or .usda (default: output/SCENE.usdc)")
    run.add_argument(
        "--log",
        type=Path,
        metavar="F",
        help=".csv or .jsonl that gets a line per frame: energies, extremes, the solver's work, and the mean "
        "displacements of bodies and point sets (see warpfem plot)",
    )
    run.add_argument(
        "--over",
        action="store_true",
        help="write a layer over the USD stage that is run: the stage as it is, and its bodies moving",
    )
    run.add_argument(
        "--checkpoint-every",
        type=positive,
        metavar="N",
        help="write a checkpoint beside the output every N frames, to resume a killed or interrupted run from",
    )
    existing = run.add_mutually_exclusive_group()
    existing.add_argument("--resume", action="store_true", help="go on after the last checkpoint of the same run")
    existing.add_argument("--overwrite", action="store_true", help="replace an output that exists, without asking")
    run.add_argument(
        "--threads",
        type=positive,
        metavar="N",
        help="threads that steps may use on the CPU (default: all cores); the result is the same",
    )
    run.add_argument("--quiet", action="store_true", help="print nothing but errors")
    run.add_argument("--json", action="store_true", help="print the summary as JSON, and nothing else")
    run.set_defaults(command=execute)


def execute(arguments: argparse.Namespace) -> int:
    """Runs a scene file and stores the animation in a USD file, frame by frame.

    An output that exists is replaced only with --overwrite or after asking. The first Ctrl-C (or SIGTERM) ends the
    run after the frame, a second one at once.
    """
    start_warp()
    scene = load(arguments)
    out = arguments.out or Path("output") / f"{arguments.scene.stem}.usdc"
    with held_interrupt() as check_interrupt:
        from warpfem.usd import check_path, require_other_file
    check_interrupt()
    check_path(out)
    require_other_file(out, arguments.scene)
    _require_stage(arguments)
    if arguments.log:
        check_log_path(arguments.log)
    recipe = _recipe(arguments) if arguments.resume or arguments.checkpoint_every else ""
    if arguments.resume:
        scene = Checkpoint.read(checkpoint_path(out)).with_meshes(scene, recipe)
    elif not arguments.overwrite:
        require_consent(out, arguments.log)
    say = not (arguments.quiet or arguments.json)
    if say:
        print(f"{arguments.scene}: preparing (the first run of a scene compiles its kernels)", file=sys.stderr)
    simulation = Simulation(scene, device=arguments.device, dtype=arguments.dtype, threads=arguments.threads)
    summary = simulation.summary
    code = OK
    try:
        recording = record(
            simulation,
            out,
            checkpoint_every=arguments.checkpoint_every,
            resume=arguments.resume,
            recipe=recipe,
            log=arguments.log,
            over=arguments.scene if arguments.over else None,
        )
        with held_interrupt() as check_interrupt, closing(recording) as frames:
            for _ in _progress(frames, scene.frames + 1) if say else frames:
                check_interrupt()
    except KeyboardInterrupt:
        if not summary.frames:
            raise
        code = fail(SimulationError(f"interrupted: {kept(out)}"), FAILED)
    except WarpfemError as error:
        if not summary.frames:
            raise
        error.add_note(kept(out))
        code = fail(error, FAILED)
    if summary.unconverged_steps:
        print(
            f"warpfem: NOT CONVERGED in {summary.unconverged_steps} of {summary.steps} steps: worst residual "
            f"{summary.worst_residual:.2e}, {summary.worst_note}"
            + ("; --dtype float64 resolves more" if "float32" in summary.worst_note else ""),
            file=sys.stderr,
        )
    if arguments.json:
        print(json.dumps(_summary_data(summary, arguments, out), indent=2))
    elif not arguments.quiet:
        print(_summary_text(summary, simulation))
        if code == OK:
            print(f"wrote {out}" + (f" and {arguments.log}" if arguments.log else ""))
    return code


def _require_stage(arguments: argparse.Namespace) -> None:
    """Raises OutputError for --over with what cannot go over a stage."""
    if arguments.over and arguments.scene.suffix.lower() not in SUFFIXES:
        raise OutputError(f"--over writes a layer over a USD stage, and {arguments.scene} is none")
    if arguments.over and (arguments.resume or arguments.checkpoint_every):
        raise OutputError("--over cannot be resumed: leave out --resume and --checkpoint-every")


def _recipe(arguments: argparse.Namespace) -> str:
    """What makes the scene: its file and what it imports, the settings and the parameters."""
    settings = [] if arguments.settings is None else [hashlib.sha256(arguments.settings.read_bytes()).hexdigest()]
    return " ".join([source_digest(arguments.scene), *settings, *arguments.parameters])


def _progress(frames: Iterable[Frame], total: int) -> Iterator[Frame]:
    """A bar on a terminal where tqdm is installed, else a line now and then."""
    if sys.stderr.isatty():
        try:
            from tqdm import tqdm
        except ImportError:
            pass
        else:
            with tqdm(total=total, unit="frame") as bar:
                for frame in frames:
                    bar.update(frame.index + 1 - bar.n)  # a resumed run does not begin with the first
                    yield frame
            return
    last = time.monotonic()
    for frame in frames:
        if time.monotonic() - last > 5.0 or frame.index + 1 == total:
            last = time.monotonic()
            print(f"frame {frame.index + 1} of {total}, t = {frame.time:.3f} s", file=sys.stderr)
        yield frame


def _summary_data(summary: Summary, arguments: argparse.Namespace, out: Path) -> dict:
    data = {"scene": str(arguments.scene), "file": str(out), "dtype": arguments.dtype, **asdict(summary)}
    return {name: None if value == float("inf") else value for name, value in data.items()}


def _summary_text(summary: Summary, simulation: Simulation) -> str:
    same = summary.longest_dt - summary.shortest_dt <= 1e-6 * summary.longest_dt
    length = f"{summary.dt:.4g} s" if same else f"{summary.shortest_dt:.4g} to {summary.longest_dt:.4g} s"
    rejected = f" ({summary.rejected_steps} more were tried and not taken)" if summary.rejected_steps else ""
    lines = [
        f"{summary.frames} frames, {summary.steps} steps of {length}{rejected}, "
        f"{summary.simulated_seconds:.3f} s simulated",
        f"wall time: {summary.setup_seconds:.2f} s to prepare, {summary.stepping_seconds:.2f} s to step",
    ]
    first, last = summary.first_energies, summary.last_energies
    if first and last:
        parts = [("kinetic", "kinetic"), ("elastic", "elastic")]
        if simulation.model.dead_load is not None:
            parts.append(("load", "load"))
        if simulation.model.contact is not None:
            parts.append(("contact", "contact"))
        text = ", ".join(f"{label} {getattr(first, name):.4g} -> {getattr(last, name):.4g}" for label, name in parts)
        lines.append(f"energy [J]: {text}, total {first.total:.4g} -> {last.total:.4g}")
    lines.append(
        f"largest von Mises stress {summary.largest_von_mises:.4g} Pa, smallest J {summary.smallest_jacobian:.4g}"
    )
    if simulation.model.contact is not None:
        start = f" ({summary.first_penetration:.3g} m at the start)" if summary.first_penetration > 0.0 else ""
        lines.append(f"deepest penetration of an obstacle {summary.largest_penetration:.3g} m{start}")
    if summary.newton_iterations:
        lines.append(
            f"{summary.newton_iterations} Newton and {summary.cg_iterations} conjugate gradient iterations "
            f"({summary.newton_iterations / summary.steps:.1f} and {summary.cg_iterations / summary.steps:.0f} a step)"
        )
    if summary.rounded_steps:
        lines.append(
            f"{summary.rounded_steps} of {summary.steps} steps ended at the rounding of {simulation.model.dtype}, with "
            f"residuals of up to {summary.worst_residual:.1e}; --dtype float64 resolves more"
        )
    return "\n".join(lines)
