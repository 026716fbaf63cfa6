"""Detection and forced photometry on one tile with sep (Source Extractor as a library)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import sep

from romandask.kernels.measurement import psf_fit
from romandask.kernels.measurement.apertures import blendedness, kron_radii, sums
from romandask.kernels.measurement.measurement_image import MeasurementImage, at
from romandask.kernels.measurement.peaks import find_peaks

KRON_FACTOR, KRON_MIN = 2.5, 3.5
"""Kron aperture: this many Kron radii, and at least this many semi-axes (PHOT_AUTOPARAMS of Source Extractor)."""
REACH, PEAK_REACH = 6.0, 3.5
"""Semi-axes within which the Kron radius is measured: Source Extractor's, of isophotes; and of the larger ones of a
smoothed image, beyond which are a faint object's neighbours and noise."""
NOT_DEBLENDED, NO_DATA, SATURATED_CORE = 256, 512, 1024
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
"""Bits of the flags column: sep's own, then ours."""


@dataclass(frozen=True)
class Found:
    """Objects of a detection image; arrays (n,) in pixels, 0 at the first pixel's centre."""

    label: np.ndarray
    """Number in the segmentation map, from 1."""
    x: np.ndarray
    """Under a window."""
    y: np.ndarray
    barycentre_x: np.ndarray
    """Of the isophote: the middle of its apertures."""
    barycentre_y: np.ndarray
    a: np.ndarray
    b: np.ndarray
    theta: np.ndarray
    x2: np.ndarray
    y2: np.ndarray
    xy: np.ndarray
    kron_radius: np.ndarray
    half_light_radius: np.ndarray
    snr: np.ndarray
    blendedness: np.ndarray
    """Share of the light under the object's Gaussian that is its neighbours'; NaN where there is none."""
    flags: np.ndarray


def detect(
    layer: MeasurementImage, threshold: float, min_area: int, levels: int, contrast: float, min_snr: float
) -> tuple[Found, np.ndarray]:
    """Return the objects of a detection image, with Source Extractor's meaning of the settings, and their map (int32).

    Kept are those whose Kron flux has the least signal to noise. An object too crowded to deblend is measured without
    deblending and flagged; it never ends the run.
    """
    _make_room()
    image, error, mask = layer.image, layer.error, layer.mask
    error[mask] = 1.0
    # smoothed, but with the threshold in units of a pixel's own noise, as Source Extractor has it
    options = {
        "err": error,
        "mask": mask,
        "minarea": min_area,
        "filter_type": "conv",
        "clean": True,
        "segmentation_map": True,
    }
    extra = 0
    try:
        found, segments = sep.extract(image, threshold, deblend_nthresh=levels, deblend_cont=contrast, **options)
    except Exception as overflow:
        # sep raises a bare Exception, whose text is all there is to tell its causes apart
        if "deblending overflow" not in str(overflow) and "limit" not in str(overflow):
            raise
        found, segments = sep.extract(image, threshold, deblend_nthresh=levels, deblend_cont=1.0, **options)
        extra = NOT_DEBLENDED
    error[mask] = 0.0
    objects = _measured(layer, found, segments, min_snr=min_snr)
    return replace(objects, flags=objects.flags | extra), segments


def detect_peaks(layer: MeasurementImage, threshold: float, min_area: int, min_snr: float) -> tuple[Found, np.ndarray]:
    """Return the objects of a detection image that are peaks of it, smoothed with its PSF, and their map (int32).

    Objects that touch are flagged as deblended; `snr` is that of a point source at the peak.
    """
    _make_room()
    peaks = find_peaks(layer, threshold, min_area, min_snr)
    if not len(peaks.snr):
        kinds = [*((name, float) for name in ("x", "y", "a", "b", "theta", "x2", "y2", "xy")), ("flag", int)]
        return _measured(layer, np.zeros(0, kinds), peaks.segments), peaks.segments
    layer.error[layer.mask] = 1.0
    # smoothed as little as Source Extractor does for its moments
    found, _ = sep.extract(
        layer.image,
        threshold,
        err=layer.error,
        mask=layer.mask,
        minarea=1,
        filter_type="conv",
        clean=False,
        segmentation_map=peaks.segments,
    )
    layer.error[layer.mask] = 0.0
    objects = _measured(layer, found, peaks.segments, PEAK_REACH)
    flags = objects.flags | np.where(peaks.touching, sep.OBJ_MERGED, 0).astype(np.int32)
    return replace(objects, snr=peaks.snr.astype(float), flags=flags), peaks.segments


def _make_room() -> None:
    sep.set_extract_pixstack(2_000_000)
    sep.set_sub_object_limit(16_384)


