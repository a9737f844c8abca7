"""The trade between speed and accuracy: settings, errors, references, fronts, and studies that go on."""

import csv
import json
import os
import signal
import threading
import time
from concurrent.futures import Executor, Future
from pathlib import Path

import numpy as np
import pytest

import warpfem as wf
from warpfem.cli import main
from warpfem.commands.session import FAILED, OK, WRONG_USE
from warpfem.errors import OutputError, SceneError, SimulationError
from warpfem.trade.axes import kind_of, mesh_control, parse_axes, settings_of
from warpfem.trade.executors import cluster_executor, local_executor
from warpfem.trade.extrapolation import MOST_ORDER, extrapolate, observed_order, order_text
from warpfem.trade.front import answer, candidates, front
from warpfem.trade.ladders import Part
from warpfem.trade.measure import measure
from warpfem.trade.outcome import Order, Outcome
from warpfem.trade.problem import Problem, Setting
from warpfem.trade.process import run_order
from warpfem.trade.reference import DEFAULT_STIFFNESS, Reference, build_reference
from warpfem.trade.store import Store
from warpfem.trade.study import Point, Study, difference

BAR = """
import warpfem as wf

def scene(cells: int = 2, E: float = 1e5, dt: float = 1 / 40, kind: str = "soft") -> wf.Scene:
    mesh = wf.Mesh.rectangle((2, 1), (2 * cells, cells))
    bar = wf.Body("bar", mesh, wf.LinearElasticity(E=E, nu=0.3), supports=[wf.Pin("left")])
    tip = wf.quantities.final_displacement("bar", at=(2, 0.5), axis=1)
    return wf.Scene([bar], wf.BackwardEuler(), dt=dt, gravity=(0, -1), damping=5.0, fps=20, frames=8,
                    quantities={"tip": tip})
"""


@pytest.fixture
def in_process(monkeypatch):
    """Settings run in this process, which is quicker."""
    monkeypatch.setattr("warpfem.trade.study.run_order", measure)
    monkeypatch.setattr("warpfem.trade.measure.LONG", 0.0)


class Here(Executor):
    """Runs what it is given at once; fails as told."""

    def __init__(self, errors: list[BaseException | None] = ()) -> None:
        self.errors = list(errors)
        self.labels: list[str] = []

    def submit(self, function, order):
        future: Future = Future()
        error = self.errors.pop(0) if self.errors else None
        if isinstance(error, KeyboardInterrupt):
            raise error
        if error is not None:
            future.set_exception(error)
        else:
            self.labels.append(order.setting.label)
            future.set_result(function(order))
        return future


def fake(order: Order) -> Outcome:
    """An outcome whose error is 1 / cells^2, at a cost of cells^3."""
    cells = int(order.setting.get("cells", "2"))
    motion = np.full((3, 4, 2), 1.0 + cells**-2.0)
    times = np.arange(3.0)
    return Outcome(load=order.load, seconds=[0.01 * cells**3], mesh_size=1.0 / cells, times=times, motion=motion)


# ---- settings


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("cells", "--axis takes NAME=VALUE"),
        ("cells=", "--axis takes NAME=VALUE"),
        ("cels=1,2", "no axis 'cels'; did you mean 'cells'"),
        ("tolerence=1e-3", "did you mean 'tolerance'"),
        ("frames=3,4", "frames is no axis"),
    ],
)
def test_axes_that_there_are_not(bar, text, message):
    with pytest.raises(SceneError, match=message):
        parse_axes([text], Problem.of(bar))


def test_settings_are_all_combinations_without_what_does_not_apply(bar):
    problem = Problem.of(bar)
    axes = parse_axes(["solver=BackwardEuler,velocity_verlet", "tolerance=1e-2,1e-4", "dt=1/40"], problem)
    labels = [setting.label for setting in settings_of(axes, problem)]
    assert labels == [
        "solver=BackwardEuler tolerance=1e-2 dt=1/40",
        "solver=BackwardEuler tolerance=1e-4 dt=1/40",
        "solver=velocity_verlet dt=1/40",  # explicit steps have no tolerance: once is enough
    ]
    with pytest.raises(SceneError, match="given twice"):
        parse_axes(["cells=1", "cells=2"], problem)


def test_values_bring_settings_that_win_over_other_axes(bar):
    problem = Problem.of(bar)
    axes = parse_axes(["cells=1,2:solver=velocity_verlet:dt=auto", "solver=sdirk2", "dt=1/40,1/80"], problem)
    labels = [setting.label for setting in settings_of(axes, problem)]
    assert labels == [
        "cells=1 solver=sdirk2 dt=1/40",
        "cells=1 solver=sdirk2 dt=1/80",
        "cells=2 solver=velocity_verlet dt=auto",  # once, whatever other axes list
    ]
    assert axes[0].values == ("1", "2")
    (named,) = parse_axes(["E=at 12:30"], problem)
    assert named.values == ("at 12:30",)  # brings nothing
    with pytest.raises(SceneError, match="no axis 'dtt'; did you mean 'dt'"):
        parse_axes(["solver=velocity_verlet:dtt=auto"], problem)
    with pytest.raises(SceneError, match="frames is no axis"):
        parse_axes(["cells=1,2:frames=3"], problem)


