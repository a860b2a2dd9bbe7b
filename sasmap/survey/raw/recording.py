"""A raw side-scan recording: an XTF file as arrays of pings by samples."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyproj
from numpy.typing import NDArray

from sasmap.arrays import FloatArray, IntArray
from sasmap.errors import InputError, check_file

# Largest recording that is read, bytes: all of its pings are held in memory.
MAX_BYTES = 2**34
EXPECTED = "expected a side-scan recording in XTF"
# XTF codes (Triton, XTF file format X41): unit of positions, kinds of channel, kind of range.
DEGREES, PORT, STARBOARD, GROUND_RANGE = 3, 1, 2, 2
WGS84 = "EPSG:4326"
# Fewest pings for the checks of the track (as for navigation files).
FEWEST_PINGS = 12
# Extent of the transmitted pulse, as a share of the range.
PULSE = 0.02


@dataclass(frozen=True, eq=False)
class Recording:
    """Pings of a line, in their order.

    Attributes
    ----------
    path : Path
    longitude, latitude : ndarray (n,)
        Degrees, WGS 84.
    altitude : ndarray (n,)
        As recorded, m; zero where missing.
    pitch : ndarray (n,)
        As recorded, degrees, nose up positive; zero where missing.
    number : ndarray (n,)
        Index of each ping in the file.
    samples : dict of str to ndarray (n, samples)
        "port" and "starboard"; the first sample is nearest to the sonar.
    spacing : ndarray (n,)
        Range from one sample to the next, m.
    ground : bool
        Whether ranges are ground ranges already.
    warnings : tuple of str
        Peculiarities of the file.
    """

    path: Path
    longitude: FloatArray
    latitude: FloatArray
    altitude: FloatArray
    pitch: FloatArray
    number: IntArray
    samples: dict[str, NDArray[Any]]
    spacing: FloatArray
    ground: bool
    warnings: tuple[str, ...] = ()


def read_xtf(path: Path, crs: str | None) -> Recording:
    """Read an XTF file.

    Parameters
    ----------
    path : Path
    crs : str or None
        CRS of positions in metres; not needed for degrees.

    Raises
    ------
    InputError
        Where the file, or pyxtf, is missing, or it holds no side-scan pings with positions.
    """
    check_file(path, EXPECTED, MAX_BYTES)
    try:
        import pyxtf  # in the extra `raw` only
    except ImportError:
        raise InputError(
            f"{path}: pyxtf is needed to read XTF: pip install 'sasmap[raw]'"
        ) from None
    header, pings, warnings = _pings(path, pyxtf)
    places = _channels(path, header)
    kept = [
        k
        for k, ping in enumerate(pings)
        if all(_at(ping, number) is not None for number in places.values())
    ]
    if len(kept) < FEWEST_PINGS:
        raise InputError(f"{path}: {EXPECTED} of at least {FEWEST_PINGS} pings, got {len(kept)}")
    x, y = _positions(path, pings, kept)
    known = (x != 0) | (y != 0)  # pings before the first fix have no position
    if known.sum() < FEWEST_PINGS:
        raise InputError(f"{path}: its pings have no positions; {EXPECTED} with navigation")
    kept = [k for k, there in zip(kept, known, strict=True) if there]
    longitude, latitude = _degrees(path, header, x[known], y[known], crs)
    return Recording(
        path,
        longitude,
        latitude,
        np.array([_altitude(pings[k]) for k in kept]),
        np.array([float(pings[k].SensorPitch) for k in kept]),
        np.array(kept),
        _oriented({side: _stacked(pings, kept, at) for side, at in places.items()}),
        _spacing(path, pings, kept, next(iter(places.values()))),
        any(int(info.CorrectionFlags) == GROUND_RANGE for info in header.sonar_info),
        tuple(warnings),
    )


def _pings(path: Path, pyxtf: Any) -> tuple[Any, list[Any], list[str]]:
    """Read the header and the sonar packets, up to a break of the file."""
    index = path.with_suffix(".pyxtf_idx")
    if index.exists():  # pyxtf would unpickle it, which can run any code
        raise InputError(
            f"{index}: an index, which could run any code: remove it; it is not needed"
        )
    pings: list[Any] = []
    header = None
    try:
        packets = pyxtf.xtf_read_gen(str(path), [pyxtf.XTFHeaderType.sonar])
        header = next(packets)
        pings += packets
    except Exception as error:  # broken files raise all kinds of exceptions
        told = f"{type(error).__name__}: {' '.join(str(error).split())[:120]}"
        if header is None:
            raise InputError(
                f"{path}: {EXPECTED}; this is another kind of file, or damaged at its start"
            ) from None
        if len(pings) < FEWEST_PINGS:
            raise InputError(f"{path}: {EXPECTED}: {told}") from None
        return (
            header,
            pings,
            [f"{path}: breaks off after {len(pings)} pings ({told}), which are used"],
        )
    return header, pings, []


def _at(ping: Any, number: int) -> int | None:
    """Index of a channel within a ping, which may hold only some of the file's channels."""
    numbers = [int(info.ChannelNumber) for info in ping.ping_chan_headers]
    if len(set(numbers)) < len(numbers):  # not filled in: channels in the file's order
        return number if number < len(numbers) else None
    return numbers.index(number) if number in numbers else None


