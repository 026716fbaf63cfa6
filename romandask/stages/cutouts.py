"""Cutouts: small squares around objects from every image that sees them, with local WCS and PSF, lazily."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import dask
import dask.array as da
import numpy as np
import pandas as pd
import xarray as xr
from astropy.wcs import WCS

from romandask.instruments.instrument import exposure_of
from romandask.kernels.detectors.simple_detector import NO_DATA, usable
from romandask.kernels.rendering.oversampled_image import fine_image
from romandask.kernels.rendering.scene import pixel_positions
from romandask.model.errors import UserError
from romandask.model.sky import Cone, Region, covering_pairs
from romandask.products.images import ImageProduct
from romandask.products.tables import TableProduct
from romandask.stages.coadds.tile_maker import TileMaker
from romandask.stages.exposures import RenderExposure, empty_variance
from romandask.stages.pointings import corners_of
from romandask.stages.psf_images import flat_shares
from romandask.storage.manifest import digest

EXPOSURE_LAYERS = {
    "background": ("float32", "electron", "expected electrons that do not come from objects"),
    "weight": ("float32", "1/electron2", "inverse variance of an empty pixel; 0 where dq forbids it"),
    "psf": ("float32", "1/pixel", "unit star, flat f_nu, at the object's place, centred on pixel size // 2"),
}
"""Layers of exposures beside those that are stored: dtype, unit, what they hold."""
LARGEST_CUTOUT_PIXELS = 256
"""Pixels a side of the largest cutouts."""
_EDGE = 1.0
"""Arcsec by which footprints, whose edges are arcs, are grown before the WCS decides what lies inside."""


Wanted = Sequence[int] | np.ndarray | pd.DataFrame | Region | Cone
"""Objects: their ids, a table with columns id, ra, dec (degrees), or a part of the sky."""


@dataclass(frozen=True)
class Positions:
    """A table of objects, with the names of the columns that cutouts need."""

    product: TableProduct
    id: str
    ra: str
    """degrees"""
    dec: str
    """degrees"""

    def named(self, rows: pd.DataFrame) -> pd.DataFrame:
        """Return id, ra and dec under these names."""
        return rows[[self.id, self.ra, self.dec]].set_axis(["id", "ra", "dec"], axis=1)


@dataclass(frozen=True)
class Frames:
    """Images of one product, in the order of its units, with all that cutouts need to know of them."""

    product: ImageProduct
    footprints: np.ndarray
    """(frames, 4, 2) corners, degrees."""
    shape: tuple[int, int]
    """(ny, nx)"""
    header: Callable[[int], dict]
    """The WCS of a unit."""
    bands: np.ndarray
    """(frames,)"""


@dataclass(frozen=True)
class Places:
    """Where objects are on images: one row a cutout, by image, then by object."""

    frame: np.ndarray
    """(n,) which of the frames."""
    row: np.ndarray
    """(n,) row of the table of objects."""
    x: np.ndarray
    """(n,) pixel coordinate on the image, 0 at the centre of the first pixel."""
    y: np.ndarray
    """(n,)"""
    corner: np.ndarray
    """(n, 2) column and row of the cutout's first pixel on the image; it may lie off it."""
    jacobian: np.ndarray
    """(n, 2, 2) arcsec a pixel: (west, north) by (x, y), GalSim's frame."""


def located(of: Wanted, tables: Sequence[Positions], catalog: str) -> pd.DataFrame:
    """Return id, ra and dec of objects: in the order of their ids, or in that of the tables.

    Raises
    ------
    UserError
        If an id is in none of the tables; `catalog` is what they are called.
    """
    if isinstance(of, pd.DataFrame):
        missing = sorted({"id", "ra", "dec"} - set(of.columns))
        if missing:
            raise UserError(f"table of objects: columns {', '.join(missing)} are missing")
        return of[["id", "ra", "dec"]].reset_index(drop=True)
    if isinstance(of, Region | Cone):
        parts = [table.named(table.product.rows_within(of, table.ra, table.dec)) for table in tables]
        return pd.concat(parts, ignore_index=True)
    ids = np.asarray(of).ravel()
    if ids.size and ids.dtype.kind not in "iu":
        raise UserError(f"ids of objects are whole numbers, found {ids.dtype}")
    ids = pd.unique(ids.astype(np.int64))
    columns = [[table.id, table.ra, table.dec] for table in tables]
    parts = [t.named(t.product.rows_where(t.id, ids, names)) for t, names in zip(tables, columns, strict=True)]
    rows = pd.concat(parts, ignore_index=True)
    absent = np.setdiff1d(ids, rows["id"])
    if len(absent):
        raise UserError(f"{len(absent)} of {len(ids)} ids are not in {catalog}, the first is {absent[0]}")
    rank = pd.Series(np.arange(len(ids)), index=ids).loc[rows["id"]].to_numpy()
    return rows.iloc[np.argsort(rank, kind="stable")].reset_index(drop=True)