def test_a_setting_makes_its_scene(bar):
    problem = Problem.of(bar, {"E": "2e5"}, frames=3)

    def scene(**values):
        return problem.build(Setting.of(**values)).scene

    plain = scene()
    assert plain.frames == 3
    assert plain.bodies[0].material.E == pytest.approx(2e5)
    assert scene(cells=4).bodies[0].mesh.cell_count == 64
    assert scene(dt="1/80").dt == 1 / 80
    assert scene(dt="auto").dt == "auto"  # although the parameter is a number
    assert scene(dt="auto", **{"scene.dt": "1/80"}).dt == 1 / 80  # as the halved steps that separate errors
    assert scene(element="P2").bodies[0].mesh.order == 2
    assert scene(refine=1).bodies[0].mesh.cell_count == 4 * plain.bodies[0].mesh.cell_count
    swapped = scene(material="NeoHookean").bodies[0].material
    assert isinstance(swapped, wf.NeoHookean)
    assert (swapped.E, swapped.nu) == pytest.approx((2e5, 0.3))
    tight = scene(solver="sdirk2", tolerance="1e-7").solver
    assert tight == wf.SDIRK2(tolerance=1e-7)
    assert scene(solver="linearised").solver == wf.BackwardEuler.linearised()
    assert problem.build(Setting.of(dtype="float64")).dtype == "float64"
    for values, message in (
        ({"material": "NeoHokean"}, "did you mean 'NeoHookean'"),
        ({"element": "cubic"}, "element must be one of"),
        ({"refine": "-1"}, "refine must be"),
        ({"dtype": "float16"}, "dtype must be"),
        ({"dt": "soon"}, "must be of type float"),
    ):
        with pytest.raises(SceneError, match=message):
            scene(**values)


def test_the_parameters_that_set_the_mesh_are_found(bar, tmp_path):
    problem = Problem.of(bar)
    mesh = mesh_control(problem)
    assert mesh.names == {"cells", "refine"}
    assert mesh.finer(Setting(), 2.0) == Setting.of(cells=4)
    assert mesh.finer(Setting.of(cells=1), 0.5) is None
    assert [kind_of(name, mesh) for name in ("cells", "dt", "dtype", "scene.tolerance", "line_search", "E")] == [
        "space",
        "time",
        "algebra",
        "algebra",
        "algebra",
        "model",
    ]
    path = tmp_path / "by_length.py"
    path.write_text(BAR.replace("cells: int = 2", "edge: float = 0.5").replace("2 * cells, cells", "int(2 / edge), 2"))
    by_length = mesh_control(Problem.of(path))
    assert by_length.finer(Setting(), 2.0) == Setting.of(edge=0.25)
    path = tmp_path / "fixed.py"
    path.write_text(BAR.replace("cells: int = 2, ", "").replace("2 * cells, cells", "2, 1"))
    fixed = mesh_control(Problem.of(path))
    assert fixed.finer(Setting(), 2.0) == Setting.of(refine=1)
    assert fixed.finer(Setting(), 0.5) is None


# ---- extrapolation


@pytest.mark.parametrize("p", [0.8, 2.0, 3.0])
def test_the_limit_of_a_power_law_is_found_and_its_order(p):
    sizes = [1.0, 0.5, 0.3]
    levels = [np.array([[2.0 + 0.7 * h**p, -1.0 + 0.2 * h**p]]) for h in sizes]
    found = extrapolate(levels, sizes)
    assert found.order == pytest.approx(p, rel=1e-6)
    np.testing.assert_allclose(found.value, [[2.0, -1.0]], rtol=1e-6)
    missing = 0.3**p * np.hypot(0.7, 0.2)
    assert found.band == pytest.approx(0.5 * missing, rel=1e-6)  # no more is claimed


@pytest.mark.parametrize(
    ("values", "remark"),
    [
        ([1.0, 2.0, 3.0], "does not converge"),
        ([1.0, 3.0, 2.0], "do not go the same way"),
        ([1.0, 2.0, 2.9], "order below"),
    ],
)
def test_nothing_is_extrapolated_from_what_does_not_converge(values, remark):
    found = extrapolate([np.array([value]) for value in values], [1.0, 0.5, 0.25])
    assert found.order is None
    assert remark in found.remark
    assert found.value == values[-1]
    assert found.band >= abs(values[-1] - values[-2])


def test_orders_have_bounds():
    assert observed_order(1.01, [1.0, 0.5, 0.25]) is None
    assert observed_order(1e9, [1.0, 0.5, 0.25]) == MOST_ORDER
    assert extrapolate([np.ones(1), np.ones(1) * 1.5], [1.0, 0.5]).band == 0.75
    assert "rounding" in extrapolate([np.zeros(1), np.ones(1), np.ones(1)], [1.0, 0.5, 0.2]).remark
    same = extrapolate([np.ones(1), np.ones(1) * 1.5, np.ones(1) * 1.75], [0.5, 0.5, 0.25])
    assert (same.order, same.band) == (None, 0.375)
    assert "do not get finer" in same.remark


@pytest.mark.parametrize("cells", [(1, 2, 4, 6), (2, 4, 8, 12), (4, 6, 8, 12)])
@pytest.mark.parametrize("part", [0.1, 0.5, 2.0])
def test_with_four_levels_the_band_is_that_of_the_limit(cells, part):
    """As at a clamped edge: an error of order 1.42 beside one that falls faster."""
    sizes = [1.0 / n for n in cells]
    levels = [np.array([[h**1.42 + part * h**3]]) for h in sizes]
    found = extrapolate(levels, sizes)
    assert abs(found.value) <= found.band
    assert found.band <= 0.4 * abs(found.value - levels[-1]) + 1.3 * abs(found.value)


