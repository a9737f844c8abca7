"""Outcomes on the disk, each written when it comes: a study that was killed goes on with those it has."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from warpfem.errors import OutputError
from warpfem.files import replacing, save_arrays
from warpfem.trade.outcome import Outcome
from warpfem.trade.problem import Problem, Setting


class Store:
    """The outcomes of a study, in a folder.

    ``runs.jsonl`` has a line for each, and ``motions/KEY.npy`` the recorded motion of each setting, that of its first
    run without failure: all its runs have the same. ``places/KEY.npz`` has the places of each scene at which it was
    recorded.

    Args:
        folder: is made if it does not exist.

    Raises:
        OutputError: it cannot be written to.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._lines = folder / "runs.jsonl"
        self._outcomes: dict[str, list[Outcome]] = {}
        try:
            for name in ("motions", "places"):
                (folder / name).mkdir(parents=True, exist_ok=True)
            self._read()
        except OSError as error:
            raise OutputError(f"cannot use the folder {folder}: {error.strerror or error}") from None

    def outcomes(self, problem: Problem, setting: Setting) -> list[Outcome]:
        """All outcomes of a setting, in the order in which they came.

        Raises:
            OutputError: their motion cannot be read.
        """
        key = problem.key(setting)
        own = self._outcomes.get(key, [])
        good = [outcome for outcome in own if not outcome.failure]
        if any(not outcome.motion.size for outcome in good):
            try:  # one file remains open for each setting, and none for those that are not asked for
                motion = np.load(self._motion(key), mmap_mode="r")
            except OSError as error:
                raise OutputError(f"cannot read {self._motion(key)}: {error.strerror or error}") from None
            for outcome in good:
                outcome.motion = motion
        return list(own)

    def add(self, problem: Problem, setting: Setting, outcome: Outcome) -> None:
        """Keeps an outcome.

        Raises:
            OutputError: it cannot be written.
        """
        key = problem.key(setting)
        try:
            motion = self._motion(key)
            if not outcome.failure and not motion.exists():
                with replacing(motion) as temporary, open(temporary, "wb") as array:
                    np.save(array, outcome.motion)
            kept = replace(outcome, motion=np.zeros((0, 0, 0)))  # read when it is asked for
            record = asdict(kept) | {"times": outcome.times.tolist()}
            del record["motion"]
            line = json.dumps({"key": key, "setting": dict(setting), **record}) + "\n"
            file = os.open(self._lines, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
            try:
                os.write(file, line.encode())  # at one stroke: a kill leaves all of it or a part that is not read
                os.fsync(file)
            finally:
                os.close(file)
        except OSError as error:
            raise OutputError(f"cannot write to {self.folder}: {error.strerror or error}") from None
        self._outcomes.setdefault(key, []).append(kept)

    def places(self, problem: Problem, drawn: Callable[[], list[np.ndarray]]) -> list[np.ndarray]:
        """The places at which all motions of a scene are recorded, those of fewer frames too.

        They are kept: some meshes come out different each time that they are made, and so would the places.

        Args:
            problem: the scene and its parameters.
            drawn: gives them for each body, if there are none yet.

        Raises:
            OutputError: they cannot be read or written.
        """
        key = replace(problem, frames=None, device=None).key(Setting())
        path = self.folder / "places" / f"{key}.npz"
        try:
            if not path.exists():
                save_arrays(path, {f"body_{index}": own for index, own in enumerate(drawn())})
            with np.load(path) as arrays:
                return [arrays[f"body_{index}"] for index in range(len(arrays.files))]
        except OSError as error:
            raise OutputError(f"cannot use {path}: {error.strerror or error}") from None

    def _motion(self, key: str) -> Path:
        return self.folder / "motions" / f"{key}.npy"

    def _read(self) -> None:
        known = {field.name for field in fields(Outcome)}
        text = self._lines.read_bytes() if self._lines.exists() else b""
        if text and not text.endswith(b"\n"):
            with open(self._lines, "ab") as file:
                file.write(b"\n")  # ends the line that a kill cut short
        for line in text.splitlines():
            try:
                record: dict[str, Any] = json.loads(line)
            except ValueError:
                continue
            key = record.get("key", "")
            outcome = Outcome(**{name: value for name, value in record.items() if name in known})
            outcome.times = np.array(outcome.times)
            if not outcome.failure and not self._motion(key).exists():
                continue  # somebody removed it: run it again
            self._outcomes.setdefault(key, []).append(outcome)
