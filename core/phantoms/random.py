"""Random poses of phantoms, for training sets."""

import numpy as np

from ..arrays import ArrayLike, Floats
from ..geometry.frames import euler_pose
from ..validation import none_below_0, real_array, seed_number


def random_pose(
    seed: int | np.random.Generator, box: ArrayLike = (0.0, 0.0, 0.0), center: ArrayLike = (0.0, 0.0, 0.0)
) -> Floats:
    """Draw a random pose world-from-phantom (4, 4), mm: uniform in position and in each Euler angle of `euler_pose`.

    Angles lie between 0 and 360 degrees. This is not the uniform distribution of rotations, for which cos(theta) would be
    uniform: a phantom's axis points along +z or -z more often. A whole number as `seed` gives the same pose each time, a
    generator its next one. `box` gives the side lengths (3,), mm, of the box in which the position lies, or one length for
    all; `center` is the centre (3,), mm, of the box.

    Examples
    --------
    >>> rng = np.random.default_rng(7)
    >>> poses = [random_pose(rng, box=(40, 40, 40)) for _ in range(1000)]
    """
    rng = seed if isinstance(seed, np.random.Generator) else np.random.default_rng(seed_number(seed))
    is_cube = isinstance(box, int | float | np.integer | np.floating)
    sides = none_below_0(np.full(3, box) if is_cube else box, "box of random poses", (3,), "mm")
    translation = real_array(center, "centre of random poses", (3,)) + (rng.random(3) - 0.5) * sides
    phi, theta, psi = rng.uniform(0.0, 2 * np.pi, 3)
    return euler_pose(phi, theta, psi, translation)
