"""Measures what accuracy costs in shipped scenes and writes docs/trade.md, with the plots beside it.

    python benchmarks/trade.py [--out docs/trade.md] [--folder output/trade] [--scene NAME ...]

Each study is one `warpfem trade` command, which the page names; it goes on from what an earlier run has left in the
folder. A quarter to half an hour for each scene, on an idle machine.
"""

import argparse
import json
import shutil
import subprocess
import sys
import textwrap
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from warpfem.trade.extrapolation import order_text
from warpfem.trade.front import rounded

ERRORS = ("10%", "1%", "0.1%")


@dataclass(frozen=True)
class Study:
    """A scene, what of it is asked for, and what is varied.

    Attributes:
        name: of the scene file.
        quantity: as the command takes it.
        axes: likewise.
        about: what moves, and why the answer is of interest.
        options: other options of the command.
    """

    name: str
    quantity: str
    axes: tuple[str, ...]
    about: str
    options: tuple[str, ...] = ()

    @property
    def scene(self) -> str:
        """The scene file, from the project's folder."""
        return f"scenes/{self.name}.py"

    def command(self) -> list[str]:
        """The arguments of ``warpfem``, without the folder."""
        axes = [part for axis in self.axes for part in ("--axis", axis)]
        errors = [part for error in ERRORS for part in ("--error", error)]
        return ["trade", self.scene, *axes, *errors, "--quantity", self.quantity, *self.options]


EXPLICIT = ":element=P2:solver=velocity_verlet:dt="
"""What a mesh brings on which implicit steps would take minutes, with a dt below its stability limit: ``auto`` takes
shorter ones, and looks at the limit again and again. Of two axes the later one wins, which is that of the mesh."""

SOLVERS = "solver=backward_euler,sdirk2,velocity_verlet:dt=auto"

LESSONS = (
    "What to learn: in bodies as soft and on meshes as coarse as these explicit steps are cheap enough to win at all "
    "of these errors, and below 0.5 % all that is on the fronts is of quadratic cells, which make up for what they "
    "cost. The error is then that of the mesh, whose order at clamped edges and after an impact is below two: from 1 % "
    "to 0.1 % the price grows by 27 to 70. Motion after an impact depends on the floor, too: one that is much stiffer "
    "than the cube sends waves through it that are too short for all of these meshes."
)
"""What the page's figures have in common; to be read again when they are measured again."""

STUDIES = (
    Study(
        "cantilever",
        "l2",
        ("element=P1,P2", SOLVERS, "dt=1/24,1/48,1/96", f"cells=1,2,4,8{EXPLICIT}1/7680,14{EXPLICIT}1/13440"),
        "A beam falls under its weight, swings, and comes to rest by damping. Errors are of its whole motion.",
        ("--frames", "24", "--limit", "600"),
    ),
    Study(
        "jelly_drop",
        "l2",
        (
            "element=P1,P2",
            SOLVERS,
            "dt=1/60,1/240",
            f"cells=2,4,8{EXPLICIT}1/1920,16{EXPLICIT}1/3840,24{EXPLICIT}1/5760",
        ),
        "A soft cube falls on a floor and is pressed flat, for half a second in all. Errors are of its whole motion, "
        "which depends on how the impact is resolved. The floor is a soft one with a stiffness of its own: the default "
        "one goes with the size of the cells, by which the motion changes from mesh to mesh, too.",
        ("--frames", "12", "--set", "stiffness=4e5", "--limit", "300"),
    ),
    Study(
        "twist",
        "l2",
        ("element=P1,P2", SOLVERS, "dt=1/24,1/48", f"cells=1,2,4,8{EXPLICIT}1/2400"),
        "A column is twisted by half a turn of its top, and comes to rest. Errors are of its whole motion.",
        ("--limit", "600"),
    ),
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("docs/trade.md"), help="the page")
    parser.add_argument("--folder", type=Path, default=Path("output/trade"), help="where studies keep their runs")
    names = [study.name for study in STUDIES]
    parser.add_argument("--scene", nargs="+", choices=names, default=names, help="what to measure anew (all)")
    options = parser.parse_args()
    plots = options.out.with_suffix("")
    plots.mkdir(parents=True, exist_ok=True)
    for study in STUDIES:
        if study.name in options.scene:
            own = options.folder / study.name
            done = subprocess.run([sys.executable, "-m", "warpfem", *study.command(), "--out", str(own)])
            if done.returncode not in (0, 1):  # 1: there is no answer for some of the errors
                sys.exit(done.returncode)
            if not (own / "trade.png").exists():
                sys.exit(f"{study.name}: the study has no plot: without a reference, or without the extra 'plot'")
            for name in ("trade.csv", "trade.png"):
                shutil.copy(own / name, plots / f"{study.name}{Path(name).suffix}")
            result = json.loads((own / "trade.json").read_text()) | {"scene": study.scene}  # wherever it lies here
            (plots / f"{study.name}.json").write_text(json.dumps(result, indent=2) + "\n")
    results = {s.name: json.loads(path.read_text()) for s in STUDIES if (path := plots / f"{s.name}.json").exists()}
    options.out.write_text(page(results, plots.name))


