"""Patches of a coadd that are drizzled from exposures, each of which is read once, for all planes."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from operator import getitem
from typing import Any

import numpy as np
import pandas as pd
from astropy.wcs import WCS

from romandask.instruments.exposure import Exposure, exposure_of
from romandask.kernels.coadding.background import background_at
from romandask.kernels.coadding.drizzle import Sums
from romandask.kernels.coadding.pixel_map import PixelMap, bounds, pixel_map, strips
from romandask.kernels.detectors.simple_detector import SATURATED, usable
from romandask.model.spectra import NJY_ZERO_POINT
from romandask.stages.coadds.exposure_noise import noise_realisations
from romandask.stages.coadds.input_psfs import input_psf, psf_side
from romandask.stages.coadds.tile_maker import Members, TileMaker
from romandask.stages.exposures.exposures import empty_variance

StripPlanes = tuple[Sequence[np.ndarray], np.ndarray, PixelMap]
"""Image and noise realisations of a strip of an exposure, its weight and its map onto the tile: see `Sums.add`."""


@dataclass(frozen=True)
class DrizzleTile(TileMaker):
    """Makes a patch of a tile in one band by drizzling the exposures that touch it.

    An exposure is mapped onto the tile, and the patch is a window of the tile: its pixels do not depend, to the last
    bit, on how the tile is divided.
    """

    def __call__(self, index: int) -> dict[str, Any]:
        """Return image, weight, noise, nimages, dq, set, psf, input_psf and the table of sets of a unit."""
        table, instrument, patch = self.exposures.table, self.instrument, self.unit(index)
        shape, target = patch.shape, WCS(patch.tile_header)
        whole = [slice(0, length) for length in instrument.shape]
        exposures = [exposure_of(table.iloc[i]) for i in patch.members]
        frames = [WCS(instrument.header(exposure)) for exposure in exposures]
        maps = [pixel_map(frame, target, *whole) for frame in frames]
        strips_of = [strips(onto, patch.window) for onto in maps]
        sampled = self.exposures.renderer.psfs
        # PSFs are sampled before the sums are allocated, because sampling needs memory of its own
        psfs = np.zeros((most_inputs(self.members), *[psf_side(instrument)] * 2), np.float32)
        centre = patch.centre
        for number, (exposure, frame) in enumerate(zip(exposures, frames, strict=True)):
            if strips_of[number]:
                psfs[number] = input_psf(instrument, sampled, exposure, frame, *centre, self.settings.pixfrac)
        sums = Sums(shape, 1 + self.settings.noise, self.settings.pixfrac, patch.corner)
        saturated = [np.zeros(0, np.int32)]
        for i, exposure, onto, own_strips in zip(patch.members, exposures, maps, strips_of, strict=True):
            planes: Iterable[StripPlanes] = []
            if own_strips:
                box = bounds(own_strips)
                arrays = self.exposures.with_mesh(int(i), ("image", "variance", "dq"), box)
                mesh = arrays.pop("background_mesh")
                parts = [onto.part(strip.rows, strip.columns) for strip in own_strips]
                saturated += [saturated_pixels(arrays["dq"], box, part, patch.window) for part in parts]
                planes = self._planes(arrays, box, mesh, parts, exposure)
            sums.add(planes)
        seconds = np.array([exposure.exptime for exposure in exposures])
        sets = sets_table(sums.set, sums.sets, seconds, [self.exposures.names[i] for i in patch.members])
        set_sizes = np.array([len(chosen) for chosen in sums.sets], np.uint16)
        image, *noise = sums.means()
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

    def _planes(
        self,
        arrays: dict[str, np.ndarray],
        box: tuple[slice, slice],
        mesh: np.ndarray,
        parts: list[PixelMap],
        exposure: Exposure,
    ) -> Iterator[StripPlanes]:
        """Yield the planes of each strip of an exposure, in nJy, as `Sums.add` takes them.

        Parameters
        ----------
        arrays : dict of str to ndarray
            Window `box` of the arrays `image`, `dq` and perhaps `variance` of the exposure.
        box : (slice, slice)
            Rows and columns of the exposure that all strips lie in.
        mesh : ndarray
            Background mesh of the exposure.
        parts : list of PixelMap
            Map of each strip onto the tile.
        exposure : Exposure
            The exposure.
        """
        instrument = self.instrument
        header = instrument.header(exposure)
        to_njy = np.float32(NJY_ZERO_POINT / instrument.bandpass(exposure.band).ab_photons() / exposure.exptime)
        for onto in parts:
            part = (onto.rows, onto.columns)
            own = tuple(slice(p.start - b.start, p.stop - b.start) for p, b in zip(part, box, strict=True))
            strip = {name: array[own] for name, array in arrays.items()}
            sky = instrument.background(exposure, header, *part)
            variance = empty_variance(strip, sky, instrument.detector)
            light = strip["image"] - background_at(mesh, instrument.shape, *part)
            planes = [light.astype(np.float32, copy=False)]
            planes += noise_realisations(self.settings.noise, variance, instrument, exposure, part, self.seed)
            for plane in planes:
                plane *= to_njy
            yield planes, np.float32(exposure.exptime) * usable(strip["dq"]), onto


def saturated_pixels(
    dq: np.ndarray, box: tuple[slice, slice], onto: PixelMap, window: tuple[slice, slice]
) -> np.ndarray:
    """Return the pixels of a window of a tile that are near saturated pixels of an exposure.

    Saturated pixels are left out of the weighted mean, so at the core of a bright star the mean is too faint: these
    pixels of the tile must be flagged.

    Parameters
    ----------
    dq : ndarray
        Window `box` of the dq plane of the exposure.
    box : (slice, slice)
        Rows and columns of the exposure; they contain the part of the exposure that is mapped.
    onto : PixelMap
        Map of a part of the exposure onto the tile.
    window : (slice, slice)
        Rows and columns of the tile.

    Returns
    -------
    ndarray, shape (n,), int32
        Indices into the flattened window.
    """
    own = tuple(slice(p.start - b.start, p.stop - b.start) for p, b in zip((onto.rows, onto.columns), box, strict=True))
    rows, columns = np.nonzero(dq[own] & SATURATED)
    if not len(rows):
        return np.zeros(0, np.int32)
    x, y = np.rint(onto.at(rows + onto.rows.start, columns + onto.columns.start)).astype(int).T
    # a drop is less than two tile pixels wide
    near = np.stack([(y + step_y - 1, x + step_x - 1) for step_y, step_x in np.ndindex(3, 3)], axis=-1)
    near -= np.array([window[0].start, window[1].start])[:, None, None]
    height, width = (part.stop - part.start for part in window)
    v, u = near[:, (near >= 0).all(axis=0) & (near[0] < height) & (near[1] < width)]
    return np.unique(v * width + u).astype(np.int32)


def saturation_plane(saturated: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Return a dq plane, uint8, in which the pixels with the given indices into the flattened plane are saturated."""
    dq = np.zeros(shape, np.uint8)
    dq.ravel()[saturated] = SATURATED
    return dq


def most_inputs(members: Members) -> int:
    """Return the largest number of exposures of a patch, rounded up to a multiple of 16.

    It is the length of arrays of all patches. It is rounded so that it seldom changes when the pointings do.
    """
    return 16 * max(1, -(-int(members.counts.max(initial=0)) // 16))


def sets_table(
    plane: np.ndarray, members: list[tuple[int, ...]], seconds: np.ndarray, names: list[str]
) -> pd.DataFrame:
    """Return the sets of exposures of a patch, with one row per set and exposure (schema: catalogs/sets.yaml).

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
