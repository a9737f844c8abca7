"""The harness of the benchmarks, with contenders that are made up."""

from pathlib import Path

import numpy as np
import pytest

from performance import turns
from performance.turns import Contender, ratio, take_turns

SCRIPT = """
from serving import Contender, serve

def setup(problem, options):
    turns = []
    def run():
        turns.append(len(turns))
        print("noise")
        return {"seconds": options["seconds"] * 2.0 ** len(turns)}
    return Contender(run, lambda: {"turns": turns, "doubled": 2 * problem["x"]}, {"fact": 7})

serve(setup)
"""


@pytest.fixture
def stub(tmp_path, monkeypatch):
    own = turns.CONTENDERS
    folder = tmp_path / "package" / "performance" / "contenders"
    folder.mkdir(parents=True)
    (folder / "serving.py").write_text((own / "serving.py").read_text())
    (folder / "stub.py").write_text(SCRIPT)
    (folder / "broken.py").write_text("raise SystemExit('it has no such material')")
    (folder / "dying.py").write_text(
        SCRIPT.replace("turns.append", "len(turns) == 2 and exit('it died'); turns.append")
    )
    monkeypatch.setattr(turns, "CONTENDERS", folder)
    return tmp_path


def test_contenders_take_turns_and_are_compared_within_them(stub):
    fast = Contender("fast", "stub.py", options={"seconds": 1.0})
    slow = Contender("slow", "stub.py", options={"seconds": 3.0})
    a, b = take_turns([fast, slow], {"x": np.arange(3)}, 3, stub)
    assert a.seconds == [4.0, 8.0, 16.0]  # the first run, which compiles, is apart
    assert a.ready["first"] == {"seconds": 2.0} and a.ready["fact"] == 7
    assert a.median == 8.0 and a.best == 4.0
    assert ratio(b, a) == 3.0
    assert a.arrays["turns"].tolist() == [0, 1, 2, 3]
    assert b.arrays["doubled"].tolist() == [0, 2, 4]


def test_who_is_missing_is_told_and_the_others_run(stub):
    who = [
        Contender("elsewhere", "stub.py", "no_such_peer", {"seconds": 1.0}),
        Contender("broken", "broken.py"),
        Contender("dying", "dying.py", options={"seconds": 1.0}),
        Contender("present", "stub.py", options={"seconds": 1.0}),
    ]
    outcomes = take_turns(who, {"x": np.arange(3)}, 3, stub)
    assert [o.missing for o in outcomes] == ["not installed", "it has no such material", "it died", ""]
    assert outcomes[0].summary()["turns"] == [] and len(outcomes[3].seconds) == 3


def test_the_page_tells_what_falls_short_and_who_is_missing(tmp_path):
    pytest.importorskip("matplotlib")
    from performance.report import write

    def row(name: str, factor: float) -> dict:
        return {
            "name": name,
            "missing": "",
            "rate": 1e6,
            "best_rate": 2e6,
            "spread": 0.1,
            "times_warpfem": factor,
            "force_difference": 1e-6,
            "displacement_difference": 1e-6,
            "ready": {"setup_seconds": 1.0, "first_seconds": 1.0},
        }

    rows = [row("warpfem", 1.0), row("C++ lanes8", 0.8), row("Taichi sums", 2.0)]
    rows.append({"name": "Newton", "missing": "not installed"})
    group = {"cells": 105_456, "material": "stable_neo_hookean", "threads": 1, "rows": rows}
    results = {
        "explicit": {
            "machine": dict.fromkeys(("processor", "cores", "memory_gib", "system", "python"), "")
            | {"caches": {}, "vector_flags": []},
            "versions": {"taichi": "1"},
            "quick": False,
            "groups": [group],
            "triad": [{"megabytes": 1.0, "threads": 1, "bytes_per_second": 7.6e9}],
            "step_bytes": 76,
        }
    }
    write(results, tmp_path / "page.md")
    page = (tmp_path / "page.md").read_text()
    assert "aimed at 0.7: **0.80**;" in page
    assert "aimed at 3: **2.00** (falls short)" in page
    assert "| Newton | not installed |" in page
    assert "| 1 MB | 1 | 7.6 | 100 |" in page
    assert Path(tmp_path, "page", "roofline.png").stat().st_size > 1000
