"""A plausible truth universe, a small HEALPix cell at a time: counts, redshifts, sizes, colours, lensing, stars.

Cells of a fixed order are the unit of randomness, so the rows do not depend on how the catalog is partitioned.
"""

from __future__ import annotations

import astropy.units as u
import cdshealpix.nested as healpix
import numpy as np
import pandas as pd
from scipy.stats import gamma

from romandask.kernels.photometry import node_photons
from romandask.model.seeds import rng
from romandask.model.sky import cell_area, unit_vectors
from romandask.model.spectra import Bandpass, LibrarySpectra, SpectrumLibrary

CELL_ORDER = 12
"""HEALPix order of the cells that are generated at a time, 51.5 arcsec wide."""
GALAXY_TEMPLATES = ("CWW_E", "CWW_Sbc", "CWW_Scd", "CWW_Im")
STAR_TEMPERATURES = (2600, 3000, 3400, 3800, 4400, 5000, 5700, 6500, 8000, 11000)
"""Kelvin, of the blackbodies that stand in for stars."""

GALAXY_COUNTS = np.array(
    [
        [16, -3.0], [18, -1.75], [20, -0.6], [22, 0.45], [24, 1.22],
        [25, 1.52], [26, 1.84], [27, 2.16], [28, 2.475], [29, 2.776],
    ]
)  # fmt: skip
"""r (AB) against log10 of the galaxies a square arcminute brighter than it: SDSS, HSC and HUDF counts, scaled to the
paper's 2.15 million a square degree at r < 29."""
STAR_COUNTS = np.array(
    [[14, -1.4], [16, -0.9], [18, -0.55], [20, -0.2], [22, 0.05], [24, 0.25], [26, 0.42], [29, 0.598]]
)
"""The same for stars at high Galactic latitude, scaled to the paper's 218,080 over 15.3 square degrees."""
MAX_REDSHIFT = 3.0
SHAPE_NOISE = 0.247
"""Ellipticity dispersion a component (paper: 0.35 in total)."""


def galaxies(cell: int, seed: int, density: float, library: SpectrumLibrary, r_band: Bandpass) -> pd.DataFrame:
    """Return the galaxies of one cell, without fluxes; `density` is galaxies to r < 29 a square arcminute.

    Magnitude: the counts above. Redshift: p(z | r) ~ z^2 exp(-z / z0), z0 = 0.0417 r - 0.744 (LSST Science Book, sect.
    3.7.2), below 3. Half-light radius: 0.25 arcsec at r = 25, falling 0.1 dex a magnitude, 0.2 dex of scatter (COSMOS).
    Bulges hold less of bluer, fainter galaxies. Knots take up to 30 per cent of the disks of a third of the galaxies
    brighter than r = 27, fewer for the small.
    """
    random = rng(seed, "truth", "galaxies", cell)
    n = random.poisson(density * cell_area(CELL_ORDER))
    ra, dec = _positions(random, cell, n)
    mag = _magnitudes(random, n, GALAXY_COUNTS)
    scale = np.maximum(0.0417 * mag - 0.744, 0.02)
    redshift = gamma.ppf(random.random(n) * gamma.cdf(MAX_REDSHIFT / scale, 3), 3) * scale
    redshift = np.clip(redshift, 0.01, MAX_REDSHIFT)

    early = random.random(n) < np.clip(0.45 - 0.04 * (mag - 20) - 0.08 * redshift, 0.04, 0.6)
    bulge_share = np.where(early, random.uniform(0.5, 1.0, n), random.beta(1.0, 6.0, n))
    late_type = 1 + random.integers(0, 3, n)
    bulge_sed = np.where(redshift < 1.5, 0, 1)
    disk_sed = np.where(early, 1, late_type)

    radius = 10 ** (np.log10(0.25) - 0.1 * (mag - 25) + 0.2 * random.standard_normal(n))
    radius = np.clip(radius, 0.02, 8.0)
    bulge_radius = radius * np.clip(0.5 * 10 ** (0.15 * random.standard_normal(n)), 0.1, 1.2)
    ellipticity = np.minimum(SHAPE_NOISE * np.hypot(*random.standard_normal((2, n))), 0.85)
    ratio = (1 - ellipticity) / (1 + ellipticity)
    bulge_ratio = (1 - 0.6 * ellipticity) / (1 + 0.6 * ellipticity)

    knotty = (mag < 27) & ~early & (random.random(n) < np.clip(radius / 0.6, 0, 0.7))
    knot_share = np.where(knotty, random.uniform(0.05, 0.3, n), 0.0)
    disk_av = np.where(early, 0.1, 1.0) * random.exponential(0.3, n)
    bulge_av = 0.3 * disk_av
    convergence, shear_1, shear_2 = lensing(ra, dec, redshift, seed)
    frame = pd.DataFrame(
        {
            "galaxy_id": (np.int64(cell) << 24) + np.arange(n),
            "ra": ra,
            "dec": dec,
            "redshift": redshift,
            "shear_1": shear_1,
            "shear_2": shear_2,
            "convergence": convergence,
            "size_bulge_true": bulge_radius / np.sqrt(bulge_ratio),
            "size_minor_bulge_true": bulge_radius * np.sqrt(bulge_ratio),
            "size_disk_true": radius / np.sqrt(ratio),
            "size_minor_disk_true": radius * np.sqrt(ratio),
            "position_angle_unlensed": random.uniform(0, 180, n),
            "n_knots": np.where(knotty, random.integers(2, 30, n), 0),
            "bulge_av": np.minimum(bulge_av, 2.0),
            "bulge_rv": 3.1,
            "disk_av": np.minimum(disk_av, 2.0),
            "disk_rv": 3.1,
            "MW_av": 0.03,
            "MW_rv": 3.1,
            "bulge_sed": bulge_sed,
            "disk_sed": disk_sed,
            "knots_sed": disk_sed,
        }
    )
    shares = {
        "bulge": bulge_share,
        "disk": (1 - bulge_share) * (1 - knot_share),
        "knots": (1 - bulge_share) * knot_share,
    }
    for component, share in shares.items():
        frame[f"{component}_magnorm"] = _magnorm(frame, component, mag, share, library, r_band)
    return frame


