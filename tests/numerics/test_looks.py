import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, rotate

from sasmap.numerics.looks import point_spread


def speckle(down, right, size=400, turn=0.0):
    """Intensity of speckle whose amplitude has a Gaussian point spread, pixels."""
    rng = np.random.default_rng(1)
    parts = [gaussian_filter(rng.standard_normal((size, size)), (down, right)) for _ in range(2)]
    if turn:
        inner = slice(size // 6, -size // 6)
        parts = [rotate(v, turn, reshape=False)[inner, inner] for v in parts]
    power = parts[0] ** 2 + parts[1] ** 2
    return power / power.mean()


@pytest.mark.parametrize(("down", "right"), [(1.0, 1.0), (2.0, 2.0), (1.5, 0.7), (0.6, 1.2)])
def test_the_blur_is_that_of_the_amplitude_over_the_root_of_two(down, right):
    blur = np.sqrt(2 * np.diag(point_spread(speckle(down, right))))
    np.testing.assert_allclose(blur, [right, down], rtol=0.12)


def test_the_blur_may_be_longest_in_a_slanted_direction():
    long, short = 2.4, 0.8
    blur = point_spread(speckle(long, short, size=600, turn=45))
    assert blur[0, 1] == pytest.approx((long**2 - short**2) / 4, rel=0.12)
    np.testing.assert_allclose(np.linalg.eigvalsh(blur), [short**2 / 2, long**2 / 2], rtol=0.2)


def test_independent_pixels_have_little_blur():
    rng = np.random.default_rng(2)
    assert np.sqrt(point_spread(rng.exponential(size=(300, 300))).max()) < 0.25
    assert not point_spread(np.ones((30, 30))).any()
    assert np.isfinite(point_spread(rng.exponential(size=(3, 200)))).all()
    assert np.isfinite(point_spread(rng.exponential(size=(200, 2)))).all()


@pytest.mark.parametrize("long", [15.0, 60.0])
def test_texture_and_holes_are_no_blur(long):
    rng = np.random.default_rng(3)
    texture = gaussian_filter(rng.standard_normal((400, 400)), long)
    power = speckle(1.2, 1.2) * np.exp(0.5 * texture / texture.std())
    power[rng.random(power.shape) < 0.2] = 0.0
    power[100:180, 200:300] = 0.0
    np.testing.assert_allclose(np.sqrt(2 * np.diag(point_spread(power))), 1.2, rtol=0.12)
