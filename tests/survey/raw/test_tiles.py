"""Raw recordings: a made one with known floor, and a recorded one beside the checkout."""

import dataclasses

import numpy as np
import pyproj
import pytest
import rasterio
import scipy.ndimage

import sasmap
from sasmap.cli import main
from sasmap.errors import InputError
from sasmap.survey.opening import open_survey
from sasmap.survey.raw import tiles as raw_tiles
from sasmap.survey.raw.bottom import altitude_of
from sasmap.survey.raw.recording import Recording, read_xtf
from tests.helpers import SHARED

LINE = SHARED / "scotsman" / "scotsman-iver2.xtf"
recorded = pytest.mark.skipif(
    not LINE.is_file(), reason="the scotsman recording is not beside the checkout"
)
NORTH = "EPSG:32617"


def made(altitude=5.0, pings=160, samples=500, recorded_altitude=True, pitch=0.0):
    """A line due north; the floor is bright between 10 and 12 m ground range to starboard."""
    rng = np.random.default_rng(2)
    y = 3300000.0 + 0.25 * np.arange(pings)
    x = np.full(pings, 500000.0)
    back = pyproj.Transformer.from_crs(NORTH, 4326, always_xy=True)
    longitude, latitude = back.transform(x, y)
    spacing = 0.05
    slant = spacing * (np.arange(samples) + 0.5)
    ground = np.sqrt(np.maximum(slant**2 - altitude**2, 0))
    level = np.where(slant * np.cos(np.radians(pitch)) < altitude, 2.0, 100.0)
    sides = {}
    for side in ("port", "starboard"):
        bright = (ground > 10) & (ground < 12) & (side == "starboard")
        speckle = rng.rayleigh(1.0, (pings, samples))
        sides[side] = (speckle * level * np.where(bright, 4, 1)).astype("uint16")
    told = np.full(pings, altitude if recorded_altitude else 0.0)
    return Recording(
        "made.xtf", longitude, latitude, told, np.full(pings, pitch), np.arange(pings), sides,
        np.full(pings, spacing), False,
    )  # fmt: skip


@pytest.mark.parametrize("recorded_altitude", [True, False])
def test_a_made_line_becomes_tiles_in_their_place(tmp_path, monkeypatch, recorded_altitude):
    monkeypatch.setattr(
        raw_tiles, "read_xtf", lambda path, crs: made(recorded_altitude=recorded_altitude)
    )
    written, warnings = raw_tiles.make_tiles(tmp_path / "made.xtf", tmp_path / "out")
    assert bool(warnings) != recorded_altitude
    with rasterio.open(tmp_path / "out" / "line_starboard.tif") as source:
        values = source.read(1).astype(float)
        assert source.crs.to_epsg() == 32617
        assert source.nodata == 0
        x = source.transform.c + source.transform.a * (np.arange(source.width) + 0.5)
    profile = np.nanmean(np.where(values > 0, values, np.nan)[50:-50], axis=0)
    bright = x[profile > 250] - 500000
    assert abs(bright.min() - 10) < 0.2
    assert abs(bright.max() - 12) < 0.2
    opened = open_survey(sasmap.load_survey(written[-1]))
    assert opened.passes[0].sides == ("port", "starboard")
    assert abs(np.median(opened.passes[0].track.altitude) - 5.0) < 0.15


def test_bottom_is_found_where_it_falls_away():
    rng = np.random.default_rng(3)
    altitude = np.linspace(4.0, 9.0, 200)
    slant = 0.05 * (np.arange(600) + 0.5)
    level = np.where(slant[None] < altitude[:, None], 3.0, 90.0)
    samples = rng.rayleigh(1.0, level.shape) * level
    found = altitude_of([samples], np.full(200, 0.05))
    assert np.abs(found - altitude).max() < 0.4
    assert abs(np.median(found - altitude)) < 0.2


LEVELS = {"rising gain": 3.0, "steady": 0.0}


