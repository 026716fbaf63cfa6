"""The tile grid: overlapping images whose inner areas cover the sky exactly once.

An object in the overlap of several images belongs to the tile whose inner area contains it; all image products use
this rule. The grid consists of rings of constant declination, each divided in right ascension (Troxel et al. 2023,
section 4.4): the centres are dec_j = -90 + (2j + 1) h and ra_i = (2i + 1) h / cos(dec_j), where h is half the side of
the inner area.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from romandask.model.errors import UserError
from romandask.model.sky import Region, from_tangent_plane

MAX_TILES = 3_000_000
"""Largest number of tiles of a region; this many tiles of the paper's size cover the whole sky."""
_RING_STRIDE = 1 << 32
"""A tile id is the ring number times this, plus the column number."""


@dataclass(frozen=True)
class Tile:
    """One tile: a gnomonic image around its centre, north up, east left."""

    id: int
    """Ring number times 2^32, plus the column number in the ring."""
    name: str
    """Right ascension and declination of the centre as text."""
    ra: float
    """Right ascension of the centre, degrees."""
    dec: float
    """Declination of the centre, degrees."""

    def corners(self, side: float) -> np.ndarray:
        """Return the corners, shape (4, 2), degrees, of a square image around the centre that is `side` arcsec wide."""
        half = side / 7200
        return np.stack(
            from_tangent_plane(
                self.ra, self.dec, np.array([half, -half, -half, half]), np.array([-half, -half, half, half])
            ),
            axis=1,
        )

    def header(self, pixels: int, scale: float) -> dict[str, float | str]:
        """Return the FITS TAN header of an image with `pixels` pixels a side, each `scale` arcsec wide."""
        return tangent_header(self.ra, self.dec, pixels, scale)


def tangent_header(ra: float, dec: float, pixels: int, scale: float) -> dict[str, float | str]:
    """Return the FITS TAN header of a square image, north up, east left.

    Parameters
    ----------
    ra, dec : float, degrees
        Position of the image centre.
    pixels : int
        Side of the image, pixels.
    scale : float, arcsec
        Pixel scale.
    """
    return {
        "CTYPE1": "RA---TAN",
        "CTYPE2": "DEC--TAN",
        "CUNIT1": "deg",
        "CUNIT2": "deg",
        "CRVAL1": float(ra),
        "CRVAL2": float(dec),
        "CRPIX1": (pixels + 1) / 2,
        "CRPIX2": (pixels + 1) / 2,
        "CD1_1": -scale / 3600,
        "CD1_2": 0.0,
        "CD2_1": 0.0,
        "CD2_2": scale / 3600,
        "RADESYS": "ICRS",
    }


