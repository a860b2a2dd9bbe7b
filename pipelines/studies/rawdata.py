"""Images of a sea floor from raw data: echoes of openstb-simulator, own beamformer.

The sea floor is a cloud of point scatterers. openstb-simulator (a point-target simulator of raw
receiver data, written by others) turns it into what a sonar's receiver records, ping by ping;
backprojection turns that into an image. Nothing here comes from sasmap: placement, speckle, lean of
crests, radiometry and point spread function are what echoes and beamformer make of them. The
simulator casts no shadows, so scatterers that no ray reaches are left out beforehand, and it gives
each point one strength, so the scattering law is in that strength.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import distributed
import numpy as np
import zarr
from numpy.typing import NDArray
from openstb.simulator.distortion.beampattern import RectangularBeampattern
from openstb.simulator.distortion.environmental import GeometricSpreading
from openstb.simulator.environment.invariant import InvariantEnvironment
from openstb.simulator.plugin.abc import DaskCluster, PointTargets
from openstb.simulator.simulation.points import PointSimulation
from openstb.simulator.system.ping_times import ConstantInterval
from openstb.simulator.system.signal import LFMChirp
from openstb.simulator.system.trajectory import Linear
from openstb.simulator.system.transducer import GenericTransducer
from openstb.simulator.travel_time.stop_and_hop import StopAndHop

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
Floor = Callable[[FloatArray, FloatArray], FloatArray]

SOUND_SPEED = 1500.0
# Step of the finite differences that normals are taken from, m.
STEP = 1e-3
# Range step of the lattice on which lines of sight are followed, m.
SIGHT = 0.01
# Points that the simulator handles at once: what fits a processor's cache.
POINTS = 4000


@dataclass(frozen=True)
class Sonar:
    """A sonar that looks to starboard, and its beamformer.

    The two-way beam of an element of length D gives a resolution of about D / 2 along the track; a
    Hamming window over the band gives 1.3 c / 2 B across it. Both are one pixel here.

    Attributes
    ----------
    frequency, bandwidth : float
        Centre and width of the chirp's band, Hz.
    element : float
        Length of transmitter and receiver, m.
    pixel : float
        m.
    pulse : float
        s.
    """

    frequency: float = 900e3
    bandwidth: float = 19.5e3
    element: float = 0.10
    pixel: float = 0.05
    pulse: float = 0.5e-3

    @property
    def spacing(self) -> float:
        """Distance between pings, m: what aliases is 28 dB down with the beamformer's taper."""
        return self.element / 3

    @property
    def sample_rate(self) -> float:
        """Of the baseband recording, Hz."""
        return 1.05 * self.bandwidth

    @property
    def aperture(self) -> float:
        """Half the synthetic aperture over the range: to 0.9 of the beam's first null."""
        return 0.9 * SOUND_SPEED / self.frequency / self.element


@dataclass(frozen=True)
class Swath:
    """What an image shows: pixels along the track and in ground range, and the track's altitude.

    Attributes
    ----------
    rows, columns : int
    near : float
        Ground range of the first column's centre, m.
    altitude : float
        Over the mean sea floor, m.
    """

    rows: int
    columns: int
    near: float
    altitude: float

    def lattice(self, pixel: float) -> tuple[FloatArray, FloatArray]:
        """Along-track distance of the rows and ground range of the columns, m."""
        return pixel * np.arange(self.rows), self.near + pixel * np.arange(self.columns)


class _InProcess(DaskCluster):  # type: ignore[misc]
    """One thread of this process, kept from one simulation to the next."""

    def __init__(self) -> None:
        self._client: distributed.Client | None = None

    def initialise(self) -> None:
        if self._client is None:
            self._client = distributed.Client(
                processes=False, n_workers=1, threads_per_worker=1, dashboard_address=":0"
            )

    @property
    def client(self) -> distributed.Client:
        return self._client

    def terminate(self) -> None:
        if self._client is not None:
            self._client.close()
            self._client = None


