"""Coadds: tiles in nJy with weight, noise realisations, number of exposures and PSF.

Roman's coadds are drizzled from its exposures, one exposure at a time. Rubin's coadds are drawn directly from its
cadence, or warped from the exposures of its visits.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd

from romandask.instruments.exposure import EXPOSURE_COLUMNS, exposures_of
from romandask.kernels.detectors.simple_detector import SATURATED
from romandask.model.settings import CoaddSettings
from romandask.model.sky import touching_pairs
from romandask.model.tiles import Tile
from romandask.products.images import Coordinates, ImageProduct
from romandask.products.schemas import schema
from romandask.products.units import LazyUnits, Unit
from romandask.stages.coadds.drawn import DrawTile
from romandask.stages.coadds.drizzled import DrizzleTile, most_inputs
from romandask.stages.coadds.input_psfs import psf_side
from romandask.stages.coadds.tile_maker import Coadds, TileMaker
from romandask.stages.coadds.warped import WarpTile
from romandask.stages.exposures.exposures import Exposures, header_text
from romandask.stages.exposures.render import cone
from romandask.stages.pointings import corners_of
from romandask.stages.stage import UNITS_FROM_POINTINGS, Stage, SurveyContext
from romandask.storage.arrays import Variable
from romandask.storage.manifest import digest

MAKERS: dict[str, type[TileMaker]] = {"drizzle": DrizzleTile, "draw": DrawTile, "warp": WarpTile}
"""Class that makes the tiles, by `Instrument.coadd`."""


def coadds(exposures: Exposures, tiles: list[Tile], settings: CoaddSettings) -> Coadds:
    """Return the lazy coadds of the exposures of an instrument, with the dims (tile, band, y, x).

    A tile takes its exposures one at a time: stored exposures are read, others are rendered. If the tiles are drawn
    from a cadence they use only the pointings and the truth, and no exposure is rendered.

    Parameters
    ----------
    exposures : Exposures
        Exposures of the instrument.
    tiles : list of Tile
        Tiles to make.
    settings : CoaddSettings
        The `coadds` section of the pipeline.
    """
    renderer = exposures.renderer
    instrument, table = renderer.instrument, renderer.table
    grid = settings.grid()
    pixels = grid.pixels(instrument.coadd_scale)
    drawn, drizzled = instrument.coadd == "draw", instrument.coadd == "drizzle"
    footprints = np.stack([tile.corners(grid.side) for tile in tiles])
    members = _members(table, footprints, instrument.bands)
    maker = MAKERS[instrument.coadd](
        exposures=exposures,
        tiles=tuple(tiles),
        members=members,
        settings=settings,
        pixels=pixels,
        render=renderer.render,
    )
    names = np.array(exposures.names, object)
    values = table[[name for name in EXPOSURE_COLUMNS if name != "band"]].to_numpy(float)
    shared = {**settings.model_dump(), "instrument": instrument.name, "seed": renderer.seed}
    shared["psf"] = instrument.psf_settings
    if drawn:
        shared |= renderer.render.model_dump()
    elif drizzled:
        # the length of the arrays of all tiles is that of the tile with most exposures: if it changes, all are remade
        shared["inputs"] = most_inputs(members)
    keys = tuple(members)
    all_exposures = exposures_of(table)

    def unit(index: int) -> Unit:
        (k, band), chosen = keys[index], members[keys[index]]
        unit_settings: dict[str, Any] = {**shared, "tile": tiles[k].name, "band": band}
        if drawn:
            unit_settings["exposures"] = digest(values[chosen])
            inputs = renderer.truth.inputs(*cone(footprints[k]))
        else:
            unit_settings["exposures"] = names[chosen].tolist()
            psf_units = dict.fromkeys(source for row in chosen for source in renderer.psfs.inputs(all_exposures[row]))
            inputs = (*((exposures.stage, name) for name in names[chosen]), *psf_units)
        return Unit(name=f"{tiles[k].name}-{band}", settings=unit_settings, inputs=inputs, cost=1.0 + len(chosen))

    def coordinates() -> Coordinates:
        headers = [header_text(tile.header(pixels, instrument.coadd_scale)) for tile in tiles]
        attributes = {"description": "FITS header of the WCS, 80-column cards"}
        return {
            "tile": (("tile",), np.array([tile.name for tile in tiles], object), {}),
            "band": (("band",), np.array(instrument.bands, object), {}),
            "tile_id": (("tile",), np.array([tile.id for tile in tiles]), {}),
            "ra": (("tile",), np.array([tile.ra for tile in tiles]), {"units": "deg"}),
            "dec": (("tile",), np.array([tile.dec for tile in tiles]), {"units": "deg"}),
            "header": (("tile",), np.array(headers, object), attributes),
        }

    planes = 2 + settings.noise
    mean = np.mean([len(chosen) for chosen in members.values()])
    product = ImageProduct(
        stage=f"coadds/{instrument.name}",
        units=LazyUnits(tuple(f"{tiles[k].name}-{band}" for k, band in keys), unit),
        make=maker,
        variables=_variables(pixels, settings.noise, psf_side(instrument), most_inputs(members) if drizzled else None),
        axes=("tile", "band"),
        lengths=(len(tiles), len(instrument.bands)),
        coordinates=coordinates,
        attributes={"survey": instrument.name, "pixel_scale": instrument.coadd_scale},
        # sums, sets and dq; the exposure that is being added, its image, its noise and the chunks that are read
        bytes_per_unit=max(
            pixels**2 * ((3 if drizzled else 45) + 4 * planes)
            + (0 if drawn else max(int(np.prod(instrument.shape)) * 18, pixels * 25_000))
            + (300 << 20 if drawn else 50 << 20),
            # sampling the PSFs of the exposures, which does not depend on the size of the tile
            0 if drawn else 700 << 20,
        ),
        # an exposure seldom covers a whole tile
        seconds_per_unit=pixels**2 * (6e-7 if drawn else 2e-7 + 2.5e-8 * float(mean)),
        tables={"sets": schema("sets")} if drizzled else {},
    )
    return Coadds(product=product, maker=maker)


def _members(table: pd.DataFrame, tiles: np.ndarray, bands: tuple[str, ...]) -> dict[tuple[int, str], np.ndarray]:
    """Return the rows of the exposures that touch each tile, in ascending order.

    Parameters
    ----------
    table : DataFrame
        Pointings table.
    tiles : ndarray, shape (tiles, 4, 2), degrees
        Corners of the tiles.
    bands : tuple of str
        Bands of the instrument.

    Returns
    -------
    dict of (int, str) to ndarray of int
        Rows in the pointings table, by index of the tile and band.
    """
    e, t = touching_pairs(corners_of(table), tiles)
    code = table["band"].map({band: number for number, band in enumerate(bands)}).to_numpy()[e]
    group = t * len(bands) + code
    order = np.lexsort((e, group))
    limits = np.searchsorted(group[order], np.arange(len(tiles) * len(bands) + 1))
    parts = np.split(e[order], limits[1:-1])
    return {(k // len(bands), bands[k % len(bands)]): part for k, part in enumerate(parts)}


def _variables(pixels: int, noise: int, psf: int, inputs: int | None) -> tuple[Variable, ...]:
    """Return the arrays of a tile.

    Parameters
    ----------
    pixels : int
        Side of a tile, pixels.
    noise : int
        Number of noise realisations.
    psf : int
        Side of the PSF images, pixels.
    inputs : int or None
        Largest number of exposures of a drizzled tile; None for tiles that are not drizzled.
    """

    def plane(name: str, dtype: str, attributes: dict[str, Any]) -> Variable:
        return Variable(name=name, dtype=dtype, shape=(pixels, pixels), axes=("y", "x"), attributes=attributes)

    flags = {"flag_masks": [SATURATED], "flag_meanings": "saturated"}
    variables = [
        plane("image", "float32", {"units": "nJy", "long_name": "flux of a pixel"}),
        plane("weight", "float32", {"units": "s" if inputs else "1/nJy2", "long_name": "sum of weights"}),
        Variable(
            name="noise",
            dtype="float32",
            shape=(noise, pixels, pixels),
            axes=("realisation", "y", "x"),
            attributes={"units": "nJy", "long_name": "noise realisations with the image's correlations"},
        ),
        plane("nimages", "uint16", {"long_name": "number of exposures"}),
        plane("dq", "uint8", {"long_name": "data quality", **flags}),
        Variable(
            name="psf",
            dtype="float32",
            shape=(psf, psf),
            axes=("v", "u"),
            attributes={"long_name": "unit star of flat f_nu, mean over the tile"},
        ),
    ]
    if inputs:
        # tiles of Rubin have no sets: with hundreds of visits there are more sets than can be numbered
        variables += [
            plane("set", "uint16", {"long_name": "number of the set of exposures"}),
            Variable(
                name="input_psf",
                dtype="float32",
                shape=(inputs, psf, psf),
                axes=("input", "v", "u"),
                attributes={"long_name": "unit star of flat f_nu of each exposure, as it is drizzled"},
            ),
        ]
    return tuple(variables)


def build_coadds(context: SurveyContext, survey: str) -> Coadds:
    """Return the lazy coadds of an instrument."""
    return coadds(context.output(f"exposures/{survey}"), context.tiles, context.pipeline.coadds)


COADDS = Stage(
    name="coadds",
    per_survey=True,
    build=build_coadds,
    reads=("exposures", "psf_models", "truth/galaxies", "truth/stars"),
    units_known_after=UNITS_FROM_POINTINGS,
    unit="tile and band",
    summary="Image, weight, noise, number and sets of exposures, and PSFs of a tile, drizzled from exposures (square "
    "kernel, exact overlaps), warped from visits or drawn from the cadence at its depth.",
    shrink_with="lower coadds.pixels",
    tables={"sets": "coadds/<survey>_sets/"},
)