@pytest.mark.parametrize("common", [0.0, 0.3])
def test_errors_of_many_directions_have_a_band(common):
    random, sizes = np.random.default_rng(1), [1.0 / n for n in (2, 4, 8, 12)]
    same = common * random.standard_normal((500, 2))
    levels = [h * (same + random.standard_normal((500, 2))) for h in sizes]
    found = extrapolate(levels, sizes)
    off = np.sqrt((found.value**2).sum(axis=-1).mean())
    assert found.order is None
    assert off <= found.band <= 4.0 * off


def test_an_order_beyond_the_claimed_one_is_told_so():
    assert (order_text(1.84), order_text(MOST_ORDER)) == ("1.8", "4 or more")


# ---- fronts


def reference(band: float, target: float = 1.0) -> Reference:
    outcome = Outcome(times=np.arange(1.0), motion=np.full((1, 1, 1), target), quantities={"tip": target})
    parts = {"l2": {"space": Part(2.0, band)}, "tip": {"space": Part(2.0, band)}}
    return Reference(outcome, {"l2": target, "tip": target}, parts, {}, {})


def point(error: float, seconds: float) -> Point:
    outcome = Outcome(seconds=[seconds], times=np.arange(1.0), motion=np.full((1, 1, 1), 1.0 + error))
    return Point(Setting.of(cells=int(1 / error)), (outcome,))


def test_the_front_and_its_answers():
    points = [point(0.2, 1.0), point(0.05, 2.0), point(0.1, 3.0), point(0.008, 20.0), point(0.001, 400.0)]
    points.append(Point(Setting.of(cells=9), (Outcome("no such thing"),)))
    own = reference(1e-4)
    ordered = candidates(points, own, "l2")
    assert [c.seconds for c in front(ordered)] == [1.0, 2.0, 20.0, 400.0]
    ten = answer(ordered, own, "l2", 0.1)
    assert (ten.candidate.seconds, ten.next_seconds, ten.next_how) == (2.0, 20.0, "measured")
    assert "cheapest setting within 10 %" in ten.sentence
    assert "10 times as much" in ten.sentence
    one = answer(ordered, own, "l2", 0.009)
    assert one.candidate.seconds == 20.0
    assert one.next_how == "extrapolated"
    assert one.next_seconds > 400.0
    assert "it is within that, too" in answer(candidates([point(0.001, 3.0)], own, "l2"), own, "l2", 0.1).sentence
    slow = answer(candidates([point(0.2, 123.0), point(0.01, 1234.0)], own, "l2"), own, "l2", 0.25)
    assert "123 s (123 to 123 s), off by 20 %" in slow.sentence
    assert "the next factor of 10: 1234 s (measured), 10 times as much" in slow.sentence
    none = answer(ordered, own, "l2", 5e-4)
    assert none.candidate is None
    assert "No setting of the sweep is within 0.05 %" in none.sentence
    coarse = reference(4e-4)
    unclear = candidates([point(0.2, 1.0), point(0.001, 400.0)], coarse, "l2")
    assert "the reference itself may be off by 0.04 %" in answer(unclear, coarse, "l2", 1e-3).sentence
    assert "known to be within 0.15 %" in answer(unclear, coarse, "l2", 1.5e-3).sentence
    outside = candidates([point(0.2, 1.0), point(0.002, 400.0)], coarse, "l2")
    assert "No setting of the sweep is within 0.1 %" in answer(outside, coarse, "l2", 1e-3).sentence
    assert "every setting failed" in answer([], own, "l2", 0.1).sentence
    assert candidates(points, own, "tip") == []  # no setting has a value of it


def test_a_setting_counts_as_within_an_error_by_its_bound():
    own = reference(2e-3)
    ordered = candidates([point(0.0095, 1.0), point(0.005, 2.0)], own, "l2")
    assert answer(ordered, own, "l2", 0.01).candidate.seconds == 2.0


def test_no_price_is_below_what_was_paid_for_less():
    own = reference(2e-3)  # which does not resolve the last of the errors
    ordered = candidates([point(0.1, 1.0), point(0.05, 1.1), point(0.005, 50.0)], own, "l2")
    assert 1.1 < answer(ordered[:2], own, "l2", 0.01).next_seconds < 50.0
    dear = answer(ordered, own, "l2", 0.01)
    assert dear.candidate.seconds == 50.0 < dear.next_seconds
    cheap, paid = (
        answer(candidates([*points, point(0.007, last)], own, "l2"), own, "l2", 0.02).next_seconds
        for points in [[point(0.1, 1.0), point(0.05, 2.0), point(0.02, 5.0)]]
        for last in (10.0, 100.0)
    )
    assert cheap < paid == pytest.approx(10.0 * cheap, rel=0.5)


