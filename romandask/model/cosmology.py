"""The universe's background: distances, redshifts and growth of a flat cold dark matter model, tabulated once."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

SPEED_OF_LIGHT = 299792.458
"""km/s"""


@dataclass(frozen=True)
class Cosmology:
    """A flat universe; the defaults are cosmoDC2's (WMAP 7, Korytov et al. 2019)."""

    h: float = 0.71
    omega_m: float = 0.2648
    omega_b: float = 0.0448
    n_s: float = 0.963
    sigma_8: float = 0.8

    @property
    def hubble_distance(self) -> float:
        """Mpc"""
        return SPEED_OF_LIGHT / (100 * self.h)

    @property
    def Omega_m0(self) -> float:  # noqa: N802  the name that lensing codes ask for
        """Matter density today."""
        return self.omega_m

    def H_over_H0(self, z):  # noqa: N802
        """Expansion rate over today's."""
        return np.sqrt(self.omega_m * (1 + np.asarray(z, float)) ** 3 + 1 - self.omega_m)

    def comoving_distance(self, z):
        """Comoving distance, Mpc."""
        return np.interp(z, *self._distances)

    def inv_comoving_distance(self, distance):
        """Redshift at a comoving distance, Mpc."""
        return np.interp(distance, *self._distances[::-1])

    def transverse_comoving_distance(self, z, z2=None):
        """Comoving distance, Mpc, to a redshift or from one to another."""
        if z2 is None:
            return self.comoving_distance(z)
        return self.comoving_distance(z2) - self.comoving_distance(z)

    def angular_diameter_distance(self, z):
        """Mpc"""
        return self.comoving_distance(z) / (1 + np.asarray(z, float))

    def growth(self, z):
        """Linear growth, 1 today: D(a) ~ H(a) int da / (a H)^3 (Heath 1977)."""
        a, value = self._growth
        return np.interp(1 / (1 + np.asarray(z, float)), a, value)

    @cached_property
    def _distances(self) -> tuple[np.ndarray, np.ndarray]:
        z = np.linspace(0, 12, 60_001)
        inverse = 1 / self.H_over_H0(z)
        steps = (inverse[1:] + inverse[:-1]) / 2 * np.diff(z)
        return z, self.hubble_distance * np.concatenate([[0.0], np.cumsum(steps)])

    @cached_property
    def _growth(self) -> tuple[np.ndarray, np.ndarray]:
        a = np.linspace(1e-4, 1, 20_001)
        rate = self.H_over_H0(1 / a - 1)
        integrand = 1 / (a * rate) ** 3
        steps = (integrand[1:] + integrand[:-1]) / 2 * np.diff(a)
        value = rate * np.concatenate([[integrand[0] * a[0]], integrand[0] * a[0] + np.cumsum(steps)])
        return a, value / value[-1]
