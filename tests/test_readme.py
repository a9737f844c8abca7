"""What the README and the pages of the documentation list is what there is."""

import tomllib
from pathlib import Path

import warpfem as wf
from warpfem.commands.info import EXTRAS

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text()


def page(name: str) -> str:
    return (ROOT / "docs" / f"{name}.md").read_text()


def test_every_scene_is_in_the_table_and_in_the_gallery():
    for path in (ROOT / "scenes").glob("*.py"):
        assert f"| `{path.stem}` |" in README
        assert f"(gallery/{path.stem}.webp)" in page("gallery")


def test_every_material_and_every_solver_is_in_a_table():
    for material in wf.MATERIALS.values():
        assert f"| `{material.__name__}` |" in page("materials")
    for solver in wf.SOLVERS.values():
        assert f"| `{solver.__name__}()` |" in page("solvers")


def test_every_extra_is_in_the_table():
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    for extra in {*extras, *EXTRAS.values()}:
        assert f"`{extra}`" in page("install")


def test_every_page_is_in_the_readme():
    for path in (ROOT / "docs").glob("*.md"):
        assert path.stem == "index" or f"(docs/{path.name})" in README


def test_every_command_is_shown():
    from warpfem.cli import COMMANDS

    for command in COMMANDS:
        assert f"\nwarpfem {command.__name__.rpartition('.')[2]} " in README + "\n"
