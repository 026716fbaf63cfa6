"""Tiles of a coadd that are drizzled from exposures. Each exposure is read once, for image, noise, weight and sets."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
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
from romandask.kernels.detectors.simple_detector import SATURATED, usable
from romandask.model.spectra import NJY_ZERO_POINT
from romandask.products.memory import release_free_memory
from romandask.stages.coadds.exposure_noise import noise_realisations
from romandask.stages.coadds.input_psfs import input_psf, psf_side
from romandask.stages.coadds.tile_maker import TileMaker
from romandask.stages.exposures.exposures import empty_variance

StripPlanes = tuple[Sequence[np.ndarray], np.ndarray, PixelMap]
"""Image and noise realisations of a strip of an exposure, its weight and its map onto the tile: see `Sums.add`."""


@dataclass(frozen=True)
class DrizzleTile(TileMaker):
    """Makes a tile in one band by drizzling the exposures that touch it."""

    def __call__(self, index: int) -> dict[str, Any]:
        """Return image, weight, noise, nimages, dq, set, psf, input_psf and the table of sets of a unit."""
        table, instrument, unit = self.exposures.table, self.instrument, self.unit(index)
        scale, shape = instrument.coadd_scale, (self.pixels, self.pixels)
        tile, members, target = unit.tile, unit.members, unit.wcs
        exposures = [exposure_of(table.iloc[i]) for i in members]
        headers = [instrument.header(exposure) for exposure in exposures]
        frames = [WCS(header) for header in headers]
        strips_of = [strips(frame, instrument.shape, target, shape) for frame in frames]
        sampled = self.exposures.renderer.psfs
        # PSFs are sampled before the sums are allocated, because sampling needs memory of its own
        psfs = np.zeros((most_inputs(self.members), *[psf_side(instrument)] * 2), np.float32)
        for number, (exposure, frame) in enumerate(zip(exposures, frames, strict=True)):
            if strips_of[number]:
                psfs[number] = input_psf(instrument, sampled, exposure, frame, tile.ra, tile.dec, self.settings.pixfrac)
        release_free_memory()
        sums = Sums(shape, 1 + self.settings.noise, self.settings.pixfrac)
        saturated = [np.zeros(0, np.int32)]
        for i, exposure, header, frame, own_strips in zip(members, exposures, headers, frames, strips_of, strict=True):
            planes: Iterable[StripPlanes] = []
            if own_strips:
                arrays = self.exposures.load(int(i), ("image", "variance", "dq"))
                maps = [pixel_map(frame, target, strip.rows, strip.columns) for strip in own_strips]
                saturated += [saturated_pixels(arrays["dq"], onto, shape) for onto in maps]
                planes = _planes_of(arrays, maps, instrument, exposure, header, self.seed, self.settings.noise)
            sums.add(planes)
        # free the last exposure
        arrays, planes = {}, []
        release_free_memory()
        seconds = np.array([exposure.exptime for exposure in exposures])
        sets = sets_table(sums.set, sums.sets, seconds, [self.exposures.names[i] for i in members])
        set_sizes = np.array([len(chosen) for chosen in sums.sets], np.uint16)
        image, *noise = sums.means()
        for plane in (image, *noise):
            plane *= np.float32(scale**2)
        psf_weights = np.bincount(sets["input"], sets["seconds"] * sets["pixels"], len(psfs))
        return {
            "image": image,
            "weight": sums.weight,
            "noise": np.stack(noise) if len(noise) > 1 else noise[0][None],
            # functions that are called when the arrays are written, after the arrays above have been freed
            "nimages": partial(getitem, set_sizes, sums.set),
            "dq": partial(saturation_plane, np.concatenate(saturated), shape),
            "set": sums.set,
            "psf": np.tensordot(psf_weights / max(psf_weights.sum(), 1e-30), psfs, 1).astype(np.float32),
            "input_psf": psfs,
            "sets": sets,
        }


def saturated_pixels(dq: np.ndarray, onto: PixelMap, shape: tuple[int, int]) -> np.ndarray:
    """Return the pixels of a tile that are near saturated pixels of an exposure.

    Saturated pixels are left out of the weighted mean, so at the core of a bright star the mean is too faint: these
    pixels of the tile must be flagged.

    Parameters
    ----------
    dq : ndarray, shape (ny, nx)
        The dq plane of the whole exposure.
    onto : PixelMap
        Map of a part of the exposure onto the tile.
    shape : (int, int)
        Rows and columns of the tile.

    Returns
    -------
    ndarray, shape (n,), int32
        Indices into the flattened tile.
    """
    rows, columns = np.nonzero(dq[onto.rows, onto.columns] & SATURATED)
    if not len(rows):
        return np.zeros(0, np.int32)
    x, y = np.rint(onto.at(rows + onto.rows.start, columns + onto.columns.start)).astype(int).T
    # a drop is less than two tile pixels wide
    near = np.stack([(y + step_y - 1, x + step_x - 1) for step_y, step_x in np.ndindex(3, 3)], axis=-1)
    v, u = near[:, (near >= 0).all(axis=0) & (near[0] < shape[0]) & (near[1] < shape[1])]
    return np.unique(v * shape[1] + u).astype(np.int32)


def saturation_plane(saturated: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Return a dq plane, uint8, in which the pixels with the given indices into the flattened plane are saturated."""
    dq = np.zeros(shape, np.uint8)
    dq.ravel()[saturated] = SATURATED
    return dq


