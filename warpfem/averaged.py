"""Averaged linear cells: their volumetric strain is averaged over patches, so that they do not lock.

Linear cells have hardly any motion that keeps each cell's volume, and resist bending far too much as nu nears 0.5. Here
a cell keeps of its first Lamé parameter only lam_k = lam mu/(lam + mu), which is less than mu, so that alone it is a
solid with nu < 0.25. The rest, lam_a = lam - lam_k, resists the mean volumetric strain of a patch g of some 2^dim cells
c (F-bar patches: de Souza Neto, Pires and Owen 2005; see patches.py):

    U = sum_c V_c psi(F_c; mu, lam_k) + sum_g S_g^2 / (2 L_g),   S_g = sum_c lam_a V_c theta_c,   L_g = sum_c lam_a V_c,

with theta the measure of volume change that the material squares. So it stays an energy, with the pressures
p_c = lam_a S_g / L_g in P_c = dpsi/dF + p_c dtheta/dF and the stiffness K = K_local + sum_g r_g r_g^T / L_g: K_local is
that of the density psi(F; mu, lam_k) + p_c theta with the pressure held, and r_g = dS_g/du couples the patch's points.
By the inequality of Cauchy and Schwarz S_g^2 / L_g is at most the sum of lam_a V_c theta_c^2: no body has more energy
than with plain linear cells, and r_g r_g^T / L_g is at most what the cells would add each by itself, which bounds the
frequencies.

Chosen by measurement (``benchmarks/locking.py``, at nu = 0.4999):

- Means over the cells about each point, the other common choice, cure irregular meshes, but hardly those of
  ``Mesh.rectangle`` and of five tetrahedra a cube. Their pressures alternate from cell to cell: in a squashed block the
  mean over neighbours takes away 17 to 77 % of them, of those of patches 4 to 37 %, most on the coarsest meshes.
  Keeping 5 % of lam in each cell (Puso and Solberg 2006) makes both a little worse.
- Patches bend about as plain cells do at nu = 0.3. Quadratic cells bend better with as many unknowns, but in irregular
  meshes of tetrahedra with pressures of which 75 to 93 % alternate.
- None has soft modes: the lowest eigenvalues of a free block are those of the solid.
- What a cell keeps of lam adds a fifth to a half to the error at small strains. Without it single cells collapse under
  strong compression while their patch keeps its volume: squashed by half, to J = -0.19, with it to 0.10.
"""

from typing import Any

import numpy as np
import warp as wp

from warpfem.elements import element_kernels
from warpfem.materials.base import Constitutive
from warpfem.model import CellBlock
from warpfem.patch_kernels import alone_constitutive, local_constitutive, patch_kernels
from warpfem.patches import cell_patches
from warpfem.scene import Body


