"""Lazy cutouts of objects from all images that contain them, with the local WCS and PSF."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import dask
import dask.array as da
import numpy as np
import pandas as pd
import xarray as xr
from astropy.wcs import WCS

from romandask.kernels.detectors.simple_detector import NO_DATA
from romandask.kernels.rendering.scene import pixel_positions
from romandask.model.errors import UserError
from romandask.model.sky import covering_pairs
from romandask.products.images import ImageProduct
from romandask.storage.manifest import digest

LARGEST_CUTOUT_PIXELS = 256
"""Largest side of a cutout, pixels."""
_FOOTPRINT_MARGIN = 1.0
"""Margin, arcsec, of the search by footprints, whose edges are great circles; the WCS then decides what is inside."""


@dataclass(frozen=True)
class Layer:
    """Type and description of one layer of cutouts."""

    dtype: str
    attributes: dict[str, Any]
    """Attributes of the xarray variable: units, long_name, ..."""


class Images(Protocol):
    """The images of exposures or coadds that cutouts are made from. `Exposures` and `Coadds` implement it."""

    product: ImageProduct
    """The lazy images; an image is a unit, or all patches of a tile in a band."""

    @property
    def image_names(self) -> tuple[str, ...]:
        """Names of the images."""

    def load_image(self, image: int, names: tuple[str, ...], window: tuple[slice, ...] = ()) -> dict[str, np.ndarray]:
        """Return a window of arrays of an image, by name."""

    @property
    def footprints(self) -> np.ndarray:
        """Corners of the images, shape (n, 4, 2), degrees."""

    @property
    def image_shape(self) -> tuple[int, int]:
        """Rows and columns of an image."""

    @property
    def image_bands(self) -> np.ndarray:
        """Band of each image, shape (n,)."""

    @property
    def extra_layers(self) -> dict[str, tuple[str, str, str]]:
        """Dtype, unit and description of the layers that are not stored, by name."""

    def header(self, index: int) -> dict[str, Any]:
        """Return the FITS header with the WCS of an image."""

    def make_layers(
        self, index: int, wanted: Sequence[str], window: tuple[slice, slice], arrays: dict[str, np.ndarray]
    ) -> dict[str, np.ndarray]:
        """Return the requested layers of a window of an image that are not stored, except `psf`.

        Parameters
        ----------
        index : int
            Index of the image.
        wanted : sequence of str
            Names of the requested layers.
        window : (slice, slice)
            Rows and columns of the window.
        arrays : dict of str to ndarray
            Stored arrays of the window, from which the layers may be computed.
        """

    def make_psfs(self, index: int, positions: np.ndarray, size: int) -> np.ndarray:
        """Return the PSFs, shape (n, size, size), at positions (x, y) on an image, shape (n, 2), pixels."""


@dataclass(frozen=True, kw_only=True)
class CutoutPositions:
    """Positions of n cutouts on images, sorted by image, then by object."""

    image: np.ndarray
    """Index of the image, shape (n,)."""
    row: np.ndarray
    """Row in the table of objects, shape (n,)."""
    x: np.ndarray
    """Position of the object on the image along x, 0 at the centre of the first pixel, shape (n,), pixels."""
    y: np.ndarray
    """Position of the object along y, as `x`."""
    corner: np.ndarray
    """Column and row on the image of the first pixel of the cutout, shape (n, 2); it may lie outside the image."""
    jacobian: np.ndarray
    """Derivative of (west, north), GalSim's frame, with respect to (x, y), shape (n, 2, 2), arcsec/pixel."""


def cutouts(
    images: Images,
    objects: pd.DataFrame,
    layers: tuple[str, ...] = ("image",),
    bands: tuple[str, ...] | None = None,
    size: int = 48,
) -> xr.Dataset:
    """Return lazy cutouts, with the dims (cutout, y, x), of the images that contain the centres of objects.

    Cutouts are sorted by image, then by object. Each image is one chunk, so it is read, or made, once. Pixels outside
    an image are 0 in every layer, and flagged `no_data` in `dq`.

    Parameters
    ----------
    images : Exposures or Coadds
        Images to cut from.
    objects : DataFrame
        Objects, with the columns id, ra and dec (degrees).
    layers : tuple of str
        Names of arrays of the product; for exposures also `background`, `weight` and `psf`.
    bands : tuple of str, optional
        Bands of the images to cut from; all by default.
    size : int, pixels
        Side of a cutout, even, at most 256.

    Raises
    ------
    UserError
        If there is no such layer or band, or the size is not allowed.
    """
    product, image_bands = images.product, images.image_bands
    known_bands = sorted(set(image_bands.tolist()))
    for band in bands or ():
        if band not in known_bands:
            raise UserError(f"band {band!r}: the images have {', '.join(known_bands)}")
    if not 8 <= size <= LARGEST_CUTOUT_PIXELS or size % 2:
        raise UserError(f"size {size}: an even number of pixels from 8 to {LARGEST_CUTOUT_PIXELS}")
    chosen = np.flatnonzero(np.isin(image_bands, bands or known_bands))
    known = {v.name: Layer(v.dtype, v.attributes) for v in product.variables if v.is_image}
    known |= {
        name: Layer(dtype, {"units": unit, "long_name": text})
        for name, (dtype, unit, text) in images.extra_layers.items()
    }
    for name in layers:
        if name not in known:
            raise UserError(f"layer {name!r}: {product.stage} has {', '.join(known)}")
    positions = find_cutouts(images, chosen, objects, size)
    return _dataset(images, positions, objects, {name: known[name] for name in layers}, size)


