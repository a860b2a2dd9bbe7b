"""Recall on hand-labelled side-scan strips: trained on two, judged on the others, and unsupervised.

    python pipelines/sediments/labels.py FOLDER [--pictures DIR]

FOLDER holds pairs NAME.png and NAME_class.png (0 sand, 127 rock, 255 other), 83 pixels across the
track, the far edge first. Range and altitude are not recorded: 0.1 m a pixel, the track 3 m below
the last row and 3 m of altitude are assumed. Every split into two strips for training and the rest
for judging is run; a recall is a class's share of pixels that are found, the mean is over classes.
Unsupervised classes are each matched to the label that they hold the largest share of.
"""

from __future__ import annotations

import argparse
from itertools import combinations
from pathlib import Path

import numpy as np
from skimage.io import imread, imsave

from sasmap.sediments.classes import Classes
from sasmap.sediments.classmap import class_map, log_likelihoods
from sasmap.sediments.segmentation import find_classes
from sasmap.sediments.training import train_classes
from sasmap.sediments.trends import AmplitudeGrid

NAMES, GREYS = ("sand", "rock", "other"), (0, 127, 255)
PIXEL, NEAREST, ALTITUDE = 0.1, 3.0, 3.0
# Rows between strips on the lattice that they share: they see nothing of each other.
GAP = 45


class Strips:
    """Strips laid below each other, one look each."""

    def __init__(self, folder: Path) -> None:
        paths = sorted(p for p in folder.glob("*.png") if not p.stem.endswith("_class"))
        self.names = [p.stem for p in paths]
        images = [imread(p).astype(float) for p in paths]
        labels = [imread(p.with_name(f"{p.stem}_class.png")) for p in paths]
        self.rows = [slice(i * (83 + GAP), i * (83 + GAP) + len(v)) for i, v in enumerate(images)]
        shape = self.rows[-1].stop, max(v.shape[1] for v in images)
        self.truth = np.zeros(shape, np.uint8)
        self.looks = []
        for rows, image, label in zip(self.rows, images, labels, strict=True):
            place = rows, slice(0, image.shape[1])
            amplitude, cotangent = np.full(shape, np.nan), np.full(shape, np.nan)
            amplitude[place] = np.maximum(image, 0.5)
            reach = NEAREST + PIXEL * np.arange(len(image))[::-1]
            cotangent[place] = (reach / ALTITUDE)[:, None]
            self.looks.append(AmplitudeGrid(amplitude, cotangent))
            for k, grey in enumerate(GREYS):
                self.truth[place][label == grey] = k + 1

    def only(self, chosen: tuple[int, ...]) -> np.ndarray:
        """Labels of some strips."""
        marks = np.zeros_like(self.truth)
        for i in chosen:
            marks[self.rows[i]] = self.truth[self.rows[i]]
        return marks


def mapped(strips: Strips, classes: Classes) -> np.ndarray:
    """Classes on all strips, mapped one by one as blocks of a survey are."""
    result = np.zeros_like(strips.truth)
    for rows in strips.rows:
        looks = [AmplitudeGrid(v.amplitude[rows], v.cotangent[rows]) for v in strips.looks]
        result[rows] = class_map(log_likelihoods(looks, classes), len(classes.laws)).label
    return result


def recalls(found: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Share of each label's pixels that are found (3,)."""
    return np.array([(found[truth == k] == k).mean() for k in (1, 2, 3)])


def matched(found: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Give each class the label of which it holds the largest share."""
    number = np.zeros(256, np.uint8)
    for k in np.unique(found[found > 0]):
        number[k] = 1 + np.argmax([(found[truth == j] == k).mean() for j in (1, 2, 3)])
    return number[found]


def line(head: str, recall: np.ndarray) -> str:
    """One line of the table."""
    each = "  ".join(f"{n} {r:.3f}" for n, r in zip(NAMES, recall, strict=True))
    return f"{head:28s} {each}  mean {recall.mean():.3f}"


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--pictures", type=Path)
    options = parser.parse_args()
    strips = Strips(options.folder)
    everything = range(len(strips.names))
    for chosen in combinations(everything, 2):
        rest = tuple(i for i in everything if i not in chosen)
        classes = train_classes(strips.looks, strips.only(chosen), 3)
        found = mapped(strips, classes)
        head = "trained on " + ", ".join(strips.names[i][-2:] for i in chosen)
        print(line(head, recalls(found, strips.only(rest))), flush=True)
        if options.pictures:
            options.pictures.mkdir(parents=True, exist_ok=True)
            grey = np.array([0, *GREYS], np.uint8)
            both = np.hstack([grey[found], grey[strips.truth]])
            imsave(options.pictures / f"{head.replace(', ', '_').replace(' ', '_')}.png", both)
    for count in (None, 3):
        classes = find_classes(strips.looks, count)
        found = matched(mapped(strips, classes), strips.truth)
        head = f"unsupervised, {len(classes.laws)} classes"
        print(line(head, recalls(found, strips.truth)), flush=True)


if __name__ == "__main__":
    main()
