"""Phantoms: shapes with known activity, voxelised on any grid."""
