"""Tuning: the search for the cheapest setting within an error, and the files of settings."""

import importlib.util
import json
import shlex
import sys
import tomllib
import zlib
from concurrent.futures import Executor, Future
from pathlib import Path

import numpy as np
import pytest

import warpfem as wf
from warpfem.cli import main, parser
from warpfem.commands.session import FAILED, OK, WRONG_USE
from warpfem.commands.tune import _tune_command
from warpfem.errors import SceneError, SimulationError
from warpfem.motion import Motion
from warpfem.solvers import Quasistatic
from warpfem.solvers.implicit import ImplicitSolver
from warpfem.trade.axes import mesh_control
from warpfem.trade.outcome import Order, Outcome
from warpfem.trade.problem import FORCED, Problem, Setting
from warpfem.trade.settings_file import SettingsFile
from warpfem.trade.store import Store
from warpfem.trade.study import Point, Study
from warpfem.trade.trials import Trial, coarsest_within, finer_in_time, steps_of, with_steps
from warpfem.trade.tune import tune

BAR = """
import warpfem as wf

def scene(cells: int = 4, E: float = 1e5, dt: float = 1 / 40) -> wf.Scene:
    mesh = wf.Mesh.rectangle((2, 1), (2 * cells, cells))
    bar = wf.Body("bar", mesh, wf.StableNeoHookean(E=E, nu=0.3), supports=[wf.Pin("left")])
    tip = wf.quantities.final_displacement("bar", at=(2, 0.5), axis=1)
    return wf.Scene([bar], wf.BackwardEuler(), dt=dt, gravity=(0, -1), damping=5.0, fps=20, frames=8,
                    quantities={"tip": tip})
"""


# ---- the search for one level


def levels(constant: float, power: float, cost: float = 1.0, failing: int = 0, rounding: float = 0.0):
    """Trials of n steps of a frame with an error of constant n^-power; those of few steps fail, float32 errs more."""

    def run(setting: Setting) -> Trial:
        steps = steps_of(setting, 10.0)
        run.tried.append(steps)
        failed = steps <= failing
        outcome = Outcome("diverged" if failed else "", seconds=[cost * steps])
        error = constant * steps**-power + (0.0 if "dtype" in setting else rounding)
        return Trial(setting, Point(setting, (outcome,)), np.inf if failed else error)

    run.tried = []
    return run


def search(run, goal: float, order: float, start: int = 1, **options) -> int | None:
    found = coarsest_within(
        run,
        with_steps(Setting(), 10.0, start),
        finer_in_time(10.0),
        lambda trial: float(steps_of(trial.setting, 10.0)),
        goal=goal,
        order=order,
        growth=1.0,
        **options,
    )
    return found and steps_of(found.setting, 10.0)


@pytest.mark.parametrize("start", [1, 5, 60])
@pytest.mark.parametrize(("power", "order"), [(1.0, 1.0), (2.0, 2.0), (1.3, 2.0), (3.0, 2.0)])
def test_the_search_ends_at_the_coarsest_level_or_a_little_finer(power, order, start):
    run, goal = levels(1.0, power), 1e-2
    coarsest = int(np.ceil(goal ** (-1.0 / power)))
    found = search(run, goal, order, start)
    assert coarsest <= found <= 1.3 * coarsest
    assert len(run.tried) <= 7


def test_levels_that_fail_are_refined():
    assert search(levels(0.01, 1.0, failing=1), 0.1, 1.0) == 2


def test_a_search_whose_errors_do_not_fall_ends():
    run = levels(1.0, 0.01)
    assert search(run, 1e-2, 1.0) is None
    assert len(run.tried) == 4  # the last in float64


def test_a_search_that_float32_stops_goes_on_in_float64():
    run = levels(1.0, 1.0, rounding=2e-2)
    assert 100 <= search(run, 1e-2, 1.0, start=40) <= 130
    assert len(run.tried) <= 10


def test_a_search_that_would_cost_too_much_ends():
    run = levels(1.0, 1.0)
    assert search(run, 1e-2, 1.0, most_seconds=30.0) is None
    assert max(run.tried) <= 30


# ---- the search for a setting, with outcomes that are made up


