"""Extinction by dust: parameters of dust per object, extinction curves and transmission."""

from __future__ import annotations

from dataclasses import dataclass

import astropy.units as u
import numpy as np
from dust_extinction.parameter_averages import CCM89, F19
from numba import njit

from romandask.model.spectra import Bandpass, ab_photon_density

MIN_RV = 1.0
"""Smallest R_V that is accepted; below it the extinction laws turn negative at some wavelengths."""
LAWS = {"CCM": CCM89, "F19": F19}
"""Extinction laws: Cardelli, Clayton and Mathis 1989; Fitzpatrick et al. 2019."""
ALL_DUST, INTERNAL_DUST, NO_DUST = range(3)
"""Indices of the first axis of photon rates: with all dust, with internal dust only, without dust."""
TAU_PER_MAG = 0.4 * np.log(10.0)
"""Optical depth of an extinction of 1 mag."""
_OBJECTS_PER_BATCH = 8192


@dataclass(frozen=True)
class Dust:
    """Dust in front of each of n objects."""

    av: np.ndarray
    """Extinction A_V, shape (n,), mag; 0 for no dust."""
    rv: np.ndarray
    """Ratio R_V = A_V / E(B-V), shape (n,); ignored where A_V is 0."""


def no_dust(n: int) -> Dust:
    """Return dust of A_V = 0 for n objects."""
    return Dust(np.zeros(n), np.full(n, 3.1))


def transmission(law: str, wave: np.ndarray, av: float, rv: float) -> np.ndarray:
    """Return the fraction of light that dust transmits.

    Parameters
    ----------
    law : {"CCM", "F19"}
        Extinction law.
    wave : array, nm
        Wavelengths in the rest frame of the dust.
    av : float, mag
        Extinction A_V.
    rv : float
        Ratio R_V, clipped to the range of the law.
    """
    a, b, rv = *extinction_curve(law, np.asarray(wave, float)), _clipped_rv(law, np.array([rv]))[0]
    return 10 ** (-0.4 * av * (a + b / rv))


def extinction(bandpass: Bandpass, milky_way: Dust) -> np.ndarray:
    """Return the extinction of a source of flat f_nu by Milky Way dust (F19) in a band.

    Parameters
    ----------
    bandpass : Bandpass
        Band.
    milky_way : Dust
        Dust in front of n objects.

    Returns
    -------
    array, shape (n,), mag
        Extinction in the band.
    """
    av, ebv = av_and_ebv(milky_way, "F19")
    a, b = extinction_curve("F19", bandpass.wave)
    light = ab_photon_density(bandpass.wave) * bandpass.weights
    out = np.zeros(len(av))
    # in batches: an object takes an array of the length of the band
    for first in range(0, len(av), _OBJECTS_PER_BATCH):
        rows = slice(first, first + _OBJECTS_PER_BATCH)
        transmitted = np.exp(-TAU_PER_MAG * (av[rows, None] * a + ebv[rows, None] * b))
        out[rows] = -2.5 * np.log10(transmitted @ light / light.sum())
    return out


def av_and_ebv(dust: Dust, law: str) -> tuple[np.ndarray, np.ndarray]:
    """Return A_V and E(B-V) = A_V / R_V of dust, both zero where A_V is zero, whatever R_V is.

    R_V is clipped to the range of the law.

    Raises
    ------
    ValueError
        If R_V is below MIN_RV or not a number where A_V is not zero.
    """
    av = np.asarray(dust.av, float)
    rv = np.where(av != 0, np.asarray(dust.rv, float), 3.1)
    if (~(rv >= MIN_RV)).any():
        raise ValueError(f"R_V below {MIN_RV} in {int((~(rv >= MIN_RV)).sum())} objects")
    return av, av / _clipped_rv(law, rv)


def _clipped_rv(law: str, rv: np.ndarray) -> np.ndarray:
    """Return R_V clipped to the range of a law."""
    return np.clip(rv, *LAWS[law].Rv_range)


def extinction_curve(law: str, wave: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the coefficients a and b of A(lambda) / A_V = a + b / R_V, the form of both laws.

    Outside the wavelength range of a law, the values at the end of the range are used.

    Parameters
    ----------
    law : {"CCM", "F19"}
        Extinction law.
    wave : array, nm
        Wavelengths in the rest frame of the dust.
    """
    model = LAWS[law]
    x = np.clip(1e3 / wave, model.x_range[0] + 1e-9, model.x_range[1] - 1e-9)
    low_rv, high_rv = (np.asarray(model(Rv=value)(x / u.micron)) for value in (2.5, 5.0))
    slope = (low_rv - high_rv) / (1 / 2.5 - 1 / 5.0)
    return low_rv - slope / 2.5, slope


@njit(cache=True, nogil=True, error_model="numpy")
def exp_minus(tau):
    """Return exp(-tau), accurate to six digits wherever light is left.

    The exponential is a series in tau / 64, squared six times. It calls no function, so that the compiler can
    vectorise loops around it. Optical depths above 60 are treated as 60.
    """
    x = max(-tau, -60.0) / 64
    e = 1 + x * (1 + x * (0.5 + x * (1 / 6 + x * (1 / 24 + x / 120))))
    e *= e
    e *= e
    e *= e
    e *= e
    e *= e
    e *= e
    return e
