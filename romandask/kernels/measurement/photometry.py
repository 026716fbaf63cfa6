"""Fluxes of objects in a band: in Kron and circular apertures, with neighbours replaced, and by fits of the PSF."""

from __future__ import annotations

import numpy as np
import sep

from romandask.kernels.measurement import psf_fit
from romandask.kernels.measurement.apertures import aperture_sums
from romandask.kernels.measurement.detected_objects import NO_DATA, DetectedObjects
from romandask.kernels.measurement.measurement_image import MeasurementImage, pixel_values


def kron_fluxes(
    measurement: MeasurementImage, segments: np.ndarray, objects: DetectedObjects
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the fluxes of a band in the Kron apertures of the detection image, with neighbours replaced.

    Parameters
    ----------
    measurement : MeasurementImage
        The band.
    segments : ndarray, shape (ny, nx)
        Segmentation map of the detection image.
    objects : DetectedObjects

    Returns
    -------
    flux, error : ndarray, shape (n,)
    flags : ndarray, shape (n,), int
        Bits of FLAGS.
    """
    shape = (objects.a, objects.b, objects.theta, objects.kron_radius)
    return ellipse_flux(measurement, segments, objects.label, objects.barycentre_x, objects.barycentre_y, *shape)


def ellipse_flux(
    measurement: MeasurementImage, segments, label, x, y, a, b, theta, r
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the fluxes in elliptical apertures, with neighbours replaced.

    The error includes the correlation of the noise and the Poisson noise of the sources. The former is the error for
    white noise times the ratio measured in random apertures of the same area in the noise realisation.

    Parameters
    ----------
    measurement : MeasurementImage
    segments : ndarray, shape (ny, nx)
        Segmentation map.
    label : ndarray, shape (n,)
        Number of each object in the map.
    x, y, a, b : ndarray, shape (n,), pixels
        Centres and semi-axes.
    theta : ndarray, shape (n,), radians
    r : ndarray, shape (n,), semi-axes
        Elliptical radius of each aperture.

    Returns
    -------
    flux, error : ndarray, shape (n,)
    flags : ndarray, shape (n,), int
        Bits of FLAGS.
    """
    if not len(x):
        return np.empty(0), np.empty(0), np.empty(0, int)
    flux, white, flag = aperture_sums(
        measurement.image, measurement.error, measurement.mask, segments, label, x, y, a, b, theta, r
    )
    correlated = white * measurement.aperture_ratio(r * np.sqrt(a * b))
    empty = pixel_values(measurement.mask, x, y)
    return flux, np.sqrt(correlated**2 + measurement.source_variance(flux, x, y)), flag | np.where(empty, NO_DATA, 0)


def aperture_fluxes(
    measurement: MeasurementImage, segments: np.ndarray, objects: DetectedObjects, radius: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return the fluxes in circular apertures, corrected to the total flux of a point source.

    The correction is the share of the light of the PSF image inside the circle. It does not depend on details of the
    PSF within the circle.

    Parameters
    ----------
    measurement, segments, objects
        As in `kron_fluxes`.
    radius : float, pixels
        Radius of the circle.

    Returns
    -------
    flux, error : ndarray, shape (n,)
        NaN if the PSF has no light in the circle.
    """
    if not len(objects.x):
        return np.empty(0), np.empty(0)
    middle = (measurement.psf.shape[0] - 1) / 2
    psf = np.ascontiguousarray(measurement.psf, dtype=np.float32)
    share = float(sep.sum_circle(psf, [middle], [middle], radius, subpix=5)[0][0])
    ones = np.ones(len(objects.x))
    flux, error, _ = ellipse_flux(
        measurement, segments, objects.label, objects.x, objects.y, ones, ones, 0 * ones, radius * ones
    )
    if not share > 0:
        return np.full(len(flux), np.nan), np.full(len(flux), np.nan)
    return flux / share, error / share


def psf_fluxes(measurement: MeasurementImage, objects: DetectedObjects) -> tuple[np.ndarray, np.ndarray]:
    """Return flux and error, (n,), of objects as point sources, from unweighted fits of the PSF in a window."""
    flux, norm = psf_fit.fit(measurement.image, measurement.psf, objects.x, objects.y)
    with np.errstate(divide="ignore", invalid="ignore"):
        white = np.where(norm > 0, pixel_values(measurement.error, objects.x, objects.y) / np.sqrt(norm), np.nan)
    return flux, np.sqrt((white * measurement.psf_ratio) ** 2 + measurement.source_variance(flux, objects.x, objects.y))


def psf_half_light_radius(psf: np.ndarray) -> float:
    """Return the radius, pixels, that holds half the light of a PSF image."""
    middle = (psf.shape[0] - 1) / 2
    image = np.ascontiguousarray(psf, dtype=np.float32)
    radius, _ = sep.flux_radius(image, [middle], [middle], [middle], 0.5, subpix=5)
    return float(radius[0])
