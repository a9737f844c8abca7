"""The commands of ``warpfem``, a file each: ``add`` gives a parser its options, and ``execute`` does it."""
