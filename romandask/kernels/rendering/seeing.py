"""PSFs of a ground-based telescope: transforms of seeing, and variation of size and shape over the field of view."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import gamma, kv

from romandask.kernels.rendering.psf import CORE, Grid, PsfModel, Variation, model, pixel_response

FIELD_RADIUS = 1.75 * 3600
"""Radius of the field of view, arcsec."""
TELESCOPE_SIZE_GROWTH = 0.19
"""Growth of the variance of the telescope's PSF from the centre of the field to its edge, relative to its mean.

An assumption: optics of 0.1 arcsec at the centre and 0.2 arcsec at the edge, out of 0.4 arcsec in all."""
TELESCOPE_RADIAL_ELLIPTICITY = 0.03
"""Radial ellipticity of the telescope's PSF at the edge of the field, in units of its variance."""
TELESCOPE_ELLIPTICITY_RMS = 0.05
"""Rms ellipticity of the telescope's PSF due to the alignment of a visit, in units of its variance.

Half of the ellipticity's variance is constant over the field, half is a gradient."""
ATMOSPHERE_RMS = 0.02
"""Rms variation of the size and of both ellipticities of the atmosphere's PSF, in units of its variance.

An assumption: 30 s of turbulence leave a few hundredths that do not average out."""
N_WAVES = 16
"""Number of plane waves that make up the pattern of the atmosphere, for the size and for each ellipticity."""
MIN_WAVELENGTH, MAX_WAVELENGTH = 0.2 * 3600, 3.0 * 3600
"""Range of the wavelengths of these plane waves on the sky, arcsec."""


