"""Coadds: tiles in nJy with weight, noise realisations, number of exposures and PSF.

Roman's coadds are drizzled from its exposures, one exposure at a time. Rubin's coadds are drawn directly from its
cadence, or warped from the exposures of its visits.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd

from romandask.instruments.exposure import EXPOSURE_COLUMNS, exposures_of
from romandask.instruments.instrument import Instrument
from romandask.kernels.detectors.simple_detector import SATURATED
from romandask.model.settings import CoaddSettings
from romandask.model.sky import from_tangent_plane, touching_pairs
from romandask.model.tiles import PatchGrid, Tile
from romandask.products.images import Coordinates, ImageProduct
from romandask.products.schemas import schema
from romandask.products.units import LazyUnits, Unit
from romandask.stages.coadds.drawn import DrawTile
from romandask.stages.coadds.drizzled import DrizzleTile, most_inputs
from romandask.stages.coadds.input_psfs import psf_side
from romandask.stages.coadds.tile_maker import Coadds, Members, TileMaker
from romandask.stages.coadds.warped import WarpTile
from romandask.stages.exposures.exposures import Exposures, header_text
from romandask.stages.exposures.render import cone
from romandask.stages.pointings import corners_of
from romandask.stages.psf_models import SharedPsfs
from romandask.stages.stage import UNITS_FROM_POINTINGS, Stage, SurveyContext
from romandask.storage.arrays import Variable
from romandask.storage.manifest import digest

FOOTPRINT_MARGIN = 2.0
"""Width by which patches are widened to find the exposures that touch them, arcsec."""
_SECONDS = {"drizzle": (1.4e-7, 4.6e-8), "draw": (6e-7, 0.0), "warp": (2e-7, 2.5e-8)}
"""Time per pixel of a patch, s: without exposures, and for each exposure, which seldom covers the whole patch."""
MAKERS: dict[str, type[TileMaker]] = {"drizzle": DrizzleTile, "draw": DrawTile, "warp": WarpTile}
"""Class that makes the tiles, by `Instrument.coadd`."""


def coadds(exposures: Exposures, tiles: list[Tile], settings: CoaddSettings) -> Coadds:
    """Return the lazy coadds of the exposures of an instrument, with the dims (tile, band, y, x).

    A unit is a patch of a tile in a band; it takes its exposures one at a time: windows of stored exposures are read,
    others are rendered. If the tiles are drawn from a cadence they use only the pointings and the truth, and no
    exposure is rendered.

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
    patches = PatchGrid(settings.grid().pixels(instrument.coadd_scale), settings.patch_pixels)
    pixels = patches.pixels
    drawn, drizzled = instrument.coadd == "draw", instrument.coadd == "drizzle"
    members = patch_members(table, tiles, patches, instrument)
    maker = MAKERS[instrument.coadd](
        exposures=exposures,
        tiles=tuple(tiles),
        patches=patches,
        members=members,
        settings=settings,
        render=renderer.render,
    )
    names = np.array(exposures.names, object)
    values = table[[name for name in EXPOSURE_COLUMNS if name != "band"]].to_numpy(float)
    shared = {**settings.model_dump(), "patch_side": patches.side, "instrument": instrument.name, "seed": renderer.seed}
    shared["psf"] = instrument.psf_settings
    if drawn:
        shared |= renderer.render.model_dump()
    elif drizzled:
        # the arrays of all patches are as long as that of the patch with most exposures needs: if it changes, all are
        # remade
        shared["inputs"] = most_inputs(members)
    all_exposures = exposures_of(table)
    places = [(row, column) for row in range(patches.count) for column in range(patches.count)]
    unit_names = tuple(
        f"{tile.name}-{band}-{patches.name(*place)}" for tile in tiles for band in instrument.bands for place in places
    )

    def unit(index: int) -> Unit:
        patch = maker.unit(index)
        chosen = patch.members
        unit_settings: dict[str, Any] = {**shared, "tile": patch.tile.name, "band": patch.band}
        unit_settings["patch"] = [patch.row, patch.column]
        if drawn:
            unit_settings["exposures"] = digest(values[chosen])
            inputs = renderer.truth.inputs(*cone(patch.footprint))
        else:
            unit_settings["exposures"] = names[chosen].tolist()
            psf_units = dict.fromkeys(source for row in chosen for source in renderer.psfs.inputs(all_exposures[row]))
            inputs = (*((exposures.stage, name) for name in names[chosen]), *psf_units)
        return Unit(name=unit_names[index], settings=unit_settings, inputs=inputs, cost=1.0 + len(chosen))

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
    seconds = _SECONDS[instrument.coadd]
    # the part of an exposure that a patch may cover, at the angle at which it is largest
    side = patches.side
    part = min(
        2 * (side * instrument.coadd_scale / instrument.pixel_scale + 140) ** 2, float(np.prod(instrument.shape))
    )
    product = ImageProduct(
        stage=f"coadds/{instrument.name}",
        units=LazyUnits(unit_names, unit),
        make=maker,
        variables=_variables(pixels, settings.noise, psf_side(instrument), most_inputs(members) if drizzled else None),
        axes=("tile", "band"),
        lengths=(len(tiles), len(instrument.bands)),
        patches=patches,
        coordinates=coordinates,
        attributes={"survey": instrument.name, "pixel_scale": instrument.coadd_scale},
        # sums, sets and dq; the part of the exposure that is being added, its image, its noise, the chunks read; PSF
        # models
        bytes_per_unit=max(
            int(side**2 * ((7 if drizzled else 45) + 4 * planes) + (0 if drawn else part * 30)) + (300 << 20),
            # sampling PSFs that differ between exposures, which does not depend on the size of the patch
            0 if drawn or isinstance(renderer.psfs, SharedPsfs) else 700 << 20,
        ),
        seconds_per_unit=side**2 * (seconds[0] + seconds[1] * float(members.counts.mean())),
        tables={"sets": schema("sets")} if drizzled else {},
    )
    return Coadds(product=product, maker=maker)


