"""Neighbours: solids of other simulators stepped by warpfem. Each module needs the package that it is named after."""
