"""The model "spectral" of recipes: what an X-ray system's panels make of its tubes' photons behind a body."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..arrays import Array, ArrayLike, Floats, Floats32, Indexes
from ..errors import InputError, naming
from ..geometry.grid import Grid
from ..geometry.views import Views
from ..physics.ct_numbers import CT_ENERGY, hu_to_mu
from ..physics.materials import attenuation
from ..progress import Progress, part_of
from ..projector import Model, Projector, Transmission
from ..rays.bundles import Beam
from ..volumes.volume import Volume
from .decomposition import correct_beam_hardening, virtual_monoenergetic
from .detectors import Detector, EnergyIntegrator, PhotonCounter
from .spectra import Spectrum, tube_spectrum
from .spectral import SpectralTransmission, panel_blur, water_and_bone
from .system import XraySystem, filter_thicknesses

_ALL = ((0.0, 1000.0),)
WATER_AND_BONE = "water-bone"


@dataclass(frozen=True, eq=False)
class SpectralScan(Model):
    """What the panels of an X-ray system make of its tubes' photons: kVp, mAs, filters and focal spots are the system's.

    A `Projector` of it gives line integrals of volumes, from which `counts` makes the images: these are not linear.

    Attributes
    ----------
    system : XraySystem
        Sources with their panels, one for each view.
    materials : str
        What volumes consist of: "water-bone", as CT numbers say (`water_and_bone`), or one of `MATERIALS`.
    panel : str
        "counting", which counts photons (`PhotonCounter`), or "energy", whose signal is keV (`EnergyIntegrator`).
    window : (float, float) or None
        Energies, keV, from and to, that are counted; None for all.
    sensor : str or None
        Material that stops the photons, `sensor_thickness`, mm, of it; None stops all.
    sensor_fwhm : float
        Energy resolution of a counting panel, keV.
    intrinsic_fwhm : float
        The panel's own blur, mm, beside that of the focal spots (`panel_blur`).
    background : float
        Counts of each pixel besides those of the spectrum, such as scatter.
    spectrum : Spectrum or None
        In place of those of the tubes.
    """

    system: XraySystem
    materials: str = WATER_AND_BONE
    panel: str = "counting"
    window: tuple[float, float] | None = None
    sensor: str | None = None
    sensor_thickness: float = 2.0
    sensor_fwhm: float = 0.0
    intrinsic_fwhm: float = 0.0
    background: float = 0.0
    spectrum: Spectrum | None = None

    name = "spectral"
    takes = ("mu",)

    def __post_init__(self) -> None:
        if not isinstance(self.system, XraySystem):
            found = getattr(self.system, "kind", type(self.system).__name__)
            raise InputError(f"spectral: expected a scanner of X-ray tubes and panels, got one of the kind {found}")
        for _ in self.transmissions(self.system.views((1, 1))):  # spectra outside the table, empty windows
            pass

    def record(self) -> dict[str, Any]:
        """The settings, for a run's record."""
        names = ("materials", "panel", "window", "sensor", "sensor_thickness", "sensor_fwhm", "intrinsic_fwhm")
        return {name: getattr(self, name) for name in names}

    def unit(self, volume: Volume) -> str:
        """Unit of the images."""
        return "counts" if self.panel == "counting" else "keV"

    def check(self, views: Views) -> None:
        """Raise `InputError` where there is not one view of each source."""
        if len(views) != len(self.system):
            raise InputError(f"spectral: expected {len(self.system)} views, one of each source, got {len(views)}")

    def beams(self, views: Views, m: int, grid: Grid) -> Iterator[Beam]:
        """The rays of the line integrals."""
        return Transmission().beams(views, m, grid)

    def at_ct_energy(self, volume: Volume, energy: float | None) -> Volume:
        """A volume of CT numbers, or of mu that holds at an energy, keV, as mu at `CT_ENERGY`, which the model takes."""
        if volume.quantity == "hu":
            return hu_to_mu(volume, CT_ENERGY)
        self.check_volume(volume)
        if energy is None:
            needed = "spectra need the energy at which the volume's mu holds"
            raise InputError(f"volume.energy (--energy): missing; {needed}")
        if energy == CT_ENERGY:
            return volume
        mu = virtual_monoenergetic(self._relative(volume, energy), self._names, CT_ENERGY)
        return Volume(np.asarray(mu, np.float32), volume.grid, "mu", volume.note)

    def counts(self, volume: Volume, A: Projector, progress: Progress | None = None) -> Floats32:
        """Expected images (M, n_v, n_u) of a volume of mu at `CT_ENERGY`, without the background; `A` has this model."""
        self.check_volume(volume)
        parts = self._relative(volume, CT_ENERGY)
        n = len(parts)
        paths = np.stack([np.asarray(A(part, part_of(progress, i, n))) for i, part in enumerate(parts)])
        images = np.empty(A.shape_out, np.float32)
        for which, m in self.transmissions(A.views):
            images[which] = m.images(paths[:, which], self.system.mas[which])[0]
        return images

    def line_integrals(self, images: ArrayLike, views: Views, corrected: bool = True) -> Floats32:
        """Line integrals (M, n_v, n_u) of what is measured: of mu at `CT_ENERGY` in water that leaves as much.

        Not `corrected` for beam hardening they are logarithms alone, of mu at no energy. Where nothing has passed, half a
        count is taken for it.
        """
        measured = np.maximum(np.asarray(images, np.float64) - self.background, 0.5)
        found = np.empty(measured.shape, np.float32)
        for which, m in self.transmissions(views, ("water",)):
            mAs, signal = self.system.mas[which], measured[None, which]
            if corrected:
                found[which] = correct_beam_hardening(signal, m, mAs) * attenuation("water", CT_ENERGY)
            else:
                found[which] = np.log(m.expected(np.zeros(signal.shape), mAs) / signal)[0]
        return found

    def transmissions(
        self, views: Views, materials: tuple[str, ...] = ()
    ) -> Iterator[tuple[Indexes, SpectralTransmission]]:
        """Indexes of the views of each spectrum, with its counts behind materials, by default the model's."""
        system, bins = self.system, _ALL if self.window is None else (self.window,)
        tubes = list(zip(system.kvp.tolist(), system.filters.tolist(), strict=True))
        blurs = panel_blur(system, self.intrinsic_fwhm)
        for tube in dict.fromkeys(tubes):
            which = np.flatnonzero([other == tube for other in tubes])
            with naming(f"X-ray source {system.numbers[which[0]]}"):
                spectrum = self.spectrum or tube_spectrum(tube[0], filter_thicknesses(tube[1]))
                arguments = (materials or self._names, bins if self.panel == "counting" else None, self._detector())
                yield which, SpectralTransmission(views[which], spectrum, *arguments, blurs[which])

    def _detector(self) -> Detector:
        if self.panel == "counting":
            return PhotonCounter(self.sensor, self.sensor_thickness, self.sensor_fwhm)
        return EnergyIntegrator(self.sensor, self.sensor_thickness)

    @property
    def _names(self) -> tuple[str, ...]:
        return ("water", "bone") if self.materials == WATER_AND_BONE else (self.materials,)

    def _relative(self, volume: Volume, energy: float) -> Array | Floats:
        """Each material (materials, n_x, n_y, n_z), relative to its own density."""
        if self.materials == WATER_AND_BONE:
            return water_and_bone(volume, energy)
        return volume.array[None].astype(np.float64) / attenuation(self.materials, energy)
