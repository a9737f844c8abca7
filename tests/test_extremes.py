"""The stability table: its cases in their quick form, and how their results are reported."""

import json
from collections.abc import Iterator

import numpy as np
import pytest

from warpfem.cli import main
from warpfem.commands.session import FAILED, OK, WRONG_USE
from warpfem.errors import MaterialError, SimulationError
from warpfem.extremes import CASES, Case, Trial, report
from warpfem.extremes.recovery import block, jacobians, misfit, released, with_one_inverted
from warpfem.extremes.subjects import rotation
from warpfem.extremes.table import at_most, attempted, refused
from warpfem.materials import StVenantKirchhoff
from warpfem.simulation import Simulation


@pytest.mark.parametrize("number", sorted(CASES))
def test_no_trial_fails(number):
    outcome = report.run_case(CASES[number], quick=True)
    assert outcome.count("FAIL") == 0, report.text_row(outcome)


# ---- trials


def test_a_figure_passes_up_to_its_limit():
    assert at_most("a", 1.0, 1.0).status == "pass"
    assert at_most("a", 1.1, 1.0, " N") == Trial("a", "FAIL", "1.1 N (limit 1 N)", ratio=1.1)
    assert at_most("a", float("nan"), 1.0).status == "FAIL"
    assert at_most("a", 0.0, 0.0).status == "pass"


def test_a_refusal_must_be_one_of_warpfem_and_clear():
    def refuse():
        raise MaterialError("nu must be in (-1, 0.5)")

    assert refused("a", refuse, "nu", "0.5") == Trial("a", "refused", "", "nu must be in (-1, 0.5)")
    assert refused("a", refuse, "density").status == "FAIL"
    assert refused("a", lambda: 3).status == "FAIL"
    with pytest.raises(ZeroDivisionError):
        refused("a", lambda: 1 / 0)


def test_a_refusal_where_none_is_allowed_fails():
    def diverge() -> Trial:
        raise SimulationError("t = 1 s: diverged")

    assert attempted("a", diverge) == Trial("a", "FAIL", "stopped", "SimulationError: t = 1 s: diverged")
    assert attempted("a", lambda: Trial("a", "pass")).status == "pass"


# ---- recovery


def test_misfit_is_free_of_rigid_motion_but_not_of_mirroring():
    mesh = block(3, quick=True)
    x = mesh.points
    turned = x @ rotation(np.ones(3), 2.0).T + (3.0, 0.0, 1.0)
    assert misfit(x, turned - x, linear=False) < 1e-14
    assert (
        misfit(x, x @ rotation(np.ones(3), 0.1).T - x, linear=True) > 1e-3
    )  # a rotation is none for linear elasticity
    assert misfit(x, np.cross((0.0, 0.1, 0.2), x), linear=True) < 1e-14
    assert misfit(x, -2.0 * x * (1.0, 0.0, 0.0), linear=False) > 0.5
    assert misfit(x, 0.01 * x, linear=False) == pytest.approx(0.01 * np.sqrt(0.75))


def test_a_body_that_rests_elsewhere_is_refused_only_with_a_warning(monkeypatch):
    mesh = block(2, quick=True)
    mirrored = mesh.points * (-1.0, 1.0)
    trial = released("mirrored", mesh, StVenantKirchhoff(1e5, 0.3), "float64", mirrored)
    assert trial.status == "refused"
    assert "StVenantKirchhoff does not turn them back" in trial.note
    monkeypatch.setattr(Simulation, "_warn_of_inverted_cells", lambda *_: None)
    trial = released("mirrored", mesh, StVenantKirchhoff(1e5, 0.3), "float64", mirrored)
    assert trial.status == "FAIL"
    assert "at rest, 8 of 8 cells inverted" in trial.note


def test_starts_are_what_they_are_called():
    mesh = block(3, quick=True)
    assert (jacobians(mesh, with_one_inverted(mesh)) < 0.0).sum() == 1
    assert (jacobians(mesh, mesh.points * (-1.0, 1.0, 1.0)) < 0.0).all()


# ---- reports


def two_passes(quick: bool) -> Iterator[Trial]:
    yield at_most("mild", 0.25, 1.0, " m")
    yield at_most("harsh", 0.5, 1.0, " m")


