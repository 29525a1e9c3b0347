"""Triangle meshes: read and checked, into volumes and out of them."""
