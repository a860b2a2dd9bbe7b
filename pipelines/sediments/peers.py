"""Error against run time on hand-labelled strips: scales of texture, training, and a peer.

    python pipelines/sediments/peers.py FOLDER

The strips and the six splits of labels.py. The sediment map with amplitude laws alone, with texture
averaged up to 2, 4, 8 and 16 pixels (all of it: the default), and trained on a quarter and a
sixteenth of the labelled pixels (whole columns of the strips). The peer has no network: local
binary patterns (Ojala, Pietikainen and Maenpaa 2002) of radii 1 and 3 in windows of 15 pixels and
smoothed amplitude, to a random forest. Mean recall over the splits and the least one, seconds to
train and to map. Needs scikit-learn (``pip install -e '.[studies]'``).
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np
from labels import Strips, mapped, recalls
from scipy.ndimage import gaussian_filter, median_filter, uniform_filter
from skimage.feature import local_binary_pattern
from sklearn.ensemble import RandomForestClassifier

from sasmap.sediments import texture
from sasmap.sediments.training import train_classes

# Pixels a side of the peer's windows, radii of its patterns, pixels it is trained on, its trees.
WINDOW, RADII, SAMPLE, TREES = 15, (1, 3), 20_000, 200

# Labels to train on, to a label at each pixel of all strips.
Method = Callable[[np.ndarray], np.ndarray]


@contextmanager
def scales(most: int) -> Iterator[None]:
    """Describe texture by averages of up to so many pixels a side."""
    kept = texture.SCALES, texture.LAGS, texture.CHANNELS
    texture.SCALES, texture.LAGS = (tuple(s for s in known if s <= most) for known in kept[:2])
    texture.CHANNELS = len(texture.SCALES) + len(texture.LAGS)
    try:
        yield
    finally:
        texture.SCALES, texture.LAGS, texture.CHANNELS = kept


def with_texture(strips: Strips, marks: np.ndarray, most: int) -> np.ndarray:
    """Map of classes that are trained with texture of so many pixels; 0 for none."""
    if most == 0:
        classes = train_classes(strips.looks, marks, 3)
        return mapped(strips, replace(classes, texture=None))
    with scales(most):
        return mapped(strips, train_classes(strips.looks, marks, 3))


def part(marks: np.ndarray, share: int) -> np.ndarray:
    """Keep one of so many runs of 16 columns of the labels."""
    return np.where(np.arange(marks.shape[1]) // 16 % share == 0, marks, 0)


def features(amplitude: np.ndarray) -> np.ndarray:
    """Smoothed log amplitude and histograms of local binary patterns, (pixels, features)."""
    logs = np.log(amplitude)
    found = [gaussian_filter(logs, s) for s in (1, 3, 7)]
    for radius in RADII:
        pattern = local_binary_pattern(np.rint(amplitude).astype(int), 8, radius, "uniform")
        found += [uniform_filter((pattern == k).astype(np.float32), WINDOW) for k in range(10)]
    return np.stack([f.ravel() for f in found], axis=1)


def forest(strips: Strips, marks: np.ndarray) -> np.ndarray:
    """Map of a random forest over local binary patterns, majority of its neighbours."""
    rng = np.random.default_rng(1)
    places, rows = [], []
    for k, look in zip(strips.rows, strips.looks, strict=True):
        known = np.isfinite(look.amplitude[k]).all(axis=0)
        places.append((k, slice(0, int(known.sum()))))
        rows.append(features(look.amplitude[places[-1]]))
    given = np.concatenate([marks[p].ravel() for p in places])
    chosen = np.concatenate(
        [
            rng.choice(np.flatnonzero(given == k), min(SAMPLE // 3, int((given == k).sum())), False)
            for k in (1, 2, 3)
        ]
    )
    model = RandomForestClassifier(TREES, min_samples_leaf=10, random_state=1, n_jobs=1)
    model.fit(np.concatenate(rows)[chosen], given[chosen])
    result = np.zeros_like(marks)
    for place, row in zip(places, rows, strict=True):
        label = model.predict(row).reshape(marks[place].shape)
        result[place] = median_filter(label, WINDOW)
    return result


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    strips = Strips(parser.parse_args().folder)
    everything = range(len(strips.names))
    methods: dict[str, Method] = {"amplitude laws alone": lambda m: with_texture(strips, m, 0)}
    for most in (2, 4, 8, 16):
        methods[f"texture up to {most} px"] = lambda m, k=most: with_texture(strips, m, k)
    for share in (4, 16):
        methods[f"trained on 1/{share} of the labels"] = lambda m, k=share: with_texture(
            strips, part(m, k), 16
        )
    methods["local binary patterns, random forest"] = lambda m: forest(strips, m)
    with_texture(strips, strips.only((0, 1)), 16)  # compiles
    print("| method | mean recall | least of the splits | s |\n|---|---|---|---|")
    for name, method in methods.items():
        found, start = [], time.perf_counter()
        for chosen in combinations(everything, 2):
            rest = tuple(i for i in everything if i not in chosen)
            label = method(strips.only(chosen))
            found.append(recalls(label, strips.only(rest)).mean())
        seconds = (time.perf_counter() - start) / len(found)
        print(f"| {name} | {np.mean(found):.3f} | {min(found):.3f} | {seconds:.1f} |", flush=True)


if __name__ == "__main__":
    main()