class Law:
    """Made-up errors and costs of settings of the bar; takes the place of running them.

    Args:
        stiffness: explicit steps of a cell's size at the coarsest.
        late: by what errors grow after half of the frames.
        noise: errors that no refinement reduces.
        opposed: the part of the errors in time that makes up for those in space.
        inertia: the error of equilibria in place of motion.
        bend: the error of linear elasticity, which takes half the time.
    """

    def __init__(
        self,
        stiffness: float = 20.0,
        late: float = 1.0,
        noise: float = 0.0,
        opposed: float = 0.0,
        inertia: float = 1.0,
        bend: float = 1.0,
    ) -> None:
        self.stiffness, self.late, self.noise, self.opposed = stiffness, late, noise, opposed
        self.inertia, self.bend = inertia, bend
        self.runs = 0

    def __call__(self, order: Order) -> Outcome:
        self.runs += 1
        problem, setting = order.problem, order.setting
        scene = problem.build(setting).scene
        body, solver = scene.bodies[0], scene.solver
        h = float(np.sqrt(2.0 / body.mesh.cell_count))
        quadratic = body.element == "quadratic"
        interval = 1.0 / scene.fps
        work = body.mesh.point_count
        in_space = 0.1 * h**3 if quadratic else 0.3 * h**2
        if isinstance(solver, ImplicitSolver):
            steps = scene.frames * max(1, round(interval / scene.dt))
            in_time = {1: 1.0, 2: 0.3, 3: 0.15}[solver.order] * (scene.frames * interval / steps) ** solver.order / 0.05
            seconds = steps * 1e-3 * (1.0 + 0.1 * work) * solver.order * (0.4 if solver.max_iterations == 1 else 1.0)
        elif isinstance(solver, Quasistatic):
            steps, in_time, seconds = scene.frames, 10.0 * self.inertia, 1e-3 * (1.0 + 0.1 * work)
        else:
            steps = round(scene.frames * self.stiffness * (2 if quadratic else 1) / h)
            in_time = 1e-5
            seconds = steps * 1e-4 * (1.0 + 0.02 * work)
        linear = isinstance(body.material, wf.LinearElasticity)
        seconds *= 0.5 if linear else 1.0
        times = interval * np.arange(scene.frames + 1)
        later = np.where(times > 4.5 * interval, self.late, 1.0)
        chance = np.random.default_rng(zlib.crc32(setting.canonical.encode())).normal(size=2)
        own = np.array([0.5 * in_space, (1.0 - self.opposed) * 0.1 * in_time]) + self.noise * chance
        own[0] -= self.opposed * 0.1 * in_time
        own[1] += self.bend if linear else 0.0
        places = sum(map(len, order.places))
        motion = np.sin(times)[:, None, None] * (1.0 + later[:, None, None] * own) * np.ones((1, places, 1))
        return Outcome(
            load=order.load,
            seconds=[seconds],
            points=work,
            mesh_size=h,
            steps=steps,
            shortest_dt=scene.frames * interval / steps,
            longest_dt=scene.frames * interval / steps,
            quantities={"tip": 1.0 + own[0]},
            times=times,
            motion=motion,
        )


class Here(Executor):
    """Runs what it is given at once."""

    def submit(self, function, order):
        future: Future = Future()
        future.set_result(function(order))
        return future


def study_of(bar: Path, law: Law, monkeypatch, limit: float = 1e4) -> Study:
    monkeypatch.setattr("warpfem.trade.study.run_order", law)
    return Study(Problem.of(bar), Store(bar.parent / "runs"), Here(), limit=limit)


def sweep(study: Study, law: Law, target: float, name: str) -> float:
    """The least cost of settings within an error of the exact motion."""
    explicit = [{"scene.solver": "velocity_verlet", "scene.dt": "auto"}]
    implicit = [
        {"scene.solver": scheme, "scene.dt": f"1/{20 * n}"}
        for scheme in ("linearised", "backward_euler", "implicit_midpoint", "sdirk2", "sdirk3")
        for n in (1, 2, 4, 8)
    ]
    best = np.inf
    for cells in (1, 2, 3, 4, 6, 8, 12):
        for element in ("linear", "quadratic"):
            for own in explicit + implicit:
                setting = Setting.of(cells=cells, **{"scene.element": element}, **own)
                outcome = law(Order(study.problem, setting, study.places, 1, 1.0, "serial"))
                best = min(best, outcome.seconds[0]) if true_error(outcome, name) <= target else best
    return best


def true_error(outcome: Outcome, name: str) -> float:
    if name == "tip":
        return abs(outcome.quantities["tip"] - 1.0)
    exact = np.broadcast_to(np.sin(outcome.times)[:, None, None], outcome.motion.shape)
    off = np.sqrt(((outcome.motion - exact) ** 2).sum(axis=-1).mean())
    return off / np.sqrt((exact**2).sum(axis=-1)).max()


