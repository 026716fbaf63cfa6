"""Object tables: the detections of all tiles as one HATS catalog, their magnitudes corrected by the zero points."""

from __future__ import annotations

from dataclasses import dataclass

import pandas as pd

from romandask.model.sky import cells_in_cone
from romandask.products.tables import TableProduct
from romandask.products.units import Unit
from romandask.stages.detections.detections import Detections
from romandask.stages.detections.zero_points import corrected
from romandask.stages.stage import UNITS_FROM_POINTINGS, Stage, SurveyContext


def objects(detections: Detections, zero: TableProduct | None = None) -> TableProduct:
    """Return the object table of a survey: the detections of all tiles, partitioned by HEALPix (HATS).

    Parameters
    ----------
    zero : offsets of the magnitudes (`zero_points()`), to be taken out; None leaves fluxes as they were measured
    """
    settings = detections.settings
    radius = detections.coadds.settings.grid().inner / 3600 * 0.75
    cells = detections.region.cells(settings.order)
    tiles_of: dict[int, list[int]] = {int(cell): [] for cell in cells}
    for k, tile in enumerate(detections.tiles):
        for cell in cells_in_cone(tile.ra, tile.dec, radius, settings.order):
            if int(cell) in tiles_of:
                tiles_of[int(cell)].append(k)
    units = tuple(
        Unit(
            f"{settings.order}-{cell}",
            {"order": settings.order, "cell": cell},
            (*((detections.stage, detections.names[k]) for k in members), *(((zero.stage, "all"),) if zero else ())),
        )
        for cell, members in tiles_of.items()
    )
    return TableProduct(
        stage=f"objects/{detections.instrument.name}",
        units=units,
        make=CollectPartition(detections, tuple(tiles_of), tuple(map(tuple, tiles_of.values())), settings.order, zero),
        schema=detections.product.tables["objects"],
        pixels=tuple(tiles_of),
        order=settings.order,
        bytes_per_unit=400 << 20,
    )


@dataclass(frozen=True)
class CollectPartition:
    """Makes one HEALPix partition of an object table from the tiles that reach into it."""

    detections: Detections
    cells: tuple[int, ...]
    members: tuple[tuple[int, ...], ...]
    order: int
    zero: TableProduct | None = None

    def __call__(self, index: int) -> pd.DataFrame:
        """Return the objects of the partition, by _healpix_29."""
        parts = [self.detections.objects(k) for k in self.members[index]]
        shift = 2 * (29 - self.order)
        parts = [part[part["_healpix_29"].to_numpy() >> shift == self.cells[index]] for part in parts]
        filled = [part for part in parts if len(part)]
        if not filled:
            return self.detections.product.tables["objects"].empty_table().to_pandas()
        found = pd.concat(filled).sort_values(["_healpix_29", "objectId"], ignore_index=True)
        return found if self.zero is None else corrected(found, self.zero.load(0))


def build_objects(context: SurveyContext, survey: str) -> TableProduct:
    """Return the lazy object table of an instrument."""
    return objects(context.output(f"detections/{survey}"), context.output(f"zero_points/{survey}"))


OBJECTS = Stage(
    name="objects",
    per_survey=True,
    build=build_objects,
    reads=("detections", "zero_points"),
    units_known_after=UNITS_FROM_POINTINGS,
    unit="HEALPix cell",
    summary="The objects of all tiles, each once, with DPDD names and calibrated fluxes.",
    sky=("coord_ra", "coord_dec"),
    shrink_with="raise detections.order",
    tables={"objects": "objects/<survey>/"},
)