def one_failure(quick: bool) -> Iterator[Trial]:
    yield Trial("mild", "refused", note="E must be finite and > 0")
    yield at_most("harsh | odd", float("inf"), 1.0)


def a_crash(quick: bool) -> Iterator[Trial]:
    yield Trial("mild", "pass")
    raise IndexError("no such\ncell")


@pytest.fixture
def cases(monkeypatch) -> dict[int, Case]:
    """Three cases instead of the real ones."""
    made = {i: Case(i, f"title {i}", f"criterion {i}", f) for i, f in enumerate((two_passes, one_failure, a_crash), 1)}
    monkeypatch.setattr("warpfem.extremes.CASES", made)
    monkeypatch.setattr("os.cpu_count", lambda: 1)  # processes of their own would not see them
    return made


def test_a_crash_is_a_failure_that_says_where(cases):
    outcome = report.run_case(cases[3], quick=True)
    assert [trial.status for trial in outcome.trials] == ["pass", "FAIL"]
    assert "IndexError" in outcome.trials[-1].note
    assert "test_extremes.py, line" in outcome.trials[-1].note


def test_a_case_that_tries_nothing_fails():
    assert report.run_case(Case(1, "empty", "", lambda quick: iter(())), quick=True).count("FAIL") == 1


def test_exit_code_is_0_only_without_failures(cases, capsys):
    assert main(["extremes", "--quick", "--case", "1"]) == OK
    assert main(["extremes", "--quick", "--case", "2", "1"]) == FAILED
    assert main(["extremes", "--quick", "--case", "3"]) == FAILED
    assert main(["extremes", "--quick", "--case", "4"]) == WRONG_USE
    assert "there is no case 4: the cases are 1, 2, 3" in capsys.readouterr().err


def test_the_table_has_the_counts_the_worst_figure_and_every_failure(cases, capsys):
    main(["extremes", "--quick"])
    lines = capsys.readouterr().out.splitlines()
    assert lines[1].split()[:6] == ["1", "title", "1", "2", "0", "0"]
    assert lines[1].endswith("0.5 m (limit 1 m): harsh")
    assert lines[2].split()[:6] == ["2", "title", "2", "0", "1", "1"]
    assert lines[3].strip() == "FAIL harsh | odd: inf (limit 1)"
    assert "FAIL trial 2 and those after it: crashed; IndexError" in "\n".join(lines[5:])


def test_json_is_valid_and_the_only_output(cases, capsys):
    assert main(["extremes", "--quick", "--json"]) == FAILED

    def no_constant(name):
        raise AssertionError(f"{name} is not JSON")

    data = json.loads(capsys.readouterr().out, parse_constant=no_constant)
    assert (data["pass"], data["refused"], data["fail"]) == (3, 1, 2)
    assert [case["case"] for case in data["cases"]] == [1, 2, 3]
    assert data["cases"][0]["trials"][1] == {
        "setting": "harsh",
        "status": "pass",
        "measured": "0.5 m (limit 1 m)",
        "note": "",
        "ratio": 0.5,
    }


def test_the_full_form_writes_the_page_and_parts_do_not(cases, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    main(["extremes", "--quick"])
    main(["extremes", "--case", "1"])
    assert not list(tmp_path.iterdir())
    main(["extremes"])
    page = (tmp_path / "docs" / "stability.md").read_text()
    assert "`warpfem extremes`" in page
    assert "| 1 | title 1 | 2 | 0 | 0 | 0.5 m (limit 1 m): harsh |" in page
    assert "## 2. title 2\n\ncriterion 2\n" in page
    assert r"| harsh \| odd | FAIL | inf (limit 1) |  |" in page
    assert "no such cell" in page
    main(["extremes", "--quick", "--case", "1", "--out", "part.md"])
    assert "## 2" not in (tmp_path / "part.md").read_text()
    # nothing but the figures changes from run to run
    main(["extremes", "--out", "again.md"])
    assert (tmp_path / "again.md").read_text() == page


def test_a_page_that_cannot_be_written_is_refused_first(cases, tmp_path, capsys):
    (tmp_path / "file").write_text("")
    assert main(["extremes", "--out", str(tmp_path / "file" / "page.md")]) == WRONG_USE
    captured = capsys.readouterr()
    assert "cannot write" in captured.err
    assert captured.out == ""
