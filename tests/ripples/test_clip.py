import numpy as np
import pytest
import xarray as xr

from sasmap.ripples.clip import Clip, bin_clip, mean_look
from tests.helpers import clip_of, zare_cobb_clip


def turned(clip, degrees):
    """The same clip with its map turned clockwise."""
    angle = np.radians(degrees)
    x, y = (
        clip.x * np.cos(angle) + clip.y * np.sin(angle),
        clip.y * np.cos(angle) - clip.x * np.sin(angle),
    )
    azimuth = (clip.look_azimuth + degrees) % 360
    return Clip(clip.amplitude, x, y, clip.ground_range, clip.altitude, azimuth, clip.pixel_size)


def test_sums_do_not_depend_on_map_rotation_or_amplitude_scale():
    clip = zare_cobb_clip(20, 25, 0.9, 0.05, size=100)
    whole = bin_clip(clip)
    assert whole.pixels.sum() == 100 * 100
    assert abs(whole.total.sum() - 100 * 100 * 1.001) < 1e-6
    for degrees in (90, 180, 270):
        other = bin_clip(turned(clip, degrees))
        assert abs(other.azimuth - (90 + degrees) % 360) < 1e-9
        np.testing.assert_allclose(other.pixels.sum(axis=0), whole.pixels.sum(axis=0))
        np.testing.assert_allclose(other.total.sum(axis=0), whole.total.sum(axis=0))
    for scale in (1e-30, 1e30):
        scaled = Clip(**{**vars(clip), "amplitude": clip.amplitude * scale})
        np.testing.assert_allclose(bin_clip(scaled).total, whole.total)


def test_columns_square_on_are_bins_and_oblique_ones_fill_them():
    clip = zare_cobb_clip(20, 25, 0.9, 0.05, size=100)
    assert bin_clip(clip).spread < 0.01
    assert bin_clip(turned(clip, 0.0)).pixels.shape[1] == 100
    oblique = Clip(**{**vars(clip), "look_azimuth": np.full((100, 100), 70.0)})
    assert bin_clip(oblique).spread > 0.9


def test_range_and_altitude_are_followed_along_and_across():
    rows, columns = np.mgrid[:120, :80]
    ground_range = 30 + 0.05 * columns
    clip = clip_of(np.ones((120, 80)), ground_range, 5.0, 0.05)
    clip = Clip(**{**vars(clip), "altitude": 8.0 - 0.02 * rows})
    binned = bin_clip(clip)
    u = binned.centres
    model = binned.range0[:, None] + binned.range_slope[:, None] * u
    np.testing.assert_allclose(model[0], 30 + 0.05 * np.arange(80), atol=1e-9)
    assert abs(np.ptp(binned.altitude0) - 0.02 * 120 * 15 / 16) < 1e-9
    # strips are merged only as far as no shadow edge moves by more than half a bin
    strips = binned.altitude_variation / (0.5 * 0.05)
    assert len(binned.pooled(1.0).pixels) == int(np.ceil(strips))
    assert (
        len(bin_clip(clip_of(np.ones((120, 80)), ground_range, 5.0, 0.05)).pooled(1.0).pixels) == 1
    )
    np.testing.assert_allclose(binned.pooled(1.0).total.sum(), binned.total.sum())


def test_missing_pixels_do_not_count():
    clip = zare_cobb_clip(20, 25, 0.9, 0.05, size=100)
    amplitude = clip.amplitude.copy()
    amplitude[:30] = np.nan
    altitude = clip.altitude.copy()
    altitude[30:40] = np.nan
    assert (
        bin_clip(Clip(**{**vars(clip), "amplitude": amplitude, "altitude": altitude})).pixels.sum()
        == 6000
    )


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
