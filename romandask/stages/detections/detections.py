"""Detections: the objects of each tile with forced photometry in every band."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd
from astropy.wcs import WCS

from romandask.instruments.instrument import Instrument
from romandask.kernels.measurement.extract import (
    SATURATED_CORE,
    DetectedObjects,
    aperture_fluxes,
    detect,
    detect_peaks,
    kron_fluxes,
    psf_fluxes,
    psf_half_light_radius,
    select,
)
from romandask.kernels.universe.dust import extinction
from romandask.model.settings import DetectionSettings
from romandask.model.sky import Region, unit_vectors
from romandask.model.tiles import Tile, TileGrid
from romandask.products.hats import with_spatial_index
from romandask.products.image_set import ImageSet
from romandask.products.images import ImageProduct
from romandask.products.memory import release_free_memory
from romandask.products.schemas import schema
from romandask.products.units import Unit
from romandask.stages.coadds.tile_maker import Coadds
from romandask.stages.detections.field import Field, tile_field
from romandask.stages.stage import UNITS_FROM_POINTINGS, Stage, SurveyContext
from romandask.stages.truth.catalogs import TruthCatalogs
from romandask.storage.arrays import Variable

EXTENDED = 1.15
"""Half-light radius over the PSF's above which an object counts as extended."""


@dataclass(frozen=True, kw_only=True, repr=False)
class Detections(ImageSet):
    """The detections of one instrument: lazy maps of objects (tile, y, x), a table of objects beside each."""

    coadds: Coadds
    settings: DetectionSettings
    region: Region

    @property
    def instrument(self) -> Instrument:
        """The instrument."""
        return self.coadds.instrument

    @property
    def truth(self) -> TruthCatalogs:
        """The truth under the tiles."""
        return self.coadds.truth

    @property
    def tiles(self) -> tuple[Tile, ...]:
        """The tiles, one a unit."""
        return self.coadds.tiles

    def objects(self, index: int) -> pd.DataFrame:
        """Return the objects of a tile (schema: catalogs/objects.yaml)."""
        return self.load(index, ("objects",))["objects"]


def detections(coadds: Coadds, settings: DetectionSettings, region: Region) -> Detections:
    """Return the lazy detections of a survey's coadds: one unit a tile, dims (tile, y, x).

    The array `segmentation` holds the number of the object in whose isophote a pixel lies, the last 24 bits of its
    objectId; 0 for none. Beside each tile's is its table `objects`, each object in the one tile that owns it.
    """
    pixels, instrument, bands = coadds.pixels, coadds.instrument, coadds.instrument.bands
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
        # the extinction by the Milky Way is taken from the truth
        return images + coadds.truth.inputs(*tile_cone(coadds, k))

    units = tuple(Unit(tile.name, {**state, "tile": tile.name}, inputs(k, tile)) for k, tile in enumerate(coadds.tiles))
    text = {"long_name": "number of the object, the last 24 bits of its objectId; 0 for none"}
    product = ImageProduct(
        stage=f"detections/{instrument.name}",
        units=units,
        make=DetectTile(coadds, settings, region),
        variables=(Variable("segmentation", "int32", (pixels, pixels), ("y", "x"), text),),
        axes=("tile",),
        lengths=(len(units),),
        coordinates=lambda: {
            name: value for name, value in coadds.product.coordinates().items() if value[0] == ("tile",)
        },
        attributes={"survey": instrument.name, "pixel_scale": instrument.coadd_scale},
        # three planes, a mask and some chunks of all bands; after that a band's two planes and the map of objects
        bytes_per_unit=pixels**2 * 13 + (420 << 20),
        seconds_per_unit=pixels**2 * 7e-7,
        tables={"objects": schema("objects", bands)},
    )
    return Detections(product=product, coadds=coadds, settings=settings, region=region)


@dataclass(frozen=True)
class DetectTile:
    """Makes the map and the objects of one tile."""

    coadds: Coadds
    settings: DetectionSettings
    region: Region

    def __call__(self, index: int) -> dict[str, np.ndarray | pd.DataFrame]:
        """Return the map of a tile and the objects that it owns (schema: catalogs/objects.yaml)."""
        coadds, tile = self.coadds, self.coadds.tiles[index]
        field, wcs = tile_field(coadds, index), coadds.wcs(index)
        found, segments, radius = find_objects(field, self.settings)
        ra, dec = positions(found, wcs)
        keep = owned(ra, dec, tile, coadds.settings.grid(), self.region)
        measured = measure(select(found, keep), field, segments, radius)
        ring, column = divmod(tile.id, 1 << 32)
        objects = measured.assign(
            objectId=((ring << 18) + column << 24) + found.label[keep],
            coord_ra=ra[keep],
            coord_dec=dec[keep],
            tile=np.full(len(measured), tile.name, object),
        )
        objects = with_spatial_index(objects, "coord_ra", "coord_dec")
        at = unit_vectors(objects["coord_ra"].to_numpy(), objects["coord_dec"].to_numpy())
        dust = coadds.truth.milky_way(at, *tile_cone(coadds, index)[:3])
        for band in field.bands:
            objects[f"{band}_extinction"] = extinction(coadds.instrument.bandpass(band), dust)
        return {"segmentation": segments, "objects": objects}


