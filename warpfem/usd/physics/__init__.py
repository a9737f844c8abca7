"""Stages with physics on them: what a simulation needs of one, as plain data.

It follows the proposal for deformable bodies in UsdPhysics (AOUSD, ``wp_deformable_physics``, 2026) and UsdPhysics
itself. What is not understood is named in a warning.
"""
