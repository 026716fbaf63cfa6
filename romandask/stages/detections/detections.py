"""Detections: objects of each tile with forced photometry in every band, then object tables as HATS catalogs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd

from romandask.kernels.detectors.simple_detector import SATURATED
from romandask.kernels.measurement.extract import (
    SATURATED_CORE,
    Found,
    aperture_fluxes,
    detect,
    detect_peaks,
    kron_fluxes,
    psf_fluxes,
    psf_half_light_radius,
    select,
)
from romandask.kernels.universe.synthetic_photometry import extinction
from romandask.model.settings import DetectionSettings
from romandask.model.sky import Region, cells_in_cone, unit_vectors
from romandask.model.tiles import Tile, TileGrid
from romandask.products.hats import with_spatial_index
from romandask.products.images import ImageProduct
from romandask.products.memory import release_free_memory
from romandask.products.schemas import schema
from romandask.products.tables import TableProduct
from romandask.products.units import Unit
from romandask.stages.coadds.tile_maker import TileMaker, tile_maker
from romandask.stages.detections.tile_bands import TileBands
from romandask.stages.detections.zero_points import corrected
from romandask.storage.arrays import Variable

EXTENDED = 1.15
"""Half-light radius over the PSF's above which an object counts as extended."""


def detections(coadds: ImageProduct, settings: DetectionSettings, region: Region) -> ImageProduct:
    """Return the lazy detections of a survey's coadds: one unit a tile, dims (tile, y, x).

    The array `segmentation` has the number of the object in whose isophote a pixel lies, the last 24 bits of its
    objectId; 0 for none. Beside each tile's is its table `objects`, each object in the one tile that owns it.
    """
    maker = tile_maker(coadds)
    render, pixels, instrument, bands = maker.source, maker.pixels, maker.instrument, maker.instrument.bands
    state = {
        "settings": settings.model_dump(exclude={"order", "match_radius", "summary_magnitude"}),
        "bands": bands,
        "region": vars(region),
        "kind": instrument.detection,
        "extended": EXTENDED,
        "aperture": instrument.aperture,
    }

    def inputs(k: int, tile: Tile) -> tuple[tuple[str, str], ...]:
        images = tuple((coadds.stage, f"{tile.name}-{band}") for band in bands)
        # the Milky Way's dust is that of the truth
        return images + render.truth.inputs(*tile_cone(maker, k))

    units = tuple(Unit(tile.name, {**state, "tile": tile.name}, inputs(k, tile)) for k, tile in enumerate(maker.tiles))
    text = {"long_name": "number of the object, the last 24 bits of its objectId; 0 for none"}
    return ImageProduct(
        stage=f"detections/{instrument.name}",
        units=units,
        make=DetectTile(coadds, settings, region),
        variables=(Variable("segmentation", "int32", (pixels, pixels), ("y", "x"), text),),
        axes=("tile",),
        lengths=(len(units),),
        coordinates=lambda: {name: value for name, value in coadds.coordinates().items() if value[0] == ("tile",)},
        attributes={"survey": instrument.name, "pixel_scale": instrument.coadd_scale},
        # three planes, a mask and some chunks of all bands; after that a band's two planes and the map of objects
        bytes_per_unit=pixels**2 * 13 + (420 << 20),
        seconds_per_unit=pixels**2 * 7e-7,
        tables={"objects": schema("objects", bands)},
    )


def objects(
    detections: ImageProduct,
    coadds: ImageProduct,
    settings: DetectionSettings,
    region: Region,
    zero: TableProduct | None = None,
) -> TableProduct:
    """Return the object table of a survey: the detections of all tiles, partitioned by HEALPix (HATS).

    Parameters
    ----------
    zero : offsets of the magnitudes (`zero_points()`), to be taken out; None leaves fluxes as they were measured
    """
    maker = tile_maker(coadds)
    radius = maker.settings.grid().inner / 3600 * 0.75
    cells = region.cells(settings.order)
    tiles_of: dict[int, list[int]] = {int(cell): [] for cell in cells}
    for k, tile in enumerate(maker.tiles):
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
        stage=f"objects/{maker.instrument.name}",
        units=units,
        make=CollectPartition(detections, tuple(tiles_of), tuple(map(tuple, tiles_of.values())), settings.order, zero),
        schema=detections.tables["objects"],
        pixels=tuple(tiles_of),
        order=settings.order,
        bytes_per_unit=400 << 20,
    )


