"""warpfem: finite element simulation of elastic solids on NVIDIA Warp."""
