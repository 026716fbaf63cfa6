"""Rubin's PSF: atmosphere and telescope, both proportional to airmass^0.6, with random variations over the field.

The PSF of an exposure is the atmospheric profile at each wavelength convolved with a Gaussian. The Gaussian stands for
the telescope and camera (`depth.SYSTEM_FWHM`) and for the departure of the atmosphere from its mean. Its covariance
varies over the focal plane by a pattern drawn for each visit (`romandask.kernels.rendering.seeing`).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import galsim
import numpy as np

from romandask.instruments.exposure import Exposure
from romandask.instruments.rubin.bands import COLLECTING_AREA
from romandask.instruments.rubin.depth import SYSTEM_FWHM
from romandask.instruments.rubin.focal_plane import CENTRES, PIXEL_SCALE
from romandask.kernels.rendering.psf import PsfModel, place_grid
from romandask.kernels.rendering.seeing import (
    Pattern,
    elliptical_model,
    fried,
    kolmogorov_transfer,
    pattern,
    radial_model,
    von_karman_transfer,
)
from romandask.kernels.universe.bandpasses import rubin_bandpass
from romandask.model.seeds import rng

STAMP = 512
"""Side of the largest stamp, pixels."""
DEGREE = 3
"""Degree of the polynomials by which the PSF varies over a detector."""
FWHM_PER_SIGMA = 2.3548200450309493
"""FWHM of a Gaussian over its sigma."""
FREQUENCY = np.linspace(0, 2.2 * np.pi * np.sqrt(2) / PIXEL_SCALE, 3000)
"""Radial frequencies at which transforms of PSFs are tabulated, 1/arcsec."""


@dataclass(frozen=True, kw_only=True)
class RubinPsf:
    """PSFs of all exposures of a survey."""

    atmosphere: Literal["kolmogorov", "von_karman"]
    """Spectrum of the turbulence."""
    outer_scale: float
    """Outer scale of von Karman turbulence, m."""
    n_waves: int
    """Number of nodes per band."""
    shape: tuple[int, int]
    """Shape of a detector (ny, nx), pixels."""
    seed: int
    """Seed of the survey, from which the patterns are drawn."""

    def key(self, exposure: Exposure) -> tuple:
        """Return the key of `Instrument.psf_key`; each exposure has its own PSF."""
        turbulence = self.atmosphere, self.outer_scale, exposure.seeing, exposure.airmass, self.seed
        return "rubin", exposure.band, self.n_waves, self.shape, exposure.visit, exposure.detector, *turbulence

    def over_detector(self, exposure: Exposure) -> PsfModel:
        """Return the PSF of an exposure, which varies over the detector."""
        return _over_detector(self, exposure)

    def at(self, exposure: Exposure, x: float, y: float) -> PsfModel:
        """Return the PSF of an exposure at one position of the detector, pixels."""
        return self.model(exposure, np.array([x]), np.array([y]), np.empty((0, 2)), 0)

    def model(self, exposure: Exposure, x: np.ndarray, y: np.ndarray, positions: np.ndarray, degree: int) -> PsfModel:
        """Return the PSF of an exposure at one position, and its differences from that at other positions.

        Parameters
        ----------
        exposure : Exposure
            The exposure.
        x, y : ndarray, shape (1,), pixels
            Position of the PSF.
        positions : ndarray, shape (n, 2), pixels
            Positions of `place_grid` at which the differences are sampled; empty for a PSF that does not vary.
        degree : int
            Degree of the polynomials that interpolate the differences.
        """
        thickness = exposure.airmass**0.6
        transfers = [
            self._transfer(FREQUENCY, np.array(exposure.seeing * (wave / 500) ** -0.3 * thickness), wave, np.array(0.0))
            for wave in self._nodes(exposure.band)
        ]
        middle, others = self._covariance(exposure, x, y)[0], self._covariance(exposure, *positions.T)
        return elliptical_model(FREQUENCY, np.array(transfers), middle, others, degree, self.shape, PIXEL_SCALE, STAMP)

    def effective(self, exposures: list[Exposure], weights: np.ndarray, size: int = STAMP) -> PsfModel:
        """Return the weighted mean PSF of some exposures of one band, on native pixels.

        The PSF is round, because the ellipticities of hundreds of rotated and dithered exposures average out. The size
        of each exposure's PSF is that in the middle of its detector.

        Parameters
        ----------
        exposures : list of Exposure
            Exposures of one band.
        weights : ndarray, shape (n,)
            Weights of the exposures; the sum need not be 1.
        size : int
            Side of the largest stamp, pixels.
        """
        share = np.asarray(weights) / np.sum(weights)
        seeing = np.array([exposure.seeing for exposure in exposures])
        thickness = np.array([exposure.airmass for exposure in exposures]) ** 0.6
        x, y = self._middle
        size2 = np.array([self._covariance(exposure, x, y)[0, :2].mean() for exposure in exposures])
        gaussian = (np.sqrt(size2) * FWHM_PER_SIGMA)[:, None]
        transfers = [
            share @ self._transfer(FREQUENCY, (seeing * (wave / 500) ** -0.3 * thickness)[:, None], wave, gaussian)
            for wave in self._nodes(exposures[0].band)
        ]
        return radial_model(FREQUENCY, np.array(transfers), PIXEL_SCALE, size)

    def profiles(self, exposure: Exposure, x: float, y: float) -> list[galsim.GSObject]:
        """Return the PSF at a position of the detector, pixels, as GalSim profiles, one per node."""
        thickness = exposure.airmass**0.6
        xx, yy, xy = self._covariance(exposure, np.array([x]), np.array([y]))[0]
        size = np.sqrt(xx * yy - xy**2)
        # a Gaussian with this covariance has distortions (xx - yy) / (xx + yy) and 2 xy / (xx + yy)
        shear = galsim.Shear(e1=(xx - yy) / (xx + yy), e2=2 * xy / (xx + yy))
        system = galsim.Gaussian(sigma=np.sqrt(size)).shear(shear)
        return [
            galsim.Convolve(self._profile(exposure.seeing * (wave / 500) ** -0.3 * thickness, wave), system)
            for wave in self._nodes(exposure.band)
        ]

    @property
    def _middle(self) -> tuple[np.ndarray, np.ndarray]:
        """x and y of the middle of a detector, each of shape (1,), pixels."""
        ny, nx = self.shape
        return np.array([(nx - 1) / 2]), np.array([(ny - 1) / 2])

    def _nodes(self, band: str) -> np.ndarray:
        return rubin_bandpass(band, self.n_waves, COLLECTING_AREA).nodes

    def _profile(self, fwhm: float, wave: float) -> galsim.GSObject:
        """Return the atmospheric PSF of a FWHM, arcsec, at a wavelength, nm."""
        if self.atmosphere == "kolmogorov":
            return galsim.Kolmogorov(fwhm=float(fwhm))
        return galsim.VonKarman(lam=float(wave), r0=fried(fwhm, wave), L0=self.outer_scale)

    def _transfer(self, frequency: np.ndarray, fwhm: np.ndarray, wave: float, gaussian: np.ndarray) -> np.ndarray:
        """Return the transform of an atmospheric PSF convolved with a round Gaussian.

        `fwhm` and `gaussian` are the FWHMs of the two, arcsec; `wave` is the wavelength, nm.
        """
        if self.atmosphere == "kolmogorov":
            return kolmogorov_transfer(frequency, fwhm, gaussian)
        return von_karman_transfer(frequency, fwhm, gaussian, wave, self.outer_scale)

    def _covariance(self, exposure: Exposure, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Return the covariance (xx, yy, xy) of the Gaussian part of the PSF at n positions of a detector.

        It is the sum of the contribution of the telescope and of the departure of the atmosphere, at 500 nm, from its
        mean: turbulence.

        Parameters
        ----------
        exposure : Exposure
            The exposure.
        x, y : ndarray, shape (n,), pixels
            Positions.

        Returns
        -------
        ndarray, shape (n, 3), arcsec2
        """
        ny, nx = self.shape
        centre = CENTRES[exposure.detector][:, None]
        u, v = centre + PIXEL_SCALE * (np.stack([x, y]) - [[(nx - 1) / 2], [(ny - 1) / 2]])
        field, thickness = _pattern(self.seed, exposure.visit), exposure.airmass**0.6
        telescope = (SYSTEM_FWHM * thickness / FWHM_PER_SIGMA) ** 2 * field.telescope(u, v)
        return telescope + (exposure.seeing * thickness / FWHM_PER_SIGMA) ** 2 * field.atmosphere(u, v)


@lru_cache(maxsize=4096)
def _pattern(seed: int, visit: int) -> Pattern:
    return pattern(rng(seed, "exposures", "rubin", "psf", visit))


@lru_cache(maxsize=1)
def _over_detector(psf: RubinPsf, exposure: Exposure) -> PsfModel:
    return psf.model(exposure, *psf._middle, place_grid(psf.shape, DEGREE), DEGREE)
