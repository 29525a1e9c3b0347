"""From a system and a volume to images and to a projection run: the main job, as one call."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..arrays import Array, ArrayLike, Floats32
from ..errors import InputError, warn
from ..geometry.scanner import Detector, Scanner
from ..geometry.system import PinholeSystem
from ..geometry.views import Views
from ..memory import require
from ..models.coefficient_checks import mu_warnings
from ..physics.dead_time import dead_time_counts
from ..physics.isotopes import photon_energy
from ..physics.noise import sample_counts
from ..progress import Progress
from ..projector import Emission, Model, Projector, Transmission, intensity
from ..validation import positive, seed_number
from ..volumes.volume import Volume
from ..xray.scan import SpectralScan
from .counting import scaled
from .run import ProjectionRun

LINES = "lines"
"""In place of the energy at which CT numbers become mu: they attenuate each line of the isotope at its own."""


@dataclass(frozen=True, eq=False)
class Imaging:
    """Makes images of volumes: the one route of runs, reconstructions and events, with the same warnings for all."""

    projector: Projector
    photons: float | None = None  # as for `project_run`
    dead_time: tuple[float, str] = (0.0, "non-paralysable")  # of each module, s, and its kind

    @property
    def model(self) -> Model:
        """What a pixel measures."""
        return self.projector.model

    def images(self, volume: Volume, mu: Floats32 | None = None, progress: Progress | None = None) -> Floats32:
        """The expected images (M, n_v, n_u) of a volume: the background included, less what dead time takes."""
        images = self.expected(volume, mu, progress)
        images *= self.recorded_shares(images)
        return images

    def recorded_shares(self, images: Floats32) -> Floats32:
        """The shares (M, 1, 1) of expected images that modules record beside their dead time; a warning says where they
        are beyond what a paralysable counter can record, so that the counts are those of a smaller rate.
        """
        (tau, kind), model = self.dead_time, self.model
        if not tau or not isinstance(model, Emission):
            return np.ones((1, 1, 1), np.float32)
        totals = np.maximum(images.sum(axis=(1, 2), dtype=float), 1e-30)
        if kind == "paralysable" and (beyond := totals / model.time > 1 / tau).any():
            numbers = ", ".join(map(str, model.system.numbers[beyond][:5]))
            warn(f"dead time: so many photons that more of them would be fewer counts, in module {numbers}")
        recorded: Array = dead_time_counts(totals, model.time, tau, kind) / totals  # type: ignore[arg-type]
        return recorded.astype(np.float32)[:, None, None]

    def expected(self, volume: Volume, mu: Floats32 | None = None, progress: Progress | None = None) -> Floats32:
        """The expected images (M, n_v, n_u) of a volume, the background included, without dead time.

        `mu`, 1/mm, attenuates in place of the model's, on whose grid it is. `progress` is called after every view.
        `InputError` where the model has no meaning for the volume. Warnings say where images hardly are what is wanted.
        """
        A = self.projector
        self.model.check_volume(volume)
        if self.photons is not None and not (isinstance(self.model, Transmission) and volume.quantity == "mu"):
            what = f"{self.model.name} of {volume.quantity}"
            raise InputError(f"photons: expected the transmission of a volume of mu, got {what}")
        warn_of_images(volume, A.views, self.model)
        if mu is not None and isinstance(self.model, Emission):
            for text in mu_warnings(mu, self.model):
                warn(text)
        if isinstance(self.model, SpectralScan):
            images = self.model.counts(volume, A, progress)
        else:
            images = np.asarray(A(volume, progress, mu))
        for image, background in zip(images, A.background, strict=True):
            passed = image if self.photons is None else intensity(image, self.photons)
            image[...] = passed + background.astype(image.dtype)
        return images.astype(np.float32, copy=False)

    def unit(self, volume: Volume) -> str:
        """The unit of a volume's images."""
        return self.model.unit(volume) if self.photons is None else "photons"