def most_inputs(members: dict[tuple[int, str], np.ndarray]) -> int:
    """Return the largest number of exposures of a tile in one band, rounded up to a multiple of 16.

    It is the length of arrays of all tiles. It is rounded so that it seldom changes when the pointings do.
    """
    return 16 * max(1, *(-(-len(chosen) // 16) for chosen in members.values()))


def sets_table(
    plane: np.ndarray, members: list[tuple[int, ...]], seconds: np.ndarray, names: list[str]
) -> pd.DataFrame:
    """Return the sets of exposures of a tile, with one row per set and exposure (schema: catalogs/sets.yaml).

    Parameters
    ----------
    plane : ndarray of int, shape (ny, nx)
        Number of the set of each pixel.
    members : list of tuple of int
        Indices of the exposures in each set.
    seconds : ndarray, shape (exposures,), s
        Exposure times.
    names : list of str
        Names of the exposures.
    """
    pixels = np.zeros(len(members), np.int64)
    # a few rows at a time, because bincount converts them to eight bytes per pixel
    for first in range(0, len(plane), 256):
        pixels += np.bincount(plane[first : first + 256].ravel(), minlength=len(members))
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
    header: dict[str, Any],
    seed: int,
    realisations: int,
) -> Iterator[StripPlanes]:
    """Yield the planes of each strip of an exposure, in nJy/arcsec^2, as `Sums.add` takes them.

    Parameters
    ----------
    arrays : dict of str to ndarray
        Arrays `image`, `dq` and perhaps `variance` of the exposure; `image` may be removed and overwritten.
    maps : list of PixelMap
        Map of each strip onto the tile.
    instrument : Instrument
        Instrument of the exposure.
    exposure : Exposure
        The exposure.
    header : dict
        FITS header of the exposure.
    seed : int
        Seed of the survey.
    realisations : int
        Number of noise realisations.
    """
    good = usable(arrays["dq"])
    # not in place if there is a variance: `empty_variance` then needs the original image
    image = arrays["image"].astype(np.float32) if "variance" in arrays else as_float(arrays.pop("image"))
    light = subtract_background(image, ~good)
    to_njy = NJY_ZERO_POINT / instrument.bandpass(exposure.band).ab_photons() / exposure.exptime
    for onto in maps:
        part = (onto.rows, onto.columns)
        scale = to_njy / pixel_areas(header, instrument.shape, *part)
        background = instrument.background(exposure, header, *part)
        variance = empty_variance(arrays, background, instrument.detector, part)
        noise = noise_realisations(realisations, variance, instrument, exposure, part, seed)
        weight = np.float32(exposure.exptime) * good[part]
        yield [light[part] * scale, *(plane * scale for plane in noise)], weight, onto
