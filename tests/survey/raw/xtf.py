"""Recordings written as XTF, with what programs do differently."""

from __future__ import annotations

import ctypes

import numpy as np
import pyxtf

FORMATS = {"uint8": 8, "uint16": 3, "uint32": 2, "float32": 5, "int16": 3}


def write_xtf(path, recording, kind="uint16", sides=("port", "starboard"), **odd):
    """Write a recording as XTF.

    Keyword arguments: `between` writes packets of another kind between the pings, `told` says
    whether the field for the sample's format is filled in, `near_first` writes port from the sonar
    on, `swapped` writes starboard before port, `weights` are each ping's power of two, `scale`
    multiplies the samples, `units` are those of positions (3: degrees).
    """
    header = pyxtf.XTFFileHeader()
    header.FileFormat, header.NavUnits = 0x7B, odd.get("units", 3)
    header.NumberOfSonarChannels = len(sides)
    kind = np.dtype(kind)
    for k, side in enumerate(sides):
        info = header.ChanInfo[k]
        info.TypeOfChannel = {"port": 1, "starboard": 2}[side]
        info.CorrectionFlags, info.BytesPerSample = 1, kind.itemsize
        info.SampleFormat = FORMATS[kind.name] if odd.get("told", True) else 0
    parts = [bytes(header).ljust(1024, b"\0")]
    for i in range(recording.longitude.size):
        parts.append(_ping(recording, i, kind, sides, odd))
        if odd.get("between"):
            parts.append(_other())
    path.write_bytes(b"".join(parts))
    return path


def _ping(recording, i, kind, sides, odd):
    ping = pyxtf.XTFPingHeader()
    ping.MagicNumber = 0xFACE
    ping.NumChansToFollow, ping.PingNumber = len(sides), i
    ping.Year, ping.Month, ping.Day = 2024, 5, 17
    ping.Minute, ping.Second = i // 60 % 60, i % 60
    ping.SensorXcoordinate, ping.SensorYcoordinate = recording.longitude[i], recording.latitude[i]
    ping.SensorPrimaryAltitude, ping.SensorPitch = recording.altitude[i], recording.pitch[i]
    weights = odd.get("weights")
    body = []
    for k, side in enumerate(sides[::-1] if odd.get("swapped") else sides):
        channel = pyxtf.XTFPingChanHeader()
        channel.ChannelNumber = len(sides) - 1 - k if odd.get("swapped") else k
        samples = recording.samples[side][i].astype(float) * odd.get("scale", 1.0)
        if weights is not None:
            channel.Weight, samples = weights[i], samples * 2.0 ** weights[i]
        if side == "port" and not odd.get("near_first"):
            samples = samples[::-1]
        channel.SlantRange = recording.spacing[i] * samples.size
        channel.NumSamples = samples.size
        body += [bytes(channel), samples.astype(kind).tobytes()]
    data = b"".join(body)
    ping.NumBytesThisRecord = ctypes.sizeof(ping) + len(data)
    return bytes(ping) + data


def _other():
    """A packet that is no sonar: an attitude record, its body left empty."""
    packet = pyxtf.XTFAttitudeData()
    packet.MagicNumber, packet.HeaderType = 0xFACE, int(pyxtf.XTFHeaderType.attitude)
    packet.NumBytesThisRecord = ctypes.sizeof(packet)
    return bytes(packet)
