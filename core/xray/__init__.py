"""X-ray sources and panels as a scanner, in the same room as the pinholes.

system.py        `XraySystem`, the second kind of scanner, and its columns
arrangements.py  arcs and rings of sources with their panels
checks.py        what stands in the way of cones, of panels and of the patient
"""