class AveragedBlock(CellBlock):
    """Averaged cells. The pressures of their patches are brought up to date with each launch that needs them.

    Attributes:
        patch: the patch of each cell, (count,) int.
        patch_count: patches.
    """

    averaged = True

    def __init__(self, constitutive: Constitutive, parts: list[tuple[Body, int, int]], dtype: str, device) -> None:
        shape = parts[0][0].mesh.shape
        super().__init__(element_kernels(local_constitutive(constitutive), shape, dtype), parts, device)
        self.bounding_kernels = element_kernels(alone_constitutive(constitutive), shape, dtype)
        self._kernels = patch_kernels(constitutive.volumetric, shape.dim, dtype)
        patches = []
        self.patch_count = 0
        for body, _, _ in parts:
            patches.append(self.patch_count + cell_patches(body.mesh, _moduli(body)[1]))
            self.patch_count = int(patches[-1].max()) + 1
        self.patch = np.concatenate(patches)
        self._point_bound = int(self.host_cells.max()) + 1
        self._arrays = self._patch_arrays(
            np.concatenate([_moduli(body)[1] * body.mesh.cell_volumes for body, *_ in parts])
        )

    def _patch_arrays(self, weights: np.ndarray) -> dict[str, wp.array]:
        """The arrays over patches, from lam_a V of the cells.

        The cells of each are ``starts, members``, the entries of its row r_g ``row_starts, points``, with the place in
        them of each cell's points in ``places``; the entries by columns ``column_starts, column_entries,
        column_patches``.
        """
        t, patch, bound = self.kernels.types, self.patch, self._point_bound
        keys, places = np.unique(patch[:, None].astype(np.int64) * bound + self.host_cells, return_inverse=True)
        patches, points = np.divmod(keys, bound)
        by_point = np.argsort(points, kind="stable")

        def integers(data: np.ndarray) -> wp.array:
            return wp.array(data, dtype=wp.int32, device=self.device)

        return {
            "patch": integers(patch),
            "starts": integers(np.concatenate([[0], np.cumsum(np.bincount(patch))])),
            "members": integers(np.argsort(patch, kind="stable")),
            "row_starts": integers(np.searchsorted(keys, np.arange(self.patch_count + 1) * bound)),
            "points": integers(points),
            "places": integers(places.reshape(self.host_cells.shape)),
            "column_starts": integers(np.searchsorted(points[by_point], np.arange(bound + 1))),
            "column_entries": integers(by_point),
            "column_patches": integers(patches[by_point]),
            "inverse_modulus": wp.array(1.0 / np.bincount(patch, weights), dtype=t.scalar, device=self.device),
            "strain": wp.zeros(self.patch_count, dtype=t.scalar, device=self.device),
            "rate": wp.zeros(self.patch_count, dtype=t.scalar, device=self.device),
        }

    def _parameter_rows(self, body: Body) -> np.ndarray:
        kept, averaged = _moduli(body)
        own = body.material.with_lam(kept).parameter_rows(len(kept))
        return np.column_stack([own, averaged, np.zeros_like(kept)])

    def arrays(self) -> list[wp.array]:
        return [*super().arrays(), *self._arrays.values()]

    def launch(self, name: str, inputs: list, outputs: list, **options: Any) -> wp.Launch | None:
        """As for other blocks; stiffness and its product lack the coupling of the cells of a patch."""
        if name != "step_limit":
            u = inputs[1] if name == "frequency" else inputs[0]
            self.update_pressure(u, taped=name == "taped_force")
        launch = super().launch(name, inputs, outputs, **options)
        if name == "energy":
            self._launch_own("energy", self.patch_count, [], outputs)
        elif name == "density":
            self._launch_own("density", self.count, [], outputs)
        return launch

    def update_pressure(self, u: wp.array, taped: bool = False) -> None:
        """Brings the pressures of the patches up to date with the displacements ``u``."""
        prefix = "taped_" if taped else ""
        self._launch_own(f"{prefix}strain", self.patch_count, [u], [self._arrays["strain"]])
        self._launch_own(f"{prefix}pressure", self.count, [], [self.arguments["parameters"]])

    def require_gradients(self) -> None:
        """Lets a tape follow the pressures."""
        for array in (self._arrays["strain"], self.arguments["parameters"]):
            array.requires_grad = True

    # --- the coupling sum_g r_g r_g^T / L_g -------------------------------------------------------------

    def linearize(self, u: wp.array) -> None:
        """Takes the coupling at ``u``, and brings the pressures up to date for the stiffness there."""
        self.update_pressure(u)
        if "rows" not in self._arrays:
            vector = self.kernels.types.vector
            self._arrays["rows"] = wp.empty(len(self._arrays["points"]), dtype=vector, device=self.device)
        self._launch_own("rows", self.patch_count, [u], [self._arrays["rows"]])

    def add_coupling(self, p: wp.array, product_out: wp.array) -> None:
        """Adds the product of the coupling with p."""
        self._launch_own("rate", self.patch_count, [p], [self._arrays["rate"]])
        self._launch_own("product", self._point_bound, [], [product_out])

    def add_coupling_diagonal(self, blocks_out: wp.array) -> None:
        """Adds the coupling's blocks on the diagonal, one for each point."""
        self._launch_own("diagonal", self._point_bound, [], [blocks_out])

    def coupling_rows(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """The coupling at the displacements that were taken last, on the host.

        Returns:
            The start of each patch's row in the next two, its points, the entries r_g of these, and 1 / L_g.
        """
        names = ("row_starts", "points", "rows", "inverse_modulus")
        starts, points, rows, inverse = (self._arrays[name].numpy() for name in names)
        return starts, points, rows, inverse

    def _launch_own(self, name: str, tasks: int, inputs: list, outputs: list) -> None:
        kernel = getattr(self._kernels, name)
        known = {**self.arguments, **self._arrays}
        own = [known[argument.label] for argument in kernel.adj.args if argument.label in known]
        wp.launch(kernel, tasks, inputs=[*own, *inputs], outputs=outputs, device=self.device)


def _moduli(body: Body) -> tuple[np.ndarray, np.ndarray]:
    """What each cell keeps of its first Lamé parameter, and what its patch averages, (cell_count,) each [Pa]."""
    count = body.mesh.cell_count
    lam, mu = (np.broadcast_to(np.asarray(value), count) for value in (body.material.lam, body.material.mu))
    return lam * mu / (lam + mu), lam * lam / (lam + mu)
