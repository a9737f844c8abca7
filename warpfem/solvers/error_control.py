"""Steps of implicit schemes that are as long as an error target allows."""

import math
from dataclasses import dataclass

import numpy as np
import warp as wp

from warpfem.errors import SimulationError
from warpfem.model import Model, State
from warpfem.points import chunks, point_kernels
from warpfem.solvers.base import Stepper, StepReport

SAFETY = 0.9
"""Part of the step that the estimate allows which is taken."""

LARGEST_CHANGE = 0.2, 2.0
"""Bounds of the ratio of a step to the one before."""

LEAST_PART = 1e-6
"""The part of the longest step below which a run would hardly get on."""


class ErrorNorm:
    """Measures displacements: the root of the mean of |e|^2 over a body's mass, relative to the body's size.

    A body's size is the diagonal of its bounding box. The largest over the bodies counts.
    """

    def __init__(self, model: Model) -> None:
        self.model = model
        self._kernel = point_kernels(model.dim, model.dtype).kinetic_energy
        self._sum = wp.zeros(1, dtype=wp.float64, device=model.device)
        self._scales = [
            float(0.5 * model.host_mass[points].sum() * np.sum(np.ptp(body.mesh.bounding_box, axis=0) ** 2))
            for body, (points, _) in zip(model.scene.bodies, model.body_slices, strict=True)
        ]

    def arrays(self) -> list[wp.array]:
        """The device arrays held."""
        return [self._sum]

    def __call__(self, e: wp.array) -> float:
        """The norm of a vector per point [m], device array."""
        model, largest = self.model, 0.0
        for scale, (points, _) in zip(self._scales, model.body_slices, strict=True):
            part = e[points]
            self._sum.zero_()
            inputs = [model.mass[points], part]
            wp.launch(self._kernel, chunks(part.shape[0]), inputs=inputs, outputs=[self._sum], device=model.device)
            largest = max(largest, (float(self._sum.numpy()[0]) / scale) ** 0.5)
        return largest


@dataclass(frozen=True)
class ControlledStep:
    """A step whose length an error target chose.

    Attributes:
        report: what it did.
        dt: its length [s].
        wanted: the length that the next one should have [s].
        rejected: steps that were tried before and not taken.
    """

    report: StepReport
    dt: float
    wanted: float
    rejected: int


def controlled_step(
    stepper: Stepper, order: int, state: State, left: float, wanted: float, longest: float
) -> ControlledStep:
    """Advances ``state`` by the longest step that its error target allows.

    The estimate grows with the length of a step to the power order + 1, and the target allows an error in proportion
    to the length: the next step is the last times (1 / error)^(1 / order), ``SAFETY`` apart.

    Args:
        stepper: estimates the errors of its steps.
        order: that of the scheme.
        state: the state.
        left: time that steps of the same length shall divide [s].
        wanted: length to try first [s].
        longest: the longest step [s].

    Raises:
        SimulationError: no step is good; the state is as it was before.
    """
    least, most = LARGEST_CHANGE
    rejected = 0
    while True:
        dt = left / math.ceil(left / wanted - 1e-9)
        failure: SimulationError | None = None
        try:
            report = stepper.try_step(state, dt)
        except SimulationError as error:
            failure, wanted = error, 0.5 * dt
        else:
            change = SAFETY * report.error ** (-1.0 / order) if report.error > 0.0 else most
            wanted = min(longest, dt * min(max(change, least), most))
            if report.error <= 1.0:
                return ControlledStep(report, dt, wanted, rejected)
        rejected += 1
        if not wanted > LEAST_PART * longest:
            why = (
                f"can be solved: {failure}"
                if failure
                else "meets the error target: take a larger one, or a smaller tolerance"
            )
            if failure is None and report.rounded:
                why += f", or a higher precision, since steps are {report.note}"
            raise SimulationError(f"t = {state.time:.6g} s: no step of more than {wanted:.3g} s {why}") from failure