def tile_cone(coadds: Coadds, index: int) -> tuple[float, float, float, float]:
    """Return centre and radii (degrees) of the cone around the unique area of a tile, for galaxies and stars."""
    tile, grid = coadds.tiles[index], coadds.settings.grid()
    radius = (grid.inner / np.sqrt(2) + 5) / 3600
    return tile.ra, tile.dec, radius, radius


def owned(ra: np.ndarray, dec: np.ndarray, tile: Tile, grid: TileGrid, region: Region) -> np.ndarray:
    """True where the tile's unique area and the region hold a position: every object in exactly one tile."""
    return (grid.owner(ra, dec) == tile.id) & region.contains(ra, dec)


def detect_and_measure(field: Field, wcs: WCS, settings: DetectionSettings) -> tuple[pd.DataFrame, np.ndarray]:
    """Detect and measure the objects of a field: of a coadd, or of images that any program made (`ArrayField`).

    Parameters
    ----------
    field : Field
    wcs : astropy.wcs.WCS
        Of the images.
    settings : DetectionSettings

    Returns
    -------
    objects : DataFrame
        One row an object: `label`, its number in the map, `coord_ra`, `coord_dec`, and the columns of
        catalogs/objects.yaml but for identifiers and extinction.
    segmentation : ndarray of int32, shape (ny, nx)
        The map of objects; 0 for none.
    """
    found, segments, radius = find_objects(field, settings)
    ra, dec = positions(found, wcs)
    return measure(found, field, segments, radius).assign(label=found.label, coord_ra=ra, coord_dec=dec), segments


def find_objects(field: Field, settings: DetectionSettings) -> tuple[DetectedObjects, np.ndarray, float]:
    """Return the objects of a field's detection image, their map (ny, nx) and the half-light radius of its PSF, pixels.

    Memory that the detection image took is released: photometry needs one band at a time.
    """
    combined = field.detection()
    if field.method == "median":
        levels = settings.deblend_levels, settings.deblend_contrast
        found, segments = detect(combined, settings.threshold, settings.min_area, *levels, settings.min_snr)
    else:
        found, segments = detect_peaks(combined, settings.threshold, settings.min_area, settings.min_snr)
    radius = psf_half_light_radius(combined.psf) if combined.psf.any() else 1.0
    del combined
    release_free_memory()
    return found, segments, radius


def positions(found: DetectedObjects, wcs: WCS) -> tuple[np.ndarray, np.ndarray]:
    """Return right ascension and declination of objects, degrees."""
    return wcs.all_pix2world(found.x, found.y, 0) if len(found.x) else (found.x, found.y)


def measure(found: DetectedObjects, field: Field, segments: np.ndarray, psf_radius: float) -> pd.DataFrame:
    """Return shapes and fluxes in every band of some objects (columns of catalogs/objects.yaml).

    Parameters
    ----------
    found : DetectedObjects
    field : Field
    segments : ndarray, shape (ny, nx)
        Map of all objects of the field.
    psf_radius : float
        Half-light radius of the PSF of the detection image, pixels.
    """
    scale = field.pixel_scale
    flags = found.flags.copy()
    columns = {
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
    for band in field.bands:
        measurement = field.measurement(band)
        flux, error, flag = kron_fluxes(measurement, segments, found)
        flags |= flag.astype(np.int32)
        columns[f"{band}_kronFlux"], columns[f"{band}_kronFluxErr"] = flux, error
        columns[f"{band}_apFlux"], columns[f"{band}_apFluxErr"] = aperture_fluxes(
            measurement, segments, found, field.aperture / scale
        )
        columns[f"{band}_psfFlux"], columns[f"{band}_psfFluxErr"] = psf_fluxes(measurement, found)
        del measurement
        flags[np.isin(found.label, segments[field.saturated(band)])] |= SATURATED_CORE
    return pd.DataFrame(columns | {"flags": flags})


def build_detections(context: SurveyContext, survey: str) -> Detections:
    """Return the lazy detections of an instrument."""
    return detections(context.output(f"coadds/{survey}"), context.pipeline.detections, context.region)


DETECTIONS = Stage(
    name="detections",
    per_survey=True,
    build=build_detections,
    reads=("coadds", "truth/galaxies", "truth/stars"),
    units_known_after=UNITS_FROM_POINTINGS,
    unit="tile",
    summary="Segmentation and objects, on the median of bands (Source Extractor's method) or on peaks of their "
    "PSF-smoothed mean; forced Kron, aperture and PSF photometry with the errors of correlated noise.",
    shrink_with="lower coadds.pixels",
    tables={"objects": "detections/<survey>_objects/"},
)
