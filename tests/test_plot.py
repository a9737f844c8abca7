"""Plots of logs: what is in them, which log is meant, and what is refused."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from warpfem.cli import main
from warpfem.commands.session import OK, WRONG_USE
from warpfem.errors import MissingExtraError, OutputError
from warpfem.log_file import FIGURES, LogTable, head, read_log, row
from warpfem.plot import draw, log_of, plot

pytest.importorskip("matplotlib")

TIMES = np.linspace(0.0, 1.0, 11)
CURVES = {
    "a ux [m]": 0.0 * TIMES,
    "a uy [m]": -TIMES,
    "a.top uy [m]": -2.0 * TIMES,
    "a.bottom uy [m]": -1.001 * TIMES,
}


def write(path: Path, frame_count: int = 11, curves: dict[str, np.ndarray] = CURVES, **figures: np.ndarray) -> Path:
    """Writes a log of a body that sinks; ``figures`` go by the first word of their names."""
    names = [*FIGURES, *curves]
    own = {"frame": np.arange(11), "time": TIMES, "elastic": TIMES**2, "total": TIMES**2, "steps": 2 * np.arange(11)}
    own |= figures
    columns = [own.get(name.split()[0], np.zeros(11)) for name in FIGURES] + list(curves.values())
    lines = [row(path, names, [column[i].item() for column in columns]) for i in range(frame_count)]
    path.write_text(head(path, names) + "".join(lines))
    return path


def drawn(table: LogTable) -> dict[str, dict[str, np.ndarray]]:
    """The lines of each panel by their labels, by the label of the panel."""
    figure = draw(table, {name: table.column(name) for name in CURVES if name in table.names}, "run")
    panels = {axes.get_ylabel(): axes for axes in figure.axes}
    assert figure.axes[-1].get_xlabel() == "time [s]"
    for axes in figure.axes:
        for line in axes.lines:
            assert np.array_equal(line.get_xdata(), table.column("time [s]"))
    return {label: {line.get_label(): line.get_ydata() for line in axes.lines} for label, axes in panels.items()}


@pytest.mark.parametrize("suffix", [".csv", ".jsonl"])
def test_a_plot_shows_what_the_log_says(tmp_path: Path, suffix: str) -> None:
    panels = drawn(read_log(write(tmp_path / f"run{suffix}", largest=5.0 * TIMES, least=1.0 - 0.1 * TIMES)))
    assert list(panels) == ["energy", "displacement", "largest von Mises stress", "least J"]
    assert list(panels["energy"]) == ["elastic", "total"]  # the others are zero
    assert np.array_equal(panels["energy"]["elastic"], TIMES**2)
    assert list(panels["displacement"]) == ["a.top uy", "a.bottom uy"]  # not what stays, nor what looks the same
    assert np.array_equal(panels["displacement"]["a.top uy"], -2.0 * TIMES)
    (stress,), (least,) = panels["largest von Mises stress"].values(), panels["least J"].values()
    assert np.array_equal(stress, 5.0 * TIMES)
    assert np.array_equal(least, 1.0 - 0.1 * TIMES)


@pytest.mark.parametrize("frame_count", [1, 2])
def test_short_logs_and_gaps_are_drawn(tmp_path: Path, frame_count: int) -> None:
    path = write(tmp_path / "run.jsonl", frame_count, elastic=np.full(11, np.inf))
    assert np.isnan(drawn(read_log(path))["energy"]["elastic"]).all()
    assert drawn(read_log(write(tmp_path / "run.csv", frame_count, curves={})))["displacement"] == {}


def test_numbers_on_the_axes_have_units(tmp_path: Path) -> None:
    table = read_log(write(tmp_path / "run.csv", largest=5e4 * TIMES))
    figure = draw(table, {"a uy [m]": 1e-3 * table.column("a uy [m]")}, "run")
    figure.canvas.draw()
    ticks = [" ".join(label.get_text() for label in axes.get_yticklabels()) for axes in figure.axes]
    for text, unit in zip(ticks, ("mJ", "µm", "kPa", ""), strict=True):
        assert unit in text


def test_steps_that_did_not_converge_are_in_the_title(tmp_path: Path) -> None:
    table = read_log(write(tmp_path / "run.csv", unconverged=np.arange(11)))
    assert draw(table, {}, "run").get_suptitle() == "run: 11 frames, 20 steps, 10 of them NOT CONVERGED"
    table = read_log(write(tmp_path / "run.csv"))
    assert draw(table, {}, "run").get_suptitle() == "run: 11 frames, 20 steps"


@pytest.mark.parametrize("run", ["run.usdc", "run.partial.usda", "run.csv", "run"])
def test_the_log_is_found_beside_the_animation(tmp_path: Path, run: str) -> None:
    path = write(tmp_path / "run.csv")
    assert log_of(tmp_path / run) == path
    write(tmp_path / "run.jsonl")
    assert log_of(tmp_path / run) == path
    path.unlink()
    if run != "run.csv":
        assert log_of(tmp_path / run) == tmp_path / "run.jsonl"


def test_the_picture_is_beside_the_log(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    write(tmp_path / "run.csv")
    assert main(["plot", str(tmp_path / "run.usdc")]) == OK
    picture = tmp_path / "run.plot.png"
    assert capsys.readouterr().out == f"wrote {picture}\n"
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert sorted(tmp_path.iterdir()) == [tmp_path / "run.csv", picture]


def test_curves_are_chosen_by_their_names(tmp_path: Path) -> None:
    path = write(tmp_path / "run.csv")
    text = plot(path, tmp_path / "run.svg", curves=["ux", "bottom"]).read_text()
    assert "<svg" in text
    named = [name for name in CURVES if f"<!-- {name.removesuffix(' [m]')} -->" in text]  # as Matplotlib notes them
    assert named == ["a.bottom uy [m]"]  # ux stays where it is
    with pytest.raises(OutputError, match="no displacement with 'tip' in its name: it has a ux "):
        plot(path, curves=["tip"])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["missing.csv"], "missing.csv cannot be read"),
        (["missing.usdc"], "neither missing.csv nor missing.jsonl is there: `warpfem run SCENE --log"),
        (["empty.csv"], "empty.csv has no frames yet"),
        (["empty.jsonl"], "empty.jsonl has no frames yet"),
        (["broken.csv"], "broken.csv is no log of a run, or damaged: line 2"),
        (["run.csv", "--out", "a.pdf"], "must end in .png or .svg"),
        (["run.csv", "--out", "folder.png"], "is a folder"),
        ([""], "is no log"),
    ],
)
def test_what_cannot_be_drawn_is_one_message_and_no_file(tmp_path, monkeypatch, capsys, arguments, message):
    monkeypatch.chdir(tmp_path)
    write(Path("run.csv"))
    write(Path("empty.csv"), 0)
    write(Path("empty.jsonl"), 0)
    Path("broken.csv").write_text(head(Path("broken.csv"), FIGURES) + "1,2\n")
    Path("folder.png").mkdir()
    before = sorted(tmp_path.rglob("*"))
    assert main(["plot", *arguments]) == WRONG_USE
    printed = capsys.readouterr().err
    assert message in printed and printed.count("\n") == 1
    assert sorted(tmp_path.rglob("*")) == before


def test_without_matplotlib_the_extra_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write(tmp_path / "run.csv")
    for module in [name for name in sys.modules if name.split(".")[0] == "matplotlib"]:
        monkeypatch.delitem(sys.modules, module)
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(MissingExtraError, match=r"the plot needs .*warpfem\[plot\]"):
        plot(path)
