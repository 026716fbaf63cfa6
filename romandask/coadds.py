"""Coadds: tiles in nJy with weight, noise realisation, number of exposures and PSF.

Roman's are drizzled from its exposures, one at a time; Rubin's are drawn directly from its cadence.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
import sep
from astropy.wcs import WCS

from romandask.coadd_psfs import input_psf, psf_side
from romandask.exposures import RenderExposure, cone, empty_variance, header_text
from romandask.instruments.exposure import EXPOSURE_COLUMNS, Exposure, Instrument, exposure_of, pixel_areas
from romandask.kernels.detector import SATURATED, noise_realisation, usable
from romandask.kernels.drizzle import Sums
from romandask.kernels.fourier import POINT
from romandask.kernels.pixel_map import PixelMap, pixel_map, strips
from romandask.kernels.psf import PsfModel
from romandask.kernels.render import Scene, draw, draw_wide, plan_stamps
from romandask.kernels.scene import build_scene
from romandask.kernels.stack import stack
from romandask.model.config import CoaddSettings, RenderSettings
from romandask.model.seeds import rng
from romandask.model.sky import touching_pairs
from romandask.model.spectra import NJY_ZERO_POINT, Bandpass
from romandask.model.tiles import Tile
from romandask.pointings import corners_of
from romandask.psfs import flat_shares
from romandask.runtime.images import Coordinates, ImageProduct
from romandask.runtime.manifest import digest
from romandask.runtime.memory import give_back
from romandask.runtime.schemas import schema
from romandask.runtime.store import Variable
from romandask.runtime.units import LazyUnits, Unit

BACKGROUND_MESH = 256
"""Pixels of the mesh on which an exposure's background is estimated."""


def coadds(exposures: ImageProduct, tiles: list[Tile], settings: CoaddSettings) -> ImageProduct:
    """Return the lazy coadds of a survey's exposures: dims (tile, band, y, x).

    A tile reads its exposures one at a time from the exposures product: from the store where they are, rendered where
    not. The tiles of an instrument that is drawn from its cadence use the exposures' table and truth, and render none.
    """
    render = exposures.make
    if not isinstance(render, RenderExposure):
        raise TypeError("coadds need the product that exposures() returns")
    instrument, table = render.instrument, render.table
    grid = settings.grid()
    pixels = grid.pixels(instrument.coadd_scale)
    drawn = instrument.coadd_from == "pointings"
    footprints = np.stack([tile.corners(grid.side) for tile in tiles])
    members = _members(table, footprints, instrument.bands)
    maker = (DrawTile if drawn else DrizzleTile)(exposures, tuple(tiles), members, settings, pixels, render.render)
    names = np.array(exposures.names, object)
    values = table[[name for name in EXPOSURE_COLUMNS if name != "band"]].to_numpy(float)
    shared = {**settings.model_dump(), "instrument": instrument.name, "seed": render.seed}
    if drawn:
        shared |= render.render.model_dump()
    else:
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
        f"coadds/{instrument.name}",
        LazyUnits(tuple(f"{tiles[k].name}-{band}" for k, band in keys), unit),
        maker,
        _planes(pixels, settings.noise, psf_side(instrument), None if drawn else most_inputs(members)),
        ("tile", "band"),
        (len(tiles), len(instrument.bands)),
        coordinates,
        {"survey": instrument.name, "pixel_scale": instrument.coadd_scale},
        # sums, sets and marks; the exposure that is added, its light and its noise, and what is read at a time
        bytes_per_unit=pixels**2 * ((45 if drawn else 3) + 4 * planes)
        + (0 if drawn else max(int(np.prod(instrument.shape)) * 18, pixels * 25_000))
        + (300 << 20 if drawn else 50 << 20),
        # a drizzled exposure seldom covers a whole tile
        seconds_per_unit=pixels**2 * (6e-7 if drawn else 2e-7 + 2.5e-8 * float(mean)),
        tables={} if drawn else {"sets": schema("sets")},
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


