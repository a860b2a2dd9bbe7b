import numpy as np
import pyproj
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sasmap.errors import InputError
from sasmap.survey.navigation import Track
from sasmap.survey.navigation import read_navigation as read
from tests.helpers import UTM, write_track


def read_navigation(*arguments):
    """Read a file that holds one line, and nothing odd."""
    found = read(*arguments)
    assert found.warnings == ()
    (stretch,) = found.stretches
    return stretch.track


WKT = pyproj.CRS.from_user_input(UTM).to_wkt()


def straight(heading=0.0, altitude=(5.0, 5.0), length=100.0, n=101):
    s = np.linspace(0, length, n)
    turn = np.radians(heading)
    return Track(s * np.sin(turn), s * np.cos(turn), np.linspace(*altitude, n))


@pytest.mark.parametrize("heading", [0, 37, 90, 200, 315])
def test_straight_track_gives_range_side_and_look(heading):
    track = straight(heading, altitude=(10.0, 2.0))
    turn = np.radians(heading)
    along, across = np.array([20.0, 50.0, 80.0]), np.array([7.0, -30.0, 0.5])
    x = along * np.sin(turn) + across * np.cos(turn)
    y = along * np.cos(turn) - across * np.sin(turn)
    seen = track.locate(x, y)
    np.testing.assert_allclose(seen.distance, np.abs(across), atol=1e-9)
    np.testing.assert_allclose(seen.altitude, 10 - 8 * along / 100, atol=1e-9)
    np.testing.assert_array_equal(seen.starboard, across > 0)
    look = np.where(across > 0, heading + 90, heading - 90) % 360
    np.testing.assert_allclose(seen.look_azimuth, look, atol=1e-6)


def test_beyond_the_ends_nothing_is_seen():
    track = straight()
    seen = track.locate(np.array([5.0, 5.0, 5.0]), np.array([-3.0, -1.5, 103.0]))
    assert np.isnan(seen.distance).tolist() == [True, False, True]
    assert np.isnan(seen.look_azimuth).tolist() == [True, False, True]


def test_circle_from_inside_and_outside():
    angle = np.linspace(0, 1.5 * np.pi, 3000)
    track = Track(50 * np.cos(angle), 50 * np.sin(angle), np.full(3000, 4.0))
    seen = track.locate(np.array([30.0, 0.0]), np.array([0.1, 80.0]))
    np.testing.assert_allclose(seen.distance, [20.0, 30.0], atol=2e-3)
    assert seen.starboard.tolist() == [False, True]  # the track turns left


