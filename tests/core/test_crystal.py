"""Laws of the crystal: how much is absorbed, how deep, and at which position it is recorded."""

import numpy as np
import pytest

import mphdrr.core as mph
from mphdrr.core.physics.crystal import absorbed_share

from .conftest import emission
from .test_emission import one_module, spot_image, turned_grid, width


@pytest.mark.parametrize("n", [1, 2, 5])
@pytest.mark.parametrize("mu", [1e-3, 0.26, 5.0])
def test_layers_absorb_what_the_crystal_absorbs_as_deep(n, mu):
    """1 - exp(-mu T / cos) of the photons are absorbed, with 2 or more layers at the mean depth, at every angle."""
    thickness, cosine = 9.0, np.linspace(0.3, 1, 50)
    depths = np.linspace(0, thickness, n)
    shares = np.array([absorbed_share(cosine, mu, thickness, depths, layer) for layer in range(n)])
    k = mu / cosine
    np.testing.assert_allclose(shares.sum(axis=0), -np.expm1(-k * thickness), rtol=1e-12)
    assert shares.min() >= 0
    if n > 1:
        mean = 1 / k - thickness / np.expm1(k * thickness)
        np.testing.assert_allclose(depths @ shares / shares.sum(axis=0), mean, rtol=1e-9)


@pytest.mark.parametrize("detector", ["real", "virtual"])
@pytest.mark.parametrize("mu", [0.05, 0.26])
def test_parallax_shifts_a_point_outwards_by_its_mean_depth(mu, detector):
    """Recorded at (l + z) tan(psi), z the mean depth of absorption along its direction; no count is gained or lost."""
    system = one_module()
    place, tangent = np.array([0.0, 70.0, 0.0]), 70 / 200
    k, thickness = mu * np.hypot(1, tangent), 10.0
    depth = 1 / k - thickness / np.expm1(k * thickness)
    scale = 1.0 if detector == "real" else -10.0
    u, pitch = system.frames()[0, 0] @ place / 200 * 60 * scale, 0.04 * abs(scale)
    grid, views = turned_grid((3, 3, 3), 0.7, place), system.views((60, 400), detector, pitch=pitch, offset=(-u, 0.0))

    def radius_and_counts(layers):
        model = emission(system, crystal_mu=mu, depth_layers=layers)
        image = mph.Projector(grid, views, model)(np.ones((3, 3, 3)))[0].astype(float)
        columns = (np.arange(400) - 199.5) * pitch - u
        return abs(columns @ image.sum(axis=0)) / image.sum() / abs(scale), image.sum()

    radius, counts = radius_and_counts(1)
    assert radius == pytest.approx(60 * tangent, abs=0.01)
    for layers in (2, 5):
        deeper, as_many = radius_and_counts(layers)
        assert deeper - radius == pytest.approx(depth * tangent, rel=0.01)
        assert as_many == pytest.approx(counts, rel=2e-3)


def test_thin_layers_blur_like_the_exponential():
    """The variance of the recorded positions along the radius, against that of the depth of absorption."""
    system, mu = one_module(), 0.26
    sharp, places = spot_image(emission(system, crystal_mu=mu), (0, 70, 0), pitch=0.05, n=200)
    deep, _ = spot_image(emission(system, crystal_mu=mu, depth_layers=12), (0, 70, 0), pitch=0.05, n=200)
    tangent, z = 70 / 200, np.linspace(0, 10, 100_001)
    density = np.exp(-mu * np.hypot(1, tangent) * z)
    density /= density.sum()
    expected = tangent**2 * (density @ z**2 - (density @ z) ** 2)
    assert width(deep, places) ** 2 - width(sharp, places) ** 2 == pytest.approx(expected, rel=0.03)
