"""Detections: objects of each tile with forced photometry in every band, then object tables as HATS catalogs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd
from astropy.wcs import WCS

from romandask.coadds import DrawTile, DrizzleTile
from romandask.exposures import RenderExposure
from romandask.instruments.exposure import Instrument
from romandask.kernels.extract import (
    Found,
    Layer,
    aperture_fluxes,
    detect,
    kron_fluxes,
    mean_layer,
    median_layer,
    psf_fluxes,
    psf_half_light_radius,
    select,
)
from romandask.model.config import DetectionSettings
from romandask.model.sky import Region, cells_in_cone
from romandask.model.spectra import NJY_ZERO_POINT
from romandask.model.tiles import Tile, TileGrid
from romandask.runtime.hats import with_spatial_index
from romandask.runtime.products import ImageProduct, TableProduct
from romandask.runtime.schemas import schema
from romandask.runtime.units import Unit

VISIT = 30.0
"""Seconds of a visit, where a coadd's weight is not its exposure time."""
EXTENDED = 1.15
"""Half-light radius over the PSF's above which an object counts as extended."""


def detections(coadds: ImageProduct, settings: DetectionSettings, region: Region) -> TableProduct:
    """Return the lazy detections of a survey's coadds: one unit a tile, each object in the one tile that owns it."""
    maker = coadds.make
    if not isinstance(maker, DrizzleTile | DrawTile):
        raise TypeError("detections need the product that coadds() returns")
    instrument = _instrument(maker)
    bands = instrument.bands
    state = {
        "settings": settings.model_dump(exclude={"order"}), "bands": bands, "region": vars(region),
        "kind": instrument.detection, "extended": EXTENDED, "aperture": instrument.aperture,
    }  # fmt: skip
    units = tuple(
        Unit(tile.name, {**state, "tile": tile.name}, tuple((coadds.stage, f"{tile.name}-{band}") for band in bands))
        for tile in maker.tiles
    )
    return TableProduct(
        f"detections/{instrument.name}",
        units,
        DetectTile(coadds, settings, region),
        schema("objects", bands),
        bytes_per_unit=maker.pixels**2 * 4 * (3 * len(bands) + 17) + (200 << 20),
        seconds_per_unit=maker.pixels**2 * 1.2e-6,
    )


def objects(
    detections: TableProduct, coadds: ImageProduct, settings: DetectionSettings, region: Region
) -> TableProduct:
    """Return the object table of a survey: the detections of all tiles, partitioned by HEALPix (HATS)."""
    maker = coadds.make
    assert isinstance(maker, DrizzleTile | DrawTile)
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
            tuple((detections.stage, detections.names[k]) for k in members),
        )
        for cell, members in tiles_of.items()
    )
    name = _instrument(maker).name
    return TableProduct(
        f"objects/{name}",
        units,
        CollectPartition(detections, tuple(tiles_of), tuple(map(tuple, tiles_of.values())), settings.order),
        detections.schema,
        tuple(tiles_of),
        settings.order,
        400 << 20,
    )


@dataclass(frozen=True)
class DetectTile:
    """Makes the objects of one tile."""

    coadds: ImageProduct
    settings: DetectionSettings
    region: Region

    def __call__(self, index: int) -> pd.DataFrame:
        """Return the objects that the tile owns (schema: catalogs/objects.yaml)."""
        maker = self.coadds.make
        assert isinstance(maker, DrizzleTile | DrawTile)
        instrument, tile = _instrument(maker), maker.tiles[index]
        layers = {
            band: load_layer(self.coadds, instrument, index, position, band)
            for position, band in enumerate(instrument.bands)
        }
        chosen = [layers[band] for band in instrument.detection_bands or instrument.bands]
        combined = median_layer(chosen) if instrument.detection == "median" else mean_layer(chosen)
        settings = self.settings
        found = detect(
            combined, settings.threshold, settings.min_area, settings.deblend_levels, settings.deblend_contrast
        )
        wcs = WCS(tile.header(maker.pixels, instrument.coadd_scale))
        ra, dec = wcs.all_pix2world(found.x, found.y, 0) if len(found.x) else (found.x, found.y)
        keep = owned(ra, dec, tile, maker.settings.grid(), self.region) & (found.snr >= settings.min_snr)
        radius = psf_half_light_radius(combined.psf) if combined.psf.any() else 1.0
        return measure(select(found, keep), ra[keep], dec[keep], tile, layers, instrument, radius)


def load_layer(coadds: ImageProduct, instrument: Instrument, tile: int, position: int, band: str) -> Layer:
    """Return one band of a tile for photometry."""
    arrays = coadds.load(tile * len(instrument.bands) + position)
    seconds, per_unit = (arrays["weight"], 1.0) if instrument.coadd_from == "exposures" else (arrays["nimages"], VISIT)
    rate = instrument.bandpass(band).ab_photons() / NJY_ZERO_POINT * per_unit
    return Layer(arrays["image"], arrays["noise"], arrays["weight"], seconds, rate, arrays["psf"])


def owned(ra: np.ndarray, dec: np.ndarray, tile: Tile, grid: TileGrid, region: Region) -> np.ndarray:
    """True where the tile's unique area and the region hold a position: every object in exactly one tile."""
    return (grid.owner(ra, dec) == tile.id) & region.contains(ra, dec)


def measure(
    found: Found,
    ra: np.ndarray,
    dec: np.ndarray,
    tile: Tile,
    layers: dict[str, Layer],
    instrument: Instrument,
    psf_radius: float,
) -> pd.DataFrame:
    """Return the object table of some detections: positions, shapes, fluxes in every band."""
    scale = instrument.coadd_scale
    ring, column = divmod(tile.id, 1 << 32)
    number = ((ring << 18) + column << 24) + np.arange(len(found.x), dtype=np.int64)
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
        "extendedness": (found.half_light_radius > EXTENDED * psf_radius).astype(np.int8),
    }
    for band, layer in layers.items():
        flux, error, flag = kron_fluxes(layer, found)
        flags |= flag.astype(np.int32)
        columns[f"{band}_kronFlux"], columns[f"{band}_kronFluxErr"] = flux, error
        columns[f"{band}_apFlux"], columns[f"{band}_apFluxErr"] = aperture_fluxes(
            layer, found, instrument.aperture / scale
        )
        columns[f"{band}_psfFlux"], columns[f"{band}_psfFluxErr"] = psf_fluxes(layer, found)
    frame = pd.DataFrame(columns | {"flags": flags})
    return with_spatial_index(frame, "coord_ra", "coord_dec")


@dataclass(frozen=True)
class CollectPartition:
    """Makes one HEALPix partition of an object table from the tiles that reach into it."""

    detections: TableProduct
    cells: tuple[int, ...]
    members: tuple[tuple[int, ...], ...]
    order: int

    def __call__(self, index: int) -> pd.DataFrame:
        """Return the objects of the partition, by _healpix_29."""
        parts = [self.detections.load(k) for k in self.members[index]]
        shift = 2 * (29 - self.order)
        parts = [part[part["_healpix_29"].to_numpy() >> shift == self.cells[index]] for part in parts]
        filled = [part for part in parts if len(part)]
        if not filled:
            return self.detections.schema.empty_table().to_pandas()
        return pd.concat(filled).sort_values(["_healpix_29", "objectId"], ignore_index=True)


def _instrument(maker: DrizzleTile | DrawTile) -> Instrument:
    render = maker.exposures.make
    assert isinstance(render, RenderExposure)
    return render.instrument
