"""Photometric calibration on stars: by how much measured magnitudes differ from true ones, in each band."""

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
"""True magnitudes of the stars that calibrate (Troxel et al. 2023, section 5.3)."""
FLUXES = ("kronFlux", "apFlux", "psfFlux")


def zero_points(summary: TableProduct, detections: Detections) -> TableProduct:
    """Return the lazy offsets of a survey's magnitudes (schema: catalogs/zero_points.yaml): one unit, of all tiles.

    Stars that are one object without a flag count: saturated and blended ones do not. A tile that could not be made is
    left out.
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
    """Return the offset of each band and flux (schema: catalogs/zero_points.yaml).

    Parameters
    ----------
    stars : flux_<band>, true, and <band>_<flux>, measured, nJy
    """
    rows = []
    for band in bands:
        true = ab_magnitude(stars[f"flux_{band}"])
        bright = (true >= BRIGHT) & (true < FAINT)
        for flux in FLUXES:
            difference = (ab_magnitude(stars[f"{band}_{flux}"]) - true)[bright]
            difference = difference[np.isfinite(difference)]
            n = len(difference)
            middle = float(np.median(difference)) if n else 0.0
            spread = 1.4826 * np.median(np.abs(difference - middle)) if n > 1 else np.nan
            # a median's error is a quarter larger than a mean's
            rows.append((band, flux, n, middle, float(1.2533 * spread / np.sqrt(max(n, 1)))))
    return pd.DataFrame(rows, columns=["band", "flux", "stars", "offset", "error"]).astype({"stars": np.int32})


def corrected(objects: pd.DataFrame, found: pd.DataFrame) -> pd.DataFrame:
    """Return objects whose fluxes and their errors have the offsets taken out."""
    scales = {
        f"{band}_{flux}{ending}": 10 ** (0.4 * offset)
        for band, flux, offset in zip(found["band"], found["flux"], found["offset"], strict=True)
        for ending in ("", "Err")
    }
    return objects.assign(**{name: objects[name] * scale for name, scale in scales.items() if name in objects})


@dataclass(frozen=True)
class MakeZeroPoints:
    """Makes the offsets of a survey."""

    summary: TableProduct
    detections: Detections
    bands: tuple[str, ...]

    def __call__(self, index: int) -> pd.DataFrame:
        """Return the offset of each band and flux."""
        true = [f"flux_{band}" for band in self.bands]
        measured = [f"{band}_{flux}" for band in self.bands for flux in FLUXES]
        parts = [pd.DataFrame(columns=[*true, *measured], dtype=float)]
        stored = self.detections.product.store is not None
        for k in range(len(self.detections.units)):
            if stored and not (self.detections.has(k) and self.summary.has(k)):
                continue
            summary = self.summary.load(k)
            summary = summary[summary["star"] & (summary["objects"] == 1)]
            objects = self.detections.objects(k)
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
    summary="Median of measured less true magnitudes of stars of 17 to 20 mag, by which fluxes are corrected.",
    tables={"zero_points": "zero_points/<survey>/"},
)