def cutouts(
    product: ImageProduct,
    objects: pd.DataFrame,
    layers: tuple[str, ...] = ("image",),
    bands: tuple[str, ...] | None = None,
    size: int = 48,
) -> xr.Dataset:
    """Return lazy cutouts (cutout, y, x) of the images of a product whose pixels hold the centres of objects.

    Cutouts are in the order of the images, then of the objects, a chunk an image: each image is read, or made, once.
    Pixels beyond an image's edge are 0 in every layer, and flagged `no_data` in `dq`.

    Parameters
    ----------
    product : what `exposures()` or `coadds()` returned
    objects : columns id, ra, dec (degrees)
    layers : of the product's own, and for exposures also `background`, `weight`, `psf`
    bands : those of the images; None for all
    size : pixels a side, even, at most 256

    Raises
    ------
    UserError
        If a layer, a band or the size is not possible.
    """
    frames = _frames(product)
    known = sorted(set(frames.bands.tolist()))
    for band in bands or ():
        if band not in known:
            raise UserError(f"band {band!r}: the images have {', '.join(known)}")
    if not 8 <= size <= LARGEST_CUTOUT_PIXELS or size % 2:
        raise UserError(f"size {size}: an even number of pixels from 8 to {LARGEST_CUTOUT_PIXELS}")
    chosen = np.flatnonzero(np.isin(frames.bands, bands or known))
    planes = {v.name: (v.dtype, v.attributes) for v in product.variables if v.axes[-2:] == ("y", "x")}
    if isinstance(product.make, RenderExposure):
        planes |= {name: (kind, {"units": u, "long_name": t}) for name, (kind, u, t) in EXPOSURE_LAYERS.items()}
    for layer in layers:
        if layer not in planes:
            raise UserError(f"layer {layer!r}: {product.stage} has {', '.join(planes)}")
    return _dataset(frames, find(frames, chosen, objects, size), objects, {n: planes[n] for n in layers}, size)


def find(frames: Frames, chosen: np.ndarray, objects: pd.DataFrame, size: int) -> Places:
    """Return where objects are on the chosen frames that see their centres."""
    ra, dec = objects["ra"].to_numpy(float), objects["dec"].to_numpy(float)
    ny, nx = frames.shape
    which, point = covering_pairs(frames.footprints[chosen], ra, dec, _EDGE)
    numbers, starts = np.unique(which, return_index=True)
    found: list[tuple[np.ndarray, ...]] = []
    for number, rows in zip(numbers, np.split(point, starts)[1:], strict=True):
        header = frames.header(int(chosen[number]))
        x, y, to_pixels = pixel_positions(WCS(header), ra[rows], dec[rows])
        inside = (x >= -0.5) & (x < nx - 0.5) & (y >= -0.5) & (y < ny - 0.5)
        rows, x, y, to_pixels = rows[inside], x[inside], y[inside], to_pixels[inside]
        # the object lies within half a pixel of the cutout's middle
        corner = np.rint(np.stack([x, y], -1) - (size - 1) / 2).astype(int)
        found.append((np.full(len(rows), chosen[number]), rows, x, y, corner, np.linalg.inv(to_pixels)))
    if not found:
        none = np.empty(0)
        return Places(none.astype(int), none.astype(int), none, none, np.empty((0, 2), int), np.empty((0, 2, 2)))
    return Places(*(np.concatenate(column) for column in zip(*found, strict=True)))


