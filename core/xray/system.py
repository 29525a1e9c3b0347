"""X-ray systems: stationary sources, each with its panel, as a kind of scanner."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import InitVar, dataclass, field
from typing import Any, ClassVar, Self

import numpy as np

from ..arrays import Array, ArrayLike, Bools, Floats, Integers
from ..errors import InputError
from ..geometry.columns import Column, ColumnTable, Values
from ..geometry.frames import affine_matrix, unit_vectors
from ..geometry.module_parts import BOX_FACES, ModulePart
from ..geometry.scanner import Detector, Fault, Finding, Scanner, first_true
from ..geometry.views import Views
from ..system_source import SystemSource
from ..validation import lengths, positive, real_array, whole_shape
from .checks import find_in_room

PANEL_THICKNESS = 10.0
"""Thickness, mm, of the solid that stands for a panel, behind its pixels."""
_TUBE = 12.0  # mm: side of the cube behind the focal spot that shows a source and by which it is grabbed
_SQUARE = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)])
_ROUNDING = 1e-14  # rounding error of a rotation matrix
_SKEW = 1e-6  # largest cosine of the angle between rows and columns of pixels at right angles
_FILTER = r"[A-Za-z][\w -]* \d+\.?\d*(?:e[-+]?\d+)?"
_FILTERS = rf"(?:{_FILTER}(?: ?\+ ?{_FILTER})*)?"

Filters = str | Mapping[str, float]
"""Filter thicknesses, mm, by material, or a text "Al 2.5 + Cu 0.1"."""


def _vector(name: str, attribute: str, help: str, letters: str, hints: str) -> Iterator[Column]:
    """Yield the columns x, y and z of a vector attribute.

    A column's heading is the axis with `name`; `letters` are the columns' places in the sheet.
    """
    for i, axis in enumerate("xyz"):
        texts = {"headings": (f"{axis}{name}", f"{axis} of {help}"), "place": f"X-ray!{letters[i]}", "help": help}
        yield Column(f"{axis}{name}", attribute, axis=i, hints=f"{axis} {hints} coordinate position", **texts)  # type: ignore[arg-type]


def _scalar(name: str, attribute: str, place: str, help: str, *more_headings: str, **more: Any) -> Column:
    """Return the column of an attribute with one value per source."""
    headings = (name, attribute.replace("_", " "), *more_headings)
    return Column(name, attribute, headings=headings, place=f"X-ray!{place}", help=help, **more)


XRAY_COLUMNS = ColumnTable(
    (
        *_vector("s", "sources", "focal spot", "BCD", "source spot"),
        *_vector("p", "panel_centers", "panel centre", "EFG", "panel detector"),
        *_vector("u", "panel_u", "step from pixel to pixel along a row", "HIJ", "step row"),
        *_vector("v", "panel_v", "step from pixel to pixel along a column", "KLM", "step column"),
        _scalar("nv", "pixel_rows", "N", "rows of pixels", "rows", kind="whole", plausible=(1, 10_000), hints="rows"),
        _scalar("nu", "pixel_columns", "O", "columns of pixels", "columns", kind="whole", plausible=(1, 10_000),
                hints="columns"),
        _scalar("kVp", "kvp", "P", "tube voltage, kV", "kV", kind="number", plausible=(10, 500), hints="kv voltage"),
        _scalar("mAs", "mas", "Q", "charge of an exposure, mAs", kind="number", plausible=(1e-6, 1e4), hints="mas"),
        _scalar("spot", "focal_spot", "R", "size of the focal spot", blank=0.0, plausible=(0, 10), hints="spot"),
        _scalar("filter", "filters", "S", 'filters, mm, such as "Al 2.5 + Cu 0.1"', "filter material", kind="text",
                blank="", hints="filter", pattern=(_FILTERS, "materials with their mm, such as Al 2.5 + Cu 0.1")),
    )
)  # fmt: skip
"""Columns of the sheet X-ray."""


def filter_text(filters: Filters) -> str:
    """Return filters as a text, "Al 2.5 + Cu 0.1"; raise `InputError` unless all thicknesses are above 0."""
    if isinstance(filters, str):
        return filters
    if not isinstance(filters, Mapping):
        raise InputError(f"filters: expected material and mm such as {{'Al': 2.5}}, got {filters!r:.60}")
    return " + ".join(f"{name} {positive(mm, f'filter {name}', 'mm')!r}" for name, mm in filters.items())


def filter_thicknesses(text: str) -> dict[str, float]:
    """Return thickness, mm, by material for a text such as "Al 2.5 + Cu 0.1"; repeated materials add up."""
    thicknesses: dict[str, float] = {}
    for filter_ in text.split("+") if text else ():
        name, _, mm = filter_.strip().rpartition(" ")
        thicknesses[name.strip()] = thicknesses.get(name.strip(), 0.0) + float(mm)
    return thicknesses


def _is_mirrored(sources: Floats, centers: Floats, u: Floats, v: Floats) -> Bools:
    """Return whether each panel (N,) is left-handed: its steps u and v, and the vector from the source to it."""
    depths = np.sum(np.cross(u, v) * (centers - sources), axis=1)
    sizes = np.linalg.norm(u, axis=1) * np.linalg.norm(v, axis=1) * np.linalg.norm(centers - sources, axis=1)
    return ~(depths > 1e-9 * sizes)


def _is_skew(u: Floats, v: Floats) -> Bools:
    """Return whether each panel (N,) has rows that are not at right angles to its columns."""
    cosines = np.sum(u * v, axis=1)
    return ~(np.abs(cosines) <= _SKEW * np.linalg.norm(u, axis=1) * np.linalg.norm(v, axis=1))


_NO_PIXELS = "panel_u and panel_v must be at right angles"
_MIRRORED = "panel_u, panel_v and the way from source to panel must be right-handed, or images would be mirrored"


@dataclass(frozen=True, eq=False)
class XraySystem(Scanner):
    """N X-ray sources around the isocentre, each of which irradiates its own flat panel.

    `sources` (N, 3) are the focal spots, `panel_centers` (N, 3) the panels' centres, world mm; `panel_u` and `panel_v` (N,
    3), mm, are the steps from pixel to pixel along a row and along a column. They are at right angles, and right-handed
    together with the vector from source to panel. `shape` is the number of pixels (n_v, n_u) of all panels; the columns
    `pixel_rows` and `pixel_columns` (N,) hold it. For each source, or one for all: `kvp` (N,), tube voltage, kV; `mas` (N,),
    mAs per exposure; `filters` (N,), texts such as "Al 2.5 + Cu 0.1", or {"Al": 2.5}, mm; `focal_spot` (N,), size, mm, 0 for
    a point.

    >>> x = XraySystem([[0, -300, 0]], [[0, 200, 0]], [[1, 0, 0]], [[0, 0, -1]], (256, 256), 80, 1, {"Al": 2.5})
    """

    kind: ClassVar[str] = "x-ray"
    sheet: ClassVar[str] = "X-ray"
    word: ClassVar[str] = "X-ray"
    takes: ClassVar[tuple[str, ...]] = ("mu",)
    columns: ClassVar[ColumnTable] = XRAY_COLUMNS

    sources: Floats
    panel_centers: Floats
    panel_u: Floats
    panel_v: Floats
    shape: InitVar[tuple[int, int] | None]
    kvp: Floats
    mas: Floats
    filters: Any = ""  # an array of texts after __post_init__
    focal_spot: Floats = 0.0  # type: ignore[assignment]  # an array after __post_init__
    numbers: Integers = None  # type: ignore[assignment]
    source: SystemSource | None = None
    more: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self, shape: tuple[int, int] | None) -> None:  # type: ignore[override]
        attributes = vars(self)
        attributes["sources"] = real_array(self.sources, "sources", (None, 3))
        if shape is not None or "pixel_rows" not in self.more:
            rows, columns = whole_shape(shape, "shape", 2)
            attributes["more"] = {**self.more, "pixel_rows": rows, "pixel_columns": columns}
        if isinstance(self.filters, str | Mapping):
            attributes["filters"] = filter_text(self.filters)
        else:
            attributes["filters"] = [filter_text(texts) for texts in np.atleast_1d(np.asarray(self.filters, object))]
        super().__post_init__()
        self._refuse(self.focal_spot < 0, "focal_spot must be 0 mm or more, got {focal_spot:g}")
        self._refuse(_is_skew(self.panel_u, self.panel_v), _NO_PIXELS)
        self._refuse(_is_mirrored(self.sources, self.panel_centers, self.panel_u, self.panel_v), _MIRRORED)

    @classmethod
    def of(cls, values: Mapping[str, Any]) -> Self:
        """Create the system from its attributes; `pixel_rows` and `pixel_columns` may replace `shape`."""
        return super().of({"shape": None, **values})

    @classmethod
    def faults(cls, values: Values, numbers: Sequence[int], place: Callable[[str, int], str]) -> Iterator[Fault]:
        """Yield pixels that are not rectangles, mirrored panels, and sources in their panel's plane, as faults of cells."""
        sources, centers, u, v = (np.stack([values[axis + name] for axis in "xyz"], axis=1) for name in "spuv")
        for i in first_true(_is_skew(u, v)):
            yield "xu", i, f"to {place('zv', i)}: the steps u and v of module {numbers[i]} must be at right angles"
        for i in first_true(_is_mirrored(sources, centers, u, v)):
            yield "xu", i, f"to {place('zv', i)}: {_MIRRORED}: reverse u or v of module {numbers[i]}"

    @property
    def pixels(self) -> tuple[int, int]:
        """Number of pixels (n_v, n_u) of all panels; raises `InputError` if panels differ."""
        pairs = set(zip(self.pixel_rows.tolist(), self.pixel_columns.tolist(), strict=True))
        if len(pairs) > 1:
            raise InputError("the panels' numbers of pixels differ: expected a shape (n_v, n_u) for all images")
        return next(iter(pairs))

    def poses(self) -> Floats:
        """Return the world-from-module poses (N, 4, 4): columns u and v along the pixels, k across them, and sources, mm."""
        u = unit_vectors(self.panel_u)
        k = unit_vectors(np.cross(u, self.panel_v))
        return affine_matrix(np.stack([u, np.cross(k, u), k], axis=2), self.sources)

    def attributes_at(self, poses: Floats) -> dict[str, Array]:
        """Return the attributes of sources at these poses (N, 4, 4), with panels that move along rigidly."""
        deltas = poses[:, :3, :3] @ self.frames() - np.eye(3)
        deltas[np.abs(deltas).max(axis=(1, 2)) < _ROUNDING] = 0.0  # a mere shift changes no digit of the steps
        arms = {"panel_u": self.panel_u, "panel_v": self.panel_v, "panel_centers": self.panel_centers - self.sources}
        moved = {name: getattr(self, name) + np.einsum("mij,mj->mi", deltas, arm) for name, arm in arms.items()}
        moved["panel_centers"] += poses[:, :3, 3] - self.sources
        return {"sources": poses[:, :3, 3], **moved}

    def views(
        self,
        shape: tuple[int, int] | None = None,
        detector: Detector = "virtual",
        magnification: float = 1.0,
        pitch: ArrayLike | None = None,
        offset: ArrayLike = (0.0, 0.0),
    ) -> Views:
        """Return the panels' images as `Views`, by default with the panels' own pixels.

        Another `shape` divides all of the panel into such pixels. `pitch` is the pixel size on the panel, mm, one number or
        (pitch_u, pitch_v), for pixels around its centre; `offset` is the position (x0, y0) of the image's centre on the
        panel, mm. A panel stands in front of its source, where it is: there is no "real" detector behind it, and
        `magnification` has no effect.
        """
        if detector != "virtual":
            raise InputError(f"detector {detector!r}: a panel stands in front of its source, expected 'virtual'")
        n_v, n_u = self.pixels if shape is None else whole_shape(shape, "image shape", 2)
        u = self.panel_u * (self.pixel_columns / n_u)[:, None]
        v = self.panel_v * (self.pixel_rows / n_v)[:, None]
        if pitch is not None:
            pitch_u, pitch_v = lengths(pitch, "pixel pitch", 2)
            u, v = pitch_u * unit_vectors(u), pitch_v * unit_vectors(v)
        x0, y0 = real_array(offset, "image offset", (2,))
        return Views(self.sources, self.panel_centers + x0 * unit_vectors(u) + y0 * unit_vectors(v), u, v, (n_v, n_u))

    def parts(self, construction: Any = None) -> list[ModulePart]:
        """Return the solids of all sources: a cube behind the focal spot, for the tube, and the panel."""
        poses, parts = self.poses(), []
        poses[:, :3, [0, 2]] *= -1  # camera space is X = -u, Y = v, Z = -k
        numbers, fields = self.numbers.tolist(), self.fields().tolist()
        for number, pose, (x, y, depth, *sides) in zip(numbers, poses, fields, strict=True):
            tube = _box((0.0, 0.0), (_TUBE, _TUBE), (0.0, _TUBE))
            panel = _box((x, y), (abs(sides[0]), abs(sides[1])), (-depth - PANEL_THICKNESS, -depth))
            parts.append(ModulePart(number, "source", f"Source {number:02d}", (tube, BOX_FACES), pose))
            parts.append(ModulePart(number, "panel", f"Panel {number:02d}", (panel, BOX_FACES), pose))
        return parts

    def findings(
        self, others: Sequence[Scanner] = (), construction: Any = None, bore: float | None = None
    ) -> tuple[Finding, ...]:
        """Return the mechanical problems among `others` in the same room, by `checks.find_in_room`."""
        return find_in_room(self, others, bore=bore, construction=construction)


def _box(center: tuple[float, float], sides: Sequence[float], ends: tuple[float, float]) -> Floats:
    """Return the corners (8, 3), in the order of `BOX_FACES`, of a box along Z with these sides and z of its two ends."""
    return np.array([[*(center + square * sides / 2), z] for z in ends for square in _SQUARE])
