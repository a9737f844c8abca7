"""Files of settings: what ``warpfem tune`` found, for ``warpfem run --settings`` to take."""

from __future__ import annotations

import difflib
import json
import re
import tomllib
import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from warpfem.errors import OutputError, SceneError, WarpfemError
from warpfem.files import replacing
from warpfem.trade.problem import FORCED, Choice, Problem, Setting, known_names

TEXTS = ("scene", "digest")
TABLES = ("parameters", "changes")
NOTES = ("estimate", "reference", "machine")
"""What a file has: two texts, two tables that are used, and tables that only tell."""

_NUMBER = re.compile(r"-?(0|[1-9]\d{0,17})(\.\d+)?(e[+-]?\d+)?", re.ASCII)
"""Numbers of JSON and of TOML, whose integers have 64 bits."""


@dataclass(frozen=True)
class SettingsFile:
    """A setting of a scene, as it is in a file.

    Attributes:
        scene: the scene file's name.
        digest: that of the scene file's contents.
        parameters: values of parameters of the scene's function, as text.
        changes: what is changed of the scene that it returns, and ``dtype``, as text.
        notes: tables for people: how accurate the setting is, what it costs, and by what that is known.
    """

    scene: str
    digest: str
    parameters: dict[str, str]
    changes: dict[str, str]
    notes: dict[str, dict[str, Any]] = field(default_factory=dict)

    @classmethod
    def of(cls, problem: Problem, setting: Setting, notes: Mapping[str, Mapping[str, Any]]) -> SettingsFile:
        """The file of a setting of a problem."""
        own = problem.parameter_names()
        parameters = dict(problem.parameters) | {name: value for name, value in setting if name in own}
        changes = {name.removeprefix(FORCED): value for name, value in setting if name not in own}
        tables = {name: dict(table) for name, table in notes.items()}
        return cls(Path(problem.path).name, problem.digest, parameters, changes, tables)

    @classmethod
    def read(cls, path: Path) -> SettingsFile:
        """Reads a file.

        Raises:
            SceneError: there is none, or it says something else than settings.
        """
        try:
            data = tomllib.loads(path.read_text(encoding="utf-8"))
        except OSError as error:
            raise SceneError(f"cannot read the settings {path}: {error.strerror or error}") from None
        except ValueError as error:  # TOML's, and of texts that are not UTF-8
            raise SceneError(f"{path} is no file of settings: {error}") from None
        known = (*TEXTS, *TABLES, *NOTES)
        for name, value in data.items():
            if name not in known:
                close = difflib.get_close_matches(name, known, 1)
                hint = f"; did you mean '{close[0]}'?" if close else f". There are: {', '.join(known)}"
                raise SceneError(f"{path}: there is no '{name}' in settings{hint}")
            kind = str if name in TEXTS else dict
            if not isinstance(value, kind):
                raise SceneError(f"{path}: {name} must be {'a text' if kind is str else f'a table [{name}]'}")
        if "scene" not in data:
            raise SceneError(f'{path}: the name of the scene is missing, as in scene = "beam.py"')
        tables = {name: {key: _text(path, key, v) for key, v in data.get(name, {}).items()} for name in TABLES}
        return cls(data["scene"], data.get("digest", ""), **tables, notes={n: data[n] for n in NOTES if n in data})

    def write(self, path: Path, remarks: Sequence[str]) -> None:
        """Writes the file.

        Args:
            path: where to.
            remarks: lines for people, at its beginning.

        Raises:
            OutputError: it cannot be written.
        """
        lines = [f"# {remark}" for remark in remarks]
        lines += ["", f"scene = {json.dumps(self.scene)}", f"digest = {json.dumps(self.digest)}"]
        for name, table in ({"parameters": self.parameters, "changes": self.changes} | self.notes).items():
            write = _toml if name in self.notes else _plain
            lines += ["", f"[{name}]", *(f"{_key(key)} = {write(value)}" for key, value in table.items())]
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            with replacing(path) as temporary:
                temporary.write_text("\n".join(lines) + "\n", encoding="utf-8")
        except OSError as error:
            raise OutputError(f"cannot write {path}: {error.strerror or error}") from None

    def choose(self, path: Path, scene: Path, given: Mapping[str, str]) -> Choice:
        """What the settings make of a scene.

        Args:
            path: of the file, for messages.
            scene: the scene file.
            given: parameters of the scene that win over those of the file.

        Raises:
            SceneError: the settings are not for this scene, or it has no such settings.
        """
        problem = Problem.of(scene, self.parameters | dict(given))
        if problem.digest != self.digest:
            if Path(scene).name != self.scene:
                raise SceneError(f"{path} has settings of {self.scene}, not of {scene}")
            if self.digest:
                warnings.warn(
                    f"{scene} has changed since {path} was written: its estimate of the error may not hold",
                    stacklevel=3,
                )
        try:
            _require_changes(self.changes)
            changes = {f"{FORCED}{n}": value for n, value in self.changes.items() if n not in given}
            return problem.build(Setting(tuple(changes.items())))
        except WarpfemError as error:
            error.add_note(f"with the settings of {path}")
            raise


def _require_changes(names: Iterable[str]) -> None:
    known = known_names([])
    for name in names:
        if name not in known:
            close = difflib.get_close_matches(name, known, 1)
            hint = f"; did you mean '{close[0]}'?" if close else f". There are: {', '.join(known)}"
            raise SceneError(f"no scene has a '{name}' to change{hint}")


def _text(path: Path, name: str, value: object) -> str:
    if not isinstance(value, str | int | float):
        raise SceneError(f"{path}: {name} must be a number or a text, not {value!r}")
    return str(value)


def _plain(text: str) -> str:
    """A number that is read as it was written as it is, any other text in quotes."""
    return text if _NUMBER.fullmatch(text) and str(json.loads(text)) == text else _toml(text)


def _key(name: str) -> str:
    return name if name.replace("_", "").replace("-", "").isalnum() and name.isascii() else json.dumps(name)


def _toml(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, int | float):
        return repr(value)
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(_toml, value))}]"
    return json.dumps(str(value), ensure_ascii=False)
