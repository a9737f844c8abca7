"""Works in a child process, which may crash, hang or run out of memory without harm to this one.

Whoever made a file decides what a library does that reads it: the USD library ends the process on some damaged
files, and a wrong count in a header takes all the memory there is.
"""

from __future__ import annotations

import importlib
import json
import os
import pickle
import signal
import subprocess
import sys
import threading
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import Any, NoReturn, TypeVar

from warpfem.errors import WarpfemError, described

T = TypeVar("T")

MIN_SECONDS = 30.0
"""The least time that a child may take."""
SECONDS_PER_BYTE = 5e-6
"""Time allowed per byte of the file: some text formats are read at a megabyte per second."""

DAMAGED = "the file is damaged, cut short or of an unknown format: write it again"

# What starts the child: this package without its __init__, which would import Warp.
_START = """
import json, sys, types
path, package, *arguments = json.loads(sys.argv[1])
sys.path[:] = path
sys.modules["warpfem"] = types.ModuleType("warpfem")
sys.modules["warpfem"].__path__ = package
from warpfem.child import serve
serve(*arguments)
"""
# One thread: others take memory and time to start.
_ENVIRONMENT = {"PXR_WORK_THREAD_LIMIT": "1", "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}


_noted: ContextVar[set[Path] | None] = ContextVar("files read", default=None)


@contextmanager
def noting_files() -> Iterator[set[Path]]:
    """The files that are read in children by what is done inside the block."""
    files: set[Path] = set()
    token = _noted.set(files)
    try:
        yield files
    finally:
        _noted.reset(token)


class ChildError(Exception):
    """A child did not do its work: says how it ended."""


def read_in_child(read: Callable[[str], T], path: str | os.PathLike[str], error: type[WarpfemError]) -> T:
    """Returns ``read(path)``, done in a child process within a time that goes with the file's size.

    Args:
        read: a function of a warpfem module; its result must be plain data.
        path: the file, and what messages name.
        error: raised if the child dies, takes too long or raises anything but a :class:`WarpfemError`.
    """
    path = existing(path, error)
    if (files := _noted.get()) is not None:
        files.add(path.absolute())
    try:
        return call_in_child(read, path, MIN_SECONDS + SECONDS_PER_BYTE * _size(path))
    except WarpfemError:
        raise
    except ChildError as problem:
        raise error(f"{path}: {DAMAGED} ({problem})") from problem
    except OSError as problem:
        raise error(f"{path}: no process could be started to read it: {problem}") from problem


def call_in_child(call: Callable[[str], T], path: str | os.PathLike[str], seconds: float | None = None) -> T:
    """Returns ``call(path)``, done in a child process that cannot take more than half of the machine's memory.

    Args:
        call: a function of a warpfem module; its result must be plain data.
        path: what the function is given.
        seconds: the time that it may take [s]; ``None`` for as long as it wants.

    Raises:
        OSError: no child can be started.
        ChildError: it dies, takes too long or raises anything but a :class:`WarpfemError`.
        WarpfemError: that which the function raised.
    """
    answer, status = _ask(call, path, seconds)
    if not answer:
        raise ChildError(f"its process {_ending(status, seconds)}")
    kind, value, remarks = pickle.loads(answer)
    for remark in remarks:
        warnings.warn(remark, stacklevel=5)
    if kind == "value":
        return value
    if kind == "error":
        raise value
    raise ChildError(value)


def existing(path: object, error: type[WarpfemError]) -> Path:
    """The path of a file, if there is one.

    Raises:
        error: the name is none, or belongs to no file.
    """
    if not isinstance(path, str | os.PathLike):
        raise error(f"the name of a file must be a str or a path, not {path!r}")
    if not os.path.isfile(path):  # unlike the path's own method it bears any name
        raise error(f"{path}: {'is a directory, not a file' if os.path.isdir(path) else 'no such file'}")
    return Path(path)


def _size(path: Path) -> int:
    """Bytes of a file, and of what is in the folder of the same name, where partial animations have their frames."""
    return sum(file.stat().st_size for file in [path, *path.with_suffix("").glob("*")] if file.is_file())


def _ask(call: Callable, path: str | os.PathLike[str], seconds: float | None) -> tuple[bytes, int | None]:
    """The child's answer, empty if it died, and how it ended: an exit status, or ``None`` for too late."""
    package = [os.path.abspath(folder) for folder in sys.modules["warpfem"].__path__]
    paths = [os.path.abspath(entry) for entry in sys.path]
    request = json.dumps([paths, package, call.__module__, call.__qualname__, os.fspath(path), seconds])
    process = subprocess.Popen(
        [sys.executable, "-I", "-c", _START, request],
        stdin=subprocess.PIPE,  # closed when this process ends, which ends the child
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        env=os.environ | _ENVIRONMENT,
        process_group=0,  # Ctrl-C is for this process to handle
    )
    assert process.stdout is not None
    late = threading.Event()

    def end() -> None:
        late.set()
        process.kill()

    timer = threading.Timer(seconds or 0.0, end)
    timer.daemon = True
    with process:
        try:
            if seconds is not None:
                timer.start()
            answer = process.stdout.read()
            status = process.wait()
        finally:
            timer.cancel()
            process.kill()
    return (answer if status == 0 else b""), (None if late.is_set() else status)


def _ending(status: int | None, seconds: float | None) -> str:
    if status is None:
        return f"took more than {seconds:.0f} s"
    return f"crashed with {signal.Signals(-status).name}" if status < 0 else f"ended with status {status}"


# ---- in the child


def serve(module: str, function: str, path: str, seconds: float | None) -> NoReturn:
    """Calls a function with the path, writes its answer to the standard output, and exits."""
    answer = os.fdopen(os.dup(1), "wb")
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # libraries print what they like
    limit_resources(seconds)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    with warnings.catch_warnings(record=True) as remarks:
        warnings.simplefilter("always")
        reply: tuple[str, Any]
        try:
            reply = "value", getattr(importlib.import_module(module), function)(path)
        except WarpfemError as error:
            reply = "error", error
        except BaseException as error:  # whatever a library raises on a damaged file
            reply = "damaged", described(error)
    said = list(dict.fromkeys(str(remark.message) for remark in remarks if remark.category is UserWarning))
    pickle.dump((*reply, said), answer, protocol=5)
    answer.close()
    os._exit(0)  # destructors have nothing to save, and may crash


def limit_resources(seconds: float | None) -> None:
    """Limits memory and, unless it is ``None``, processor time [s]; writes no core file. Where the system can."""
    try:
        import resource
    except ImportError:
        return
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") // 2
    limits = [(resource.RLIMIT_DATA, memory), (resource.RLIMIT_CORE, 0)]  # files that are mapped do not count
    if seconds is not None:
        limits.append((resource.RLIMIT_CPU, int(seconds) + 1))
    for kind, limit in limits:
        _, most = resource.getrlimit(kind)
        resource.setrlimit(kind, (limit if most < 0 else min(limit, most), most))


def _end_with_parent() -> None:
    sys.stdin.buffer.read()
    os._exit(1)
