import numpy as np
import pytest
import xarray as xr

from sasmap.ripples import estimate
from sasmap.ripples.clip import Clip, mean_look
from tests.helpers import zare_cobb_clip


def turned(clip, degrees):
    """The same clip with its map turned clockwise."""
    angle = np.radians(degrees)
    x, y = (
        clip.x * np.cos(angle) + clip.y * np.sin(angle),
        clip.y * np.cos(angle) - clip.x * np.sin(angle),
    )
    azimuth = (clip.look_azimuth + degrees) % 360
    return Clip(clip.amplitude, x, y, clip.ground_range, clip.altitude, azimuth, clip.pixel_size)


def test_mean_look_over_north():
    clip = zare_cobb_clip(20, 25, 0.9, 0.05, size=20)
    azimuth = np.where(np.arange(20) % 2, 350.0, 10.0) * np.ones((20, 1))
    look = mean_look(Clip(**{**vars(clip), "look_azimuth": azimuth}))
    assert min(look, 360 - look) < 1e-9


def test_from_array_takes_scalars_and_one_dimensional_coordinates():
    x = 500000 + 0.1 * np.arange(6)
    array = xr.DataArray(
        np.ones((4, 6)),
        dims=("y", "x"),
        coords={
            "x": x,
            "y": 10 - 0.1 * np.arange(4),
            "ground_range": ("x", x - 499990),
            "altitude": 5.0,
            "look_azimuth": 90.0,
        },
    )
    clip = Clip.from_array(array)
    assert clip.x.shape == clip.altitude.shape == (4, 6)
    assert abs(clip.pixel_size - 0.1) < 1e-9
    with pytest.raises(ValueError, match="expected coordinates altitude"):
        Clip.from_array(array.drop_vars("altitude"))
    with pytest.raises(ValueError, match="expected an array"):
        Clip.from_array(array[0])


def test_amplitudes_without_coordinates_are_no_clip():
    with pytest.raises(TypeError, match="got ndarray"):
        estimate(np.ones((50, 50)))
