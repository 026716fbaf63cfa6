"""Lensing: the stages of the two-point functions of the true shapes of detected galaxies.

The sky is divided into patches, which the jackknife uses as well. One unit counts the pairs within a patch and between
the patch and each later patch, so that a worker holds the galaxies of at most two patches.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd

from romandask.kernels.measurement.shear import shapes
from romandask.model.settings import LensingSettings
from romandask.model.sky import Region
from romandask.products.hats import rows_around
from romandask.products.schemas import schema
from romandask.products.tables import TableProduct
from romandask.products.units import Unit
from romandask.stages.analysis.two_point import REDSHIFTS, pair_sums, patches, separations, two_point_table
from romandask.stages.stage import UNITS_FROM_POINTINGS, Stage, SurveyContext
from romandask.stages.truth.catalogs import truth_of
from romandask.storage.store import Store

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
"""Columns of true galaxies that lensed shapes are computed from."""


@dataclass(frozen=True)
class Lensing:
    """The products of the lensing stages of one survey, in order."""

    shapes: TableProduct
    """Lensed shapes of the true galaxies of the sample (schema: catalogs/shapes.yaml)."""
    pairs: TableProduct
    """Sums over the pairs of galaxies of two patches (schema: catalogs/pairs.yaml)."""
    shear: TableProduct
    """Two-point functions, their errors and theory (schema: catalogs/shear.yaml)."""


def lensing(
    sample: TableProduct,
    galaxies: TableProduct,
    settings: LensingSettings,
    region: Region,
    store: Store | None = None,
) -> Lensing:
    """Return the lazy lensing products of a survey's sample.

    Parameters
    ----------
    sample : TableProduct
        Sample of the survey (schema: catalogs/samples.yaml).
    galaxies : TableProduct
        True galaxies (schema: catalogs/galaxies.yaml).
    settings : LensingSettings
        Section `lensing` of the pipeline.
    region : Region
        Region of the survey. Without room for a bin of separation, `pairs` has no units and `shear` no rows.
    store : Store, optional
        Store from which stored units are read; by default everything is made.
    """
    name, unit_settings = sample.stage.split("/")[1], {"settings": settings.model_dump(), "region": vars(region)}
    upstream = tuple((product.stage, unit) for product in (sample, galaxies) for unit in product.names)
    shapes_product = TableProduct(
        stage=f"shapes/{name}",
        units=tuple(Unit(unit, {"sample": unit}, upstream) for unit in sample.names),
        make=MeasureShapes(sample, galaxies),
        schema=schema("shapes"),
        pixels=sample.pixels,
        order=sample.order,
        bytes_per_unit=400 << 20,
        store=store,
    )
    boxes = patches(region, settings.patches) if len(separations(settings, region)) > 1 else []
    shape_units = tuple((shapes_product.stage, unit) for unit in shapes_product.names)
    pairs = TableProduct(
        stage=f"shear_pairs/{name}",
        units=tuple(Unit(f"{k}", {**unit_settings, "patch": k}, shape_units) for k in range(len(boxes))),
        make=CountPairs(shapes_product, settings, region),
        schema=schema("pairs"),
        bytes_per_unit=700 << 20,
        store=store,
    )
    pair_units = tuple((pairs.stage, unit) for unit in pairs.names)
    shear = TableProduct(
        stage=f"shear/{name}",
        units=(Unit("all", unit_settings, shape_units + pair_units),),
        make=MeasureShear(shapes_product, pairs, settings, region),
        schema=schema("shear"),
        bytes_per_unit=500 << 20,
        store=store,
    )
    return Lensing(shapes=shapes_product, pairs=pairs, shear=shear)


@dataclass(frozen=True)
class MeasureShapes:
    """Makes the lensed shapes of the true galaxies that are counterparts of the objects of a sample."""

    sample: TableProduct
    galaxies: TableProduct

    def __call__(self, index: int) -> pd.DataFrame:
        """Return the galaxies in one partition of the sample; a counterpart of several objects is one row."""
        pixel, order = (self.sample.pixels or ())[index], self.sample.order or 0
        # the objects of a galaxy may lie in the next partition
        objects = rows_around(self.sample, pixel, order, ["truth_id", "star"])
        ids = objects.loc[~objects["star"].to_numpy(bool) & (objects["truth_id"] >= 0), "truth_id"].to_numpy()
        rows = self.galaxies.rows_in(np.array([pixel]), order, SHAPE_COLUMNS)
        rows = rows[np.isin(rows["galaxy_id"].to_numpy(), ids)]
        return rows[["_healpix_29", "galaxy_id", "ra", "dec", "redshift"]].assign(**true_shapes(rows))


@dataclass(frozen=True)
class CountPairs:
    """Makes the sums over the pairs of galaxies within a patch and between it and each later patch."""

    shapes: TableProduct
    settings: LensingSettings
    region: Region

    def __call__(self, index: int) -> pd.DataFrame:
        """Return one row per pair of patches and bin of separation (schema: catalogs/pairs.yaml)."""
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
    """Makes the two-point functions of a sample."""

    shapes: TableProduct
    pairs: TableProduct
    settings: LensingSettings
    region: Region

    def __call__(self, index: int) -> pd.DataFrame:
        """Return one row per bin of separation (schema: catalogs/shear.yaml)."""
        count, power, redshifts = 0, 0.0, np.zeros(len(REDSHIFTS) - 1)
        for k in range(len(self.shapes.units)):
            rows = self.shapes.select(k, ["ra", "dec", "redshift", "g1", "g2"])
            rows = rows[self.region.contains(rows["ra"], rows["dec"])]
            count, power = count + len(rows), power + float((rows["g1"] ** 2 + rows["g2"] ** 2).sum())
            redshifts += np.histogram(rows["redshift"], REDSHIFTS)[0]
        if not self.pairs.units or count < 2:
            return schema("shear").empty_table().to_pandas()
        sigma = np.sqrt(power / count / 2)
        return two_point_table(self.pairs.all_rows(), count, sigma, redshifts, self.settings, self.region)


def true_shapes(galaxies: pd.DataFrame) -> dict[str, np.ndarray]:
    """Return the components `g1` and `g2` of the lensed ellipticity (a - b) / (a + b) of galaxies, (n,) each.

    The shape is that of the disk, or of the bulge for a galaxy without disk.

    Parameters
    ----------
    galaxies : DataFrame
        True galaxies, with the columns `SHAPE_COLUMNS`.
    """
    disk = np.isfinite(galaxies["disk_magnorm"].to_numpy(float))
    major, minor = (
        np.where(disk, galaxies[f"size_{axis}disk_true"], galaxies[f"size_{axis}bulge_true"]).astype(float)
        for axis in ("", "minor_")
    )
    names = ("position_angle_unlensed", "shear_1", "shear_2", "convergence")
    ellipticity = shapes(major, minor, *(galaxies[name].to_numpy(float) for name in names))
    return {"g1": ellipticity.real, "g2": ellipticity.imag}


def build_lensing(context: SurveyContext, survey: str) -> Lensing:
    """Return the lazy lensing products of a survey."""
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
    summary="The lensed shapes of the true galaxies that are counterparts of objects of the sample.",
    tables={"shapes": "shapes/<survey>/"},
)
SHEAR_PAIRS = Stage(
    name="shear_pairs",
    per_survey=True,
    build=lambda context, survey: context.once(build_lensing, survey).pairs,
    reads=("shapes",),
    units_known_after=UNITS_FROM_POINTINGS,
    unit="patch of the sky",
    summary="Sums over the pairs of galaxies within a patch and between it and each later patch (TreeCorr).",
    tables={"pairs": "shear_pairs/<survey>/"},
)
SHEAR = Stage(
    name="shear",
    per_survey=True,
    build=lambda context, survey: context.once(build_lensing, survey).shear,
    reads=("shapes", "shear_pairs"),
    units_known_after=UNITS_FROM_POINTINGS,
    unit="survey",
    summary="The two-point functions xi+ and xi- of the true shapes, with Gaussian covariance, jackknife errors and "
    "theory.",
    tables={"shear": "shear/<survey>/"},
)
