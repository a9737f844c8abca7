"""Writes the page from the results that there are, and its plots."""

import textwrap
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

Results = dict[str, Any]


def write(results: Results, out: Path) -> None:
    """Writes the page and, beside it in a folder of its name, the plots."""
    folder = out.with_suffix("")
    lines = [
        "# Performance",
        "",
        *_prose(
            "Written by `make bench` (`python benchmarks/performance`), which runs warpfem and the "
            "other codes in turn, in "
            "processes that wait while the others run. Times are medians over the turns; *times "
            "warpfem* is the median over "
            "turns of the ratio within one, which a change of the clock rate between turns does not "
            "touch, and ± half the "
            "distance of the quartiles. Figures that fall short of what was aimed at are marked. "
            "Everything measured is in "
            f"[results.json]({folder.name}/results.json)."
        ),
    ]
    sections: dict[str, Callable[[Results, Path], list[str]]] = {
        "explicit": _explicit,
        "implicit": _implicit,
        "trajectory": _trajectory,
        "static": _static,
        "scaling": _scaling,
        "start": _start,
    }
    known = {name: results[name] for name in sections if name in results}
    if known:
        lines += _machine(next(iter(known.values())))
    for name, result in known.items():
        lines += sections[name](result, folder)
        if result["quick"]:
            lines += ["*Measured with `--quick`: sizes and repeats are too small to judge by.*", ""]
    out.write_text("\n".join(lines).rstrip() + "\n")


def _table(head: Iterable[str], rows: Iterable[Iterable[object]]) -> list[str]:
    head = list(head)
    lines = ["| " + " | ".join(head) + " |", "|" + " --- |" * len(head)]
    return [*lines, *("| " + " | ".join(str(cell) for cell in row) + " |" for row in rows), ""]


def _prose(text: str) -> list[str]:
    return [*textwrap.wrap(text, 118, break_long_words=False, break_on_hyphens=False), ""]


def _time(seconds: float) -> str:
    return f"{seconds:.3g} s" if seconds >= 1.0 else f"{1e3 * seconds:.3g} ms"


def _target(wanted: str, value: float, met: bool) -> str:
    return f"{wanted}: **{value:.2f}**{'' if met else ' (falls short)'}"


def _find(group: Results, name: str) -> Results | None:
    return next((row for row in group["rows"] if row["name"] == name and not row["missing"]), None)


def _machine(result: Results) -> list[str]:
    facts, versions = result["machine"], result["versions"]
    caches = ", ".join(f"{level} {size}" for level, size in facts["caches"].items())
    return [
        "## Machine",
        "",
        f"{facts['processor']}, {facts['cores']} cores, {caches}, {facts['memory_gib']} GiB; vector units: "
        f"{', '.join(facts['vector_flags'])}; {facts['system']}, Python {facts['python']}.",
        "",
        "Versions: " + ", ".join(f"{name} {version}" for name, version in versions.items()) + ".",
        "",
    ]


# --- explicit steps ------------------------------------------------------------------------------------------


def _explicit(result: Results, folder: Path) -> list[str]:
    lines = [
        "## An explicit step",
        "",
        *_prose(
            "Symplectic Euler in float32, the whole step: forces, their sum per point, motion, held "
            "points. In millions of "
            "cells per second and thread count. All contenders get the same mesh, material and state; "
            "*differ* is the "
            "largest difference of the forces to warpfem's, relative to the largest. C++ is "
            "[limit.cpp](../benchmarks/performance/limit.cpp), where *lanes* and *strips* are "
            "explained; Taichi's variants are "
            "in [taichi_explicit.py](../benchmarks/performance/contenders/taichi_explicit.py)."
        ),
    ]
    for group in result["groups"]:
        lines += [f"### {group['cells']:,} cells, {group['material']}, threads: {group['threads']}", ""]
        rows = []
        for row in group["rows"]:
            if row["missing"]:
                rows.append([row["name"], row["missing"], "", "", "", "", ""])
                continue
            rows.append(
                [
                    row["name"],
                    f"{row['rate'] / 1e6:.1f} ± {100 * row['spread']:.0f} %",
                    f"{row['best_rate'] / 1e6:.1f}",
                    f"{row['times_warpfem']:.2f}" if "times_warpfem" in row else "",
                    f"{row['force_difference']:.0e}",
                    f"{row['displacement_difference']:.0e}",
                    f"{row['ready']['setup_seconds'] + row['ready']['first_seconds']:.2g} s",
                ]
            )
        head = [
            "",
            "million cells/s",
            "best turn",
            "time over warpfem's",
            "forces differ",
            "motion differs",
            "first run",
        ]
        lines += _table(head, rows)
        lines += _explicit_targets(group)
    return lines + _thread_targets(result) + _roofline(result, folder)