@dataclass(frozen=True)
class DrizzleTile:
    """Makes one tile and band by drizzling its exposures."""

    exposures: ImageProduct
    tiles: tuple[Tile, ...]
    members: dict[tuple[int, str], np.ndarray]
    settings: CoaddSettings
    pixels: int
    render: RenderSettings

    def __call__(self, index: int) -> dict[str, np.ndarray]:
        """Return image, weight, noise, nimages, dq, set, PSFs and the table of sets."""
        source: RenderExposure = self.exposures.make  # type: ignore[assignment]
        instrument = source.instrument
        k, b = divmod(index, len(instrument.bands))
        tile, band = self.tiles[k], instrument.bands[b]
        scale = instrument.coadd_scale
        target = WCS(tile.header(self.pixels, scale))
        members, shape = self.members[k, band], (self.pixels, self.pixels)
        exposures = [exposure_of(source.table.iloc[i]) for i in members]
        headers = [instrument.header(exposure) for exposure in exposures]
        frames = [WCS(header) for header in headers]
        parts = [strips(frame, instrument.shape, target, shape) for frame in frames]
        # before the sums take their memory: sampling PSFs takes some of its own
        psfs = np.zeros((most_inputs(self.members), *[psf_side(instrument)] * 2), np.float32)
        for number, (exposure, frame) in enumerate(zip(exposures, frames, strict=True)):
            if parts[number]:
                psfs[number] = input_psf(instrument, exposure, frame, tile.ra, tile.dec, self.settings.pixfrac)
        give_back()
        sums, dq = Sums(shape, 1 + self.settings.noise, self.settings.pixfrac), np.zeros(shape, np.uint8)
        for i, exposure, header, frame, part in zip(members, exposures, headers, frames, parts, strict=True):
            planes: Iterable = []
            if part:
                arrays = self.exposures.load(int(i), ("image", "variance", "dq"))
                maps = [pixel_map(frame, target, strip.rows, strip.columns) for strip in part]
                for onto in maps:
                    mark_saturated(dq, arrays["dq"], onto)
                planes = _planes_of(arrays, maps, instrument, exposure, header, source.seed, self.settings.noise)
            sums.add(planes)
        arrays, planes = {}, []
        give_back()
        seconds = np.array([exposure.exptime for exposure in exposures])
        sets = sets_table(sums.set, sums.sets, seconds, [self.exposures.names[i] for i in members])
        count = sums.count
        image, *noise = sums.means()
        for plane in (image, *noise):
            plane *= np.float32(scale**2)
        used = np.bincount(sets["input"], sets["seconds"] * sets["pixels"], len(psfs))
        return {
            "image": image,
            "weight": sums.weight,
            "noise": np.stack(noise) if len(noise) > 1 else noise[0][None],
            "nimages": count,
            "dq": dq,
            "set": sums.set,
            "psf": np.tensordot(used / max(used.sum(), 1e-30), psfs, 1).astype(np.float32),
            "input_psf": psfs,
            "sets": sets,
        }


def mark_saturated(dq: np.ndarray, source: np.ndarray, onto: PixelMap) -> None:
    """Set, in its place, the bit of a tile's dq plane (uint8) around where pixels of an exposure are saturated.

    They are left out of the mean, and what is left at a star's core is its fainter part.

    Parameters
    ----------
    source : dq of the whole exposure
    onto : the map of a part of it onto the tile
    """
    rows, columns = np.nonzero(source[onto.rows, onto.columns] & SATURATED)
    if not len(rows):
        return
    x, y = np.rint(onto.at(rows + onto.rows.start, columns + onto.columns.start)).astype(int).T
    # a drop is less than two of the tile's pixels wide
    for step_y, step_x in np.ndindex(3, 3):
        v, u = y + step_y - 1, x + step_x - 1
        inside = (v >= 0) & (u >= 0) & (v < dq.shape[0]) & (u < dq.shape[1])
        dq[v[inside], u[inside]] |= SATURATED


