"""Which pixfrac suits a survey's dithers: the smallest whose coadds have no empty pixels and an even weight."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from astropy.wcs import WCS

from romandask.instruments.exposure import exposure_of
from romandask.kernels.coadding.drizzle import Sums
from romandask.kernels.coadding.pixel_map import pixel_map, strips
from romandask.model.errors import UserError
from romandask.model.tiles import tangent_header
from romandask.stages.coadds.tile_maker import Coadds

CHOICES = np.round(np.arange(0.3, 1.001, 0.1), 1)
UNEVEN = 0.2
"""Rms over median of the weight that is tolerated (Troxel et al. 2023, section 5.1; Fruchter & Hook 2002)."""
TEST_SQUARE_PIXELS = 300
"""Pixels, a side, of the square in which it is measured."""


@dataclass(frozen=True)
class Coverage:
    """What a pixfrac does to one band in the middle of a tile."""

    band: str
    pixfrac: float
    exposures: int
    empty: float
    """Share of pixels without weight."""
    uneven: float
    """Rms of the weight over its median."""

    @property
    def good(self) -> bool:
        """Whether it can be recommended."""
        return self.empty == 0 and self.uneven < UNEVEN


def coverage(coadds: Coadds) -> list[Coverage]:
    """Return what each pixfrac of CHOICES does to each band, from the places of the exposures alone.

    It is measured in the middle of the tile that has the most exposures, with every pixel of them good.

    Raises
    ------
    UserError
        If the coadds are not drizzled, or a band has no exposure there.
    """
    maker, table = coadds.maker, coadds.exposures.table
    if coadds.instrument.coadd != "drizzle":
        raise UserError("pixfrac: only Roman's coadds are drizzled, and this pipeline has no Roman")
    instrument, scale = coadds.instrument, coadds.instrument.coadd_scale
    totals = [sum(len(maker.members[k, band]) for band in instrument.bands) for k in range(len(maker.tiles))]
    k = int(np.argmax(totals))
    target = WCS(tangent_header(maker.tiles[k].ra, maker.tiles[k].dec, TEST_SQUARE_PIXELS, scale))
    found = []
    for band in instrument.bands:
        seen = []
        for i in maker.members[k, band]:
            exposure = exposure_of(table.iloc[i])
            wcs = WCS(instrument.header(exposure))
            parts = strips(wcs, instrument.shape, target, (TEST_SQUARE_PIXELS, TEST_SQUARE_PIXELS))
            if parts:
                seen.append((exposure.exptime, [pixel_map(wcs, target, part.rows, part.columns) for part in parts]))
        if not seen:
            raise UserError(f"pixfrac: no exposure of {band} on the middle of tile {maker.tiles[k].name}")
        for choice in CHOICES:
            sums = Sums((TEST_SQUARE_PIXELS, TEST_SQUARE_PIXELS), 1, float(choice))
            for seconds, maps in seen:
                planes = [np.full(one.shape, seconds, np.float32) for one in maps]
                sums.add(([plane], plane, one) for plane, one in zip(planes, maps, strict=True))
            weight = sums.weight[2:-2, 2:-2]
            middle = max(float(np.median(weight)), 1e-30)
            found.append(
                Coverage(band, float(choice), len(seen), float((weight <= 0).mean()), float(weight.std() / middle))
            )
    return found


def advice(found: list[Coverage]) -> float | None:
    """Return the smallest pixfrac that is good in all bands; None where there is none."""
    good = [choice for choice in CHOICES if all(one.good for one in found if one.pixfrac == choice)]
    return float(good[0]) if good else None
