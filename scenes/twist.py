"""A column is twisted by a turn of its top.

Physics: fixed corotated elasticity, pins, prescribed motion; backward Euler.
Units: SI. 1 m x 4 m x 1 m, 1000 kg/m^3, E = 1e6 Pa; no gravity.
Tested: once the top rests, the mean twist at mid-height is half of the top's, within 2 %, and the top is
where the motion puts it.
"""

import numpy as np

import warpfem as wf


def scene(
    cells: int = 4,
    E: float = 1e6,
    nu: float = 0.3,
    degrees: float = 180.0,
    seconds: float = 1.5,
    damping: float = 5.0,
    dt: float = 1 / 48,
    frames: int = 60,
) -> wf.Scene:
    def turn(rest: np.ndarray, time: float) -> np.ndarray:
        angle = np.radians(degrees) * min(time / seconds, 1.0)
        c, s = np.cos(angle), np.sin(angle)
        return rest @ np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]).T

    mesh = wf.Mesh.box(size=(1, 4, 1), cells=(cells, 4 * cells, cells), origin=(-0.5, 0, -0.5))
    column = wf.Body(
        "column",
        mesh,
        wf.FixedCorotated(E=E, nu=nu),
        density=1000,
        supports=[wf.Pin("bottom"), wf.PrescribedMotion("top", turn)],
    )
    return wf.Scene(
        [column],
        wf.BackwardEuler(),
        dt=dt,
        damping=damping,
        frames=frames,
        quantities={
            "turn at mid-height": wf.quantities.final_displacement("column", at=(0.5, 2, 0), axis=2),
            "stress at mid-height": wf.quantities.final_von_mises("column", at=(0.5, 2, 0)),
        },
    )


if __name__ == "__main__":
    print(wf.run(scene(), "twist.usdc"))
