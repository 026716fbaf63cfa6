"""Oversampled images of the PSF of an exposure at a position: stars of unit flux, with the pixel response."""

from __future__ import annotations

import numpy as np

from romandask.instruments.exposure import Exposure
from romandask.instruments.instrument import Instrument
from romandask.kernels.rendering.oversampled_image import fine_image
from romandask.model.spectra import Bandpass, ab_photon_density

OVERSAMPLING = 8
"""Samples per native pixel, along each axis."""
PSF_IMAGE_PIXELS = 64
"""Side of a PSF image, native pixels."""
PSF_IMAGE_SIDE = PSF_IMAGE_PIXELS * OVERSAMPLING
"""Side of a PSF image, samples."""


def flat_shares(bandpass: Bandpass) -> np.ndarray:
    """Return the fraction of the photons of a source of flat f_nu at each PSF node of a band, shape (nodes,)."""
    photons = (ab_photon_density(bandpass.wave) * bandpass.weights) @ bandpass.node_weights()
    return photons / photons.sum()


def psf_image(
    instrument: Instrument, exposure: Exposure, x: float, y: float, shares: np.ndarray | None = None
) -> np.ndarray:
    """Return the oversampled image of a star of unit flux at a position on the detector.

    A sample is the share of the light in a native pixel that is centred on the sample: samples that are one native
    pixel apart sum to 1, apart from the light beyond the edge of the image. The star is centred on sample
    PSF_IMAGE_SIDE / 2 of both axes.

    Parameters
    ----------
    instrument : Instrument
        Instrument of the exposure.
    exposure : Exposure
        Exposure whose PSF is sampled.
    x, y : float, pixels
        Position on the detector.
    shares : ndarray, shape (nodes,), optional
        Photons of the star's spectrum at each PSF node of the band, in any unit; by default those of a star of flat
        f_nu.

    Returns
    -------
    ndarray, shape (PSF_IMAGE_SIDE, PSF_IMAGE_SIDE)
    """
    bandpass = instrument.bandpass(exposure.band)
    shares = flat_shares(bandpass) if shares is None else np.asarray(shares, float) / np.sum(shares)
    return fine_image(instrument.psf_at(exposure, x, y), shares, x, y, PSF_IMAGE_PIXELS, OVERSAMPLING)


def centre_image(instrument: Instrument, exposure: Exposure) -> np.ndarray:
    """Return `psf_image` of a star of flat f_nu at the centre of the detector, float32."""
    ny, nx = instrument.shape
    return psf_image(instrument, exposure, (nx - 1) / 2, (ny - 1) / 2).astype(np.float32)
