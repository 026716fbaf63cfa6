"""Tiles of a coadd that are warped from the exposures of visits and averaged with inverse-variance weights."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from astropy.wcs import WCS

from romandask.instruments.exposure import Exposure, exposure_of, pixel_areas
from romandask.instruments.instrument import Instrument
from romandask.instruments.psf_image import OVERSAMPLING, psf_image
from romandask.kernels.coadding.background import as_float, subtract_background
from romandask.kernels.coadding.coadd_psf import warped_psf
from romandask.kernels.coadding.pixel_map import pixel_map, strips
from romandask.kernels.coadding.warp import Means
from romandask.kernels.detectors.simple_detector import SATURATED, usable
from romandask.model.spectra import NJY_ZERO_POINT
from romandask.model.tiles import Tile
from romandask.products.memory import release_free_memory
from romandask.stages.coadds.exposure_noise import noise_realisations
from romandask.stages.coadds.input_psfs import jacobian, psf_side
from romandask.stages.coadds.tile_maker import TileMaker


@dataclass(frozen=True)
class WarpTile(TileMaker):
    """Makes a tile in one band from the exposures that touch it."""

    def __call__(self, index: int) -> dict[str, np.ndarray]:
        """Return image, weight, noise, nimages, dq and psf of a unit."""
        table, instrument, unit = self.exposures.table, self.instrument, self.unit(index)
        target, shape = unit.wcs, (self.pixels, self.pixels)
        sums, side = Means(shape, 1 + self.settings.noise), psf_side(instrument)
        psf, total_weight = np.zeros((side, side)), 0.0
        for i in unit.members.tolist():
            exposure = exposure_of(table.iloc[i])
            weight = self._add(sums, exposure, i, target)
            if weight:
                psf += weight * _psf(instrument, exposure, target, unit.tile)
                total_weight += weight
        release_free_memory()
        scale = np.float32(instrument.coadd_scale**2)
        image, *noise = (plane * scale for plane in sums.means())
        return {
            "image": image,
            "weight": sums.weight,
            "noise": np.stack(noise),
            "nimages": sums.count,
            "dq": sums.marks * np.uint8(SATURATED),
            "psf": (psf / max(total_weight, 1e-30)).astype(np.float32),
        }

    def _add(self, sums: Means, exposure: Exposure, index: int, target: WCS) -> float:
        """Add an exposure to the sums, and return its weight summed over the pixels of the tile.

        Parameters
        ----------
        sums : Means
            Sums over the exposures of the tile.
        exposure : Exposure
            The exposure.
        index : int
            Row of the exposure in the pointings table.
        target : WCS
            WCS of the tile.

        Returns
        -------
        float, 1/nJy^2
            0 if the exposure does not touch the tile.
        """
        instrument = self.instrument
        header, shape = instrument.header(exposure), (self.pixels, self.pixels)
        frame = WCS(header)
        # the part of the tile that the exposure may cover, and the part of the exposure that the tile may cover
        on_tile = strips(target, shape, frame, instrument.shape)
        on_frame = strips(frame, instrument.shape, target, shape)
        if not on_tile or not on_frame:
            return 0.0
        arrays = self.exposures.load(index, ("image", "dq"))
        bad, saturated = ~usable(arrays["dq"]), (arrays["dq"] & SATURATED) > 0
        light = subtract_background(as_float(arrays.pop("image")), bad)
        rows = slice(on_frame[0].rows.start, on_frame[-1].rows.stop)
        part = rows, on_frame[0].columns
        to_njy = NJY_ZERO_POINT / instrument.bandpass(exposure.band).ab_photons() / exposure.exptime
        density = to_njy / pixel_areas(header, instrument.shape, *part)
        variance = instrument.background(exposure, header, *part) + np.float32(instrument.detector.read_noise**2)
        noise = noise_realisations(self.settings.noise, variance, instrument, exposure, part, self.seed)
        planes = np.stack([light[part] * density, *(plane * density for plane in noise)])
        weight = 1 / float(np.mean(variance * density**2) * instrument.coadd_scale**4)
        onto = pixel_map(target, frame, slice(on_tile[0].rows.start, on_tile[-1].rows.stop), on_tile[0].columns)
        corner = part[0].start, part[1].start
        return weight * sums.add(planes, bad[part], saturated[part], weight, onto, corner)


def _psf(instrument: Instrument, exposure: Exposure, target: WCS, tile: Tile) -> np.ndarray:
    """Return the image on a tile of a star of unit flux and flat f_nu in an exposure, shape (side, side).

    The PSF is that at the centre of the tile, or at the nearest position on the detector.
    """
    source = WCS(instrument.header(exposure))
    ny, nx = instrument.shape
    x, y = np.clip(np.array(source.all_world2pix(tile.ra, tile.dec, 0, quiet=True), float), 0, [nx - 1, ny - 1])
    fine = psf_image(instrument, exposure, x, y)
    return warped_psf(fine, OVERSAMPLING, jacobian(source, target, x, y), psf_side(instrument))
