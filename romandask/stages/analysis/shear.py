"""Lensing: two-point functions of the true shapes of detected galaxies, their covariance, and what is expected.

The sky is cut in patches, by which the jackknife goes too: a unit counts the pairs of one patch, and of it with those
that come after, so that no worker holds more than the galaxies of two.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
import pandas as pd
import treecorr

from romandask.kernels.measurement.shear import convergence_power, correlations, covariance, shapes, signal_to_noise
from romandask.model.settings import LensingSettings
from romandask.model.sky import Region
from romandask.products.hats import rows_around
from romandask.products.schemas import schema
from romandask.products.tables import TableProduct
from romandask.products.units import Unit
from romandask.stages.stage import UNITS_FROM_POINTINGS, Stage, SurveyContext
from romandask.stages.truth.catalogs import truth_of
from romandask.storage.store import Store

ARCMIN = np.radians(1 / 60)
REDSHIFTS = np.linspace(0, 4, 81)
"""Bins in which the sources' redshifts are counted."""
SHAPE_COLUMNS = [
    "_healpix_29",
    "galaxy_id",
    "ra",
    "dec",
    "redshift",
    "shear_1",
    "shear_2",
    "convergence",
    "position_angle_unlensed",
    "size_disk_true",
    "size_minor_disk_true",
    "size_bulge_true",
    "size_minor_bulge_true",
    "disk_magnorm",
]
SUMS = ("pairs", "weight", "separation", "xip", "xim")
"""What is summed over the pairs of two patches."""


@dataclass(frozen=True)
class Lensing:
    """The stages of the two-point functions of one survey's sample."""

    shapes: TableProduct
    """Lensed shapes of the sample's true galaxies."""
    pairs: TableProduct
    """Sums over the pairs of patches."""
    shear: TableProduct
    """Two-point functions, their covariance and expectation."""


def lensing(
    sample: TableProduct,
    galaxies: TableProduct,
    settings: LensingSettings,
    region: Region,
    store: Store | None = None,
) -> Lensing:
    """Return the lazy stages (schemas: catalogs/shapes.yaml, pairs.yaml, shear.yaml) of a survey's sample.

    `store` is where the stages before the last are read, where they are stored.
    """
    name, state = sample.stage.split("/")[1], {"settings": settings.model_dump(), "region": vars(region)}
    own = tuple((product.stage, unit) for product in (sample, galaxies) for unit in product.names)
    shaped = TableProduct(
        stage=f"shapes/{name}",
        units=tuple(Unit(unit, {"sample": unit}, own) for unit in sample.names),
        make=MeasureShapes(sample, galaxies),
        schema=schema("shapes"),
        pixels=sample.pixels,
        order=sample.order,
        bytes_per_unit=400 << 20,
        store=store,
    )
    boxes = patches(region, settings.patches) if len(separations(settings, region)) > 1 else []
    sources = tuple((shaped.stage, unit) for unit in shaped.names)
    pairs = TableProduct(
        stage=f"shear_pairs/{name}",
        units=tuple(Unit(f"{k}", {**state, "patch": k}, sources) for k in range(len(boxes))),
        make=CountPairs(shaped, settings, region),
        schema=schema("pairs"),
        bytes_per_unit=700 << 20,
        store=store,
    )
    counted = tuple((pairs.stage, unit) for unit in pairs.names)
    found = TableProduct(
        stage=f"shear/{name}",
        units=(Unit("all", state, sources + counted),),
        make=MeasureShear(shaped, pairs, settings, region),
        schema=schema("shear"),
        bytes_per_unit=500 << 20,
        store=store,
    )
    return Lensing(shaped, pairs, found)


def separations(settings: LensingSettings, region: Region) -> np.ndarray:
    """Return the edges of the bins, arcmin: they end at a half of the region's shorter side."""
    height = (region.dec_max - region.dec_min) * 60
    width = region.width * 60 * np.cos(np.radians((region.dec_max + region.dec_min) / 2))
    limit = min(settings.max_separation, min(width, height) / 2)
    every = np.geomspace(settings.min_separation, settings.max_separation, settings.bins + 1)
    return every[every <= limit * (1 + 1e-9)]


def patches(region: Region, count: int) -> list[Region]:
    """Return boxes of equal area, all but square, that cover a region: about as many as are asked for."""
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


