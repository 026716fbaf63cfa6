"""Tiles of a coadd that are warped from the exposures of visits, and averaged with inverse variances."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from astropy.wcs import WCS

from romandask.instruments.exposure import Exposure, exposure_of, pixel_areas
from romandask.instruments.instrument import Instrument
from romandask.kernels.coadding.background import as_float, subtract_background
from romandask.kernels.coadding.coadd_psf import warped_psf
from romandask.kernels.coadding.pixel_map import pixel_map, strips
from romandask.kernels.coadding.warp import Means
from romandask.kernels.detectors.simple_detector import SATURATED, noise_realisation, usable
from romandask.model.seeds import realisation_key, rng
from romandask.model.spectra import NJY_ZERO_POINT
from romandask.model.tiles import Tile
from romandask.products.memory import release_free_memory
from romandask.stages.coadds.input_psfs import jacobian, psf_side
from romandask.stages.coadds.tile_maker import TileMaker
from romandask.stages.psf_images import OVERSAMPLING, psf_image


@dataclass(frozen=True)
class WarpTile(TileMaker):
    """Makes one tile and band of the exposures that touch it."""

    def __call__(self, index: int) -> dict[str, np.ndarray]:
        """Return image, weight, noise, nimages, dq and the PSF."""
        table, instrument, here = self.exposures.table, self.instrument, self.unit(index)
        target, shape = here.wcs, (self.pixels, self.pixels)
        sums, side = Means(shape, 1 + self.settings.noise), psf_side(instrument)
        psf, used = np.zeros((side, side)), 0.0
        for i in here.members.tolist():
            exposure = exposure_of(table.iloc[i])
            weight = self._add(sums, exposure, i, target, self.seed)
            if weight:
                psf += weight * _psf(instrument, exposure, target, here.tile)
                used += weight
        release_free_memory()
        scale = np.float32(instrument.coadd_scale**2)
        image, *noise = (plane * scale for plane in sums.means())
        return {
            "image": image,
            "weight": sums.weight,
            "noise": np.stack(noise),
            "nimages": sums.count,
            "dq": sums.marks * np.uint8(SATURATED),
            "psf": (psf / max(used, 1e-30)).astype(np.float32),
        }

    def _add(self, sums: Means, exposure: Exposure, index: int, target: WCS, seed: int) -> float:
        """Add an exposure; return its weight in the whole tile: 1 / nJy2 of a pixel, times pixels."""
        instrument = self.instrument
        header, shape = instrument.header(exposure), (self.pixels, self.pixels)
        frame = WCS(header)
        # the part of the tile that the exposure may cover, and of the exposure that the tile may
        on_tile = strips(target, shape, frame, instrument.shape)
        on_frame = strips(frame, instrument.shape, target, shape)
        if not on_tile or not on_frame:
            return 0.0
        arrays = self.exposures.load(index, ("image", "dq"))
        bad, saturated = ~usable(arrays["dq"]), (arrays["dq"] & SATURATED) > 0
        light = subtract_background(as_float(arrays.pop("image")), bad)
        rows = slice(on_frame[0].rows.start, on_frame[-1].rows.stop)
        here = rows, on_frame[0].columns
        to_njy = NJY_ZERO_POINT / instrument.bandpass(exposure.band).ab_photons() / exposure.exptime
        density = to_njy / pixel_areas(header, instrument.shape, *here)
        variance = instrument.background(exposure, header, *here) + np.float32(instrument.detector.read_noise**2)
        identity = ("noise", instrument.name, exposure.visit, exposure.detector)
        noise = (
            noise_realisation(
                variance,
                instrument.shape[1],
                *here,
                lambda block, k=number: rng(seed, "coadds", *identity, *realisation_key(k), block),
            )
            for number in range(self.settings.noise)
        )
        planes = np.stack([light[here] * density, *(plane * density for plane in noise)])
        weight = 1 / float(np.mean(variance * density**2) * instrument.coadd_scale**4)
        onto = pixel_map(target, frame, slice(on_tile[0].rows.start, on_tile[-1].rows.stop), on_tile[0].columns)
        corner = here[0].start, here[1].start
        return weight * sums.add(planes, bad[here], saturated[here], weight, onto, corner)


def _psf(instrument: Instrument, exposure: Exposure, target: WCS, tile: Tile) -> np.ndarray:
    """Return a unit star of flat f_nu (side, side), as an exposure has it in the middle of a tile, or next to it."""
    source = WCS(instrument.header(exposure))
    ny, nx = instrument.shape
    x, y = np.clip(np.array(source.all_world2pix(tile.ra, tile.dec, 0, quiet=True), float), 0, [nx - 1, ny - 1])
    fine = psf_image(instrument, exposure, x, y)
    return warped_psf(fine, OVERSAMPLING, jacobian(source, target, x, y), psf_side(instrument))
