"""PSFs of drizzled coadds: the PSF of each input exposure on a tile, and images of stars at any position."""

from __future__ import annotations

import numpy as np
from astropy.wcs import WCS

from romandask.instruments.exposure import Exposure
from romandask.instruments.instrument import Instrument
from romandask.instruments.psf_image import OVERSAMPLING, psf_image
from romandask.kernels.coadding.coadd_psf import drizzled_psf, native_star
from romandask.kernels.coadding.drizzle import Sums
from romandask.kernels.coadding.pixel_map import pixel_map
from romandask.model.tiles import tangent_header
from romandask.stages.psf_models import Psfs

PSF_RADIUS = 3.0
"""Half the side of the PSF images, arcsec (Roman: tile pixels of 0.0575 arcsec); above 0.1 arcsec it is proportional to
the tile pixel."""


def psf_side(instrument: Instrument) -> int:
    """Return the side of the PSF images of the coadds of an instrument, pixels; an odd number."""
    radius = PSF_RADIUS * max(1.0, instrument.coadd_scale / 0.1)
    return 2 * int(round(radius / instrument.coadd_scale)) + 1


def jacobian(source: WCS, target: WCS, x: float, y: float) -> np.ndarray:
    """Return the derivative of the position on a target image with respect to the position on a source image.

    Parameters
    ----------
    source, target : WCS
        WCSs of the images.
    x, y : float, pixels
        Position on the source.

    Returns
    -------
    ndarray, shape (2, 2), target pixels per source pixel
        d(x, y on the target) / d(x, y on the source), as a finite difference over one pixel.
    """
    on_source = np.array([[0.5, 0.0], [-0.5, 0.0], [0.0, 0.5], [0.0, -0.5]]) + [x, y]
    on_target = np.stack(target.all_world2pix(*source.all_pix2world(*on_source.T, 0), 0, quiet=True))
    return np.stack([on_target[:, 0] - on_target[:, 1], on_target[:, 2] - on_target[:, 3]], axis=1)


def input_psf(
    instrument: Instrument, psfs: Psfs, exposure: Exposure, source: WCS, ra: float, dec: float, pixfrac: float
) -> np.ndarray:
    """Return the PSF of one exposure of a drizzled patch: the drizzled image of a star of unit flux and flat f_nu.

    It is the PSF at the centre of the detector (Troxel et al. 2023, section 5.2), with the orientation and distortion
    of the exposure at the centre of the patch.

    Parameters
    ----------
    instrument : Instrument
        Instrument of the exposure.
    psfs : Psfs
        PSFs of the exposures.
    exposure : Exposure
        The exposure.
    source : WCS
        WCS of the exposure.
    ra, dec : float, degrees
        Centre of the patch.
    pixfrac : float
        Side of a drop over the side of a native pixel.

    Returns
    -------
    ndarray, shape (side, side), float32
        Image with the pixels of the tile; `side` is that of `psf_side`.
    """
    ny, nx = instrument.shape
    x, y = np.clip(np.array(source.all_world2pix(ra, dec, 0, quiet=True), float), 0, [nx - 1, ny - 1])
    centre_ra, centre_dec = (float(value) for value in source.all_pix2world(x, y, 0))
    side = psf_side(instrument)
    target = WCS(tangent_header(centre_ra, centre_dec, side, instrument.coadd_scale))
    fine = psfs.centre(exposure)
    return drizzled_psf(fine, OVERSAMPLING, jacobian(source, target, x, y), pixfrac, side).astype(np.float32)


def star_on(
    target: WCS,
    stamp: int,
    ra: float,
    dec: float,
    exposures: list[tuple[Exposure, WCS, float]],
    instrument: Instrument,
    pixfrac: float,
    shares: np.ndarray | None,
) -> np.ndarray:
    """Return the image of a star of unit flux, drizzled from exposures, each with its own pixels and PSF.

    Parameters
    ----------
    target : WCS
        WCS of the image.
    stamp : int
        Side of the image, pixels.
    ra, dec : float, degrees
        Position of the star.
    exposures : list of (Exposure, WCS, float)
        The exposures, with their WCSs and weights.
    instrument : Instrument
        Instrument of the exposures.
    pixfrac : float
        Side of a drop over the side of a native pixel.
    shares : ndarray, shape (nodes,), or None
        Photons of the star's spectrum at each PSF node of the band, in any unit; None for those of flat f_nu.

    Returns
    -------
    ndarray, shape (stamp, stamp), float32
    """
    sums = Sums((stamp, stamp), 1, pixfrac)
    for exposure, source, weight in exposures:
        x, y = (float(value) for value in source.all_world2pix(ra, dec, 0))
        area = abs(np.linalg.det(jacobian(source, target, x, y)))
        half = int(np.ceil(0.75 * stamp / np.sqrt(area))) + 2
        column, row = round(x), round(y)
        fine = psf_image(instrument, exposure, x, y, shares)
        star = native_star(fine, OVERSAMPLING, half, x - column, y - row)
        rows, columns = slice(row - half, row + half + 1), slice(column - half, column + half + 1)
        weights = np.full(star.shape, weight, np.float32)
        sums.add([([star], weights, pixel_map(source, target, rows, columns))])
    return sums.means()[0]
