"""Lensing: two-point functions of the true shapes of detected galaxies, their covariance, and what is expected."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd
import treecorr

from romandask.kernels.shear import convergence_power, correlations, covariance, shapes, signal_to_noise
from romandask.model.config import LensingSettings
from romandask.model.seeds import rng
from romandask.model.sky import Region
from romandask.runtime.hats import rows_around
from romandask.runtime.schemas import schema
from romandask.runtime.tables import TableProduct
from romandask.runtime.units import Unit

ARCMIN = np.radians(1 / 60)
REDSHIFTS = np.linspace(0, 4, 81)
"""Bins in which the sources' redshifts are counted."""
SHAPE_COLUMNS = [
    "galaxy_id", "ra", "dec", "redshift", "shear_1", "shear_2", "convergence", "position_angle_unlensed",
    "size_disk_true", "size_minor_disk_true", "size_bulge_true", "size_minor_bulge_true", "disk_magnorm",
]  # fmt: skip
EACH = 10
"""Galaxies a patch that a jackknife has at least."""


def shear(
    sample: TableProduct, galaxies: TableProduct, settings: LensingSettings, region: Region, seed: int
) -> TableProduct:
    """Return the lazy two-point functions of a survey's sample (schema: catalogs/shear.yaml): one unit."""
    state = {"settings": settings.model_dump(), "region": vars(region), "seed": seed}
    upstream = tuple((product.stage, name) for product in (sample, galaxies) for name in product.names)
    return TableProduct(
        f"shear/{sample.stage.split('/')[1]}", (Unit("all", state, upstream),),
        MeasureShear(sample, galaxies, settings, region, seed), schema("shear"), bytes_per_unit=1200 << 20,
    )  # fmt: skip


@dataclass(frozen=True)
class MeasureShear:
    """Measures the two-point functions of a sample."""

    sample: TableProduct
    galaxies: TableProduct
    settings: LensingSettings
    region: Region
    seed: int

    def __call__(self, index: int) -> pd.DataFrame:
        """Return a row a bin of separation."""
        parts = [self.shapes(k) for k in range(len(self.sample.units))]
        found = pd.concat([part for part in parts if len(part)] or parts, ignore_index=True)
        # a galaxy in two pieces is one
        return two_point(found.drop_duplicates("galaxy_id"), self.settings, self.region, self.seed)

    def shapes(self, index: int) -> pd.DataFrame:
        """Return galaxy_id, ra, dec, redshift, g1 and g2 of the galaxies that one partition of the sample has."""
        wanted = self.sample.select(index, ["truth_id", "star"])
        ids = wanted.loc[~wanted["star"].to_numpy(bool) & (wanted["truth_id"] >= 0), "truth_id"].to_numpy()
        pixel, order = (self.sample.pixels or ())[index], self.sample.order or 0
        # a counterpart may lie beyond the border
        rows = rows_around(self.galaxies, pixel, order, SHAPE_COLUMNS)
        rows = rows[np.isin(rows["galaxy_id"].to_numpy(), ids)].drop_duplicates("galaxy_id")
        return rows[["galaxy_id", "ra", "dec", "redshift"]].assign(**true_shapes(rows))


def significance(table: pd.DataFrame) -> float:
    """Return the signal to noise of xi+ and xi- together, sqrt(xi^T C^-1 xi), of a table of `shear`; 0 without bins."""
    if not len(table):
        return 0.0
    matrix = np.array([*table["covariance_xip"], *table["covariance_xim"]], float)
    return signal_to_noise(np.concatenate([table["xip"], table["xim"]]), (matrix + matrix.T) / 2)


def true_shapes(galaxies: pd.DataFrame) -> dict[str, np.ndarray]:
    """Return g1 and g2 of galaxies: the lensed shape of the disk, or of the bulge where there is no disk."""
    disk = np.isfinite(galaxies["disk_magnorm"].to_numpy(float))
    major, minor = (
        np.where(disk, galaxies[f"size_{axis}disk_true"], galaxies[f"size_{axis}bulge_true"]).astype(float)
        for axis in ("", "minor_")
    )
    names = ("position_angle_unlensed", "shear_1", "shear_2", "convergence")
    found = shapes(major, minor, *(galaxies[name].to_numpy(float) for name in names))
    return {"g1": found.real, "g2": found.imag}


def two_point(galaxies: pd.DataFrame, settings: LensingSettings, region: Region, seed: int) -> pd.DataFrame:
    """Return xi+ and xi- of shapes, with errors and expectation (schema: catalogs/shear.yaml).

    Parameters
    ----------
    galaxies : ra, dec (degrees), redshift, g1, g2
    region : whose solid angle they fill; separations end at a half of its shorter side
    """
    height = (region.dec_max - region.dec_min) * 60
    width = region.width * 60 * np.cos(np.radians((region.dec_max + region.dec_min) / 2))
    limit = min(settings.max_separation, min(width, height) / 2)
    every = np.geomspace(settings.min_separation, settings.max_separation, settings.bins + 1)
    edges = every[every <= limit * (1 + 1e-9)]
    if len(edges) < 2 or len(galaxies) < 2 * EACH:
        return schema("shear").empty_table().to_pandas()
    patches = min(settings.patches, len(galaxies) // EACH)
    catalog = treecorr.Catalog(
        ra=galaxies["ra"].to_numpy(), dec=galaxies["dec"].to_numpy(), ra_units="deg", dec_units="deg",
        g1=galaxies["g1"].to_numpy(), g2=galaxies["g2"].to_numpy(), npatch=patches,
        rng=rng(seed, "shear", "patches"),
    )  # fmt: skip
    measured = treecorr.GGCorrelation(
        min_sep=edges[0], max_sep=edges[-1], nbins=len(edges) - 1, sep_units="arcmin", var_method="jackknife",
        num_threads=1, cross_patch_weight="match",
    )  # fmt: skip
    measured.process(catalog)
    count, _ = np.histogram(galaxies["redshift"], REDSHIFTS)
    sigma = np.sqrt(np.mean(galaxies["g1"] ** 2 + galaxies["g2"] ** 2) / 2)
    area = region.area * ARCMIN**2
    power = convergence_power(REDSHIFTS, count)
    expected = correlations(edges * ARCMIN, power)
    # TreeCorr counts a pair once, with one weight
    matrix = covariance(edges * ARCMIN, power, area, len(galaxies) / area, sigma, measured.npairs)
    bins, own = len(edges) - 1, np.sqrt(np.diag(matrix))
    jackknife = np.sqrt(np.diag(measured.cov))
    return pd.DataFrame({
        "low": edges[:-1], "high": edges[1:], "separation": measured.meanr, "pairs": measured.npairs,
        "xip": measured.xip, "xim": measured.xim, "xip_theory": expected[0], "xim_theory": expected[1],
        "xip_error": own[:bins], "xim_error": own[bins:],
        "xip_jackknife": jackknife[:bins], "xim_jackknife": jackknife[bins:],
        "covariance_xip": list(matrix[:bins].astype(np.float32)),
        "covariance_xim": list(matrix[bins:].astype(np.float32)),
        "galaxies": len(galaxies), "sigma": sigma,
    })  # fmt: skip