@pytest.mark.parametrize(
    ("errors", "target", "within", "told"),
    [
        ((0.2, 0.05, 0.0009), 0.02, True, False),  # the last may be within 0.2 % or not
        ((0.2, 0.05, 0.0095), 0.01, False, False),  # likewise within 1 %
        ((0.2, 0.05, 0.02), 0.01, False, True),
        ((0.2, 0.05, 0.02), 0.03, True, True),
    ],
)
def test_the_next_factor_costs_more_than_the_answer_or_is_not_told(errors, target, within, told):
    own = reference(2e-3)
    ordered = candidates([point(error, 2.0**k) for k, error in enumerate(errors)], own, "l2")
    found = answer(ordered, own, "l2", target)
    assert (found.candidate is not None, found.next_seconds is not None) == (within, told)
    assert found.next_seconds is None or found.next_seconds > 4.0
    assert told or "the front does not tell what that costs: its last setting may be within" in found.sentence


def test_an_error_of_nothing_is_no_part_of_a_power_law():
    own = reference(0.0)
    exact = Point(Setting(), (Outcome(seconds=[50.0], times=np.arange(1.0), motion=np.full((1, 1, 1), 1.0)),))
    ordered = candidates([point(0.2, 1.0), point(0.05, 2.0), exact], own, "l2")
    assert answer(ordered, own, "l2", 0.01).next_seconds == 50.0
    own = reference(1e-4)
    none = answer(candidates([point(0.2, 1.0), point(0.05, 2.0), exact], own, "l2"), own, "l2", 5e-4)
    assert (none.candidate.seconds, none.next_seconds) == (50.0, None)


# ---- studies


def study(bar: Path, folder: Path, executor: Executor, **options) -> Study:
    return Study(Problem.of(bar), Store(folder), executor, **options)


def test_a_study_goes_on_from_what_it_has(bar, tmp_path, monkeypatch):
    monkeypatch.setattr("warpfem.trade.study.run_order", fake)
    settings = [Setting.of(cells=cells) for cells in (1, 2, 3, 4)]
    interrupted = Here([None, None, KeyboardInterrupt()])
    first = study(bar, tmp_path / "a", interrupted)
    monkeypatch.setattr(first, "_run_each", lambda s, rounds: one_by_one(interrupted, first, s))
    with pytest.raises(KeyboardInterrupt):
        first.run(settings, 2)
    with open(tmp_path / "a" / "runs.jsonl", "ab") as file:
        file.write(b'{"key": "cut sho')  # as a kill in the middle of a line leaves it
    rest = Here()
    points = study(bar, tmp_path / "a", rest).run(settings, 2)
    assert interrupted.labels == ["cells=1", "cells=2"]
    assert rest.labels == ["cells=3", "cells=4", "cells=1", "cells=2", "cells=3", "cells=4"]
    assert [len(point.samples) for point in points] == [2, 2, 2, 2]
    nothing = Here()
    again = study(bar, tmp_path / "a", nothing).run(settings, 2)
    assert nothing.labels == []
    assert [point.seconds for point in again] == [point.seconds for point in points]
    assert difference(again[0].first, points[1].first).l2 == pytest.approx(np.sqrt(2.0) * (1 - 1 / 4))
    bar.write_text(BAR + "# changed\n")
    changed = Here()
    study(bar, tmp_path / "a", changed).run(settings[:1])
    assert changed.labels == ["cells=1"]


@pytest.mark.skipif(not Path("/dev/fd").exists(), reason="tells which files are open")
def test_motions_that_nobody_wants_are_not_open(bar, tmp_path, monkeypatch):
    monkeypatch.setattr("warpfem.trade.study.run_order", fake)
    settings = [Setting.of(cells=cells) for cells in range(1, 21)]
    study(bar, tmp_path / "a", Here()).run(settings)
    before = len(os.listdir("/dev/fd"))
    again = study(bar, tmp_path / "a", Here())
    points = again.run(settings[:2], 3)
    assert len(os.listdir("/dev/fd")) <= before + 2
    assert [outcome.motion.shape for outcome in points[1].outcomes] == [(3, 4, 2)] * 3


def one_by_one(executor, own, settings):
    """Outcomes come while later settings are not submitted yet, as with one worker."""
    for setting in settings:
        order = Order(own.problem, setting, own.places, 1, 1.0, own.load)
        yield setting, executor.submit(fake, order).result()


def test_runs_are_those_of_the_scene_and_of_what_it_imports(bar, tmp_path):
    (tmp_path / "shapes").mkdir()
    used = [tmp_path / "sizes.py", tmp_path / "shapes" / "__init__.py", tmp_path / "shapes" / "plate.py"]
    for file, text in zip(used, ("WIDTH = 2", "from .plate import *", "HEIGHT = 1"), strict=True):
        file.write_text(text)
    other = tmp_path / "other.py"
    other.write_text("")
    bar.write_text("import math\nimport shapes.plate\nfrom sizes import WIDTH\n" + BAR)
    before = Problem.of(bar).key(Setting())
    other.write_text("LENGTH = 3")
    assert Problem.of(bar).key(Setting()) == before
    for file in used:
        text = file.read_text()
        file.write_text(text + "\n")
        assert Problem.of(bar).key(Setting()) != before
        file.write_text(text)
    assert Problem.of(bar).key(Setting()) == before


