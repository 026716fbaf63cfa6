"""One band of a tile, or its detection image, as photometry needs it: flux, error, and how its noise is correlated."""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
import sep

NOISE_RADII = np.array([1.0, 1.5, 2.0, 2.5, 3.0, 4.0, 6.0, 9.0, 14.0, 20.0])
"""Radii of the apertures on which the correlations of the noise are measured, pixels."""
TRIALS = 2000
"""Apertures of each radius."""
_SAMPLES = 4_000_000
"""Pixels from which the rms is found."""


@dataclass(frozen=True)
class MeasurementImage:
    """One band of a tile, or its detection image."""

    image: np.ndarray
    """(ny, nx) float32, flux of a pixel."""
    error: np.ndarray
    """(ny, nx) float32, rms of an empty pixel; 0 for no data."""
    mask: np.ndarray
    """(ny, nx) True for no data."""
    ratios: np.ndarray
    """By radius of NOISE_RADII: scatter of apertures on the noise over that of white noise."""
    psf: np.ndarray
    """(side, side) unit star."""
    psf_ratio: float = 1.0
    """Scatter of PSF fits to the noise over that of white noise."""
    electrons: float = 0.0
    """Electrons per unit flux and second of exposure, or what else the exposure is counted in; 0 for no Poisson noise
    of the objects."""
    rms: float = 1.0
    """Error of a pixel with an exposure of one second: its exposure is (rms / error)^2."""
    exposures: np.ndarray | None = None
    """(ny, nx) exposure, where the error does not tell it."""

    def poisson(self, flux: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Return the variance that the objects' own light adds to their fluxes."""
        if not self.electrons:
            return np.zeros(len(x))
        if self.exposures is not None:
            exposure = at(self.exposures, x, y).astype(float)
        else:
            error = at(self.error, x, y).astype(float)
            exposure = np.where(error > 0, self.rms / np.where(error > 0, error, 1), 0) ** 2
        return np.maximum(np.nan_to_num(flux), 0) / np.maximum(exposure * self.electrons, 1e-6)

    def ratio(self, radius: np.ndarray | float) -> np.ndarray:
        """Return how much larger the scatter of an aperture is than that of white noise."""
        return np.interp(radius, NOISE_RADII, self.ratios)


def rms_of(noise: np.ndarray, weight: np.ndarray) -> float:
    """Return the rms of a noise realisation times the root of its weight, robustly; 0 where there is no weight."""
    step = max(1, int(np.sqrt(noise.size / _SAMPLES)))
    some = weight[::step, ::step]
    scaled = noise[::step, ::step][some > 0] * np.sqrt(some[some > 0])
    if not len(scaled):
        return 0.0
    return float(1.4826 * np.median(np.abs(scaled - np.median(scaled))))


def errors(weight: np.ndarray, rms: float) -> tuple[np.ndarray, np.ndarray]:
    """Turn a weight, in its place, to the rms of a pixel, 0 for no data; return it and the mask of no data."""
    mask = weight <= 0
    weight[mask] = 1
    np.sqrt(weight, out=weight)
    np.divide(np.float32(rms), weight, out=weight)
    weight[mask] = 0
    return weight, mask


def noise_ratios(noise: np.ndarray, error: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Return, by radius of NOISE_RADII, the scatter of apertures on a noise realisation over that of white noise."""
    ratios = np.ones(len(NOISE_RADII))
    ny, nx = noise.shape
    # the positions only sample the realisation: any fixed sequence will do
    random = np.random.default_rng(0)
    for k, radius in enumerate(NOISE_RADII):
        if min(ny, nx) < 4 * radius:
            ratios[k:] = ratios[max(k - 1, 0)]
            break
        x, y = (random.uniform(radius, n - 1 - radius, TRIALS) for n in (nx, ny))
        flux, white, flag = sep.sum_circle(noise, x, y, radius, err=error, mask=mask, subpix=5)
        good = (flag == 0) & (white > 0)
        if good.sum() > 50:
            ratios[k] = np.std(flux[good] / white[good])
    return ratios


def median(planes: list[np.ndarray], weights: list[np.ndarray]) -> np.ndarray:
    """Return the median over bands (ny, nx): a band counts where it has weight, and 0 stands for no data."""
    return _median(tuple(planes), tuple(weights))


@numba.njit(nogil=True, cache=True)
def _median(planes, weights):
    bands, (ny, nx) = len(planes), planes[0].shape
    out = np.empty((ny, nx), np.float32)
    values = np.empty(bands, np.float32)
    for y in range(ny):
        if bands == 4:
            # the two middle ones of four, by a selection network; where a band is missing it is done again below
            for x in range(nx):
                a, b, c, d = planes[0][y, x], planes[1][y, x], planes[2][y, x], planes[3][y, x]
                low = max(min(a, b), min(c, d))
                high = min(max(a, b), max(c, d))
                out[y, x] = (low + high) * np.float32(0.5)
        for x in range(nx):
            whole = bands == 4
            for weight in weights:
                whole &= weight[y, x] > 0
            if whole:
                continue
            count = 0
            for band in range(bands):
                if weights[band][y, x] > 0:
                    value, place = planes[band][y, x], count
                    while place > 0 and values[place - 1] > value:
                        values[place] = values[place - 1]
                        place -= 1
                    values[place] = value
                    count += 1
            out[y, x] = 0
            if count > 0:
                out[y, x] = (values[(count - 1) // 2] + values[count // 2]) * np.float32(0.5)
    return out


def weighted_mean(
    planes: list[np.ndarray], weights: list[np.ndarray], rms: list[float]
) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean over bands with inverse variances, the best for a flat spectrum, and their sum (both float32)."""
    total = np.zeros(planes[0].shape)
    mean = np.zeros(planes[0].shape)
    for plane, weight, scale in zip(planes, weights, rms, strict=True):
        if scale > 0:
            share = weight / scale**2
            total += share
            mean += share * plane
    return np.where(total > 0, mean / np.where(total > 0, total, 1), 0).astype(np.float32), total.astype(np.float32)


def at(plane: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return a plane at the pixels of positions."""
    ix = np.clip(np.rint(x).astype(int), 0, plane.shape[1] - 1)
    iy = np.clip(np.rint(y).astype(int), 0, plane.shape[0] - 1)
    return plane[iy, ix]