@dataclass(frozen=True)
class MeasureShapes:
    """Measures the lensed shapes of the true galaxies that the objects of a sample are."""

    sample: TableProduct
    galaxies: TableProduct

    def __call__(self, index: int) -> pd.DataFrame:
        """Return the galaxies that lie in one partition of the sample, each once whatever the number of its pieces."""
        pixel, order = (self.sample.pixels or ())[index], self.sample.order or 0
        # a galaxy's objects may lie beyond the border
        wanted = rows_around(self.sample, pixel, order, ["truth_id", "star"])
        ids = wanted.loc[~wanted["star"].to_numpy(bool) & (wanted["truth_id"] >= 0), "truth_id"].to_numpy()
        rows = self.galaxies.rows_in(np.array([pixel]), order, SHAPE_COLUMNS)
        rows = rows[np.isin(rows["galaxy_id"].to_numpy(), ids)]
        return rows[["_healpix_29", "galaxy_id", "ra", "dec", "redshift"]].assign(**true_shapes(rows))


@dataclass(frozen=True)
class CountPairs:
    """Sums over the pairs of galaxies of a patch, and of it with each that comes after it."""

    shapes: TableProduct
    settings: LensingSettings
    region: Region

    def __call__(self, index: int) -> pd.DataFrame:
        """Return a row a pair of patches and bin of separation (schema: catalogs/pairs.yaml)."""
        boxes, edges = patches(self.region, self.settings.patches), separations(self.settings, self.region)
        first = self.galaxies(boxes[index])
        parts = [pair_sums(index, index, first, None, edges)]
        for other in range(index + 1, len(boxes)):
            if len(first):
                parts.append(pair_sums(index, other, first, self.galaxies(boxes[other]), edges))
        return pd.concat(parts, ignore_index=True)

    def galaxies(self, box: Region) -> pd.DataFrame:
        """Return the galaxies of a patch."""
        order = self.shapes.order or 0
        rows = self.shapes.rows_in(box.cells(order), order, ["ra", "dec", "g1", "g2"])
        return rows[box.contains(rows["ra"], rows["dec"])]


@dataclass(frozen=True)
class MeasureShear:
    """Measures the two-point functions of a sample."""

    shapes: TableProduct
    pairs: TableProduct
    settings: LensingSettings
    region: Region

    def __call__(self, index: int) -> pd.DataFrame:
        """Return a row a bin of separation."""
        count, power, redshifts = 0, 0.0, np.zeros(len(REDSHIFTS) - 1)
        for k in range(len(self.shapes.units)):
            rows = self.shapes.select(k, ["ra", "dec", "redshift", "g1", "g2"])
            rows = rows[self.region.contains(rows["ra"], rows["dec"])]
            count, power = count + len(rows), power + float((rows["g1"] ** 2 + rows["g2"] ** 2).sum())
            redshifts += np.histogram(rows["redshift"], REDSHIFTS)[0]
        if not self.pairs.units or count < 2:
            return schema("shear").empty_table().to_pandas()
        sigma = np.sqrt(power / count / 2)
        return table_of(self.pairs.all_rows(), count, sigma, redshifts, self.settings, self.region)


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


def pair_sums(
    number: int, other: int, first: pd.DataFrame, second: pd.DataFrame | None, edges: np.ndarray
) -> pd.DataFrame:
    """Return the sums over the pairs of two patches, or of one with itself (`second` None): a row a bin.

    Parameters
    ----------
    first, second : ra, dec (degrees), g1, g2
    edges : of the bins of separation, arcmin
    """
    bins = len(edges) - 1
    sums = np.zeros((len(SUMS), bins))
    if len(first) and (second is None or len(second)):
        counted = treecorr.GGCorrelation(
            min_sep=edges[0],
            max_sep=edges[-1],
            nbins=bins,
            sep_units="arcmin",
        )
        with _one_thread():
            if second is None:
                counted.process_auto(_catalog(first))
            else:
                counted.process_cross(_catalog(first), _catalog(second))
        # before they are divided by the weight
        sums = np.stack([counted.npairs, counted.weight, counted.meanr, counted.xip, counted.xim])
        sums[2] /= ARCMIN
    return pd.DataFrame(
        {"first": number, "second": other, "bin": np.arange(bins), **dict(zip(SUMS, sums, strict=True))}
    )


@contextmanager
def _one_thread() -> Iterator[None]:
    """Keep TreeCorr to one thread: its catalogs take every core, and beside another worker their threads only wait."""
    most = treecorr.util.max_omp_threads
    treecorr.set_max_omp_threads(1)
    try:
        yield
    finally:
        treecorr.set_max_omp_threads(most)


def _catalog(galaxies: pd.DataFrame) -> treecorr.Catalog:
    names = ("ra", "dec", "g1", "g2")
    columns = {name: galaxies[name].to_numpy(float) for name in names}
    return treecorr.Catalog(**columns, ra_units="deg", dec_units="deg")


