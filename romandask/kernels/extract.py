"""Detection and forced photometry on one tile with sep (Source Extractor as a library)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import sep
from scipy import ndimage

KRON_FACTOR, KRON_MIN = 2.5, 3.5
"""Kron aperture: this many Kron radii, and at least this many pixels."""
NOT_DEBLENDED, NO_DATA = 256, 512
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
}
"""Bits of the flags column: sep's own, then ours."""
PSF_RADIUS = 12
"""Half the side of the window of PSF photometry, pixels."""
_NOISE_RADII = np.array([1.5, 2.5, 4.0, 6.0, 9.0, 14.0, 20.0])
_NOISE_TRIALS = 600


@dataclass(frozen=True)
class Layer:
    """One band of a tile, or its detection image."""

    image: np.ndarray
    """(ny, nx) float32, flux of a pixel."""
    noise: np.ndarray
    """(ny, nx) a realisation of the noise of an empty field."""
    weight: np.ndarray
    """(ny, nx) proportional to the inverse variance of an empty pixel; 0 for no data."""
    seconds: np.ndarray | None
    """(ny, nx) total exposure time, for the Poisson noise of the objects; None for none."""
    rate: float
    """Electrons per second and unit flux."""
    psf: np.ndarray
    """(side, side) unit star."""

    def poisson(self, flux: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Return the variance that the objects' own light adds to their fluxes."""
        if self.seconds is None:
            return np.zeros(len(x))
        return np.maximum(np.nan_to_num(flux), 0) / np.maximum(_at(self.seconds, x, y) * self.rate, 1e-6)

    def error(self) -> np.ndarray:
        """Return the rms of a pixel (float32) from the noise realisation, varying as the weight; 0 for no data."""
        good = self.weight > 0
        if not good.any():
            return np.zeros(self.weight.shape, np.float32)
        scaled = self.noise[good] * np.sqrt(self.weight[good])
        rms = 1.4826 * np.median(np.abs(scaled - np.median(scaled)))
        return np.where(good, rms / np.sqrt(np.where(good, self.weight, 1)), 0).astype(np.float32)


@dataclass(frozen=True)
class Found:
    """Objects of a detection image; arrays (n,) in pixels, 0 at the first pixel's centre."""

    x: np.ndarray
    y: np.ndarray
    a: np.ndarray
    b: np.ndarray
    theta: np.ndarray
    x2: np.ndarray
    y2: np.ndarray
    xy: np.ndarray
    kron_radius: np.ndarray
    half_light_radius: np.ndarray
    snr: np.ndarray
    flags: np.ndarray


def median_layer(layers: list[Layer]) -> Layer:
    """Return the NaN-aware median of bands: pixels without data in a band do not count."""
    image = _median([layer.image for layer in layers], [layer.weight for layer in layers])
    noise = _median([layer.noise for layer in layers], [layer.weight for layer in layers])
    return Layer(image, noise, _mean_weight(layers), None, 0.0, _mean_psf(layers))


def mean_layer(layers: list[Layer]) -> Layer:
    """Return the mean of bands with inverse-variance weights: the best for a flat spectrum."""
    total = np.zeros(layers[0].image.shape)
    image, noise = total.copy(), total.copy()
    for layer in layers:
        error = layer.error()
        weight = np.where(error > 0, 1 / np.where(error > 0, error, 1).astype(float) ** 2, 0)
        total += weight
        image += weight * layer.image
        noise += weight * layer.noise
    good = total > 0
    safe = np.where(good, total, 1)
    return Layer(
        (image / safe).astype(np.float32),
        (noise / safe).astype(np.float32),
        total.astype(np.float32),
        None,
        0.0,
        _mean_psf(layers),
    )


def detect(layer: Layer, threshold: float, min_area: int, levels: int, contrast: float) -> Found:
    """Return the objects of a detection image, with Source Extractor's meaning of the settings.

    An object too crowded to deblend is measured without deblending and flagged; it never ends the run.
    """
    sep.set_extract_pixstack(5_000_000)
    sep.set_sub_object_limit(16_384)
    image = np.ascontiguousarray(layer.image)
    error = layer.error()
    mask = error <= 0
    error[mask] = 1.0
    options = {"err": error, "mask": mask, "minarea": min_area, "clean": True}
    extra = 0
    try:
        found = sep.extract(image, threshold, deblend_nthresh=levels, deblend_cont=contrast, **options)
    except Exception as overflow:
        # sep raises a bare Exception, whose text is all there is to tell its causes apart
        if "deblending overflow" not in str(overflow) and "limit" not in str(overflow):
            raise
        found = sep.extract(image, threshold, deblend_nthresh=levels, deblend_cont=1.0, **options)
        extra = NOT_DEBLENDED
    x, y, a, b, theta = (found[name].astype(float) for name in ("x", "y", "a", "b", "theta"))
    # a line of pixels has no width; half a pixel keeps apertures defined
    a, b = np.maximum(a, 0.3), np.maximum(b, 0.3)
    theta = np.clip(theta, -np.pi / 2, np.pi / 2)
    radius, kron_flag = sep.kron_radius(image, x, y, a, b, theta, 6.0, mask=mask)
    radius = np.where(np.isfinite(radius), radius, 0.0)
    radius = np.maximum(KRON_FACTOR * radius, KRON_MIN / np.sqrt(a * b))
    flux, flux_error, flag = ellipse_flux(layer, error, x, y, a, b, theta, radius)
    half, half_flag = sep.flux_radius(
        image, x, y, 6.0 * a + 5, 0.5, normflux=np.where(flux > 0, flux, 1.0), mask=mask, subpix=5
    )
    with np.errstate(divide="ignore", invalid="ignore"):
        snr = np.where(flux_error > 0, flux / flux_error, 0.0)
    half = np.where(np.isfinite(half) & (half > 0), half, 1.0)
    x, y = _windowed(image, mask, x, y, half)
    return Found(
        x, y, a, b, theta, found["x2"], found["y2"], found["xy"], radius, half, snr,
        (found["flag"] | kron_flag | flag | half_flag).astype(np.int32) | extra,
    )  # fmt: skip


def select(found: Found, keep: np.ndarray) -> Found:
    """Return some of the objects."""
    return Found(**{name: value[keep] for name, value in vars(found).items()})


def kron_fluxes(layer: Layer, found: Found) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return flux, error and flags of a band in the apertures of the detection image."""
    return ellipse_flux(layer, layer.error(), found.x, found.y, found.a, found.b, found.theta, found.kron_radius)


def ellipse_flux(layer: Layer, error: np.ndarray, x, y, a, b, theta, r) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return flux, error and flags in ellipses of `r` times the semi-axes.

    The error counts the correlations of the noise: that of white noise times the ratio measured on random apertures of
    the same area in the noise realisation; and the Poisson noise of the objects.
    """
    if not len(x):
        return np.empty(0), np.empty(0), np.empty(0, int)
    mask = layer.weight <= 0
    flux, white, flag = sep.sum_ellipse(layer.image, x, y, a, b, theta, r, err=error, mask=mask, subpix=5)
    ratio = np.interp(r * np.sqrt(a * b), _NOISE_RADII, noise_ratios(layer, error))
    empty = _at(layer.weight, x, y) <= 0
    return flux, np.sqrt((white * ratio) ** 2 + layer.poisson(flux, x, y)), flag | np.where(empty, NO_DATA, 0)


def noise_ratios(layer: Layer, error: np.ndarray) -> np.ndarray:
    """Return, by radius of _NOISE_RADII, the scatter of apertures on the noise realisation over that of white noise."""
    ratios = np.ones(len(_NOISE_RADII))
    ny, nx = layer.noise.shape
    mask = layer.weight <= 0
    # the positions only sample the realisation: any fixed sequence will do
    random = np.random.default_rng(0)
    for k, radius in enumerate(_NOISE_RADII):
        if min(ny, nx) < 4 * radius:
            ratios[k:] = ratios[max(k - 1, 0)]
            break
        x = random.uniform(radius, nx - 1 - radius, _NOISE_TRIALS)
        y = random.uniform(radius, ny - 1 - radius, _NOISE_TRIALS)
        flux, white, flag = sep.sum_circle(
            np.ascontiguousarray(layer.noise), x, y, radius, err=error, mask=mask, subpix=5
        )
        good = (flag == 0) & (white > 0)
        if good.sum() > 50:
            ratios[k] = np.std(flux[good] / white[good])
    return ratios


def aperture_fluxes(layer: Layer, found: Found, radius: float) -> tuple[np.ndarray, np.ndarray]:
    """Return flux and error of every object in a circle (pixels), corrected to the total light of a point source.

    The correction is the share of the PSF image's light inside the circle; no detail of the PSF within it matters.
    """
    if not len(found.x):
        return np.empty(0), np.empty(0)
    middle = (layer.psf.shape[0] - 1) / 2
    psf = np.ascontiguousarray(layer.psf, dtype=np.float32)
    share = float(sep.sum_circle(psf, [middle], [middle], radius, subpix=5)[0][0])
    error, mask = layer.error(), layer.weight <= 0
    flux, white, _ = sep.sum_circle(layer.image, found.x, found.y, radius, err=error, mask=mask, subpix=5)
    ratio = np.interp(radius, _NOISE_RADII, noise_ratios(layer, error))
    if not share > 0:
        return np.full(len(flux), np.nan), np.full(len(flux), np.nan)
    return flux / share, np.sqrt((white * ratio) ** 2 + layer.poisson(flux, found.x, found.y)) / share


def psf_fluxes(layer: Layer, found: Found) -> tuple[np.ndarray, np.ndarray]:
    """Return flux and error of every object as a point source: unweighted fit of the PSF in a window."""
    error = layer.error()
    flux, norm = _psf_fit(layer.image, layer.psf, found.x, found.y)
    random = np.random.default_rng(0)
    ny, nx = layer.noise.shape
    x, y = (random.uniform(PSF_RADIUS, n - 1 - PSF_RADIUS, _NOISE_TRIALS) for n in (nx, ny))
    trial, trial_norm = _psf_fit(layer.noise, layer.psf, x, y)
    pixel = _at(error, x, y)
    good = (pixel > 0) & (trial_norm > 0)
    ratio = np.std(trial[good] * np.sqrt(trial_norm[good]) / pixel[good]) if good.sum() > 50 else 1.0
    with np.errstate(divide="ignore", invalid="ignore"):
        white = np.where(norm > 0, _at(error, found.x, found.y) / np.sqrt(norm), np.nan)
    return flux, np.sqrt((white * ratio) ** 2 + layer.poisson(flux, found.x, found.y))


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

    Where the window wanders off by more than the object's half-light radius the barycentre stays.
    """
    if not len(x):
        return x, y
    xw, yw, _ = sep.winpos(image, x, y, 2.0 / 2.35 * half, mask=mask)
    good = np.hypot(xw - x, yw - y) < half
    return np.where(good, xw, x), np.where(good, yw, y)


def _psf_fit(image: np.ndarray, psf: np.ndarray, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return sum(P d) / sum(P^2) and sum(P^2) with the PSF shifted to each position; NaN and 0 near the edge."""
    flux, norm = np.full(len(x), np.nan), np.zeros(len(x))
    offset = np.arange(-PSF_RADIUS, PSF_RADIUS + 1)
    middle = (psf.shape[0] - 1) / 2
    smooth = ndimage.spline_filter(psf.astype(float), order=5)
    ix, iy = np.rint(x).astype(int), np.rint(y).astype(int)
    inside = (
        (ix >= PSF_RADIUS)
        & (iy >= PSF_RADIUS)
        & (ix < image.shape[1] - PSF_RADIUS)
        & (iy < image.shape[0] - PSF_RADIUS)
    )
    rows = np.flatnonzero(inside)
    for first in range(0, len(rows), 512):
        part = rows[first : first + 512]
        u = middle + (ix - x)[part, None, None] + offset[None, None, :]
        v = middle + (iy - y)[part, None, None] + offset[None, :, None]
        model = ndimage.map_coordinates(smooth, np.broadcast_arrays(v, u), order=5, prefilter=False)
        data = image[(iy[part, None] + offset)[:, :, None], (ix[part, None] + offset)[:, None, :]]
        norm[part] = (model**2).sum(axis=(1, 2))
        flux[part] = (model * data).sum(axis=(1, 2)) / np.where(norm[part] > 0, norm[part], np.nan)
    return flux, norm


def _at(plane: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    ix = np.clip(np.rint(x).astype(int), 0, plane.shape[1] - 1)
    iy = np.clip(np.rint(y).astype(int), 0, plane.shape[0] - 1)
    return plane[iy, ix]


def _median(planes: list[np.ndarray], weights: list[np.ndarray]) -> np.ndarray:
    """Return the median over bands, by blocks of rows; a band counts where it has weight, and 0 stands for no data."""
    out = np.empty(planes[0].shape, np.float32)
    for first in range(0, len(out), 256):
        rows = slice(first, first + 256)
        values = np.stack([np.where(w[rows] > 0, p[rows], np.inf) for p, w in zip(planes, weights, strict=True)])
        values.sort(axis=0)
        count = np.isfinite(values).sum(axis=0)
        middle = [np.take_along_axis(values, np.maximum(k, 0)[None], axis=0)[0] for k in ((count - 1) // 2, count // 2)]
        with np.errstate(invalid="ignore"):
            out[rows] = np.where(count > 0, (middle[0] + middle[1]) / 2, 0)
    return out


def _mean_weight(layers: list[Layer]) -> np.ndarray:
    total = np.zeros(layers[0].weight.shape, np.float32)
    for layer in layers:
        if (layer.weight > 0).any():
            total += layer.weight / np.median(layer.weight[layer.weight > 0])
    return total / len(layers)


def _mean_psf(layers: list[Layer]) -> np.ndarray:
    return np.mean([layer.psf for layer in layers], axis=0)