@pytest.mark.parametrize(
    ("stiffness", "late", "opposed", "target", "name"),
    [
        (5.0, 1.0, 0.0, 0.01, "l2"),  # explicit steps win
        (1e4, 1.0, 0.0, 0.01, "l2"),  # only implicit ones can be
        (200.0, 1.0, 0.0, 0.1, "l2"),
        (200.0, 1.0, 1.0, 0.02, "l2"),  # the errors of the longest steps make up for those of the coarsest meshes
        (200.0, 1.0, 0.0, 0.001, "l2"),
        (200.0, 4.0, 0.0, 0.01, "l2"),  # the frames that the search has not seen are harder
        (200.0, 0.1, 0.0, 0.01, "l2"),  # or easier
        (200.0, 1.0, 0.0, 0.01, "tip"),
    ],
)
def test_what_is_found_is_within_the_error_at_little_more_than_the_least_cost(
    bar, monkeypatch, stiffness, late, opposed, target, name
):
    law = Law(stiffness, late, opposed=opposed)
    study = study_of(bar, law, monkeypatch)
    found = tune(study, mesh_control(study.problem), name, target, repeats=1)
    runs = law.runs
    assert true_error(found.point.first, name) <= target
    assert found.error == pytest.approx(true_error(found.point.first, name), abs=0.1 * target)
    assert found.point.seconds <= 2.0 * sweep(study, law, target, name)
    assert runs < 80 < (law.runs - runs) / 3.0  # settings of the sweep
    if late == 4.0:
        assert found.seen < found.unseen


def test_what_errs_more_only_on_the_frames_of_the_search_is_found(bar, monkeypatch):
    law = Law(5.0, late=0.1)
    study = study_of(bar, law, monkeypatch)
    found = tune(study, mesh_control(study.problem), "l2", 0.003, repeats=1)
    assert found.unseen < 0.003 < found.seen
    assert true_error(found.point.first, "l2") <= 0.003
    assert found.point.seconds <= 1.2 * sweep(study, law, 0.003, "l2")


@pytest.mark.parametrize("inertia", [1e-4, 0.03])
def test_equilibria_take_the_place_of_motion_only_where_they_are_accurate_enough(bar, monkeypatch, inertia):
    law = Law(inertia=inertia)
    study = study_of(bar, law, monkeypatch)
    found = tune(study, mesh_control(study.problem), "l2", 0.01, repeats=1)
    assert (found.setting["scene.solver"] == "quasistatic") == (inertia < 0.003)
    assert true_error(found.point.first, "l2") <= 0.01
    if inertia < 0.003:
        assert found.parts["model"] == pytest.approx(inertia * share_of_errors(found.point.first, 1.0), rel=0.05)
        assert "time" not in found.parts


@pytest.mark.parametrize("bend", [1e-4, 0.03])
def test_linear_elasticity_is_taken_only_where_it_is_accurate_enough(bar, monkeypatch, bend):
    law = Law(5.0, late=0.1, bend=bend)
    study = study_of(bar, law, monkeypatch)
    found = tune(study, mesh_control(study.problem), "l2", 0.01, repeats=1)
    assert ("scene.material" in found.setting) == (bend < 0.003)
    assert true_error(found.point.first, "l2") <= 0.01
    if bend < 0.003:  # told over all frames, not over those of the search
        assert found.parts["model"] == pytest.approx(bend * share_of_errors(found.point.first, 0.1), rel=0.05)


def share_of_errors(outcome: Outcome, late: float) -> float:
    """The root mean square of one component of the motion, in late frames times a factor, over the peak of the two."""
    motion = np.sin(outcome.times)
    return float(
        np.sqrt(np.mean((np.where(outcome.times > 4.5 / 20, late, 1.0) * motion) ** 2)) / np.sqrt(2.0) / motion.max()
    )


def test_tuning_that_was_interrupted_goes_on(bar, monkeypatch):
    class Interrupted(Law):
        def __call__(self, order):
            if self.runs == 10:
                raise KeyboardInterrupt
            return super().__call__(order)

    study = study_of(bar, Interrupted(), monkeypatch)
    mesh = mesh_control(study.problem)
    with pytest.raises(KeyboardInterrupt):
        tune(study, mesh, "l2", 0.01)
    law = Law()
    resumed = tune(study_of(bar, law, monkeypatch), mesh, "l2", 0.01)
    again = Law()
    assert tune(study_of(bar, again, monkeypatch), mesh, "l2", 0.01).setting == resumed.setting
    assert law.runs > 0 == again.runs


def test_motion_without_a_limit_is_refused(bar, monkeypatch):
    study = study_of(bar, Law(noise=0.1), monkeypatch)
    with pytest.raises(SimulationError, match=r"within 1 % of the motion .* the reference itself may be off by"):
        tune(study, mesh_control(study.problem), "l2", 0.01)


