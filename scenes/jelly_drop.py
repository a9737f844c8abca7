"""A soft box falls on a floor, bounces and comes to rest.

Physics: stable Neo-Hookean elasticity, gravity, penalty contact with Coulomb friction; backward Euler.
Units: SI. A 1 m cube of 1000 kg/m^3 at E = 1e5 Pa (gelatine) falls from 0.3 m.
Tested: at rest the floor carries the weight, so that the mean depth of the bottom, weighted by area, is
rho g H / k with the contact stiffness k [Pa/m], within 2 %. Where meshes are compared, the floor wants a k of its own,
such as 4e5: by default it goes with the cells. Floors that are much stiffer send waves through the body that only very
fine meshes follow.
"""

import warpfem as wf


def scene(
    cells: int = 6,
    E: float = 1e5,
    nu: float = 0.45,
    height: float = 0.3,
    friction: float = 0.5,
    stiffness: float | None = None,
    damping: float = 1.0,
    dt: float = 1 / 120,
    frames: int = 72,
) -> wf.Scene:
    mesh = wf.Mesh.box(size=(1, 1, 1), cells=(cells, cells, cells), origin=(-0.5, height, -0.5))
    jelly = wf.Body("jelly", mesh, wf.StableNeoHookean(E=E, nu=nu), density=1000)
    return wf.Scene(
        [jelly],
        wf.BackwardEuler(),
        dt=dt,
        gravity=(0, -9.81, 0),
        obstacles=[wf.Plane(point=(0, 0, 0), normal=(0, 1, 0), friction=friction, stiffness=stiffness)],
        damping=damping,
        frames=frames,
        quantities={
            "deepest": wf.quantities.largest_displacement("jelly", at=(0, height + 1, 0), axis=1),
            "at the end": wf.quantities.final_displacement("jelly", at=(0, height + 1, 0), axis=1),
        },
    )


if __name__ == "__main__":
    print(wf.run(scene(), "jelly_drop.usdc"))