@dataclass(frozen=True)
class DetectTile:
    """Makes the objects of one tile."""

    coadds: ImageProduct
    settings: DetectionSettings
    region: Region

    def __call__(self, index: int) -> dict[str, np.ndarray | pd.DataFrame]:
        """Return the map of a tile and the objects that it owns (schema: catalogs/objects.yaml)."""
        maker, settings = tile_maker(self.coadds), self.settings
        instrument, tile = maker.instrument, maker.tiles[index]
        bands = TileBands(self.coadds, instrument, index)
        combined = bands.detection()
        if instrument.detection == "median":
            levels = settings.deblend_levels, settings.deblend_contrast
            found, segments = detect(combined, settings.threshold, settings.min_area, *levels, settings.min_snr)
        else:
            found, segments = detect_peaks(combined, settings.threshold, settings.min_area, settings.min_snr)
        radius = psf_half_light_radius(combined.psf) if combined.psf.any() else 1.0
        # a band at a time is in memory
        del combined
        release_free_memory()
        wcs = maker.wcs(index)
        ra, dec = wcs.all_pix2world(found.x, found.y, 0) if len(found.x) else (found.x, found.y)
        keep = owned(ra, dec, tile, maker.settings.grid(), self.region)
        objects = measure(select(found, keep), ra[keep], dec[keep], tile, bands, segments, radius)
        at = unit_vectors(objects["coord_ra"].to_numpy(), objects["coord_dec"].to_numpy())
        dust = maker.source.truth.milky_way(at, *tile_cone(maker, index)[:3])
        for band in instrument.bands:
            objects[f"{band}_extinction"] = extinction(instrument.bandpass(band), dust)
        return {"segmentation": segments, "objects": objects}


def tile_cone(tiles: TileMaker, index: int) -> tuple[float, float, float, float]:
    """Return centre and radii (degrees) of the cone around the unique area of a tile, for galaxies and stars."""
    tile, grid = tiles.tiles[index], tiles.settings.grid()
    radius = (grid.inner / np.sqrt(2) + 5) / 3600
    return tile.ra, tile.dec, radius, radius


def owned(ra: np.ndarray, dec: np.ndarray, tile: Tile, grid: TileGrid, region: Region) -> np.ndarray:
    """True where the tile's unique area and the region hold a position: every object in exactly one tile."""
    return (grid.owner(ra, dec) == tile.id) & region.contains(ra, dec)


def measure(
    found: Found,
    ra: np.ndarray,
    dec: np.ndarray,
    tile: Tile,
    bands: TileBands,
    segments: np.ndarray,
    psf_radius: float,
) -> pd.DataFrame:
    """Return the object table of some detections: positions, shapes, fluxes in every band."""
    scale = bands.instrument.coadd_scale
    ring, column = divmod(tile.id, 1 << 32)
    number = ((ring << 18) + column << 24) + found.label
    flags = found.flags.copy()
    columns = {
        "objectId": number,
        "coord_ra": ra,
        "coord_dec": dec,
        "tile": np.full(len(number), tile.name, object),
        "x": found.x,
        "y": found.y,
        "ixx": found.x2 * scale**2,
        "iyy": found.y2 * scale**2,
        "ixy": found.xy * scale**2,
        "kron_radius": found.kron_radius * np.sqrt(found.a * found.b) * scale,
        "half_light_radius": found.half_light_radius * scale,
        "snr": found.snr,
        "blendedness": found.blendedness,
        "extendedness": (found.half_light_radius > EXTENDED * psf_radius).astype(np.int8),
    }
    for band in bands.instrument.bands:
        layer = bands.layer(band)
        flux, error, flag = kron_fluxes(layer, segments, found)
        flags |= flag.astype(np.int32)
        columns[f"{band}_kronFlux"], columns[f"{band}_kronFluxErr"] = flux, error
        columns[f"{band}_apFlux"], columns[f"{band}_apFluxErr"] = aperture_fluxes(
            layer, segments, found, bands.instrument.aperture / scale
        )
        columns[f"{band}_psfFlux"], columns[f"{band}_psfFluxErr"] = psf_fluxes(layer, found)
        del layer
        saturated = segments[(bands.arrays(band, ("dq",))["dq"] & SATURATED) > 0]
        flags[np.isin(found.label, saturated)] |= SATURATED_CORE
    frame = pd.DataFrame(columns | {"flags": flags})
    return with_spatial_index(frame, "coord_ra", "coord_dec")


@dataclass(frozen=True)
class CollectPartition:
    """Makes one HEALPix partition of an object table from the tiles that reach into it."""

    detections: ImageProduct
    cells: tuple[int, ...]
    members: tuple[tuple[int, ...], ...]
    order: int
    zero: TableProduct | None = None

    def __call__(self, index: int) -> pd.DataFrame:
        """Return the objects of the partition, by _healpix_29."""
        parts = [self.detections.load(k, ("objects",))["objects"] for k in self.members[index]]
        shift = 2 * (29 - self.order)
        parts = [part[part["_healpix_29"].to_numpy() >> shift == self.cells[index]] for part in parts]
        filled = [part for part in parts if len(part)]
        if not filled:
            return self.detections.tables["objects"].empty_table().to_pandas()
        found = pd.concat(filled).sort_values(["_healpix_29", "objectId"], ignore_index=True)
        return found if self.zero is None else corrected(found, self.zero.load(0))