class _Gated(StopAndHop):  # type: ignore[misc]
    """Recording begins so many seconds after the ping, not with it: shorter records."""

    def __init__(self, gate: float) -> None:
        self.gate = gate

    def calculate(self, *args: Any, **kwargs: Any) -> Any:
        result = super().calculate(*args, **kwargs)
        return replace(result, travel_time=result.travel_time - self.gate)


class _Points(PointTargets):  # type: ignore[misc]
    """Scatterers at known places."""

    def __init__(self, position: FloatArray, reflectivity: FloatArray) -> None:
        self._position, self._reflectivity = position, reflectivity

    def __len__(self) -> int:
        return len(self._reflectivity)

    @property
    def position(self) -> FloatArray:
        return self._position

    @property
    def reflectivity(self) -> FloatArray:
        return self._reflectivity


def scatterers(
    floor: Floor,
    law: Callable[[FloatArray], FloatArray],
    sonar: Sonar,
    swath: Swath,
    density: float,
    rng: np.random.Generator,
) -> tuple[FloatArray, FloatArray]:
    """Scatter points over a floor; those that no ray from abeam reaches are left out.

    Parameters
    ----------
    floor : callable
        Height over the mean sea floor, m, of along-track distance and ground range, m.
    law : callable
        Intensity that a facet scatters back per area, of the sine of its local grazing angle.
    sonar : Sonar
    swath : Swath
    density : float
        Scatterers a pixel.
    rng : Generator

    Returns
    -------
    position : ndarray (points, 3)
        Forward, to starboard, down from the track's start, m.
    strength : ndarray (points,)
        Amplitude.
    """
    margin = 10 * sonar.pixel
    along, across = swath.lattice(sonar.pixel)
    low = np.array([along[0], max(across[0], 1.0)]) - margin
    high = np.array([along[-1], across[-1]]) + margin
    count = rng.poisson(density * np.prod((high - low) / sonar.pixel))
    s, r = low[:, None] + (high - low)[:, None] * rng.random((2, count))
    h = floor(s, r)
    forward = (floor(s + STEP, r) - floor(s - STEP, r)) / (2 * STEP)
    outward = (floor(s, r + STEP) - floor(s, r - STEP)) / (2 * STEP)
    drop = swath.altitude - h
    area = np.sqrt(1 + forward**2 + outward**2)
    sine = (r * outward + drop) / (np.hypot(r, drop) * area)
    lit = (sine > 0) & ~_hidden(floor, swath.altitude, (low, high), s, r, -drop / r)
    strength = np.sqrt(law(np.clip(sine[lit], 1e-9, 1)) * area[lit])
    return np.column_stack([s, r, drop])[lit], strength


def _hidden(
    floor: Floor,
    altitude: float,
    box: tuple[FloatArray, FloatArray],
    s: FloatArray,
    r: FloatArray,
    rise: FloatArray,
) -> NDArray[np.bool_]:
    """Whether an earlier point of the same ray stands higher, seen from the array."""
    low, high = box
    rows = np.arange(low[0], high[0] + 0.05, 0.05)
    # sight lines begin before the scene: rays are nearly parallel, and ripples repeat
    ranges = np.arange(max(0.6 * low[1], 0.5), high[1] + SIGHT, SIGHT)
    seen = (floor(rows[:, None], ranges) - altitude) / ranges
    horizon = np.maximum.accumulate(seen, axis=1)
    # nearest row; the column before the point's own, lest a point hide itself
    i = np.clip(np.rint((s - rows[0]) / 0.05).astype(int), 0, len(rows) - 1)
    j = np.clip(((r - ranges[0]) / SIGHT).astype(int) - 1, 0, len(ranges) - 1)
    return np.asarray(horizon[i, j] > rise)


