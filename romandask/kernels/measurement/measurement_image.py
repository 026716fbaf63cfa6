"""Measurement images: one band of a tile, or its detection image, with its errors and noise correlations."""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np

NOISE_RADII = np.array([1.0, 1.5, 2.0, 2.5, 3.0, 4.0, 6.0, 9.0, 14.0, 20.0])
"""Radii of the apertures in which the correlation of the noise is measured, pixels."""


@dataclass(frozen=True)
class MeasurementImage:
    """One band of a tile, or its detection image, as photometry needs it."""

    image: np.ndarray
    """Flux of a pixel, (ny, nx) float32."""
    error: np.ndarray
    """Rms of an empty pixel, (ny, nx) float32; 0 for no data."""
    mask: np.ndarray
    """True for no data, (ny, nx)."""
    aperture_ratios: np.ndarray
    """Scatter of aperture fluxes in the noise over that in white noise, (len(NOISE_RADII),)."""
    psf: np.ndarray
    """PSF of unit flux, (side, side)."""
    psf_ratio: float = 1.0
    """Scatter of fluxes from PSF fits to the noise over that in white noise."""
    electrons_per_flux: float = 0.0
    """Electrons per unit flux and unit exposure, which is a second or the unit of `exposure_map`; 0 for no Poisson
    noise of the sources."""
    rms: float = 1.0
    """Error of a pixel with unit exposure. Without `exposure_map`, the exposure of a pixel is (rms / error)^2."""
    exposure_map: np.ndarray | None = None
    """Exposure of each pixel, (ny, nx), where the errors do not determine it."""

    def source_variance(self, flux: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Return the variance that the Poisson noise of sources adds to their fluxes.

        Parameters
        ----------
        flux : ndarray, shape (n,)
        x, y : ndarray, shape (n,), pixels

        Returns
        -------
        ndarray, shape (n,), flux^2
        """
        if not self.electrons_per_flux:
            return np.zeros(len(x))
        if self.exposure_map is not None:
            exposure = pixel_values(self.exposure_map, x, y).astype(float)
        else:
            error = pixel_values(self.error, x, y).astype(float)
            exposure = np.where(error > 0, self.rms / np.where(error > 0, error, 1), 0) ** 2
        return np.maximum(np.nan_to_num(flux), 0) / np.maximum(exposure * self.electrons_per_flux, 1e-6)

    def aperture_ratio(self, radius: np.ndarray | float) -> np.ndarray:
        """Return the scatter of aperture fluxes over that in white noise, for aperture radii in pixels."""
        return np.interp(radius, NOISE_RADII, self.aperture_ratios)


def errors(weight: np.ndarray, rms: float) -> tuple[np.ndarray, np.ndarray]:
    """Convert a weight, in place, to the rms of a pixel.

    Parameters
    ----------
    weight : ndarray, shape (ny, nx), float32
        It is overwritten.
    rms : float
        Rms of a pixel of unit weight (`noise.rms_of`).

    Returns
    -------
    error : ndarray, shape (ny, nx), float32
        `weight` itself: the rms of each pixel, 0 for no data.
    mask : ndarray, shape (ny, nx), bool
        True for no data.
    """
    mask = weight <= 0
    weight[mask] = 1
    np.sqrt(weight, out=weight)
    np.divide(np.float32(rms), weight, out=weight)
    weight[mask] = 0
    return weight, mask


def median(planes: list[np.ndarray], weights: list[np.ndarray]) -> np.ndarray:
    """Return the median over the bands that have weight in a pixel.

    Parameters
    ----------
    planes, weights : list of ndarray, shape (ny, nx), float32
        Image and weight of each band.

    Returns
    -------
    ndarray, shape (ny, nx), float32
        0 where no band has weight.
    """
    return _median(tuple(planes), tuple(weights))


@numba.njit(nogil=True, cache=True)
def _median(planes, weights):
    bands, (ny, nx) = len(planes), planes[0].shape
    out = np.empty((ny, nx), np.float32)
    values = np.empty(bands, np.float32)
    for y in range(ny):
        if bands == 4:
            # mean of the two middle values of four, from a selection network; pixels without all bands are redone below
            for x in range(nx):
                a, b, c, d = planes[0][y, x], planes[1][y, x], planes[2][y, x], planes[3][y, x]
                low = max(min(a, b), min(c, d))
                high = min(max(a, b), max(c, d))
                out[y, x] = (low + high) * np.float32(0.5)
        for x in range(nx):
            complete = bands == 4
            for weight in weights:
                complete &= weight[y, x] > 0
            if complete:
                continue
            count = 0
            for band in range(bands):
                if weights[band][y, x] > 0:
                    value, index = planes[band][y, x], count
                    while index > 0 and values[index - 1] > value:
                        values[index] = values[index - 1]
                        index -= 1
                    values[index] = value
                    count += 1
            out[y, x] = 0
            if count > 0:
                out[y, x] = (values[(count - 1) // 2] + values[count // 2]) * np.float32(0.5)
    return out


def weighted_mean(
    planes: list[np.ndarray], weights: list[np.ndarray], rms: list[float]
) -> tuple[np.ndarray, np.ndarray]:
    """Return the inverse-variance weighted mean over bands, which is optimal for sources with a flat spectrum.

    Parameters
    ----------
    planes, weights : list of ndarray, shape (ny, nx)
        Image and weight of each band.
    rms : list of float
        Rms of a pixel of unit weight in each band; a band with 0 is left out.

    Returns
    -------
    mean : ndarray, shape (ny, nx), float32
        0 where no band has weight.
    total : ndarray, shape (ny, nx), float32
        Sum of the inverse variances.
    """
    total = np.zeros(planes[0].shape)
    mean = np.zeros(planes[0].shape)
    for plane, weight, scale in zip(planes, weights, rms, strict=True):
        if scale > 0:
            share = weight / scale**2
            total += share
            mean += share * plane
    return np.where(total > 0, mean / np.where(total > 0, total, 1), 0).astype(np.float32), total.astype(np.float32)


def pixel_values(plane: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return the values of a plane (ny, nx) in the pixels nearest to positions x and y, (n,) pixels."""
    ix = np.clip(np.rint(x).astype(int), 0, plane.shape[1] - 1)
    iy = np.clip(np.rint(y).astype(int), 0, plane.shape[0] - 1)
    return plane[iy, ix]
