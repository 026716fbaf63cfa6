"""Detections: the objects of each patch of a tile, with forced photometry in every band."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import pandas as pd

from romandask.instruments.instrument import Instrument
from romandask.kernels.measurement.detected_objects import Part, select
from romandask.kernels.universe.dust import extinction
from romandask.model.errors import UserError
from romandask.model.settings import DetectionSettings
from romandask.model.sky import Region, from_tangent_plane, unit_vectors
from romandask.model.tiles import Tile, TileGrid
from romandask.products.hats import with_spatial_index
from romandask.products.image_set import ImageSet
from romandask.products.images import ImageProduct
from romandask.products.schemas import schema
from romandask.products.units import LazyUnits, Unit
from romandask.stages.coadds.tile_maker import Coadds
from romandask.stages.detections.coadd_noise import CoaddNoise
from romandask.stages.detections.measure import EXTENDED, find_objects, measure, positions
from romandask.stages.detections.tile_field import BORDER, bordered, patch_field, units_in
from romandask.stages.stage import UNITS_FROM_POINTINGS, Stage, SurveyContext
from romandask.stages.truth.catalogs import TruthCatalogs
from romandask.storage.arrays import Variable

NUMBER_BITS = 28
"""Bits of an objectId, the last, that are the number of the object in its tile."""
TILE_BITS = 32
"""Bits of an objectId that are the number of its tile. Groups of two surveys need three more, for the survey."""


@dataclass(frozen=True, kw_only=True, repr=False)
class Detections(ImageSet):
    """Detections of one instrument: a lazy segmentation map (tile, y, x) and a table of objects for each patch."""

    coadds: Coadds
    """Coadds in which objects are detected and measured."""
    noise: CoaddNoise
    """Noise of the coadds."""
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
        """Tiles of the coadds; each patch of them is one unit."""
        return self.coadds.tiles

    def units_of(self, tile: int) -> range:
        """Return the indices of the units of the tile with an index: its patches."""
        count = self.coadds.patches.count**2
        return range(tile * count, (tile + 1) * count)

    def inputs(self, tile: int) -> tuple[tuple[str, str], ...]:
        """Return (stage, unit) of all patches of the tile with an index."""
        return tuple((self.stage, self.names[unit]) for unit in self.units_of(tile))

    def has_tile(self, tile: int) -> bool:
        """Return whether all patches of the tile with an index are stored."""
        return all(map(self.has, self.units_of(tile)))

    def cones(self) -> Iterator[tuple[float, float, float]]:
        """Yield right ascension, declination and radius, degrees, of a cone around the objects of each unit."""
        count = self.coadds.patches.count
        for tile in range(len(self.tiles)):
            for number in range(count**2):
                yield patch_cone(self.coadds, tile, divmod(number, count), 1.0)[:3]

    def objects(self, unit: int) -> pd.DataFrame:
        """Return the objects of the patch with a given index of its unit (schema: catalogs/objects.yaml)."""
        return self.load(unit, ("objects",))["objects"]

    def tile_objects(self, tile: int) -> pd.DataFrame:
        """Return the objects of all patches of the tile with an index (schema: catalogs/objects.yaml)."""
        parts = [self.objects(unit) for unit in self.units_of(tile)]
        filled = [part for part in parts if len(part)]
        return pd.concat(filled, ignore_index=True) if filled else parts[0]


def detections(coadds: Coadds, noise: CoaddNoise, settings: DetectionSettings, region: Region) -> Detections:
    """Return the lazy detections of a survey's coadds, one unit per patch of a tile, in all bands.

    Parameters
    ----------
    coadds : Coadds
        Coadds in which objects are detected and measured.
    noise : CoaddNoise
        Noise of the coadds.
    settings : DetectionSettings
        Section `detections` of the pipeline.
    region : Region
        Region of the survey; objects outside it are left out.

    Returns
    -------
    Detections
        Array `segmentation`, dims (tile, y, x): the number of the object in whose isophote a pixel lies, which is the
        last 28 bits of its objectId; 0 for none. An object with its peak in the pixel (x, y) has the number
        y * pixels + x + 1. Table `objects` of each patch (schema: catalogs/objects.yaml): the objects with their peak
        in the patch, whose position lies in the unique area of the tile. So every object is in exactly one table.

    Raises
    ------
    UserError
        If tiles have so many pixels that an objectId has not enough bits for them.
    """
    pixels, instrument, bands = coadds.pixels, coadds.instrument, coadds.instrument.bands
    _check_numbers(coadds)
    grid, scale = coadds.patches, instrument.coadd_scale
    places = [(row, column) for row in range(grid.count) for column in range(grid.count)]
    unit_settings = {
        "settings": settings.model_dump(exclude={"order", "match_radius", "summary_magnitude"}),
        "bands": bands,
        "region": vars(region),
        "kind": instrument.detection,
        "extended": EXTENDED,
        "aperture": instrument.aperture,
        "border": BORDER,
        "patch": grid.side,
    }

    def unit(index: int) -> Unit:
        k, patch = index // len(places), places[index % len(places)]
        tile = coadds.tiles[k].name
        # the extinction by the Milky Way is that of true galaxies nearby
        truth = coadds.truth.inputs(*patch_cone(coadds, k, patch))
        images = units_in(coadds, k, [bordered(grid, patch, scale)])
        return Unit(
            f"{tile}-{grid.name(*patch)}", {**unit_settings, "tile": tile}, (*images, (noise.stage, tile), *truth)
        )

    names = tuple(f"{tile.name}-{grid.name(*patch)}" for tile in coadds.tiles for patch in places)
    attributes = {"long_name": f"number of the object, the last {NUMBER_BITS} bits of its objectId; 0 for none"}
    window = min(grid.side + 2 * round(BORDER / scale), pixels)
    product = ImageProduct(
        stage=f"detections/{instrument.name}",
        units=LazyUnits(names, unit),
        make=DetectPatch(coadds, noise, settings, region),
        variables=(Variable("segmentation", "int32", (pixels, pixels), ("y", "x"), attributes),),
        axes=("tile",),
        lengths=(len(coadds.tiles),),
        coordinates=lambda: {
            name: value for name, value in coadds.product.coordinates().items() if value[0] == ("tile",)
        },
        attributes={"survey": instrument.name, "pixel_scale": scale},
        # image and weight of all bands; three planes, a mask and the limits of sep; the chunks that are decoded
        bytes_per_unit=window**2 * (8 * len(bands) + 26) + (200 << 20),
        # reading and measuring each band, and detection
        seconds_per_unit=window**2 * (9e-8 * len(bands) + 1.8e-7),
        tables={"objects": schema("objects", bands)},
        patches=grid,
    )
    return Detections(product=product, coadds=coadds, noise=noise, settings=settings, region=region)


@dataclass(frozen=True)
class DetectPatch:
    """Makes the segmentation map and the objects of one patch of a tile."""

    coadds: Coadds
    noise: CoaddNoise
    settings: DetectionSettings
    region: Region

    def __call__(self, index: int) -> dict[str, np.ndarray | pd.DataFrame]:
        """Return `segmentation` (ny, nx) and the table `objects` (schema: catalogs/objects.yaml) of a patch."""
        coadds, grid = self.coadds, self.coadds.patches
        k, number = divmod(index, grid.count**2)
        tile, patch = coadds.tiles[k], divmod(number, grid.count)
        field, noise, wcs = patch_field(coadds, k, patch), self.noise.noise(k), coadds.wcs(k)
        first_row, first_column = (part.start for part in field.window)
        rows, columns = grid.window(*patch)
        inner = (
            slice(rows.start - first_row, rows.stop - first_row),
            slice(columns.start - first_column, columns.stop - first_column),
        )
        part = Part(width=coadds.pixels, x=first_column, y=first_row, inner=inner)
        field.hold()
        detected, segments = find_objects(field, noise, self.settings, part)
        ra, dec = positions(detected, wcs, (first_column, first_row))
        keep = owned(ra, dec, tile, coadds.settings.grid(), self.region)
        measured = measure(select(detected, keep), field, noise, segments)
        objects = measured.assign(
            x=measured["x"] + first_column,
            y=measured["y"] + first_row,
            objectId=object_ids(coadds.settings.grid(), tile, detected.label[keep]),
            coord_ra=ra[keep],
            coord_dec=dec[keep],
            tile=np.full(len(measured), tile.name, object),
            patch=np.full(len(measured), grid.name(*patch), object),
        )
        objects = with_spatial_index(objects, "coord_ra", "coord_dec")
        vectors = unit_vectors(objects["coord_ra"].to_numpy(), objects["coord_dec"].to_numpy())
        dust = coadds.truth.milky_way(vectors, *patch_cone(coadds, k, patch)[:3])
        for band in field.bands:
            objects[f"{band}_extinction"] = extinction(coadds.instrument.bandpass(band), dust)
        return {"segmentation": segments[inner], "objects": objects}


def object_ids(grid: TileGrid, tile: Tile, numbers: np.ndarray) -> np.ndarray:
    """Return the ids, (n,) int64, of objects with some numbers, (n,), in a tile."""
    return (grid.number(tile) << NUMBER_BITS) + numbers.astype(np.int64)


def _check_numbers(coadds: Coadds) -> None:
    """Raise a UserError if an objectId has not enough bits for the pixels of a tile or for the tiles of the sky."""
    grid = coadds.settings.grid()
    if coadds.pixels**2 >= 1 << NUMBER_BITS:
        raise UserError(
            f"coadds.pixels: tiles of {coadds.instrument.name} have {coadds.pixels} pixels a side, too many to number "
            f"their objects: make it smaller, so that they have at most {(1 << NUMBER_BITS // 2) - 1}"
        )
    if max(map(grid.number, coadds.tiles)) >= 1 << TILE_BITS:
        raise UserError(
            f"coadds.pixels: tiles {grid.inner:.3g} arcsec wide are too many on the sky to number objects: raise "
            "it, or lower coadds.overlap"
        )


def patch_cone(
    coadds: Coadds, tile: int, patch: tuple[int, int], margin: float = 30.0
) -> tuple[float, float, float, float]:
    """Return the cone that contains a patch of a tile (by index) and `margin` arcsec around it (see `tile_cone`)."""
    grid, scale = coadds.patches, coadds.instrument.coadd_scale / 3600
    x, y = (value - (coadds.pixels - 1) / 2 for value in grid.centre(*patch))
    centre = coadds.tiles[tile]
    ra, dec = from_tangent_plane(centre.ra, centre.dec, -x * scale, y * scale)
    radius = grid.side / np.sqrt(2) * scale + margin / 3600
    return float(ra), float(dec), radius, radius


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


def build_detections(context: SurveyContext, survey: str) -> Detections:
    """Return the lazy detections of a survey (the `build` of the stage)."""
    inputs = context.output(f"coadds/{survey}"), context.output(f"coadd_noise/{survey}")
    return detections(*inputs, context.pipeline.detections, context.region)


DETECTIONS = Stage(
    name="detections",
    per_survey=True,
    build=build_detections,
    reads=("coadds", "coadd_noise", "truth/galaxies", "truth/stars"),
    units_known_after=UNITS_FROM_POINTINGS,
    unit="patch of a tile",
    summary="The segmentation map and the objects of a patch, detected on the median of the bands (Source Extractor's "
    "method) or as peaks of their PSF-smoothed mean, with forced Kron, aperture and PSF photometry and errors for "
    "correlated noise.",
    shrink_with="lower coadds.patch_pixels",
    tables={"objects": "detections/<survey>_objects/"},
)
