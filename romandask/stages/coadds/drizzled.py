"""Tiles of a coadd that are drizzled from exposures: image, noise, weight, sets and PSFs in one pass over each."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import partial
from operator import getitem
from typing import Any

import numpy as np
import pandas as pd
from astropy.wcs import WCS

from romandask.instruments.exposure import Exposure, exposure_of, pixel_areas
from romandask.instruments.instrument import Instrument
from romandask.kernels.coadding.background import as_float, subtract_background
from romandask.kernels.coadding.drizzle import Sums
from romandask.kernels.coadding.pixel_map import PixelMap, pixel_map, strips
from romandask.kernels.detectors.simple_detector import SATURATED, noise_realisation, usable
from romandask.model.seeds import realisation_key, rng
from romandask.model.spectra import NJY_ZERO_POINT
from romandask.products.memory import release_free_memory
from romandask.stages.coadds.input_psfs import input_psf, psf_side
from romandask.stages.coadds.tile_maker import TileMaker
from romandask.stages.exposures.exposures import empty_variance


@dataclass(frozen=True)
class DrizzleTile(TileMaker):
    """Makes one tile and band by drizzling its exposures."""

    def __call__(self, index: int) -> dict[str, Any]:
        """Return image, weight, noise, nimages, dq, set, PSFs and the table of sets."""
        table, instrument, here = self.exposures.table, self.instrument, self.unit(index)
        scale, shape = instrument.coadd_scale, (self.pixels, self.pixels)
        tile, members, target = here.tile, here.members, here.wcs
        exposures = [exposure_of(table.iloc[i]) for i in members]
        headers = [instrument.header(exposure) for exposure in exposures]
        frames = [WCS(header) for header in headers]
        parts = [strips(frame, instrument.shape, target, shape) for frame in frames]
        # before the sums take their memory: sampling PSFs takes some of its own
        psfs = np.zeros((most_inputs(self.members), *[psf_side(instrument)] * 2), np.float32)
        for number, (exposure, frame) in enumerate(zip(exposures, frames, strict=True)):
            if parts[number]:
                psfs[number] = input_psf(instrument, exposure, frame, tile.ra, tile.dec, self.settings.pixfrac)
        release_free_memory()
        sums, full = Sums(shape, 1 + self.settings.noise, self.settings.pixfrac), []
        for i, exposure, header, frame, part in zip(members, exposures, headers, frames, parts, strict=True):
            planes: Iterable = []
            if part:
                arrays = self.exposures.load(int(i), ("image", "variance", "dq"))
                maps = [pixel_map(frame, target, strip.rows, strip.columns) for strip in part]
                full += [saturated_places(arrays["dq"], onto, shape) for onto in maps]
                planes = _planes_of(arrays, maps, instrument, exposure, header, self.seed, self.settings.noise)
            sums.add(planes)
        arrays, planes = {}, []
        release_free_memory()
        seconds = np.array([exposure.exptime for exposure in exposures])
        sets = sets_table(sums.set, sums.sets, seconds, [self.exposures.names[i] for i in members])
        members_of = np.array([len(chosen) for chosen in sums.sets], np.uint16)
        image, *noise = sums.means()
        for plane in (image, *noise):
            plane *= np.float32(scale**2)
        used = np.bincount(sets["input"], sets["seconds"] * sets["pixels"], len(psfs))
        return {
            "image": image,
            "weight": sums.weight,
            "noise": np.stack(noise) if len(noise) > 1 else noise[0][None],
            # made when they are written: by then the planes before them are let go
            "nimages": partial(getitem, members_of, sums.set),
            "dq": partial(marked, np.concatenate([np.zeros(0, np.int32), *full]), shape),
            "set": sums.set,
            "psf": np.tensordot(used / max(used.sum(), 1e-30), psfs, 1).astype(np.float32),
            "input_psf": psfs,
            "sets": sets,
        }


def saturated_places(source: np.ndarray, onto: PixelMap, shape: tuple[int, int]) -> np.ndarray:
    """Return the pixels of a tile (n,), int32 in its flattened image, around where those of an exposure are saturated.

    They are left out of the mean, and what is left at a star's core is its fainter part.

    Parameters
    ----------
    source : dq of the whole exposure
    onto : the map of a part of it onto the tile
    """
    rows, columns = np.nonzero(source[onto.rows, onto.columns] & SATURATED)
    if not len(rows):
        return np.zeros(0, np.int32)
    x, y = np.rint(onto.at(rows + onto.rows.start, columns + onto.columns.start)).astype(int).T
    # a drop is less than two of the tile's pixels wide
    near = np.stack([(y + step_y - 1, x + step_x - 1) for step_y, step_x in np.ndindex(3, 3)], axis=-1)
    v, u = near[:, (near >= 0).all(axis=0) & (near[0] < shape[0]) & (near[1] < shape[1])]
    return np.unique(v * shape[1] + u).astype(np.int32)


def marked(places: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Return a dq plane (uint8) that is saturated at some places (n,) of the flattened image."""
    dq = np.zeros(shape, np.uint8)
    dq.ravel()[places] = SATURATED
    return dq


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
    return pd.DataFrame(
        {
            "set": sets.astype(np.int32),
            "input": inputs.astype(np.int32),
            "exposure": np.array([*names, ""], object)[inputs],
            "seconds": np.array([*seconds, 0], np.float32)[inputs],
            "pixels": pixels[sets],
        }
    )


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
                variance,
                instrument.shape[1],
                *here,
                lambda block, k=number: rng(seed, "coadds", *identity, *realisation_key(k), block),
            )
            for number in range(realisations)
        ]
        weight = np.float32(exposure.exptime) * good[here]
        yield [light[here] * scale, *(plane * scale for plane in noise)], weight, onto
