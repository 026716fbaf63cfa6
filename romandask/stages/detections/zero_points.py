"""Zero points: the offsets of measured from true magnitudes of stars, in each band and for each kind of flux."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd

from romandask.model.spectra import ab_magnitude
from romandask.products.schemas import schema
from romandask.products.tables import TableProduct
from romandask.products.units import Unit
from romandask.stages.detections.detections import Detections
from romandask.stages.stage import UNITS_FROM_POINTINGS, Stage

BRIGHT, FAINT = 17.0, 20.0
"""Range of true magnitudes of the stars that are used (Troxel et al. 2023, section 5.3)."""
FLUXES = ("kronFlux", "apFlux", "psfFlux")
"""Kinds of flux, as the columns <band>_<flux> of objects name them."""


def zero_points(summary: TableProduct, detections: Detections) -> TableProduct:
    """Return the lazy zero points of a survey (schema: catalogs/zero_points.yaml), one unit for all tiles.

    Only stars that are the counterpart of exactly one object, without any flag, are used; so saturated and blended
    stars are not. Tiles that could not be made are left out.

    Parameters
    ----------
    summary : TableProduct
        True objects of each tile (see `truth_match.truth_summary`).
    detections : Detections
        Detections of the survey.
    """
    sources = tuple((product.stage, name) for product in (summary, detections) for name in product.names)
    name, bands = detections.instrument.name, detections.instrument.bands
    return TableProduct(
        stage=f"zero_points/{name}",
        units=(Unit("all", {"bands": bands, "limits": [BRIGHT, FAINT]}, optional=sources),),
        make=MakeZeroPoints(summary, detections, bands),
        schema=schema("zero_points"),
        bytes_per_unit=400 << 20,
    )


def offsets(stars: pd.DataFrame, bands: tuple[str, ...]) -> pd.DataFrame:
    """Return the offset of each band and kind of flux (schema: catalogs/zero_points.yaml).

    Parameters
    ----------
    stars : DataFrame
        True fluxes `flux_<band>` and measured fluxes `<band>_<flux>` of stars, nJy.
    bands : tuple of str

    Returns
    -------
    DataFrame
        `offset` is the median of measured minus true magnitudes, 0 without stars; `error` is the error of the median,
        from the median absolute deviation.
    """
    rows = []
    for band in bands:
        true = ab_magnitude(stars[f"flux_{band}"])
        bright = (true >= BRIGHT) & (true < FAINT)
        for flux in FLUXES:
            difference = (ab_magnitude(stars[f"{band}_{flux}"]) - true)[bright]
            difference = difference[np.isfinite(difference)]
            n = len(difference)
            offset = float(np.median(difference)) if n else 0.0
            scatter = 1.4826 * np.median(np.abs(difference - offset)) if n > 1 else np.nan
            # for Gaussian errors, the error of a median is sqrt(pi / 2) = 1.2533 times that of a mean
            rows.append((band, flux, n, offset, float(1.2533 * scatter / np.sqrt(max(n, 1)))))
    return pd.DataFrame(rows, columns=["band", "flux", "stars", "offset", "error"]).astype({"stars": np.int32})


def corrected(objects: pd.DataFrame, zero_points: pd.DataFrame) -> pd.DataFrame:
    """Return objects with the offsets removed from their fluxes and flux errors.

    Parameters
    ----------
    objects : DataFrame
        Objects (schema: catalogs/objects.yaml).
    zero_points : DataFrame
        Offsets (schema: catalogs/zero_points.yaml).
    """
    scales = {
        f"{band}_{flux}{suffix}": 10 ** (0.4 * offset)
        for band, flux, offset in zip(zero_points["band"], zero_points["flux"], zero_points["offset"], strict=True)
        for suffix in ("", "Err")
    }
    return objects.assign(**{name: objects[name] * scale for name, scale in scales.items() if name in objects})


@dataclass(frozen=True)
class MakeZeroPoints:
    """Makes the zero points of a survey."""

    summary: TableProduct
    detections: Detections
    bands: tuple[str, ...]

    def __call__(self, index: int) -> pd.DataFrame:
        """Return the offset of each band and kind of flux."""
        true = [f"flux_{band}" for band in self.bands]
        measured = [f"{band}_{flux}" for band in self.bands for flux in FLUXES]
        parts = [pd.DataFrame(columns=[*true, *measured], dtype=float)]
        has_store = self.detections.product.store is not None
        for k in range(len(self.detections.tiles)):
            # the units are optional inputs: with a store, those that failed are missing
            if has_store and not (self.summary.has(k) and self.detections.has_tile(k)):
                continue
            summary = self.summary.load(k)
            summary = summary[summary["star"] & (summary["objects"] == 1)]
            objects = self.detections.tile_objects(k)
            objects = objects[objects["flags"] == 0]
            parts.append(summary[["objectId", *true]].merge(objects[["objectId", *measured]], on="objectId"))
        return offsets(pd.concat(parts, ignore_index=True), self.bands)


ZERO_POINTS = Stage(
    name="zero_points",
    per_survey=True,
    build=lambda context, survey: zero_points(
        context.output(f"truth_summary/{survey}"), context.output(f"detections/{survey}")
    ),
    reads=("truth_summary", "detections"),
    units_known_after=UNITS_FROM_POINTINGS,
    unit="survey",
    summary="The median of measured minus true magnitudes of stars of 17 to 20 mag, for each band and kind of flux, by "
    "which the fluxes of objects are corrected.",
    tables={"zero_points": "zero_points/<survey>/"},
)