def _thread_targets(result: Results) -> list[str]:
    rates = {
        (group["cells"], group["material"], group["threads"]): own["rate"]
        for group in result["groups"]
        if (own := _find(group, "warpfem"))
    }
    told = [
        f"{cells:,} cells, {material}: " + _target("aimed at 1.8", rate / alone, rate / alone >= 1.8)
        for (cells, material, threads), rate in rates.items()
        if threads == 2 and cells > 50_000 and (alone := rates.get((cells, material, 1)))
    ]
    return ["Two threads over one: " + "; ".join(told) + ".", ""] if told else []


def _explicit_targets(group: Results) -> list[str]:
    own = _find(group, "warpfem")
    if own is None or group["cells"] < 50_000:
        return []
    limit = min(
        (r["times_warpfem"] for r in group["rows"] if r["name"].startswith("C++") and not r["missing"]), default=0
    )
    wanted = 0.7 if group["material"] == "stable_neo_hookean" else 0.5
    told = [_target(f"of the C++ limit, aimed at {wanted}", limit, limit >= wanted)]
    taichi = [r["times_warpfem"] for r in group["rows"] if r["name"].startswith("Taichi") and not r["missing"]]
    if taichi:
        told.append(_target("times faster than Taichi's best, aimed at 3", min(taichi), min(taichi) >= 3.0))
    return ["warpfem " + "; ".join(told) + ".", ""]


def _roofline(result: Results, folder: Path) -> list[str]:
    measured = [entry for entry in result["triad"] if entry["bytes_per_second"]]
    if not measured:
        return ["No C++ compiler was at hand: the bandwidth of memory was not measured.", ""]
    bytes_per_cell = result["step_bytes"]
    lines = [
        "### Roofline",
        "",
        *_prose(
            f"A step moves at least {bytes_per_cell} bytes for each cell. At the bandwidth of a triad "
            f"over arrays of a total "
            "size, which shows the caches, that allows"
        ),
    ]
    rows = [
        [
            f"{entry['megabytes']:.0f} MB",
            entry["threads"],
            f"{entry['bytes_per_second'] / 1e9:.1f}",
            f"{entry['bytes_per_second'] / bytes_per_cell / 1e6:.0f}",
        ]
        for entry in measured
    ]
    lines += _table(["arrays", "threads", "GB/s", "million cells/s"], rows)
    _plot_roofline(result, measured, folder / "roofline.png")
    return [*lines, f"![cells per second against the roof]({folder.name}/roofline.png)", ""]


def _plot_roofline(result: Results, measured: list[Results], path: Path) -> None:
    figure, axes = _figure("bytes a cell needs, from memory of the speed of the triad", "million cells/s")
    for threads in sorted({entry["threads"] for entry in measured}):
        points = [
            (e["megabytes"], e["bytes_per_second"] / result["step_bytes"] / 1e6)
            for e in measured
            if e["threads"] == threads
        ]
        axes.plot(*zip(*points, strict=True), "--", label=f"roof, threads: {threads}")
        for name, marker in (("warpfem", "o"), ("C++ strips3x16", "s"), ("Taichi serial", "^"), ("Taichi sums", "v")):
            points = [
                (g["cells"] * result["step_bytes"] / 1e6, row["rate"] / 1e6)
                for g in result["groups"]
                if g["threads"] == threads and g["material"] == "stable_neo_hookean"
                for row in g["rows"]
                if row["name"] == name and not row["missing"]
            ]
            if points:
                axes.plot(*zip(*sorted(points), strict=True), marker, label=f"{name}, threads: {threads}")
    axes.set_xlabel("data of a step [MB]")
    _save(figure, axes, path)