def most_inputs(members: dict[tuple[int, str], np.ndarray]) -> int:
    """Return room for the exposures of any tile in any band: a multiple of 16, so that it seldom changes."""
    return 16 * max(1, *(-(-len(chosen) // 16) for chosen in members.values()))


def sets_table(
    planes: np.ndarray, members: list[tuple[int, ...]], seconds: np.ndarray, names: list[str]
) -> pd.DataFrame:
    """Return the sets of exposures of a tile, one row for each exposure of each (schema: catalogs/sets.yaml).

    Parameters
    ----------
    planes : (ny, nx) number of the set of each pixel
    members : exposures of each set, as numbers
    seconds, names : of each exposure
    """
    pixels = np.zeros(len(members), np.int64)
    # some rows at a time: counting makes them eight bytes each
    for first in range(0, len(planes), 256):
        pixels += np.bincount(planes[first : first + 256].ravel(), minlength=len(members))
    rows = [(k, number) for k, chosen in enumerate(members) if pixels[k] for number in chosen]
    sets, inputs = np.array(rows, int).reshape(-1, 2).T
    return pd.DataFrame({
        "set": sets.astype(np.int32), "input": inputs.astype(np.int32),
        "exposure": np.array([*names, ""], object)[inputs],
        "seconds": np.array([*seconds, 0], np.float32)[inputs], "pixels": pixels[sets],
    })  # fmt: skip


@dataclass(frozen=True)
class DrawTile:
    """Makes one tile and band from the cadence: the expectation with the effective PSF, and the stack's noise."""

    exposures: ImageProduct
    tiles: tuple[Tile, ...]
    members: dict[tuple[int, str], np.ndarray]
    settings: CoaddSettings
    pixels: int
    render: RenderSettings

    def __call__(self, index: int) -> dict[str, np.ndarray]:
        """Return image, weight, noise, nimages, dq and the PSF."""
        source: RenderExposure = self.exposures.make  # type: ignore[assignment]
        instrument: Any = source.instrument
        k, b = divmod(index, len(instrument.bands))
        tile, band = self.tiles[k], instrument.bands[b]
        shape = (self.pixels, self.pixels)
        wcs = WCS(tile.header(self.pixels, instrument.coadd_scale))
        bandpass = instrument.bandpass(band)
        chosen = [exposure_of(source.table.iloc[i]) for i in self.members[k, band]]
        to_njy = NJY_ZERO_POINT / bandpass.ab_photons()
        gains = np.array([exposure.exptime for exposure in chosen]) / to_njy
        variances = (np.array([instrument.pixel_noise(exposure) for exposure in chosen]) / gains) ** 2
        corners = corners_of(source.table.iloc[self.members[k, band]])
        polygons = np.stack(wcs.all_world2pix(corners[..., 0].ravel(), corners[..., 1].ravel(), 0, quiet=True), -1)
        layers = stack(polygons.reshape(-1, 4, 2), variances, gains, shape)
        made = {"weight": layers.weight, "nimages": layers.count, "dq": np.zeros(shape, np.uint8)}
        realisations = self.settings.noise
        if not layers.shares.any():
            side = psf_side(instrument)
            blank = np.zeros((realisations, *shape), np.float32)
            return {**made, "image": blank[0], "noise": blank, "psf": np.zeros((side, side))}
        truth = source.truth.near(*cone(tile.corners(self.settings.grid().side)))
        scene = build_scene(truth, wcs, bandpass, to_njy, instrument.knot_smoothing).scene
        faintest = self.render.truncation / np.sqrt(layers.weight.max())
        psf = instrument.effective_psf(chosen, layers.shares)
        stamps = plan_stamps(scene, psf.edges, shape, faintest, self.render.largest)
        covered = layers.weight > 0
        expected = np.where(covered, draw(scene, psf, shape, stamps, faintest), 0)
        empty = np.where(covered, 1 / np.maximum(layers.weight, np.finfo(np.float32).tiny), 0)
        light = rng(source.seed, "coadds", instrument.name, tile.id, band).standard_normal(shape, dtype=np.float32)
        noise = np.empty((realisations, *shape), np.float32)
        for number, plane in enumerate(noise):
            other = rng(source.seed, "coadds", "noise", instrument.name, tile.id, band, *_number(number))
            other.standard_normal(out=plane, dtype=np.float32)
            plane *= np.sqrt(empty)
        return {
            **made,
            "image": expected + light * np.sqrt(empty + layers.source * np.maximum(expected, 0)),
            "noise": noise,
            "psf": _star(psf, bandpass, psf_side(instrument)),
        }


def _number(realisation: int) -> tuple[int, ...]:
    """Return what tells the random numbers of a noise realisation from those of the first."""
    return (realisation,) if realisation else ()


def _planes_of(
    arrays: dict[str, np.ndarray],
    maps: list[PixelMap],
    instrument: Instrument,
    exposure: Exposure,
    header: dict,
    seed: int,
    realisations: int,
) -> Iterator[tuple[list[np.ndarray], np.ndarray, PixelMap]]:
    """Yield, for each strip that has a map, image and noise realisations in nJy/arcsec2, weight and the map."""
    good = usable(arrays["dq"])
    # where the variance is worked out from the image it is needed once more
    image = arrays["image"].astype(np.float32) if "variance" in arrays else as_float(arrays.pop("image"))
    light = subtract_background(image, ~good)
    to_njy = NJY_ZERO_POINT / instrument.bandpass(exposure.band).ab_photons() / exposure.exptime
    identity = ("noise", instrument.name, exposure.visit, exposure.detector)
    for onto in maps:
        here = (onto.rows, onto.columns)
        scale = to_njy / pixel_areas(header, instrument.shape, *here)
        background = instrument.background(exposure, header, *here)
        variance = empty_variance(arrays, background, instrument.detector, here)
        noise = [
            noise_realisation(
                variance, instrument.shape[1], *here,
                lambda block, k=number: rng(seed, "coadds", *identity, *_number(k), block),
            )
            for number in range(realisations)
        ]  # fmt: skip
        weight = np.float32(exposure.exptime) * good[here]
        yield [light[here] * scale, *(plane * scale for plane in noise)], weight, onto


def as_float(image: np.ndarray) -> np.ndarray:
    """Return an image as float32, in its own place where its pixels have four bytes: it is of no use any more."""
    if image.dtype.itemsize != 4 or not image.flags.writeable:
        return image.astype(np.float32)
    light = image.view(np.float32)
    # some rows at a time, for a copy of each is made on the way
    for first in range(0, len(image), 256):
        light[first : first + 256] = image[first : first + 256].astype(np.float32)
    return light


def subtract_background(light: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Return an exposure (float32, electrons), changed, less its background, estimated from it on a coarse mesh."""
    background = sep.Background(light, mask=mask, bw=BACKGROUND_MESH, bh=BACKGROUND_MESH)
    background.subfrom(light)
    return light


def _star(psf: PsfModel, bandpass: Bandpass, side: int) -> np.ndarray:
    """Return a unit star (side, side) of flat f_nu in the middle."""
    middle = np.array([(side - 1) / 2])
    scene = Scene(
        x=middle,
        y=middle,
        key=np.zeros(1, np.uint64),
        owner=np.zeros(1, int),
        kind=np.full(1, POINT),
        matrix=np.zeros((1, 2, 2)),
        smoothing=np.zeros((1, 2, 2)),
        knots=np.zeros(1, int),
        photons=flat_shares(bandpass)[None],
    )
    image = np.zeros((side, side), np.float32)
    draw_wide(image, scene, scene.photons, psf.nodes, psf.grid, np.array([psf.grid.size]))
    return image


def _planes(pixels: int, noise: int, psf: int, inputs: int | None) -> tuple[Variable, ...]:
    """Return the arrays of a tile: `inputs` exposures at most are drizzled, or None where tiles are drawn."""
    shape, axes = (pixels, pixels), ("y", "x")
    text = "noise realisations with the image's correlations"
    flags = {"flag_masks": [SATURATED], "flag_meanings": "saturated"}
    found = [
        Variable("image", "float32", shape, axes, {"units": "nJy", "long_name": "flux of a pixel"}),
        Variable(
            "weight", "float32", shape, axes,
            {"units": "s" if inputs else "1/nJy2", "long_name": "sum of weights"},
        ),
        Variable("noise", "float32", (noise, *shape), ("realisation", *axes), {"units": "nJy", "long_name": text}),
        Variable("nimages", "uint16", shape, axes, {"long_name": "number of exposures"}),
        Variable("dq", "uint8", shape, axes, {"long_name": "data quality", **flags}),
        Variable("psf", "float32", (psf, psf), ("v", "u"), {"long_name": "unit star of flat f_nu, mean over the tile"}),
    ]  # fmt: skip
    if inputs:
        # of the hundreds of visits that a drawn tile has there are more sets than can be numbered
        found.append(Variable("set", "uint16", shape, axes, {"long_name": "number of the set of exposures"}))
        text = "unit star of flat f_nu of each exposure, as it is drizzled"
        found.append(Variable("input_psf", "float32", (inputs, psf, psf), ("input", "v", "u"), {"long_name": text}))
    return tuple(found)
