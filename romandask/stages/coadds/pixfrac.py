"""Choice of pixfrac for the dithers of a survey: the smallest whose coadds have no empty pixels and an even weight."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from astropy.wcs import WCS

from romandask.instruments.exposure import exposure_of
from romandask.kernels.coadding.drizzle import Sums
from romandask.kernels.coadding.pixel_map import pixel_map, strips
from romandask.model.errors import UserError
from romandask.model.sky import covering_sums
from romandask.model.tiles import tangent_header
from romandask.stages.coadds.tile_maker import Coadds
from romandask.stages.pointings import corners_of

CHOICES = np.round(np.arange(0.3, 1.001, 0.1), 1)
"""Values of pixfrac that are compared."""
MAX_UNEVENNESS = 0.2
"""Largest ratio of rms to median of the weight (Troxel et al. 2023, section 5.1; Fruchter & Hook 2002)."""
TEST_SQUARE_PIXELS = 300
"""Side of the square in which the weight is measured, pixels."""


@dataclass(frozen=True)
class Coverage:
    """Weight of a coadd in one band with one pixfrac, measured in a square at the centre of a tile."""

    band: str
    pixfrac: float
    exposures: int
    """Number of exposures that touch the square."""
    empty: float
    """Fraction of pixels without weight."""
    uneven: float
    """Ratio of rms to median of the weight."""

    @property
    def good(self) -> bool:
        """Whether the pixfrac can be recommended for the band."""
        return self.empty == 0 and self.uneven < MAX_UNEVENNESS


def coverage(coadds: Coadds) -> list[Coverage]:
    """Return the coverage of each band with each pixfrac of CHOICES.

    It is measured at the centre of the tile whose centre has the most exposures, from the WCSs of the exposures alone:
    all their pixels are taken to be good.

    Raises
    ------
    UserError
        If the coadds are not drizzled, or there is no exposure in a band.
    """
    maker, table = coadds.maker, coadds.exposures.table
    if coadds.instrument.coadd != "drizzle":
        raise UserError("pixfrac: only Roman's coadds are drizzled, and this pipeline has no Roman")
    instrument, scale = coadds.instrument, coadds.instrument.coadd_scale
    centres = np.array([(tile.ra, tile.dec) for tile in maker.tiles])
    k = int(np.argmax(covering_sums(corners_of(table), *centres.T)))
    target = WCS(tangent_header(maker.tiles[k].ra, maker.tiles[k].dec, TEST_SQUARE_PIXELS, scale))
    results = []
    for band in instrument.bands:
        inputs = []
        for i in coadds.tile_members(k, band):
            exposure = exposure_of(table.iloc[i])
            onto = pixel_map(WCS(instrument.header(exposure)), target, *(slice(0, n) for n in instrument.shape))
            parts = strips(onto, (slice(0, TEST_SQUARE_PIXELS), slice(0, TEST_SQUARE_PIXELS)))
            if parts:
                inputs.append((exposure.exptime, [onto.part(part.rows, part.columns) for part in parts]))
        if not inputs:
            raise UserError(f"pixfrac: no exposure of {band} on the middle of tile {maker.tiles[k].name}")
        for choice in CHOICES:
            sums = Sums((TEST_SQUARE_PIXELS, TEST_SQUARE_PIXELS), 1, float(choice))
            for seconds, maps in inputs:
                planes = [np.full(strip_map.shape, seconds, np.float32) for strip_map in maps]
                sums.add(([plane], plane, strip_map) for plane, strip_map in zip(planes, maps, strict=True))
            weight = sums.weight[2:-2, 2:-2]
            median = max(float(np.median(weight)), 1e-30)
            results.append(
                Coverage(
                    band=band,
                    pixfrac=float(choice),
                    exposures=len(inputs),
                    empty=float((weight <= 0).mean()),
                    uneven=float(weight.std() / median),
                )
            )
    return results


def advice(found: list[Coverage]) -> float | None:
    """Return the smallest pixfrac that is good in all bands, or None if there is none."""
    good = [choice for choice in CHOICES if all(result.good for result in found if result.pixfrac == choice)]
    return float(good[0]) if good else None
