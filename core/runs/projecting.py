"""Simulation of images: a volume is projected into all modules of a system, and becomes a projection run."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, cast

import numpy as np

from ..arrays import Array, ArrayLike, Floats32
from ..errors import InputError, warn
from ..geometry.scanner import Detector, Scanner
from ..geometry.views import Views
from ..memory import require
from ..physics.dead_time import dead_time_counts
from ..physics.isotopes import photon_energy
from ..physics.noise import sample_counts
from ..progress import Progress
from ..projector import Model, Projector, intensity
from ..scatter.images import scatter_images, scattering_body
from ..validation import positive, seed_number
from ..volumes.volume import Volume
from .counting import scale_by_module
from .run import ProjectionRun

LINES = "lines"
"""Word in place of the energy at which CT numbers become mu: they attenuate each line of the isotope at its own energy."""


@dataclass(frozen=True)
class BodyScatter:
    """Simulation of the photons that the attenuating body scatters, see `scatter_images`."""

    precision: float = 0.005
    """Relative standard deviation of each module's total."""
    seed: int = 0
    """Seed of the random numbers."""


@dataclass(frozen=True, eq=False)
class Imaging:
    """Simulator of a volume's images with one model: projection, background, dead time, and the warnings about them.

    Runs, reconstructions and event sets all make their images with it.
    """

    projector: Projector
    photons: float | None = None
    """Photons per pixel of an X-ray source, see `project_run`."""
    dead_time: tuple[float, str] = (0.0, "non-paralysable")
    """Dead time of each module, s, and its kind."""
    scatter: BodyScatter | None = None
    """Simulation of scattered photons; None leaves them out."""

    def __post_init__(self) -> None:
        if self.scatter is not None:
            scattering_body(cast(Any, self.model))  # or raises

    @property
    def model(self) -> Model:
        """Model of the images."""
        return self.projector.model

    def images(
        self, volume: Volume, mu: Floats32 | None = None, progress: Progress | None = None, number: int = 0
    ) -> Floats32:
        """Return the expected images (M, n_v, n_u) of a volume, with background, scatter and the losses by dead time.

        The seed of the scatter is that of `scatter` and `number` added.
        """
        images = self.expected(volume, mu, progress)
        if (scattered := self.scattered(volume, mu, progress, number)) is not None:
            images += scattered
        images *= self.recorded_shares(images)
        return images

    def scattered(
        self, volume: Volume, mu: Floats32 | None = None, progress: Progress | None = None, number: int = 0
    ) -> Floats32 | None:
        """Return the expected images (M, n_v, n_u) of the photons that the body scatters; None where they are left out.

        The arguments are those of `images`.
        """
        if self.scatter is None:
            return None
        model: Any = self.model
        body = scattering_body(model) if mu is None else Volume(mu, volume.grid, "mu")
        A, precision, seed = self.projector, self.scatter.precision, self.scatter.seed + number
        return scatter_images(
            volume, body, A.views, model, precision=precision, seed=seed, threads=A.threads, progress=progress
        ).images[0]

    def recorded_shares(self, images: Floats32) -> Floats32:
        """Return the fractions (M, 1, 1) of expected `images` (M, n_v, n_u) that the modules record despite their dead time.

        Warns of modules at rates beyond the maximum of a paralysable counter, whose counts could be those of a lower rate.
        """
        (tau, kind), model = self.dead_time, cast(Any, self.model)
        if not tau or not model.has_times:
            return np.ones((1, 1, 1), np.float32)
        totals = np.maximum(images.sum(axis=(1, 2), dtype=float), 1e-30)
        if kind == "paralysable" and (beyond := totals / model.time > 1 / tau).any():
            numbers = ", ".join(map(str, model.system.numbers[beyond][:5]))
            warn(f"dead time: so many photons that more of them would be fewer counts, in module {numbers}")
        recorded: Array = dead_time_counts(totals, model.time, tau, kind) / totals  # type: ignore[arg-type]
        return recorded.astype(np.float32)[:, None, None]

    def expected(self, volume: Volume, mu: Floats32 | None = None, progress: Progress | None = None) -> Floats32:
        """Return the expected images (M, n_v, n_u) of a volume, with the background, without dead time.

        Parameters
        ----------
        volume
            Volume of a quantity that the model can image, else `InputError` is raised.
        mu
            Attenuation, 1/mm, in place of the model's, on the same grid.
        progress
            Called after every view.

        Warns of volumes and views whose images are probably not the intended ones.
        """
        A = self.projector
        self.model.check_volume(volume)
        if self.photons is not None and not (self.model.has_photons and volume.quantity == "mu"):
            text = f"{self.model.name} of {volume.quantity}"
            raise InputError(f"photons: expected the transmission of a volume of mu, got {text}")
        warn_of_images(volume, A.views, self.model)
        for text in () if mu is None else self.model.mu_warnings(mu):
            warn(text)
        images = self.model.expected_images(A, volume, progress, mu)
        for image, background in zip(images, A.background, strict=True):
            passed = image if self.photons is None else intensity(image, self.photons)
            image[...] = passed + background.astype(image.dtype)
        return images.astype(np.float32, copy=False)

    def unit(self, volume: Volume) -> str:
        """Return the unit of a volume's images."""
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
    noise: str = "poisson",
    scatter: BodyScatter | None = None,
) -> ProjectionRun:
    """Project `volume` into every module of `system`.

    Parameters
    ----------
    system, volume
        Modules, and the volume that they image.
    shape, detector, magnification, pitch
        Pixels and detector, see `PinholeSystem.views`.
    backend, threads
        See `Projector`.
    settings
        Further entries of the run's record.
    model
        `Transmission` (the default), or an `Emission`, an `InverseSquareSum` or a `SpectralScan` of the same system.
    photons
        Photons per pixel of an X-ray source: the run of a volume of mu then holds the photons that pass (`intensity`)
        instead of line integrals.
    noise_seed
        Seed with which counts are drawn (`sample_counts`) for images of counts or `photons`; None for expected counts.
    progress
        Called after every view.
    dead_time
        Dead time of each module, s, and its kind, "non-paralysable" or "paralysable", for an `Emission`. It reduces the
        expected counts, before noise is drawn (`dead_time_counts`), and the run's background.
    noise
        Model of the noise, see `sample_counts`.
    scatter
        Simulation of the photons that the model's mu scatters, for an `Emission` with an isotope and `energy_fwhm`.

    Raises
    ------
    InputError
        A setting is out of range, the model cannot image the volume's quantity, or the images do not fit into memory.
    """
    photons = None if photons is None else positive(photons, "photons")
    if noise_seed is not None:
        if photons is None and (model is None or model.unit(volume) != "counts"):
            raise InputError("noise_seed: only counts of an Emission or of X rays, or photons that pass, have noise")
        noise_seed = seed_number(noise_seed)
    views = system.views(shape=shape, detector=detector, magnification=magnification, pitch=pitch)
    n_v, n_u = views.shape
    bytes_per_pixel = 4.0 if noise_seed is None else 20.0  # counts are drawn from float64, as int64
    require(bytes_per_pixel * len(views) * n_v * n_u, f"a set of {len(views)} projections of {n_v} x {n_u} pixels")
    imaging = Imaging(Projector(volume.grid, views, model, backend, threads), photons, dead_time, scatter)
    model = imaging.model
    images = imaging.expected(volume, progress=progress)
    scattered = imaging.scattered(volume, progress=progress)
    if scattered is not None:
        images += scattered
    shares = imaging.recorded_shares(images)
    images *= shares
    if noise_seed is not None:
        images = sample_counts(images, noise_seed, noise).astype(np.float32)
    record = {
        "detector": detector, "magnification": float(magnification),
        "pitch_mm": None if pitch is None else np.broadcast_to(pitch, 2).tolist(), "model": model.name, **model.record(),
        **({} if photons is None else {"photons": photons}), "backend": imaging.projector.backend, **(settings or {}),
    }  # fmt: skip
    return ProjectionRun(images, system, views, volume, unit=imaging.unit(volume), settings=record, seed=noise_seed,
                         background=scale_by_module(model.background, shares), efficiency=model.efficiency,
                         scatter=None if scattered is None else scattered * shares)  # fmt: skip