def test_runs_are_those_of_the_meshes_that_a_scene_reads(bar, tmp_path, monkeypatch):
    meshio = pytest.importorskip("meshio")
    path = tmp_path / "plate.vtk"
    mesh = wf.Mesh.rectangle((2, 1), (2, 1)).with_point_set("left", lambda x: x[:, 0] == 0.0)

    def write(scale: float) -> None:
        points = np.pad(scale * mesh.points, ((0, 0), (0, 1)))
        meshio.Mesh(points, [("triangle", mesh.cells)]).write(path)

    write(1.0)
    read = f'wf.load_mesh({str(path)!r}).with_point_set("left", lambda x: x[:, 0] == 0.0)'
    bar.write_text(BAR.replace("wf.Mesh.rectangle((2, 1), (2 * cells, cells))", read))
    own = study(bar, tmp_path / "a", Here())
    assert [file for file, _ in own.problem.files] == [str(path)]
    write(1.5)
    assert study(bar, tmp_path / "a", Here()).problem.key(Setting()) != own.problem.key(Setting())
    outcome = measure(Order(own.problem, Setting(), own.places, 1, 100.0, "serial"))
    assert f"{path} is not the file that the study was begun with" in outcome.failure
    write(1.0)
    monkeypatch.setattr("warpfem.trade.problem.code_digest", lambda: "another")
    assert study(bar, tmp_path / "a", Here()).problem.key(Setting()) != own.problem.key(Setting())
    outcome = measure(Order(own.problem, Setting(), own.places, 1, 100.0, "serial"))
    assert "not the code of warpfem that the study was begun with" in outcome.failure


def test_all_frames_are_not_run_again_as_the_first_ones(bar, tmp_path, monkeypatch):
    monkeypatch.setattr("warpfem.trade.study.run_order", fake)
    runs = Here()
    own = study(bar, tmp_path, runs)
    for part in (own, own.shortened(own.scene.frames), own.shortened(3)):
        part.run([Setting()])
    assert len(runs.labels) == 2


def test_places_stand_for_the_same_volume_but_for_few_of_small_bodies(tmp_path):
    path = tmp_path / "three.py"
    path.write_text(
        "import warpfem as wf\n"
        "def scene():\n"
        "    sizes = {'large': 3.0, 'middle': 1.0, 'small': 0.04}\n"
        "    meshes = {name: wf.Mesh.rectangle((size, 1), (2, 2)) for name, size in sizes.items()}\n"
        "    bodies = [wf.Body(name, mesh, wf.LinearElasticity(E=1e5, nu=0.3)) for name, mesh in meshes.items()]\n"
        "    return wf.Scene(bodies, wf.BackwardEuler())\n"
    )
    counts = [len(own) for own in Study(Problem.of(path), Store(tmp_path / "runs"), Here()).places]
    assert counts == [297, 99, 10]


def test_motions_are_compared_at_the_same_places_though_meshes_come_out_different(bar, tmp_path):
    shuffled = "    mesh = replace(mesh, cells=np.random.default_rng().permutation(mesh.cells))\n    bar ="
    bar.write_text("from dataclasses import replace\nimport numpy as np\n" + BAR.replace("    bar =", shuffled))
    first = study(bar, tmp_path / "a", Here())
    again = study(bar, tmp_path / "a", Here())
    assert (again.scene.bodies[0].mesh.cells != first.scene.bodies[0].mesh.cells).any()
    for other in (again, first.shortened(3), first.alone()):
        np.testing.assert_array_equal(other.places, first.places)
    assert (study(bar, tmp_path / "b", Here()).places[0] != first.places[0]).any()


def test_times_under_load_are_not_mixed_with_others(bar, tmp_path, monkeypatch):
    monkeypatch.setattr("warpfem.trade.study.run_order", fake)
    setting = Setting.of(cells=2)
    busy, alone, more = Here(), Here(), Here()
    study(bar, tmp_path, busy, load="parallel").run([setting], 3)
    (point,) = study(bar, tmp_path, alone).run([setting], 1)
    assert len(alone.labels) == 1
    assert {outcome.load for outcome in point.outcomes} == {"serial"}
    study(bar, tmp_path, more).solve([setting])  # for its motion any load will do
    study(bar, tmp_path, more, load="parallel").solve([setting])
    assert more.labels == []


def test_times_of_another_machine_are_not_mixed_with_those_of_this_one(bar, tmp_path, monkeypatch):
    settings, runs = [Setting.of(cells=2)], Here()
    monkeypatch.setattr("warpfem.trade.study.run_order", fake)
    study(bar, tmp_path, runs).run(settings, 2)
    here = study(bar, tmp_path, runs)
    for outcome in here.store.outcomes(here.problem, settings[0]):
        outcome.machine["processor"] = "another one"
    here.solve(settings)  # the motion is the same on all
    assert len(runs.labels) == 2
    (point,) = here.run(settings)
    assert len(runs.labels) == 3
    assert "another one" not in {outcome.machine["processor"] for outcome in point.outcomes}


def test_what_a_lost_worker_had_in_hand_is_submitted_again(bar, tmp_path, monkeypatch):
    monkeypatch.setattr("warpfem.trade.study.run_order", fake)
    said = []
    twice = Here([RuntimeError("gone"), RuntimeError("gone")])
    (point,) = study(bar, tmp_path, twice, say=said.append).run([Setting()])
    assert not point.failure
    assert sum("worker was lost" in text for text in said) == 2
    lost = Here([RuntimeError("gone")] * 9)
    with pytest.raises(OutputError, match="3 workers were lost"):
        study(bar, tmp_path, lost).run([Setting.of(cells=3)])