def test_no_setting_within_the_limit_is_refused(bar, monkeypatch):
    study = study_of(bar, Law(), monkeypatch, limit=0.05)
    with pytest.raises(SimulationError):
        tune(study, mesh_control(study.problem), "l2", 0.001)


# ---- the command


def test_the_command_writes_settings_that_run_takes(bar, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("warpfem.trade.study.run_order", Law(5.0))
    assert main(["tune", str(bar), "--error", "2%", "--set", "E=2e5", "--json"]) == OK
    found = json.loads(capsys.readouterr().out)
    assert found["estimate"]["error"] + found["estimate"]["band"] <= 0.02
    path = tmp_path / "output" / "bar.settings.toml"
    own = tomllib.loads(path.read_text())
    assert own["scene"] == "bar.py" and own["parameters"]["E"] == "2e5"
    assert own["changes"]["solver"] == "velocity_verlet"
    assert own["estimate"]["command"] == f"warpfem tune {bar} --error 0.02 --set E=2e5"
    choice = SettingsFile.read(path).choose(path, bar, {})
    assert choice.scene.solver.name == "velocity_verlet" and choice.scene.bodies[0].material.E == pytest.approx(2e5)
    assert main(["tune", str(bar), "--error", "2%", "--set", "E=2e5"]) == OK  # from what is kept
    printed = capsys.readouterr()
    assert "The cheapest setting found within 2 % of the motion (L2)" in printed.out
    assert "which the search has not seen" in printed.out and "s of steps" not in printed.err


def test_the_command_that_a_file_tells_of_can_be_given_again(tmp_path):
    words = ["tune", str(tmp_path / "my bar.py"), "--error", "0.02", "--set", "kind=a b", "--quantity", "tip sag"]
    assert shlex.split(_tune_command(parser().parse_args(words))) == ["warpfem", *words]


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (["--error", "1%", "--quantity", "tipp"], WRONG_USE, "no quantity 'tipp'"),
        (["--error", "1%", "--set", "cels=3"], WRONG_USE, "did you mean 'cells'"),
        (["--error", "0.001%", "--limit", "1"], FAILED, "within 0.001 %"),
    ],
)
def test_questions_without_an_answer(bar, tmp_path, monkeypatch, capsys, arguments, code, message):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("warpfem.trade.study.run_order", Law(5.0))
    assert main(["tune", str(bar), *arguments]) == code
    assert message in capsys.readouterr().err


# ---- files of settings


@pytest.fixture
def settings(bar, tmp_path) -> Path:
    path = tmp_path / "bar.toml"
    names = {"element": "quadratic", "solver": "sdirk2", "dt": "1/60", "tolerance": "1e-3", "dtype": "float64"}
    setting = Setting.of(cells=3, **{f"{FORCED}{name}": value for name, value in names.items()})
    notes = {"estimate": {"error": 0.008, "quantity": "l2"}, "machine": {"cores": 2}}
    SettingsFile.of(Problem.of(bar, {"E": "3e5"}), setting, notes).write(path, ["for people"])
    return path


def test_settings_come_back_as_they_were_written(bar, settings):
    text = settings.read_text()
    assert text.startswith("# for people\n") and "cells = 3\n" in text and 'dt = "1/60"' in text
    read = SettingsFile.read(settings)
    assert read.parameters == {"E": "3e5", "cells": "3"}
    assert read.notes["estimate"] == {"error": 0.008, "quantity": "l2"}
    choice = read.choose(settings, bar, {})
    scene, body = choice.scene, choice.scene.bodies[0]
    assert (choice.dtype, scene.solver.name, scene.solver.tolerance) == ("float64", "sdirk2", 1e-3)
    assert (scene.dt, body.element) == (pytest.approx(1 / 60), "quadratic")
    assert body.mesh.cell_count == 2 * 6 * 3 and body.material.E == pytest.approx(3e5)


TEXTS = [
    "3",
    "-2.5",
    "1e-05",
    "3e5",
    "1.50",
    "007",
    "1e400",
    "9" * 30,
    "9" * 5000,
    "-0",
    "true",
    "True",
    "nan",
    "[3]",
    "1/60",
]


@pytest.mark.parametrize("text", TEXTS, ids=lambda text: text[:8])
def test_texts_come_back_as_they_are(bar, tmp_path, text):
    path = tmp_path / "texts.toml"
    SettingsFile("bar.py", "", {"kind": text}, {"dt": text}).write(path, [])
    read = SettingsFile.read(path)
    assert (read.parameters, read.changes) == ({"kind": text}, {"dt": text})