def project_run(
    system: Scanner,
    volume: Volume,
    shape: tuple[int, int] = (256, 256),
    detector: Detector = "virtual",
    magnification: float = 10.0,
    pitch: ArrayLike | None = None,
    backend: str = "auto",
    threads: int | None = None,
    settings: Mapping[str, Any] | None = None,
    model: Model | None = None,
    photons: float | None = None,
    noise_seed: int | None = None,
    progress: Progress | None = None,
    dead_time: tuple[float, str] = (0.0, "non-paralysable"),
) -> ProjectionRun:
    """Project `volume` into every module of `system`.

    Parameters
    ----------
    shape, detector, magnification, pitch
        The images, as for `PinholeSystem.views`.
    backend, threads
        As for `Projector`.
    settings
        More to record in the run.
    model
        `Transmission` (the default), an `Emission`, an `InverseSquareSum` or a `SpectralScan` of the same system.
    photons
        Photons of an X-ray source, per pixel: the run of a volume of mu holds those that pass (`intensity`), not line
        integrals.
    noise_seed
        With counts or `photons`: the run holds counts drawn with this seed (`sample_counts`), not their means.
    progress
        Called after every view.
    dead_time
        With an `Emission`: that of each module, s, and its kind, "non-paralysable" or "paralysable". The expected counts,
        before noise, are less by it (`dead_time_counts`); the run's background is what is recorded of it.

    Raises
    ------
    InputError
        A setting is out of range, the volume holds what the model has no meaning for, or the images do not fit into memory.
    """
    photons = None if photons is None else positive(photons, "photons")
    if noise_seed is not None:
        if photons is None and not (isinstance(model, Emission | SpectralScan) and model.unit(volume) == "counts"):
            raise InputError("noise_seed: only counts of an Emission or of X rays, or photons that pass, have noise")
        noise_seed = seed_number(noise_seed)
    views = system.views(shape=shape, detector=detector, magnification=magnification, pitch=pitch)
    n_v, n_u = views.shape
    each = 4.0 if noise_seed is None else 20.0  # bytes; counts are drawn from float64, as int64
    require(each * len(views) * n_v * n_u, f"a set of {len(views)} projections of {n_v} x {n_u} pixels")
    imaging = Imaging(Projector(volume.grid, views, model, backend, threads), photons, dead_time)
    model = imaging.model
    images = imaging.expected(volume, progress=progress)
    shares = imaging.recorded_shares(images)
    images *= shares
    if noise_seed is not None:
        images = sample_counts(images, noise_seed).astype(np.float32)
    record = {
        "detector": detector, "magnification": float(magnification),
        "pitch_mm": None if pitch is None else np.broadcast_to(pitch, 2).tolist(), "model": model.name, **model.record(),
        **({} if photons is None else {"photons": photons}), "backend": imaging.projector.backend, **(settings or {}),
    }  # fmt: skip
    return ProjectionRun(
        images, system, views, volume, unit=imaging.unit(volume), settings=record, seed=noise_seed,
        background=scaled(model.background, shares), efficiency=model.efficiency,
    )  # fmt: skip


def warn_of_energy(model: Model, energy: float | str | None, source: str) -> None:
    """Warn where mu holds at an energy (keV, or an isotope's) whose photons the model does not count.

    `source` names what the mu is of.
    """
    window = model.window if isinstance(model, Emission) else None
    if window is None or energy in (None, LINES):
        return
    energy = photon_energy(energy)
    if not window[0] <= energy <= window[1]:
        counted = f"photons of {window[0]:g} to {window[1]:g} keV are counted"
        warn(f"the mu of {source} holds at {energy:g} keV, {counted}")


def warn_of_images(volume: Volume, views: Views, model: Model) -> None:
    """Warn where images of a volume hardly are what is wanted: activity below 0, pixels beside crystals, unseen parts."""
    lowest, highest = float(volume.array.min()), float(volume.array.max())
    if isinstance(model, Emission) and lowest < -0.1 * abs(highest):  # interpolation leaves less
        warn(f"the activity is {lowest:g} to {highest:g} kBq/mL: what is below 0 makes counts below 0")
    if isinstance(model, Emission) and not model.within_crystal:
        _warn_of_no_crystal(model.system, views)
    _warn_of_unseen(volume, views, ends_at_plane=not isinstance(model, Emission))


def _warn_of_no_crystal(system: PinholeSystem, views: Views) -> None:
    """Warn where images of counts reach beyond the crystal."""
    magnification = np.linalg.norm(views.detector_centers - views.sources, axis=1) / system.collimator_length
    steps = np.stack([views.u_steps, views.v_steps])
    sides = np.linalg.norm(steps, axis=2) * np.array(views.shape[::-1])[:, None] / magnification  # on the crystal, mm
    beyond = int(np.any(sides > 1.001 * system.detector_side, axis=0).sum())
    if beyond:
        warn(
            f"{beyond} of {len(views)} images are wider than the crystal: pixels beside it count photons that nothing "
            "detects, unless within_crystal (Crystal's Side) leaves them out"
        )


def _warn_of_unseen(volume: Volume, views: Views, ends_at_plane: bool) -> None:
    """Warn where a volume lies beside the isocentre, or beyond the plane at which the rays end."""
    index = volume.grid.index_from_world[:3, 3]
    if np.any(index < -0.5) or np.any(index > np.array(volume.grid.shape) - 0.5):
        warn("the isocentre, at which the modules aim, lies outside the volume's grid: check the volume's position")
    corners = np.concatenate([volume.grid.corners(), np.ones((8, 1))], axis=1)
    depth = corners @ views.projection_matrices()[:, 2].T  # (8, M), 1 at the virtual detector's plane
    cut = int(np.any(depth > 1, axis=0).sum())
    if ends_at_plane and cut:
        warn(f"{cut} of {len(views)} virtual detectors stand in front of parts of the volume: raise the magnification")