@settings(max_examples=50, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_equals_brute_force_over_all_segments(seed):
    rng = np.random.default_rng(seed)
    n = 40
    x, y = np.cumsum(rng.normal(0.3, 0.5, (2, n)), axis=1)
    track = Track(x, y, rng.uniform(3, 9, n))
    px, py = rng.uniform(x.min(), x.max(), 300), rng.uniform(y.min(), y.max(), 300)
    seen = track.locate(px, py)
    x, y, _ = track._extended
    dx, dy = np.diff(x), np.diff(y)
    t = ((px[:, None] - x[:-1]) * dx + (py[:, None] - y[:-1]) * dy) / (dx**2 + dy**2)
    t = np.clip(t, 0, 1)
    away = np.hypot(px[:, None] - x[:-1] - t * dx, py[:, None] - y[:-1] - t * dy)
    best = away.argmin(axis=1)
    at = t[np.arange(px.size), best]
    beyond = ((best == 0) & (at == 0)) | ((best == n) & (at == 1))
    np.testing.assert_array_equal(np.isnan(seen.distance), beyond)
    np.testing.assert_allclose(seen.distance[~beyond], away.min(axis=1)[~beyond], atol=1e-9)


def test_geometry_does_not_depend_on_how_points_are_grouped():
    track = Track(np.array([0, 3.0, 5, 9]), np.array([0, 10.0, 22, 30]), np.array([5, 6, 7, 4.0]))
    x, y = np.meshgrid(np.linspace(5, 30, 83), np.linspace(2, 28, 61))
    whole = track.locate(x, y)
    part = track.locate(x[7:31, 11:60], y[7:31, 11:60])
    for one, other in zip(whole, part, strict=True):
        np.testing.assert_array_equal(one[7:31, 11:60], other)


@pytest.mark.parametrize("step", [3, 8])
def test_places_between_some_that_are_located_are_nearly_as_exact(step):
    y = np.arange(0, 40, 0.5)
    headings = np.random.default_rng(step).normal(0, 0.05, y.size)
    track = Track(np.cumsum(0.5 * headings), y, np.linspace(8.0, 12.0, y.size))
    # on both sides, and beyond the first ping
    x, y = np.meshgrid(np.arange(-12, 30, 0.05), np.arange(-3, 9, 0.05))
    exact, seen = track.locate(x, y), track.locate(x, y, step=step)
    np.testing.assert_array_equal(np.isnan(seen.distance), np.isnan(exact.distance))
    np.testing.assert_array_equal(seen.starboard, exact.starboard)
    known = np.isfinite(exact.distance)
    assert known.mean() > 0.5 > 1 - known.mean() > 0.1
    np.testing.assert_allclose(seen.distance[known], exact.distance[known], atol=0.015)
    # where a wandering track's nearest ping jumps, the altitude does
    assert np.abs(seen.altitude - exact.altitude)[known].mean() < 0.02


def test_geographic_positions_land_on_the_grid(tmp_path):
    back = pyproj.Transformer.from_crs(UTM, 4326, always_xy=True)
    north = np.arange(3300000.0, 3300050.0, 10)
    longitude, latitude = back.transform(np.full(north.size, 500010.0), north)
    write_track(tmp_path / "n.csv", longitude, latitude, 6.0, ("longitude", "latitude", "altitude"))
    track = read_navigation(tmp_path / "n.csv", WKT, WKT, None)
    np.testing.assert_allclose(track.x, 500010.0, atol=1e-6)
    np.testing.assert_allclose(track.y, north, atol=1e-6)


def test_projected_positions_in_another_crs(tmp_path):
    other = "EPSG:32616"
    x, y = pyproj.Transformer.from_crs(UTM, other, always_xy=True).transform(
        np.full(3, 500000.0), np.array([3300000.0, 3300001, 3300002])
    )
    write_track(tmp_path / "n.csv", x, y, 6.0)
    track = read_navigation(tmp_path / "n.csv", WKT, WKT, other)
    np.testing.assert_allclose(track.x, 500000.0, atol=1e-6)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("x,y\n1,2\n3,4\n", "no column 'altitude'"),
        ("a,b,altitude\n1,2,3\n4,5,6\n", "expected columns longitude, latitude or x, y"),
        ("x,y,altitude\n1,2,3\n4,5,0\n", "row 3: altitude: expected more than 0 m, got 0"),
        ("x,y,altitude\n1,2,3\n4,5,-2\n", "got -2"),
        ("x,y,altitude\n1,2,3\n4,oops,6\n", "row 3: y: expected a number, got 'oops'"),
        ("x,y,altitude\n1,2,3\n4,5\n", "row 3: altitude: expected a number"),
        ("x,y,altitude\n1,2,3\n4,5,nan\n", "row 3: altitude: expected a number, got nothing"),
        ("x,y,altitude\n1,2,3\n", "at least two pings"),
        ("x,y,altitude\n1,2,3\n1,2,3\n", "two pings at different positions"),
        ("longitude,latitude,altitude\n1,2,3\n4,95,6\n", "row 3: expected longitude, latitude"),
        ("", "empty"),
    ],
)
def test_faults_name_file_row_and_column(tmp_path, text, says):
    path = tmp_path / "n.csv"
    path.write_text(text)
    with pytest.raises(InputError) as caught:
        read_navigation(path, WKT, WKT, None)
    (fault,) = caught.value.faults
    assert fault.startswith(str(path))
    assert says in fault


def test_blank_lines_do_not_shift_row_numbers(tmp_path):
    path = tmp_path / "n.csv"
    path.write_text("x,y,altitude\n1,2,3\n\n\n4,5,-1\n")
    with pytest.raises(InputError, match="row 5"):
        read_navigation(path, WKT, WKT, None)


def test_missing_or_binary_file(tmp_path):
    with pytest.raises(InputError, match="cannot be read"):
        read_navigation(tmp_path / "none.csv", WKT, WKT, None)
    (tmp_path / "b.csv").write_bytes(bytes(range(256)))
    with pytest.raises(InputError, match="CSV"):
        read_navigation(tmp_path / "b.csv", WKT, WKT, None)


@pytest.mark.parametrize("noise", [0.05, 0.3])
def test_jitter_does_not_turn_port_into_starboard(noise):
    rng = np.random.default_rng(1)
    n = 600  # a ping every 0.1 m
    y = 0.1 * np.arange(n)
    track = Track(rng.normal(0, noise, n), y + rng.normal(0, noise, n), np.full(n, 5.0))
    px, py = rng.uniform(5, 30, 2000), rng.uniform(5, 55, 2000)
    assert track.locate(px, py).starboard.all()
    assert not track.locate(-px, py).starboard.any()


def test_semicolons_and_tabs_separate_as_well(tmp_path):
    for mark in ";\t":
        (tmp_path / "n.csv").write_text("x,y,altitude\n1,2,3\n4,5,6\n".replace(",", mark))
        np.testing.assert_array_equal(read_navigation(tmp_path / "n.csv", WKT, WKT, None).y, [2, 5])


def test_navigation_crs_chooses_between_columns(tmp_path):
    path = tmp_path / "n.csv"
    path.write_text("longitude,latitude,x,y,altitude\n-81,29,1,2,3\n-81,29.1,4,5,6\n")
    np.testing.assert_array_equal(read_navigation(path, WKT, WKT, UTM).y, [2, 5])
    assert read_navigation(path, WKT, WKT, None).y[0] > 3e6
    path.write_text("longitude,latitude,altitude\n-81,29,3\n-81,29.1,6\n")
    with pytest.raises(InputError, match="needs columns x, y"):
        read_navigation(path, WKT, WKT, UTM)
