"""Scene files: Python files that define ``scene(**parameters) -> Scene``, and USD stages."""

from __future__ import annotations

import ast
import difflib
import hashlib
import importlib.util
import inspect
import os
import sys
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from warpfem.errors import SceneError, user_code
from warpfem.scene import Scene
from warpfem.stage import STEP, SUFFIXES, read_stage, stage_files


def load_scene(path: str | Path, settings: Mapping[str, str] | None = None) -> Scene:
    """Runs a scene file and calls its ``scene`` function, or reads a USD stage (:func:`warpfem.read_stage`).

    Args:
        path: the file; the code of a Python file is executed.
        settings: values for parameters of ``scene``, as text; each is read as a Python literal where the
            parameter's default is not a string.

    Returns:
        The scene.

    Raises:
        SceneError: no such file, no function ``scene``, an unknown parameter, a value of another type than
            the default, or any error in the file, with its line.
        WarpfemError: whatever the scene itself raises.
    """
    path = Path(path)
    function = _scene_function(path)
    arguments = _arguments(path, function, settings or {})
    scene = _call(path, lambda: function(**arguments))
    if not isinstance(scene, Scene):
        raise SceneError(f"{path}: scene() must return a warpfem.Scene, not {type(scene).__name__}")
    return scene


def scene_parameters(path: str | Path) -> Mapping[str, inspect.Parameter]:
    """The parameters of a scene file's function ``scene``, or of a USD stage, by name.

    Raises:
        SceneError: as :func:`load_scene`.
    """
    path = Path(path)
    return _parameters(path, _scene_function(path))


def source_digest(path: str | Path) -> str:
    """Names what a scene file says: its contents, and those of the files that it imports or refers to.

    Raises:
        SceneError: no such file.
    """
    path = Path(path)
    if not path.is_file():
        raise SceneError(f"no scene file '{path}'")
    digest, found, left = hashlib.sha256(), {path}, [path]
    if path.suffix.lower() in SUFFIXES:
        left = [Path(file) for file in stage_files(path)]
    while left:
        file = left.pop()
        contents = file.read_bytes()
        digest.update(hashlib.sha256(contents).digest())
        names = _imported(contents) if file.suffix == ".py" else ()
        folders = {path.parent, file.parent}  # for what is imported relatively
        neighbours = {other for name in names for folder in folders for other in _neighbours(folder, name)}
        new = sorted(neighbours - found)
        found.update(new)
        left += new
    return digest.hexdigest()


def _imported(contents: bytes) -> Iterator[str]:
    """The dotted names that Python code imports, those of functions too; none if it is no code."""
    try:
        tree = ast.parse(contents)
    except (SyntaxError, ValueError):
        return
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield from (".".join(filter(None, (node.module, alias.name))) for alias in node.names)


def _neighbours(folder: Path, name: str) -> list[Path]:
    """The files below a folder that the import of a dotted name may run."""
    parts = name.split(".")
    stems = [folder.joinpath(*parts[: k + 1]) for k in range(len(parts))]
    files = [file for stem in stems for file in (stem.with_suffix(".py"), stem / "__init__.py")]
    return [file for file in files if file.is_file()]


def _scene_function(path: Path) -> Callable[..., Any]:
    if not os.path.isfile(path):  # unlike the path's own method it bears any name
        raise SceneError(f"no scene file '{path}'")
    if path.suffix.lower() in SUFFIXES:
        return _stage_function(path)
    if path.suffix != ".py":
        raise SceneError(
            f"'{path}' is not a scene file: it must end in .py and define scene() -> Scene, or be a USD stage"
        )
    name = f"warpfem_scene_{path.stem}"
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None and spec.loader is not None  # given for every existing .py file
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # Warp looks functions up there
    loader = spec.loader
    _call(path, lambda: loader.exec_module(module))
    function = getattr(module, "scene", None)
    if not callable(function):
        raise SceneError(f"{path} does not define a function scene(**parameters) -> Scene")
    return function


def _stage_function(path: Path) -> Callable[..., Any]:
    def scene(dt: float = STEP) -> Scene:
        return read_stage(path, dt)

    return scene


def _call(path: Path, action: Callable[[], Any]) -> Any:
    """Turns an error in the file into one that names its line."""
    folder = str(path.parent.absolute())
    with user_code(str(path), str(path)):
        sys.path.insert(0, folder)  # as for a script: a scene may import its neighbours
        try:
            return action()
        except SyntaxError as error:
            raise SceneError(f"{path}, line {error.lineno}: {error.msg}") from error
        finally:
            sys.path.remove(folder)


def _parameters(path: Path, function: Callable[..., Any]) -> Mapping[str, inspect.Parameter]:
    try:
        return inspect.signature(function).parameters
    except (TypeError, ValueError) as error:
        raise SceneError(f"{path}: scene must be a function scene(**parameters) -> Scene, not {function!r}") from error


def _arguments(path: Path, function: Callable[..., Any], settings: Mapping[str, str]) -> dict[str, Any]:
    parameters = _parameters(path, function)
    arguments = {}
    for name, text in settings.items():
        if name not in parameters:
            close = difflib.get_close_matches(name, parameters, 1)
            hint = f"; did you mean '{close[0]}'?" if close else "."
            known = ", ".join(str(p) for p in parameters.values()) or "none"
            raise SceneError(f"{path}: scene() has no parameter '{name}'{hint} It has: {known}")
        arguments[name] = value_of(path, name, text, parameters[name].default)
    for name, parameter in parameters.items():
        if parameter.default is parameter.empty and name not in arguments:
            raise SceneError(f"{path}: parameter '{name}' has no default: give it with --set {name}=VALUE")
    return arguments


def value_of(owner: str | Path, name: str, text: str, default: Any) -> Any:
    """What a text says, as a value of the type of the default.

    Args:
        owner: the scene file, or what else has the value, for messages.
        name: of the value.
        text: a Python literal, or any text if the default is one.
        default: the default.

    Raises:
        SceneError: it is of another type than the default.
    """
    if isinstance(default, str):
        return text
    try:
        value = ast.literal_eval(text)
    except (ValueError, TypeError, SyntaxError, MemoryError, RecursionError):  # literal_eval's, for odd texts
        value = text
    if isinstance(default, float) and not isinstance(value, bool):
        try:
            return float(value)
        except (TypeError, ValueError, OverflowError):
            pass  # reported below
    if default is not inspect.Parameter.empty and default is not None and type(value) is not type(default):
        raise SceneError(f"{owner}: {name} must be of type {type(default).__name__}, like {default!r}, not {text!r}")
    return value