def test_a_cluster_that_is_gone_is_a_clear_error(bar, tmp_path):
    class Gone(Executor):
        def submit(self, function, order):
            raise RuntimeError("no scheduler")

    with pytest.raises(OutputError, match="3 workers were lost, the last with RuntimeError: no scheduler"):
        study(bar, tmp_path, Gone()).run([Setting()])


def test_failures_are_results(bar, tmp_path):
    """A crash, a hang, an end, a scene that is no scene, and steps that are too long."""
    actions = {
        "die": "import os; os.kill(os.getpid(), 9)",
        "stop": "import os; os.kill(os.getpid(), 15)",
        "hang": "import time; time.sleep(60)",
        "end": "import os; os._exit(3)",
        "raise": "1 / 0",
    }
    body = "".join(f"    if kind == '{name}':\n        {action}\n" for name, action in actions.items())
    bar.write_text(BAR.replace("    mesh =", f"{body}    mesh ="))
    reasons, by_chance = {}, set()
    for setting in [*(Setting.of(kind=name) for name in actions), Setting.of(solver="velocity_verlet", E=1e7)]:
        limit = 5.0 if setting.get("kind") == "hang" else 100.0  # to start a process alone takes 10 s at times
        outcome = run_order(Order(Problem.of(bar), setting, [np.array([[1.0, 0.5]])], 1, limit, "serial"))
        reasons[setting.label] = outcome.failure
        by_chance |= {setting.label} if outcome.by_chance else set()
    for name, reason in {
        "kind=die": "killed by SIGKILL",
        "kind=stop": "killed by SIGTERM",
        "kind=hang": "out of time: more than 5 s",
        "kind=end": "ended with status 3",
        "kind=raise": "ZeroDivisionError",
        "solver=velocity_verlet E=10000000.0": "above the stability limit",
    }.items():
        assert reason in reasons[name]
    assert by_chance == {"kind=die", "kind=stop"}  # the others would fail again


def test_only_failures_that_may_go_away_are_run_again(bar, tmp_path, monkeypatch):
    failures = {"1": Outcome("crashed"), "2": Outcome("killed", by_chance=True), "3": Outcome("late", limit=5.0)}
    monkeypatch.setattr("warpfem.trade.study.run_order", lambda order: failures[order.setting["cells"]])
    settings, once = [Setting.of(cells=cells) for cells in failures], Here()
    study(bar, tmp_path, once, limit=5.0).run(settings, 3)
    assert once.labels == ["cells=1", "cells=2", "cells=3"]
    monkeypatch.setattr("warpfem.trade.study.run_order", fake)
    again, longer = Here(), Here()
    points = study(bar, tmp_path, again, limit=5.0).run(settings)
    assert again.labels == ["cells=2"]
    assert [point.failure for point in points] == ["crashed", "", "late"]
    study(bar, tmp_path, longer, limit=6.0).run(settings)
    assert longer.labels == ["cells=3"]


def test_a_scene_that_was_edited_meanwhile_is_no_failure_of_its_settings(bar):
    order = Order(Problem.of(bar), Setting(), [np.array([[1.0, 0.5]])], 1, 100.0, "serial")
    bar.write_text(BAR + "# edited")
    outcome = measure(order)
    assert "not the file that the study was begun with" in outcome.failure
    assert outcome.by_chance  # once that is undone it is run again


def test_the_reference_is_within_its_band_of_a_finer_one(bar, tmp_path, in_process):
    own = study(bar, tmp_path / "a", Here())
    settings = [Setting.of(cells=1, element="P2", dt="1/20"), Setting.of(cells=2, element="P1", dt="1/20")]
    asked = own.run(settings)
    found = build_reference(own, mesh_control(own.problem), asked, explicit=False)
    exact = {"dtype": "float64", "solver": "sdirk3", "dt": "1/80", "tolerance": "1e-8"}
    (truth,) = own.run([Setting.of(cells=10, element="P2", **exact)])
    assert not truth.failure
    best = min(found.errors(point.first)["l2"] for point in asked)
    for name in ("l2", "max", "tip"):
        assert found.errors(truth.first)[name] <= found.band(name)
    assert found.band("l2") <= best / 4.0
    assert 1.0 < found.parts["l2"]["space"].order < 4.0
    assert 1.0 < found.parts["l2"]["time"].order < 4.0


DROP = """
import warpfem as wf

def scene(cells: int = 2, stiffness: float | None = 1e6) -> wf.Scene:
    mesh = wf.Mesh.rectangle((1, 1), (cells, cells), origin=(0, 0.05))
    block = wf.Body("block", mesh, wf.LinearElasticity(E=1e5, nu=0.3))
    floor = wf.Plane(point=(0, 0), normal=(0.1, 1), friction=0.3, stiffness=stiffness)
    return wf.Scene([block], wf.BackwardEuler(), gravity=(0, -9.81), damping=2.0, fps=20, frames=12, obstacles=[floor])
"""


@pytest.mark.parametrize(
    ("text", "first", "within", "cells"),
    [(BAR, 1, 2e-3, (1, 2, 4, 6, 8)), (DROP, 2, 1e-2, (2, 4, 8))],
    ids=["a clamped edge", "an impact"],
)
def test_the_band_holds_against_a_far_finer_run(bar, tmp_path, in_process, text, first, within, cells):
    bar.write_text(text)
    own = study(bar, tmp_path / "a", Here())
    (coarse,) = own.run([Setting.of(cells=first, element="P2")])
    found = build_reference(own, mesh_control(own.problem), [coarse], within=within, explicit=True)
    assert [int(rung.setting["cells"]) for rung in found.ladders["space"]] == list(cells)
    exact = {"dtype": "float64", "solver": "velocity_verlet", "dt": "auto"}
    (truth,) = own.run([Setting.of(cells=4 * cells[-1], element="P2", **exact)])
    for name in found.names:
        assert found.errors(truth.first)[name] <= found.band(name) <= 0.5 * found.errors(coarse.first)[name]


