"""Truth matching: the true counterpart of each detected object, and the detected objects of each true object."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from romandask.kernels.measurement.counterparts import counterparts
from romandask.model.sky import unit_vectors
from romandask.model.spectra import ab_magnitude
from romandask.products.schemas import schema
from romandask.products.tables import TableProduct
from romandask.products.units import Unit
from romandask.stages.detections.detections import Detections, owned, tile_cone
from romandask.stages.stage import UNITS_FROM_POINTINGS, Stage

BINS = np.arange(17.0, 30.01, 0.5)
"""Edges of the magnitude bins in which completeness and purity are computed."""


def truth_match(detections: Detections) -> TableProduct:
    """Return the lazy true counterparts of the objects of a survey (schema: catalogs/truth_match.yaml).

    Each tile is one unit. The counterpart of an object is the closest in magnitude, in the reference band, of the
    nearest true objects within `detections.match_radius` (see `kernels.measurement.counterparts`).
    """
    instrument = detections.instrument
    units = _units(
        detections,
        detections.inputs,
        {"radius": detections.settings.match_radius, "band": instrument.reference_band},
    )
    return TableProduct(
        stage=f"truth_match/{instrument.name}",
        units=units,
        make=MatchTile(detections),
        schema=schema("truth_match"),
        bytes_per_unit=600 << 20,
        seconds_per_unit=0.5,
    )


def truth_summary(matched: TableProduct, detections: Detections) -> TableProduct:
    """Return the lazy table of the true objects of a survey, detected or not (schema: catalogs/truth_summary.yaml).

    Each tile is one unit. It contains the true objects in the unique area of the tile that are brighter than
    `detections.summary_magnitude` in the reference band.

    Parameters
    ----------
    matched : TableProduct
        Counterparts of the objects (see `truth_match`).
    detections : Detections
        Detections of the survey.
    """
    instrument, bands = detections.instrument, detections.instrument.bands

    def inputs(tile: int) -> tuple[tuple[str, str], ...]:
        return ((matched.stage, matched.names[tile]),)

    units = _units(detections, inputs, {"faintest": detections.settings.summary_magnitude, "bands": bands})
    return TableProduct(
        stage=f"truth_summary/{instrument.name}",
        units=units,
        make=SummariseTile(matched, detections),
        schema=schema("truth_summary", bands),
        bytes_per_unit=600 << 20,
        seconds_per_unit=0.5,
    )


def completeness(summary: pd.DataFrame, matched: pd.DataFrame, band: str) -> pd.DataFrame:
    """Return completeness and purity in bins of magnitude.

    Parameters
    ----------
    summary : DataFrame
        True objects (schema: catalogs/truth_summary.yaml).
    matched : DataFrame
        Detected objects and their counterparts (schema: catalogs/truth_match.yaml).
    band : str
        Reference band.

    Returns
    -------
    DataFrame
        One row per bin: `magnitude`, its middle. In bins of true magnitude: `true`, the number of true objects,
        `found`, the number of those that were detected, and `completeness`, found / true. In bins of measured
        magnitude: `objects`, the number of detected objects, `real`, the number of those with a counterpart, and
        `purity`, real / objects. A ratio without objects is NaN.
    """
    true = ab_magnitude(summary[f"flux_{band}"])
    is_found = summary["objectId"].to_numpy() > 0
    measured, real = matched["magnitude"].to_numpy(float), matched["truth_id"].to_numpy() >= 0
    counts = [np.histogram(values, BINS)[0] for values in (true, true[is_found], measured, measured[real])]
    with np.errstate(divide="ignore", invalid="ignore"):
        return pd.DataFrame(
            {
                "magnitude": (BINS[1:] + BINS[:-1]) / 2,
                "true": counts[0],
                "found": counts[1],
                "completeness": counts[1] / counts[0],
                "objects": counts[2],
                "real": counts[3],
                "purity": counts[3] / counts[2],
            }
        )


@dataclass(frozen=True)
class MatchTile:
    """Makes the counterparts of the objects of one tile."""

    detections: Detections

    def __call__(self, index: int) -> pd.DataFrame:
        """Return one row per object (schema: catalogs/truth_match.yaml)."""
        detections = self.detections
        band = detections.instrument.reference_band
        objects = detections.tile_objects(index)
        true = detections.truth.brief(*tile_cone(detections.coadds, index)[:3], (band,))
        magnitude = ab_magnitude(objects[f"{band}_kronFlux"])
        matched = counterparts(
            unit_vectors(objects["coord_ra"].to_numpy(), objects["coord_dec"].to_numpy()),
            magnitude,
            unit_vectors(true["ra"].to_numpy(), true["dec"].to_numpy()),
            ab_magnitude(true[f"flux_{band}"]),
            np.radians(detections.settings.match_radius / 3600),
        )
        none = matched.row < 0
        rows = true.iloc[np.where(none, 0, matched.row)] if len(true) else true.reindex(range(len(objects)))
        return pd.DataFrame(
            {
                "objectId": objects["objectId"].to_numpy(),
                "truth_id": np.where(none, -1, rows["id"].fillna(-1).to_numpy()).astype(np.int64),
                "star": np.where(none, False, rows["star"].fillna(False).to_numpy(bool)),
                "separation": np.degrees(matched.separation) * 3600,
                "candidates": matched.candidates.astype(np.int32),
                "magnitude": magnitude,
                "true_magnitude": np.where(none, np.nan, ab_magnitude(rows[f"flux_{band}"])),
            }
        )


@dataclass(frozen=True)
class SummariseTile:
    """Makes the table of the true objects of one tile."""

    matched: TableProduct
    detections: Detections

    def __call__(self, index: int) -> pd.DataFrame:
        """Return one row per true object (schema: catalogs/truth_summary.yaml)."""
        detections = self.detections
        bands, band = detections.instrument.bands, detections.instrument.reference_band
        true = detections.truth.brief(*tile_cone(detections.coadds, index)[:3], bands)
        tile, grid = detections.tiles[index], detections.coadds.settings.grid()
        in_tile = owned(true["ra"].to_numpy(), true["dec"].to_numpy(), tile, grid, detections.region)
        true = true[in_tile & (ab_magnitude(true[f"flux_{band}"]) < detections.settings.summary_magnitude)]
        matched = self.matched.load(index)
        matched = matched[matched["truth_id"] >= 0].sort_values(["separation", "objectId"])
        key = ["truth_id", "star"]
        count = matched.groupby(key).size().rename("objects").reset_index()
        # a nullable type: with missing values integers would become floats and lose their last digits
        nullable = matched.astype({"objectId": "Int64"})
        nearest = nullable.drop_duplicates(key)[[*key, "objectId", "separation"]].merge(count, on=key)
        joined = true.merge(nearest, how="left", left_on=["id", "star"], right_on=key).drop(columns="truth_id")
        joined = joined.rename(columns={"id": "truth_id"})
        joined["objectId"] = joined["objectId"].fillna(0).astype(np.int64)
        joined["objects"] = joined["objects"].fillna(0).astype(np.int32)
        return joined[schema("truth_summary", bands).names]


def _units(
    detections: Detections, inputs: Callable[[int], tuple[tuple[str, str], ...]], settings: dict[str, Any]
) -> tuple[Unit, ...]:
    """Return one unit per tile, which reads the `inputs` of the tile with an index and the truth around it."""
    coadds, truth = detections.coadds, detections.truth
    return tuple(
        Unit(tile.name, {"tile": tile.name, **settings}, (*inputs(k), *truth.inputs(*tile_cone(coadds, k))))
        for k, tile in enumerate(coadds.tiles)
    )


TRUTH_MATCH = Stage(
    name="truth_match",
    per_survey=True,
    build=lambda context, survey: truth_match(context.output(f"detections/{survey}")),
    reads=("detections", "truth/galaxies", "truth/stars"),
    units_known_after=UNITS_FROM_POINTINGS,
    unit="tile",
    summary="The true counterpart of each detected object within one arcsecond (`detections.match_radius`).",
    tables={"truth_match": "truth_match/<survey>/"},
)
TRUTH_SUMMARY = Stage(
    name="truth_summary",
    per_survey=True,
    build=lambda context, survey: truth_summary(
        context.output(f"truth_match/{survey}"), context.output(f"detections/{survey}")
    ),
    reads=("truth_match", "truth/galaxies", "truth/stars"),
    units_known_after=UNITS_FROM_POINTINGS,
    unit="tile",
    summary="The true objects of a tile, each with the detected object that it is the counterpart of, if there is one.",
    tables={"truth_summary": "truth_summary/<survey>/"},
)
