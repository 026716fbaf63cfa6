"""Object tables: the objects of all patches as one HATS catalog, with fluxes corrected by the zero points."""

from __future__ import annotations

from dataclasses import dataclass

import pandas as pd

from romandask.model.sky import cells_in_cone
from romandask.products.tables import TableProduct
from romandask.products.units import Unit
from romandask.stages.detections.detections import Detections
from romandask.stages.detections.zero_points import corrected
from romandask.stages.stage import UNITS_FROM_POINTINGS, Stage, SurveyContext


def objects(detections: Detections, zero_points: TableProduct | None = None) -> TableProduct:
    """Return the lazy object table of a survey (schema: catalogs/objects.yaml), a HATS catalog.

    Parameters
    ----------
    detections : Detections
        Detections of the survey; each object of each patch becomes one row.
    zero_points : TableProduct, optional
        Offsets of the magnitudes (see `zero_points.zero_points`), which are removed; by default fluxes are left as
        measured.
    """
    settings = detections.settings
    cells = detections.region.cells(settings.order)
    patches_of_cell: dict[int, list[int]] = {int(cell): [] for cell in cells}
    for k, cone in enumerate(detections.cones()):
        for cell in cells_in_cone(*cone, settings.order):
            if int(cell) in patches_of_cell:
                patches_of_cell[int(cell)].append(k)
    units = tuple(
        Unit(
            f"{settings.order}-{cell}",
            {"order": settings.order, "cell": cell},
            (
                *((detections.stage, detections.names[k]) for k in patches),
                *(((zero_points.stage, "all"),) if zero_points else ()),
            ),
        )
        for cell, patches in patches_of_cell.items()
    )
    return TableProduct(
        stage=f"objects/{detections.instrument.name}",
        units=units,
        make=CollectPartition(
            detections=detections,
            cells=tuple(patches_of_cell),
            patches=tuple(map(tuple, patches_of_cell.values())),
            order=settings.order,
            zero_points=zero_points,
        ),
        schema=detections.product.tables["objects"],
        pixels=tuple(patches_of_cell),
        order=settings.order,
        bytes_per_unit=400 << 20,
    )


@dataclass(frozen=True, kw_only=True)
class CollectPartition:
    """Makes one HEALPix partition of an object table from the patches that overlap it."""

    detections: Detections
    cells: tuple[int, ...]
    """Nested HEALPix cell of each partition."""
    patches: tuple[tuple[int, ...], ...]
    """Indices of the units of the detections, which are patches, that may overlap each partition."""
    order: int
    """HEALPix order of the partitions."""
    zero_points: TableProduct | None = None
    """Offsets of the magnitudes; None leaves fluxes as measured."""

    def __call__(self, index: int) -> pd.DataFrame:
        """Return the objects of a partition, sorted by _healpix_29."""
        parts = [self.detections.objects(k) for k in self.patches[index]]
        shift = 2 * (29 - self.order)
        parts = [part[part["_healpix_29"].to_numpy() >> shift == self.cells[index]] for part in parts]
        filled = [part for part in parts if len(part)]
        if not filled:
            return self.detections.product.tables["objects"].empty_table().to_pandas()
        rows = pd.concat(filled).sort_values(["_healpix_29", "objectId"], ignore_index=True)
        return rows if self.zero_points is None else corrected(rows, self.zero_points.load(0))


def build_objects(context: SurveyContext, survey: str) -> TableProduct:
    """Return the lazy object table of a survey (the `build` of the stage)."""
    return objects(context.output(f"detections/{survey}"), context.output(f"zero_points/{survey}"))


OBJECTS = Stage(
    name="objects",
    per_survey=True,
    build=build_objects,
    reads=("detections", "zero_points"),
    units_known_after=UNITS_FROM_POINTINGS,
    unit="HEALPix cell",
    summary="The objects of all patches in one catalog, each object once, with DPDD column names and fluxes "
    "corrected by the zero points.",
    sky=("coord_ra", "coord_dec"),
    shrink_with="raise detections.order",
    tables={"objects": "objects/<survey>/"},
)