def _frames(product: ImageProduct) -> Frames:
    """Return the images of exposures or coadds."""
    maker = product.make
    if isinstance(maker, RenderExposure):
        table, instrument = maker.table, maker.instrument

        def of_exposure(unit: int) -> dict:
            return instrument.header(exposure_of(table.iloc[unit]))

        return Frames(product, corners_of(table), instrument.shape, of_exposure, table["band"].to_numpy(object))
    if isinstance(maker, TileMaker):
        bands, side = maker.instrument.bands, maker.settings.grid().side

        def of_tile(unit: int) -> dict:
            return maker.header(unit // len(bands))

        corners = np.repeat(np.stack([tile.corners(side) for tile in maker.tiles]), len(bands), axis=0)
        shape = (maker.pixels, maker.pixels)
        return Frames(product, corners, shape, of_tile, np.array(bands * len(maker.tiles), object))
    raise TypeError("cutouts need the product that exposures() or coadds() returns")


def _dataset(
    frames: Frames, places: Places, objects: pd.DataFrame, layers: dict[str, tuple[str, dict]], size: int
) -> xr.Dataset:
    """Return the lazy arrays with the coordinates of every cutout."""
    product, axes = frames.product, ("cutout",)
    used, counts = np.unique(places.frame, return_counts=True)
    data = {}
    if len(used):
        settings = [product.units[unit].settings for unit in used.tolist()]
        token = digest(product.stage, places.frame, places.x, places.y, size, sorted(layers), settings)
        name = f"{product.stage.replace('/', '-')}-cutouts-{token}"
        source = dask.delayed(Cut(product, used, _per_frame(places, used), tuple(layers), size), name=name)
        bundles = da.map_blocks(
            _cut_block, source, chunks=((1,) * len(used),), dtype=object, meta=np.empty(0, object), name=f"{name}-unit"
        )
    for layer, (dtype, attributes) in layers.items():
        array = da.zeros((0, size, size), dtype)
        if len(used):
            array = da.map_blocks(
                _layer_of,
                bundles,
                layer,
                chunks=(tuple(counts.tolist()), (size,), (size,)),
                new_axis=[1, 2],
                dtype=dtype,
                meta=np.empty((0, 0, 0), dtype),
                name=f"{name}-{layer}",
            )
        axis_names = ("v", "u") if layer == "psf" else ("y", "x")
        data[layer] = ((*axes, *axis_names), array, attributes)
    unit_names = np.array(product.names, object)[places.frame]
    degrees = {"units": "deg"}
    pixel = {"units": "pixel", "description": "on the whole image, 0 at the centre of the first pixel"}
    first = {"units": "pixel", "description": "of the cutout's first pixel on the whole image"}
    text = {"units": "arcsec/pixel", "description": "(west, north) by (x, y)"}
    coordinates = {
        "id": (axes, objects["id"].to_numpy()[places.row], {}),
        "object": (axes, places.row, {"description": "row among the objects that were asked for"}),
        "ra": (axes, objects["ra"].to_numpy(float)[places.row], degrees),
        "dec": (axes, objects["dec"].to_numpy(float)[places.row], degrees),
        "unit": (axes, unit_names.astype(str), {"description": "image: exposure, or tile and band"}),
        "band": (axes, frames.bands[places.frame].astype(str), {}),
        "x_image": (axes, places.x, pixel),
        "y_image": (axes, places.y, pixel),
        "column": (axes, places.corner[:, 0], first),
        "row": (axes, places.corner[:, 1], first),
        "jacobian": ((*axes, "sky", "pixel"), places.jacobian, text),
    }
    return xr.Dataset(data, coordinates, {"survey": product.attributes.get("survey", ""), "size": size})


def _per_frame(places: Places, used: np.ndarray) -> tuple[tuple[np.ndarray, np.ndarray], ...]:
    """Return positions (n, 2) and corners (n, 2) of the cutouts of each frame."""
    limits = np.searchsorted(places.frame, [*used, used[-1] + 1])
    at = np.stack([places.x, places.y], -1)
    return tuple((at[low:high], places.corner[low:high]) for low, high in zip(limits[:-1], limits[1:], strict=True))


@dataclass(frozen=True)
class Cut:
    """Cuts the squares of one image."""

    product: ImageProduct
    units: np.ndarray
    """(images,) number of each in the product."""
    places: tuple[tuple[np.ndarray, np.ndarray], ...]
    """By image: positions (n, 2) and corners (n, 2)."""
    layers: tuple[str, ...]
    size: int

    def __call__(self, number: int) -> dict[str, np.ndarray]:
        """Return the layers (n, size, size) of an image."""
        unit, (at, corners) = int(self.units[number]), self.places[number]
        maker = self.product.make
        own = {v.name: v.shape[-2:] for v in self.product.variables if v.axes[-2:] == ("y", "x")}
        shape = next(iter(own.values()))
        low = np.clip(corners.min(axis=0), 0, np.array(shape[::-1]))
        high = np.clip(corners.max(axis=0) + self.size, 0, np.array(shape[::-1]))
        window = (slice(int(low[1]), int(high[1])), slice(int(low[0]), int(high[0])))
        wanted = {name for name in self.layers if name in own}
        if "weight" in self.layers:
            wanted |= {"dq", "image", "variance"}
        arrays = self.product.load(unit, tuple(sorted(wanted & set(own))), window) if wanted else {}
        # of planes that there are several of, noise realisations, the first
        arrays = {name: plane if plane.ndim == 2 else plane[0] for name, plane in arrays.items()}
        made = {}
        if isinstance(maker, RenderExposure):
            arrays |= self._expected(maker, unit, window, arrays)
            if "psf" in self.layers:
                made["psf"] = self._stars(maker, unit, at)
        for name in self.layers:
            if name != "psf":
                outside = NO_DATA if name == "dq" else 0
                made[name] = squares(arrays[name], corners - low, self.size, outside)
        return made

    def _expected(
        self, maker: RenderExposure, unit: int, window: tuple[slice, slice], arrays: dict[str, np.ndarray]
    ) -> dict[str, np.ndarray]:
        """Return background and weight of a window of an exposure, where they are wanted."""
        if not {"background", "weight"} & set(self.layers):
            return {}
        exposure, instrument = exposure_of(maker.table.iloc[unit]), maker.instrument
        background = instrument.background(exposure, instrument.header(exposure), *window)
        if "weight" not in self.layers:
            return {"background": background}
        variance = empty_variance(arrays, background, instrument.detector)
        return {"background": background, "weight": np.where(usable(arrays["dq"]), 1 / variance, np.float32(0))}

    def _stars(self, maker: RenderExposure, unit: int, at: np.ndarray) -> np.ndarray:
        """Return the PSF (n, size, size) at places of an exposure."""
        exposure, instrument = exposure_of(maker.table.iloc[unit]), maker.instrument
        psf, shares = instrument.psf(exposure), flat_shares(instrument.bandpass(exposure.band))
        return np.stack([fine_image(psf, shares, x, y, self.size, 1) for x, y in at]).astype(np.float32)


def squares(image: np.ndarray, corners: np.ndarray, size: int, outside: float) -> np.ndarray:
    """Return squares (n, size, size) of an image that begin at `corners` (n, 2), column and row.

    Pixels off the image are `outside`:

    >>> squares(np.arange(4).reshape(2, 2), np.array([[-1, 0]]), 2, 9)
    array([[[9, 0],
            [9, 2]]])
    """
    out = np.full((len(corners), size, size), outside, image.dtype)
    ny, nx = image.shape
    for square, (column, row) in zip(out, corners, strict=True):
        rows, columns = slice(max(row, 0), min(row + size, ny)), slice(max(column, 0), min(column + size, nx))
        if rows.start < rows.stop and columns.start < columns.stop:
            part = image[rows, columns]
            square[rows.start - row : rows.stop - row, columns.start - column : columns.stop - column] = part
    return out


def _cut_block(cut: Cut, block_id: tuple[int, ...] = ()) -> np.ndarray:
    bundle = np.empty(1, object)
    bundle[0] = cut(block_id[0])
    return bundle


def _layer_of(bundle: np.ndarray, layer: str) -> np.ndarray:
    return bundle[0][layer]