def two_point(galaxies: pd.DataFrame, settings: LensingSettings, region: Region) -> pd.DataFrame:
    """Return xi+ and xi- of shapes in memory, with errors and expectation (schema: catalogs/shear.yaml).

    Parameters
    ----------
    galaxies : ra, dec (degrees), redshift, g1, g2
    region : whose solid angle they fill; separations end at a half of its shorter side
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
    return table_of(pd.concat(sums), len(galaxies), sigma, count, settings, region)


def table_of(
    sums: pd.DataFrame, galaxies: int, sigma: float, redshifts: np.ndarray, settings: LensingSettings, region: Region
) -> pd.DataFrame:
    """Return the table of two-point functions (schema: catalogs/shear.yaml) of the sums over pairs of patches.

    Parameters
    ----------
    galaxies, sigma, redshifts : number, rms of a component, and counts in REDSHIFTS of the whole sample
    """
    edges = separations(settings, region)
    total = sums.groupby("bin")[list(SUMS)].sum()
    weight = total["weight"].to_numpy()
    means = {name: total[name].to_numpy() / np.where(weight > 0, weight, np.nan) for name in SUMS[2:]}
    # TreeCorr's are chords until all are counted
    means["separation"] = 2 * np.arcsin(means["separation"] * ARCMIN / 2) / ARCMIN
    area = region.area * ARCMIN**2
    power = convergence_power(REDSHIFTS, redshifts)
    expected = correlations(edges * ARCMIN, power)
    # TreeCorr counts a pair once, with one weight
    matrix = covariance(edges * ARCMIN, power, area, galaxies / area, sigma, np.maximum(total["pairs"].to_numpy(), 1))
    bins, own = len(edges) - 1, np.sqrt(np.diag(matrix))
    spread = jackknife(sums, bins)
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
            "xip_error": own[:bins],
            "xim_error": own[bins:],
            "xip_jackknife": spread[0],
            "xim_jackknife": spread[1],
            "covariance_xip": list(matrix[:bins].astype(np.float32)),
            "covariance_xim": list(matrix[bins:].astype(np.float32)),
            "galaxies": galaxies,
            "sigma": sigma,
        }
    )


def jackknife(sums: pd.DataFrame, bins: int) -> np.ndarray:
    """Return the errors (2, bins) of xi+ and xi- from leaving out a patch at a time.

    Of the pairs of a patch with others a part is left out, by which auto- and cross-pairs count alike (Mohammad &
    Percival 2022, equation 27).
    """
    table = sums.pivot_table(index=["first", "second"], columns="bin", values=["weight", "xip", "xim"]).fillna(0)
    first, second = (table.index.get_level_values(name).to_numpy() for name in ("first", "second"))
    values = np.stack([table[name].reindex(columns=range(bins)).to_numpy() for name in ("weight", "xip", "xim")])
    known = np.unique(first[(first == second) & (values[0].sum(axis=1) > 0)])
    count = len(known)
    if count < 2:
        return np.full((2, bins), np.nan)
    kept = 1 - count / (2 + np.sqrt(2) * (count - 1))
    found = []
    for patch in known:
        share = np.where((first == patch) | (second == patch), np.where(first == second, 0, kept), 1)
        weight, xip, xim = np.tensordot(values, share, (1, 0))
        found.append(np.stack([xip, xim]) / np.where(weight > 0, weight, np.nan))
    samples = np.array(found)
    return np.sqrt((count - 1) / count * ((samples - samples.mean(axis=0)) ** 2).sum(axis=0))


def build_lensing(context: SurveyContext, survey: str) -> Lensing:
    """Return the stages of the two-point functions of an instrument's sample."""
    galaxies = context.once(truth_of).galaxies
    return lensing(
        context.output(f"samples/{survey}"), galaxies, context.pipeline.lensing, context.region, context.store
    )


SHAPES = Stage(
    name="shapes",
    per_survey=True,
    build=lambda context, survey: context.once(build_lensing, survey).shapes,
    reads=("samples", "truth/galaxies"),
    units_known_after=UNITS_FROM_POINTINGS,
    unit="HEALPix cell",
    summary="Lensed shapes of the true galaxies of the sample.",
    tables={"shapes": "shapes/<survey>/"},
)
SHEAR_PAIRS = Stage(
    name="shear_pairs",
    per_survey=True,
    build=lambda context, survey: context.once(build_lensing, survey).pairs,
    reads=("shapes",),
    units_known_after=UNITS_FROM_POINTINGS,
    unit="patch of the sky",
    summary="Sums over the pairs of galaxies of a patch, and of it with each later patch (TreeCorr).",
    tables={"pairs": "shear_pairs/<survey>/"},
)
SHEAR = Stage(
    name="shear",
    per_survey=True,
    build=lambda context, survey: context.once(build_lensing, survey).shear,
    reads=("shapes", "shear_pairs"),
    units_known_after=UNITS_FROM_POINTINGS,
    unit="survey",
    summary="xi+ and xi- of true shapes, with Gaussian covariance, jackknife and theory.",
    tables={"shear": "shear/<survey>/"},
)