@dataclass(frozen=True)
class Pattern:
    """Variation of the PSF of one visit over the field of view.

    The PSF has two parts, those of the telescope and of the atmosphere. Covariances are in units of the mean variance
    of the part.
    """

    alignment: np.ndarray
    """Ellipticities (plus, cross) of the telescope's part, shape (2, 3): constant, and gradients along x and y per
    field radius."""
    waves: np.ndarray
    """Plane waves of the size and the two ellipticities of the atmosphere, shape (3, N_WAVES, 3): frequencies along x
    and y (radians per arcsec), and phase (radians)."""

    def telescope(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Return the covariance of the telescope's part.

        Parameters
        ----------
        x, y : array, shape (n,), arcsec
            Positions in the field of view, relative to the boresight.

        Returns
        -------
        array, shape (n, 3)
            xx, yy and xy, in units of the mean variance.
        """
        u, v = np.asarray(x, float) / FIELD_RADIUS, np.asarray(y, float) / FIELD_RADIUS
        size = 1 + TELESCOPE_SIZE_GROWTH * (u**2 + v**2 - 0.5)
        basis = np.stack([np.ones_like(u), u, v])
        plus, cross = self.alignment @ basis
        plus = plus + TELESCOPE_RADIAL_ELLIPTICITY * (u**2 - v**2)
        cross = cross + TELESCOPE_RADIAL_ELLIPTICITY * 2 * u * v
        return np.stack([size + plus, size - plus, cross], axis=-1)

    def atmosphere(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Return the difference of the atmosphere's covariance from that of its mean, round PSF.

        Arguments and returned array are those of `telescope`.
        """
        position = np.stack([np.asarray(x, float), np.asarray(y, float)])
        phase = self.waves[..., :2] @ position + self.waves[..., 2:]
        size, plus, cross = ATMOSPHERE_RMS * np.sqrt(2 / N_WAVES) * np.cos(phase).sum(axis=1)
        return np.stack([size + plus, size - plus, cross], axis=-1)


def pattern(random: np.random.Generator) -> Pattern:
    """Return a random pattern for a visit."""
    alignment = TELESCOPE_ELLIPTICITY_RMS * np.sqrt(0.5) * random.standard_normal((2, 3))
    wavelength = np.exp(random.uniform(np.log(MIN_WAVELENGTH), np.log(MAX_WAVELENGTH), (3, N_WAVES)))
    angle, phase = random.uniform(0, 2 * np.pi, (2, 3, N_WAVES))
    frequency = 2 * np.pi / wavelength
    return Pattern(alignment, np.stack([frequency * np.cos(angle), frequency * np.sin(angle), phase], axis=-1))


def kolmogorov_transfer(frequency: np.ndarray, atmosphere: np.ndarray, system: np.ndarray) -> np.ndarray:
    """Return the transform of a PSF of Kolmogorov seeing convolved with a Gaussian.

    The transform of Kolmogorov seeing is exp(-3.4419 (k lambda / 2 pi r0)^(5/3)) with FWHM = 0.97586 lambda / r0
    (Fried 1966; the constants are those of GalSim).

    Parameters
    ----------
    frequency : array, radians/arcsec
        Radial frequencies k, that is 2 pi over the period.
    atmosphere : array, arcsec
        FWHM of the seeing.
    system : array, arcsec
        FWHM of the Gaussian.
    """
    kolmogorov = np.exp(-3.4418970 * (frequency * atmosphere / (2 * np.pi * 0.9758634299)) ** (5 / 3))
    return kolmogorov * np.exp(-((frequency * system / 2.3548200450309493) ** 2) / 2)


def fried(fwhm: np.ndarray | float, wave: float) -> np.ndarray | float:
    """Return the Fried parameter r0, m, of Kolmogorov seeing (Fried 1966).

    Parameters
    ----------
    fwhm : float or array, arcsec
        FWHM of the seeing.
    wave : float, nm
        Wavelength.
    """
    return 0.9758634299 * wave * 1e-9 / (fwhm * np.pi / 648000)


def von_karman_transfer(
    frequency: np.ndarray, atmosphere: np.ndarray, system: np.ndarray, wave: float, outer_scale: float
) -> np.ndarray:
    """Return the transform of a PSF of von Karman seeing convolved with a Gaussian.

    Von Karman seeing is due to turbulence with an outer scale. The structure function is that of Conan (2008,
    equation 16).

    Parameters
    ----------
    frequency : array, radians/arcsec
        Radial frequencies, that is 2 pi over the period.
    atmosphere : array, arcsec
        FWHM that the seeing would have without the outer scale.
    system : array, arcsec
        FWHM of the Gaussian.
    wave : float, nm
        Wavelength.
    outer_scale : float, m
        Outer scale.
    """
    separation = np.maximum(frequency * (648000 / np.pi) * wave * 1e-9 / (2 * np.pi), 1e-9)
    x = 2 * np.pi * separation / outer_scale
    constant = 2 ** (1 / 6) * gamma(11 / 6) / np.pi ** (8 / 3) * (24 / 5 * gamma(6 / 5)) ** (5 / 6)
    structure = (outer_scale / fried(atmosphere, wave)) ** (5 / 3) * constant
    structure = structure * (gamma(5 / 6) / 2 ** (1 / 6) - x ** (5 / 6) * kv(5 / 6, x))
    return np.exp(-structure / 2) * np.exp(-((frequency * system / 2.3548200450309493) ** 2) / 2)


def radial_model(frequency: np.ndarray, transfers: np.ndarray, pixel_scale: float, size: int) -> PsfModel:
    """Return the model of a round PSF that does not vary over the detector.

    Parameters
    ----------
    frequency : array, shape (n,), radians/arcsec
        Radial frequencies.
    transfers : array, shape (nodes, n)
        Transform of the PSF at each node.
    pixel_scale : float, arcsec
        Pixel scale.
    size : int
        Side of the largest stamp, pixels, a power of two.
    """
    grid = Grid(size, 2)
    return model(_round(frequency, transfers, grid, pixel_scale), grid)


def elliptical_model(
    frequency: np.ndarray,
    transfers: np.ndarray,
    middle: np.ndarray,
    covariances: np.ndarray,
    degree: int,
    shape: tuple[int, int],
    pixel_scale: float,
    size: int,
) -> PsfModel:
    """Return the model of a round PSF convolved with a Gaussian whose covariance varies over the detector.

    Parameters
    ----------
    frequency : array, shape (n,), radians/arcsec
        Radial frequencies.
    transfers : array, shape (nodes, n)
        Transform of the round PSF at each node.
    middle : array, shape (3,), arcsec2
        Covariance xx, yy, xy in the middle of the detector.
    covariances : array, shape (positions, 3), arcsec2
        Covariances at the positions of `place_grid`; empty for a PSF that does not vary over the detector.
    degree : int
        Degree of `place_grid`.
    shape : (int, int)
        Shape of the detector (ny, nx).
    pixel_scale : float, arcsec
        Pixel scale.
    size : int
        Side of the largest stamp, pixels, a power of two.
    """
    grid = Grid(size, 2)
    round_part = _round(frequency, transfers, grid, pixel_scale)
    nodes = round_part * _gaussian(middle, grid, pixel_scale)
    if not len(covariances):
        return model(nodes, grid)
    core = Grid(min(size, CORE), 2)
    inner = grid.within(round_part, core.size)
    in_middle = _gaussian(middle, core, pixel_scale)
    gaussians = [_gaussian(covariance, core, pixel_scale) for covariance in covariances]
    differences = np.stack([inner * (gaussian - in_middle) for gaussian in gaussians], axis=1)
    return model(nodes, grid, Variation(shape, degree, differences))


def _round(frequency: np.ndarray, transfers: np.ndarray, grid: Grid, pixel_scale: float) -> np.ndarray:
    """Return the transforms of round PSFs with the response of a pixel, shape (nodes, *grid.shape), complex64."""
    rows, columns = grid.axes()
    radius = np.hypot(rows[:, None], columns[None, :]) / pixel_scale
    response = pixel_response(grid, 0.0)
    transforms = np.zeros((len(transfers), *grid.shape), np.complex64)
    for out, transfer in zip(transforms, transfers, strict=True):
        out[:] = np.interp(radius, frequency, transfer, right=0.0) * response
    transforms[:, 0, :] = 0
    transforms[:, :, -1] = 0
    return transforms


def _gaussian(covariance: np.ndarray, grid: Grid, pixel_scale: float) -> np.ndarray:
    """Return the transform of a Gaussian with a covariance in arcsec2, shape (grid.shape), float32."""
    rows, columns = (axis / pixel_scale for axis in grid.axes())
    xx, yy, xy = covariance
    exponent = xx * columns[None, :] ** 2 + yy * rows[:, None] ** 2 + 2 * xy * rows[:, None] * columns[None, :]
    return np.exp(-exponent / 2).astype(np.float32)
