"""Two bars of different materials hang side by side and stretch under their weight.

Physics: linear elasticity and stable Neo-Hookean elasticity in one scene, gravity, damping; backward Euler.
Units: SI. Each 0.5 m x 2 m x 0.5 m, 1000 kg/m^3, nu = 0; the soft one has a quarter of the stiffness.
Source: a hanging bar grows by rho g L^2 / (2 E).
Tested: each bar grows by that within 2 %.
"""

import warpfem as wf


def scene(
    cells: int = 2,
    E: float = 4e6,
    damping: float = 10.0,
    dt: float = 1 / 48,
    frames: int = 48,
) -> wf.Scene:
    def bar(name: str, x: float, material) -> wf.Body:
        mesh = wf.Mesh.box(size=(0.5, 2, 0.5), cells=(cells, 4 * cells, cells), origin=(x, 0, 0))
        return wf.Body(name, mesh, material, density=1000, supports=[wf.Pin("top")])

    return wf.Scene(
        [
            bar("stiff", 0.0, wf.LinearElasticity(E=E, nu=0.0)),
            bar("soft", 1.0, wf.StableNeoHookean(E=E / 4, nu=0.0)),
        ],
        wf.BackwardEuler(),
        dt=dt,
        gravity=(0, -9.81, 0),
        damping=damping,
        frames=frames,
        quantities={
            "growth of the stiff bar": wf.quantities.final_displacement("stiff", at=(0.25, 0, 0.25), axis=1),
            "growth of the soft bar": wf.quantities.final_displacement("soft", at=(1.25, 0, 0.25), axis=1),
        },
    )


if __name__ == "__main__":
    print(wf.run(scene(), "two_materials.usdc"))
