"""Meshes from elsewhere: mesh files, surface files, and tetrahedra inside a surface.

:func:`load_mesh` is the way from a file to a :class:`warpfem.mesh.Mesh`; :func:`read_surface` and
:func:`tetrahedralize` are its two halves for surfaces, to change something in between. Files are read in a child
process, by a module for each library that reads some: what is wrong with one cannot harm this process.

What this needs beyond NumPy is optional and imported where it is used: ``meshio`` and ``trimesh`` (extra ``mesh``) read
files, ``pytetwild`` (extra ``tet``) fills surfaces.
"""

from warpfem.meshing.files import load_mesh, read_surface
from warpfem.meshing.filling import tetrahedralize

__all__ = ["load_mesh", "read_surface", "tetrahedralize"]
