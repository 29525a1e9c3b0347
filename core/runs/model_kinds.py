"""Models of the images by `model.kind` of recipes, and the models of counts of each kind of scanner.

A new model is a class, a row of `MODELS`, and a word of the setting ``model.kind`` in `settings.py`. A new kind of scanner
whose images are counts has its model in a row of `COUNT_MODELS`.
"""

from collections.abc import Mapping

from ..geometry.scanner import Scanner
from ..geometry.system import PinholeSystem
from ..projector import Emission, InverseSquareSum, Model, Transmission
from ..xray.scan import SpectralScan

COUNTS = "emission"
"""Value of `model.kind` whose images are counts of activity."""
MODELS: Mapping[str, type[Model]] = {
    "transmission": Transmission, COUNTS: Emission, "spectral": SpectralScan, "inverse-square": InverseSquareSum,
}  # fmt: skip
COUNT_MODELS: Mapping[str, type[Model]] = {PinholeSystem.kind: Emission}
"""Models of counts by the scanner's kind: dataclasses with `system`, `time`, `start`, `background` and `efficiency`."""


def model_class(kind: str, system: Scanner) -> type[Model]:
    """Return the class of the model of this `model.kind` for a scanner; the class refuses a scanner that it cannot model."""
    return COUNT_MODELS.get(system.kind, Emission) if kind == COUNTS else MODELS[kind]