@pytest.mark.parametrize("growth", LEVELS.values(), ids=LEVELS)
@pytest.mark.parametrize("beam", [False, True])
def test_bottom_is_found_under_gain_and_in_a_side_looking_beam(growth, beam):
    """Noise that grows with range; a beam that hears nothing straight below."""
    rng = np.random.default_rng(4)
    altitude = 5 + np.linspace(0, 3, 200)[:, None]
    slant = 0.04 * (np.arange(700) + 0.5)
    below = np.degrees(np.arccos(np.clip(altitude / slant, 0, 1)))
    floor = 100 * 10 ** (-2 * (np.clip(45 - below, 0, None) / 45) ** 2) if beam else 100.0
    signal = np.where(slant < altitude, 0, floor) * rng.rayleigh(1.0, below.shape)
    noise = (2 + growth * slant / 5) * rng.rayleigh(1.0, below.shape)
    samples = np.hypot(signal, noise)
    samples[:, :8] += 4000  # the transmitted pulse
    samples[:, 60:63] += 150 * rng.rayleigh(1.0, (200, 3))  # an echo of the surface
    found = altitude_of([samples.astype("uint16")], np.full(200, 0.04))
    away = found / altitude[:, 0] - 1
    assert abs(np.median(away)) < 0.03
    assert np.abs(away).max() < 0.06


def test_altitude_found_by_a_pitched_sonar_is_upright():
    pitched = made(recorded_altitude=False, pitch=25.0)
    lines, warnings, found = raw_tiles._lines(pitched, NORTH)
    assert found
    assert abs(np.median(lines[0].pings.altitude) - 5.0) < 0.15
    assert any("pitches by 25 degrees" in line for line in warnings)


def test_an_altitude_that_the_water_column_contradicts_is_named():
    given = made()
    assert raw_tiles._lines(given, NORTH)[1] == []
    feet = dataclasses.replace(given, altitude=given.altitude / 0.3048)
    told = " ".join(raw_tiles._lines(feet, NORTH)[1])
    assert "16.4 m" in told
    assert "water column" in told


VARIANTS = {
    "8 bits": {"kind": "uint8", "scale": 0.14},
    "32 bits": {"kind": "uint32", "scale": 1000.0},
    "float": {"kind": "float32", "scale": 1e-3},
    "format not told": {"kind": "uint16", "told": False},
    "other packets between": {"between": True},
    "port from the sonar on": {"near_first": True},
    "channels in another order": {"swapped": True},
    "weights by ping": {"weights": np.arange(160) % 3},
    "port alone": {"sides": ("port",)},
    "starboard alone": {"sides": ("starboard",)},
}


@pytest.mark.parametrize("odd", VARIANTS.values(), ids=VARIANTS)
@pytest.mark.parametrize("recorded_altitude", [True, False])
def test_variants_of_xtf_give_the_same_recording(tmp_path, odd, recorded_altitude):
    pytest.importorskip("pyxtf")
    from tests.survey.raw.xtf import write_xtf

    given = made(recorded_altitude=recorded_altitude)
    found = read_xtf(write_xtf(tmp_path / "a.xtf", given, **odd), None)
    assert set(found.samples) == set(odd.get("sides", ("port", "starboard")))
    np.testing.assert_allclose(found.longitude, given.longitude, atol=1e-9)
    np.testing.assert_allclose(found.spacing, given.spacing, rtol=1e-6)
    np.testing.assert_array_equal(found.altitude, given.altitude)
    for side, samples in found.samples.items():
        wanted = given.samples[side] * odd.get("scale", 1.0)
        loss = 1.0 if np.dtype(odd.get("kind", "uint16")).kind == "u" else 1e-4
        assert np.abs(samples - wanted).max() < loss
    altitude = raw_tiles._lines(found, NORTH)[0][0].pings.altitude
    assert abs(np.median(altitude) - 5) < 0.15


