"""Coadds: tiles in nJy with weight, noise realisation, number of exposures and PSF.

Roman's are drizzled from its exposures, one at a time; Rubin's are drawn directly from its cadence, or warped from the
exposures of its visits.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd

from romandask.instruments.instrument import EXPOSURE_COLUMNS
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
from romandask.stages.coadds.tile_maker import TileMaker, source_of
from romandask.stages.coadds.warped import WarpTile
from romandask.stages.exposures import cone, header_text
from romandask.stages.pointings import corners_of
from romandask.storage.arrays import Variable
from romandask.storage.manifest import digest

MAKERS: dict[str, type[TileMaker]] = {"drizzle": DrizzleTile, "draw": DrawTile, "warp": WarpTile}


def coadds(exposures: ImageProduct, tiles: list[Tile], settings: CoaddSettings) -> ImageProduct:
    """Return the lazy coadds of a survey's exposures: dims (tile, band, y, x).

    A tile reads its exposures one at a time from the exposures product: from the store where they are, rendered where
    not. The tiles of an instrument that is drawn from its cadence use the exposures' table and truth, and render none.
    """
    render = source_of(exposures)
    instrument, table = render.instrument, render.table
    grid = settings.grid()
    pixels = grid.pixels(instrument.coadd_scale)
    drawn, drizzled = instrument.coadd == "draw", instrument.coadd == "drizzle"
    footprints = np.stack([tile.corners(grid.side) for tile in tiles])
    members = _members(table, footprints, instrument.bands)
    maker = MAKERS[instrument.coadd](exposures, tuple(tiles), members, settings, pixels, render.render)
    names = np.array(exposures.names, object)
    values = table[[name for name in EXPOSURE_COLUMNS if name != "band"]].to_numpy(float)
    shared = {**settings.model_dump(), "instrument": instrument.name, "seed": render.seed}
    shared["psf"] = instrument.psf_settings
    if drawn:
        shared |= render.render.model_dump()
    elif drizzled:
        # the arrays are as long as the busiest tile's are: another length, and all are made again
        shared["inputs"] = most_inputs(members)
    keys = tuple(members)

    def unit(index: int) -> Unit:
        (k, band), chosen = keys[index], members[keys[index]]
        state: dict[str, Any] = {**shared, "tile": tiles[k].name, "band": band}
        if drawn:
            state["exposures"] = digest(values[chosen])
            inputs = render.truth.inputs(*cone(footprints[k]))
        else:
            state["exposures"] = names[chosen].tolist()
            inputs = tuple((exposures.stage, name) for name in names[chosen])
        return Unit(f"{tiles[k].name}-{band}", state, inputs, 1.0 + len(chosen))

    def coordinates() -> Coordinates:
        headers = [header_text(tile.header(pixels, instrument.coadd_scale)) for tile in tiles]
        text = {"description": "FITS header of the WCS, 80-column cards"}
        return {
            "tile": (("tile",), np.array([tile.name for tile in tiles], object), {}),
            "band": (("band",), np.array(instrument.bands, object), {}),
            "tile_id": (("tile",), np.array([tile.id for tile in tiles]), {}),
            "ra": (("tile",), np.array([tile.ra for tile in tiles]), {"units": "deg"}),
            "dec": (("tile",), np.array([tile.dec for tile in tiles]), {"units": "deg"}),
            "header": (("tile",), np.array(headers, object), text),
        }

    planes = 2 + settings.noise
    mean = np.mean([len(chosen) for chosen in members.values()])
    return ImageProduct(
        stage=f"coadds/{instrument.name}",
        units=LazyUnits(tuple(f"{tiles[k].name}-{band}" for k, band in keys), unit),
        make=maker,
        variables=_planes(pixels, settings.noise, psf_side(instrument), most_inputs(members) if drizzled else None),
        axes=("tile", "band"),
        lengths=(len(tiles), len(instrument.bands)),
        coordinates=coordinates,
        attributes={"survey": instrument.name, "pixel_scale": instrument.coadd_scale},
        # sums, sets and marks; the exposure that is added, its light and its noise, and what is read at a time
        bytes_per_unit=max(
            pixels**2 * ((3 if drizzled else 45) + 4 * planes)
            + (0 if drawn else max(int(np.prod(instrument.shape)) * 18, pixels * 25_000))
            + (300 << 20 if drawn else 50 << 20),
            # the PSFs of exposures are sampled before, whatever the size of the tile
            0 if drawn else 700 << 20,
        ),
        # a drizzled exposure seldom covers a whole tile
        seconds_per_unit=pixels**2 * (6e-7 if drawn else 2e-7 + 2.5e-8 * float(mean)),
        tables={"sets": schema("sets")} if drizzled else {},
    )


def _members(table: pd.DataFrame, tiles: np.ndarray, bands: tuple[str, ...]) -> dict[tuple[int, str], np.ndarray]:
    """Return the rows of the exposures that touch each tile (tiles, 4, 2), by tile and band, in order."""
    e, t = touching_pairs(corners_of(table), tiles)
    code = table["band"].map({band: number for number, band in enumerate(bands)}).to_numpy()[e]
    group = t * len(bands) + code
    order = np.lexsort((e, group))
    limits = np.searchsorted(group[order], np.arange(len(tiles) * len(bands) + 1))
    parts = np.split(e[order], limits[1:-1])
    return {(k // len(bands), bands[k % len(bands)]): part for k, part in enumerate(parts)}


def _planes(pixels: int, noise: int, psf: int, inputs: int | None) -> tuple[Variable, ...]:
    """Return the arrays of a tile: `inputs` exposures at most are drizzled, or None where none is."""
    shape, axes = (pixels, pixels), ("y", "x")
    text = "noise realisations with the image's correlations"
    flags = {"flag_masks": [SATURATED], "flag_meanings": "saturated"}
    found = [
        Variable("image", "float32", shape, axes, {"units": "nJy", "long_name": "flux of a pixel"}),
        Variable(
            "weight",
            "float32",
            shape,
            axes,
            {"units": "s" if inputs else "1/nJy2", "long_name": "sum of weights"},
        ),
        Variable("noise", "float32", (noise, *shape), ("realisation", *axes), {"units": "nJy", "long_name": text}),
        Variable("nimages", "uint16", shape, axes, {"long_name": "number of exposures"}),
        Variable("dq", "uint8", shape, axes, {"long_name": "data quality", **flags}),
        Variable("psf", "float32", (psf, psf), ("v", "u"), {"long_name": "unit star of flat f_nu, mean over the tile"}),
    ]
    if inputs:
        # of the hundreds of visits that Rubin's tiles have there are more sets than can be numbered
        found.append(Variable("set", "uint16", shape, axes, {"long_name": "number of the set of exposures"}))
        text = "unit star of flat f_nu of each exposure, as it is drizzled"
        found.append(Variable("input_psf", "float32", (inputs, psf, psf), ("input", "v", "u"), {"long_name": text}))
    return tuple(found)
