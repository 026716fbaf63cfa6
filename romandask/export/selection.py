"""Selection of stored images by the names that a user gives."""

from __future__ import annotations

import difflib
from collections.abc import Sequence

from romandask.model.errors import UserError
from romandask.products.images import ImageProduct
from romandask.survey import Survey


def indices_of(product: ImageProduct, names: Sequence[str], unit_type: str, owner: str) -> list[int]:
    """Return the unit indices of given names, stored or not.

    Parameters
    ----------
    product : ImageProduct
        Product of the units.
    names : sequence of str
        Names of units.
    unit_type : str
        What a unit is, as the error message names it: `exposure` or `tile`.
    owner : str
        What has the units, as the error message names it, for example the name of the stage.

    Raises
    ------
    UserError
        If the product has no unit of a name; the message suggests the most similar name.
    """
    indices = {name: index for index, name in enumerate(product.names)}
    for name in names:
        if name not in indices:
            nearest = difflib.get_close_matches(name, indices, n=1, cutoff=0.0)
            raise UserError(f"{unit_type} {name!r}: {owner} has {len(indices)}, nearest {', '.join(nearest) or 'none'}")
    return [indices[name] for name in names]


def stored_units(product: ImageProduct, names: Sequence[str], unit_type: str) -> list[int]:
    """Return the unit indices of given names, all of which must be stored.

    Parameters
    ----------
    product, names, unit_type
        As in `indices_of`.

    Raises
    ------
    UserError
        If the product has no unit of a name, or the unit is not stored.
    """
    indices = indices_of(product, names, unit_type, product.stage)
    for index in indices:
        if not product.has(index):
            raise UserError(f"{product.stage} {product.names[index]} is not stored: run the survey first")
    return indices


def tile_units(survey: Survey, survey_name: str, tiles: Sequence[str], bands: Sequence[str]) -> list[int]:
    """Return the unit indices of the coadds of given tiles and bands.

    Parameters
    ----------
    survey : Survey
        Stored survey.
    survey_name : str
        Name of the survey of one instrument, for example `roman`.
    tiles : sequence of str
        Names of tiles.
    bands : sequence of str
        Bands of each tile; all bands if empty.

    Raises
    ------
    UserError
        If the survey has no such band or tile, or the unit is not stored.
    """
    known = survey.instruments[survey_name].bands
    unknown = [band for band in bands if band not in known]
    if unknown:
        raise UserError(f"band {unknown[0]!r}: {survey_name} has {', '.join(known)}")
    names = [f"{tile}-{band}" for tile in tiles for band in bands or known]
    return stored_units(survey.output(f"coadds/{survey_name}").product, names, "tile")
