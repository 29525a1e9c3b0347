"""Geometries that are calibrated by measurements and improved by gradients."""
