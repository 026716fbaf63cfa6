"""Detection and forced photometry of one tile with sep (Source Extractor as a library)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import sep

from romandask.kernels.measurement import psf_fit
from romandask.kernels.measurement.apertures import aperture_sums, blendedness, kron_radii
from romandask.kernels.measurement.measurement_image import MeasurementImage, pixel_values
from romandask.kernels.measurement.peaks import find_peaks

KRON_FACTOR, KRON_MIN = 2.5, 3.5
"""Radius of the Kron aperture: this many Kron radii, and at least this many semi-axes (PHOT_AUTOPARAMS of Source
Extractor)."""
KRON_REACH, PEAK_KRON_REACH = 6.0, 3.5
"""Elliptical radius within which the Kron radius is measured, semi-axes: the value of Source Extractor for isophotes,
and a smaller one for the larger segments of the PSF-smoothed image, beyond which there are neighbours and noise."""
NOT_DEBLENDED, NO_DATA, SATURATED_CORE = 256, 512, 1024
"""Bits of the flags column beyond those of sep."""
FLAGS = {
    "deblended": sep.OBJ_MERGED,
    "truncated": sep.OBJ_TRUNC,
    "deblend_overflow": sep.OBJ_DOVERFLOW,
    "singular": sep.OBJ_SINGU,
    "aperture_truncated": sep.APER_TRUNC,
    "aperture_masked": sep.APER_HASMASKED,
    "aperture_all_masked": sep.APER_ALLMASKED,
    "kron_nonpositive": sep.APER_NONPOSITIVE,
    "not_deblended": NOT_DEBLENDED,
    "no_data": NO_DATA,
    "saturated": SATURATED_CORE,
}
"""Bits of the flags column, by name: those of sep, then NOT_DEBLENDED, NO_DATA and SATURATED_CORE."""


@dataclass(frozen=True, kw_only=True)
class DetectedObjects:
    """Objects of a detection image; all arrays are of shape (n,), positions 0 at the centre of the first pixel."""

    label: np.ndarray
    """Number in the segmentation map, from 1."""
    x: np.ndarray
    """x under a Gaussian window (XWIN), pixels."""
    y: np.ndarray
    """y under a Gaussian window (YWIN), pixels."""
    barycentre_x: np.ndarray
    """x of the barycentre of the isophote, the centre of the apertures, pixels."""
    barycentre_y: np.ndarray
    """y of the barycentre of the isophote, pixels."""
    a: np.ndarray
    """Semi-major axis, pixels."""
    b: np.ndarray
    """Semi-minor axis, pixels."""
    theta: np.ndarray
    """Angle of the major axis from the x axis, radians."""
    x2: np.ndarray
    """Second moment in x, pixels^2."""
    y2: np.ndarray
    """Second moment in y, pixels^2."""
    xy: np.ndarray
    """Mixed second moment, pixels^2."""
    kron_radius: np.ndarray
    """Radius of the Kron aperture, semi-axes."""
    half_light_radius: np.ndarray
    """Radius of the circle that holds half of the Kron flux, pixels; 1 where it cannot be measured."""
    snr: np.ndarray
    """Signal to noise: of the Kron flux (`detect`), or of a point source at the peak (`detect_peaks`)."""
    blendedness: np.ndarray
    """Share of the light at the object that belongs to its neighbours; NaN where there is no light."""
    flags: np.ndarray
    """Bits of FLAGS."""


def detect(
    measurement: MeasurementImage, threshold: float, min_area: int, levels: int, contrast: float, min_snr: float
) -> tuple[DetectedObjects, np.ndarray]:
    """Detect objects as Source Extractor does: connected pixels above a threshold, deblended.

    If an object is too crowded for sep to deblend, the whole image is detected without deblending and its objects are
    flagged as NOT_DEBLENDED.

    Parameters
    ----------
    measurement : MeasurementImage
        Detection image.
    threshold : float
        Detection threshold of the smoothed image, in units of the rms of an unsmoothed pixel (DETECT_THRESH).
    min_area : int
        Smallest number of pixels of an object (DETECT_MINAREA).
    levels : int
        Number of deblending levels (DEBLEND_NTHRESH).
    contrast : float
        Smallest contrast of a deblended object (DEBLEND_MINCONT).
    min_snr : float
        Smallest signal to noise of the Kron flux of the objects that are kept.

    Returns
    -------
    objects : DetectedObjects
    segments : ndarray, shape (ny, nx), int32
        Number of the object in whose isophote a pixel lies, 0 for none; objects that are not kept included.
    """
    _raise_sep_limits()
    image, error, mask = measurement.image, measurement.error, measurement.mask
    error[mask] = 1.0
    # "conv" smooths the image and keeps the threshold in units of the noise of an unsmoothed pixel, as Source
    # Extractor does
    options = {
        "err": error,
        "mask": mask,
        "minarea": min_area,
        "filter_type": "conv",
        "clean": True,
        "segmentation_map": True,
    }
    extra_flag = 0
    try:
        detected, segments = sep.extract(image, threshold, deblend_nthresh=levels, deblend_cont=contrast, **options)
    except Exception as overflow:
        # sep raises a bare Exception: only its message distinguishes the causes
        if "deblending overflow" not in str(overflow) and "limit" not in str(overflow):
            raise
        detected, segments = sep.extract(image, threshold, deblend_nthresh=levels, deblend_cont=1.0, **options)
        extra_flag = NOT_DEBLENDED
    error[mask] = 0.0
    objects = _measure(measurement, detected, segments, min_snr=min_snr)
    return replace(objects, flags=objects.flags | extra_flag), segments


def detect_peaks(
    measurement: MeasurementImage, threshold: float, min_area: int, min_snr: float
) -> tuple[DetectedObjects, np.ndarray]:
    """Detect objects as peaks of the PSF-smoothed image.

    Objects whose pixels touch those of another are flagged as deblended. Their `snr` is that of a point source at the
    peak.

    Parameters
    ----------
    measurement, threshold, min_area, min_snr
        As in `peaks.find_peaks`.

    Returns
    -------
    objects : DetectedObjects
    segments : ndarray, shape (ny, nx), int32
        Number of the object to whose peak a pixel belongs, 0 for none.
    """
    _raise_sep_limits()
    peaks = find_peaks(measurement, threshold, min_area, min_snr)
    if not len(peaks.snr):
        fields = [*((name, float) for name in ("x", "y", "a", "b", "theta", "x2", "y2", "xy")), ("flag", int)]
        return _measure(measurement, np.zeros(0, fields), peaks.segments), peaks.segments
    measurement.error[measurement.mask] = 1.0
    # moments of the image smoothed with the small default kernel, as in Source Extractor
    detected, _ = sep.extract(
        measurement.image,
        threshold,
        err=measurement.error,
        mask=measurement.mask,
        minarea=1,
        filter_type="conv",
        clean=False,
        segmentation_map=peaks.segments,
    )
    measurement.error[measurement.mask] = 0.0
    objects = _measure(measurement, detected, peaks.segments, PEAK_KRON_REACH)
    flags = objects.flags | np.where(peaks.touching, sep.OBJ_MERGED, 0).astype(np.int32)
    return replace(objects, snr=peaks.snr.astype(float), flags=flags), peaks.segments


def _raise_sep_limits() -> None:
    """Raise the limits of sep on the pixels and on the objects in one detection."""
    sep.set_extract_pixstack(2_000_000)
    sep.set_sub_object_limit(16_384)


def _measure(
    measurement: MeasurementImage,
    detected: np.ndarray,
    segments: np.ndarray,
    reach: float = KRON_REACH,
    min_snr: float | None = None,
) -> DetectedObjects:
    """Measure the objects that sep has detected, in the order of their numbers in the segmentation map.

    Parameters
    ----------
    measurement : MeasurementImage
        Detection image.
    detected : structured ndarray, shape (n,)
        Objects as `sep.extract` returns them.
    segments : ndarray, shape (ny, nx), int32
        Segmentation map.
    reach : float, semi-axes
        Elliptical radius within which the Kron radius is measured.
    min_snr : float, optional
        Smallest signal to noise of the Kron flux of the objects that are returned; None for all objects.
    """
    image, mask = measurement.image, measurement.mask
    x, y, a, b, theta = (detected[name].astype(float) for name in ("x", "y", "a", "b", "theta"))
    # a line of pixels has no width: a least semi-axis keeps apertures defined
    a, b = np.maximum(np.nan_to_num(a), 0.3), np.maximum(np.nan_to_num(b), 0.3)
    theta = np.clip(np.nan_to_num(theta), -np.pi / 2, np.pi / 2)
    label = np.arange(1, len(x) + 1, dtype=np.int64)
    radius = kron_radii(image, mask, segments, label, x, y, a, b, theta, reach)
    nonpositive = np.where(np.isfinite(radius), 0, sep.APER_NONPOSITIVE)
    radius = np.maximum(KRON_FACTOR * np.nan_to_num(radius), KRON_MIN)
    flux, flux_error, flag = ellipse_flux(measurement, segments, label, x, y, a, b, theta, radius)
    with np.errstate(divide="ignore", invalid="ignore"):
        snr = np.where(flux_error > 0, flux / flux_error, 0.0)
    flag = detected["flag"] | nonpositive | flag
    if min_snr is not None:
        keep = snr >= min_snr
        # most objects are noise, and the measurements below take most of the time
        x, y, a, b, theta, label, radius, flux, snr, flag, detected = (
            values[keep] for values in (x, y, a, b, theta, label, radius, flux, snr, flag, detected)
        )
    half, half_flag = sep.flux_radius(
        image, x, y, 6.0 * a + 5, 0.5, normflux=np.where(flux > 0, flux, 1.0), mask=mask, subpix=5
    )
    half = np.where(np.isfinite(half) & (half > 0), half, 1.0)
    blended = blendedness(image, mask, segments, label, x, y, detected["x2"], detected["y2"], detected["xy"])
    xw, yw = _windowed(image, mask, x, y, half)
    return DetectedObjects(
        label=label,
        x=xw,
        y=yw,
        barycentre_x=x,
        barycentre_y=y,
        a=a,
        b=b,
        theta=theta,
        x2=detected["x2"],
        y2=detected["y2"],
        xy=detected["xy"],
        kron_radius=radius,
        half_light_radius=half,
        snr=snr,
        blendedness=blended,
        flags=(flag | half_flag).astype(np.int32),
    )


def select(objects: DetectedObjects, keep: np.ndarray) -> DetectedObjects:
    """Return the objects for which `keep`, (n,) bool, is True."""
    return DetectedObjects(**{name: value[keep] for name, value in vars(objects).items()})


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


def _windowed(
    image: np.ndarray, mask: np.ndarray, x: np.ndarray, y: np.ndarray, half: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return positions under a Gaussian window (XWIN, YWIN), which neighbours affect less than barycentres.

    An object keeps its barycentre (x, y) where the window moves away from it, for example to a brighter neighbour, by
    more than a pixel or by more than its half-light radius `half`.
    """
    if not len(x):
        return x, y
    xw, yw, _ = sep.winpos(image, x, y, 2.0 / 2.35 * half, mask=mask)
    good = np.hypot(xw - x, yw - y) < np.minimum(half, 1.0)
    return np.where(good, xw, x), np.where(good, yw, y)
