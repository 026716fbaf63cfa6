"""Types, shapes, dust, fluxes and lensing of generated galaxies, as rows of the truth catalog."""

from __future__ import annotations

import numpy as np
import pandas as pd
from scipy.special import betaincinv, ndtri

from romandask.kernels.universe.dust import ALL_DUST
from romandask.kernels.universe.flux_table import RV, FluxTable
from romandask.kernels.universe.galaxies import (
    ANGLE,
    BULGE_FRACTION,
    BULGE_SIZE,
    DUST,
    EARLY,
    HAS_KNOTS,
    KNOT_COUNT,
    KNOT_FRACTION,
    SHAPE_1,
    SHAPE_2,
    SHAPE_NOISE,
    SIZE,
    STEPS,
    TEMPLATES,
    TYPE,
    Galaxies,
)
from romandask.kernels.universe.structure import Structure
from romandask.kernels.universe.synthetic_photometry import njy
from romandask.model.spectra import NJY_ZERO_POINT

KNOTS_LIMIT = 27.0
"""Faintest i magnitude of a galaxy with knots."""
REFERENCE_BAND = "r"
"""Band of the generated magnitudes."""
NEEDED_BANDS = ("r", "i")
"""Bands that the flux table must hold in addition to those of the survey: REFERENCE_BAND and the band of KNOTS_LIMIT.
"""
MAX_AV = 2.0
"""Largest A_V of the internal dust, mag."""


def galaxy_rows(
    galaxies: Galaxies,
    structure: Structure,
    table: FluxTable,
    bands: tuple[str, ...],
    shear: tuple[float, float],
    milky_way_av: float,
) -> pd.DataFrame:
    """Return rows of the truth catalog (catalogs/galaxies.yaml) without the columns of top-hat spectra.

    - Types: the fraction of early galaxies decreases with magnitude and redshift; late disks become bluer with
      magnitude, as r - H does in COSMOS2020.
    - Half-light radii of disks: 0.25 arcsec at r = 25, decreasing by 0.1 dex per magnitude, with a scatter of 0.2 dex
      (COSMOS, Leauthaud et al. 2007). Bulges are half as large.
    - Ellipticities: rms SHAPE_NOISE per component.
    - Internal dust: exponential distribution of A_V.
    - Knots: up to 30 per cent of the light of late disks, a fraction that increases with size; none in galaxies fainter
      than KNOTS_LIMIT.

    Parameters
    ----------
    galaxies : Galaxies
        Positions, redshifts, magnitudes and uniform random numbers of n galaxies.
    structure : Structure
        Convergence and shear.
    table : FluxTable
        Fluxes of the spectral types; must hold `bands` and NEEDED_BANDS.
    bands : tuple of str
        Bands of the flux columns.
    shear : (float, float)
        Constant shear (gamma_1, gamma_2) added to that of the structure.
    milky_way_av : float, mag
        A_V of the Milky Way.
    """
    uniform = galaxies.uniform.T
    n, mag, z = len(galaxies.id), galaxies.magnitude, galaxies.redshift
    early = uniform[EARLY] < np.clip(0.42 - 0.05 * (mag - 20) - 0.06 * z, 0.03, 0.55)
    bulge_fraction = np.where(early, 0.5 + 0.5 * uniform[BULGE_FRACTION], betaincinv(1.0, 6.0, uniform[BULGE_FRACTION]))
    bulge_sed, disk_sed = _types(early, z, mag, uniform[TYPE])
    bulge_av, disk_av = _internal_av(early, mag, uniform[DUST])
    radius = np.clip(10 ** (np.log10(0.25) - 0.1 * (mag - 25) + 0.2 * ndtri(uniform[SIZE])), 0.02, 8.0)
    bulge_radius = radius * np.clip(0.5 * 10 ** (0.15 * ndtri(uniform[BULGE_SIZE])), 0.1, 1.2)
    ellipticity = SHAPE_NOISE * np.hypot(ndtri(uniform[SHAPE_1]), ndtri(uniform[SHAPE_2]))
    ellipticity = np.minimum(ellipticity, 0.85)
    ratio = (1 - ellipticity) / (1 + ellipticity)
    bulge_ratio = (1 - 0.6 * ellipticity) / (1 + 0.6 * ellipticity)
    mw_av = np.full(n, milky_way_av)
    r_band = table.band_index(REFERENCE_BAND)
    magnorm, photons_of = {}, {}
    for name, sed, av, fraction in (
        ("bulge", bulge_sed, bulge_av, bulge_fraction),
        ("disk", disk_sed, disk_av, 1 - bulge_fraction),
    ):
        at_magnorm_0 = table.photons(np.zeros(n), sed, z, av, mw_av)
        r_flux = njy(at_magnorm_0[ALL_DUST, :, r_band], table.bandpasses[r_band])
        with np.errstate(divide="ignore"):
            magnorm[name] = mag - 2.5 * np.log10(fraction) + 2.5 * np.log10(r_flux / NJY_ZERO_POINT)
        photons_of[name] = at_magnorm_0 * 10 ** (-0.4 * magnorm[name])[None, :, None]
    photons = photons_of["bulge"] + photons_of["disk"]
    i_band = table.band_index("i")
    i_mag = 31.4 - 2.5 * np.log10(njy(photons[ALL_DUST, :, i_band], table.bandpasses[i_band]))
    has_knots = (i_mag <= KNOTS_LIMIT) & ~early & (uniform[HAS_KNOTS] < np.clip(radius / 0.6, 0, 0.7))
    knot_fraction = (0.05 + 0.25 * uniform[KNOT_FRACTION]) * np.clip(radius / 0.4, 0.2, 1)
    knot_fraction = np.where(has_knots, knot_fraction, 0.0)
    convergence, shear_1, shear_2 = structure.lensing(galaxies.ra, galaxies.dec, z)
    shear_1, shear_2 = shear_1 + shear[0], shear_2 + shear[1]
    with np.errstate(divide="ignore"):
        knots_magnorm = magnorm["disk"] - 2.5 * np.log10(knot_fraction)
    frame = {
        "galaxy_id": galaxies.id,
        "ra": galaxies.ra,
        "dec": galaxies.dec,
        "redshift": z,
        "shear_1": shear_1,
        "shear_2": shear_2,
        "convergence": convergence,
        "size_bulge_true": bulge_radius / np.sqrt(bulge_ratio),
        "size_minor_bulge_true": bulge_radius * np.sqrt(bulge_ratio),
        "size_disk_true": radius / np.sqrt(ratio),
        "size_minor_disk_true": radius * np.sqrt(ratio),
        "position_angle_unlensed": 180 * uniform[ANGLE],
        "bulge_magnorm": magnorm["bulge"],
        "disk_magnorm": magnorm["disk"] - 2.5 * np.log10(1 - knot_fraction),
        "knots_magnorm": knots_magnorm,
        "n_knots": np.where(has_knots, 2 + (28 * uniform[KNOT_COUNT]).astype(int), 0),
        "bulge_av": bulge_av,
        "bulge_rv": np.full(n, RV),
        "disk_av": disk_av,
        "disk_rv": np.full(n, RV),
        "MW_av": mw_av,
        "MW_rv": np.full(n, RV),
        "bulge_sed": bulge_sed,
        "disk_sed": disk_sed,
        "knots_sed": disk_sed,
    }
    magnification = 1 / ((1 - convergence) ** 2 - shear_1**2 - shear_2**2)
    for band in bands:
        k = table.band_index(band)
        frame |= flux_columns(band, njy(photons[:, :, k], table.bandpasses[k]) * magnification)
    return pd.DataFrame(frame)


