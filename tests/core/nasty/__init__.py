"""Workbooks that are easily misread, each with the scanner that a person sees in it."""
