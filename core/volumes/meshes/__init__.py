"""Triangle meshes: their files, and their conversion from and to volumes.

`read_mesh` and `write_mesh` (`mesh.py`) handle files of a `Mesh`, `require_closed` checks one; `voxelize_mesh`
(`voxelization.py`) fills a volume with closed meshes, `volume_to_mesh` (`surface.py`) makes the surface at a level.

A further mesh format is an ending in `MESH_FORMATS` that trimesh reads and writes.
"""
