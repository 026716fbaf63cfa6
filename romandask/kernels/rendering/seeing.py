"""PSFs of a telescope on the ground: the transform of seeing, and how size and shape vary over a field of view."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import gamma, kv

from romandask.kernels.rendering.psf import CORE, Grid, PsfModel, Variation, model, response_of

FIELD = 1.75 * 3600
"""Radius of the field of view, arcsec."""
DESIGN = 0.19
"""By how much the variance of the telescope's part grows from the middle of the field to its edge: chosen, as images of
0.1 arcsec in the middle and 0.2 at the edge, of 0.4 in all, would have it."""
RADIAL = 0.03
"""Of its variance at the edge of the field, along the radius or, with the other sign, across."""
ALIGNMENT = 0.05
"""Rms, of its variance, of a visit's own ellipticity: a constant and a slope over the field, half each."""
TURBULENCE = 0.02
"""Rms, of the atmosphere's variance, of size and of both ellipticities: chosen, some hundredths are what 30 s of
turbulence do not average out."""
WAVES = 16
SHORTEST, LONGEST = 0.2 * 3600, 3.0 * 3600
"""Plane waves that make up the atmosphere's pattern, and between which lengths they lie, arcsec."""


@dataclass(frozen=True)
class Pattern:
    """How the PSF of one visit varies over the field of view, in units of the variances of its two parts."""

    alignment: np.ndarray
    """(2, 3): both ellipticities of the telescope's part, each a constant and two slopes a field radius."""
    waves: np.ndarray
    """(3, WAVES, 3): of size and both ellipticities of the atmosphere, frequencies (1/arcsec) and phases."""

    def telescope(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Return the covariance (n, 3), xx, yy, xy, of the telescope's part at places (arcsec from the boresight)."""
        u, v = np.asarray(x, float) / FIELD, np.asarray(y, float) / FIELD
        size = 1 + DESIGN * (u**2 + v**2 - 0.5)
        basis = np.stack([np.ones_like(u), u, v])
        plus, cross = self.alignment @ basis
        plus, cross = plus + RADIAL * (u**2 - v**2), cross + RADIAL * 2 * u * v
        return np.stack([size + plus, size - plus, cross], axis=-1)

    def atmosphere(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Return, likewise, by how much the atmosphere's covariance differs from that of its mean, round PSF."""
        place = np.stack([np.asarray(x, float), np.asarray(y, float)])
        phase = self.waves[..., :2] @ place + self.waves[..., 2:]
        size, plus, cross = TURBULENCE * np.sqrt(2 / WAVES) * np.cos(phase).sum(axis=1)
        return np.stack([size + plus, size - plus, cross], axis=-1)


def pattern(random: np.random.Generator) -> Pattern:
    """Return the pattern of a visit."""
    alignment = ALIGNMENT * np.sqrt(0.5) * random.standard_normal((2, 3))
    length = np.exp(random.uniform(np.log(SHORTEST), np.log(LONGEST), (3, WAVES)))
    angle, phase = random.uniform(0, 2 * np.pi, (2, 3, WAVES))
    wave = 2 * np.pi / length
    return Pattern(alignment, np.stack([wave * np.cos(angle), wave * np.sin(angle), phase], axis=-1))


def kolmogorov_transfer(frequency: np.ndarray, atmosphere: np.ndarray, system: np.ndarray) -> np.ndarray:
    """Return the transform, at radial frequencies in 1/arcsec (2 pi / period), of Kolmogorov seeing and a Gaussian.

    `atmosphere` and `system` are FWHM in arcsec. Kolmogorov's transform is exp(-3.4419 (k lambda / 2 pi r0)^(5/3)) with
    FWHM = 0.97586 lambda / r0 (Fried 1966; the constants are GalSim's).
    """
    kolmogorov = np.exp(-3.4418970 * (frequency * atmosphere / (2 * np.pi * 0.9758634299)) ** (5 / 3))
    return kolmogorov * np.exp(-((frequency * system / 2.3548200450309493) ** 2) / 2)


def fried(fwhm: np.ndarray | float, wave: float) -> np.ndarray | float:
    """Return r0, m, of Kolmogorov seeing of a FWHM, arcsec, at a wavelength, nm (Fried 1966)."""
    return 0.9758634299 * wave * 1e-9 / (fwhm * np.pi / 648000)


def von_karman_transfer(
    frequency: np.ndarray, atmosphere: np.ndarray, system: np.ndarray, wave: float, outer_scale: float
) -> np.ndarray:
    """Return the transform of von Karman seeing and a Gaussian: turbulence whose power ends at an outer scale.

    Arguments and units are those of `kolmogorov_transfer`, `atmosphere` the FWHM without the outer scale; `wave` in nm,
    `outer_scale` in m. The structure function is Conan's (2008, equation 16).
    """
    separation = np.maximum(frequency * (648000 / np.pi) * wave * 1e-9 / (2 * np.pi), 1e-9)
    x = 2 * np.pi * separation / outer_scale
    constant = 2 ** (1 / 6) * gamma(11 / 6) / np.pi ** (8 / 3) * (24 / 5 * gamma(6 / 5)) ** (5 / 6)
    structure = (outer_scale / fried(atmosphere, wave)) ** (5 / 3) * constant
    structure = structure * (gamma(5 / 6) / 2 ** (1 / 6) - x ** (5 / 6) * kv(5 / 6, x))
    return np.exp(-structure / 2) * np.exp(-((frequency * system / 2.3548200450309493) ** 2) / 2)


def radial_model(frequency: np.ndarray, transfers: np.ndarray, pixel_scale: float, size: int) -> PsfModel:
    """Return the model of round PSFs from their transforms (nodes, n) at radial frequencies (n,), 1/arcsec."""
    grid = Grid(size, 2)
    return model(_round(frequency, transfers, grid, pixel_scale), grid)


def elliptical_model(
    frequency: np.ndarray,
    transfers: np.ndarray,
    middle: np.ndarray,
    places: np.ndarray,
    degree: int,
    shape: tuple[int, int],
    pixel_scale: float,
    size: int,
) -> PsfModel:
    """Return the model of round PSFs that are convolved with a Gaussian whose covariance varies over a detector.

    Parameters
    ----------
    frequency, transfers : transforms (nodes, n) of the round PSFs at radial frequencies (n,), 1/arcsec
    middle : (3,) covariance in the middle of the detector, xx, yy and xy, arcsec2
    places : (places, 3) covariances at the places of `place_grid`; none for a PSF that is the same everywhere
    degree : of that grid
    shape : detector (ny, nx)
    size : largest stamp, pixels
    """
    grid = Grid(size, 2)
    round_part = _round(frequency, transfers, grid, pixel_scale)
    nodes = round_part * _gaussian(middle, grid, pixel_scale)
    if not len(places):
        return model(nodes, grid)
    core = Grid(min(size, CORE), 2)
    inner = grid.within(round_part, core.size)
    here = _gaussian(middle, core, pixel_scale)
    differences = np.stack([inner * (_gaussian(there, core, pixel_scale) - here) for there in places], axis=1)
    return model(nodes, grid, Variation(shape, degree, differences))


def _round(frequency: np.ndarray, transfers: np.ndarray, grid: Grid, pixel_scale: float) -> np.ndarray:
    """Return the transforms (nodes, *grid.shape), complex64, of round PSFs and the pixel."""
    rows, columns = grid.axes()
    radius = np.hypot(rows[:, None], columns[None, :]) / pixel_scale
    response = response_of(grid, 0.0)
    found = np.zeros((len(transfers), *grid.shape), np.complex64)
    for out, transfer in zip(found, transfers, strict=True):
        out[:] = np.interp(radius, frequency, transfer, right=0.0) * response
    found[:, 0, :] = 0
    found[:, :, -1] = 0
    return found


def _gaussian(covariance: np.ndarray, grid: Grid, pixel_scale: float) -> np.ndarray:
    """Return the transform (grid.shape), float32, of a Gaussian of some covariance, arcsec2."""
    rows, columns = (axis / pixel_scale for axis in grid.axes())
    xx, yy, xy = covariance
    exponent = xx * columns[None, :] ** 2 + yy * rows[:, None] ** 2 + 2 * xy * rows[:, None] * columns[None, :]
    return np.exp(-exponent / 2).astype(np.float32)
