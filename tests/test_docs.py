"""The documentation: its Python runs, its commands are those of the parser, and what it names exists."""

import ast
import importlib.util
import math
import re
import shlex
import sys
from pathlib import Path

import pytest

import warpfem as wf
from warpfem.cli import parser

ROOT = Path(__file__).parent.parent
DOCS = ROOT / "docs"
PAGES = [ROOT / "README.md", *sorted(DOCS.glob("*.md"))]
GENERATED = {"accuracy.md", "performance.md", "stability.md", "trade.md", "tuning.md", "gpu.md"}
OPTIONAL = ("meshio", "newton")

pages = pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)


def blocks(page: Path, language: str) -> list[str]:
    """The fenced blocks of a page in that language."""
    return re.findall(rf"^```{language}\n(.*?)^```", page.read_text(), re.DOTALL | re.MULTILINE)


@pytest.mark.parametrize("page", [page for page in PAGES if blocks(page, "python")], ids=lambda page: page.stem)
def test_python_runs(page, tmp_path, monkeypatch, capsys):
    """All blocks of a page in turn, as one file: Warp reads the source of its functions there."""
    text = "\n".join(blocks(page, "python")).replace("frames=48", "frames=2")
    for package in OPTIONAL:
        if f"import {package}" in text:
            pytest.importorskip(package)
    name = f"page_{page.stem.lower()}"
    file = tmp_path / f"{name}.py"
    file.write_text(text)
    monkeypatch.chdir(tmp_path)
    spec = importlib.util.spec_from_file_location(name, file)
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, name, module)
    spec.loader.exec_module(module)
    CHECKS.get(page.stem, lambda names, printed: None)(vars(module), capsys.readouterr().out.splitlines())


def check_extending(names: dict, printed: list[str]) -> None:
    """The material's force is the derivative of its energy, and the solver's steps keep the energy."""
    force, difference = map(float, printed[-2].split())
    assert force == pytest.approx(difference, rel=1e-6)
    first, last = map(float, printed[-1].split())
    assert last == pytest.approx(first, rel=1e-4)


def check_materials(names: dict, printed: list[str]) -> None:
    """psi of the page at F = 1.2 I in a cube of 1 m, where only the change of volume has energy."""
    assert float(printed[-1]) == pytest.approx(0.5 * 2e7 * (1.2**3 - 1) ** 2, rel=1e-9)


def check_statics(names: dict, printed: list[str]) -> None:
    """The support bears the weight of 4 m^3 at 1000 kg/m^3."""
    total = [float(number) for number in printed[-1].strip("[]").split()]
    assert total == pytest.approx([0.0, 4000 * 9.81, 0.0], abs=1.0)


def check_runs(names: dict, printed: list[str]) -> None:
    assert printed == ["5"]  # frames, the initial one included, of the run that was taken up again


def check_neighbours(names: dict, printed: list[str]) -> None:
    """The beam, held at a height of 1 m, sags, and steps have been solved."""
    lowest, residual = map(float, printed[-1].split())
    assert 0.8 < lowest < 0.999 and residual < 1e-3


def check_scenes(names: dict, printed: list[str]) -> None:
    """The last block grows a cube of 1 m by 10 % in a float64 model: psi of the default material by hand."""
    model, state = names["model"], names["state"]
    moduli = wf.elastic_moduli(E=1e6, nu=0.3)
    mu, lam = 4 / 3 * moduli.mu, moduli.lam + 5 / 6 * moduli.mu
    a = 1 + 3 * mu / (4 * lam)

    def psi(I_C: float, J: float) -> float:
        return mu / 2 * (I_C - 3 - math.log(I_C + 1)) + lam / 2 * (J - a) ** 2

    assert model.energies(state).elastic == pytest.approx(psi(3 * 1.1**2, 1.1**3) - psi(3, 1), rel=1e-9)


def check_start(names: dict, printed: list[str]) -> None:
    assert len(printed) == 1 + 3  # of the run, and a line per frame


def check_usd(names: dict, printed: list[str]) -> None:
    """A run reads back as the scene that it was, and a layer over it has what it has."""
    assert printed[-2:] == ["100000.0 (0.0, -9.81, 0.0) 3", "True"]


CHECKS = {
    "extending": check_extending,
    "materials": check_materials,
    "neighbours": check_neighbours,
    "runs": check_runs,
    "scenes": check_scenes,
    "start": check_start,
    "statics": check_statics,
    "usd": check_usd,
}


@pages
def test_commands_are_those_of_the_parser(page):
    for block in blocks(page, ""):
        for line in block.replace("\\\n", " ").splitlines():
            if line.startswith("warpfem "):
                parser().parse_args(shlex.split(line, comments=True)[1:])
            for target in re.findall(r"^make (\w+)", line):
                assert re.search(rf"^{target}:", (ROOT / "Makefile").read_text(), re.MULTILINE), line


@pages
def test_files_and_tests_that_are_named_exist(page):
    text = page.read_text()
    for name, test in re.findall(r"((?:benchmarks|docs|scenes|tests|warpfem)/[\w/.-]*\w)(?:::(\w+))?", text):
        if name.startswith(("benchmarks/blender", "docs/_build")):
            continue
        path = ROOT / name
        assert path.exists(), name
        if test:
            functions = {node.name for node in ast.parse(path.read_text()).body if isinstance(node, ast.FunctionDef)}
            assert test in functions, f"{name}::{test}"


@pages
def test_names_of_the_package_exist(page):
    if page.name not in GENERATED:
        for name in re.findall(r"\bwf\.(\w+)", page.read_text()):
            assert hasattr(wf, name), name


@pages
def test_links_lead_to_files(page):
    for link in re.findall(r"\]\(([^)#:\s]+)(?:#[^)]*)?\)", page.read_text()):
        assert (page.parent / link).exists(), link


def test_every_public_name_is_in_the_reference():
    listed = re.findall(r"^\.\. auto(?:class|function|data|exception|module):: (?:\w+\.)*(\w+)$", api(), re.MULTILINE)
    assert set(wf.__all__) <= set(listed)
    assert len(listed) == len(set(listed))


def api() -> str:
    return (DOCS / "api.md").read_text()


def test_every_page_is_in_the_contents():
    listed = set("\n".join(blocks(DOCS / "index.md", "{toctree}")).split())
    assert {page.stem for page in DOCS.glob("*.md")} - {"index"} <= listed


INCLUDES = [
    (page, match)
    for page in PAGES
    for match in re.findall(r"^```{literalinclude} (\S+)\n(.*?)^```", page.read_text(), re.DOTALL | re.MULTILINE)
]


@pytest.mark.parametrize("page, include", INCLUDES, ids=lambda value: getattr(value, "stem", None))
def test_code_beside_formulas_is_found(page, include):
    """A marker is on one line of its file, of several of which Sphinx would take the first, and the end comes after."""
    path, settings = include
    source = (page.parent / path).read_text()
    options = dict(re.findall(r"^:([\w-]+): ?(.*)$", settings, re.MULTILINE))
    if "pyobject" in options:
        defined = {node.name for node in ast.parse(source).body if isinstance(node, ast.FunctionDef | ast.ClassDef)}
        assert options["pyobject"] in defined
        return
    if not options:
        return  # the whole file
    lines = source.splitlines()
    start = options["start-at"].strip('"').replace('\\"', '"')
    assert sum(start in line for line in lines) == 1, start
    first = next(index for index, line in enumerate(lines) if start in line)
    end = options.get("end-at", options.get("end-before")).strip('"').replace('\\"', '"')
    assert any(end in line for line in lines[first:]), end