class Recorder:
    """Runs openstb-simulator over many pings; ``close`` ends its worker.

    Its cost is points times samples times pings. A few pings at a time are given the points in
    their beam alone, and a band of ranges at a time is recorded by itself.
    """

    def __init__(self, sonar: Sonar, pings: int = 8, band: float = 2.5) -> None:
        self.sonar = sonar
        self.pings, self.band = pings, band
        self._cluster = _InProcess()

    def close(self) -> None:
        """End the worker."""
        self._cluster.terminate()

    def record(
        self, position: FloatArray, strength: FloatArray, swath: Swath
    ) -> tuple[ComplexArray, FloatArray, float]:
        """Simulate what the receiver records of a swath.

        Parameters
        ----------
        position : ndarray (points, 3)
        strength : ndarray (points,)
        swath : Swath

        Returns
        -------
        pressure : ndarray of complex (pings, samples)
            At baseband.
        places : ndarray (pings,)
            Along-track distance of the pings, m.
        gate : float
            Time from a ping to its first sample, s.
        """
        sonar, step = self.sonar, 1 / self.sonar.sample_rate
        slant = np.hypot(position[:, 1], position[:, 2])
        start = int(2 * (slant.min() - 0.5) / SOUND_SPEED / step)
        stop = int((2 * (slant.max() + 0.5) / SOUND_SPEED + sonar.pulse) / step)
        widest = sonar.aperture * float(slant.max())
        places = np.arange(-widest, sonar.pixel * swath.rows + widest, sonar.spacing)
        pressure = np.zeros((len(places), stop - start), complex)
        for near in np.arange(slant.min(), slant.max() + 1e-9, self.band):
            on = (slant >= near) & (slant < near + self.band)
            gate = int(2 * (near - 0.1) / SOUND_SPEED / step)
            far = np.hypot(near + self.band, widest)
            samples = int((2 * far / SOUND_SPEED + sonar.pulse) / step) + 2 - gate
            part = self._band(position[on], strength[on], places, (gate * step, samples))
            end = min(gate - start + samples, pressure.shape[1])
            # to the phase of a record that begins with the ping
            turn = np.exp(-2j * np.pi * sonar.frequency * gate * step)
            pressure[:, gate - start : end] += turn * part[:, : end - gate + start]
        return pressure, places, start * step

    def _band(
        self,
        position: FloatArray,
        strength: FloatArray,
        places: FloatArray,
        window: tuple[float, int],
    ) -> ComplexArray:
        """Simulate the points of a band of ranges, some pings at a time."""
        reach = self.sonar.aperture * np.hypot(position[:, 1], position[:, 2])
        result = np.zeros((len(places), window[1]), complex)
        for first in range(0, len(places), self.pings):
            some = slice(first, first + self.pings)
            part = places[some]
            near = (position[:, 0] > part[0] - reach) & (position[:, 0] < part[-1] + reach)
            if near.any():
                result[some] = self._block(position[near], strength[near], part, *window)
        return result

    def _block(
        self,
        position: FloatArray,
        strength: FloatArray,
        places: FloatArray,
        gate: float,
        samples: int,
    ) -> ComplexArray:
        """Simulate some pings; only the points in their main beams are given."""
        sonar = self.sonar
        turn = [np.sqrt(0.5), 0, 0, np.sqrt(0.5)]  # from forward to starboard
        one_way = {"width": sonar.element, "height": 0.01, "frequency": "centre", "vertical": False}
        sending = RectangularBeampattern(transmit=True, receive=False, **one_way)
        receiving = RectangularBeampattern(transmit=False, receive=True, **one_way)
        end = places[0] + sonar.spacing * len(places)
        half = 0.5 * sonar.bandwidth
        config = {
            "dask_cluster": self._cluster,
            "ping_times": ConstantInterval(sonar.spacing, 0.0, 0.5 * sonar.spacing),
            "transmitter": GenericTransducer([0, 0, 0], turn, sending),
            "receivers": [GenericTransducer([0, 0, 0], turn, receiving)],
            "signal": LFMChirp(sonar.frequency - half, sonar.frequency + half, sonar.pulse, 200.0),
            "targets": [_Points(position, strength)],
            "trajectory": Linear([places[0], 0, 0], [end, 0, 0], 1.0, start_time=0),
            "environment": InvariantEnvironment(35.0, SOUND_SPEED, 12.0),
            "travel_time": _Gated(gate),
            "distortion": [GeometricSpreading(1.0)],
        }
        with tempfile.TemporaryDirectory() as folder:
            store = Path(folder) / "raw.zarr"
            simulation = PointSimulation(
                store, POINTS, sonar.sample_rate, sonar.frequency, max_samples=samples
            )
            simulation.run(config)
            return np.asarray(zarr.open_group(store, mode="r")["pressure"][:, 0, :])


