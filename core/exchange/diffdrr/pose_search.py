"""Registration: the pose of the camera that took an image, found by gradient descent. Needs torch and RoMa."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from ...errors import InputError
from ...geometry.grid import Grid
from ...geometry.rotations import pose_matrix, se3_exp
from ...progress import Progress, tell
from ...projector.torch_cameras import pinhole_images
from ...volumes.volume import Volume

Similarity = Callable[[Tensor, Tensor], Tensor]

# Shift, mm, that corresponds to a turn by one radian in a step: about the radius of a body.
_RADIUS = 100.0


def ncc(a: Tensor, b: Tensor) -> Tensor:
    """Return the normalised cross-correlation (...) of images (..., n_v, n_u): 1 if brightness and contrast alone differ."""
    return (_standardised(a) * _standardised(b)).mean(dim=(-2, -1))


def local_ncc(a: Tensor, b: Tensor, patch: int = 9) -> Tensor:
    """Return the mean `ncc` (...) of all square patches of `patch` x `patch` pixels of two images (..., n_v, n_u).

    It responds to edges, `ncc` to the body's outline. Patches are weighted with their contrast in `b`, the measured image:
    an empty background has no weight, and the largest mean is 1, for a = b (a constant added to the variances would favour
    strong contrast).
    """
    if min(a.shape[-2:]) < patch:
        return ncc(a, b)

    def means(x: Tensor) -> Tensor:
        """Return the means of `x` in the window around each pixel."""
        return avg_pool2d(x.reshape(-1, 1, *x.shape[-2:]), patch, stride=1).reshape(*x.shape[:-2], -1)

    a, b = _standardised(a), _standardised(b)
    covariance = means(a * b) - means(a) * means(b)
    rounding = torch.finfo(a.dtype).eps
    variance_a, variance_b = ((means(x * x) - means(x) ** 2).clamp_min(0) + rounding for x in (a, b))
    return (covariance / variance_a.sqrt()).sum(dim=-1) / variance_b.sqrt().sum(dim=-1)


def multiscale_ncc(a: Tensor, b: Tensor, patches: Sequence[int | None] = (None, 9)) -> Tensor:
    """Return the mean of the similarities for `patches`: `local_ncc` for a size in pixels, `ncc` for None."""
    scores = [ncc(a, b) if patch is None else local_ncc(a, b, patch) for patch in patches]
    return torch.stack(scores).mean(dim=0)


def _standardised(x: Tensor) -> Tensor:
    """Return images with mean 0 and variance 1; a uniform image becomes 0."""
    x = x - x.mean(dim=(-2, -1), keepdim=True)
    return x * (x * x).mean(dim=(-2, -1), keepdim=True).clamp_min(1e-24).rsqrt()


@dataclass(frozen=True, eq=False)
class PoseEstimate:
    """Result of a registration."""

    pose: Tensor
    """(4, 4), world from camera, columns u, v, k and the pinhole, mm."""
    similarities: tuple[float, ...]
    """Similarity of the images before each step."""


def register_pose(
    image: Tensor,
    volume: Volume | Tensor,
    initial: Tensor,
    distance: float,
    pitch: Any,
    offset: Any = (0.0, 0.0),
    *,
    levels: Sequence[int] = (4, 2, 1),
    steps: int = 80,
    learning_rate: float = 0.03,
    similarity: Similarity = multiscale_ncc,
    grid: Grid | None = None,
    backend: str = "auto",
    progress: Progress | None = None,
) -> PoseEstimate:
    """Return the pose of the camera that took `image`, with the similarities on the way.

    Adam maximises the similarity of the image and the one projected from the present pose, from coarse pixels to fine ones.
    A pose is moved by turning it about the grid's middle and shifting it.

    Parameters
    ----------
    image
        Line integrals, or values that grow linearly with them, (n_v, n_u).
    volume
        Imaged volume: a `Volume`, or a tensor on `grid`.
    initial
        First guess of the pose, (4, 4): world from camera, columns u, v, k and the pinhole (as ``system.poses()``).
    distance, pitch, offset
        Distance, pitch and offset of the camera, as in `pinhole_images`, mm.
    levels
        Sides, pixels, of the squares to which pixels are joined, one level after the other.
    steps
        Number of steps on each level.
    learning_rate
        Size of the first steps, radians (and tenths of m); it falls to a hundredth over all levels.
    similarity
        Function of two images, larger when they are more alike.
    grid, backend
        Grid of a volume that is a tensor, and one of the backends of `Projector`.
    progress
        Called as ``progress(steps done, steps)``.

    """
    if image.ndim != 2:
        raise InputError(f"image: expected n_v x n_u, got {' x '.join(map(str, image.shape))}")
    if initial.shape != (4, 4):
        raise InputError(f"initial pose: expected 4 x 4, got {' x '.join(map(str, initial.shape))}")
    volume_grid = volume.grid if isinstance(volume, Volume) else grid
    if volume_grid is None:
        raise InputError(f"register_pose: expected a Volume, or also a grid, got {type(volume).__name__}")
    initial = initial.detach().to(torch.float64)
    pitch, offset = (torch.as_tensor(x, dtype=torch.float64).expand(2) for x in (pitch, offset))
    middle = pose_matrix(torch.eye(3, dtype=torch.float64), torch.tensor(volume_grid.center))
    from_middle = torch.linalg.inv(middle) @ initial

    motion = torch.zeros(6, dtype=torch.float64, requires_grad=True)
    scale = torch.tensor([_RADIUS] * 3 + [1.0] * 3, dtype=torch.float64)
    optimizer = torch.optim.Adam([motion], lr=learning_rate, betas=(0.8, 0.95))
    total = steps * len(levels)
    schedule = torch.optim.lr_scheduler.ExponentialLR(optimizer, gamma=0.01 ** (1 / max(1, total)))
    similarities: list[float] = []
    for level in levels:
        measured = avg_pool2d(image.detach().to(torch.float64)[None], level)[0]
        # Pixels left over at the image's end shift its middle.
        left_over = torch.tensor([n % level for n in reversed(image.shape)], dtype=torch.float64)
        # Rays of float32 are good to 0.1 um, and a step takes half as long again in float64.
        camera = (distance, (level * pitch).float(), tuple(measured.shape), (offset - left_over / 2 * pitch).float())
        for _ in range(steps):
            pose = middle @ se3_exp(scale * motion) @ from_middle
            position, rotation = pose[:3, 3].to(torch.float32), pose[:3, :3].to(torch.float32)
            projected = pinhole_images(volume, position, rotation, *camera, backend=backend, grid=grid)
            score = similarity(projected.to(measured), measured)
            optimizer.zero_grad()
            (-score).backward()
            optimizer.step()
            schedule.step()
            similarities.append(float(score.detach()))
            tell(progress, len(similarities), total)
    with torch.no_grad():
        return PoseEstimate(middle @ se3_exp(scale * motion) @ from_middle, tuple(similarities))


def pose_error(a: Tensor, b: Tensor, point: Any = (0.0, 0.0, 0.0)) -> tuple[float, float]:
    """Return the angle, radians, between two poses (4, 4), and the distance, mm, between their images of a `point`."""
    difference = a.to(torch.float64) @ torch.linalg.inv(b.to(torch.float64))
    cosine = (difference[:3, :3].diagonal().sum() - 1) / 2
    start = torch.as_tensor(point, dtype=torch.float64)
    motion = difference[:3, :3] @ start + difference[:3, 3] - start
    return float(torch.arccos(cosine.clamp(-1, 1))), float(motion.norm())
