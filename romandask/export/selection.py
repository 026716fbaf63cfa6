"""Selection of stored images by the names that a user gives."""

from __future__ import annotations

import difflib
from collections.abc import Sequence

from romandask.model.errors import UserError
from romandask.products.images import ImageProduct
from romandask.stages.coadds.tile_maker import Coadds


def indices_of(known: Sequence[str], names: Sequence[str], unit_type: str, owner: str) -> list[int]:
    """Return the indices of given names, stored or not.

    Parameters
    ----------
    known : sequence of str
        All names.
    names : sequence of str
        Names that are looked up.
    unit_type : str
        What has a name, as the error message calls it: `exposure` or `tile`.
    owner : str
        What has the names, as the error message calls it, for example the name of the stage.

    Raises
    ------
    UserError
        If there is no such name; the message suggests the most similar one.
    """
    indices = {name: index for index, name in enumerate(known)}
    for name in names:
        if name not in indices:
            nearest = difflib.get_close_matches(name, indices, n=1, cutoff=0.0)
            raise UserError(f"{unit_type} {name!r}: {owner} has {len(indices)}, nearest {', '.join(nearest) or 'none'}")
    return [indices[name] for name in names]


def stored_units(product: ImageProduct, names: Sequence[str], unit_type: str) -> list[int]:
    """Return the unit indices of given names, all of which must be stored.

    Parameters
    ----------
    product : ImageProduct
        Product of the units.
    names, unit_type
        As in `indices_of`.

    Raises
    ------
    UserError
        If the product has no unit of a name, or the unit is not stored.
    """
    indices = indices_of(product.names, names, unit_type, product.stage)
    for index in indices:
        if not product.has(index):
            raise UserError(f"{product.stage} {product.names[index]} is not stored: run the survey first")
    return indices


def tile_images(coadds: Coadds, tiles: Sequence[str], bands: Sequence[str]) -> list[int]:
    """Return the indices of the images of given tiles and bands, all of whose patches must be stored.

    Parameters
    ----------
    coadds : Coadds
        Coadds of a stored survey.
    tiles : sequence of str
        Names of tiles.
    bands : sequence of str
        Bands of each tile; all bands if empty.

    Raises
    ------
    UserError
        If there is no such band or tile, or a patch is not stored.
    """
    instrument = coadds.instrument
    unknown = [band for band in bands if band not in instrument.bands]
    if unknown:
        raise UserError(f"band {unknown[0]!r}: {instrument.name} has {', '.join(instrument.bands)}")
    names = [f"{tile}-{band}" for tile in tiles for band in bands or instrument.bands]
    indices = indices_of(coadds.image_names, names, "tile", coadds.stage)
    for name, index in zip(names, indices, strict=True):
        if not coadds.has_tile(*coadds.image_place(index)):
            raise UserError(f"{coadds.stage} {name} is not stored: run the survey first")
    return indices
