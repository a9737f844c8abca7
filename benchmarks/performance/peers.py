"""The other codes: which packages they are, and the interpreters that have them."""

import functools
import shutil
import subprocess
import sys
from pathlib import Path

PEERS = {
    "taichi": ("taichi==1.7.4", "numpy"),
    "newton": ("newton==1.8.0", "numpy"),
    "skfem": ("scikit-fem==12.0.2", "scipy"),
    "felupe": ("felupe==11.3.0", "scipy"),
}
"""Module names, and what is installed into an environment of their own to have them."""

FLAGS = ("-std=c++20", "-O3", "-march=native", "-ffast-math", "-fopenmp")
"""How the C++ limit is compiled."""


def install(folder: Path) -> None:
    """Makes an environment for each peer that cannot be imported yet."""
    for name, requirements in PEERS.items():
        if interpreter(name, folder) is None:
            subprocess.run([sys.executable, "-m", "venv", folder / name], check=True)
            python = folder / name / "bin" / "python"
            subprocess.run([python, "-m", "pip", "install", "--quiet", *requirements], check=False)


def _has(python: Path | str, name: str) -> bool:
    code = f"import importlib.util as u, sys; sys.exit(u.find_spec({name!r}) is None)"
    return subprocess.run([str(python), "-c", code], check=False).returncode == 0


@functools.cache
def interpreter(name: str, folder: Path) -> str | None:
    """The interpreter that has a module: the peer's own, or this one; ``None`` if it is not installed."""
    if name in ("warpfem", "warp", "scipy"):
        return sys.executable
    for python in (folder / name / "bin" / "python", Path(sys.executable)):
        if python.exists() and _has(python, name):
            return str(python)
    return None


@functools.cache
def version(name: str, folder: Path) -> str:
    """The version of a peer's package."""
    python = interpreter(name, folder)
    if python is None:
        return "not installed"
    package = {"skfem": "scikit-fem", "warp": "warp-lang"}.get(name, name)
    code = f"import importlib.metadata as m; print(m.version({package!r}))"
    return subprocess.run([python, "-c", code], capture_output=True, text=True, check=False).stdout.strip() or "?"


@functools.cache
def compiled(source: str, folder: Path) -> str | None:
    """The program of a C++ file beside this one; ``None`` where no compiler is at hand."""
    compiler = shutil.which("g++") or shutil.which("c++")
    if compiler is None:
        return None
    program = folder / Path(source).stem
    path = Path(__file__).with_name(source)
    if not program.exists() or program.stat().st_mtime < path.stat().st_mtime:
        program.parent.mkdir(parents=True, exist_ok=True)
        done = subprocess.run([compiler, *FLAGS, path, "-o", program], capture_output=True, text=True, check=False)
        if done.returncode:
            print(done.stderr, file=sys.stderr)
            return None
    return str(program)
