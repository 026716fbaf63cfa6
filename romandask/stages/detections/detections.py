"""Detections: the objects of each tile, with forced photometry in every band."""

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
"""Ratio of the half-light radius of an object to that of the PSF above which the object counts as extended."""


@dataclass(frozen=True, kw_only=True, repr=False)
class Detections(ImageSet):
    """Detections of one instrument: a lazy segmentation map (tile, y, x) and a table of objects for each tile."""

    coadds: Coadds
    """Coadds in which objects are detected and measured."""
    settings: DetectionSettings
    """Section `detections` of the pipeline."""
    region: Region
    """Region of the survey; objects outside it are left out."""

    @property
    def instrument(self) -> Instrument:
        """Instrument of the coadds."""
        return self.coadds.instrument

    @property
    def truth(self) -> TruthCatalogs:
        """Truth catalogs of the survey."""
        return self.coadds.truth

    @property
    def tiles(self) -> tuple[Tile, ...]:
        """Tiles of the coadds; each is one unit."""
        return self.coadds.tiles

    def objects(self, index: int) -> pd.DataFrame:
        """Return the objects of the tile with a given index (schema: catalogs/objects.yaml)."""
        return self.load(index, ("objects",))["objects"]


def detections(coadds: Coadds, settings: DetectionSettings, region: Region) -> Detections:
    """Return the lazy detections of a survey's coadds, one unit per tile.

    Parameters
    ----------
    coadds : Coadds
        Coadds in which objects are detected and measured.
    settings : DetectionSettings
        Section `detections` of the pipeline.
    region : Region
        Region of the survey; objects outside it are left out.

    Returns
    -------
    Detections
        Array `segmentation`, dims (tile, y, x): the number of the object in whose isophote a pixel lies, which is the
        last 24 bits of its objectId; 0 for none. Table `objects` of each tile (schema: catalogs/objects.yaml): the
        objects whose position lies in the unique area of the tile, so that every object is in exactly one table.
    """
    pixels, instrument, bands = coadds.pixels, coadds.instrument, coadds.instrument.bands
    unit_settings = {
        "settings": settings.model_dump(exclude={"order", "match_radius", "summary_magnitude"}),
        "bands": bands,
        "region": vars(region),
        "kind": instrument.detection,
        "extended": EXTENDED,
        "aperture": instrument.aperture,
    }

    def inputs(k: int, tile: Tile) -> tuple[tuple[str, str], ...]:
        images = tuple((coadds.stage, coadds.names[unit]) for band in bands for unit in coadds.units_of(k, band))
        # the extinction by the Milky Way is that of true galaxies nearby
        return images + coadds.truth.inputs(*tile_cone(coadds, k))

    units = tuple(
        Unit(tile.name, {**unit_settings, "tile": tile.name}, inputs(k, tile)) for k, tile in enumerate(coadds.tiles)
    )
    attributes = {"long_name": "number of the object, the last 24 bits of its objectId; 0 for none"}
    product = ImageProduct(
        stage=f"detections/{instrument.name}",
        units=units,
        make=DetectTile(coadds, settings, region),
        variables=(Variable("segmentation", "int32", (pixels, pixels), ("y", "x"), attributes),),
        axes=("tile",),
        lengths=(len(units),),
        coordinates=lambda: {
            name: value for name, value in coadds.product.coordinates().items() if value[0] == ("tile",)
        },
        attributes={"survey": instrument.name, "pixel_scale": instrument.coadd_scale},
        # peak of detection: three planes, a mask and some chunks of all bands; photometry needs less, two planes of a
        # band and the segmentation map
        bytes_per_unit=pixels**2 * 13 + (420 << 20),
        seconds_per_unit=pixels**2 * 7e-7,
        tables={"objects": schema("objects", bands)},
    )
    return Detections(product=product, coadds=coadds, settings=settings, region=region)