def test_the_default_stiffness_of_obstacles_is_told_of(bar, tmp_path, monkeypatch):
    bar.write_text(DROP.replace("= 1e6", "= None"))
    monkeypatch.setattr("warpfem.trade.study.run_order", fake)
    own = study(bar, tmp_path, Here())
    found = build_reference(own, mesh_control(own.problem), own.run([Setting.of(cells=1)]), explicit=True)
    assert found.remarks == [DEFAULT_STIFFNESS]


def test_the_steps_of_the_reference_are_not_those_of_explicit_settings(bar, tmp_path, monkeypatch):
    monkeypatch.setattr("warpfem.trade.study.run_order", fake)
    runs = Here()
    own = study(bar, tmp_path, runs)
    asked = own.run([Setting.of(cells=1, dt="1/40"), Setting.of(cells=1, solver="velocity_verlet", dt="auto")])
    for asked_point, dt, iterations in zip(asked, (1 / 40, 1e-4), (30, 0), strict=True):
        asked_point.first.shortest_dt = asked_point.first.longest_dt = dt
        asked_point.first.newton_iterations = iterations
    build_reference(own, mesh_control(own.problem), asked, explicit=False)
    assert {label.rpartition("dt=")[2] for label in runs.labels[2:]} == {"1/20", "1/40", "1/80"}


def test_nothing_is_measured_where_nothing_moves(bar, tmp_path, in_process):
    bar.write_text(BAR.replace("gravity=(0, -1)", "gravity=None"))
    own = study(bar, tmp_path / "a", Here())
    with pytest.raises(SimulationError, match="nothing moves"):
        build_reference(own, mesh_control(own.problem), own.run([Setting()]), explicit=False)


def test_a_quantity_without_a_value_is_told_of_with_its_reason(bar, tmp_path, monkeypatch):
    def without(order: Order) -> Outcome:
        outcome = fake(order)
        outcome.missing = {"tip": "it does not swing"}
        return outcome

    monkeypatch.setattr("warpfem.trade.study.run_order", without)
    own = study(bar, tmp_path, Here())
    with pytest.raises(SimulationError, match="the reference has no value of 'tip': it does not swing"):
        build_reference(own, mesh_control(own.problem), own.run([Setting()]), "tip", explicit=False)


@pytest.mark.parametrize(
    ("size", "limit", "remark"),
    [(1.0, 600.0, "its meshes do not get finer"), (None, 0.1, "a finer mesh would take more than 0.1 s")],
)
def test_why_a_reference_is_no_finer(bar, tmp_path, monkeypatch, size, limit, remark):
    def alike(order: Order) -> Outcome:
        outcome = fake(order)
        outcome.mesh_size = size or outcome.mesh_size
        return outcome

    monkeypatch.setattr("warpfem.trade.study.run_order", alike)
    own = study(bar, tmp_path, Here(), limit=limit)
    (found,) = build_reference(own, mesh_control(own.problem), own.run([Setting.of(cells=1)]), explicit=False).remarks
    assert remark in found


def test_a_finer_mesh_is_priced_by_how_much_finer_it_is(bar, tmp_path, monkeypatch):
    """By 3/2 after 4/3, in the plane 3.4 times the work."""

    def priced(order: Order) -> Outcome:
        outcome = fake(order)
        outcome.seconds = [1.0 if order.setting["cells"] == "8" else 0.1]
        return outcome

    monkeypatch.setattr("warpfem.trade.study.run_order", priced)
    own = study(bar, tmp_path, Here(), limit=3.0)
    asked = own.run([Setting.of(cells=1)])
    found = build_reference(own, mesh_control(own.problem), asked, within=0.0, explicit=True)
    assert [rung.setting["cells"] for rung in found.ladders["space"]] == ["1", "2", "4", "6", "8"]


def test_errors_are_not_relative_to_nothing(bar, tmp_path, in_process):
    bar.write_text(BAR.replace('{"tip": tip}', '{"nothing": lambda motion: 0.0}'))
    own = study(bar, tmp_path / "a", Here())
    with pytest.raises(SimulationError, match="the reference has 0 for 'nothing'"):
        build_reference(own, mesh_control(own.problem), own.run([Setting.of(cells=1)]), "nothing", explicit=False)