def test_the_command_line_wins_over_settings(bar, settings):
    choice = SettingsFile.read(settings).choose(settings, bar, {"cells": "1", "dt": "0.01"})
    assert choice.scene.bodies[0].mesh.cell_count == 4
    assert choice.scene.dt == 0.01  # the file's own dt is forced upon whatever the scene says, but not upon this


def test_settings_of_a_scene_that_has_changed_are_told_of(bar, settings):
    bar.write_text(bar.read_text() + "\n# more\n")
    with pytest.warns(UserWarning, match="its estimate of the error may not hold"):
        SettingsFile.read(settings).choose(settings, bar, {})


def test_settings_of_a_scene_under_another_name_are_taken(bar, settings):
    other = bar.with_name("other.py")
    other.write_text(bar.read_text())
    assert SettingsFile.read(settings).choose(settings, other, {}).dtype == "float64"


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("solver =", "solvr =", "no scene has a 'solvr' to change; did you mean 'solver'"),
        ("cells =", "cels =", "no parameter 'cels'; did you mean 'cells'"),
        ('"sdirk2"', '"sdirk4"', "no solver 'sdirk4'"),
        ("[changes]", "[chances]", "no 'chances' in settings; did you mean 'changes'"),
        ("[changes]", "changes", "no file of settings"),
        ("cells = 3", "cells = [3]", "cells must be a number or a text"),
        ('scene = "bar.py"', "scene = 3", "scene must be a text"),
        ('scene = "bar.py"', "", "the name of the scene is missing"),
        ('"1/60"', '"soon"', "'soon' is no number"),
    ],
)
def test_broken_settings_are_refused(bar, settings, old, new, message):
    settings.write_text(settings.read_text().replace(old, new, 1))
    with pytest.raises(SceneError, match=message) as caught:
        SettingsFile.read(settings).choose(settings, bar, {})
    assert str(settings) in "".join([str(caught.value), *getattr(caught.value, "__notes__", ())])


def test_settings_of_another_scene_are_refused(bar, settings):
    other = bar.with_name("other.py")
    other.write_text(BAR + "\n")
    with pytest.raises(SceneError, match=r"has settings of bar\.py, not of"):
        SettingsFile.read(settings).choose(settings, other, {})


def test_settings_that_are_not_there(tmp_path):
    with pytest.raises(SceneError, match="cannot read the settings"):
        SettingsFile.read(tmp_path / "none.toml")


def test_run_and_static_take_settings(bar, settings, tmp_path, capsys):
    plain = settings.read_text().replace('solver = "sdirk2"', 'solver = "backward_euler"')
    settings.write_text(plain.replace('dtype = "float64"', 'dtype = "float32"'))
    run = ["run", str(bar), "--settings", str(settings), "--frames", "1", "--out", str(tmp_path / "a.usdc")]
    assert main([*run, "--json"]) == OK
    summary = json.loads(capsys.readouterr().out)
    assert (summary["steps"], summary["dtype"]) == (3, "float32")
    assert main([*run, "--overwrite", "--json", "--set", "dt=0.05"]) == OK
    assert json.loads(capsys.readouterr().out)["steps"] == 1


def test_the_page_of_the_benchmark_is_that_of_its_results(monkeypatch):
    root = Path(__file__).parent.parent
    spec = importlib.util.spec_from_file_location("tuning", root / "benchmarks" / "tuning.py")
    benchmark = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, "tuning", benchmark)
    spec.loader.exec_module(benchmark)
    results = json.loads((root / "docs" / "tuning.json").read_text())
    assert benchmark.page(results) == (root / "docs" / "tuning.md").read_text()


@pytest.mark.slow
def test_what_is_found_is_within_the_error_of_a_finer_run(bar, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["tune", str(bar), "--error", "3%", "--quantity", "tip", "--json"]) == OK
    found = json.loads(capsys.readouterr().out)
    assert found["estimate"]["error"] + found["estimate"]["band"] <= 0.03
    problem = Problem.of(bar)
    settings = SettingsFile.read(tmp_path / "output" / "bar.settings.toml")
    fine = {"element": "quadratic", "solver": "sdirk2", "dt": "1/160"}
    scenes = [
        settings.choose(tmp_path, bar, {}).scene,
        problem.build(Setting.of(cells=12, **{f"{FORCED}{name}": value for name, value in fine.items()})).scene,
    ]
    own, exact = (scene.quantities["tip"](Motion.of(wf.Simulation(scene, dtype="float64"))) for scene in scenes)
    assert own == pytest.approx(exact, rel=0.03)
