"""Detected objects and the true ones: the counterpart of each object of a tile, and what was found of the truth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd

from romandask.instruments.instrument import Instrument
from romandask.kernels.measurement.counterparts import counterparts
from romandask.model.settings import DetectionSettings
from romandask.model.sky import unit_vectors
from romandask.model.spectra import ab_magnitude
from romandask.products.images import ImageProduct
from romandask.products.schemas import schema
from romandask.products.tables import TableProduct
from romandask.products.units import Unit
from romandask.stages.coadds.tile_maker import TileMaker, tile_maker
from romandask.stages.detections.detections import DetectTile, owned, tile_cone
from romandask.stages.exposures import RenderExposure

BINS = np.arange(17.0, 30.01, 0.5)
"""Magnitudes between which completeness and purity are counted."""

REFERENCE_BANDS = ("H158", "i")
"""The bands in which Roman's and Rubin's magnitudes are compared, where they are surveyed."""


def truth_match(detections: ImageProduct, settings: DetectionSettings) -> TableProduct:
    """Return the lazy counterparts of the objects of each tile (schema: catalogs/truth_match.yaml), a unit a tile."""
    _, _, render = _makers(detections)
    state = {"radius": settings.match_radius, "band": reference_band(render.instrument)}
    units = _units(detections, detections.stage, state)
    return TableProduct(
        stage=f"truth_match/{render.instrument.name}",
        units=units,
        make=MatchTile(detections, settings),
        schema=schema("truth_match"),
        bytes_per_unit=600 << 20,
        seconds_per_unit=0.5,
    )


def truth_summary(matched: TableProduct, detections: ImageProduct, settings: DetectionSettings) -> TableProduct:
    """Return the lazy list of the true objects of each tile, found or not (schema: catalogs/truth_summary.yaml)."""
    _, _, render = _makers(detections)
    bands = render.instrument.bands
    units = _units(detections, matched.stage, {"faintest": settings.summary_magnitude, "bands": bands})
    return TableProduct(
        stage=f"truth_summary/{render.instrument.name}",
        units=units,
        make=SummariseTile(matched, detections, settings),
        schema=schema("truth_summary", bands),
        bytes_per_unit=600 << 20,
        seconds_per_unit=0.5,
    )


def reference_band(instrument: Instrument) -> str:
    """Return the band in which magnitudes are compared: H158 of Roman, i of Rubin, or the middle one."""
    bands = instrument.bands
    return next((band for band in REFERENCE_BANDS if band in bands), bands[len(bands) // 2])


def completeness(summary: pd.DataFrame, matched: pd.DataFrame, band: str) -> pd.DataFrame:
    """Return, by magnitude: true objects, found, completeness; objects, real ones, purity.

    Completeness is counted in true magnitudes, purity in measured ones.
    """
    true = ab_magnitude(summary[f"flux_{band}"])
    found = summary["objectId"].to_numpy() > 0
    measured, real = matched["magnitude"].to_numpy(float), matched["truth_id"].to_numpy() >= 0
    counts = [np.histogram(values, BINS)[0] for values in (true, true[found], measured, measured[real])]
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
    """Makes the counterparts of one tile."""

    detections: ImageProduct
    settings: DetectionSettings

    def __call__(self, index: int) -> pd.DataFrame:
        """Return one row for each object (schema: catalogs/truth_match.yaml)."""
        _, tiles, render = _makers(self.detections)
        band = reference_band(render.instrument)
        objects = self.detections.load(index, ("objects",))["objects"]
        true = render.truth.brief(*tile_cone(tiles, index)[:3], (band,))
        magnitude = ab_magnitude(objects[f"{band}_kronFlux"])
        found = counterparts(
            unit_vectors(objects["coord_ra"].to_numpy(), objects["coord_dec"].to_numpy()),
            magnitude,
            unit_vectors(true["ra"].to_numpy(), true["dec"].to_numpy()),
            ab_magnitude(true[f"flux_{band}"]),
            np.radians(self.settings.match_radius / 3600),
        )
        none = found.row < 0
        rows = true.iloc[np.where(none, 0, found.row)] if len(true) else true.reindex(range(len(objects)))
        return pd.DataFrame(
            {
                "objectId": objects["objectId"].to_numpy(),
                "truth_id": np.where(none, -1, rows["id"].fillna(-1).to_numpy()).astype(np.int64),
                "star": np.where(none, False, rows["star"].fillna(False).to_numpy(bool)),
                "separation": np.degrees(found.separation) * 3600,
                "candidates": found.candidates.astype(np.int32),
                "magnitude": magnitude,
                "true_magnitude": np.where(none, np.nan, ab_magnitude(rows[f"flux_{band}"])),
            }
        )


@dataclass(frozen=True)
class SummariseTile:
    """Makes the list of true objects of one tile."""

    matched: TableProduct
    detections: ImageProduct
    settings: DetectionSettings

    def __call__(self, index: int) -> pd.DataFrame:
        """Return one row for each true object (schema: catalogs/truth_summary.yaml)."""
        maker, tiles, render = _makers(self.detections)
        bands, band = render.instrument.bands, reference_band(render.instrument)
        true = render.truth.brief(*tile_cone(tiles, index)[:3], bands)
        tile, grid = tiles.tiles[index], tiles.settings.grid()
        here = owned(true["ra"].to_numpy(), true["dec"].to_numpy(), tile, grid, maker.region)
        true = true[here & (ab_magnitude(true[f"flux_{band}"]) < self.settings.summary_magnitude)]
        matched = self.matched.load(index)
        matched = matched[matched["truth_id"] >= 0].sort_values(["separation", "objectId"])
        key = ["truth_id", "star"]
        number = matched.groupby(key).size().rename("objects").reset_index()
        # whole numbers stay whole where some are missing: as floats their last digits would go
        whole = matched.astype({"objectId": "Int64"})
        nearest = whole.drop_duplicates(key)[[*key, "objectId", "separation"]].merge(number, on=key)
        joined = true.merge(nearest, how="left", left_on=["id", "star"], right_on=key).drop(columns="truth_id")
        joined = joined.rename(columns={"id": "truth_id"})
        joined["objectId"] = joined["objectId"].fillna(0).astype(np.int64)
        joined["objects"] = joined["objects"].fillna(0).astype(np.int32)
        return joined[schema("truth_summary", bands).names]


def _units(detections: ImageProduct, source: str, state: dict) -> tuple[Unit, ...]:
    """Return a unit a tile that reads the tile's unit of a stage and the truth on it."""
    _, tiles, render = _makers(detections)
    return tuple(
        Unit(tile.name, {"tile": tile.name, **state}, ((source, tile.name), *render.truth.inputs(*tile_cone(tiles, k))))
        for k, tile in enumerate(tiles.tiles)
    )


def _makers(detections: ImageProduct) -> tuple[DetectTile, TileMaker, RenderExposure]:
    maker = detections.make
    assert isinstance(maker, DetectTile)
    tiles = tile_maker(maker.coadds)
    return maker, tiles, tiles.source
