"""Implicit Runge-Kutta schemes of second and third order."""

from dataclasses import dataclass

from warpfem.boundary import is_number
from warpfem.errors import SceneError
from warpfem.model import Model
from warpfem.solvers.base import Stepper
from warpfem.solvers.implicit import ImplicitSolver, ImplicitStepper, Tableau


@dataclass(frozen=True)
class ImplicitMidpoint(ImplicitSolver):
    """The implicit midpoint rule: M (v - v_t)/dt = f((u + u_t)/2), (u - u_t)/dt = (v + v_t)/2.

    It conserves linear and angular momentum (to ``tolerance``) and damps nothing: for smooth motion without contact.
    What dt does not resolve rings on: from starts far from rest, such as scrambled points, the energy can grow without
    bound, or steps fail, and points that friction ought to stop tremble.
    """

    name = "implicit_midpoint"
    order = 2
    tableau = Tableau(rows=((0.5,),), weights=(1.0,))


@dataclass(frozen=True)
class SinglyDiagonallyImplicit(ImplicitSolver):
    """Settings of the schemes that can choose their steps.

    Attributes:
        error: what a second of simulated time may add to the error of the displacements, as the root of its mean
            square over a body's mass, relative to the diagonal of the body's bounding box [1/s]. Steps with
            ``dt="auto"`` are then as long as that allows, up to the frame interval. ``None`` leaves dt as it is given.
            ``tolerance`` limits the accuracy too, and so does rounding: stiff bodies in float32 take needlessly short
            steps to a small error.
    """

    error: float | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.error is not None and not (is_number(self.error) and self.error > 0.0):
            raise SceneError(f"{type(self).__name__}: error must be a finite number > 0, or None, not {self.error!r}")

    def stepper(self, model: Model) -> Stepper:
        return ImplicitStepper(model, self, self.error)


_GAMMA_2 = 1.0 - 0.5**0.5
_GAMMA_3 = 0.43586652150845899942


@dataclass(frozen=True)
class SDIRK2(SinglyDiagonallyImplicit):
    """Singly diagonally implicit Runge-Kutta of two stages, second order, L-stable (Alexander 1977).

    It damps motion that dt does not resolve, as backward Euler does, and little of what it resolves: for motion that is
    to be followed with contact, friction, or from any start.
    """

    name = "sdirk2"
    order = 2
    tableau = Tableau(rows=((_GAMMA_2,), (1.0 - _GAMMA_2, _GAMMA_2)))


@dataclass(frozen=True)
class SDIRK3(SinglyDiagonallyImplicit):
    """Singly diagonally implicit Runge-Kutta of three stages, third order, L-stable (Alexander 1977).

    For impacts and small errors: of the block that falls on a floor in ``benchmarks/time_integration.py`` it has less
    than half the error of SDIRK2 for as many linear solves. Long steps damp what they barely resolve more than those of
    SDIRK2, which loses less of a spin.
    """

    name = "sdirk3"
    order = 3
    tableau = Tableau(
        rows=(
            (_GAMMA_3,),
            (0.5 * (1.0 - _GAMMA_3), _GAMMA_3),
            (-1.5 * _GAMMA_3**2 + 4.0 * _GAMMA_3 - 0.25, 1.5 * _GAMMA_3**2 - 5.0 * _GAMMA_3 + 1.25, _GAMMA_3),
        )
    )
