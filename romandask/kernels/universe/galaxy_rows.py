"""Everything about drawn galaxies: shapes, types, dust, light and lensing, as rows of the truth catalog."""

from __future__ import annotations

import numpy as np
import pandas as pd
from scipy.special import betaincinv, ndtri

from romandask.kernels.universe import galaxies as drawn
from romandask.kernels.universe.flux_table import RV, FluxTable
from romandask.kernels.universe.galaxies import SHAPE_NOISE, STEPS, TEMPLATES, Galaxies
from romandask.kernels.universe.structure import Structure
from romandask.kernels.universe.synthetic_photometry import SEEN, njy
from romandask.model.spectra import NJY_ZERO_POINT

KNOTS_LIMIT = 27.0
"""Galaxies fainter in i have no knots."""
REFERENCE = "r"
"""Band in which magnitudes are drawn; the flux table holds it and the band of KNOTS_LIMIT whatever the survey's are."""
NEEDED_BANDS = ("r", "i")
LARGEST_AV = 2.0


def galaxy_rows(
    galaxies: Galaxies,
    structure: Structure,
    table: FluxTable,
    bands: tuple[str, ...],
    shear: tuple[float, float],
    milky_way_av: float,
) -> pd.DataFrame:
    """Return rows of the truth catalog (catalogs/galaxies.yaml) but for the columns of top-hat spectra.

    Types: early galaxies are fewer among the faint and far; late disks grow bluer with magnitude as r - H of COSMOS2020
    does. Half-light radius: 0.25 arcsec at r = 25, falling 0.1 dex a magnitude, 0.2 dex of scatter (COSMOS, Leauthaud
    et al. 2007); bulges are half as large. Ellipticities: SHAPE_NOISE a component. Own dust: exponential in A_V.
    Knots: up to 30 per cent of the light of late disks, falling with size, none beyond KNOTS_LIMIT.

    Parameters
    ----------
    shear : constant shear (gamma_1, gamma_2) that is added to the universe's own
    milky_way_av : A_V of the Milky Way, mag
    """
    column = galaxies.uniform.T
    n, mag, z = len(galaxies.id), galaxies.magnitude, galaxies.redshift
    early = column[drawn.EARLY] < np.clip(0.42 - 0.05 * (mag - 20) - 0.06 * z, 0.03, 0.55)
    share = np.where(early, 0.5 + 0.5 * column[drawn.SHARE], betaincinv(1.0, 6.0, column[drawn.SHARE]))
    bulge_sed, disk_sed = _types(early, z, mag, column[drawn.TYPE])
    bulge_av, disk_av = _own_dust(early, mag, column[drawn.DUST])
    radius = np.clip(10 ** (np.log10(0.25) - 0.1 * (mag - 25) + 0.2 * ndtri(column[drawn.SIZE])), 0.02, 8.0)
    bulge_radius = radius * np.clip(0.5 * 10 ** (0.15 * ndtri(column[drawn.BULGE_SIZE])), 0.1, 1.2)
    ellipticity = np.minimum(SHAPE_NOISE * np.hypot(ndtri(column[drawn.SHAPE_1]), ndtri(column[drawn.SHAPE_2])), 0.85)
    ratio = (1 - ellipticity) / (1 + ellipticity)
    bulge_ratio = (1 - 0.6 * ellipticity) / (1 + 0.6 * ellipticity)
    own_mw = np.full(n, milky_way_av)
    r_band = table.index(REFERENCE)
    parts, light = {}, 0.0
    for name, sed, av, part in (("bulge", bulge_sed, bulge_av, share), ("disk", disk_sed, disk_av, 1 - share)):
        unit = table.photons(np.zeros(n), sed, z, av, own_mw)
        in_r = njy(unit[SEEN, :, r_band], table.bandpasses[r_band])
        with np.errstate(divide="ignore"):
            parts[name] = mag - 2.5 * np.log10(part) + 2.5 * np.log10(in_r / NJY_ZERO_POINT)
        light = light + unit * 10 ** (-0.4 * parts[name])[None, :, None]
    i_band = table.index("i")
    i_mag = 31.4 - 2.5 * np.log10(njy(light[SEEN, :, i_band], table.bandpasses[i_band]))
    knotty = (i_mag <= KNOTS_LIMIT) & ~early & (column[drawn.KNOTTY] < np.clip(radius / 0.6, 0, 0.7))
    knots = np.where(knotty, (0.05 + 0.25 * column[drawn.KNOT_SHARE]) * np.clip(radius / 0.4, 0.2, 1), 0.0)
    convergence, shear_1, shear_2 = structure.lensing(galaxies.ra, galaxies.dec, z)
    shear_1, shear_2 = shear_1 + shear[0], shear_2 + shear[1]
    with np.errstate(divide="ignore"):
        knots_magnorm = parts["disk"] - 2.5 * np.log10(knots)
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
        "position_angle_unlensed": 180 * column[drawn.ANGLE],
        "bulge_magnorm": parts["bulge"],
        "disk_magnorm": parts["disk"] - 2.5 * np.log10(1 - knots),
        "knots_magnorm": knots_magnorm,
        "n_knots": np.where(knotty, 2 + (28 * column[drawn.KNOTS]).astype(int), 0),
        "bulge_av": bulge_av,
        "bulge_rv": np.full(n, RV),
        "disk_av": disk_av,
        "disk_rv": np.full(n, RV),
        "MW_av": own_mw,
        "MW_rv": np.full(n, RV),
        "bulge_sed": bulge_sed,
        "disk_sed": disk_sed,
        "knots_sed": disk_sed,
    }
    magnification = 1 / ((1 - convergence) ** 2 - shear_1**2 - shear_2**2)
    for band in bands:
        k = table.index(band)
        frame |= flux_columns(band, njy(light[:, :, k], table.bandpasses[k]) * magnification)
    return pd.DataFrame(frame)


def flux_columns(band: str, fluxes: np.ndarray) -> dict[str, np.ndarray]:
    """Return the truth catalogs' columns of a band: fluxes (3, n), nJy, with all dust, their own alone, none."""
    seen, own, clear = fluxes
    with np.errstate(divide="ignore", invalid="ignore"):
        dimming = np.where(seen > 0, -2.5 * np.log10(seen / clear), 0.0)
    return {f"flux_{band}": seen, f"flux_{band}_noMW": own, f"dust_{band}": dimming}


def _types(
    early: np.ndarray, z: np.ndarray, magnitude: np.ndarray, uniform: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the templates of bulges and of disks, 0 for the reddest; r - H follows COSMOS2020 (r 20 to 26)."""
    last = STEPS * (len(TEMPLATES) - 1)
    young = np.clip(0.5 * (magnitude - 20), 0, 3.5)
    disk = np.where(early, 2 + 2 * uniform, STEPS + (last - STEPS) * uniform ** (1 / (1.0 + young)))
    disk = np.clip(np.rint(disk), 0, last).astype(int)
    # bulges are redder than their disks, those of late galaxies by a template
    bulge = np.where(early, np.where(z < 1.5, 0, STEPS - 1), disk - STEPS)
    return bulge, disk


def _own_dust(early: np.ndarray, magnitude: np.ndarray, uniform: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return A_V of bulges and of disks: exponential, and less of it in the faint."""
    mean = np.where(early, 0.03, np.clip(0.3 - 0.04 * (magnitude - 21), 0.08, 0.3))
    disk = np.minimum(-mean * np.log1p(-uniform), LARGEST_AV)
    return 0.3 * disk, disk