# --- implicit ----------------------------------------------------------------------------------------------------


def _implicit(result: Results, folder: Path) -> list[str]:
    lines = [
        "## A linearised implicit step",
        "",
        *_prose(
            f"One step of backward Euler from a deformed state, to a true residual of "
            f"{result['tolerance']:.0e}, computed in "
            "float64 afterwards; each turn takes two, of which the second counts. "
            "warpfem's systems have the exact tangent; those in the manner of Taichi's example "
            "([taichi_implicit.py](../benchmarks/performance/contenders/taichi_implicit.py)) leave the "
            "change of the rotation "
            "out, and *factored* solves with a constant matrix that it factored before."
        ),
    ]
    for group in result["groups"]:
        lines += [f"### {group['cells']:,} cells, threads: {group['threads']}", ""]
        rows = [
            [
                row["name"],
                row["missing"] or f"{_time(row['median'])} ± {100 * row['spread']:.0f} %",
                row.get("iterations", ""),
                f"{row['residual']:.1e}" if "residual" in row else "",
                f"{row['times_warpfem']:.2f}" if "times_warpfem" in row else "",
            ]
            for row in group["rows"]
        ]
        lines += _table(["", "time", "iterations", "true residual", "time over the first's"], rows)
        own = group["rows"][0]
        for name, wanted in (("Taichi shipped", 20.0), ("Taichi rewritten", 3.0)):
            other = _find(group, name)
            if other and not own["missing"]:
                factor = other["times_warpfem"]
                lines += [
                    _target(f"times faster than {name}, aimed at {wanted:.0f}", factor, factor >= wanted) + ".",
                    "",
                ]
    return lines


def _trajectory(result: Results, folder: Path) -> list[str]:
    lines = [
        "## A motion to 1 % of its peak",
        "",
        *_prose(
            f"A cantilever of {result['cells']} cells, E = 1 MPa, falls under its weight and swings for "
            f"{result['duration']} s "
            f"(peak {result['peak']:.2f} m). Wall time for a second of motion on one thread, and the "
            f"largest error over all "
            "points and samples relative to the peak. Newton's vertex block descent has another "
            "material, so that each is "
            "compared with a converged motion of its own. The cheapest setting within 1 % is marked. Steps are per "
            "interval of 0.05 s."
        ),
    ]
    for row in result["rows"]:
        if row["missing"]:
            lines += [f"{row['name']}: {row['missing']}.", ""]
            continue
        cells = [
            [
                f"**{s['name']}**" if s["chosen"] else s["name"],
                f"{100 * s['error']:.2g} %" if s["error"] < 10 else "diverges",
                f"{s['seconds']:.3g} s",
            ]
            for s in row["settings"]
        ]
        lines += [f"### {row['name']}", "", *_table(["setting", "error", "time per second"], cells)]
    return lines + _trajectory_targets(result)


def _trajectory_targets(result: Results) -> list[str]:
    chosen = {row["name"]: next((s for s in row["settings"] if s["chosen"]), None) for row in result["rows"]}
    own = chosen.get("warpfem")
    lines = []
    for name, wanted in (("Newton VBD", 10.0), ("Newton semi-implicit", 1.0)):
        other = chosen.get(name)
        if own and other:
            factor = other["seconds"] / own["seconds"]
            lines += [_target(f"times faster than {name}, aimed at {wanted:.0f}", factor, factor >= wanted) + ".", ""]
        elif own and any(row["name"] == name and row["settings"] for row in result["rows"]):
            lines += [f"{name} reached 1 % at no setting tried.", ""]
    return lines


