"""The recorded motion of a run, at places that do not depend on the mesh."""

from __future__ import annotations

import difflib
from collections.abc import Sequence

import numpy as np

from warpfem.errors import MeshError, SceneError
from warpfem.model import Energies, Model
from warpfem.places import Places, locate
from warpfem.simulation import Frame, Simulation


class Motion:
    """The frames of a run.

    Attributes:
        model: the scene on the device.
        times: simulated time of each frame [s], (frames,).
        energies: the energies of each frame [J].
    """

    def __init__(self, model: Model, frames: Sequence[Frame]) -> None:
        self.model = model
        self.times = np.array([frame.time for frame in frames])
        self.energies: list[Energies] = [frame.energies for frame in frames]
        self._displacements = [frame.displacement for frame in frames]
        self._stresses: dict[int, np.ndarray] = {}

    @classmethod
    def of(cls, simulation: Simulation) -> Motion:
        """The motion of a simulation, which is run.

        Raises:
            SimulationError: the run cannot go on.
        """
        return cls(simulation.model, list(simulation.frames()))

    def displacement(self, body: str, at: Sequence[float] | np.ndarray) -> np.ndarray:
        """Displacements of places of a body in every frame.

        Args:
            body: its name.
            at: a rest position (dim,), or some (k, dim) [m].

        Returns:
            (frames, dim) or (frames, k, dim) [m].
        """
        own, places = self._places(body, at)
        values = np.stack([places.values(u[own]) for u in self._displacements])
        return values[:, 0] if np.ndim(at) == 1 else values

    def von_mises(self, body: str, at: Sequence[float] | np.ndarray, frames: Sequence[int] | None = None) -> np.ndarray:
        """Von Mises stresses at places of a body, from the recovered ones of :meth:`Model.nodal_stresses`.

        Args:
            body: its name.
            at: a rest position (dim,), or some (k, dim) [m].
            frames: numbers of the frames; ``None`` for all, which takes long for many.

        Returns:
            (frames,) or (frames, k) [Pa].
        """
        own, places = self._places(body, at)
        chosen = range(len(self.times)) if frames is None else np.arange(len(self.times))[list(frames)]
        stresses = np.stack([places.values(self._nodal_stresses(int(frame))[own]) for frame in chosen])
        pressure = np.trace(stresses, axis1=-2, axis2=-1) / 3.0
        deviator = stresses - pressure[..., None, None] * np.eye(3)
        values = np.sqrt(1.5 * (deviator**2).sum(axis=(-2, -1)))
        return values[:, 0] if np.ndim(at) == 1 else values

    def _nodal_stresses(self, frame: int) -> np.ndarray:
        if frame not in self._stresses:
            state = self.model.state()
            state.assign(displacement=self._displacements[frame])
            self._stresses[frame] = self.model.nodal_stresses(state)
        return self._stresses[frame]

    def _places(self, body: str, at: Sequence[float] | np.ndarray) -> tuple[slice, Places]:
        bodies = self.model.scene.bodies
        names = [own.name for own in bodies]
        if body not in names:
            close = difflib.get_close_matches(str(body), names, 1)
            hint = f"; did you mean '{close[0]}'?" if close else "."
            raise SceneError(f"the scene has no body '{body}'{hint} It has: {', '.join(names)}")
        number = names.index(body)
        try:
            places = locate(bodies[number].mesh, np.atleast_2d(np.asarray(at, dtype=np.float64)))
        except MeshError as error:
            raise MeshError(f"body '{body}': {error}") from None
        return self.model.body_slices[number][0], places
