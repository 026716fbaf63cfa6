"""Chromatic PSF bases: PSFs at a few wavelengths, sampled in Fourier space once for all stamp sizes."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import galsim
import numpy as np
from scipy import fft


@dataclass(frozen=True)
class PsfBasis:
    """PSFs, pixel response included, at the nodes of a band, as transforms on a common grid.

    A stamp of N pixels needs frequencies 2 pi j / N; those of every power-of-two stamp up to `size` lie on the
    grid of the largest, so smaller stamps stride through it.
    """

    transforms: np.ndarray
    """(nodes, folds * size, folds * size / 2 + 1) complex64; rows are j_y = -folds * size / 2 ..., columns j_x = 0 ...;
    1 at zero frequency."""
    size: int
    """Largest stamp, pixels a side, a power of two."""
    folds: int
    """The transforms reach `folds` times the pixel grid's Nyquist frequency."""

    @cached_property
    def edge_brightness(self) -> dict[int, float]:
        """Largest surface brightness (1/pixel) of a unit star, at the first or last node, at the edge of each stamp."""
        edges: dict[int, float] = {}
        for transform in self.transforms[[0, -1]]:
            image = np.abs(_aliased_image(transform, self.size, self.folds))
            offset = np.abs(np.arange(self.size) - self.size // 2)
            ring = np.maximum(offset[:, None], offset[None, :])
            size = 16
            while size <= self.size:
                # a ring a few pixels wide, for the diffraction rings have nulls
                width = max(size // 16, 2)
                at_edge = image[(ring <= size // 2) & (ring > size // 2 - width)].max()
                edges[size] = max(edges.get(size, 0.0), float(at_edge))
                size *= 2
        return edges


def _aliased_image(transform: np.ndarray, size: int, folds: int) -> np.ndarray:
    """Return the centred (size, size) image of a unit star."""
    grid = folds * size
    full = fft.irfft2(np.fft.ifftshift(transform, axes=0), s=(grid, grid))
    # sampling an image finer by `folds` at pixel centres is folding its transform
    return np.fft.fftshift(full[::folds, ::folds]) * folds**2


def sample_basis(profiles: list[galsim.GSObject], pixel_scale: float, size: int) -> PsfBasis:
    """Sample PSF profiles (arcsec, in the frame of the pixels), convolved with the pixel, up to stamps of `size`.

    Parameters
    ----------
    profiles : unit-flux GalSim profiles, one a node
    pixel_scale : arcsec
    size : largest stamp, pixels a side, a power of two
    """
    reach = max(profile.maxk for profile in profiles) * pixel_scale
    folds = int(np.clip(np.ceil(reach / np.pi), 1, 4))
    grid = folds * size
    frequency = 2 * np.pi * np.arange(-grid // 2, grid // 2) / size
    pixel = np.sinc(frequency / (2 * np.pi))
    response = (pixel[:, None] * np.sinc(frequency[grid // 2 :] / (2 * np.pi))[None, :]).astype(np.float32)
    transforms = np.zeros((len(profiles), grid, grid // 2 + 1), np.complex64)
    for out, profile in zip(transforms, profiles, strict=True):
        # half the plane is enough, which GalSim's underscored method, alone, can draw
        bounds = galsim.BoundsI(0, grid // 2 - 1, -grid // 2, grid // 2 - 1)
        image = galsim.ImageCF(bounds, scale=2 * np.pi / (size * pixel_scale))
        profile._drawKImage(image)
        # the last column, half the sampling frequency of the folded grid, is beyond every profile's reach
        np.multiply(image.array, response, out=out[:, :-1])
    transforms[:, 0, :] = 0
    return PsfBasis(transforms, size, folds)


def radial_basis(frequency: np.ndarray, transfers: np.ndarray, pixel_scale: float, size: int) -> PsfBasis:
    """Return the basis of round PSFs from their transforms (nodes, n) at radial frequencies (n,), 1/arcsec."""
    folds = 2
    grid = folds * size
    rows = 2 * np.pi * np.arange(-grid // 2, grid // 2) / size
    columns = rows[grid // 2 :]
    response = np.sinc(rows / (2 * np.pi))[:, None] * np.sinc(columns / (2 * np.pi))[None, :]
    radius = np.hypot(rows[:, None], columns[None, :]) / pixel_scale
    transforms = np.zeros((len(transfers), grid, grid // 2 + 1), np.complex64)
    for out, transfer in zip(transforms, transfers, strict=True):
        out[:, :-1] = np.interp(radius, frequency, transfer, right=0.0) * response
    transforms[:, 0, :] = 0
    return PsfBasis(transforms, size, folds)