def flux_columns(band: str, fluxes: np.ndarray) -> dict[str, np.ndarray]:
    """Return the flux columns of a band in the truth catalogs.

    Parameters
    ----------
    band : str
        Name of the band.
    fluxes : array, shape (3, n), nJy
        Flux densities with all dust, with internal dust only, and without dust.
    """
    all_dust, internal_dust, no_dust = fluxes
    with np.errstate(divide="ignore", invalid="ignore"):
        dimming = np.where(all_dust > 0, -2.5 * np.log10(all_dust / no_dust), 0.0)
    return {f"flux_{band}": all_dust, f"flux_{band}_noMW": internal_dust, f"dust_{band}": dimming}


def _types(
    early: np.ndarray, z: np.ndarray, magnitude: np.ndarray, uniform: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the spectral types of bulges and of disks, 0 for the reddest.

    The distribution of r - H follows COSMOS2020 from r = 20 to 26.
    """
    last = STEPS * (len(TEMPLATES) - 1)
    blueness = np.clip(0.5 * (magnitude - 20), 0, 3.5)
    disk = np.where(early, 2 + 2 * uniform, STEPS + (last - STEPS) * uniform ** (1 / (1.0 + blueness)))
    disk = np.clip(np.rint(disk), 0, last).astype(int)
    # bulges are redder than their disks, in late galaxies by one template
    bulge = np.where(early, np.where(z < 1.5, 0, STEPS - 1), disk - STEPS)
    return bulge, disk


def _internal_av(early: np.ndarray, magnitude: np.ndarray, uniform: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return A_V of bulges and of disks, from an exponential distribution whose mean decreases with magnitude."""
    mean = np.where(early, 0.03, np.clip(0.3 - 0.04 * (magnitude - 21), 0.08, 0.3))
    disk = np.minimum(-mean * np.log1p(-uniform), MAX_AV)
    return 0.3 * disk, disk