def _channels(path: Path, header: Any) -> dict[str, int]:
    """Return the number of each side's first channel."""
    places: dict[str, int] = {}
    for k, info in enumerate(header.sonar_info):
        side = {PORT: "port", STARBOARD: "starboard"}.get(int(info.TypeOfChannel))
        if side is not None:
            places.setdefault(side, k)
    if not places:
        raise InputError(f"{path}: holds no port or starboard channel; {EXPECTED}")
    return places


def _positions(path: Path, pings: list[Any], kept: list[int]) -> tuple[FloatArray, FloatArray]:
    """Positions of the sensor, or of the ship where the sensor's are not recorded."""
    for prefix in ("Sensor", "Ship"):
        x = np.array([float(getattr(pings[k], f"{prefix}Xcoordinate")) for k in kept])
        y = np.array([float(getattr(pings[k], f"{prefix}Ycoordinate")) for k in kept])
        if ((x != 0) | (y != 0)).sum() > len(kept) / 2:
            return x, y
    raise InputError(f"{path}: its pings have no positions; {EXPECTED} with navigation")


def _degrees(
    path: Path, header: Any, x: FloatArray, y: FloatArray, crs: str | None
) -> tuple[FloatArray, FloatArray]:
    degrees = int(header.NavUnits) == DEGREES or (np.abs(x).max() <= 360 and np.abs(y).max() <= 90)
    if degrees:
        return x, y
    if crs is None:
        raise InputError(
            f"{path}: positions are in metres: state their CRS, for example --crs EPSG:32619"
        )
    try:
        move = pyproj.Transformer.from_crs(crs, WGS84, always_xy=True)
    except pyproj.exceptions.ProjError:
        raise InputError(f"--crs: expected a CRS such as EPSG:32619, got {crs!r}") from None
    longitude, latitude = move.transform(x, y)
    if not (np.isfinite(longitude).all() and np.isfinite(latitude).all()):
        raise InputError(f"{path}: positions lie outside the domain of --crs {crs}")
    return np.asarray(longitude, float), np.asarray(latitude, float)


def _altitude(ping: Any) -> float:
    first = float(ping.SensorPrimaryAltitude)
    return first if first > 0 else float(ping.SensorAuxAltitude)


def _spacing(path: Path, pings: list[Any], kept: list[int], at: int) -> FloatArray:
    headers = [pings[k].ping_chan_headers[_at(pings[k], at)] for k in kept]
    counts = [len(pings[k].data[_at(pings[k], at)]) for k in kept]
    ranges = np.array([float(h.SlantRange) or float(h.GroundRange) for h in headers])
    if not (ranges > 0).all():
        raise InputError(f"{path}: ping {kept[int(np.argmin(ranges))]}: no range recorded")
    return np.asarray(ranges / np.array(counts), float)


def _stacked(pings: list[Any], kept: list[int], at: int) -> NDArray[Any]:
    """Stack the samples of a channel; shorter pings are padded with zeros."""
    parts = [np.asarray(pings[k].data[_at(pings[k], at)]) for k in kept]
    weights = [int(pings[k].ping_chan_headers[_at(pings[k], at)].Weight) for k in kept]
    if len(set(weights)) > 1:  # samples of each ping are divided by two to this power
        parts = [
            np.ldexp(part.astype(np.float32), -w) for part, w in zip(parts, weights, strict=True)
        ]
    length = max(part.size for part in parts)
    stacked = np.zeros((len(parts), length), np.result_type(*{part.dtype for part in parts}))
    for row, part in zip(stacked, parts, strict=True):
        row[: part.size] = part
    # a signed channel holds the waveform: its magnitude approximates the envelope
    return np.abs(stacked) if stacked.dtype.kind == "i" else stacked


def _oriented(samples: dict[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """Reverse port so that the nearest sample is first: XTF stores it from the far end.

    Some programs store both sides from the sonar outwards. Then port's mean profile resembles
    starboard's; with port alone, the transmitted pulse, the strongest sample, is at the start.
    """
    if "port" not in samples:
        return samples
    port = samples["port"]
    profile = np.log1p(port.mean(axis=0, dtype=float))
    starboard = samples.get("starboard")
    if starboard is not None and starboard.shape[1] == port.shape[1]:
        other = np.log1p(starboard.mean(axis=0, dtype=float))
        alike = [float(np.corrcoef(p, other)[0, 1]) for p in (profile, profile[::-1])]
        near_first = alike[0] > alike[1]
    else:
        pulse = max(int(PULSE * profile.size), 1)
        near_first = profile[:pulse].max() > np.log(2) + profile[pulse:].max()
    return samples if near_first else samples | {"port": port[:, ::-1]}