def test_a_file_that_breaks_off_is_used_so_far(tmp_path):
    pytest.importorskip("pyxtf")
    from tests.survey.raw.xtf import write_xtf

    path = write_xtf(tmp_path / "a.xtf", made())
    path.write_bytes(path.read_bytes()[:-100_000])
    found = read_xtf(path, None)
    assert 80 < found.longitude.size < 160
    assert "breaks off" in found.warnings[0]
    (tmp_path / "a.pyxtf_idx").write_bytes(b"cos\nsystem\n(S'true'\ntR.")  # pyxtf would run it
    with pytest.raises(InputError, match="remove it"):
        read_xtf(path, None)


def test_what_is_no_recording_is_one_line(tmp_path, capsys):
    pytest.importorskip("pyxtf")
    path = tmp_path / "line.xtf"
    table = b"time,easting,northing\n2026-01-01T00:00:00,1,2\n"
    for content in (b"", b"hello", table, 40 * table, bytes(range(256)) * 40):
        path.write_bytes(content)
        assert main(["tiles", str(path), "--output", str(tmp_path / "out")]) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert "line.xtf" in line
        assert "expected a" in line
        assert "Error" not in line
    assert main(["tiles", str(tmp_path / "none.xtf"), "--output", str(tmp_path / "out")]) == 2
    assert "no such file" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@recorded
def test_the_recorded_line_agrees_with_its_tiles(tmp_path):
    pytest.importorskip("pyxtf")
    raw_tiles.make_tiles(LINE, tmp_path)
    opened = open_survey(sasmap.load_survey(tmp_path / "survey.yaml"))
    rows = np.genfromtxt(SHARED / "scotsman" / "navigation.csv", delimiter=",", names=True)
    utm = pyproj.Transformer.from_crs(4326, 32619, always_xy=True)
    x, y = utm.transform(rows["longitude"], rows["latitude"])
    track = opened.passes[0].track
    assert track.locate(x, y).distance[5:-5].max() < 0.2
    for side in ("port", "starboard"):
        assert _shift(SHARED / "scotsman" / f"{side}.tif", tmp_path / f"line_{side}.tif") < 0.2


def _shift(wanted, found):
    """Median distance (m) between the patterns of two tiles, over patches of 10 m."""
    from skimage.registration import phase_cross_correlation

    with rasterio.open(wanted) as one, rasterio.open(found) as other:
        a, b = one.read(1).astype(float), other.read(1).astype(float)
        column, row = ~other.transform @ (one.transform.c + 0.025, one.transform.f - 0.025)
    row, column = int(np.floor(row)), int(np.floor(column))
    away = []
    for i in range(0, a.shape[0] - 200, 150):
        for j in range(0, a.shape[1] - 200, 150):
            if min(i + row, j + column) < 0:
                continue
            p = a[i : i + 200, j : j + 200]
            q = b[i + row : i + row + 200, j + column : j + column + 200]
            if q.shape == p.shape and (p > 0).mean() > 0.95 and (q > 0).mean() > 0.95:
                shift, _, _ = phase_cross_correlation(
                    _pattern(p), _pattern(q), upsample_factor=10, normalization=None
                )
                away.append(0.05 * np.hypot(*shift))
    assert len(away) > 5
    return float(np.median(away))


def _pattern(values):
    level = np.log1p(values)
    return scipy.ndimage.gaussian_filter(level, 2) - scipy.ndimage.gaussian_filter(level, 20)


def test_positions_in_metres_need_a_crs(tmp_path):
    pytest.importorskip("pyxtf")
    from tests.survey.raw.xtf import write_xtf

    given = made()
    move = pyproj.Transformer.from_crs(4326, NORTH, always_xy=True)
    x, y = move.transform(given.longitude, given.latitude)
    metres = dataclasses.replace(given, longitude=x, latitude=y)
    path = write_xtf(tmp_path / "a.xtf", metres, units=0)
    with pytest.raises(InputError, match="--crs"):
        read_xtf(path, None)
    np.testing.assert_allclose(read_xtf(path, NORTH).latitude, given.latitude, atol=1e-9)