@dataclass(frozen=True)
class DetectTile:
    """Makes the segmentation map and the objects of one tile."""

    coadds: Coadds
    settings: DetectionSettings
    region: Region

    def __call__(self, index: int) -> dict[str, np.ndarray | pd.DataFrame]:
        """Return `segmentation` (ny, nx) and the table `objects` (schema: catalogs/objects.yaml) of a tile."""
        coadds, tile = self.coadds, self.coadds.tiles[index]
        field, wcs = tile_field(coadds, index), coadds.wcs(index)
        detected, segments, psf_radius = find_objects(field, self.settings)
        ra, dec = positions(detected, wcs)
        keep = owned(ra, dec, tile, coadds.settings.grid(), self.region)
        measured = measure(select(detected, keep), field, segments, psf_radius)
        ring, column = divmod(tile.id, 1 << 32)
        objects = measured.assign(
            objectId=((ring << 18) + column << 24) + detected.label[keep],
            coord_ra=ra[keep],
            coord_dec=dec[keep],
            tile=np.full(len(measured), tile.name, object),
        )
        objects = with_spatial_index(objects, "coord_ra", "coord_dec")
        vectors = unit_vectors(objects["coord_ra"].to_numpy(), objects["coord_dec"].to_numpy())
        dust = coadds.truth.milky_way(vectors, *tile_cone(coadds, index)[:3])
        for band in field.bands:
            objects[f"{band}_extinction"] = extinction(coadds.instrument.bandpass(band), dust)
        return {"segmentation": segments, "objects": objects}


def tile_cone(coadds: Coadds, index: int) -> tuple[float, float, float, float]:
    """Return the cone that contains the unique area of a tile and 5 arcsec around it.

    Returns
    -------
    ra, dec, radius, stars_radius : float, degrees
        Centre, and radius for galaxies and for stars, which are equal here.
    """
    tile, grid = coadds.tiles[index], coadds.settings.grid()
    radius = (grid.inner / np.sqrt(2) + 5) / 3600
    return tile.ra, tile.dec, radius, radius


def owned(ra: np.ndarray, dec: np.ndarray, tile: Tile, grid: TileGrid, region: Region) -> np.ndarray:
    """Return True, (n,), for positions in both the unique area of a tile and the region.

    Unique areas do not overlap, so every position in the region belongs to exactly one tile.

    Parameters
    ----------
    ra, dec : ndarray, shape (n,), degrees
    tile : Tile
    grid : TileGrid
    region : Region
    """
    return (grid.owner(ra, dec) == tile.id) & region.contains(ra, dec)


def detect_and_measure(field: Field, wcs: WCS, settings: DetectionSettings) -> tuple[pd.DataFrame, np.ndarray]:
    """Detect and measure the objects of a field.

    Parameters
    ----------
    field : Field
        Images in one or more bands: a tile of a coadd (`tile_field`), or images from any program (`ArrayField`).
    wcs : astropy.wcs.WCS
        WCS of the images.
    settings : DetectionSettings
        Section `detections` of a pipeline.

    Returns
    -------
    objects : DataFrame
        One row per object: `label` (its number in the segmentation map), `coord_ra` and `coord_dec` (degrees), and
        the columns of catalogs/objects.yaml except identifiers and extinction.
    segmentation : ndarray, shape (ny, nx), int32
        Number of the object in whose isophote a pixel lies; 0 for none.
    """
    detected, segments, psf_radius = find_objects(field, settings)
    ra, dec = positions(detected, wcs)
    objects = measure(detected, field, segments, psf_radius)
    return objects.assign(label=detected.label, coord_ra=ra, coord_dec=dec), segments


