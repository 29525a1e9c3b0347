"""DiffDRR's pictures of radiographs."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from torch import Tensor

from ...errors import InputError, needing


def plot_drr(
    img: Tensor,
    title: str | Sequence[str] | None = None,
    ticks: bool = True,
    axs: Any = None,
    cmap: str = "gray",
    **imshow_kwargs: Any,
) -> list[Any]:
    """Show the radiographs (B, C, height, width) of `DRR` side by side, as DiffDRR's `plot_drr`; needs matplotlib.

    Structures in channels are shown together. The answer is matplotlib's axes, those given as `axs` (one for each image) or new ones.
    """
    with needing("matplotlib", "plot_drr"):
        from matplotlib import pyplot
    if img.ndim != 4:
        raise InputError(f"plot_drr: expected images B x C x height x width, got {' x '.join(map(str, img.shape))}")
    axes = pyplot.subplots(ncols=len(img), figsize=(10, 5))[1] if axs is None else axs
    shown = list(np.ravel(axes))
    titles = [title] * len(img) if title is None or isinstance(title, str) else title
    for picture, ax, text in zip(img.sum(1).numpy(force=True), shown, titles, strict=True):
        ax.imshow(picture, cmap=cmap, **imshow_kwargs)
        ax.xaxis.tick_top()
        for axis, size in zip((ax.yaxis, ax.xaxis), picture.shape, strict=True):
            axis.set_ticks([0, size - 1] if ticks else [], labels=[1, size] if ticks else [])
        ax.set_xlabel(text)
    return shown
