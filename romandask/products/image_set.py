"""Image sets: an image product together with what its units are images of."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
import xarray as xr

from romandask.model.tiles import PatchGrid
from romandask.products.images import ImageProduct
from romandask.products.mosaic import Mosaic
from romandask.products.units import Made, Unit
from romandask.storage.store import Store


@dataclass(frozen=True, kw_only=True, repr=False)
class ImageSet:
    """An image product, which it behaves like; subclasses say what the images are of."""

    product: ImageProduct
    """The lazy images."""

    def stored(self, store: Store) -> Self:
        """Return the same images, reading what the store has."""
        return replace(self, product=self.product.stored(store))

    @property
    def stage(self) -> str:
        """Name of the product, for example `coadds/roman`."""
        return self.product.stage

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the units."""
        return self.product.names

    @property
    def units(self) -> Sequence[Unit]:
        """The units, in order."""
        return self.product.units

    @property
    def dataset(self) -> xr.Dataset:
        """The lazy xarray view, one chunk a unit."""
        return self.product.dataset

    @property
    def make(self) -> Callable[[int], dict[str, Any]]:
        """What makes the arrays of a unit."""
        return self.product.make

    def has(self, index: int) -> bool:
        """True where the store has a unit."""
        return self.product.has(index)

    def load(self, index: int, names: tuple[str, ...] | None = None, window: tuple[slice, ...] = ()) -> dict[str, Any]:
        """Return arrays and tables of a unit: see `ImageProduct.load`."""
        return self.product.load(index, names, window)

    @property
    def patches(self) -> PatchGrid | None:
        """Division of the images into patches, each of which is a unit; None if an image is one unit."""
        return self.product.patches

    def image(self, *place: int) -> Mosaic:
        """Return a reader of windows of a whole image across its patches: see `ImageProduct.image`."""
        return self.product.image(*place)

    def reader(self, index: int) -> Callable[[str, tuple[slice, ...]], np.ndarray]:
        """Return a reader of windows of the arrays of a stored unit: see `ImageProduct.reader`."""
        return self.product.reader(index)

    def prepare(self, store: Store) -> None:
        """Make the arrays and coordinates that units are written into."""
        self.product.prepare(store)

    def write(self, index: int, store: Store) -> Made:
        """Make one unit and write it."""
        return self.product.write(index, store)

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.stage}, {len(self.product.units)} units)"
