"""Sampling of GalSim profiles in Fourier space, and PSF models made from them."""

from __future__ import annotations

import galsim
import numpy as np

from romandask.kernels.rendering.psf import Grid, PsfModel, model, pixel_response


def sample(profile: galsim.GSObject, pixel_scale: float, grid: Grid, diffusion: float = 0.0) -> np.ndarray:
    """Return the transform of a profile convolved with the response of a pixel.

    Parameters
    ----------
    profile : galsim.GSObject
        Profile, in arcsec.
    pixel_scale : float, arcsec
        Pixel scale.
    grid : Grid
        Frequencies.
    diffusion : float, pixels
        Sigma of the Gaussian by which charge diffuses before it is collected; 0 for no diffusion.

    Returns
    -------
    complex64 array, shape (grid.shape)
        Transform.
    """
    rows, columns = grid.shape
    # only the private method can draw half of the plane, which is all that is needed
    bounds = galsim.BoundsI(0, columns - 2, -rows // 2, rows // 2 - 1)
    image = galsim.ImageCF(bounds, scale=2 * np.pi / (grid.size * pixel_scale))
    profile._drawKImage(image)
    out = np.zeros(grid.shape, np.complex64)
    # the last column, the Nyquist frequency of the folded grid, is beyond the maximum frequency of every profile
    np.multiply(image.array, pixel_response(grid, diffusion)[:, :-1], out=out[:, :-1])
    out[0] = 0
    return out


def required_folds(profiles: list[galsim.GSObject], pixel_scale: float) -> int:
    """Return the maximum frequency of profiles (arcsec) in units of the Nyquist frequency, rounded up, from 1 to 4."""
    max_frequency = max(profile.maxk for profile in profiles) * pixel_scale
    return int(np.clip(np.ceil(max_frequency / np.pi), 1, 4))


def sample_model(profiles: list[galsim.GSObject], pixel_scale: float, size: int, diffusion: float = 0.0) -> PsfModel:
    """Return the model of a PSF that does not vary over the detector.

    Parameters
    ----------
    profiles : list of galsim.GSObject
        PSF of flux 1 at each node, in arcsec, in the frame of the pixels.
    pixel_scale : float, arcsec
        Pixel scale.
    size : int
        Side of the largest stamp, pixels, a power of two.
    diffusion : float, pixels
        Sigma of charge diffusion.
    """
    grid = Grid(size, required_folds(profiles, pixel_scale))
    return model(np.stack([sample(profile, pixel_scale, grid, diffusion) for profile in profiles]), grid)
