"""Blender glue: ids, registration, properties, and the bridges between core objects and datablocks.

This file imports nothing, so that `mphdrr.addon.blender.ids` can be read without Blender.
"""
