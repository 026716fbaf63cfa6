"""Tiles of coadds as fields: a whole tile, or a patch of it with a border."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from romandask.kernels.measurement.detected_objects import WHOLE
from romandask.model.spectra import NJY_ZERO_POINT
from romandask.model.tiles import PatchGrid
from romandask.products.mosaic import Mosaic
from romandask.stages.coadds.tile_maker import Coadds
from romandask.stages.detections.field import Field, Window

BORDER = 10.0
"""Width of the border with which a patch is read, arcsec (docs/concepts/methods.md)."""


@dataclass(frozen=True, kw_only=True)
class TileField(Field):
    """A window of a tile of a survey's coadds as a field."""

    coadds: Coadds
    """Coadds of the survey."""
    tile: int
    """Index of the tile."""
    window: tuple[slice, slice]
    """Rows and columns of the tile."""
    patches: tuple[tuple[int, int], ...]
    """Row and column of the patches whose mean PSF is that of the field."""
    mosaics: dict[str, Mosaic] = field(default_factory=dict)
    """Cache of the readers of the bands. They read the store, or the memory if a patch is not stored and was made."""
    held: dict[tuple[str, str], np.ndarray] = field(default_factory=dict)
    """Arrays that were read by `hold` and not yet returned whole, by band and name."""

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the window."""
        rows, columns = self.window
        return rows.stop - rows.start, columns.stop - columns.start

    def strips(self) -> Iterator[Window]:
        """Yield windows of full rows that consist of whole chunks of the stored tile, so that none is decoded twice."""
        rows, chunk = self.window[0], self.coadds.patches.side // 2
        cuts = [rows.start, *range((rows.start // chunk + 1) * chunk, rows.stop, chunk), rows.stop]
        for low, high in zip(cuts[:-1], cuts[1:], strict=True):
            yield slice(low - rows.start, high - rows.start), slice(None)

    def hold(self) -> None:
        """Read the arrays from which both the detection image and the photometry are made, to decode them only once.

        Each is held until it is returned whole.
        """
        for band in self.detection_bands:
            for name, array in self.arrays(band, ("image", "weight")).items():
                self.held[band, name] = array

    def arrays(self, band: str, names: tuple[str, ...], window: Window = WHOLE) -> dict[str, np.ndarray]:
        """Return arrays of a band, by name (see `Field.arrays`); `noise` is the first realisation."""
        if band not in self.mosaics:
            self.mosaics[band] = self.coadds.tile_image(self.tile, band)
        rows, columns = (
            slice(own.start + first, own.start + last)
            for own, length, part in zip(self.window, self.shape, window, strict=True)
            for first, last, _ in [part.indices(length)]
        )
        arrays = {}
        for name in names:
            if (band, name) in self.held:
                whole = (rows, columns) == self.window
                arrays[name] = self.held.pop((band, name)) if whole else self.held[band, name][window]
            elif name == "psf":
                arrays[name] = self._psf(band)
            elif name == "noise":
                arrays[name] = self.mosaics[band](name, (slice(0, 1), rows, columns))[0]
            else:
                arrays[name] = self.mosaics[band](name, (rows, columns))
        return arrays

    def _psf(self, band: str) -> np.ndarray:
        """Return the mean PSF of the patches that have data; zeros if none has."""
        coadds = self.coadds
        units = [coadds.index(self.tile, band, *patch) for patch in self.patches]
        psfs = [coadds.load(unit, ("psf",))["psf"] for unit in units]
        filled = [psf for psf in psfs if psf.any()]
        return np.mean(filled, axis=0) if filled else psfs[0]


def tile_field(coadds: Coadds, tile: int) -> TileField:
    """Return a tile of a survey's coadds as a field, with the bands and the detection method of its instrument.

    Parameters
    ----------
    coadds : Coadds
    tile : int
        Index of the tile.
    """
    grid = coadds.patches
    whole = slice(0, grid.pixels), slice(0, grid.pixels)
    return field_of(coadds, tile, whole, tuple(grid.touching(whole)))


def patch_field(coadds: Coadds, tile: int, patch: tuple[int, int]) -> TileField:
    """Return a patch of a tile, with its border, as a field. Its PSF is that of the patch.

    Parameters
    ----------
    coadds : Coadds
    tile : int
        Index of the tile.
    patch : (int, int)
        Row and column of the patch.
    """
    return field_of(coadds, tile, bordered(coadds.patches, patch, coadds.instrument.coadd_scale), (patch,))


def units_in(coadds: Coadds, tile: int, windows: Sequence[tuple[slice, slice]]) -> tuple[tuple[str, str], ...]:
    """Return (stage, unit) of the coadds that have pixels in some windows of a tile (by index), in all bands."""
    grid = coadds.patches
    touched = {patch for window in windows for patch in grid.touching(window)}
    units = {coadds.index(tile, band, *patch) for band in coadds.instrument.bands for patch in touched}
    return tuple((coadds.stage, coadds.names[unit]) for unit in sorted(units))


def bordered(grid: PatchGrid, patch: tuple[int, int], scale: float) -> tuple[slice, slice]:
    """Return the rows and columns of a patch and its border, which ends at the edge of the tile.

    Parameters
    ----------
    grid : PatchGrid
        Patches of a tile.
    patch : (int, int)
        Row and column of the patch.
    scale : float, arcsec
        Size of a pixel.
    """
    border = round(BORDER / scale)
    rows, columns = (
        slice(max(part.start - border, 0), min(part.stop + border, grid.pixels)) for part in grid.window(*patch)
    )
    return rows, columns


def field_of(coadds: Coadds, tile: int, window: tuple[slice, slice], patches: tuple[tuple[int, int], ...]) -> TileField:
    """Return a window of a tile as a field whose PSF is the mean of those of some patches."""
    instrument = coadds.instrument
    drizzled = instrument.coadd == "drizzle"
    electrons = {band: instrument.bandpass(band).ab_photons() / NJY_ZERO_POINT for band in instrument.bands}
    if not drizzled:
        electrons = {band: rate * instrument.visit_seconds for band, rate in electrons.items()}
    return TileField(
        bands=instrument.bands,
        detection_bands=instrument.detection_bands or instrument.bands,
        method=instrument.detection,
        pixel_scale=instrument.coadd_scale,
        aperture=instrument.aperture,
        electrons_per_njy=electrons,
        weight_is_exposure_time=drizzled,
        coadds=coadds,
        tile=tile,
        window=window,
        patches=patches,
    )
