"""A seeded mutator of a small survey's files."""

from __future__ import annotations

import random
from pathlib import Path

WORDS = (
    "1e999", "-1", "0", "nan", "null", "[]", "{}", "~", "''", "true", "12:30", "1e-3", "0x10",
    "../../..", "/", "/dev/zero", "/proc/self/mem", "http://127.0.0.1:9/x.tif",
    "/vsicurl/http://127.0.0.1:9/x.tif", "!!python/object/apply:os.system [id]", "&a [*a]", "*b",
    "EPSG:4326", "EPSG:3857", "EPSG:999999", "EPSG:2154", "a" * 300, "**/*", "%", "\\x00", "é",
    "- x", "9" * 40, "both", "port", "slant", "zare-cobb", "auto", "[0.1, 0.05]", "[nan, 1]",
)  # fmt: skip
CELLS = ("", "nan", "inf", "-5", "0", "1e308", "91", "abc", "5,5", '"', "\x00", "999999999", " 5 ")


def mutate_yaml(text: str, rng: random.Random) -> bytes:
    """Change a survey file: words, lines, characters or bytes."""
    lines = text.splitlines()
    kind = rng.randrange(8)
    where = rng.randrange(len(lines))
    if kind == 0:
        del lines[where]
    elif kind == 1:
        lines.insert(rng.randrange(len(lines)), lines[where])
    elif kind in (2, 3, 4):
        head, mark, _ = lines[where].partition(":")
        lines[where] = f"{head}{mark or ':'} {rng.choice(WORDS)}"
    elif kind == 5:
        lines[where] = rng.choice(("  ", "\t", "    ", "- ")) + lines[where]
    elif kind == 6:
        lines.insert(where, f"{rng.choice(('x', 'crs', 'output', 'seed', 'window'))}: 1")
    raw = bytearray("\n".join(lines).encode())
    if kind == 7:
        raw = _bytes(raw, rng)
    return bytes(raw)


def mutate_csv(text: str, rng: random.Random) -> bytes:
    """Change a navigation file: cells, rows, header or bytes."""
    rows = [line.split(",") for line in text.splitlines()]
    kind, where = rng.randrange(7), rng.randrange(len(rows))
    column = rng.randrange(len(rows[0]))
    if kind == 0:
        rows[where][column] = rng.choice(CELLS)
    elif kind == 1:
        for row in rows[1:]:
            row[column] = rng.choice(CELLS)
    elif kind == 2:
        del rows[where][column]
    elif kind == 3:
        rows = rows[: rng.randrange(4)]
    elif kind == 4:
        rng.shuffle(rows)
    elif kind == 5:
        rows[0][column] = rng.choice(("", "X", "altitude", "longitude", "y", "heading"))
    raw = bytearray("\n".join(",".join(row) for row in rows).encode())
    return bytes(_bytes(raw, rng) if kind == 6 else raw)


def mutate_tiff(raw: bytes, rng: random.Random) -> bytes:
    """Change a GeoTIFF: bits, stretches, its end, its tags, or all of it."""
    kind = rng.randrange(7)
    if kind == 0:
        return raw[: rng.randrange(len(raw))]
    if kind == 1:
        return b"<VRTDataset><SimpleSource>http://127.0.0.1:9/x.tif</SimpleSource></VRTDataset>"
    changed = bytearray(raw)
    if kind == 2:  # the directory of tags
        start = int.from_bytes(raw[4:8], "little")
        for _ in range(rng.randrange(1, 6)):
            changed[min(start + rng.randrange(260), len(raw) - 1)] = rng.randrange(256)
    elif kind == 3:
        start = rng.randrange(len(raw))
        changed[start : start + rng.randrange(1, 200)] = b"\0" * rng.randrange(1, 200)
    elif kind == 4:  # the header
        changed[rng.randrange(8)] = rng.randrange(256)
    elif kind == 5:
        changed += bytes(rng.randrange(256) for _ in range(50))
    else:
        changed = _bytes(changed, rng)
    return bytes(changed)


def _bytes(raw: bytearray, rng: random.Random) -> bytearray:
    for _ in range(rng.randrange(1, 20)):
        if raw:
            raw[rng.randrange(len(raw))] = rng.randrange(256)
    return raw


def mutate(folder: Path, seed: int) -> Path:
    """Change one file of a small survey; returns which."""
    rng = random.Random(seed)
    kind = rng.randrange(3)
    if kind == 0:
        path = folder / "survey.yaml"
        path.write_bytes(mutate_yaml(path.read_text(), rng))
    elif kind == 1:
        path = folder / "nav.csv"
        path.write_bytes(mutate_csv(path.read_text(), rng))
    else:
        path = folder / "tiles" / "a.tif"
        path.write_bytes(mutate_tiff(path.read_bytes(), rng))
    return path
