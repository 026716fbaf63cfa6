"""Patches of a coadd that are warped from the exposures of visits and averaged with inverse-variance weights."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from astropy.wcs import WCS

from romandask.instruments.exposure import Exposure, exposure_of, pixel_areas
from romandask.instruments.instrument import Instrument
from romandask.instruments.psf_image import OVERSAMPLING, psf_image
from romandask.kernels.coadding.background import background_at
from romandask.kernels.coadding.coadd_psf import warped_psf
from romandask.kernels.coadding.pixel_map import bounds, pixel_map, strips
from romandask.kernels.coadding.warp import REACH, Means
from romandask.kernels.detectors.simple_detector import SATURATED, usable
from romandask.model.spectra import NJY_ZERO_POINT
from romandask.stages.coadds.exposure_noise import noise_realisations
from romandask.stages.coadds.input_psfs import jacobian, psf_side
from romandask.stages.coadds.tile_maker import TileMaker


@dataclass(frozen=True)
class WarpTile(TileMaker):
    """Makes a patch of a tile in one band from the exposures that touch it."""

    def __call__(self, index: int) -> dict[str, np.ndarray]:
        """Return image, weight, noise, nimages, dq and psf of a unit."""
        table, instrument, patch = self.exposures.table, self.instrument, self.unit(index)
        target, shape, centre = patch.wcs, patch.shape, patch.centre
        sums, side = Means(shape, 1 + self.settings.noise), psf_side(instrument)
        psf, total_weight = np.zeros((side, side)), 0.0
        for i in patch.members.tolist():
            exposure = exposure_of(table.iloc[i])
            weight = self._add(sums, exposure, i, target, shape)
            if weight:
                psf += weight * _psf(instrument, exposure, target, *centre)
                total_weight += weight
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

    def _add(self, sums: Means, exposure: Exposure, index: int, target: WCS, shape: tuple[int, int]) -> float:
        """Add an exposure to the sums, and return its weight summed over the pixels of the patch.

        Parameters
        ----------
        sums : Means
            Sums over the exposures of the patch.
        exposure : Exposure
            The exposure.
        index : int
            Row of the exposure in the pointings table.
        target : WCS
            WCS of the patch.
        shape : (int, int)
            Rows and columns of the patch.

        Returns
        -------
        float, 1/nJy^2
            0 if the exposure does not touch the patch.
        """
        instrument = self.instrument
        header = instrument.header(exposure)
        frame = WCS(header)
        # the part of the patch that the exposure may cover, and the part of the exposure that the patch may cover
        patch, detector = _whole(shape), _whole(instrument.shape)
        onto = pixel_map(target, frame, *patch)
        on_tile, on_frame = strips(onto, detector), strips(pixel_map(frame, target, *detector), patch)
        if not on_tile or not on_frame:
            return 0.0
        # the interpolation takes pixels around those that are mapped
        part = _widened(bounds(on_frame), instrument.shape)
        arrays = self.exposures.with_mesh(index, ("image", "dq"), part)
        bad, saturated = ~usable(arrays["dq"]), (arrays["dq"] & SATURATED) > 0
        light = (arrays["image"] - background_at(arrays["background_mesh"], instrument.shape, *part)).astype(np.float32)
        to_njy = NJY_ZERO_POINT / instrument.bandpass(exposure.band).ab_photons() / exposure.exptime
        density = to_njy / pixel_areas(header, instrument.shape, *part)
        variance = instrument.background(exposure, header, *part) + np.float32(instrument.detector.read_noise**2)
        noise = noise_realisations(self.settings.noise, variance, instrument, exposure, part, self.seed)
        planes = np.stack([light * density, *(plane * density for plane in noise)])
        weight = 1 / float(np.mean(variance * density**2) * instrument.coadd_scale**4)
        corner = part[0].start, part[1].start
        return weight * sums.add(planes, bad, saturated, weight, onto.part(*bounds(on_tile)), corner)


def _whole(shape: tuple[int, int]) -> tuple[slice, slice]:
    return slice(0, shape[0]), slice(0, shape[1])


def _widened(part: tuple[slice, slice], shape: tuple[int, int]) -> tuple[slice, slice]:
    """Return a part of an image with REACH more pixels on each edge, within the image."""
    rows, columns = (
        slice(max(own.start - REACH, 0), min(own.stop + REACH, length)) for own, length in zip(part, shape, strict=True)
    )
    return rows, columns


def _psf(instrument: Instrument, exposure: Exposure, target: WCS, ra: float, dec: float) -> np.ndarray:
    """Return the image on a patch of a star of unit flux and flat f_nu in an exposure, shape (side, side).

    The PSF is that at the centre of the patch (ra, dec), or at the nearest position on the detector.
    """
    source = WCS(instrument.header(exposure))
    ny, nx = instrument.shape
    x, y = np.clip(np.array(source.all_world2pix(ra, dec, 0, quiet=True), float), 0, [nx - 1, ny - 1])
    fine = psf_image(instrument, exposure, x, y)
    return warped_psf(fine, OVERSAMPLING, jacobian(source, target, x, y), psf_side(instrument))
