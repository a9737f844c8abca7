"""Dependencies point downwards only."""

import ast
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parent.parent / "warpfem"

LAYERS = [
    {"errors", "shapes"},
    {
        "files",
        "tensor",
        "dtypes",
        "boundary",
        "moduli",
        "profiling",
        "child",
        "recovery",
        "threads",
        "strips",
        "subnormals",
        "vector_code",
    },
    {"mesh", "points", "launches", "quantities", "log_file", "barrier", "packed_points"},
    {"materials", "row_blocks"},
    {"stiffness"},
    {"elements", "meshing", "folds", "patches", "patch_kernels", "places"},
    {"scene", "embedding"},
    {"supports", "contact"},
    {"model"},
    {"averaged", "vectorized", "vectorized_stiffness"},
    {"linear", "reactions"},
    {"solvers"},
    {"simulation"},
    {"usd", "checkpoint", "failure", "motion", "interop", "log"},
    {"stage"},
    {"record", "explain", "scene_file", "preview", "plot"},
    {"static_run"},
    {"extremes", "trade"},
    {"commands"},
    {"cli"},
    {"__main__"},
]
"""From the bottom up; a module imports only from the layers below its own."""

# Imported inside a function, where the lower module hands work to an optional upper one.
UPWARD = {("model", "averaged"), ("model", "vectorized"), ("model", "linear"), ("meshing", "usd")}


def level(module: str) -> int:
    return next(i for i, layer in enumerate(LAYERS) if module in layer)


def imports(path: Path) -> set[str]:
    """The warpfem modules that a file imports, but for those that only type checkers see."""
    tree = ast.parse(path.read_text())
    for node in ast.walk(tree):
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
            node.body = []
    names = [node.module for node in ast.walk(tree) if isinstance(node, ast.ImportFrom) and node.module]
    names += [alias.name for node in ast.walk(tree) if isinstance(node, ast.Import) for alias in node.names]
    return {name.split(".")[1] for name in names if name.startswith("warpfem.")}


def modules() -> list[Path]:
    return [path for path in sorted(PACKAGE.rglob("*.py")) if path.parent != PACKAGE or path.name != "__init__.py"]


def test_every_module_has_a_layer():
    known = set().union(*LAYERS)
    assert {path.relative_to(PACKAGE).parts[0].removesuffix(".py") for path in modules()} == known


@pytest.mark.parametrize("path", modules(), ids=lambda path: str(path.relative_to(PACKAGE)))
def test_imports_point_downwards(path):
    own = path.relative_to(PACKAGE).parts[0].removesuffix(".py")
    for other in imports(path) - {own}:
        assert level(other) < level(own) or (own, other) in UPWARD, f"{own} imports {other}"


@pytest.mark.parametrize("path", modules(), ids=lambda path: str(path.relative_to(PACKAGE)))
def test_only_usd_imports_pxr(path):
    if "usd" not in path.relative_to(PACKAGE).parts[0]:
        assert "pxr" not in path.read_text()


@pytest.mark.parametrize("path", modules(), ids=lambda path: str(path.relative_to(PACKAGE)))
def test_optional_packages_are_imported_where_they_are_used(path):
    tree = ast.parse(path.read_text())
    top = [node for node in tree.body if isinstance(node, ast.Import | ast.ImportFrom)]
    names = {alias.name.split(".")[0] for node in top if isinstance(node, ast.Import) for alias in node.names}
    names |= {(node.module or "").split(".")[0] for node in top if isinstance(node, ast.ImportFrom)}
    assert not names & {
        "meshio",
        "pytetwild",
        "matplotlib",
        "PIL",
        "imageio_ffmpeg",
        "tqdm",
        "trimesh",
        "scipy",
        "pyamg",
        "pypardiso",
        "distributed",
        "torch",
        "jax",
    }