def page(results: dict[str, dict[str, Any]], plots: str) -> str:
    """The page of some studies' results, whose plots are in a folder beside it."""
    lines = [
        "# What accuracy costs",
        "",
        *_prose(
            "Written by `python benchmarks/trade.py`: studies of shipped scenes by `warpfem trade`, which runs all "
            "settings and measures their errors against a reference that is finer in space and time, extrapolated, "
            "with an error band of its own. Times are those of the steps, the median of some processes, without the "
            "compilation of kernels and the set-up; in brackets the least and the greatest. Errors are relative; where "
            "the reference's band is more than a quarter of one, only its bound is told (<)."
        ),
    ]
    known = [study for study in STUDIES if study.name in results]
    lines += ["| within | " + " | ".join(ERRORS) + " |", "| --- " * (1 + len(ERRORS)) + "|"]
    for study in known:
        cells = [_recommended(answer, results[study.name]["settings"]) for answer in results[study.name]["answers"]]
        lines.append(f"| [{study.name}](#{study.name}) | {' | '.join(cells)} |")
    lines += ["", *_prose(LESSONS)]
    for study in known:
        lines += _study(study, results[study.name], plots)
    return "\n".join(lines).rstrip() + "\n"


def _recommended(answer: dict[str, Any], rows: list[dict[str, Any]]) -> str:
    """The cell of an answer in the table of all."""
    if answer["refusal"]:
        return "not told: the reference is too rough"
    if answer["setting"] is None:
        return "none of the sweep"
    (own,) = (row for row in rows if row["setting"] == answer["setting"])
    return f"{' '.join(f'{name}={value}' for name, value in own['setting'].items())}: {rounded(own['seconds'])} s"


def _study(study: Study, result: dict[str, Any], plots: str) -> list[str]:
    machine = result["machine"]
    lines = [
        f"## {study.name}",
        "",
        *_prose(study.about),
        "```",
        *_wrapped_command(study),
        "```",
        "",
        f"![time against error]({plots}/{study.name}.png)",
        "",
    ]
    lines += [f"- {answer['sentence']}" for answer in result["answers"]]
    reference = result["reference"]["names"][study.quantity]
    band = reference["band"]
    front = sorted((row for row in result["settings"] if row["on_front"]), key=lambda row: row["seconds"])
    kinds = ("space", "time", "algebra")
    lines += [
        "",
        *_prose(
            "The front, from fast to accurate, and how much the motion changes where the mesh, the steps, or the "
            "tolerance and the precision alone are made finer:"
        )[:-1],
        "",
        f"| setting | time | error | {' | '.join(kinds)} |",
        "| --- " * (3 + len(kinds)) + "|",
    ]
    for row in front:
        setting = " ".join(f"{name}={value}" for name, value in row["setting"].items())
        parts = [row["parts"].get(kind, {}).get(study.quantity) for kind in kinds]
        shares = " | ".join("" if part is None else _percent(part) for part in parts)
        lines.append(f"| {setting} | {_time(row)} | {_error(row, study.quantity, band)} | {shares} |")
    lines += ["", "What is on the front, value by value, from its largest to its least error:", ""]
    lines += [f"- {name}: {_places(front, name, study.quantity)}" for name in result["axes"]]
    seen = {kind: part["order"] for kind, part in reference["parts"].items() if part.get("order") is not None}
    orders = ", ".join(f"in {kind} {order_text(order)}" for kind, order in seen.items())
    failed = sum(bool(row["failure"]) for row in result["settings"])
    lines += [
        "",
        *_prose(
            f"{len(result['settings'])} settings, {failed} of which failed. The reference: orders "
            f"{orders or 'not seen'}, band {_percent(band)}. All of it: "
            f"[{study.name}.json]({plots}/{study.name}.json), [{study.name}.csv]({plots}/{study.name}.csv). "
            f"{machine['processor']}, {machine['cores']} cores; warpfem "
            f"{machine['warpfem']}, warp {machine['warp']}."
        ),
    ]
    return lines


def _places(front: list[dict[str, Any]], axis: str, quantity: str) -> str:
    """Where each value of an axis is on the front."""
    errors: dict[str, list[float]] = {}
    for row in front:
        errors.setdefault(row["setting"].get(axis, "as written"), []).append(row["errors"][quantity])
    spans = {value: dict.fromkeys((_percent(max(own)), _percent(min(own)))) for value, own in errors.items()}
    return ", ".join(f"{value} ({' to '.join(span)})" for value, span in spans.items())


def _percent(part: float) -> str:
    return f"{100 * part:.2g} %"


def _wrapped_command(study: Study) -> list[str]:
    words = ["warpfem", *(f'"{word}"' if " " in word else word for word in study.command())]
    lines = textwrap.wrap(" ".join(words), 110, break_long_words=False, break_on_hyphens=False)
    return [line + (" \\" if line is not lines[-1] else "") for line in lines]


def _time(row: dict[str, Any]) -> str:
    return f"{rounded(row['seconds'])} s ({rounded(row['seconds_least'])} to {rounded(row['seconds_most'])})"


def _error(row: dict[str, Any], name: str, band: float) -> str:
    error = row["errors"][name]
    return _percent(error) if row["resolved"] else f"< {_percent(error + band)}"


def _prose(text: str) -> list[str]:
    return [*textwrap.wrap(text, 118, break_long_words=False, break_on_hyphens=False), ""]


if __name__ == "__main__":
    main()
