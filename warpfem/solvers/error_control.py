"""Steps of implicit schemes that are as long as an error target allows."""

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
            0.5 * model.host_mass[points].sum() * float(np.sum(np.ptp(body.mesh.bounding_box, axis=0) ** 2))
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


class ErrorControl:
    """Chooses the steps of a stepper that estimates their errors.

    The estimate of a step falls with its length to the power order + 1, and the target allows an error in
    proportion to the length: the next step is the last times (1 / ratio)^(1 / order), ``SAFETY`` apart.

    Attributes:
        stepper: the stepper; its reports' ``error`` is the estimate over what the target allows.
        order: that of the scheme.
        longest: the longest step [s].
        wanted: the length of the next step [s]. All that has to be known to go on as if nothing had been.
        rejected: steps that were tried and not taken.
    """

    def __init__(self, stepper: Stepper, order: int, longest: float) -> None:
        self.stepper = stepper
        self.order = order
        self.longest = longest
        self.wanted = longest
        self.rejected = 0

    def step(self, state: State, left: float) -> tuple[StepReport, float]:
        """Advances ``state`` by the longest good step that divides the time ``left`` [s].

        Returns:
            The report and the length of the step [s].

        Raises:
            SimulationError: none is good; the state is as it was before.
        """
        failure: SimulationError | None = None
        while self.wanted > LEAST_PART * self.longest:
            dt = left / np.ceil(left / self.wanted - 1e-9)
            try:
                report = self.stepper.try_step(state, dt)
            except SimulationError as error:
                failure = error
                self.wanted = 0.5 * dt
            else:
                failure = None
                least, most = LARGEST_CHANGE
                change = SAFETY * report.error ** (-1.0 / self.order) if report.error > 0.0 else most
                self.wanted = min(self.longest, dt * min(max(change, least), most))
                if report.error <= 1.0:
                    return report, dt
            self.rejected += 1
        raise SimulationError(
            f"t = {state.time:.6g} s: no step of more than {self.wanted:.3g} s "
            + (f"can be solved: {failure}" if failure else "meets the error target: take a larger one, or a fixed dt")
        ) from failure