def patch_members(table: pd.DataFrame, tiles: Sequence[Tile], patches: PatchGrid, instrument: Instrument) -> Members:
    """Return the exposures that touch the patch of each unit.

    Footprints are quadrilaterals of great circles, and the edges of distorted detectors are curved: patches are widened
    by FOOTPRINT_MARGIN, so that an exposure with a single pixel on a patch is never missed.

    Parameters
    ----------
    table : DataFrame
        Pointings table.
    tiles : sequence of Tile
    patches : PatchGrid
        Division of each tile into patches.
    instrument : Instrument
        Instrument of the exposures.
    """
    bands, count = instrument.bands, patches.count
    edges = np.array([patches.window(k, k)[0].start for k in range(count)] + [patches.pixels], float)
    # offsets from the centre of a tile, degrees: x grows to the west
    low, high = ((edges[k : count + k] - patches.pixels / 2) * instrument.coadd_scale / 3600 for k in range(2))
    margin = FOOTPRINT_MARGIN / 3600
    low, high = low - margin, high + margin
    west = np.stack([low, high, high, low], axis=-1)[None, :]
    north = np.stack([low, low, high, high], axis=-1)[:, None]
    west, north = (np.broadcast_to(axis, (count, count, 4)).reshape(-1) for axis in (west, north))
    corners = np.stack([np.stack(from_tangent_plane(t.ra, t.dec, -west, north), -1) for t in tiles])
    e, p = touching_pairs(corners_of(table), corners.reshape(-1, 4, 2))
    tile, place = np.divmod(p, count**2)
    code = table["band"].map({band: number for number, band in enumerate(bands)}).to_numpy()[e]
    group = (tile * len(bands) + code) * count**2 + place
    order = np.lexsort((e, group))
    limits = np.searchsorted(group[order], np.arange(len(tiles) * len(bands) * count**2 + 1))
    return Members(e[order], limits)


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
        Largest number of exposures of a drizzled patch; None for tiles that are not drizzled.
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
            attributes={"long_name": "unit star of flat f_nu, mean over the patch"},
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
    unit="patch of a tile in a band",
    summary="Image, weight, noise, number and sets of exposures, and PSFs of a patch, drizzled from exposures (square "
    "kernel, exact overlaps), warped from visits or drawn from the cadence at its depth.",
    shrink_with="lower coadds.patch_pixels",
    tables={"sets": "coadds/<survey>_sets/"},
)
