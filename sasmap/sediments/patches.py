"""Compiled search for the patches of a class map and for their rims."""

from __future__ import annotations

import numba
import numpy as np


@numba.njit(cache=True, nogil=True, error_model="numpy")
def patches(label):  # type: ignore[no-untyped-def]
    """Find the patches of a map: pixels of one class connected by their sides.

    Parameters
    ----------
    label : ndarray of uint8 (rows, columns)
        0 for none.

    Returns
    -------
    number : ndarray of int32 (rows, columns)
        From 1; 0 for none.
    size : ndarray of int (patches + 1,)
        Pixels of each number.
    """
    rows, columns = label.shape
    number = np.zeros((rows, columns), np.int32)
    first = np.empty(rows * columns + 1, np.int32)
    first[0] = count = 0
    for r in range(rows):
        for c in range(columns):
            k = label[r, c]
            if k == 0:
                continue
            above = number[r - 1, c] if r > 0 and label[r - 1, c] == k else 0
            left = number[r, c - 1] if c > 0 and label[r, c - 1] == k else 0
            if above == 0 and left == 0:
                count += 1
                first[count] = count
                number[r, c] = count
            elif above == 0 or above == left:
                number[r, c] = left
            elif left == 0:
                number[r, c] = above
            else:
                number[r, c] = _joined(first, above, left)
    return number, _renumbered(number, first, count)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _joined(first, one, other):  # type: ignore[no-untyped-def]
    """Merge two numbers into one patch; returns the smaller."""
    while first[one] != one:
        one = first[one]
    while first[other] != other:
        other = first[other]
    less = min(one, other)
    first[max(one, other)] = less
    return less


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _renumbered(number, first, count):  # type: ignore[no-untyped-def]
    """Renumber the patches without gaps; returns the pixel count of each."""
    last = 0
    for k in range(1, count + 1):
        if first[k] == k:
            last += 1
            first[k] = last
        else:
            first[k] = first[first[k]]  # smaller, and so already renumbered
    size = np.zeros(last + 1, np.int64)
    for r in range(number.shape[0]):
        for c in range(number.shape[1]):
            k = first[number[r, c]]
            number[r, c] = k
            size[k] += 1
    return size


@numba.njit(cache=True, nogil=True, error_model="numpy")
def counted(label):  # type: ignore[no-untyped-def]
    """Count the pixels of each number of a map.

    Parameters
    ----------
    label : ndarray of uint8 (rows, columns)

    Returns
    -------
    ndarray of int (256,)
    """
    total = np.zeros(256, np.int64)
    for r in range(label.shape[0]):
        for c in range(label.shape[1]):
            total[label[r, c]] += 1
    return total


@numba.njit(cache=True, nogil=True, error_model="numpy")
def rims(mask):  # type: ignore[no-untyped-def]
    """Find pixels of a mask that touch, by side or corner, pixels outside it.

    Parameters
    ----------
    mask : ndarray of bool (rows, columns)

    Returns
    -------
    ndarray of int (n, 2)
        Rows and columns, row by row; empty where there are none.
    """
    rows, columns = mask.shape
    found = [(0, 0)]
    for r in range(rows):
        above, below = mask[max(r - 1, 0)], mask[min(r + 1, rows - 1)]
        here = mask[r]
        for c in range(columns):
            if here[c]:
                a, b = max(c - 1, 0), min(c + 1, columns - 1)
                whole = here[a] & here[b] & above[a] & above[c] & above[b]
                if not (whole & below[a] & below[c] & below[b]):
                    found.append((r, c))
    result = np.empty((len(found) - 1, 2), np.int64)
    for i in range(1, len(found)):
        result[i - 1, 0], result[i - 1, 1] = found[i]
    return result
