"""Models of chromatic PSFs that vary over a detector, sampled in Fourier space once for all stamp sizes.

A PSF is known at the wavelengths of a band's nodes (`Bandpass.nodes`). All transforms include the response of a pixel.
Positions are pixel coordinates x, y, 0 at the centre of the first pixel.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import overload

import numpy as np
from numpy.polynomial.chebyshev import chebvander
from scipy import fft

from romandask.kernels.rendering.fourier import Frequencies, pack_frequencies
from romandask.kernels.rendering.rings import Rings, rings

_MIN_MODE_PEAK = 1e-7
"""Surface brightness of a unit star, 1/pixel, below which a mode of the PSF's variation is left out."""
MIN_POWER = 1e-5
"""Value of a transform, in units of its largest value, below which it counts as zero."""
CORE = 128
"""Side, pixels, of the largest stamps on which the variation of the PSF over the detector is modelled."""


@dataclass(frozen=True)
class Grid:
    """Grid of frequencies at which transforms are sampled.

    A stamp of N pixels needs the frequencies 2 pi j / N. For powers of two up to `size`, they are part of the grid of
    the largest stamp, so smaller stamps stride through it.
    """

    size: int
    """Side of the largest stamp, pixels, a power of two."""
    folds: int
    """Highest frequency, in units of the Nyquist frequency of the pixel grid."""

    @property
    def shape(self) -> tuple[int, int]:
        """Number of rows and columns.

        Frequencies are 2 pi j / size with rows j_y = -folds size / 2, ... and columns j_x = 0, 1, ...
        """
        return self.folds * self.size, self.folds * self.size // 2 + 1

    def axes(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the frequencies of the rows and of the columns, radians per pixel."""
        rows = 2 * np.pi * np.arange(-self.shape[0] // 2, self.shape[0] // 2) / self.size
        return rows, 2 * np.pi * np.arange(self.shape[1]) / self.size

    def within(self, transforms: np.ndarray, size: int) -> np.ndarray:
        """Return transforms on this grid, strided to the grid of stamps of at most `size` pixels."""
        stride = self.size // size
        return transforms[:, ::stride, ::stride]


@dataclass(frozen=True)
class Variation:
    """Differences of the PSF at positions on the detector from the PSF in the middle of the detector.

    The differences are known at the positions of `place_grid`. In between they are interpolated by the polynomial
    through all of these positions.
    """

    shape: tuple[int, int]
    """Shape of the detector (ny, nx)."""
    degree: int
    """Total degree of the polynomials in x and y."""
    differences: np.ndarray
    """Transforms on the grid of the core, shape (nodes, positions, rows, columns), complex64."""


class NodeTransforms(Sequence[np.ndarray], ABC):
    """Transforms of a PSF at its nodes, each of which is found when it is accessed, because they are large."""

    @abstractmethod
    def transform(self, node: int) -> np.ndarray:
        """Return the transform (grid.shape) of the PSF at a node."""

    @overload
    def __getitem__(self, index: int) -> np.ndarray: ...
    @overload
    def __getitem__(self, index: slice) -> Sequence[np.ndarray]: ...
    def __getitem__(self, index: int | slice) -> np.ndarray | Sequence[np.ndarray]:
        """Return the transform of the PSF at a node, or a list of those of a slice."""
        if isinstance(index, slice):
            return [self[k] for k in range(*index.indices(len(self)))]
        return self.transform(range(len(self))[index])


@dataclass(frozen=True)
class BrightPsf:
    """PSF of bright stars in the middle of a detector, more detailed and larger than the `PsfModel`."""

    min_electrons: float
    """Smallest flux, electrons, of the stars that are drawn with this PSF."""
    grid: Grid
    """Frequencies of the transforms."""
    nodes: Sequence[np.ndarray]
    """Transforms, each of grid.shape; they are large, so each is made or read when it is accessed."""
    shares: np.ndarray
    """Fractions of the light of the band's nodes at the nodes of this PSF, shape (band nodes, nodes of this PSF)."""


@dataclass(frozen=True, eq=False, kw_only=True)
class PsfModel:
    """PSF of one detector and band, as a function of wavelength and position.

    On stamps up to the size of the core, the PSF is a sum of principal modes whose weights depend on wavelength and
    position. On larger stamps, it is the PSF in the middle of the detector.
    """

    nodes: np.ndarray
    """Transforms of the PSFs in the middle of the detector, shape (nodes, *grid.shape), complex64, 1 at frequency 0."""
    grid: Grid
    """Frequencies of `nodes`."""
    core: Grid
    """Frequencies of `modes`, those of the largest stamps on which the variation over the detector is modelled."""
    modes: np.ndarray
    """Transforms of the modes, shape (modes, *core.shape), complex64; all light is in the first mode."""
    mixing: np.ndarray
    """Weights of the modes, shape (nodes * (1 + positions), modes).

    The first rows are the PSFs in the middle of the detector, the others the differences at the positions."""
    peaks: np.ndarray
    """Largest surface brightness of each mode, shape (modes,), 1/pixel."""
    degree: int = 0
    """Degree of the polynomials in x and y; 0 for a PSF that does not vary over the detector."""
    shape: tuple[int, int] = (1, 1)
    """Shape of the detector (ny, nx)."""
    # by stamp size; held by the instance, so that they are freed with it
    _core_frequencies: dict[int, Frequencies] = field(default_factory=dict, repr=False)
    _wide_frequencies: dict[int, Frequencies] = field(default_factory=dict, repr=False)

    def weights(self, photons: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Return the weights of the modes for the PSFs of n sources.

        Parameters
        ----------
        photons : array, shape (n, nodes)
            Electrons of each source at each node.
        x, y : array, shape (n,), pixels
            Positions on the detector.

        Returns
        -------
        array, shape (n, modes), float32
            Weights.
        """
        parts = [photons]
        if self.degree:
            positions = place_weights(x, y, self.shape, self.degree).astype(photons.dtype)
            width = photons.shape[1] * positions.shape[1]
            parts.append((photons[:, :, None] * positions[:, None, :]).reshape(len(photons), width))
        return (np.concatenate(parts, axis=1) @ self.mixing).astype(np.float32)

    def difference_weights(self, photons: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Return `weights` for the differences from the PSF in the middle of the detector only."""
        return self.weights(photons, x, y) - (photons @ self.mixing[: photons.shape[1]]).astype(np.float32)

    def frequencies(self, stamp: int) -> Frequencies:
        """Return the modes at the frequencies of a stamp of at most core.size pixels."""
        if stamp not in self._core_frequencies:
            self._core_frequencies[stamp] = stamp_frequencies(self.modes, self._images, self.core, stamp)
        return self._core_frequencies[stamp]

    def wide_frequencies(self, stamp: int) -> Frequencies:
        """Return the PSFs of the nodes in the middle of the detector at the frequencies of a stamp of any size."""
        if stamp not in self._wide_frequencies:
            self._wide_frequencies[stamp] = self._sample_nodes(stamp)
        return self._wide_frequencies[stamp]

    def _sample_nodes(self, stamp: int) -> Frequencies:
        fine = np.empty((len(self.nodes), 0, 0), np.float32)
        # a stamp as large as the grid is not cut from an image
        if stamp < self.grid.size:
            fine = np.stack([star_image(node, self.grid, self.grid.folds) for node in self.nodes])
        return stamp_frequencies(self.nodes, fine, self.grid, stamp)

    @cached_property
    def _images(self) -> np.ndarray:
        """Images of the modes, oversampled by core.folds."""
        return np.stack([star_image(mode, self.core, self.core.folds) for mode in self.modes])

    @cached_property
    def rings(self) -> Rings:
        """Light outside small stamps, for the PSFs in the middle of the detector."""
        return rings(
            [star_image(node, self.grid, self.grid.folds) for node in self.nodes], self.grid.folds, self.grid.size
        )

    @cached_property
    def edges(self) -> dict[int, float]:
        """Surface brightness of a unit star at the edges of stamps, by stamp size; see `edge_brightness`."""
        return edge_brightness(self.nodes[[0, -1]], self.grid)


def stamp_frequencies(transforms: np.ndarray, images: np.ndarray, grid: Grid, stamp: int) -> Frequencies:
    """Return PSFs, cut to a stamp centred on them, at the frequencies of the stamp.

    Sampling the transform of the whole PSF at the frequencies of a small stamp would fold light from outside the stamp
    into it.

    Parameters
    ----------
    transforms : complex array, shape (n, *grid.shape)
        Transforms of the PSFs.
    images : array, shape (n, folds * size, folds * size)
        Images of the PSFs, oversampled by grid.folds; not used if the stamp is as large as the grid.
    grid : Grid
        Frequencies of the transforms.
    stamp : int
        Side of the stamp, pixels.
    """
    stride = grid.size // stamp
    power = np.abs(transforms[:, ::stride, ::stride]).max(axis=0)
    has_power = power > MIN_POWER * power.max()
    if stride == 1:
        return pack_frequencies(transforms, has_power, stamp)
    return pack_frequencies(np.stack([_cut(image, grid.folds, stamp) for image in images]), has_power, stamp)


def _cut(image: np.ndarray, folds: int, size: int) -> np.ndarray:
    """Return the transform of the middle `size` pixels of an image that is oversampled by `folds`."""
    return np.fft.fftshift(fft.rfft2(fft.ifftshift(middle_of(image, folds * size))) / folds**2, axes=0)


def middle_of(image: np.ndarray, side: int) -> np.ndarray:
    """Return a copy of the middle of an image; its centre stays on the sample len(image) / 2."""
    low = image.shape[0] // 2 - side // 2
    return image[low : low + side, low : low + side].copy()


def edge_brightness(transforms: np.ndarray, grid: Grid) -> dict[int, float]:
    """Return the surface brightness of a unit star at the edges of stamps, for the PSF that is brightest there.

    Parameters
    ----------
    transforms : complex array, shape (n, *grid.shape)
        Transforms of the PSFs, for example those of the first and the last node of a band.
    grid : Grid
        Frequencies of the transforms.

    Returns
    -------
    dict of int to float
        Largest surface brightness, 1/pixel, at the edge, by stamp size.
    """
    brightness: dict[int, float] = {}
    offset = np.abs(np.arange(grid.size) - grid.size // 2)
    ring = np.maximum(offset[:, None], offset[None, :])
    for transform in transforms:
        image = np.abs(star_image(transform, grid))
        size = 16
        while size <= grid.size:
            # the maximum over several pixels, because the PSF has nulls between its diffraction rings
            width = max(size // 16, 2)
            at_edge = image[(ring <= size // 2) & (ring > size // 2 - width)].max()
            brightness[size] = max(brightness.get(size, 0.0), float(at_edge))
            size *= 2
    return brightness


def star_image(transform: np.ndarray, grid: Grid, fine: int = 1) -> np.ndarray:
    """Return the image of a unit star, shape (size * fine, size * fine).

    Parameters
    ----------
    transform : complex array, shape (grid.shape)
        Transform of the PSF.
    grid : Grid
        Frequencies of the transform.
    fine : int
        Oversampling, a divisor of grid.folds. The star is centred on the sample size * fine / 2.
    """
    side = grid.folds * grid.size
    full = fft.fftshift(fft.irfft2(np.fft.ifftshift(transform, axes=0), s=(side, side)))
    # taking every (folds / fine)-th sample of the image is the same as folding its transform
    return full[:: grid.folds // fine, :: grid.folds // fine] * grid.folds**2


def place_grid(shape: tuple[int, int], degree: int) -> np.ndarray:
    """Return the positions on a detector at which the variation of a PSF is sampled.

    They are the (degree + 1) (degree + 2) / 2 Padua points, the best nodes for interpolation in the plane by
    polynomials of a total degree (Caliari, De Marchi & Vianello 2005).

    Parameters
    ----------
    shape : (int, int)
        Shape of the detector (ny, nx).
    degree : int
        Total degree of the polynomials in x and y; at least 1.

    Returns
    -------
    array, shape (n, 2), pixels
        x and y of each position.
    """
    points = [
        (np.cos(j * np.pi / degree), np.cos(k * np.pi / (degree + 1)))
        for j in range(degree + 1)
        for k in range(degree + 2)
        if (j + k) % 2 == 0
    ]
    return (np.array(points) + 1) / 2 * shape[::-1] - 0.5


def place_weights(x: np.ndarray, y: np.ndarray, shape: tuple[int, int], degree: int) -> np.ndarray:
    """Return the weights, shape (n, positions), by which values at the positions of `place_grid` are interpolated.

    Parameters
    ----------
    x, y : array, shape (n,), pixels
        Positions; those outside the detector are moved to its edge.
    shape : (int, int)
        Shape of the detector (ny, nx).
    degree : int
        Total degree of the polynomials.
    """
    node_x, node_y = place_grid(shape, degree).T
    at_nodes = _polynomials(node_x, node_y, shape, degree)
    return _polynomials(np.asarray(x, float), np.asarray(y, float), shape, degree) @ np.linalg.inv(at_nodes)


def _polynomials(x: np.ndarray, y: np.ndarray, shape: tuple[int, int], degree: int) -> np.ndarray:
    """Return the products of Chebyshev polynomials up to a total degree, shape (n, polynomials)."""
    across, up = (
        chebvander(np.clip(2 * (value + 0.5) / side - 1, -1, 1), degree)
        for value, side in zip((x, y), shape[::-1], strict=True)
    )
    return np.stack([across[:, i] * up[:, j] for i in range(degree + 1) for j in range(degree + 1 - i)], axis=1)


def pixel_response(grid: Grid, diffusion: float) -> np.ndarray:
    """Return the transform of the response of a square pixel and of charge diffusion.

    Parameters
    ----------
    grid : Grid
        Frequencies.
    diffusion : float, pixels
        Sigma of the Gaussian by which charge diffuses before it is collected; 0 for no diffusion.

    Returns
    -------
    float32 array, shape (grid.shape)
        Transform.
    """
    up, across = (np.sinc(axis / (2 * np.pi)) * np.exp(-((axis * diffusion) ** 2) / 2) for axis in grid.axes())
    return (up[:, None] * across[None, :]).astype(np.float32)


def model(nodes: np.ndarray, grid: Grid, variation: Variation | None = None) -> PsfModel:
    """Return the model of sampled PSFs: their mean and the principal modes of the differences.

    Parameters
    ----------
    nodes : complex64 array, shape (nodes, *grid.shape)
        Transforms of the PSFs in the middle of the detector.
    grid : Grid
        Frequencies of the transforms.
    variation : Variation, optional
        Differences over the detector; None for a PSF that does not vary.
    """
    core = Grid(min(grid.size, CORE), grid.folds)
    core_nodes = grid.within(nodes, core.size)
    if core.size < grid.size:
        # without the cut, light outside the core would be folded into it
        power = np.abs(core_nodes).max(axis=0)
        has_power = power > MIN_POWER * power.max()
        core_nodes = np.stack(
            [_cut(star_image(node, grid, grid.folds), grid.folds, core.size) * has_power for node in nodes]
        )
    mean = core_nodes.mean(axis=0)
    differences = (core_nodes - mean).reshape(len(nodes), -1)
    if variation is not None:
        differences = np.concatenate([differences, variation.differences.reshape(-1, differences.shape[1])])
    # each column except the first stands for two frequencies
    weight = np.full(core.shape, 2.0, np.float32)
    weight[:, 0] = 1.0
    gram = ((differences * weight.ravel()) @ differences.conj().T).real
    variances, vectors = np.linalg.eigh(gram.astype(float))
    strongest = np.argsort(variances)[::-1]
    strongest = strongest[variances[strongest] > 1e-12 * variances.max(initial=1e-30)]
    modes = (vectors[:, strongest].T.astype(np.float32) @ differences).reshape(-1, *core.shape)
    peaks = np.array([np.abs(star_image(mode, core, core.folds)).max() for mode in modes])
    kept = peaks * np.abs(vectors[:, strongest]).max(axis=0, initial=0.0) > _MIN_MODE_PEAK
    mixing = vectors[:, strongest][:, kept]
    mean_weight = np.zeros((len(differences), 1))
    mean_weight[: len(nodes)] = 1.0
    return PsfModel(
        nodes=nodes,
        grid=grid,
        core=core,
        modes=np.concatenate([mean[None], modes[kept]]).astype(np.complex64),
        mixing=np.concatenate([mean_weight, mixing], axis=1).astype(np.float32),
        peaks=np.concatenate([[np.abs(star_image(mean, core, core.folds)).max()], peaks[kept]]),
        degree=variation.degree if variation is not None else 0,
        shape=variation.shape if variation is not None else (1, 1),
    )