def warn_of_energy(model: Model, energy: float | str | None, source: str) -> None:
    """Warn of mu that holds at an `energy` (keV, or an isotope's name) outside the model's energy window.

    `source` names the file or phantom of the mu, for the message.
    """
    window = model.detected_energies
    if window is None or energy in (None, LINES):
        return
    energy = photon_energy(energy)
    if not window[0] <= energy <= window[1]:
        counted = f"photons of {window[0]:g} to {window[1]:g} keV are counted"
        warn(f"the mu of {source} holds at {energy:g} keV, {counted}")


def warn_of_images(volume: Volume, views: Views, model: Model) -> None:
    """Warn of activity below 0, pixels beside the crystals, and a volume that the modules do not see whole."""
    for text in model.image_warnings(volume, views):
        warn(text)
    index = volume.grid.index_from_world[:3, 3]
    if np.any(index < -0.5) or np.any(index > np.array(volume.grid.shape) - 0.5):
        warn("the isocentre, at which the modules aim, lies outside the volume's grid: check the volume's position")
    corners = np.concatenate([volume.grid.corners(), np.ones((8, 1))], axis=1)
    depth = corners @ views.projection_matrices()[:, 2].T  # (8, M), 1 at the virtual detector's plane
    cut = int(np.any(depth > 1, axis=0).sum())
    if model.ends_at_detector and cut:
        warn(f"{cut} of {len(views)} virtual detectors stand in front of parts of the volume: raise the magnification")
