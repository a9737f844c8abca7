"""The command ``warpfem``."""

from __future__ import annotations

import argparse
import hashlib
import importlib.metadata
import json
import os
import platform
import signal
import sys
import time
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import warpfem
from warpfem.checkpoint import Checkpoint, checkpoint_path
from warpfem.dtypes import FloatName
from warpfem.errors import MissingExtraError, OutputError, SimulationError, TimeStepError, WarpfemError
from warpfem.scene import Scene
from warpfem.simulation import Frame, Simulation, Summary
from warpfem.solvers import StaticEquilibrium

if TYPE_CHECKING:
    from warpfem.trade.sweep import Sweep

OK, FAILED, WRONG_USE = 0, 1, 2

STABILITY_PAGE = Path("docs") / "stability.md"

EXTRAS = {
    "meshio": "mesh",
    "pytetwild": "tet",
    "matplotlib": "plot",
    "pillow": "plot",
    "tqdm": "progress",
    "scipy": "bench",
    "scikit-fem": "bench",
    "distributed": "cluster",
}
"""Optional packages and the extra that brings them."""


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the command line; returns 0, 1 for a failed run or 2 for wrong use."""
    arguments = _parser().parse_args(argv)
    try:
        with warnings.catch_warnings():
            warnings.showwarning = _show_warning  # type: ignore[assignment]
            return arguments.command(arguments)
    except TimeStepError as error:
        return _fail(error, WRONG_USE)
    except SimulationError as error:
        return _fail(error, FAILED)
    except WarpfemError as error:
        return _fail(error, WRONG_USE)
    except KeyboardInterrupt:
        return _fail(SimulationError("interrupted before anything was written"), FAILED)


def _show_warning(message: Warning | str, *_: object) -> None:
    print(f"warpfem: warning: {message}", file=sys.stderr)


def _fail(error: Exception, code: int) -> int:
    print(f"warpfem: {error}", file=sys.stderr)
    for note in getattr(error, "__notes__", ()):
        print(f"  {note}", file=sys.stderr)
    return code


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="warpfem", description="Simulates elastic solids by finite elements and stores the animation in USD."
    )
    parser.add_argument("--version", action="version", version=f"warpfem {warpfem.__version__}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    run = commands.add_parser("run", help="run a scene file and store the animation", description=_run.__doc__)
    _scene_options(run)
    _time_options(run)
    run.add_argument("--out", type=Path, metavar="F", help="output .usdc, .usd or .usda (default: output/SCENE.usdc)")
    run.add_argument(
        "--checkpoint-every",
        type=_positive,
        metavar="N",
        help="write a checkpoint beside the output every N frames, to resume a killed or interrupted run from",
    )
    existing = run.add_mutually_exclusive_group()
    existing.add_argument("--resume", action="store_true", help="go on after the last checkpoint of the same run")
    existing.add_argument("--overwrite", action="store_true", help="replace an output that exists, without asking")
    run.add_argument(
        "--threads",
        type=_positive,
        metavar="N",
        help="threads that steps may use on the CPU (default: all cores); the result is the same",
    )
    run.add_argument("--quiet", action="store_true", help="print nothing but errors")
    run.add_argument("--json", action="store_true", help="print the summary as JSON, and nothing else")
    run.set_defaults(command=_run)

    static = commands.add_parser(
        "static", help="solve a scene's static equilibrium and store it", description=_static.__doc__
    )
    _scene_options(static, dtype="float64")
    static.set_defaults(frames=None, fps=None)
    static.add_argument(
        "--out", type=Path, metavar="F", help="output .usdc, .usd or .usda (default: output/SCENE.static.usdc)"
    )
    static.add_argument(
        "--time", type=float, metavar="T", help="when prescribed motions are held [s] (default: at the last frame)"
    )
    static.add_argument(
        "--tolerance",
        type=float,
        default=StaticEquilibrium.tolerance,
        metavar="R",
        help="largest unbalanced force relative to the largest force that acts (default: %(default)s)",
    )
    static.add_argument(
        "--load-steps",
        type=int,
        default=StaticEquilibrium.load_steps,
        metavar="N",
        help="increments of loads and motions, at least (default: 1, and more only where it needs them)",
    )
    static.add_argument("--overwrite", action="store_true", help="replace an output that exists, without asking")
    static.add_argument("--quiet", action="store_true", help="print nothing but errors")
    static.add_argument("--json", action="store_true", help="print the summary as JSON, and nothing else")
    static.set_defaults(command=_static)

    explain = commands.add_parser(
        "explain",
        help="say what a scene requires, and so what is modelled (steps it for some seconds)",
        description=_explain.__doc__,
    )
    _scene_options(explain)
    _time_options(explain)
    explain.set_defaults(command=_explain)

    _trade_parser(commands)

    preview = commands.add_parser("preview", help="draw a run to PNG or GIF", description=_preview.__doc__)
    preview.add_argument("file", type=Path, metavar="FILE", help="a USD file that warpfem wrote")
    preview.add_argument(
        "-o", "--out", type=Path, required=True, metavar="F", help=".png (a sheet of frames) or .gif (the motion)"
    )
    preview.set_defaults(command=_preview)

    extremes = commands.add_parser(
        "extremes", help="measure the stability of warpfem at the extremes", description=_extremes.__doc__
    )
    extremes.add_argument("--quick", action="store_true", help="few settings and small meshes, about two minutes")
    extremes.add_argument("--json", action="store_true", help="print the results as JSON, and nothing else")
    extremes.add_argument(
        "--case", type=int, nargs="+", default=[], metavar="N", help="only the cases of these numbers"
    )
    extremes.add_argument(
        "--out",
        type=Path,
        metavar="F",
        help=f"Markdown file of all figures (default: {STABILITY_PAGE}, if neither --quick nor --case is given)",
    )
    extremes.set_defaults(command=_extremes)

    info = commands.add_parser("info", help="print versions and devices", description=_info.__doc__)
    info.set_defaults(command=_info)
    return parser


def _trade_parser(commands: Any) -> None:
    trade = commands.add_parser(
        "trade", help="measure what accuracy costs in a scene, setting by setting", description=_trade.__doc__
    )
    trade.add_argument("scene", type=Path, metavar="SCENE", help="a Python file that defines scene() -> Scene")
    _set_option(trade)
    trade.add_argument("--device", metavar="D", help="Warp device, for example cpu or cuda:0")
    trade.add_argument("--frames", type=_positive, metavar="N", help="frames to simulate after the initial one")
    trade.add_argument(
        "--axis",
        action="append",
        default=[],
        dest="axes",
        metavar="NAME=VALUE,...",
        help="what to vary, may be repeated: a parameter of the scene, or dt, solver, element, material, dtype, refine "
        "(how often all cells are divided), or a setting of the solver such as tolerance; without any, the mesh, the "
        "element, the scheme and dt",
    )
    trade.add_argument(
        "--error",
        type=_error,
        action="append",
        dest="errors",
        metavar="E",
        help="relative error to find the cheapest setting for, as 1%% or 0.01; may be repeated (default: 10%%, 1%% and "
        "0.1%%)",
    )
    trade.add_argument(
        "--quantity",
        default="l2",
        metavar="Q",
        help="what the error is of: a quantity that the scene declares, or l2 or max, the norms of the motion "
        "(default: %(default)s)",
    )
    trade.add_argument(
        "--repeats", type=_positive, default=3, metavar="N", help="processes that time each setting (default: 3)"
    )
    trade.add_argument(
        "--limit",
        type=_positive,
        default=300,
        metavar="SECONDS",
        help="wall time after which a setting has failed, also one of the reference (default: %(default)s)",
    )
    where = trade.add_mutually_exclusive_group()
    where.add_argument(
        "--workers",
        type=_positive,
        default=1,
        metavar="N",
        help="settings that run at the same time on this machine: their times are marked, and not mixed with others",
    )
    where.add_argument("--scheduler", metavar="ADDRESS", help="scheduler of a Dask cluster to run the settings on")
    trade.add_argument(
        "--out",
        type=Path,
        metavar="DIR",
        help="folder of the results, and of the runs that a study goes on from (default: output/SCENE.trade)",
    )
    trade.add_argument("--json", action="store_true", help="print the results as JSON, and nothing else")
    trade.set_defaults(command=_trade)


def _error(text: str) -> float:
    number = float(text.removesuffix("%")) / (100.0 if text.endswith("%") else 1.0)
    if not 0.0 < number < 1.0:
        raise argparse.ArgumentTypeError(f"must be between 0 and 100 %, not {text}")
    return number


_error.__name__ = "error"  # argparse's name for what is no number


def _positive(text: str) -> int:
    number = int(text)
    if number < 1:
        raise argparse.ArgumentTypeError(f"must be at least 1, not {number}")
    return number


_positive.__name__ = "number"  # argparse's name for what is no number


def _scene_options(parser: argparse.ArgumentParser, dtype: FloatName = "float32") -> None:
    parser.add_argument("scene", type=Path, metavar="SCENE", help="a Python file that defines scene() -> Scene")
    parser.add_argument("--device", metavar="D", help="Warp device, for example cpu or cuda:0")
    parser.add_argument("--dtype", choices=("float32", "float64"), default=dtype, help=f"default: {dtype}")
    _set_option(parser)


def _set_option(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        dest="settings",
        metavar="NAME=VALUE",
        help="set a parameter of the scene; may be repeated",
    )


def _time_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--frames", type=int, metavar="N", help="frames to simulate after the initial one")
    parser.add_argument("--fps", type=float, metavar="N", help="frames per second of simulated time")


def _load(arguments: argparse.Namespace) -> Scene:
    from warpfem.scene_file import load_scene

    scene = load_scene(arguments.scene, _parameters(arguments))
    given = {"frames": arguments.frames, "fps": arguments.fps}
    return replace(scene, **{name: value for name, value in given.items() if value is not None})


def _parameters(arguments: argparse.Namespace) -> dict[str, str]:
    """What --set gives."""
    settings = {}
    for text in arguments.settings:
        name, equals, value = text.partition("=")
        if not equals or not name.isidentifier():
            raise WarpfemError(f"--set takes NAME=VALUE, for example --set cells=16, not '{text}'")
        settings[name] = value
    return settings


def _start_warp() -> None:
    """Starts Warp without its reports of loaded modules, and without its warning that there is no CUDA driver."""
    import warp

    warp.config.log_level = warp.LOG_ERROR
    sys.stderr.flush()
    kept = os.dup(2)  # the warning comes from native code
    try:
        with open(os.devnull, "w") as nowhere:
            os.dup2(nowhere.fileno(), 2)
            warp.init()
    finally:
        os.dup2(kept, 2)
        os.close(kept)


@contextmanager
def _held_interrupt() -> Iterator[Callable[[], None]]:
    """Holds back the first Ctrl-C or SIGTERM until the function that it gives is called; a second one stops at once.

    Raised just anywhere, the interrupt would be lost in the import of the USD libraries or in a destructor.
    """
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    seen = []

    def restore() -> None:
        for number, handler in before.items():
            signal.signal(number, handler)

    def note(*_: object) -> None:
        seen.append(True)
        restore()

    def check() -> None:
        if seen:
            raise KeyboardInterrupt

    for number in before:
        signal.signal(number, note)
    try:
        yield check
    finally:
        restore()


def _run(arguments: argparse.Namespace) -> int:
    """Runs a scene file and stores the animation in a USD file, frame by frame.

    An output that exists is replaced only with --overwrite or after asking. The first Ctrl-C (or SIGTERM) ends the
    run after the frame, a second one at once.
    """
    _start_warp()
    scene = _load(arguments)
    out = arguments.out or Path("output") / f"{arguments.scene.stem}.usdc"
    with _held_interrupt() as check_interrupt:
        from warpfem.usd import check_path
    check_interrupt()
    check_path(out)
    recipe = _recipe(arguments)
    if arguments.resume:
        scene = Checkpoint.read(checkpoint_path(out)).with_meshes(scene, recipe)
    elif not arguments.overwrite:
        _require_consent(out)
    say = not (arguments.quiet or arguments.json)
    if say:
        print(f"{arguments.scene}: preparing (the first run of a scene compiles its kernels)", file=sys.stderr)
    simulation = Simulation(scene, device=arguments.device, dtype=arguments.dtype, threads=arguments.threads)
    summary = simulation.summary
    code = OK
    try:
        recording = warpfem.record(
            simulation,
            out,
            checkpoint_every=arguments.checkpoint_every,
            resume=arguments.resume,
            recipe=recipe,
        )
        with _held_interrupt() as check_interrupt, closing(recording) as frames:
            for _ in _progress(frames, scene.frames + 1) if say else frames:
                check_interrupt()
    except KeyboardInterrupt:
        if not summary.frames:
            raise
        code = _fail(SimulationError(f"interrupted: {_kept(out)}"), FAILED)
    except WarpfemError as error:
        if not summary.frames:
            raise
        error.add_note(_kept(out))
        code = _fail(error, FAILED)
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
            print(f"wrote {out}")
    return code


def _recipe(arguments: argparse.Namespace) -> str:
    """What makes the scene: the file and the parameters."""
    contents = hashlib.sha256(arguments.scene.read_bytes()).hexdigest()
    return " ".join([contents, *arguments.settings])


def _require_consent(out: Path) -> None:
    """Asks before what an earlier run left is replaced; refuses where nobody can be asked.

    Raises:
        OutputError: it is to stay.
    """
    from warpfem.usd import partial_path

    partial = partial_path(out)
    found = [f"{out} exists"] if out.exists() else []
    if partial.exists():
        found.append(f"{_frames_in(partial)} in {partial}, of a run that was killed")
    if not found:
        return
    text = ", and ".join(found)
    if checkpoint_path(out).exists():
        text += f" (to go on from {checkpoint_path(out)}, use --resume)"
    if sys.stdin.isatty() and sys.stderr.isatty():
        print(f"{text}: overwrite? [y/N] ", end="", file=sys.stderr, flush=True)
        if sys.stdin.readline().strip().lower() in ("y", "yes"):
            return
        raise OutputError("nothing was run, and nothing overwritten")
    raise OutputError(f"{text}: use --overwrite to replace it, or another --out")


def _frames_in(path: Path) -> str:
    from warpfem.usd import read_animation

    try:
        count = read_animation(path).frame_count
    except OutputError:
        return "no readable frames are"
    return "1 frame is" if count == 1 else f"{count} frames are"


def _kept(out: Path) -> str:
    """Says where the frames of a run that has ended early are."""
    from warpfem.usd import partial_path

    for path in (partial_path(out), out):
        if path.exists():
            return f"{_frames_in(path)} in {path}"
    return "no frame is left"


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


def _static(arguments: argparse.Namespace) -> int:
    """Solves the static equilibrium of a scene under its loads, and stores it in a USD file.

    Bodies start from their initial displacement; velocities and damping do not matter. Frame 0 of the file is the
    start, and one frame each shows the equilibria on the way to the full load, the last one under it.
    """
    from warpfem.static_run import StaticRun, record_static, summary_text

    _start_warp()
    solver = StaticEquilibrium(arguments.tolerance, load_steps=arguments.load_steps)
    scene = _load(arguments)
    out = arguments.out or Path("output") / f"{arguments.scene.stem}.static.usdc"
    with _held_interrupt() as check_interrupt:
        from warpfem.usd import check_path
    check_interrupt()
    check_path(out)
    if not arguments.overwrite:
        _require_consent(out)
    say = not (arguments.quiet or arguments.json)
    if say:
        print(f"{arguments.scene}: solving (the first time its kernels are compiled)", file=sys.stderr)
    run = StaticRun(scene, solver, time=arguments.time, device=arguments.device, dtype=arguments.dtype)
    summary = run.summary
    code = OK
    try:
        with _held_interrupt() as check_interrupt, closing(record_static(run, out)) as frames:
            for frame in frames:
                if say and frame.index > 0:
                    print(f"equilibrium under {100.0 * summary.fractions[-1]:.4g} % of the load", file=sys.stderr)
                check_interrupt()
    except KeyboardInterrupt:
        if not summary.fractions:
            raise
        code = _fail(SimulationError(f"interrupted: {_kept(out)}"), FAILED)
    except SimulationError as error:
        if not summary.fractions:
            raise
        error.add_note(_kept(out))
        code = _fail(error, FAILED)
    if arguments.json:
        data = {"scene": str(arguments.scene), "file": str(out), "dtype": arguments.dtype, **asdict(summary)}
        print(json.dumps(data, indent=2))
    elif not arguments.quiet and code == OK:
        print(summary_text(summary))
        print(f"wrote {out}")
    return code


def _explain(arguments: argparse.Namespace) -> int:
    """Says what a scene requires, and so what is modelled, compiled, stored and paid for in a step."""
    from warpfem.explain import explain

    _start_warp()
    print(explain(_load(arguments), device=arguments.device, dtype=arguments.dtype))
    return OK


def _trade(arguments: argparse.Namespace) -> int:
    """Measures what accuracy costs in a scene: runs all combinations of the axes' values, each in a process of its own
    and several times, and compares them with a reference that is finer in space and time.

    Writes trade.csv, trade.json and, with the extra 'plot', trade.png and trade.svg. A study that was interrupted or
    killed goes on from the runs that it has when the command is given again. Exits with 1 if there is no reference,
    or none that is good enough for an error that was asked for.
    """
    from warpfem.trade import report
    from warpfem.trade.plot import plot

    say = (lambda text: None) if arguments.json else (lambda text: print(text, file=sys.stderr, flush=True))
    out = arguments.out or Path("output") / f"{arguments.scene.stem}.trade"
    _start_warp()
    try:
        done = _sweep(arguments, out, say)
    except KeyboardInterrupt:
        return _fail(SimulationError(f"interrupted: what has been run is in {out}, and the command goes on"), FAILED)
    written = report.write(done, out)
    if done.reference is not None:
        try:
            written += plot(done, out)
        except MissingExtraError as error:
            say(str(error))
    if arguments.json:
        print(json.dumps(report.data(done), indent=2, allow_nan=False))
    else:
        print(report.text(done))
        print(f"wrote {', '.join(map(str, written))}")
    refused = arguments.errors is not None and any(answer.refusal for answer in done.answers)
    return FAILED if done.reference is None or refused else OK


def _sweep(arguments: argparse.Namespace, out: Path, say: Callable[[str], None]) -> Sweep:
    """Runs the study; what can be wrong with the command is said before anything is run."""
    from warpfem.trade.axes import default_axes, mesh_control, parse_axes, settings_of
    from warpfem.trade.executors import cluster_executor, local_executor
    from warpfem.trade.problem import Problem
    from warpfem.trade.store import Store
    from warpfem.trade.study import Study
    from warpfem.trade.sweep import TARGETS, require_quantity, sweep

    problem = Problem.of(arguments.scene, _parameters(arguments), frames=arguments.frames, device=arguments.device)
    axes = parse_axes(arguments.axes, problem)
    mesh = mesh_control(problem)
    axes = axes or default_axes(problem, mesh)
    require_quantity(problem, arguments.quantity)
    say(f"{arguments.scene}: {len(settings_of(axes, problem))} settings of {', '.join(axis.name for axis in axes)}")
    alone = arguments.workers == 1 and arguments.scheduler is None
    executor = cluster_executor(arguments.scheduler) if arguments.scheduler else local_executor(arguments.workers)
    with executor as pool:
        study = Study(
            problem,
            Store(out),
            pool,
            load="serial" if alone else "parallel",
            limit=float(arguments.limit),
            threads=None if alone else 1,
            say=say,
        )
        targets = arguments.errors or TARGETS
        return sweep(study, axes, mesh, name=arguments.quantity, targets=targets, repeats=arguments.repeats)


def _preview(arguments: argparse.Namespace) -> int:
    """Draws a run: a sheet of frames as PNG, or the motion as GIF (needs the extra 'plot')."""
    from warpfem.preview import preview

    print(f"wrote {preview(arguments.file, arguments.out)}")
    return OK


def _extremes(arguments: argparse.Namespace) -> int:
    """Runs the cases of the stability table: extreme deformations, parameters, scales, steps and wrong input.

    Every trial passes, is refused with a clear message, or FAILs; any FAIL makes the exit code 1.
    """
    from warpfem.extremes import CASES, report

    unknown = sorted(set(arguments.case) - set(CASES))
    if unknown:
        raise WarpfemError(f"there is no case {unknown[0]}: the cases are {', '.join(map(str, sorted(CASES)))}")
    out = arguments.out or (None if arguments.quick or arguments.case else STABILITY_PAGE)
    if out:
        _make_writable(out)
    _start_warp()
    say = not arguments.json
    if say:
        print(report.text_header(), flush=True)
    outcomes = []
    for outcome in report.run_cases(sorted(set(arguments.case) or CASES), arguments.quick, _start_warp):
        outcomes.append(outcome)
        if say:
            print(report.text_row(outcome), flush=True)
    if arguments.json:
        print(json.dumps(report.json_data(outcomes, arguments.quick), indent=2, allow_nan=False))
    if out:
        out.write_text(report.markdown(outcomes, arguments.quick), encoding="utf-8")
        if say:
            print(f"wrote {out}")
    return FAILED if report.failed(outcomes) else OK


def _make_writable(out: Path) -> None:
    """Finds out that a text file cannot be written before the work of hours is lost."""
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        out.open("a").close()
    except OSError as error:
        raise OutputError(f"cannot write {out}: {error.strerror}") from None


def _info(arguments: argparse.Namespace) -> int:
    """Prints versions and devices."""
    import warp

    _start_warp()
    print(f"warpfem {warpfem.__version__}, Python {platform.python_version()}, {platform.platform()}")
    for package in ("warp-lang", "numpy", "usd-core"):
        print(f"{package} {importlib.metadata.version(package)}")
    for package, extra in EXTRAS.items():
        try:
            print(f"{package} {importlib.metadata.version(package)}")
        except importlib.metadata.PackageNotFoundError:
            print(f"{package} not installed: pip install 'warpfem[{extra}]'")
    print("devices: " + ", ".join(f"{device.alias} ({device.name})" for device in warp.get_devices()))
    return OK


if __name__ == "__main__":
    sys.exit(main())