@dataclass(frozen=True)
class PatchGrid:
    """The division of a square image into square patches.

    Patches have an even number of pixels a side, so that each consists of 2 x 2 chunks. The last row and column of
    patches may be narrower.
    """

    pixels: int
    """Side of the image, pixels."""
    patch_pixels: int
    """Approximate side of a patch, pixels."""

    @property
    def side(self) -> int:
        """Side of a patch, pixels; even."""
        return 2 * -(-self.pixels // (2 * max(1, round(self.pixels / self.patch_pixels))))

    @property
    def count(self) -> int:
        """Number of rows, and of columns, of patches."""
        return -(-self.pixels // self.side)

    def window(self, row: int, column: int) -> tuple[slice, slice]:
        """Return the rows and columns of the image that a patch covers."""
        rows, columns = (slice(k * self.side, min((k + 1) * self.side, self.pixels)) for k in (row, column))
        return rows, columns

    def centre(self, row: int, column: int) -> tuple[float, float]:
        """Return x and y of the centre of a patch, 0 at the centre of the first pixel of the image."""
        rows, columns = self.window(row, column)
        return (columns.start + columns.stop - 1) / 2, (rows.start + rows.stop - 1) / 2

    def touching(self, window: tuple[slice, slice]) -> list[tuple[int, int]]:
        """Return row and column of the patches that have pixels in a window of the image, in order."""
        rows, columns = (range(*part.indices(self.pixels)) for part in window)
        if not rows or not columns:
            return []
        return [
            (row, column)
            for row in range(rows[0] // self.side, rows[-1] // self.side + 1)
            for column in range(columns[0] // self.side, columns[-1] // self.side + 1)
        ]

    @staticmethod
    def name(row: int, column: int) -> str:
        """Return the name of a patch, which ends the names of units: r<row>c<column>."""
        return f"r{row}c{column}"


@dataclass(frozen=True)
class TileGrid:
    """The tile grid of a survey, common to all instruments."""

    inner: float
    """Side of the inner area, arcsec."""
    overlap: float
    """Padding on each edge, arcsec."""

    @property
    def side(self) -> float:
        """Side of the padded image, arcsec."""
        return self.inner + 2 * self.overlap

    def pixels(self, scale: float) -> int:
        """Return the side of the padded image, in pixels of `scale` arcsec."""
        return int(np.ceil(self.side / scale - 1e-6))

    def owner(self, ra: ArrayLike, dec: ArrayLike) -> np.ndarray:
        """Return the id of the tile whose inner area contains each position (degrees)."""
        step = self.inner / 3600
        ring = np.clip(np.floor((np.asarray(dec, float) + 90) / step), 0, self._rings - 1).astype(np.int64)
        column = np.floor((np.asarray(ra, float) % 360) / self._width(ring)).astype(np.int64)
        return ring * _RING_STRIDE + np.minimum(column, self._columns(ring) - 1)

    def tile(self, tile_id: int) -> Tile:
        """Return the tile with an id."""
        ring, column = divmod(int(tile_id), _RING_STRIDE)
        dec = -90 + (2 * ring + 1) * self.inner / 7200
        ra = float((column + 0.5) * self._width(ring)) % 360
        return Tile(id=int(tile_id), name=f"{ra:.4f}_{dec:+.4f}", ra=ra, dec=dec)

    def covering(self, region: Region) -> list[Tile]:
        """Return the tiles whose inner areas touch the region, sorted by declination, then right ascension.

        Raises
        ------
        UserError
            If the padded image does not cover the whole inner area because the region is too close to a pole, or if
            there are more than MAX_TILES tiles.
        """
        count = region.area * 3600 / self.inner**2
        if count > MAX_TILES:
            raise UserError(
                f"region has {count:.3g} tiles {self.inner:.3g} arcsec wide, at most {MAX_TILES} can be planned: "
                "raise coadds.pixels or coadds.scale, or make the region smaller"
            )
        step = self.inner / 3600
        first = int(np.floor((region.dec_min + 90) / step + 1e-9))
        last = min(int(np.ceil((region.dec_max + 90) / step - 1e-9)), self._rings)
        tiles = []
        for ring in range(max(first, 0), last):
            self._check_ring(ring)
            width, columns = self._width(ring), int(self._columns(ring))
            # columns are counted from RA 0, and the last column of a ring may be narrower: a region that crosses RA 0
            # is treated as two
            touched: set[int] = set()
            for low, high in _without_wrap(region):
                lowest, highest = int(np.floor(low / width + 1e-9)), int(np.ceil(high / width - 1e-9))
                touched |= set(range(lowest, min(highest, columns)))
            tiles += [self.tile(ring * _RING_STRIDE + column) for column in sorted(touched)]
        return tiles

    @property
    def _rings(self) -> int:
        """Number of rings from pole to pole."""
        return int(np.ceil(180 * 3600 / self.inner - 1e-9))

    def _width(self, ring) -> np.ndarray:
        """Return the width in right ascension, degrees, of the inner areas of a ring."""
        centre = np.radians(-90 + (2 * np.asarray(ring) + 1) * self.inner / 7200)
        return self.inner / 3600 / np.maximum(np.cos(centre), 1e-6)

    def _columns(self, ring) -> np.ndarray:
        """Return the number of tiles in a ring."""
        return np.maximum(np.ceil(360 / self._width(ring) - 1e-9), 1).astype(np.int64)

    def _check_ring(self, ring: int) -> None:
        """Raise UserError if the inner areas of a ring reach beyond the padded images.

        The inner area is a box in right ascension and declination, so towards the equator it is wider than the side
        of the tile. The padding must cover the difference.
        """
        edge = min(abs(-90 + 2 * (ring + k) * self.inner / 7200) for k in (0, 1))
        centre = abs(-90 + (2 * ring + 1) * self.inner / 7200)
        excess = self.inner / 2 * (np.cos(np.radians(edge)) / max(np.cos(np.radians(centre)), 1e-9) - 1)
        # a meridian also curves away from the image's edge; both effects are of second order, largest at the corners
        bend = self.inner / 2 * np.radians(self.inner / 7200) * np.tan(np.radians(min(edge, 89.999)))
        if excess + bend > self.overlap:
            raise UserError(
                f"region reaches declination {np.copysign(centre, ring - self._rings / 2):.2f}: tiles {self.inner:.0f} "
                f"arcsec wide need an overlap of {excess + bend:.1f} arcsec there, coadds.overlap gives "
                f"{self.overlap:.1f}: raise coadds.overlap or lower coadds.pixels"
            )


def _without_wrap(region: Region) -> list[tuple[float, float]]:
    """Return the ranges of right ascension of a region, degrees, split where it crosses 360."""
    low = region.ra_min % 360
    high = low + region.width
    return [(low, high)] if high <= 360 else [(low, 360.0), (0.0, high - 360)]
