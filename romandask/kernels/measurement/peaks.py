"""Objects as peaks of an image smoothed with its PSF, each with the pixels from which the way up leads to it."""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np

from romandask.kernels.measurement.convolve import convolve
from romandask.kernels.measurement.measurement_image import MeasurementImage

KERNEL = 8
"""Half the side of the PSF that is smoothed with, pixels."""


@dataclass(frozen=True)
class Peaks:
    """Peaks of a detection image, and what belongs to each."""

    segments: np.ndarray
    """(ny, nx) int32: number of the peak, from 1; 0 for none."""
    snr: np.ndarray
    """(n,) signal to noise, of a point source, at each peak."""
    touching: np.ndarray
    """(n,) True where its pixels touch another's."""


def find_peaks(layer: MeasurementImage, threshold: float, min_area: int, min_snr: float) -> Peaks:
    """Return the peaks of the PSF-smoothed image: what Rubin's pipelines detect (Bosch et al. 2018, section 4.7).

    Parameters
    ----------
    threshold : signal to noise of the smoothed image down to which pixels belong to an object
    min_area : least number of pixels of an object
    min_snr : least signal to noise at its peak
    """
    smooth = point_source_snr(layer)
    top, segments = np.zeros(smooth.shape, np.int32), np.zeros(smooth.shape, np.int32)
    _climb(smooth, np.float32(threshold), top)
    roots, area = np.unique(top[top > 0], return_counts=True)
    height = smooth.ravel()[roots - 1]
    kept = (height >= min_snr) & (area >= min_area)
    number = np.zeros(len(roots) + 1, np.int32)
    number[1:][kept] = np.arange(1, kept.sum() + 1)
    inside = top > 0
    segments[inside] = number[1 + np.searchsorted(roots, top[inside])]
    return Peaks(segments, height[kept], _touching(segments, int(kept.sum()))[1:])


def point_source_snr(layer: MeasurementImage) -> np.ndarray:
    """Return the signal to noise (ny, nx), float32, of a point source at every pixel: the matched filter.

    The noise is white but for the factor by which PSF fits scatter more (`Layer.psf_ratio`). Where there is no data
    there is none.
    """
    middle = layer.psf.shape[0] // 2
    part = slice(middle - KERNEL, middle + KERNEL + 1)
    kernel = np.ascontiguousarray(layer.psf[part, part], np.float32)
    good = ~layer.mask
    weight = np.zeros(layer.image.shape, np.float32)
    np.divide(1, layer.error**2, out=weight, where=good & (layer.error > 0))
    scale = np.float32(weight.max(initial=0))
    if not scale > 0:
        return weight
    weight /= scale
    turned = kernel[::-1, ::-1]
    sums = convolve(layer.image * weight, turned)
    norm = convolve(weight, turned**2)
    found = np.zeros(weight.shape, np.float32)
    # of what is mostly beyond the edge nothing is said
    enough = good & (norm > 0.2 * (kernel**2).sum() * weight)
    np.divide(sums, np.sqrt(np.maximum(norm, 1e-12)), out=found, where=enough)
    return found * np.float32(np.sqrt(scale) / layer.psf_ratio)


@numba.njit(nogil=True, cache=True)
def _climb(image, threshold, top):
    """Give every pixel above the threshold the number (from 1, in the flattened image) of the peak above it."""
    ny, nx = image.shape
    path = np.empty(ny + nx, np.int64)
    for y in range(ny):
        for x in range(nx):
            if image[y, x] <= threshold or top[y, x] > 0:
                continue
            v, u, steps = y, x, 0
            while top[v, u] == 0:
                # pixels on the way; a longer one is finished in more than one go
                if steps < len(path):
                    path[steps] = v * nx + u
                    steps += 1
                best, bv, bu = image[v, u], v, u
                for j in range(max(v - 1, 0), min(v + 2, ny)):
                    for i in range(max(u - 1, 0), min(u + 2, nx)):
                        if image[j, i] > best:
                            best, bv, bu = image[j, i], j, i
                if bv == v and bu == u:
                    top[v, u] = v * nx + u + 1
                else:
                    v, u = bv, bu
            for k in range(steps):
                top[path[k] // nx, path[k] % nx] = top[v, u]


@numba.njit(nogil=True, cache=True)
def _touching(segments, count):
    out = np.zeros(count + 1, np.bool_)
    ny, nx = segments.shape
    for y in range(ny):
        for x in range(nx):
            own = segments[y, x]
            if own == 0:
                continue
            for j in range(max(y - 1, 0), min(y + 2, ny)):
                for i in range(max(x - 1, 0), min(x + 2, nx)):
                    if segments[j, i] != 0 and segments[j, i] != own:
                        out[own] = True
    return out