def find_objects(field: Field, settings: DetectionSettings) -> tuple[DetectedObjects, np.ndarray, float]:
    """Detect the objects of a field in its detection image.

    The memory of the detection image is released before the function returns, because photometry needs room for one
    band.

    Returns
    -------
    objects : DetectedObjects
    segments : ndarray, shape (ny, nx), int32
        Segmentation map.
    psf_radius : float, pixels
        Half-light radius of the PSF of the detection image; 1 if the PSF is empty.
    """
    detection_image = field.detection()
    if field.method == "median":
        detected, segments = detect(
            detection_image,
            threshold=settings.threshold,
            min_area=settings.min_area,
            levels=settings.deblend_levels,
            contrast=settings.deblend_contrast,
            min_snr=settings.min_snr,
        )
    else:
        detected, segments = detect_peaks(detection_image, settings.threshold, settings.min_area, settings.min_snr)
    psf_radius = psf_half_light_radius(detection_image.psf) if detection_image.psf.any() else 1.0
    del detection_image
    release_free_memory()
    return detected, segments, psf_radius


def positions(objects: DetectedObjects, wcs: WCS) -> tuple[np.ndarray, np.ndarray]:
    """Return right ascension and declination of objects, (n,) each, degrees."""
    return wcs.all_pix2world(objects.x, objects.y, 0) if len(objects.x) else (objects.x, objects.y)


def measure(objects: DetectedObjects, field: Field, segments: np.ndarray, psf_radius: float) -> pd.DataFrame:
    """Measure the shapes of objects, and their fluxes in every band.

    Parameters
    ----------
    objects : DetectedObjects
        Objects to measure; they may be a part of the objects in the segmentation map.
    field : Field
    segments : ndarray, shape (ny, nx), int32
        Segmentation map of all objects of the field.
    psf_radius : float, pixels
        Half-light radius of the PSF of the detection image.

    Returns
    -------
    DataFrame
        Columns of catalogs/objects.yaml except identifiers, coordinates and extinction, one row per object.
    """
    scale = field.pixel_scale
    flags = objects.flags.copy()
    columns = {
        "x": objects.x,
        "y": objects.y,
        "ixx": objects.x2 * scale**2,
        "iyy": objects.y2 * scale**2,
        "ixy": objects.xy * scale**2,
        "kron_radius": objects.kron_radius * np.sqrt(objects.a * objects.b) * scale,
        "half_light_radius": objects.half_light_radius * scale,
        "snr": objects.snr,
        "blendedness": objects.blendedness,
        "extendedness": (objects.half_light_radius > EXTENDED * psf_radius).astype(np.int8),
    }
    for band in field.bands:
        measurement = field.measurement(band)
        flux, error, flag = kron_fluxes(measurement, segments, objects)
        flags |= flag.astype(np.int32)
        columns[f"{band}_kronFlux"], columns[f"{band}_kronFluxErr"] = flux, error
        columns[f"{band}_apFlux"], columns[f"{band}_apFluxErr"] = aperture_fluxes(
            measurement, segments, objects, field.aperture / scale
        )
        columns[f"{band}_psfFlux"], columns[f"{band}_psfFluxErr"] = psf_fluxes(measurement, objects)
        # make room for the data quality plane
        del measurement
        flags[np.isin(objects.label, segments[field.saturated(band)])] |= SATURATED_CORE
    return pd.DataFrame(columns | {"flags": flags})


def build_detections(context: SurveyContext, survey: str) -> Detections:
    """Return the lazy detections of a survey (the `build` of the stage)."""
    return detections(context.output(f"coadds/{survey}"), context.pipeline.detections, context.region)


DETECTIONS = Stage(
    name="detections",
    per_survey=True,
    build=build_detections,
    reads=("coadds", "truth/galaxies", "truth/stars"),
    units_known_after=UNITS_FROM_POINTINGS,
    unit="tile",
    summary="The segmentation map and the objects of a tile, detected on the median of the bands (Source Extractor's "
    "method) or as peaks of their PSF-smoothed mean, with forced Kron, aperture and PSF photometry and errors for "
    "correlated noise.",
    shrink_with="lower coadds.pixels",
    tables={"objects": "detections/<survey>_objects/"},
)
