"""Registration: find the pose from which a camera saw an image, by gradient descent. Needs torch and RoMa."""

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

# mm of motion that count as much as one radian in a step: about the radius of a body.
_RADIUS = 100.0


def ncc(a: Tensor, b: Tensor) -> Tensor:
    """Normalised cross-correlation (...) of images (..., n_v, n_u): 1 where they differ by brightness and contrast alone."""
    return (_standardised(a) * _standardised(b)).mean(dim=(-2, -1))


def local_ncc(a: Tensor, b: Tensor, patch: int = 9) -> Tensor:
    """Mean of the `ncc` of all square patches of `patch` pixels: sees edges where `ncc` sees the body's outline.

    Patches are weighted with the contrast that they have in `b`, the image that is given: an empty background says nothing,
    and the best possible mean is 1, reached for a = b (a constant added to the variances would favour strong contrast).
    """
    if min(a.shape[-2:]) < patch:
        return ncc(a, b)

    def means(x: Tensor) -> Tensor:
        return avg_pool2d(x.reshape(-1, 1, *x.shape[-2:]), patch, stride=1).reshape(*x.shape[:-2], -1)

    a, b = _standardised(a), _standardised(b)
    covariance = means(a * b) - means(a) * means(b)
    rounding = torch.finfo(a.dtype).eps
    of_a, of_b = ((means(x * x) - means(x) ** 2).clamp_min(0) + rounding for x in (a, b))
    return (covariance / of_a.sqrt()).sum(dim=-1) / of_b.sqrt().sum(dim=-1)


def multiscale_ncc(a: Tensor, b: Tensor, patches: Sequence[int | None] = (None, 9)) -> Tensor:
    """Mean of `ncc` (for None) and `local_ncc` with each of the `patches`' sizes in pixels."""
    scores = [ncc(a, b) if patch is None else local_ncc(a, b, patch) for patch in patches]
    return torch.stack(scores).mean(dim=0)


def _standardised(x: Tensor) -> Tensor:
    """Images with mean 0 and variance 1; all 0 where they are flat."""
    x = x - x.mean(dim=(-2, -1), keepdim=True)
    return x * (x * x).mean(dim=(-2, -1), keepdim=True).clamp_min(1e-24).rsqrt()


@dataclass(frozen=True, eq=False)
class PoseEstimate:
    """What a registration found."""

    pose: Tensor  # (4, 4): World from camera, columns u, v, k and the pinhole, mm
    similarities: tuple[float, ...]  # the similarity before each step


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
    """The pose of the camera that saw `image`.

    The similarity of the image and the one projected from the present pose is climbed with Adam, from coarse pixels to
    fine ones. A pose is moved by turning it about the grid's middle and shifting it.

    Parameters
    ----------
    image
        Line integrals, or what grows linearly with them, (n_v, n_u).
    volume
        What was seen; a `Volume`, or a tensor on `grid`.
    initial
        The first guess, (4, 4): world from camera, columns u, v, k and the pinhole (as ``system.poses()``).
    distance, pitch, offset
        The camera's, as in `pinhole_images`, mm.
    levels
        Pixels are joined to squares of these sides, one after the other.
    steps
        Steps on each level.
    learning_rate
        Radians (and tenths of m) of the first steps; it falls to a hundredth over all levels.
    similarity
        A function of two images, larger when they are more alike.
    progress
        Called as ``progress(steps done, steps)``.

    """
    if image.ndim != 2:
        raise InputError(f"image: expected n_v x n_u, got {' x '.join(map(str, image.shape))}")
    if initial.shape != (4, 4):
        raise InputError(f"initial pose: expected 4 x 4, got {' x '.join(map(str, initial.shape))}")
    where = volume.grid if isinstance(volume, Volume) else grid
    if where is None:
        raise InputError(f"register_pose: expected a Volume, or also a grid, got {type(volume).__name__}")
    initial = initial.detach().to(torch.float64)
    pitch, offset = (torch.as_tensor(x, dtype=torch.float64).expand(2) for x in (pitch, offset))
    middle = pose_matrix(torch.eye(3, dtype=torch.float64), torch.tensor(where.center))
    from_middle = torch.linalg.inv(middle) @ initial

    motion = torch.zeros(6, dtype=torch.float64, requires_grad=True)
    scale = torch.tensor([_RADIUS] * 3 + [1.0] * 3, dtype=torch.float64)
    optimizer = torch.optim.Adam([motion], lr=learning_rate, betas=(0.8, 0.95))
    total = steps * len(levels)
    schedule = torch.optim.lr_scheduler.ExponentialLR(optimizer, gamma=0.01 ** (1 / max(1, total)))
    similarities: list[float] = []
    for level in levels:
        seen = avg_pool2d(image.detach().to(torch.float64)[None], level)[0]
        # What is left over at the image's end shifts its middle.
        lost = torch.tensor([n % level for n in reversed(image.shape)], dtype=torch.float64)
        # Rays of float32 are good to 0.1 um, and a step is half as long again in float64.
        camera = (distance, (level * pitch).float(), tuple(seen.shape), (offset - lost / 2 * pitch).float())
        for _ in range(steps):
            pose = middle @ se3_exp(scale * motion) @ from_middle
            position, rotation = pose[:3, 3].to(torch.float32), pose[:3, :3].to(torch.float32)
            projected = pinhole_images(volume, position, rotation, *camera, backend=backend, grid=grid)
            score = similarity(projected.to(seen), seen)
            optimizer.zero_grad()
            (-score).backward()
            optimizer.step()
            schedule.step()
            similarities.append(float(score.detach()))
            tell(progress, len(similarities), total)
    with torch.no_grad():
        return PoseEstimate(middle @ se3_exp(scale * motion) @ from_middle, tuple(similarities))


def pose_error(a: Tensor, b: Tensor, point: Any = (0.0, 0.0, 0.0)) -> tuple[float, float]:
    """How far two poses (4, 4) are apart: the angle, radians, and how far apart they carry a world `point`, mm."""
    between = a.to(torch.float64) @ torch.linalg.inv(b.to(torch.float64))
    cosine = (between[:3, :3].diagonal().sum() - 1) / 2
    at = torch.as_tensor(point, dtype=torch.float64)
    moved = between[:3, :3] @ at + between[:3, 3] - at
    return float(torch.arccos(cosine.clamp(-1, 1))), float(moved.norm())