def compress(pressure: ComplexArray, sonar: Sonar, finer: int = 8) -> ComplexArray:
    """Compress pulses, with a Hamming window over the band.

    Parameters
    ----------
    pressure : ndarray of complex (pings, samples)
    sonar : Sonar
    finer : int
        Samples of the result for one of the recording.

    Returns
    -------
    ndarray of complex (pings, finer * samples)
    """
    count = pressure.shape[1]
    half = 0.5 * sonar.bandwidth
    chirp = LFMChirp(-half, half, sonar.pulse, 200.0)
    replica = np.fft.fft(chirp.sample(np.arange(count) / sonar.sample_rate, 0.0))
    f = np.fft.fftfreq(count, 1 / sonar.sample_rate)
    window = np.where(np.abs(f) < half, 0.54 + 0.46 * np.cos(np.pi * f / half), 0.0)
    # flat within the band, so that the window alone shapes the pulse
    spectrum = np.fft.fft(pressure) * window * np.conj(replica) / np.abs(replica) ** 2
    wide = np.zeros((len(pressure), finer * count), complex)
    middle = (count + 1) // 2
    wide[:, :middle] = spectrum[:, :middle]
    wide[:, middle - count :] = spectrum[:, middle:]
    return np.asarray(np.fft.ifft(wide) * finer)


def backproject(
    compressed: ComplexArray,
    places: FloatArray,
    gate: float,
    sonar: Sonar,
    swath: Swath,
    finer: int = 8,
) -> ComplexArray:
    """Focus an image on a flat sea floor: the sum of echoes over each pixel's aperture.

    Parameters
    ----------
    compressed : ndarray of complex (pings, samples)
    places : ndarray (pings,)
        m.
    gate : float
        s.
    sonar : Sonar
    swath : Swath
    finer : int
        As of :func:`compress`.

    Returns
    -------
    ndarray of complex (rows, columns)
        Spreading is taken off, and what a wider aperture adds.
    """
    along, across = swath.lattice(sonar.pixel)
    closest = np.hypot(across, swath.altitude)
    image = np.zeros((swath.rows, swath.columns), complex)
    used = np.zeros((swath.rows, swath.columns))
    rate = finer * sonar.sample_rate
    reach = sonar.aperture * closest
    for place, echo in zip(places, compressed, strict=True):
        rows = np.flatnonzero(np.abs(along - place) < reach.max())
        away = np.abs(along[rows, None] - place)
        distance = np.hypot(closest, away)
        delay = 2 * distance / SOUND_SPEED
        at = (delay - gate) * rate
        k = np.clip(at.astype(int), 0, echo.size - 2)
        value = echo[k] + (at - k) * (echo[k + 1] - echo[k])
        taper = np.where(away < reach, np.cos(0.5 * np.pi * away / reach), 0.0)
        value *= np.exp(2j * np.pi * sonar.frequency * delay) * distance**2
        image[rows] += taper * value
        used[rows] += taper
    return image / np.maximum(used, 1)
