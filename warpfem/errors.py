"""The exceptions of warpfem. Each message says what is wrong, where, and what to try."""

import os
import textwrap
import traceback
from collections.abc import Iterator
from contextlib import contextmanager


class WarpfemError(Exception):
    """Base of every error that warpfem raises on purpose."""


class MeshError(WarpfemError, ValueError):
    """A mesh that cannot be simulated: names the first offending index and how many there are."""


class MaterialError(WarpfemError, ValueError):
    """Material parameters outside the domain of the material."""


class SceneError(WarpfemError, ValueError):
    """A scene that contradicts itself or refers to something that does not exist."""


class OutputError(WarpfemError, OSError):
    """An output file that cannot be written, or read back."""


class MissingExtraError(WarpfemError, ImportError):
    """An optional dependency is not installed: the message names the extra to install."""

    def __init__(self, purpose: str, package: str, extra: str) -> None:
        super().__init__(f"{purpose} needs the package '{package}': pip install 'warpfem[{extra}]'")
        self.purpose = purpose
        self.package = package
        self.extra = extra

    def __reduce__(self) -> tuple:  # it comes back from child processes
        return MissingExtraError, (self.purpose, self.package, self.extra)


class SimulationError(WarpfemError, RuntimeError):
    """A run that cannot go on: it diverged, or a step could not be solved."""


class TimeStepError(SimulationError):
    """A time step that explicit steps cannot take: names the limit."""


@contextmanager
def user_code(where: str, file: str) -> Iterator[None]:
    """Turns what a user's code raises into a SceneError that names the last line of ``file`` that was reached.

    A :class:`WarpfemError` stays what it is, with the line added as a note.
    """
    try:
        yield
    except KeyboardInterrupt:
        raise
    except BaseException as error:  # SystemExit, and what else a user's code may raise
        reached = [f for f in traceback.extract_tb(error.__traceback__) if _same_file(f.filename, file)]
        line = f"{file}, line {reached[-1].lineno}" if reached else file
        if isinstance(error, WarpfemError):
            if reached:
                error.add_note(f"in {line}")
            raise
        raise SceneError(f"{where}: {described(error)} ({line})") from error


def described(error: BaseException) -> str:
    """What kind of error it is and what it says, on one line."""
    try:
        text = str(error)
    except Exception:  # the text is a user's code, too
        text = "without a text"
    return one_line(f"{type(error).__name__}: {text}" if text else type(error).__name__)


def one_line(text: str) -> str:
    """What others say, on one line that is not too long."""
    return textwrap.shorten(text, 300, placeholder=" ...")


def source_of(function: object) -> str:
    """The file that a function was written in, or "" if there is none."""
    code = getattr(function, "__code__", None)
    return "" if code is None else code.co_filename


def _same_file(a: str, b: str) -> bool:
    return os.path.abspath(a) == os.path.abspath(b)
