"""Icosahedron and its group, rotations, cameras and seeds: no learning, no files.

Conventions are in `docs/conventions.md`: a `rotation` takes object to camera coordinates, a `view`
is its transpose, camera axes are x right, y up, z towards the viewer. Import from the modules
(`i2i.geometry.icosahedron`, ...): rendering processes use the cameras and never load torch.
"""
