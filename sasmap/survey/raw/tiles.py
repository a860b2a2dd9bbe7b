"""Ground-range tiles, navigation and a survey file from a raw recording."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyproj
import rasterio
from affine import Affine
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from sasmap.arrays import FloatArray, IntArray
from sasmap.errors import InputError
from sasmap.io.files import write_text, written_whole
from sasmap.settings.yamlfile import dump_yaml
from sasmap.survey.lines import find_lines
from sasmap.survey.navigation import Track
from sasmap.survey.pings import Pings
from sasmap.survey.raw.bottom import altitude_of
from sasmap.survey.raw.recording import Recording, read_xtf
from sasmap.survey.raw.track import smooth_track

# Most pixels a side of a tile: bounds memory.
SIDE = 4096
# Share of pings without a recorded altitude above which it is found in the water column.
MOST_MISSING = 0.1
# Round pixel sizes, m: the finest that is not below the spacing of samples is used.
SIZES = tuple(m * 10.0**e for e in (-3, -2, -1, 0) for m in (1, 2, 2.5, 5))
# Standard deviation of recorded altitude (a usual altimeter), and of altitude from the water
# column, m, for the survey file.
RECORDED_SD, FOUND_SD = 0.05, 0.3
# The latter as a share of altitude. A side-looking beam receives little or nothing from straight
# below: with a first echo from 25 degrees off the vertical, altitude is 10 % too large. On a
# recorded line (Iver2, 600 kHz, nose down by 7 to 23 degrees) it was 10 % after correction for
# pitch. The echo itself, 20 dB above the water within two samples, is that late for any threshold;
# 3 % are due to the file's 1500 m/s, too fast for cold water, and part may be due to the lower
# altimeter in the nose.
FOUND_SHARE = 0.1
# Limits of first echo over recorded altitude beyond which one of them is wrong.
CONTRADICTING = (0.85, 1.25)
# Pitch, degrees, at which the fan meets the floor a quarter of the altitude ahead or astern.
STEEP_PITCH = 14.0


class SurveyLine(NamedTuple):
    """A survey line of a recording: its smoothed pings and their indices."""

    name: str
    pings: Pings
    places: IntArray


def make_tiles(
    path: Path, output: Path, crs: str | None = None, pixel: float | None = None
) -> tuple[list[Path], list[str]]:
    """Turn a raw recording into tiles, navigation and a survey file.

    Parameters
    ----------
    path : Path
        XTF file.
    output : Path
        Folder to write into.
    crs : str, optional
        CRS of positions, where they are in metres.
    pixel : float, optional
        Pixel size, m; default: the spacing of samples, rounded up.

    Returns
    -------
    written : list of Path
    warnings : list of str

    Raises
    ------
    InputError
        Where the recording cannot be used; nothing is written then.
    """
    recording = read_xtf(path, crs)
    target = _utm(recording)
    pixel = pixel or next((s for s in SIZES if s >= float(np.median(recording.spacing))), 1.0)
    lines, warnings, found = _lines(recording, target)
    scratch = output / ".sasmap"
    try:
        scratch.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        told = error.strerror or error
        raise InputError(f"{output}: output folder cannot be made: {told}") from None
    written: list[Path] = []
    passes = []
    for line in lines:
        names = []
        for side, samples in recording.samples.items():
            for name, values, transform in _gridded(recording, line, side, samples, pixel):
                _write(output / name, values, transform, target, scratch)
                names.append(name)
        written += [output / name for name in names]
        csv_path = output / f"{line.name}.csv"
        write_text(csv_path, _navigation(line), scratch)
        written.append(csv_path)
        sides = list(recording.samples)
        passes.append({
            "name": line.name, "tiles": names, "navigation": csv_path.name,
            "side": "both" if len(sides) == 2 else sides[0], "range": "ground",
            "altitude_sd": _altitude_sd(line) if found else RECORDED_SD,
        })  # fmt: skip
    content = {"name": path.stem, "output": "out", "crs": target, "window": _window(pixel),
               "passes": passes, "ripples": {}, "sediments": {}}  # fmt: skip
    write_text(output / "survey.yaml", dump_yaml(content), scratch)
    scratch.rmdir()
    return [*written, output / "survey.yaml"], warnings


def _altitude_sd(line: SurveyLine) -> float:
    """Return the standard deviation of altitude found in the water column, m."""
    return round(max(FOUND_SD, FOUND_SHARE * float(np.median(line.pings.altitude))), 2)


def _window(pixel: float) -> int:
    """Window of about ten metres, which suits usual wavelengths, pixels."""
    return int(np.clip(round(10.0 / pixel), 100, 500))


def _utm(recording: Recording) -> str:
    longitude = float(np.median(recording.longitude))
    zone = min(int((longitude + 180) % 360 // 6) + 1, 60)
    return f"EPSG:{(32600 if np.median(recording.latitude) >= 0 else 32700) + zone}"


def _lines(recording: Recording, target: str) -> tuple[list[SurveyLine], list[str], bool]:
    """Smoothed survey lines of a recording, and whether altitude is from the water column."""
    move = pyproj.Transformer.from_crs("EPSG:4326", target, always_xy=True)
    x, y = move.transform(recording.longitude, recording.latitude)
    altitude = recording.altitude
    found = bool((altitude <= 0).mean() > MOST_MISSING)
    warnings = list(recording.warnings)
    steep = float(np.median(np.abs(recording.pitch)))
    if steep > STEEP_PITCH:
        warnings.append(
            f"{recording.path}: the sonar pitches by {steep:.0f} degrees: its fan meets the floor "
            f"{np.tan(np.radians(steep)):.1f} altitudes ahead or astern of the positions, which "
            "used uncorrected"
        )
    if found:
        if recording.ground:
            raise InputError(
                f"{recording.path}: has no altitude, and in ground range no water column to "
                "find it in"
            )
        altitude = altitude_of(list(recording.samples.values()), recording.spacing)
        # the fan is normal to the vehicle's axis: with pitch it meets the floor farther away
        altitude = altitude * np.cos(np.radians(recording.pitch))
        warnings.append(
            f"{recording.path}: no recorded altitude: found in the water column, "
            f"{altitude.min():.1f} to {altitude.max():.1f} m, possibly 10 % too large; check "
            "it in the navigation"
        )
    elif not recording.ground:
        warnings += _contradicted(recording)
    every = Pings(recording.path, recording.number, np.asarray(x), np.asarray(y), altitude)
    fresh = np.concatenate([[True], np.hypot(np.diff(every.x), np.diff(every.y)) > 0])
    fixes = np.flatnonzero(fresh)
    spans, gaps = find_lines(every.at(fresh))
    lines = []
    for k, (first, last) in enumerate(spans, 1):
        end = fixes[last + 1] if last + 1 < fixes.size else every.x.size
        part = slice(int(fixes[first]), int(end))
        smooth, odd = smooth_track(every.at(part))
        warnings += odd
        places = np.searchsorted(recording.number, smooth.rows)
        lines.append(SurveyLine(f"line_{k}" if len(spans) > 1 else "line", smooth, places))
    if not lines:
        raise InputError(f"{recording.path}: no two successive pings lie on a line")
    return lines, [*warnings, *gaps], found


def _contradicted(recording: Recording) -> list[str]:
    """Warn where the water column contradicts the altitudes of a recording."""
    seen = altitude_of(list(recording.samples.values()), recording.spacing)
    seen = seen * np.cos(np.radians(recording.pitch))
    known = recording.altitude > 0
    ratio = float(np.median(seen[known] / recording.altitude[known]))
    if CONTRADICTING[0] < ratio < CONTRADICTING[1]:
        return []
    return [
        f"{recording.path}: its altitudes (about {np.median(recording.altitude[known]):.3g} m) are "
        f"not where its water column ends (about {np.median(seen[known]):.3g} m): expected metres "
        "above the sea floor; correct them in the navigation, or the ranges, before a run"
    ]


def _gridded(
    recording: Recording, line: SurveyLine, side: str, samples: NDArray[Any], pixel: float
) -> Iterator[tuple[str, NDArray[Any], Affine]]:
    """Tiles of one side by nearest neighbour; samples are not averaged."""
    pings = line.pings
    moved = np.concatenate([[True], np.hypot(np.diff(pings.x), np.diff(pings.y)) > 1e-6])
    track = Track(pings.x[moved], pings.y[moved], pings.altitude[moved])
    nearest = cKDTree(np.column_stack([pings.x, pings.y]))
    reach = float((recording.spacing[line.places] * samples.shape[1]).max())
    left, top, rows, columns = _frame(pings, reach, pixel)
    for r in range(0, rows, SIDE):
        for c in range(0, columns, SIDE):
            height, width = min(SIDE, rows - r), min(SIDE, columns - c)
            x = np.asarray(left + pixel * (c + 0.5 + np.arange(width)), float)
            y = np.asarray(top - pixel * (r + 0.5 + np.arange(height)), float)
            values = _sampled(recording, line, side, samples, track, nearest, x, y)
            seen_rows = np.flatnonzero(values.any(axis=1))
            seen_columns = np.flatnonzero(values.any(axis=0))
            if not seen_rows.size:
                continue
            i, j = int(seen_rows[0]), int(seen_columns[0])
            cut = values[i : seen_rows[-1] + 1, j : seen_columns[-1] + 1]
            corner = Affine(pixel, 0, left + pixel * (c + j), 0, -pixel, top - pixel * (r + i))
            name = f"{line.name}_{side}"
            name += f"_r{r // SIDE}_c{c // SIDE}" if rows > SIDE or columns > SIDE else ""
            yield f"{name}.tif", cut, corner


def _frame(pings: Pings, reach: float, pixel: float) -> tuple[float, float, int, int]:
    """Upper-left corner and size of the grid that a line covers, in whole pixels."""
    left = np.floor((pings.x.min() - reach) / pixel) * pixel
    top = np.ceil((pings.y.max() + reach) / pixel) * pixel
    columns = int(np.ceil((pings.x.max() + reach - left) / pixel))
    rows = int(np.ceil((top - pings.y.min() + reach) / pixel))
    return float(left), float(top), rows, columns


def _sampled(
    recording: Recording,
    line: SurveyLine,
    side: str,
    samples: NDArray[Any],
    track: Track,
    nearest: Any,
    x: FloatArray,
    y: FloatArray,
) -> NDArray[Any]:
    """Look up the samples at the pixels of columns `x` and rows `y`; 0 where there is none."""
    wide = np.broadcast_arrays(x[None, :], y[:, None])
    seen = track.locate(*wide)
    limit = float((recording.spacing[line.places] * samples.shape[1]).max())
    known = (seen.distance < limit) & (seen.starboard == (side == "starboard"))
    out = np.zeros(known.shape, _stored(samples.dtype))
    distance, azimuth = seen.distance[known], np.radians(seen.look_azimuth[known])
    foot = np.column_stack(
        [wide[0][known] - distance * np.sin(azimuth), wide[1][known] - distance * np.cos(azimuth)]
    )
    if not foot.size:
        return out
    ping = line.places[nearest.query(foot)[1]]
    ranges = distance if recording.ground else np.hypot(distance, seen.altitude[known])
    sample = np.floor(ranges / recording.spacing[ping]).astype(np.int64)
    inside = sample < samples.shape[1]
    values = np.zeros(sample.size, out.dtype)
    # 0 is nodata: samples of zero become the smallest positive value
    least = np.finfo(out.dtype).tiny if out.dtype.kind == "f" else 1
    values[inside] = np.maximum(samples[ping[inside], sample[inside]].astype(out.dtype), least)
    out[known] = values
    return out


def _stored(kind: np.dtype[Any]) -> np.dtype[Any]:
    """Type of a tile's pixels."""
    small = kind.kind == "u" and kind.itemsize <= 2
    return np.dtype(kind.newbyteorder("=")) if small else np.dtype(np.float32)


def _write(path: Path, values: NDArray[Any], transform: Affine, crs: str, scratch: Path) -> None:
    with (
        written_whole(path, scratch) as part,
        rasterio.open(
            part, "w", driver="GTiff", height=values.shape[0], width=values.shape[1], count=1,
            dtype=values.dtype, crs=crs, transform=transform, nodata=0, tiled=True,
            compress="deflate", predictor=2 if values.dtype.kind == "u" else 3,
        ) as target,
    ):  # fmt: skip
        target.write(values, 1)
        target.set_band_description(1, "amplitude")


def _navigation(line: SurveyLine) -> str:
    """Navigation as CSV."""
    stream = io.StringIO()
    rows = csv.writer(stream, lineterminator="\n")
    rows.writerow(("ping", "x", "y", "altitude"))
    pings = line.pings
    for number, x, y, altitude in zip(pings.rows, pings.x, pings.y, pings.altitude, strict=True):
        rows.writerow((int(number), f"{x:.4f}", f"{y:.4f}", f"{altitude:.4f}"))
    return stream.getvalue()
