"""The part of a detector that is drawn: all of it, or what the tiles of the survey need."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import pandas as pd
from astropy.wcs import WCS

from romandask.kernels.coadding.background import BACKGROUND_MESH
from romandask.kernels.coadding.pixel_map import pixel_map, strips
from romandask.kernels.detectors.simple_detector import NOISE_BLOCK
from romandask.model.sky import touching_pairs
from romandask.model.tiles import Tile
from romandask.stages.pointings import corners_of

Window = tuple[slice, slice]
"""Rows and columns of a part of a detector."""


@dataclass(frozen=True)
class DrawnArea:
    """Tiles for which exposures are drawn."""

    tiles: Mapping[int, tuple[Tile, ...]]
    """Tiles that an exposure touches, by its row in the pointings table."""
    pixels: int
    """Side of a padded tile, pixels."""
    scale: float
    """Size of a tile pixel, arcsec."""

    def settings(self, row: int) -> dict[str, object]:
        """Return what the drawn part of an exposure depends on, as JSON values."""
        return {"tiles": [tile.name for tile in self.tiles.get(row, ())], "pixels": self.pixels, "scale": self.scale}

    def window(self, row: int, frame: WCS, shape: tuple[int, int]) -> Window:
        """Return the part of a detector that is drawn.

        It holds all pixels that the coadds of the tiles read, and a cell of the mesh on which their background is
        estimated beyond these. Its edges are those of blocks of the detector that have their own random numbers.

        Parameters
        ----------
        row : int
            Row of the exposure in the pointings table.
        frame : WCS
            WCS of the exposure.
        shape : (int, int)
            Rows and columns of the detector.
        """
        detector, tile_window = [slice(0, length) for length in shape], (slice(0, self.pixels), slice(0, self.pixels))
        parts = [
            strip
            for tile in self.tiles.get(row, ())
            for strip in strips(pixel_map(frame, WCS(tile.header(self.pixels, self.scale)), *detector), tile_window)
        ]
        if not parts:
            return slice(0, 0), slice(0, 0)
        rows, columns = ([getattr(part, axis) for part in parts] for axis in ("rows", "columns"))
        return _widened(rows, shape[0]), _widened(columns, shape[1])

    def share(self, shape: tuple[int, int], pixel_scale: float) -> float:
        """Return an upper estimate of the share of a detector that is drawn, as a mean over the exposures."""
        side = self.pixels * self.scale / pixel_scale + 2 * (BACKGROUND_MESH + NOISE_BLOCK)
        tiles = sum(len(touching) for touching in self.tiles.values()) / max(1, len(self.tiles))
        return min(1.0, tiles * side**2 / (shape[0] * shape[1]))


def drawn_area(table: pd.DataFrame, tiles: list[Tile], side: float, pixels: int, scale: float) -> DrawnArea:
    """Return the area to draw of the exposures of a pointings table.

    Parameters
    ----------
    table : DataFrame
        Pointings table (schema: catalogs/pointings.yaml).
    tiles : list of Tile
        Tiles of the survey.
    side : float, arcsec
        Side of a padded tile.
    pixels : int
        Side of a padded tile, pixels of the instrument's coadds.
    scale : float, arcsec
        Size of these pixels.
    """
    touching: dict[int, tuple[Tile, ...]] = {}
    footprints = np.stack([tile.corners(side) for tile in tiles])
    for row, tile in zip(*touching_pairs(corners_of(table), footprints), strict=True):
        touching[int(row)] = (*touching.get(int(row), ()), tiles[int(tile)])
    return DrawnArea(touching, pixels, scale)


def _widened(parts: list[slice], length: int) -> slice:
    """Return the range of several ranges, with a margin and up to the next edges of blocks, within 0 to `length`."""
    low = min(part.start for part in parts) - BACKGROUND_MESH
    high = max(part.stop for part in parts) + BACKGROUND_MESH
    return slice(max(0, low // NOISE_BLOCK * NOISE_BLOCK), min(length, -(-high // NOISE_BLOCK) * NOISE_BLOCK))