def find_cutouts(images: Images, chosen: np.ndarray, objects: pd.DataFrame, size: int) -> CutoutPositions:
    """Return the positions of the cutouts of objects on the chosen images that contain their centres.

    Parameters
    ----------
    images : Images
        Images to cut from.
    chosen : ndarray of int
        Indices of the chosen images.
    objects : DataFrame
        Objects, with the columns id, ra and dec (degrees).
    size : int, pixels
        Side of a cutout.
    """
    ra, dec = objects["ra"].to_numpy(float), objects["dec"].to_numpy(float)
    ny, nx = images.image_shape
    which, point = covering_pairs(images.footprints[chosen], ra, dec, _FOOTPRINT_MARGIN)
    numbers, starts = np.unique(which, return_index=True)
    parts = []
    for number, rows in zip(numbers, np.split(point, starts)[1:], strict=True):
        header = images.header(int(chosen[number]))
        x, y, to_pixels = pixel_positions(WCS(header), ra[rows], dec[rows])
        inside = (x >= -0.5) & (x < nx - 0.5) & (y >= -0.5) & (y < ny - 0.5)
        rows, x, y, to_pixels = rows[inside], x[inside], y[inside], to_pixels[inside]
        parts.append(
            {
                "image": np.full(len(rows), chosen[number]),
                "row": rows,
                "x": x,
                "y": y,
                # the object lies within half a pixel of the centre of the cutout
                "corner": np.rint(np.stack([x, y], -1) - (size - 1) / 2).astype(int),
                "jacobian": np.linalg.inv(to_pixels),
            }
        )
    if not parts:
        none = np.empty(0)
        return CutoutPositions(
            image=none.astype(int),
            row=none.astype(int),
            x=none,
            y=none,
            corner=np.empty((0, 2), int),
            jacobian=np.empty((0, 2, 2)),
        )
    return CutoutPositions(**{name: np.concatenate([part[name] for part in parts]) for name in parts[0]})


def _dataset(
    images: Images, positions: CutoutPositions, objects: pd.DataFrame, layers: dict[str, Layer], size: int
) -> xr.Dataset:
    """Return the lazy layers, with the coordinates of every cutout."""
    product, axes = images.product, ("cutout",)
    used, counts = np.unique(positions.image, return_counts=True)
    data = {}
    if len(used):
        settings = _settings(product, used)
        token = digest(product.stage, positions.image, positions.x, positions.y, size, sorted(layers), settings)
        task = f"{product.stage.replace('/', '-')}-cutouts-{token}"
        cut = CutImage(images, used, _per_image(positions, used), tuple(layers), size)
        source = dask.delayed(cut, name=task)
        bundles = da.map_blocks(
            _cut_block, source, chunks=((1,) * len(used),), dtype=object, meta=np.empty(0, object), name=f"{task}-unit"
        )
    for name, layer in layers.items():
        array = da.zeros((0, size, size), layer.dtype)
        if len(used):
            array = da.map_blocks(
                _layer_of,
                bundles,
                name,
                chunks=(tuple(counts.tolist()), (size,), (size,)),
                new_axis=[1, 2],
                dtype=layer.dtype,
                meta=np.empty((0, 0, 0), layer.dtype),
                name=f"{task}-{name}",
            )
        axis_names = ("v", "u") if name == "psf" else ("y", "x")
        data[name] = ((*axes, *axis_names), array, layer.attributes)
    unit_names = np.array(images.image_names, object)[positions.image]
    degrees = {"units": "deg"}
    on_image = {"units": "pixel", "description": "on the whole image, 0 at the centre of the first pixel"}
    first_pixel = {"units": "pixel", "description": "of the first pixel of the cutout, on the whole image"}
    derivative = {"units": "arcsec/pixel", "description": "derivative of (west, north) with respect to (x, y)"}
    coordinates = {
        "id": (axes, objects["id"].to_numpy()[positions.row], {}),
        "object": (axes, positions.row, {"description": "row in the table of the selected objects"}),
        "ra": (axes, objects["ra"].to_numpy(float)[positions.row], degrees),
        "dec": (axes, objects["dec"].to_numpy(float)[positions.row], degrees),
        "unit": (axes, unit_names.astype(str), {"description": "image: exposure, or tile and band"}),
        "band": (axes, images.image_bands[positions.image].astype(str), {}),
        "x_image": (axes, positions.x, on_image),
        "y_image": (axes, positions.y, on_image),
        "column": (axes, positions.corner[:, 0], first_pixel),
        "row": (axes, positions.corner[:, 1], first_pixel),
        "jacobian": ((*axes, "sky", "pixel"), positions.jacobian, derivative),
    }
    return xr.Dataset(data, coordinates, {"survey": product.attributes.get("survey", ""), "size": size})


