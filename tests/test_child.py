"""Reading in a child process: what comes back, what becomes an error, and that nothing is left behind."""

from __future__ import annotations

import ctypes
import os
import shutil
import signal
import subprocess
import sys
import time
import warnings
from pathlib import Path

import numpy as np
import pytest

from warpfem import child
from warpfem.child import read_in_child
from warpfem.errors import MeshError, OutputError

PACKAGE = Path(__file__).parent.parent / "warpfem"


def process_of(path: str) -> int:
    return os.getpid()


def content(path: str) -> tuple[str, np.ndarray]:
    print("to nobody", flush=True)
    os.write(1, b"to nobody")
    os.write(2, b"to nobody")
    warnings.warn("mind the gap", stacklevel=1)
    return Path(path).read_text(), np.arange(100_000)


def refuse(path: str) -> None:
    raise MeshError(f"{path}: a reason")


def crash(path: str) -> None:
    ctypes.string_at(0)


def abort(path: str) -> None:
    os.abort()


def leave(path: str) -> None:
    sys.exit(3)


def interrupt(path: str) -> None:
    raise KeyboardInterrupt


def recurse(path: str) -> None:
    recurse(path)


def devour(path: str) -> None:
    np.ones(1 << 40)


def hang(path: str) -> None:
    Path(path).with_suffix(".pid").write_text(str(os.getpid()))
    while True:
        pass


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "a file, é.txt"
    path.write_text("text")
    return path


def test_results_and_warnings_come_back_and_nothing_is_printed(file: Path, capfd) -> None:
    with pytest.warns(UserWarning, match="mind the gap"):
        text, array = read_in_child(content, file, MeshError)
    assert text == "text" and np.array_equal(array, np.arange(100_000))
    assert capfd.readouterr() == ("", "")
    assert read_in_child(process_of, file, MeshError) != os.getpid()


def test_a_relative_path_is_one_from_here(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(file.parent)
    with pytest.raises(MeshError, match=f"^{file.name}: a reason$"):
        read_in_child(refuse, file.name, OutputError)


@pytest.mark.parametrize(
    ("read", "reason"),
    [
        (crash, "crashed with SIGSEGV"),
        (abort, "crashed with SIGABRT"),
        (leave, "SystemExit: 3"),
        (interrupt, "KeyboardInterrupt"),
        (recurse, "RecursionError"),
        (devour, "MemoryError"),
    ],
)
def test_whatever_happens_is_one_error(file: Path, capfd, read, reason: str) -> None:
    with pytest.raises(OutputError, match=reason) as caught:
        read_in_child(read, file, OutputError)
    assert str(caught.value).startswith(f"{file}: the file is damaged")
    assert "\n" not in str(caught.value)
    assert capfd.readouterr() == ("", "")


def test_what_takes_too_long_is_ended(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(child, "MIN_SECONDS", 3.0)
    with pytest.raises(MeshError, match="took more than 3 s"):
        read_in_child(hang, file, MeshError)
    assert not alive(file)


def test_a_missing_file_starts_no_process(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(child, "_ask", None)
    for path in (tmp_path / "absent", "", "a" * 5000, "a\0b"):
        with pytest.raises(MeshError, match="no such file"):
            read_in_child(refuse, path, MeshError)


def alive(file: Path) -> bool:
    """Whether the process that hangs over the file exists."""
    pid = int(file.with_suffix(".pid").read_text())
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return Path(f"/proc/{pid}/stat").exists() and Path(f"/proc/{pid}/stat").read_text().split()[2] != "Z"


@pytest.mark.skipif(not Path("/proc/self").exists(), reason="looks for processes in /proc")
@pytest.mark.parametrize("blow", [signal.SIGINT, signal.SIGKILL])
def test_no_child_outlives_its_parent(file: Path, blow: signal.Signals) -> None:
    code = "import signal, sys, test_child as t; "
    code += "signal.signal(signal.SIGINT, signal.default_int_handler); "  # a background job may have it ignored
    code += "t.read_in_child(t.hang, sys.argv[1], t.MeshError)"
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    process = subprocess.Popen(
        [sys.executable, "-c", code, str(file)], env=environment, stderr=subprocess.PIPE, text=True
    )
    while not file.with_suffix(".pid").exists() or not file.with_suffix(".pid").read_text():
        time.sleep(0.05)
        assert process.poll() is None
    assert alive(file)
    process.send_signal(blow)
    _, said = process.communicate()
    assert ("KeyboardInterrupt" in said) == (blow == signal.SIGINT)
    for _ in range(100):
        if not alive(file):
            break
        time.sleep(0.1)
    assert not alive(file)


def test_works_from_a_zip_file_in_another_directory(tmp_path: Path) -> None:
    (tmp_path / "source").mkdir()
    shutil.copytree(PACKAGE, tmp_path / "source" / "warpfem", ignore=shutil.ignore_patterns("__pycache__"))
    archive = shutil.make_archive(str(tmp_path / "all of it"), "zip", tmp_path / "source")
    (tmp_path / "bad.usda").write_text("#usda 1.0\n")
    code = """
import sys, types
sys.path.insert(0, "all of it.zip")
import warpfem.child
assert ".zip" in warpfem.child.__file__
from warpfem.usd import read_mesh
try:
    read_mesh("bad.usda")
except warpfem.MeshError as error:
    print(error)
"""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(p for p in sys.path if p != str(PACKAGE.parent))}
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert Path(archive).exists()
    assert done.stdout == "bad.usda: there is no Mesh in the file\n", done.stderr
