"""The model "spectral" of recipes: images of a body by the tubes and panels of an X-ray system."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..arrays import Array, ArrayLike, Floats, Floats32, Indexes
from ..errors import InputError, naming
from ..geometry.grid import Grid
from ..geometry.views import Views
from ..models.model import checked_background, with_image_axes
from ..physics.ct_numbers import CT_ENERGY, hu_to_mu
from ..physics.materials import attenuation
from ..progress import Progress, part_of
from ..projector import Model, Projector, Transmission
from ..rays.bundles import Beam
from ..volumes.volume import Volume
from .decomposition import correct_beam_hardening, virtual_monoenergetic
from .detectors import Bins, EnergyIntegrator, PanelDetector, PhotonCounter
from .spectra import Spectrum, tube_spectrum
from .spectral import SpectralTransmission, panel_blur, water_and_bone
from .system import XraySystem, filter_thicknesses

_ALL_ENERGIES = ((0.0, 1000.0),)
WATER_AND_BONE = "water-bone"


@dataclass(frozen=True, eq=False)
class SpectralScan(Model):
    """Polychromatic image model of an X-ray system: spectra of its tubes, and the response of its panels.

    kVp, mAs, filters and focal spots are those of `system`. A `Projector` with this model computes line integrals of
    volumes; `counts` computes images from them, which are not linear in the volume.

    Attributes
    ----------
    system : XraySystem
        Sources with their panels, one for each view.
    materials : str
        Materials of volumes: "water-bone", a mixture given by CT numbers (`water_and_bone`), or one of `MATERIALS`.
    panel : str
        "counting" for photon counts (`PhotonCounter`), or "energy" for a signal in keV (`EnergyIntegrator`).
    window : (float, float) or None
        Lower and upper energy, keV, of the counted photons; None for all.
    sensor : str or None
        Material of the sensor, `sensor_thickness` mm thick; None stops all photons.
    sensor_fwhm : float
        Energy resolution of a counting panel, keV.
    intrinsic_fwhm : float
        Blur of the panel, mm, besides that of the focal spots (`panel_blur`).
    background : float or array (M,) or (M, n_v, n_u)
        Counts of each pixel besides those of the spectrum, such as scatter (`xray_scatter`).
    spectrum : Spectrum or None
        Spectrum to use instead of those of the tubes.
    """

    system: XraySystem
    materials: str = WATER_AND_BONE
    panel: str = "counting"
    window: tuple[float, float] | None = None
    sensor: str | None = None
    sensor_thickness: float = 2.0
    sensor_fwhm: float = 0.0
    intrinsic_fwhm: float = 0.0
    background: float | Floats = 0.0
    spectrum: Spectrum | None = None

    name = "spectral"
    takes = ("mu",)
    takes_ct_numbers = True

    def __post_init__(self) -> None:
        if not isinstance(self.system, XraySystem):
            kind = getattr(self.system, "kind", type(self.system).__name__)
            raise InputError(f"spectral: expected a scanner of X-ray tubes and panels, got one of the kind {kind}")
        background = checked_background(self.background, "spectral: background", len(self.system))
        object.__setattr__(self, "background", background)
        for _ in self.transmissions(self.system.views((1, 1))):  # refuses spectra outside the table, empty windows
            pass

    def record(self) -> dict[str, Any]:
        """Return the settings for a run's record."""
        names = ("materials", "panel", "window", "sensor", "sensor_thickness", "sensor_fwhm", "intrinsic_fwhm")
        return {name: getattr(self, name) for name in names}

    def unit(self, volume: Volume) -> str:
        """Return the unit of the images, "counts" or "keV"."""
        return "counts" if self.panel == "counting" else "keV"

    def check(self, views: Views) -> None:
        """Raise `InputError` unless there is one view for each source."""
        if len(views) != len(self.system):
            raise InputError(f"spectral: expected {len(self.system)} views, one of each source, got {len(views)}")
        checked_background(self.background, "spectral: background", len(views), views.shape)

    def linear(self) -> Model:
        """Return the model of the line integrals that `line_integrals` makes of the images."""
        return Transmission()

    def beams(self, views: Views, m: int, grid: Grid) -> Iterator[Beam]:
        """Return the rays of the line integrals of view m."""
        return Transmission().beams(views, m, grid)

    def at_ct_energy(self, volume: Volume, energy: float | None) -> Volume:
        """Return a volume as mu at `CT_ENERGY`, which the model takes.

        The given volume holds CT numbers, or mu at `energy`, keV. Raises `InputError` for mu without an energy.
        """
        if volume.quantity == "hu":
            return hu_to_mu(volume, CT_ENERGY)
        self.check_volume(volume)
        if energy is None:
            reason = "spectra need the energy at which the volume's mu holds"
            raise InputError(f"volume.energy (--energy): missing; {reason}")
        if energy == CT_ENERGY:
            return volume
        mu = virtual_monoenergetic(self._relative(volume, energy), self._names, CT_ENERGY)
        return Volume(np.asarray(mu, np.float32), volume.grid, "mu", volume.note)

    in_model_quantity = at_ct_energy

    def expected_images(
        self, A: Projector, volume: Volume, progress: Progress | None = None, mu: Floats32 | None = None
    ) -> Floats32:
        """Return the expected images by `counts`, which no `mu` attenuates."""
        return self.counts(volume, A, progress)

    def counts(self, volume: Volume, A: Projector, progress: Progress | None = None) -> Floats32:
        """Return the expected images (M, n_v, n_u) of a volume of mu at `CT_ENERGY`, without background.

        `A` is a `Projector` with this model. The images are in the unit of `unit`.
        """
        self.check_volume(volume)
        volumes = self._relative(volume, CT_ENERGY)
        n = len(volumes)
        paths = np.stack([np.asarray(A(array, part_of(progress, i, n))) for i, array in enumerate(volumes)])
        images = np.empty(A.shape_out, np.float32)
        for views, m in self.transmissions(A.views):
            images[views] = m.images(paths[:, views], self.system.mas[views], A)[0]
        return images

    def line_integrals(self, images: ArrayLike, views: Views, corrected: bool = True) -> Floats32:
        """Return line integrals (M, n_v, n_u) of mu at `CT_ENERGY` along the paths through water that explain images.

        If not `corrected` for beam hardening they are mere logarithms, of mu at no particular energy. Pixels without photons
        are treated as having half a count.
        """
        self.check(views)
        measured = np.maximum(np.asarray(images, np.float64) - with_image_axes(self.background), 0.5)
        result = np.empty(measured.shape, np.float32)
        for indices, m in self.transmissions(views, ("water",)):
            mAs, signal = self.system.mas[indices], measured[None, indices]
            if corrected:
                result[indices] = correct_beam_hardening(signal, m, mAs) * attenuation("water", CT_ENERGY)
            else:
                result[indices] = np.log(m.expected(np.zeros(signal.shape), mAs) / signal)[0]
        return result

    def transmissions(
        self, views: Views, materials: tuple[str, ...] = ()
    ) -> Iterator[tuple[Indexes, SpectralTransmission]]:
        """Yield, for each spectrum of the tubes, the indices of its views and its transmission model behind materials.

        `materials` are by default those of the scan.
        """
        blurs = panel_blur(self.system, self.intrinsic_fwhm)
        for indices, spectrum in self.spectra():
            with naming(f"X-ray source {self.system.numbers[indices[0]]}"):
                arguments = (materials or self._names, self._bins, self._detector())
                yield indices, SpectralTransmission(views[indices], spectrum, *arguments, blurs[indices])

    def spectra(self) -> Iterator[tuple[Indexes, Spectrum]]:
        """Yield each spectrum of the tubes, behind their filters, with the indices of its views."""
        system = self.system
        tubes = list(zip(system.kvp.tolist(), system.filters.tolist(), strict=True))
        for tube in dict.fromkeys(tubes):
            indices = np.flatnonzero([view_tube == tube for view_tube in tubes])
            with naming(f"X-ray source {system.numbers[indices[0]]}"):
                spectrum = self.spectrum or tube_spectrum(tube[0], filter_thicknesses(tube[1]))
            yield indices, spectrum

    def photon_signals(self, energies: Floats) -> Floats:
        """Return the signal (n,), in the unit of `unit`, of one photon of each energy (n,), keV, that hits a pixel."""
        return self._detector().response(energies, self._bins)[0]

    @property
    def _bins(self) -> Bins | None:
        """Energies, keV, of the photons that are counted; None for a panel that integrates the energy."""
        if self.panel != "counting":
            return None
        return _ALL_ENERGIES if self.window is None else (self.window,)

    def _detector(self) -> PanelDetector:
        """Return the detector of the panels' pixels."""
        if self.panel == "counting":
            return PhotonCounter(self.sensor, self.sensor_thickness, self.sensor_fwhm)
        return EnergyIntegrator(self.sensor, self.sensor_thickness)

    @property
    def _names(self) -> tuple[str, ...]:
        """Names of the scan's materials."""
        return ("water", "bone") if self.materials == WATER_AND_BONE else (self.materials,)

    def _relative(self, volume: Volume, energy: float) -> Array | Floats:
        """Return volumes of the materials (materials, n_x, n_y, n_z), each relative to its own density."""
        if self.materials == WATER_AND_BONE:
            return water_and_bone(volume, energy)
        return volume.array[None].astype(np.float64) / attenuation(self.materials, energy)
