"""Damaged files: each is read as something valid, or refused by an error of ours; nothing else happens."""

from __future__ import annotations

from pathlib import Path

import pytest
from fuzzing import KINDS, MESH_KINDS, USD_KINDS, answers, mutants

BATCHES = [
    pytest.param(MESH_KINDS, "solid", 24, id="meshes"),
    pytest.param(MESH_KINDS, "surface", 24, id="surfaces"),
    pytest.param(USD_KINDS, "solid", 12, id="USD-meshes"),
    pytest.param(USD_KINDS, "surface", 12, id="USD-surfaces"),
    pytest.param(USD_KINDS, "animation", 12, id="animations"),
    pytest.param(USD_KINDS, "picture", 4, id="previews"),
]


@pytest.mark.parametrize(("kinds", "reader", "count"), BATCHES)
def test_damaged_files_are_read_or_refused(tmp_path: Path, kinds, reader: str, count: int) -> None:
    check(tmp_path, [name for name, kind in kinds.items() if kind.reader == reader], reader, count, seed=1)


@pytest.mark.slow
@pytest.mark.parametrize("name", KINDS)
def test_many_damaged_files_are_read_or_refused(tmp_path: Path, name: str) -> None:
    check(tmp_path, [name], KINDS[name].reader, 500, seed=2)


def check(folder: Path, names: list[str], reader: str, count: int, seed: int) -> None:
    """Reads in one process; the undamaged files, and what ends it, as users do: with a child process each."""
    if reader == "picture":
        pytest.importorskip("matplotlib")
        pytest.importorskip("PIL")
    if set(names) & set(MESH_KINDS):
        pytest.importorskip("meshio")
        pytest.importorskip("trimesh")
    paths, whole = [], []
    for name in names:
        made = mutants(KINDS[name], folder / name, count, seed)
        whole.append(folder / name / "valid" / made[0].relative_to(folder / name / "0"))
        paths += made
    assert all(answer == "valid" for answer in answers(reader, whole, children=True))

    found = dict(zip(paths, answers(reader, paths), strict=True))
    assert any(answer.startswith("refused: ") for answer in found.values())
    again = [path for path, answer in found.items() if answer.startswith(("died", "hung"))]
    found |= zip(again, answers(reader, again, children=True), strict=True)
    bad = {path: answer for path, answer in found.items() if answer != "valid" and not answer.startswith("refused: ")}
    assert not bad
    assert not [answer for answer in found.values() if "\n" in answer]
