"""Detection and forced photometry of one tile with sep (Source Extractor as a library)."""

from __future__ import annotations

from dataclasses import replace
from threading import Lock
from typing import Any

import numpy as np
import sep

from romandask.kernels.measurement.apertures import blendedness, kron_radii
from romandask.kernels.measurement.blends import deblend_each
from romandask.kernels.measurement.detected_objects import NOT_DEBLENDED, WHOLE, DetectedObjects, Part, Window
from romandask.kernels.measurement.measurement_image import MeasurementImage
from romandask.kernels.measurement.peaks import find_peaks
from romandask.kernels.measurement.photometry import ellipse_flux

KRON_FACTOR, KRON_MIN = 2.5, 3.5
"""Radius of the Kron aperture: this many Kron radii, and at least this many semi-axes (PHOT_AUTOPARAMS of Source
Extractor)."""
KRON_REACH, PEAK_KRON_REACH = 6.0, 3.5
"""Elliptical radius within which the Kron radius is measured, semi-axes: the value of Source Extractor for isophotes,
and a smaller one for the larger segments of the PSF-smoothed image, beyond which there are neighbours and noise."""
_SEP_LIMITS = Lock()


def detect(
    measurement: MeasurementImage,
    threshold: float,
    min_area: int,
    levels: int,
    contrast: float,
    min_snr: float,
    part: Part | None = None,
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
    part : Part, optional
        Place of the detection image in a larger one; by default it is the whole image.

    Returns
    -------
    objects : DetectedObjects
    segments : ndarray, shape (ny, nx), int32
        Number (`DetectedObjects.label`) of the object in whose isophote a pixel lies, 0 for none; objects that are not
        kept or measured included.
    """
    image, error, mask = measurement.image, measurement.error, measurement.mask
    error[mask] = 1.0
    # "conv" smooths the image and keeps the threshold in units of the noise of an unsmoothed pixel, as Source
    # Extractor does
    options = {"minarea": min_area, "filter_type": "conv", "segmentation_map": True}
    extra_flag = 0

    def extract(window: Window, clean: bool = False) -> tuple[np.ndarray, np.ndarray]:
        planes = {name: np.ascontiguousarray(plane[window]) for name, plane in (("err", error), ("mask", mask))}
        part = np.ascontiguousarray(image[window])
        return _extract(
            part, threshold, clean=clean, deblend_nthresh=levels, deblend_cont=contrast, **options, **planes
        )

    try:
        detected, segments = extract(WHOLE, clean=True)
        detected, segments = deblend_each(detected, segments, extract)
    except Exception as overflow:
        # sep raises a bare Exception: only its message distinguishes the causes
        if "deblending overflow" not in str(overflow) and "limit" not in str(overflow):
            raise
        detected, segments = _extract(image, threshold, err=error, mask=mask, clean=True, deblend_cont=1.0, **options)
        extra_flag = NOT_DEBLENDED
    error[mask] = 0.0
    part = part or whole(image)
    inside = part.contains(detected["xpeak"], detected["ypeak"], image.shape)
    objects = _measure(measurement, detected, segments, inside, min_snr=min_snr)
    numbers = part.numbers(detected["xpeak"], detected["ypeak"])
    return _numbered(replace(objects, flags=objects.flags | extra_flag), segments, numbers)


def detect_peaks(
    measurement: MeasurementImage, threshold: float, min_area: int, min_snr: float, part: Part | None = None
) -> tuple[DetectedObjects, np.ndarray]:
    """Detect objects as peaks of the PSF-smoothed image.

    Objects whose pixels touch those of another are flagged as deblended. Their `snr` is that of a point source at the
    peak.

    Parameters
    ----------
    measurement, threshold, min_area, min_snr
        As in `peaks.find_peaks`.
    part : Part, optional
        As in `detect`.

    Returns
    -------
    objects : DetectedObjects
    segments : ndarray, shape (ny, nx), int32
        Number (`DetectedObjects.label`) of the object to whose peak a pixel belongs, 0 for none.
    """
    peaks = find_peaks(measurement, threshold, min_area, min_snr)
    if not len(peaks.snr):
        fields = [*((name, float) for name in ("x", "y", "a", "b", "theta", "x2", "y2", "xy")), ("flag", int)]
        return _measure(measurement, np.zeros(0, fields), peaks.segments, np.zeros(0, bool)), peaks.segments
    measurement.error[measurement.mask] = 1.0
    # moments of the image smoothed with the small default kernel, as in Source Extractor
    detected, _ = _extract(
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
    part = part or whole(measurement.image)
    inside = part.contains(peaks.x, peaks.y, measurement.image.shape)
    objects = _measure(measurement, detected, peaks.segments, inside, PEAK_KRON_REACH)
    flags = objects.flags | np.where(peaks.touching[inside], sep.OBJ_MERGED, 0).astype(np.int32)
    objects = replace(objects, snr=peaks.snr[inside].astype(float), flags=flags)
    return _numbered(objects, peaks.segments, part.numbers(peaks.x, peaks.y))


def whole(image: np.ndarray) -> Part:
    """Return the part that is the whole of an image (ny, nx)."""
    return Part(width=image.shape[1], x=0, y=0, inner=WHOLE)


def _numbered(
    objects: DetectedObjects, segments: np.ndarray, numbers: np.ndarray
) -> tuple[DetectedObjects, np.ndarray]:
    """Return objects and segmentation map with the running number k of an object replaced by numbers[k - 1]."""
    numbers = np.concatenate([np.zeros(1, np.int32), numbers])
    return replace(objects, label=numbers[objects.label]), numbers[segments]


def _extract(image: np.ndarray, *arguments: Any, **options: Any) -> tuple[np.ndarray, np.ndarray]:
    """Call `sep.extract` with the limits of sep raised on the pixels and on the objects in one detection.

    The limits are global in sep, so threads take turns. sep writes all pixels that the limit allows in each call:
    the limit of a small image is small.
    """
    with _SEP_LIMITS:
        sep.set_extract_pixstack(min(max(4 * image.size, 10_000), 2_000_000))
        sep.set_sub_object_limit(16_384)
        return sep.extract(image, *arguments, **options)


def _measure(
    measurement: MeasurementImage,
    detected: np.ndarray,
    segments: np.ndarray,
    inside: np.ndarray,
    reach: float = KRON_REACH,
    min_snr: float | None = None,
) -> DetectedObjects:
    """Measure some of the objects that sep has detected, in the order of their numbers in the segmentation map.

    Parameters
    ----------
    measurement : MeasurementImage
        Detection image.
    detected : structured ndarray, shape (n,)
        Objects as `sep.extract` returns them.
    segments : ndarray, shape (ny, nx), int32
        Segmentation map.
    inside : ndarray of bool, shape (n,)
        True for the objects to measure.
    reach : float, semi-axes
        Elliptical radius within which the Kron radius is measured.
    min_snr : float, optional
        Smallest signal to noise of the Kron flux of the objects that are returned; None for all objects.
    """
    image, mask = measurement.image, measurement.mask
    label = np.flatnonzero(inside) + 1
    detected = detected[inside]
    x, y, a, b, theta = (detected[name].astype(float) for name in ("x", "y", "a", "b", "theta"))
    # a line of pixels has no width: a least semi-axis keeps apertures defined
    a, b = np.maximum(np.nan_to_num(a), 0.3), np.maximum(np.nan_to_num(b), 0.3)
    theta = np.clip(np.nan_to_num(theta), -np.pi / 2, np.pi / 2)
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
        x, y, a, b, theta, label, radius, flux, snr, flag = (
            values[keep] for values in (x, y, a, b, theta, label, radius, flux, snr, flag)
        )
        detected = detected[keep]
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
