"""A rubber block of a user's own material is pulled; only its energy density is written down.

Physics: a compressible Mooney-Rivlin solid, psi = c1 (J^-2/3 I1 - 3) + c2 (J^-4/3 I2 - 3) + K/2 (J - 1)^2;
traction on top, rollers below and on two sides; backward Euler with damping.
Units: SI. A 1 m cube; no gravity.
Source: at small strain it is Hooke's solid with mu = 2 (c1 + c2) and bulk modulus K, so that a pull of
t [Pa] lengthens it by t / E with E = 9 K mu / (3 K + mu).
Tested: under a small pull it lengthens by that within 1 %.
"""

from typing import Any

import warp as wp

import warpfem as wf


@wp.func
def mooney_rivlin(F: wp.mat33d, parameters: Any):
    c1 = parameters[0]
    c2 = parameters[1]
    K = parameters[2]
    C = wp.transpose(F) * F
    J = wp.determinant(F)
    I1 = wp.trace(C)
    I2 = (I1 * I1 - wp.ddot(C, C)) / wp.float64(2.0)
    inverse_cube_root = wp.pow(J, wp.float64(-1.0) / wp.float64(3.0))  # of 1.0 / 3.0 Warp keeps 8 digits
    scale = inverse_cube_root * inverse_cube_root  # J^-2/3
    three = wp.float64(3.0)
    volumetric = K / wp.float64(2.0) * (J - wp.float64(1.0)) * (J - wp.float64(1.0))
    return c1 * (scale * I1 - three) + c2 * (scale * scale * I2 - three) + volumetric


def scene(
    cells: int = 3,
    c1: float = 1e5,
    c2: float = 5e4,
    K: float = 2e6,
    pull: float = 4e5,
    damping: float = 20.0,
    dt: float = 1 / 48,
    frames: int = 36,
) -> wf.Scene:
    rubber = wf.EnergyMaterial(mooney_rivlin, {"c1": c1, "c2": c2, "K": K})
    mesh = wf.Mesh.box(size=(1, 1, 1), cells=(cells, cells, cells))
    block = wf.Body(
        "rubber",
        mesh,
        rubber,
        density=1100,
        supports=[wf.Pin("bottom", axes=(1,)), wf.Pin("left", axes=(0,)), wf.Pin("back", axes=(2,))],
        loads=[wf.Traction("top", (0, pull, 0))],
    )
    return wf.Scene(
        [block],
        wf.BackwardEuler(),
        dt=dt,
        damping=damping,
        frames=frames,
        quantities={"lengthening": wf.quantities.final_displacement("rubber", at=(1, 1, 1), axis=1)},
    )


if __name__ == "__main__":
    print(wf.run(scene(), "custom_material.usdc"))