def _measured(
    layer: MeasurementImage, found: np.ndarray, segments: np.ndarray, reach: float = REACH, min_snr: float | None = None
) -> Found:
    """Return what is measured of the objects that sep has found, in the order of their numbers in the map.

    Parameters
    ----------
    reach : semi-axes within which the radius of light is measured
    min_snr : least signal to noise of the Kron flux of those that are returned; None for all
    """
    image, mask = layer.image, layer.mask
    x, y, a, b, theta = (found[name].astype(float) for name in ("x", "y", "a", "b", "theta"))
    # a line of pixels has no width; half a pixel keeps apertures defined
    a, b = np.maximum(np.nan_to_num(a), 0.3), np.maximum(np.nan_to_num(b), 0.3)
    theta = np.clip(np.nan_to_num(theta), -np.pi / 2, np.pi / 2)
    label = np.arange(1, len(x) + 1, dtype=np.int64)
    radius = kron_radii(image, mask, segments, label, x, y, a, b, theta, reach)
    dark = np.where(np.isfinite(radius), 0, sep.APER_NONPOSITIVE)
    radius = np.maximum(KRON_FACTOR * np.nan_to_num(radius), KRON_MIN)
    flux, flux_error, flag = ellipse_flux(layer, segments, label, x, y, a, b, theta, radius)
    with np.errstate(divide="ignore", invalid="ignore"):
        snr = np.where(flux_error > 0, flux / flux_error, 0.0)
    flag = found["flag"] | dark | flag
    if min_snr is not None:
        keep = snr >= min_snr
        # most are noise, and what follows takes most of the time
        x, y, a, b, theta, label, radius, flux, snr, flag, found = (
            values[keep] for values in (x, y, a, b, theta, label, radius, flux, snr, flag, found)
        )
    half, half_flag = sep.flux_radius(
        image, x, y, 6.0 * a + 5, 0.5, normflux=np.where(flux > 0, flux, 1.0), mask=mask, subpix=5
    )
    half = np.where(np.isfinite(half) & (half > 0), half, 1.0)
    blended = blendedness(image, mask, segments, label, x, y, found["x2"], found["y2"], found["xy"])
    xw, yw = _windowed(image, mask, x, y, half)
    return Found(
        label,
        xw,
        yw,
        x,
        y,
        a,
        b,
        theta,
        found["x2"],
        found["y2"],
        found["xy"],
        radius,
        half,
        snr,
        blended,
        (flag | half_flag).astype(np.int32),
    )


def select(found: Found, keep: np.ndarray) -> Found:
    """Return some of the objects."""
    return Found(**{name: value[keep] for name, value in vars(found).items()})


def kron_fluxes(
    layer: MeasurementImage, segments: np.ndarray, found: Found
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return flux, error and flags of a band in the apertures of the detection image, neighbours taken out."""
    shape = (found.a, found.b, found.theta, found.kron_radius)
    return ellipse_flux(layer, segments, found.label, found.barycentre_x, found.barycentre_y, *shape)


def ellipse_flux(
    layer: MeasurementImage, segments, label, x, y, a, b, theta, r
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return flux, error and flags in ellipses of `r` times the semi-axes, neighbours taken out.

    The error counts the correlations of the noise: that of white noise times the ratio measured on random apertures of
    the same area in the noise realisation; and the Poisson noise of the objects.
    """
    if not len(x):
        return np.empty(0), np.empty(0), np.empty(0, int)
    flux, white, flag = sums(layer.image, layer.error, layer.mask, segments, label, x, y, a, b, theta, r)
    correlated = white * layer.ratio(r * np.sqrt(a * b))
    empty = at(layer.mask, x, y)
    return flux, np.sqrt(correlated**2 + layer.poisson(flux, x, y)), flag | np.where(empty, NO_DATA, 0)


def aperture_fluxes(
    layer: MeasurementImage, segments: np.ndarray, found: Found, radius: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return flux and error of every object in a circle (pixels), corrected to the total light of a point source.

    The correction is the share of the PSF image's light inside the circle; no detail of the PSF within it matters.
    """
    if not len(found.x):
        return np.empty(0), np.empty(0)
    middle = (layer.psf.shape[0] - 1) / 2
    psf = np.ascontiguousarray(layer.psf, dtype=np.float32)
    share = float(sep.sum_circle(psf, [middle], [middle], radius, subpix=5)[0][0])
    one = np.ones(len(found.x))
    flux, error, _ = ellipse_flux(layer, segments, found.label, found.x, found.y, one, one, 0 * one, radius * one)
    if not share > 0:
        return np.full(len(flux), np.nan), np.full(len(flux), np.nan)
    return flux / share, error / share


def psf_fluxes(layer: MeasurementImage, found: Found) -> tuple[np.ndarray, np.ndarray]:
    """Return flux and error of every object as a point source: unweighted fit of the PSF in a window."""
    flux, norm = psf_fit.fit(layer.image, layer.psf, found.x, found.y)
    with np.errstate(divide="ignore", invalid="ignore"):
        white = np.where(norm > 0, at(layer.error, found.x, found.y) / np.sqrt(norm), np.nan)
    return flux, np.sqrt((white * layer.psf_ratio) ** 2 + layer.poisson(flux, found.x, found.y))


def psf_half_light_radius(psf: np.ndarray) -> float:
    """Return the radius, pixels, that holds half the light of a PSF image."""
    middle = (psf.shape[0] - 1) / 2
    image = np.ascontiguousarray(psf, dtype=np.float32)
    radius, _ = sep.flux_radius(image, [middle], [middle], [middle], 0.5, subpix=5)
    return float(radius[0])


def _windowed(
    image: np.ndarray, mask: np.ndarray, x: np.ndarray, y: np.ndarray, half: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return positions under a Gaussian window (XWIN, YWIN): neighbours pull barycentres, and less these.

    Where the window wanders off, by more than a pixel or the object's half-light radius, to a brighter neighbour for
    example, the barycentre stays.
    """
    if not len(x):
        return x, y
    xw, yw, _ = sep.winpos(image, x, y, 2.0 / 2.35 * half, mask=mask)
    good = np.hypot(xw - x, yw - y) < np.minimum(half, 1.0)
    return np.where(good, xw, x), np.where(good, yw, y)
