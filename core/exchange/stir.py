"""STIR: the pinhole matrix's detector and collimator files, where they can say what the system is.

"Pinhole SPECT UB" (STIR's ProjMatrixByBinPinholeSPECTUB and PinholeSPECTUB_Tools) knows detectors that stand upright,
parallel to z, all at one distance from the z axis and centred at z = 0 (its z0 moves the ring for attenuation only), with
holes anywhere before them. Modules that aim at the isocentre from another z have tilted crystals, which it cannot express.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..errors import InputError
from ..geometry.system import PinholeSystem
from ..geometry.views import Views
from .cameras import first_off
from .format import Format


def _write(system: PinholeSystem, views: Views, path: Path) -> None:
    """Four files, in cm: detector.txt, collimator.txt, matrix.par that names them, and projections.hs for the images.

    The detection plane is the crystal's front face. STIR adds half the crystal's thickness to the header's radius while
    its correction for depth of interaction is off, as it is here, so that much is taken away from it.
    """
    if len(views) != len(system):
        raise InputError(f"format stir describes the modules' crystals: expected {len(system)} views, got {len(views)}")
    n_v, n_u = views.shape
    to_detector = views.detector_centers - views.sources
    with np.errstate(divide="ignore", invalid="ignore"):  # what is no number is refused below
        # The plane that the rays of each pixel meet at l behind the pinhole.
        share = -system.collimator_length / np.einsum("mi,mi->m", to_detector, system.principal_rays)
    centers = views.sources + share[:, None] * to_detector
    u, v = share[:, None] * views.u_steps, share[:, None] * views.v_steps
    inverted = v[0, 2] < 0
    if inverted:
        u, v = -u, -v
    along = u * [1.0, 1.0, 0.0]
    with np.errstate(invalid="ignore"):
        x1 = along / np.linalg.norm(along, axis=1, keepdims=True)
    y1 = np.cross([0.0, 0.0, 1.0], x1)
    radius = float(centers[0] @ y1[0])
    pitch = np.array([np.linalg.norm(u[0]), np.linalg.norm(v[0])])
    errors = (
        centers - radius * y1,
        (u - pitch[0] * x1) * n_u / 2,
        (v - pitch[1] * np.array([0.0, 0.0, 1.0])) * n_v / 2,
    )
    off = np.sum([np.linalg.norm(error, axis=1) for error in errors], axis=0) / pitch.min()
    m = first_off(off) if radius > 0 else 0
    if m is not None:
        raise InputError(
            f"module {system.numbers[m]}: format stir holds crystals that stand parallel to the z axis in one ring: "
            f"pinholes at z = 0, one b + l and one pixel size"
        )
    if inverted:
        raise InputError("format stir describes the crystals: expected views with detector 'real'")
    thickness = _common(system.detector_thickness, system, "crystal thickness")
    collimator = float(np.mean(system.pinhole_distance))
    detector = ["Detectors in cm, each a ring of one for any azimuth", f"Number of rings: {len(system)}"]
    detector += ["Sigma (cm): 0.", f"Crystal thickness (cm): {thickness / 10:.9f}"]
    detector += ["Crystal attenuation coefficient (cm -1): 0."]
    holes = ["Pinholes, cm and degrees", "Model (cyl/pol): pol", f"Collimator radius (cm): {collimator / 10:.9f}"]
    holes += ["Wall thickness (cm): 0.", f"Number of holes: {len(system)}"]
    for m in range(len(system)):
        angle = np.degrees(np.arctan2(x1[m, 1], x1[m, 0]))
        detector += ["Nangles: 1", f"ang0 (deg): {angle:.9f}", "incr (deg): 0.", "z0 (cm): 0."]
        x, y, z = np.array([views.sources[m] @ x1[m], views.sources[m] @ y1[m] - collimator, views.sources[m, 2]]) / 10
        d = system.pinhole_diameter[m] / 10
        # So wide that the whole crystal is seen through the whole hole.
        open_to = (system.detector_side[m] + system.pinhole_diameter[m]) / 2 / system.collimator_length[m]
        accepted = np.degrees(np.arctan(open_to))
        numbers = (d, d, 0.0, 0.0, accepted, accepted)
        holes.append(f"h{m + 1}: {m + 1} {x:.9f} {y:.9f} {z:.9f} round " + " ".join(f"{n:.9f}" for n in numbers))
    roi = float(np.max(system.roi_radius))
    matrix = [
        "Projection Matrix By Bin Pinhole SPECT UB Parameters:=",
        "maximum number of sigmas := 2.0",
        "spatial resolution PSF := 0.001",
        "subsampling factor PSF := 1",
        "detector file := detector.txt",
        "collimator file := collimator.txt",
        "psf correction := no",
        "doi correction := no",
        "attenuation type := no",
        f"object radius (cm) := {roi / 10:.9f}",
        "mask from attenuation map := 0",
        "keep all views in cache := 0",
        "End Projection Matrix By Bin Pinhole SPECT UB Parameters:=",
    ]
    header = [
        "!INTERFILE :=",
        "!imaging modality := nucmed",
        "!version of keys := STIR4.0",
        "!GENERAL DATA :=",
        "!data offset in bytes := 0",
        "name of data file := projections.s",
        "!GENERAL IMAGE DATA :=",
        "!type of data := Tomographic",
        "imagedata byte order := LITTLEENDIAN",
        "!SPECT STUDY (general) :=",
        "!process status := Acquired",
        f"!matrix size [1] := {n_u}",
        f"!matrix size [2] := {n_v}",
        "!number format := float",
        "!number of bytes per pixel := 4",
        f"scaling factor (mm/pixel) [1] := {float(pitch[0])!r}",
        f"scaling factor (mm/pixel) [2] := {float(pitch[1])!r}",
        f"!number of projections := {len(system)}",
        "!extent of rotation := 360",
        "!SPECT STUDY (acquired data) :=",
        "!direction of rotation := CCW",
        "start angle := 0",
        "orbit := Circular",
        f"radius := {radius - thickness / 2!r}",
        "!END OF INTERFILE :=",
    ]
    files = {"detector.txt": detector, "collimator.txt": holes, "matrix.par": matrix, "projections.hs": header}
    for name, lines in files.items():
        (path / name).write_text("\n".join(lines) + "\n", encoding="ascii")


def _common(values: np.ndarray, system: PinholeSystem, what: str) -> float:
    if np.any(values != values[0]):
        number = system.numbers[np.argmax(values != values[0])]
        raise InputError(f"module {number}: format stir has one {what}, and this module's differs from the first's")
    return float(values[0])


STIR = Format("stir", "STIR: pinhole matrix, for one horizontal ring", (), _write)
