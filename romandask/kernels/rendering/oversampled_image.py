"""Oversampled images of PSF models."""

from __future__ import annotations

import numpy as np
from scipy import fft

from romandask.kernels.rendering.psf import Grid, PsfModel, middle_of


def fine_image(psf: PsfModel, shares: np.ndarray, x: float, y: float, side: int, oversampling: int) -> np.ndarray:
    """Return the oversampled image of a unit star, shape (side * oversampling, side * oversampling).

    Parameters
    ----------
    psf : PsfModel
        PSF.
    shares : array, shape (nodes,)
        Fractions of the star's light at each node; the sum is 1.
    x, y : float, pixels
        Position on the detector.
    side : int
        Side of the image, native pixels.
    oversampling : int
        Samples per pixel along a side. The star is centred on the sample side * oversampling / 2.
    """
    shares = np.asarray(shares, float)
    image = _oversampled(np.tensordot(shares.astype(np.float32), psf.nodes, 1), psf.grid, oversampling)
    image = middle_of(image, side * oversampling)
    if psf.degree:
        weights = psf.difference_weights(shares[None], np.array([x]), np.array([y]))[0]
        difference = _oversampled(np.tensordot(weights, psf.modes, 1), psf.core, oversampling)
        inside = middle_of(difference, min(len(difference), len(image)))
        low = (len(image) - len(inside)) // 2
        image[low : low + len(inside), low : low + len(inside)] += inside
    return image


def _oversampled(transform: np.ndarray, grid: Grid, oversampling: int) -> np.ndarray:
    """Return the image of a transform, grid.size * oversampling samples a side, centred on the sample in the middle."""
    rows, columns = grid.shape
    # the PSF has no power beyond the grid's frequencies: padding the transform with zeros oversamples the image
    fine = grid.size * oversampling * -(-rows // (grid.size * oversampling))
    padded = np.zeros((fine, fine // 2 + 1), np.complex64)
    padded[fine // 2 - rows // 2 : fine // 2 + rows // 2, :columns] = transform
    image = fft.fftshift(fft.irfft2(np.fft.ifftshift(padded, axes=0), s=(fine, fine))) * (fine / grid.size) ** 2
    step = fine // (grid.size * oversampling)
    return image[::step, ::step]
