"""Two-point functions of galaxy shapes, from sums over the pairs of galaxies of patches of the sky (TreeCorr)."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import cast

import numpy as np
import pandas as pd
import treecorr

from romandask.kernels.measurement.shear import convergence_power, correlations, covariance, signal_to_noise
from romandask.model.settings import LensingSettings
from romandask.model.sky import Region
from romandask.products.schemas import schema

ARCMIN = np.radians(1 / 60)
"""One arcminute, radians."""
REDSHIFTS = np.linspace(0, 4, 81)
"""Edges of the bins in which the redshifts of the galaxies are counted."""
SUMS = ("pairs", "weight", "separation", "xip", "xim")
"""Quantities that are summed over the pairs of two patches."""


def separations(settings: LensingSettings, region: Region) -> np.ndarray:
    """Return the edges of the bins of separation, arcmin, up to half the shorter side of the region."""
    height = (region.dec_max - region.dec_min) * 60
    width = region.width * 60 * np.cos(np.radians((region.dec_max + region.dec_min) / 2))
    limit = min(settings.max_separation, min(width, height) / 2)
    edges = np.geomspace(settings.min_separation, settings.max_separation, settings.bins + 1)
    return edges[edges <= limit * (1 + 1e-9)]


def patches(region: Region, count: int) -> list[Region]:
    """Return approximately `count` boxes of equal area, nearly square, that cover a region without overlap."""
    height = region.dec_max - region.dec_min
    width = region.width * np.cos(np.radians((region.dec_max + region.dec_min) / 2))
    rows = max(1, round(np.sqrt(count * height / width)))
    columns = max(1, round(count / rows))
    low, high = np.sin(np.radians([region.dec_min, region.dec_max]))
    dec = np.degrees(np.arcsin(np.linspace(low, high, rows + 1)))
    dec[0], dec[-1] = region.dec_min, region.dec_max
    ra = region.ra_min + region.width * np.linspace(0, 1, columns + 1)
    return [
        Region(ra[i] % 360, ra[i + 1] % 360 or 360.0, dec[j], dec[j + 1]) for j in range(rows) for i in range(columns)
    ]


def pair_sums(
    first_patch: int, second_patch: int, first: pd.DataFrame, second: pd.DataFrame | None, edges: np.ndarray
) -> pd.DataFrame:
    """Return the sums over the pairs of galaxies of two patches, or within one patch.

    Parameters
    ----------
    first_patch, second_patch : int
        Numbers of the patches.
    first, second : DataFrame
        Galaxies of the patches: ra, dec (degrees), g1 and g2; `second` is None for pairs within the first patch.
    edges : ndarray, shape (bins + 1,), arcmin
        Edges of the bins of separation.

    Returns
    -------
    DataFrame
        One row per bin (schema: catalogs/pairs.yaml).
    """
    bins = len(edges) - 1
    sums = np.zeros((len(SUMS), bins))
    if len(first) and (second is None or len(second)):
        correlation = treecorr.GGCorrelation(
            min_sep=edges[0],
            max_sep=edges[-1],
            nbins=bins,
            sep_units="arcmin",
        )
        with _one_thread():
            if second is None:
                correlation.process_auto(_catalog(first))
            else:
                correlation.process_cross(_catalog(first), _catalog(second))
        # TreeCorr divides these by the weight only when it finalises the correlation
        sums = np.stack([correlation.npairs, correlation.weight, correlation.meanr, correlation.xip, correlation.xim])
        sums[SUMS.index("separation")] /= ARCMIN
    return pd.DataFrame(
        {"first": first_patch, "second": second_patch, "bin": np.arange(bins), **dict(zip(SUMS, sums, strict=True))}
    )


@contextmanager
def _one_thread() -> Iterator[None]:
    """Limit TreeCorr to one thread; it would use all cores, and workers would slow each other down."""
    previous = treecorr.util.max_omp_threads
    treecorr.set_max_omp_threads(1)
    try:
        yield
    finally:
        treecorr.set_max_omp_threads(previous)


def _catalog(galaxies: pd.DataFrame) -> treecorr.Catalog:
    names = ("ra", "dec", "g1", "g2")
    columns = {name: galaxies[name].to_numpy(float) for name in names}
    return treecorr.Catalog(**columns, ra_units="deg", dec_units="deg")


def two_point(galaxies: pd.DataFrame, settings: LensingSettings, region: Region) -> pd.DataFrame:
    """Return the two-point functions of shapes in memory (schema: catalogs/shear.yaml).

    Parameters
    ----------
    galaxies : DataFrame
        Columns ra, dec (degrees), redshift, g1 and g2.
    settings : LensingSettings
    region : Region
        Region that the galaxies fill; separations reach at most half its shorter side.
    """
    edges = separations(settings, region)
    if len(edges) < 2 or len(galaxies) < 2:
        return schema("shear").empty_table().to_pandas()
    boxes = patches(region, settings.patches)
    parts = [galaxies[box.contains(galaxies["ra"], galaxies["dec"])] for box in boxes]
    sums = [
        pair_sums(i, j, parts[i], None if i == j else parts[j], edges)
        for i in range(len(boxes))
        for j in range(i, len(boxes))
    ]
    sigma = float(np.sqrt(np.mean(galaxies["g1"] ** 2 + galaxies["g2"] ** 2) / 2))
    count, _ = np.histogram(galaxies["redshift"], REDSHIFTS)
    return two_point_table(pd.concat(sums), len(galaxies), sigma, count, settings, region)


def two_point_table(
    sums: pd.DataFrame, galaxies: int, sigma: float, redshifts: np.ndarray, settings: LensingSettings, region: Region
) -> pd.DataFrame:
    """Return the two-point functions (schema: catalogs/shear.yaml) from the sums over pairs of galaxies.

    Parameters
    ----------
    sums : DataFrame
        Sums for all pairs of patches, as `pair_sums` returns them.
    galaxies : int
        Number of galaxies of the sample.
    sigma : float
        Rms of one component of their ellipticity.
    redshifts : ndarray, shape (len(REDSHIFTS) - 1,)
        Number of galaxies in each bin of redshift.
    settings : LensingSettings
    region : Region
    """
    edges = separations(settings, region)
    total = sums.groupby("bin")[list(SUMS)].sum()
    weight = total["weight"].to_numpy()
    means = {name: total[name].to_numpy() / np.where(weight > 0, weight, np.nan) for name in SUMS[2:]}
    # TreeCorr sums chords; convert the mean chord to an angle
    means["separation"] = 2 * np.arcsin(means["separation"] * ARCMIN / 2) / ARCMIN
    area = region.area * ARCMIN**2
    power = convergence_power(REDSHIFTS, redshifts)
    expected = correlations(edges * ARCMIN, power)
    # TreeCorr counts each pair once, as the covariance expects
    matrix = covariance(edges * ARCMIN, power, area, galaxies / area, sigma, np.maximum(total["pairs"].to_numpy(), 1))
    bins, errors = len(edges) - 1, np.sqrt(np.diag(matrix))
    jackknife_errors = jackknife(sums, bins)
    return pd.DataFrame(
        {
            "low": edges[:-1],
            "high": edges[1:],
            "separation": means["separation"],
            "pairs": total["pairs"].to_numpy(),
            "xip": means["xip"],
            "xim": means["xim"],
            "xip_theory": expected[0],
            "xim_theory": expected[1],
            "xip_error": errors[:bins],
            "xim_error": errors[bins:],
            "xip_jackknife": jackknife_errors[0],
            "xim_jackknife": jackknife_errors[1],
            "covariance_xip": list(matrix[:bins].astype(np.float32)),
            "covariance_xim": list(matrix[bins:].astype(np.float32)),
            "galaxies": galaxies,
            "sigma": sigma,
        }
    )


def jackknife(sums: pd.DataFrame, bins: int) -> np.ndarray:
    """Return the jackknife errors of xi+ and xi-, from leaving out one patch at a time.

    When a patch is left out, its own pairs are removed, and its pairs with other patches are removed in part, so that
    auto- and cross-pairs have the same weight (Mohammad & Percival 2022, equation 27).

    Parameters
    ----------
    sums : DataFrame
        Sums for all pairs of patches, as `pair_sums` returns them.
    bins : int
        Number of bins of separation.

    Returns
    -------
    ndarray, shape (2, bins)
        NaN with fewer than two patches that contain pairs.
    """
    table = sums.pivot_table(index=["first", "second"], columns="bin", values=["weight", "xip", "xim"]).fillna(0)
    first, second = (table.index.get_level_values(name).to_numpy() for name in ("first", "second"))
    # a name selects the columns of all bins, a frame; the stubs of pandas assume plain columns
    frames = [cast(pd.DataFrame, table[name]) for name in ("weight", "xip", "xim")]
    values = np.stack([frame.reindex(columns=range(bins)).to_numpy() for frame in frames])
    filled_patches = np.unique(first[(first == second) & (values[0].sum(axis=1) > 0)])
    count = len(filled_patches)
    if count < 2:
        return np.full((2, bins), np.nan)
    # share of the pairs with other patches that is kept
    kept = 1 - count / (2 + np.sqrt(2) * (count - 1))
    estimates = []
    for patch in filled_patches:
        share = np.where((first == patch) | (second == patch), np.where(first == second, 0, kept), 1)
        weight, xip, xim = np.tensordot(values, share, (1, 0))
        estimates.append(np.stack([xip, xim]) / np.where(weight > 0, weight, np.nan))
    samples = np.array(estimates)
    return np.sqrt((count - 1) / count * ((samples - samples.mean(axis=0)) ** 2).sum(axis=0))


def significance(table: pd.DataFrame) -> float:
    """Return the signal-to-noise ratio sqrt(xi^T C^-1 xi) of xi+ and xi- together.

    Parameters
    ----------
    table : DataFrame
        Two-point functions (schema: catalogs/shear.yaml); without rows the ratio is 0.
    """
    if not len(table):
        return 0.0
    matrix = np.array([*table["covariance_xip"], *table["covariance_xim"]], float)
    return signal_to_noise(np.concatenate([table["xip"], table["xim"]]), (matrix + matrix.T) / 2)