def _static(result: Results, folder: Path) -> list[str]:
    lines = [
        "## A static solve",
        "",
        *_prose(
            "A beam 4 m by 1 m by 1 m under its weight, assembly included. Errors are the largest "
            "difference of displacements "
            f"to those by sparse LU, relative to the largest; {result['error']:.0e} is asked for."
        ),
    ]
    for group in result["groups"]:
        lines += [f"### {group['cells']:,} cells, {group['material']}, threads: {group['threads']}", ""]
        rows = [
            [
                row["name"],
                row["missing"] or _time(row["median"]),
                f"{row['error']:.1e}" if "error" in row else "",
                row.get("newton", ""),
                row.get("iterations", ""),
                f"{row['times_warpfem']:.2f}" if "times_warpfem" in row else "",
            ]
            for row in group["rows"]
        ]
        lines += _table(["", "time", "error", "Newton", "CG", "time over the first's"], rows)
        for row in group["rows"]:
            if "LU" in row["name"] and "times_warpfem" in row:
                factor = row["times_warpfem"]
                lines += [_target(f"times faster than {row['name']}, aimed at 3", factor, factor >= 3.0) + ".", ""]
    return lines


# --- scaling and start -------------------------------------------------------------------------------------------


def _scaling(result: Results, folder: Path) -> list[str]:
    lines = ["## Scaling", "", "### Explicit steps", ""]
    explicit = [row for row in result["explicit"] if not row["missing"]]
    rows = [
        [
            f"{row['cells']:,}",
            row["threads"],
            _time(row["median"]),
            f"{row['cells'] / row['median'] / 1e6:.1f}",
            f"{row['bytes_per_cell']:.0f}",
        ]
        for row in explicit
    ]
    lines += _table(["cells", "threads", "time per step", "million cells/s", "bytes per cell"], rows)
    figure, axes = _figure("cells", "time per step [s]")
    for threads in sorted({row["threads"] for row in explicit}):
        points = [(row["cells"], row["median"]) for row in explicit if row["threads"] == threads]
        axes.plot(*zip(*points, strict=True), "o-", label=f"explicit, threads: {threads}")
    _save(figure, axes, folder / "cells.png")
    lines += [f"![time per step against cells]({folder.name}/cells.png)", "", "### Static solves with multigrid", ""]
    static = [row for row in result["static"] if not row["missing"]]
    rows = [[f"{row['unknowns']:,}", row["newton"], row["iterations"], _time(row["median"])] for row in static]
    lines += _table(["unknowns", "Newton iterations", "CG iterations", "time"], rows)
    figure, axes = _figure("unknowns", "CG iterations per Newton iteration")
    axes.plot(
        [row["unknowns"] for row in static], [row["iterations"] / row["newton"] for row in static], "o-", label="static"
    )
    _save(figure, axes, folder / "iterations.png")
    counts = [row["iterations"] / row["newton"] for row in static]
    if counts:
        growth = max(counts) / counts[0]
        lines += [_target("iterations grow by, aimed at less than 2", growth, growth < 2.0) + ".", ""]
    return [*lines, f"![iterations against unknowns]({folder.name}/iterations.png)", ""]


def _start(result: Results, folder: Path) -> list[str]:
    lines = ["## Start", ""]
    rows = [[name, _time(seconds)] for name, seconds in result["seconds"].items()]
    return [*lines, *_table(["", "time"], rows)]


def _figure(horizontal: str, vertical: str):
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.0, 4.2), dpi=120)
    axes = figure.add_subplot()
    axes.set(xscale="log", yscale="log", xlabel=horizontal, ylabel=vertical)
    axes.grid(alpha=0.3, which="both")
    return figure, axes


def _save(figure, axes, path: Path) -> None:
    axes.legend(fontsize=7)
    figure.tight_layout()
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path)