def stars(cell: int, seed: int, density: float, library: SpectrumLibrary, r_band: Bandpass) -> pd.DataFrame:
    """Return the stars of one cell, without fluxes; `density` is stars to r < 29 a square arcminute."""
    random = rng(seed, "truth", "stars", cell)
    n = random.poisson(density * cell_area(CELL_ORDER))
    ra, dec = _positions(random, cell, n)
    mag = _magnitudes(random, n, STAR_COUNTS)
    # faint stars are mostly red dwarfs, bright ones near the turn-off
    warmth = np.clip(0.75 - 0.05 * (mag - 16) + 0.18 * random.standard_normal(n), 0, 0.999)
    sed = len(GALAXY_TEMPLATES) + (warmth * len(STAR_TEMPERATURES)).astype(int)
    none = np.zeros(n)
    unit = node_photons(
        none, LibrarySpectra(library, sed), none, none, none, np.full(n, 0.03), np.full(n, 3.1), r_band
    ).sum(axis=1)
    return pd.DataFrame(
        {
            "id": (np.int64(cell) << 24) + (1 << 23) + np.arange(n),
            "ra": ra,
            "dec": dec,
            "magnorm": mag + 2.5 * np.log10(unit / r_band.ab_photons()),
            "sed": sed,
            "MW_av": 0.03,
            "MW_rv": 3.1,
        }
    )


def lensing(ra, dec, redshift, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return convergence and shear (GalSim's sky frame) of a smooth random potential: one field, so they agree.

    A sum of plane waves of the deflection potential over the sphere's tangent plane at each position's own declination,
    with periods from 10 to 100 arcmin; the amplitude grows with redshift to an rms convergence of 0.02 at z = 1.5.
    """
    random = rng(seed, "truth", "lensing")
    modes = 24
    vectors = unit_vectors(ra, dec)
    ra, dec = np.radians(ra), np.radians(dec)
    west = np.stack([np.sin(ra), -np.cos(ra), np.zeros_like(ra)], -1)
    north = np.stack([-np.sin(dec) * np.cos(ra), -np.sin(dec) * np.sin(ra), np.cos(dec)], -1)
    period = np.radians(10 ** random.uniform(np.log10(10 / 60), np.log10(100 / 60), modes))
    wave = random.standard_normal((modes, 3))
    wave *= (2 * np.pi / period / np.linalg.norm(wave, axis=1))[:, None]
    phase = random.uniform(0, 2 * np.pi, modes)
    growth = np.clip(np.asarray(redshift) / 1.5, 0, 1.6) * 0.02 / np.sqrt(modes / 2)
    kappa, g1, g2 = np.zeros(len(vectors)), np.zeros(len(vectors)), np.zeros(len(vectors))
    for k, offset in zip(wave, phase, strict=True):
        u, v = west @ k, north @ k
        value = np.cos(vectors @ k + offset) / np.maximum(k @ k, 1e-12)
        kappa += value * (u * u + v * v)
        g1 += value * (u * u - v * v)
        g2 += value * 2 * u * v
    return kappa * growth, g1 * growth, g2 * growth


def _positions(random: np.random.Generator, cell: int, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Uniform in the cell: random cells of order 29 (0.4 mas) inside it, for HEALPix cells have equal areas."""
    depth = 2 * (29 - CELL_ORDER)
    inside = (np.int64(cell) << depth) + random.integers(0, 1 << depth, n)
    if n == 0:
        return np.empty(0), np.empty(0)
    lon, lat = healpix.healpix_to_lonlat(inside.astype(np.uint64), 29)
    return lon.to_value(u.deg), lat.to_value(u.deg)


def _magnitudes(random: np.random.Generator, n: int, counts: np.ndarray) -> np.ndarray:
    total = counts[-1, 1]
    drawn = total + np.log10(np.maximum(random.random(n), 1e-12))
    return np.interp(drawn, counts[:, 1], counts[:, 0])


def _magnorm(
    frame: pd.DataFrame, component: str, mag: np.ndarray, share: np.ndarray, library: SpectrumLibrary, r_band: Bandpass
) -> np.ndarray:
    """Return the magnorm that gives a component its share of the observed r magnitude; inf without light."""
    dust = "bulge" if component == "bulge" else "disk"
    unit = node_photons(
        np.zeros(len(frame)),
        LibrarySpectra(library, frame[f"{component}_sed"].to_numpy()),
        frame["redshift"].to_numpy(),
        frame[f"{dust}_av"].to_numpy(),
        frame[f"{dust}_rv"].to_numpy(),
        frame["MW_av"].to_numpy(),
        frame["MW_rv"].to_numpy(),
        r_band,
    ).sum(axis=1)
    with np.errstate(divide="ignore"):
        return mag - 2.5 * np.log10(share) + 2.5 * np.log10(unit / r_band.ab_photons())