def _settings(product: ImageProduct, used: np.ndarray) -> list[Any]:
    """Return the settings of the units of some images: of all their patches, if they are divided."""
    parts = 1 if product.patches is None else product.patches.count**2
    return [product.units[image * parts + k].settings for image in used.tolist() for k in range(parts)]


def _per_image(positions: CutoutPositions, used: np.ndarray) -> tuple[tuple[np.ndarray, np.ndarray], ...]:
    """Return the positions of the objects and the corners of the cutouts, each (n, 2), on each used image."""
    limits = np.searchsorted(positions.image, [*used, used[-1] + 1])
    xy = np.stack([positions.x, positions.y], -1)
    return tuple((xy[low:high], positions.corner[low:high]) for low, high in zip(limits[:-1], limits[1:], strict=True))


@dataclass(frozen=True)
class CutImage:
    """Makes the cutouts of one image."""

    images: Images
    units: np.ndarray
    """Index of each image that has cutouts, shape (images,)."""
    positions: tuple[tuple[np.ndarray, np.ndarray], ...]
    """Positions of the objects and corners of the cutouts on each of these images, each (n, 2), pixels."""
    layers: tuple[str, ...]
    """Names of the layers."""
    size: int
    """Side of a cutout, pixels."""

    def __call__(self, number: int) -> dict[str, np.ndarray]:
        """Return the layers, each (n, size, size), of the cutouts of one of the images that have cutouts."""
        unit, (xy, corners) = int(self.units[number]), self.positions[number]
        product = self.images.product
        stored_layers = {v.name: v.shape[-2:] for v in product.variables if v.is_image}
        shape = next(iter(stored_layers.values()))
        low = np.clip(corners.min(axis=0), 0, np.array(shape[::-1]))
        high = np.clip(corners.max(axis=0) + self.size, 0, np.array(shape[::-1]))
        window = (slice(int(low[1]), int(high[1])), slice(int(low[0]), int(high[0])))
        wanted = {name for name in self.layers if name in stored_layers}
        if "weight" in self.layers:
            wanted |= {"dq", "image", "variance"}
        arrays = self.images.load_image(unit, tuple(sorted(wanted & set(stored_layers))), window) if wanted else {}
        # of several noise realisations, the first
        arrays = {name: plane if plane.ndim == 2 else plane[0] for name, plane in arrays.items()}
        arrays |= self.images.make_layers(unit, self.layers, window, arrays)
        made = {"psf": self.images.make_psfs(unit, xy, self.size)} if "psf" in self.layers else {}
        for name in self.layers:
            if name != "psf":
                outside = NO_DATA if name == "dq" else 0
                made[name] = squares(arrays[name], corners - low, self.size, outside)
        return made


def squares(image: np.ndarray, corners: np.ndarray, size: int, outside: float) -> np.ndarray:
    """Return square cutouts of an image, shape (n, size, size).

    Parameters
    ----------
    image : ndarray, shape (ny, nx)
        Image.
    corners : ndarray of int, shape (n, 2)
        Column and row of the first pixel of each cutout; they may lie outside the image.
    size : int, pixels
        Side of a cutout.
    outside : float
        Value of pixels outside the image.

    Examples
    --------
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


def _cut_block(cut: CutImage, block_id: tuple[int, ...] = ()) -> np.ndarray:
    bundle = np.empty(1, object)
    bundle[0] = cut(block_id[0])
    return bundle


def _layer_of(bundle: np.ndarray, layer: str) -> np.ndarray:
    return bundle[0][layer]
