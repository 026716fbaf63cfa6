"""Background cosmology of a flat cold dark matter universe: distances, expansion rate and linear growth."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

SPEED_OF_LIGHT = 299792.458
"""km/s"""


@dataclass(frozen=True)
class Cosmology:
    """A flat cold dark matter cosmology; the defaults are those of cosmoDC2 (WMAP 7, Korytov et al. 2019).

    Distances (redshifts up to 12) and growth (scale factors from 1e-4) are tabulated at first use and interpolated
    linearly. The method names are those that GLASS expects of a cosmology.
    """

    h: float = 0.71
    """Hubble constant, 100 km/s/Mpc."""
    omega_m: float = 0.2648
    """Matter density parameter."""
    omega_b: float = 0.0448
    """Baryon density parameter."""
    n_s: float = 0.963
    """Scalar spectral index."""
    sigma_8: float = 0.8
    """Rms linear density contrast in spheres of radius 8 Mpc/h, today."""

    @property
    def hubble_distance(self) -> float:
        """Hubble distance c / H0, Mpc."""
        return SPEED_OF_LIGHT / (100 * self.h)

    @property
    def Omega_m0(self) -> float:  # noqa: N802  the name that lensing codes expect
        """Matter density parameter today."""
        return self.omega_m

    def H_over_H0(self, z):  # noqa: N802
        """Return the expansion rate at redshift `z` over the rate today."""
        return np.sqrt(self.omega_m * (1 + np.asarray(z, float)) ** 3 + 1 - self.omega_m)

    def comoving_distance(self, z):
        """Return the comoving distance to redshift `z`, Mpc."""
        return np.interp(z, *self._distances)

    def inv_comoving_distance(self, distance):
        """Return the redshift at a comoving distance in Mpc."""
        return np.interp(distance, *self._distances[::-1])

    def transverse_comoving_distance(self, z, z2=None):
        """Return the transverse comoving distance, Mpc, to redshift `z`, or from `z` to `z2` if given."""
        if z2 is None:
            return self.comoving_distance(z)
        return self.comoving_distance(z2) - self.comoving_distance(z)

    def angular_diameter_distance(self, z):
        """Return the angular diameter distance to redshift `z`, Mpc."""
        return self.comoving_distance(z) / (1 + np.asarray(z, float))

    def growth(self, z):
        """Return the linear growth factor, 1 today: D(a) ~ H(a) int da / (a H)^3 (Heath 1977)."""
        a, growth = self._growth
        return np.interp(1 / (1 + np.asarray(z, float)), a, growth)

    @cached_property
    def _distances(self) -> tuple[np.ndarray, np.ndarray]:
        """Redshifts and comoving distances, Mpc."""
        z = np.linspace(0, 12, 60_001)
        inverse = 1 / self.H_over_H0(z)
        steps = (inverse[1:] + inverse[:-1]) / 2 * np.diff(z)
        return z, self.hubble_distance * np.concatenate([[0.0], np.cumsum(steps)])

    @cached_property
    def _growth(self) -> tuple[np.ndarray, np.ndarray]:
        """Scale factors and growth factors."""
        a = np.linspace(1e-4, 1, 20_001)
        expansion = self.H_over_H0(1 / a - 1)
        integrand = 1 / (a * expansion) ** 3
        steps = (integrand[1:] + integrand[:-1]) / 2 * np.diff(a)
        growth = expansion * np.concatenate([[integrand[0] * a[0]], integrand[0] * a[0] + np.cumsum(steps)])
        return a, growth / growth[-1]
