"""Detection of objects as peaks of the PSF-smoothed image; a pixel belongs to the peak that is uphill of it."""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np

from romandask.kernels.measurement.convolve import convolve
from romandask.kernels.measurement.measurement_image import MeasurementImage

KERNEL_HALF_WIDTH = 8
"""Half the width of the smoothing kernel, a cutout of the PSF, pixels."""


@dataclass(frozen=True)
class Peaks:
    """Peaks of a detection image and their pixels."""

    segments: np.ndarray
    """Number, from 1, of the peak to which a pixel belongs, (ny, nx) int32; 0 for none."""
    snr: np.ndarray
    """Signal to noise of a point source at each peak, (n,)."""
    x: np.ndarray
    """Column of the pixel of each peak, (n,)."""
    y: np.ndarray
    """Row of the pixel of each peak, (n,)."""
    touching: np.ndarray
    """True for peaks with pixels next to pixels of another peak, (n,)."""


def find_peaks(measurement: MeasurementImage, threshold: float, min_area: int, min_snr: float) -> Peaks:
    """Return the peaks of the PSF-smoothed image, as Rubin's pipelines detect them (Bosch et al. 2018, section 4.7).

    Parameters
    ----------
    measurement : MeasurementImage
        Detection image.
    threshold : float
        Signal to noise of the smoothed image above which pixels belong to an object.
    min_area : int
        Smallest number of pixels of an object.
    min_snr : float
        Smallest signal to noise at the peak of an object.
    """
    smooth = point_source_snr(measurement)
    top, segments = np.zeros(smooth.shape, np.int32), np.zeros(smooth.shape, np.int32)
    _climb(smooth, np.float32(threshold), top)
    roots, area = np.unique(top[top > 0], return_counts=True)
    height = smooth.ravel()[roots - 1]
    kept = (height >= min_snr) & (area >= min_area)
    number = np.zeros(len(roots) + 1, np.int32)
    number[1:][kept] = np.arange(1, kept.sum() + 1)
    inside = top > 0
    segments[inside] = number[1 + np.searchsorted(roots, top[inside])]
    y, x = np.divmod(roots[kept] - 1, smooth.shape[1])
    return Peaks(segments, height[kept], x, y, _touching(segments, int(kept.sum()))[1:])


def point_source_snr(measurement: MeasurementImage) -> np.ndarray:
    """Return the signal to noise of a point source centred on each pixel (matched filter).

    The noise is taken to be white; the result is divided by the factor by which PSF fits scatter more
    (`MeasurementImage.psf_ratio`).

    Returns
    -------
    ndarray, shape (ny, nx), float32
        0 where there is no data.
    """
    middle = measurement.psf.shape[0] // 2
    part = slice(middle - KERNEL_HALF_WIDTH, middle + KERNEL_HALF_WIDTH + 1)
    kernel = np.ascontiguousarray(measurement.psf[part, part], np.float32)
    good = ~measurement.mask
    weight = np.zeros(measurement.image.shape, np.float32)
    np.divide(1, measurement.error**2, out=weight, where=good & (measurement.error > 0))
    scale = np.float32(weight.max(initial=0))
    if not scale > 0:
        return weight
    weight /= scale
    flipped = kernel[::-1, ::-1]
    sums = convolve(measurement.image * weight, flipped)
    norm = convolve(weight, flipped**2)
    snr = np.zeros(weight.shape, np.float32)
    # no result where most of the kernel has no data
    enough = good & (norm > 0.2 * (kernel**2).sum() * weight)
    np.divide(sums, np.sqrt(np.maximum(norm, 1e-12)), out=snr, where=enough)
    return snr * np.float32(np.sqrt(scale) / measurement.psf_ratio)


@numba.njit(nogil=True, cache=True)
def _climb(image, threshold, top):
    """Write, for each pixel above the threshold, 1 + the index in the flattened image of the peak uphill of it."""
    ny, nx = image.shape
    path = np.empty(ny + nx, np.int64)
    for y in range(ny):
        for x in range(nx):
            if image[y, x] <= threshold or top[y, x] > 0:
                continue
            v, u, steps = y, x, 0
            while top[v, u] == 0:
                # record the path; pixels beyond the length of the buffer are left to later climbs
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
    """Return, for each number in the map, whether its pixels are next to pixels of another number."""
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
