"""Learned reconstruction: networks that know the geometry of their scanner, and their judge.

Files of this room import torch, MONAI and Lightning only in their own modules; this one imports none of them, so that
commands and panels can say what is missing.
"""
