"""Cases 1 to 5 and 22: forces, stresses and trajectories where rounding could spoil them."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from warpfem.extremes.subjects import DTYPES, EPSILON, custom, hookean, label, model_of, rotation, slab
from warpfem.extremes.table import Trial, at_most, case
from warpfem.materials import LinearElasticity

E, NU = 1e5, 0.3


@case(
    1,
    "rigid rotation 0..360 degrees, translation",
    "After a rigid rotation by 0 to 360 degrees the largest force at a point is below 4 eps E A L/h: eps the "
    "precision, A the cross-section, L the body's length, h its shortest edge. A translation by T = 1e6 L gives no "
    "force at all, and changes the forces of a deformed body by at most 4 eps E A |T|/h, which is what the "
    "displacement resolves. (Linear elasticity is not invariant under rotations: translation only.)",
)
def rigid_motion(quick: bool) -> Iterator[Trial]:
    rng = np.random.default_rng(1)
    for dim in (2, 3):
        mesh = slab(dim)
        x, length, edge = mesh.points, 2.0, mesh.edge_lengths.min()
        axes = [np.ones(2)] if dim == 2 else [*np.eye(3), np.ones(3), *rng.normal(size=(0 if quick else 3, 3))]
        angles = np.radians(np.arange(0.0, 361.0, 45.0 if quick else 7.5))
        noise = 0.05 * edge * rng.uniform(-1.0, 1.0, x.shape)
        materials = hookean(E, NU) if quick else [*hookean(E, NU), custom(E, NU)]
        for material in materials:
            for dtype in DTYPES:
                model = model_of(material, mesh, dtype)
                limit = 4.0 * EPSILON[dtype] * E / edge  # A = 1 m^2
                state = model.state()

                def forces(u: np.ndarray, model=model, state=state) -> np.ndarray:
                    state.assign(displacement=u)
                    return model.internal_force(state)

                if not isinstance(material, LinearElasticity):
                    turned = [x @ rotation(axis, angle).T - x for axis in axes for angle in angles]
                    worst = max(np.linalg.norm(forces(u), axis=1).max() for u in turned)
                    yield at_most(label(material, dim, dtype, f"{len(turned)} rotations"), worst, limit * length, " N")
                shift = np.full(dim, 1e6 * length / np.sqrt(dim))
                worst = np.abs(forces(np.broadcast_to(shift, x.shape))).max()
                yield at_most(label(material, dim, dtype, "translated by 1e6 L"), worst, 0.0, " N")
                change = forces(noise + shift) - forces(noise)
                worst = np.linalg.norm(change, axis=1).max()
                yield at_most(label(material, dim, dtype, "deformed and translated"), worst, limit * 1e6 * length, " N")
