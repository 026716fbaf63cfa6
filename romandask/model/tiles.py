"""The tile grid: padded images whose unique inner areas cover the sky once; the border rule of every image product.

Rings of constant declination, each cut at steps of right ascension (Troxel et al. 2023, section 4.4): with h half
the side of the inner area, dec_j = -90 + (2j + 1) h and ra_i = (2i + 1) h / cos(dec_j).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from romandask.model.errors import UserError
from romandask.model.sky import Region, from_tangent_plane

MOST_TILES = 3_000_000
"""Tiles of a region: of the paper's size as many as cover the whole sky."""
_RING = 1 << 32


@dataclass(frozen=True)
class Tile:
    """One tile: a gnomonic image about its centre, north up, east left."""

    id: int
    name: str
    ra: float
    """Centre, degrees."""
    dec: float
    """Centre, degrees."""

    def corners(self, side: float) -> np.ndarray:
        """Return the four corners (4, 2), degrees, of the image `side` arcsec wide."""
        half = side / 7200
        return np.stack(
            from_tangent_plane(
                self.ra, self.dec, np.array([half, -half, -half, half]), np.array([-half, -half, half, half])
            ),
            axis=1,
        )

    def header(self, pixels: int, scale: float) -> dict[str, float | str]:
        """Return the FITS TAN header of the image: `pixels` a side, `scale` arcsec a pixel."""
        return tangent_header(self.ra, self.dec, pixels, scale)


def tangent_header(ra: float, dec: float, pixels: int, scale: float) -> dict[str, float | str]:
    """Return the header of a square gnomonic image centred on a position (degrees), north up, east left."""
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
class TileGrid:
    """All tiles of one survey: image side and overlap are common to all instruments, in arcsec."""

    inner: float
    """Side of the unique area, arcsec."""
    overlap: float
    """Padding on every edge, arcsec."""

    @property
    def side(self) -> float:
        """Side of the padded image, arcsec."""
        return self.inner + 2 * self.overlap

    def pixels(self, scale: float) -> int:
        """Return the side of the padded image in pixels of `scale` arcsec."""
        return int(np.ceil(self.side / scale - 1e-6))

    def owner(self, ra, dec) -> np.ndarray:
        """Return the id of the one tile whose unique area holds each position (degrees)."""
        step = self.inner / 3600
        ring = np.clip(np.floor((np.asarray(dec, float) + 90) / step), 0, self._rings - 1).astype(np.int64)
        column = np.floor((np.asarray(ra, float) % 360) / self._width(ring)).astype(np.int64)
        return ring * _RING + np.minimum(column, self._columns(ring) - 1)

    def tile(self, tile_id: int) -> Tile:
        """Return a tile by its id."""
        ring, column = divmod(int(tile_id), _RING)
        dec = -90 + (2 * ring + 1) * self.inner / 7200
        ra = float((column + 0.5) * self._width(ring)) % 360
        return Tile(id=int(tile_id), name=f"{ra:.4f}_{dec:+.4f}", ra=ra, dec=dec)

    def covering(self, region: Region) -> list[Tile]:
        """Return the tiles whose unique areas touch the region, by declination and right ascension.

        Raises
        ------
        UserError
            Where the padding does not reach the edges of the unique area (too close to a pole), or tiles would be
            more than MOST_TILES.
        """
        count = region.area * 3600 / self.inner**2
        if count > MOST_TILES:
            raise UserError(
                f"region has {count:.3g} tiles {self.inner:.3g} arcsec wide, at most {MOST_TILES} can be planned: "
                "raise coadds.pixels or coadds.scale, or make the region smaller"
            )
        step = self.inner / 3600
        first = int(np.floor((region.dec_min + 90) / step + 1e-9))
        last = min(int(np.ceil((region.dec_max + 90) / step - 1e-9)), self._rings)
        tiles = []
        for ring in range(max(first, 0), last):
            self._check_ring(ring)
            width, columns = self._width(ring), int(self._columns(ring))
            # columns count from RA 0 and the last may be cut short there: a region across it is two
            found: set[int] = set()
            for low, high in _without_wrap(region):
                lowest, highest = int(np.floor(low / width + 1e-9)), int(np.ceil(high / width - 1e-9))
                found |= set(range(lowest, min(highest, columns)))
            tiles += [self.tile(ring * _RING + column) for column in sorted(found)]
        return tiles

    @property
    def _rings(self) -> int:
        return int(np.ceil(180 * 3600 / self.inner - 1e-9))

    def _width(self, ring) -> np.ndarray:
        centre = np.radians(-90 + (2 * np.asarray(ring) + 1) * self.inner / 7200)
        return self.inner / 3600 / np.maximum(np.cos(centre), 1e-6)

    def _columns(self, ring) -> np.ndarray:
        return np.maximum(np.ceil(360 / self._width(ring) - 1e-9), 1).astype(np.int64)

    def _check_ring(self, ring: int) -> None:
        """The box in RA and Dec is wider towards the equator than the tile: the padding must make up for it."""
        edge = min(abs(-90 + 2 * (ring + k) * self.inner / 7200) for k in (0, 1))
        centre = abs(-90 + (2 * ring + 1) * self.inner / 7200)
        excess = self.inner / 2 * (np.cos(np.radians(edge)) / max(np.cos(np.radians(centre)), 1e-9) - 1)
        # a meridian also bends away from the tile's edge; both are second order and largest at the corners
        bend = self.inner / 2 * np.radians(self.inner / 7200) * np.tan(np.radians(min(edge, 89.999)))
        if excess + bend > self.overlap:
            raise UserError(
                f"region reaches declination {np.copysign(centre, ring - self._rings / 2):.2f}: tiles {self.inner:.0f} "
                f"arcsec wide need an overlap of {excess + bend:.1f} arcsec there, coadds.overlap gives "
                f"{self.overlap:.1f}: raise coadds.overlap or lower coadds.pixels"
            )


def _without_wrap(region: Region) -> list[tuple[float, float]]:
    """Return the ranges of right ascension of a region, none across 360."""
    low = region.ra_min % 360
    high = low + region.width
    return [(low, high)] if high <= 360 else [(low, 360.0), (0.0, high - 360)]
