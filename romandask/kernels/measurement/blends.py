"""Blends: groups of touching objects that sep has deblended, each deblended again by itself.

Source Extractor gives the faint pixels between deblended objects to one of them at random. Its random numbers are those
of the whole image, so the pixels of a blend depend on all blends before it. Here the sequence starts again with each
blend: an object is then the same in every window of the image that contains its blend.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import sep
from scipy import ndimage

from romandask.kernels.measurement.detected_objects import Window

MARGIN = 2
"""Pixels around a blend that are cut out with it; the smoothing kernel reaches one pixel."""
_POSITIONS = {"x": ("x", "xmin", "xmax", "xpeak", "xcpeak"), "y": ("y", "ymin", "ymax", "ypeak", "ycpeak")}
"""Columns of sep's objects that are positions, by axis."""
Extract = Callable[[Window], tuple[np.ndarray, np.ndarray]]
"""Detects and deblends the objects of a window: returns sep's objects, and the segmentation map of the window."""


def deblend_each(detected: np.ndarray, segments: np.ndarray, extract: Extract) -> tuple[np.ndarray, np.ndarray]:
    """Return the objects and the segmentation map of an image with each blend deblended by itself.

    A blend that does not have the same objects by itself, which is rare, is left as it is.

    Parameters
    ----------
    detected : structured ndarray, shape (n,)
        Objects of the whole image, as `sep.extract` returns them.
    segments : ndarray, shape (ny, nx), int32
        Segmentation map of the image, with the numbers 1 to n.
    extract : callable
        extract(window) detects the objects of a window of the image.

    Returns
    -------
    detected : structured ndarray, shape (n,)
    segments : ndarray, shape (ny, nx), int32
    """
    blended = np.flatnonzero(detected["flag"] & sep.OBJ_MERGED)
    if not len(blended):
        return detected, segments
    groups, _ = ndimage.label(segments > 0, np.ones((3, 3)))
    detected, segments = detected.copy(), segments.copy()
    group_of = groups[detected["ycpeak"], detected["xcpeak"]]
    blends = np.unique(group_of[blended])
    order = np.argsort(group_of, kind="stable")
    limits = np.searchsorted(group_of[order], np.stack([blends, blends + 1]))
    boxes = ndimage.find_objects(groups)
    for blend, first, last in zip(blends, *limits, strict=True):
        if blend == 0:
            continue
        members = order[first:last]
        rows, columns = (slice(max(part.start - MARGIN, 0), part.stop + MARGIN) for part in boxes[blend - 1])
        box = rows, columns
        alone, numbers = extract(box)
        low_y, low_x = box[0].start, box[1].start
        found = numbers[detected["ycpeak"][members] - low_y, detected["xcpeak"][members] - low_x]
        if not found.all() or len(np.unique(found)) != len(found):
            continue
        for fields, low in ((_POSITIONS["x"], low_x), (_POSITIONS["y"], low_y)):
            for name in fields:
                alone[name] += low
        children = alone[found - 1]
        # an object at the edge of the image is truncated; one at the edge of the cutout is not
        children["flag"] |= detected["flag"][members] & sep.OBJ_TRUNC
        detected[members] = children
        number_of = np.zeros(len(alone) + 1, segments.dtype)
        number_of[found] = members + 1
        window, own = segments[box], groups[box] == blend
        taken = number_of[numbers]
        # pixels of objects that were merged into others ("clean") belong to no object, as in the whole image
        window[own] = 0
        window[taken > 0] = taken[taken > 0]
    return detected, segments