def test_the_command_writes_a_front_with_its_parts(bar, tmp_path, in_process, capsys, monkeypatch):
    pytest.importorskip("matplotlib")
    # steps take so little here that which setting is the fastest would be by chance
    prices = property(lambda self: [1e-3 * self.first.cells * (4.0 if "element=P2" in self.setting.label else 1.0)])
    monkeypatch.setattr(Point, "samples", prices)
    out = tmp_path / "out"
    arguments = ["trade", str(bar), "--axis", "cells=1,2", "--axis", "element=P1,P2", "--axis", "dt=1/20"]
    arguments += ["--axis", "material=linear,Neo", "--error", "10%", "--repeats", "1", "--out", str(out)]
    assert main(arguments) == OK
    printed = capsys.readouterr().out
    assert "failed: 4 settings with dt=1/20 material=Neo: there is no material 'Neo'" in printed
    assert "observed order" in printed
    assert "The cheapest setting within 10 % of the motion (L2) is" in printed
    data = json.loads((out / "trade.json").read_text())
    assert len(data["settings"]) == 8
    assert [machine["cores"] for machine in data["ran_on"]] == [data["machine"]["cores"]]
    edge = [record for record in data["settings"] if record["on_front"]]
    most = max(edge, key=lambda record: record["errors"]["l2"])
    parts = {kind: errors["l2"] for kind, errors in most["parts"].items()}
    assert set(parts) == {"space", "time", "algebra", "model"}
    assert sum(parts.values()) == pytest.approx(most["errors"]["l2"], rel=0.3)
    assert parts["space"] > 10.0 * parts["algebra"]
    assert parts["model"] == 0.0
    with open(out / "trade.csv") as file:
        table = list(csv.DictReader(file))
    assert [row["failure"] != "" for row in table] == [record["failure"] != "" for record in data["settings"]]
    assert float(table[0]["error_l2"]) == data["settings"][0]["errors"]["l2"]
    assert [row["axis_cells"] for row in table] == [record["setting"]["cells"] for record in data["settings"]]
    assert int(table[0]["cells"]) == data["settings"][0]["cells"] == 4  # those of the mesh of cells=1
    for name in ("trade.png", "trade.svg"):
        assert (out / name).stat().st_size > 10_000
    lines = (out / "runs.jsonl").read_text().count("\n")
    assert main([*arguments, "--quantity", "tip", "--json"]) == OK
    again = json.loads(capsys.readouterr().out)
    assert again["quantity"] == "tip"
    assert (out / "runs.jsonl").read_text().count("\n") - lines < 20  # only what the other quantity still needs


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["trade", "missing.py"], "no scene file"),
        (["trade", "bar.py", "--axis", "cels=1"], "did you mean 'cells'"),
        (["trade", "bar.py", "--quantity", "tipp"], "there is no quantity 'tipp'"),
        (["trade", "bar.py", "--set", "cells=few"], "cells must be of type int, like 2, not 'few'"),
        (["trade", "bar.py", "--set", "dt=1/48"], "dt must be of type float"),
    ],
)
def test_wrong_use_is_said_before_anything_is_run(bar, tmp_path, monkeypatch, capsys, arguments, message):
    monkeypatch.chdir(tmp_path)
    assert main(arguments) == WRONG_USE
    assert message in capsys.readouterr().err


def test_quantities_are_not_called_as_norms_are(bar, tmp_path, capsys):
    bar.write_text(BAR.replace('"tip": tip', '"max": tip'))
    assert main(["trade", str(bar), "--out", str(tmp_path / "out")]) == WRONG_USE
    assert "a quantity cannot be called 'max'" in capsys.readouterr().err


def test_a_study_whose_every_setting_fails_says_so(bar, tmp_path, in_process, capsys):
    out = tmp_path / "out"
    out.mkdir()
    (out / "trade.png").write_text("of the study before")
    assert main(["trade", str(bar), "--axis", "element=cubic", "--out", str(out)]) == FAILED
    assert not (out / "trade.png").exists()
    assert "No reference: there is no reference: every setting failed" in capsys.readouterr().out


@pytest.mark.usefixtures("interrupts")
def test_an_interrupt_ends_the_processes(bar, tmp_path):
    bar.write_text(BAR.replace("    mesh =", "    if kind == 'hang':\n        import time; time.sleep(60)\n    mesh ="))
    start = time.monotonic()
    threading.Timer(2.0, os.kill, (os.getpid(), signal.SIGINT)).start()
    with pytest.raises(KeyboardInterrupt), local_executor(2) as pool:
        study(bar, tmp_path / "a", pool, load="parallel").run([Setting.of(kind="hang"), Setting.of(kind="hang", E=2e5)])
    assert time.monotonic() - start < 30.0


def test_a_cluster_loses_a_worker_and_no_result(bar, tmp_path):
    distributed = pytest.importorskip("distributed")
    settings = [Setting.of(cells=1, dt=f"1/{20 * n}") for n in range(1, 7)]
    lost = []
    with distributed.LocalCluster(2, threads_per_worker=1, processes=True, dashboard_address=None) as cluster:
        worker = next(iter(cluster.workers.values())).pid

        def kill_after_the_first(text: str) -> None:
            if not lost:
                lost.append(worker)
                os.kill(worker, signal.SIGKILL)

        with cluster_executor(cluster.scheduler_address) as pool:
            own = study(bar, tmp_path / "a", pool, load="parallel", threads=1, say=kill_after_the_first)
            points = own.run(settings)
    assert lost
    assert [point.failure for point in points] == [""] * len(settings)
    assert {point.first.load for point in points} == {"parallel"}
    assert len({point.first.steps for point in points}) == len(settings)


def test_no_scheduler_is_a_clear_error(monkeypatch):
    pytest.importorskip("distributed")
    monkeypatch.setattr("warpfem.trade.executors.PATIENCE", "1s")
    with pytest.raises(OutputError, match="no Dask scheduler"), cluster_executor("tcp://127.0.0.1:1"):
        pass
