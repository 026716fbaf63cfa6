"""Chromatic PSFs that vary over a detector, sampled in Fourier space once for all stamp sizes."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import cached_property

import galsim
import numpy as np
from numpy.polynomial.chebyshev import chebvander
from scipy import fft

from romandask.kernels.rendering.fourier import Frequencies, frequencies

_NEGLIGIBLE = 1e-7
"""Surface brightness of a unit star, 1/pixel, below which a mode of the PSF's variation is left out."""
FAINTEST = 1e-5
"""Share of a transform's largest value below which it is taken for empty."""
CORE = 128
"""Largest stamp, pixels, on which the variation over the detector is followed."""


@dataclass(frozen=True)
class Grid:
    """Frequencies at which transforms are sampled.

    A stamp of N pixels needs frequencies 2 pi j / N; those of every power-of-two stamp up to `size` lie on the
    grid of the largest, so smaller stamps stride through it.
    """

    size: int
    """Largest stamp, pixels a side, a power of two."""
    folds: int
    """The transforms reach `folds` times the pixel grid's Nyquist frequency."""

    @property
    def shape(self) -> tuple[int, int]:
        """Rows j_y = -folds size / 2 ..., columns j_x = 0 ..., of frequencies 2 pi j / size."""
        return self.folds * self.size, self.folds * self.size // 2 + 1

    def axes(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the frequencies of rows and columns, radians a pixel."""
        rows = 2 * np.pi * np.arange(-self.shape[0] // 2, self.shape[0] // 2) / self.size
        return rows, 2 * np.pi * np.arange(self.shape[1]) / self.size

    def within(self, transforms: np.ndarray, size: int) -> np.ndarray:
        """Return the transforms for stamps of at most `size` pixels."""
        stride = self.size // size
        return transforms[:, ::stride, ::stride]


@dataclass(frozen=True)
class Variation:
    """How the PSF at each node differs from that in the middle of the detector, at the places of `place_grid`.

    Between the places it is the polynomial of their degree through all of them.
    """

    shape: tuple[int, int]
    """Detector (ny, nx)."""
    degree: int
    differences: np.ndarray
    """(nodes, places, rows, columns) complex64 on the grid of the core."""


@dataclass(frozen=True)
class BrightPsf:
    """The PSF of the brightest stars, in more detail and further out, in the middle of a detector."""

    least: float
    """Electrons from which on a star is drawn with it."""
    grid: Grid
    nodes: Callable[[], Iterator[np.ndarray]]
    """Returns the transforms (grid.shape), one at a time: they are large."""
    shares: np.ndarray
    """(nodes of the band, nodes of this PSF): how the light of the band's nodes is shared among its own."""


@dataclass(frozen=True, eq=False)
class PsfModel:
    """PSFs, pixel response included, of one detector and band: at the band's nodes, and over the detector."""

    nodes: np.ndarray
    """(nodes, *grid.shape) complex64: in the middle of the detector; 1 at zero frequency."""
    grid: Grid
    core: Grid
    """That of stamps on which the variation over the detector is followed."""
    modes: np.ndarray
    """(modes, *core.shape) complex64: the first has the light, the others none."""
    mixing: np.ndarray
    """(nodes * (1 + places), modes): each sampled PSF, or difference from that in the middle, as a sum of modes."""
    peaks: np.ndarray
    """(modes,) largest surface brightness, 1/pixel, of each."""
    degree: int = 0
    """Of the polynomials in place; 0 for a PSF that is the same everywhere."""
    shape: tuple[int, int] = (1, 1)
    """Detector (ny, nx)."""
    # of each size of stamps once; they go with the model, as a cache of the class would not
    _known: dict[int, Frequencies] = field(default_factory=dict, repr=False)
    _known_wide: dict[int, Frequencies] = field(default_factory=dict, repr=False)

    def weights(self, photons: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Return the modes' weights (n, modes), float32, of light (n, nodes) at places on the detector."""
        parts = [photons]
        if self.degree:
            places = place_weights(x, y, self.shape, self.degree).astype(photons.dtype)
            width = photons.shape[1] * places.shape[1]
            parts.append((photons[:, :, None] * places[:, None, :]).reshape(len(photons), width))
        return (np.concatenate(parts, axis=1) @ self.mixing).astype(np.float32)

    def shifted(self, photons: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Return, as `weights`, only what the PSF at places differs by from that in the middle."""
        return self.weights(photons, x, y) - (photons @ self.mixing[: photons.shape[1]]).astype(np.float32)

    def frequencies(self, stamp: int) -> Frequencies:
        """Return the modes at the frequencies of a stamp of at most core.size pixels."""
        if stamp not in self._known:
            self._known[stamp] = stamp_frequencies(self.modes, self._images, self.core, stamp)
        return self._known[stamp]

    def wide_frequencies(self, stamp: int) -> Frequencies:
        """Return the PSFs of the nodes in the middle of the detector at the frequencies of a larger stamp."""
        if stamp not in self._known_wide:
            self._known_wide[stamp] = self._wide(stamp)
        return self._known_wide[stamp]

    def _wide(self, stamp: int) -> Frequencies:
        fine = np.empty((len(self.nodes), 0, 0), np.float32)
        # a stamp as large as the grid needs no image to cut
        if stamp < self.grid.size:
            fine = np.stack([star_image(node, self.grid, self.grid.folds) for node in self.nodes])
        return stamp_frequencies(self.nodes, fine, self.grid, stamp)

    @cached_property
    def _images(self) -> np.ndarray:
        """The modes as images, sampled finer than pixels by core.folds."""
        return np.stack([star_image(mode, self.core, self.core.folds) for mode in self.modes])

    @cached_property
    def edges(self) -> dict[int, float]:
        """As `edge_brightness`."""
        return edge_brightness(self.nodes[[0, -1]], self.grid)


def stamp_frequencies(transforms: np.ndarray, images: np.ndarray, grid: Grid, stamp: int) -> Frequencies:
    """Return PSFs at the frequencies of a stamp: of their light that which falls on it when they are in its middle.

    A transform sampled at a small stamp's frequencies would fold the light from beyond its edges into it.

    Parameters
    ----------
    transforms : (n, *grid.shape)
    images : (n, folds size, folds size): the same as images, sampled finer than pixels by grid.folds
    """
    stride = grid.size // stamp
    power = np.abs(transforms[:, ::stride, ::stride]).max(axis=0)
    seen = power > FAINTEST * power.max()
    if stride == 1:
        return frequencies(transforms, seen, stamp)
    return frequencies(np.stack([_cut(image, grid.folds, stamp) for image in images]), seen, stamp)


def _cut(image: np.ndarray, folds: int, size: int) -> np.ndarray:
    """Return the transform, on the grid of `size` pixels, of the middle of an image that is finer by `folds`."""
    return np.fft.fftshift(fft.rfft2(fft.ifftshift(_middle(image, folds * size))) / folds**2, axes=0)


def edge_brightness(transforms: np.ndarray, grid: Grid) -> dict[int, float]:
    """Return the largest surface brightness (1/pixel) of a unit star with any of some PSFs at the edge of each stamp.

    Parameters
    ----------
    transforms : (n, *grid.shape): of the first and the last node, say
    """
    found: dict[int, float] = {}
    offset = np.abs(np.arange(grid.size) - grid.size // 2)
    ring = np.maximum(offset[:, None], offset[None, :])
    for transform in transforms:
        image = np.abs(star_image(transform, grid))
        size = 16
        while size <= grid.size:
            # a ring a few pixels wide, for the diffraction rings have nulls
            width = max(size // 16, 2)
            at_edge = image[(ring <= size // 2) & (ring > size // 2 - width)].max()
            found[size] = max(found.get(size, 0.0), float(at_edge))
            size *= 2
    return found


def star_image(transform: np.ndarray, grid: Grid, fine: int = 1) -> np.ndarray:
    """Return the image (size, size) of a unit star centred on the pixel size / 2; sampled finer by `fine` if asked."""
    side = grid.folds * grid.size
    full = fft.fftshift(fft.irfft2(np.fft.ifftshift(transform, axes=0), s=(side, side)))
    # sampling an image finer by `folds` at pixel centres is folding its transform
    return full[:: grid.folds // fine, :: grid.folds // fine] * grid.folds**2


def fine_image(psf: PsfModel, shares: np.ndarray, x: float, y: float, side: int, oversampling: int) -> np.ndarray:
    """Return the image (side * oversampling, square) of a unit star at a place, sampled finer than its pixels.

    Parameters
    ----------
    shares : (nodes,) of the star's light by node; they sum to 1
    side : native pixels that the image covers
    oversampling : samples along a pixel; the star is centred on sample side * oversampling / 2
    """
    shares = np.asarray(shares, float)
    image = _finer(np.tensordot(shares.astype(np.float32), psf.nodes, 1), psf.grid, oversampling)
    image = _middle(image, side * oversampling)
    if psf.degree:
        weights = psf.shifted(shares[None], np.array([x]), np.array([y]))[0]
        change = _finer(np.tensordot(weights, psf.modes, 1), psf.core, oversampling)
        inside = _middle(change, min(len(change), len(image)))
        low = (len(image) - len(inside)) // 2
        image[low : low + len(inside), low : low + len(inside)] += inside
    return image


def _finer(transform: np.ndarray, grid: Grid, oversampling: int) -> np.ndarray:
    """Return the image (grid.size * oversampling, square) of a transform, centred on the sample in the middle."""
    rows, columns = grid.shape
    # frequencies beyond the optics' reach are empty: padded with zeros, or more of them, they make finer samples
    fine = grid.size * oversampling * -(-rows // (grid.size * oversampling))
    padded = np.zeros((fine, fine // 2 + 1), np.complex64)
    padded[fine // 2 - rows // 2 : fine // 2 + rows // 2, :columns] = transform
    image = fft.fftshift(fft.irfft2(np.fft.ifftshift(padded, axes=0), s=(fine, fine))) * (fine / grid.size) ** 2
    step = fine // (grid.size * oversampling)
    return image[::step, ::step]


def _middle(image: np.ndarray, side: int) -> np.ndarray:
    """Return the middle of an image that is centred on the sample in its middle, the same way."""
    low = image.shape[0] // 2 - side // 2
    return image[low : low + side, low : low + side].copy()


def place_grid(shape: tuple[int, int], degree: int) -> np.ndarray:
    """Return the places (n, 2), x and y, 0 at the centre of the first pixel, at which the variation is sampled.

    They are the Padua points, (degree + 1) (degree + 2) / 2 of them, through which polynomials of that total degree in
    the plane are interpolated best (Caliari, De Marchi & Vianello 2005).
    """
    points = [
        (np.cos(j * np.pi / degree), np.cos(k * np.pi / (degree + 1)))
        for j in range(degree + 1)
        for k in range(degree + 2)
        if (j + k) % 2 == 0
    ]
    return (np.array(points) + 1) / 2 * shape[::-1] - 0.5


def place_weights(x: np.ndarray, y: np.ndarray, shape: tuple[int, int], degree: int) -> np.ndarray:
    """Return the weights (n, places) of the places of `place_grid`; an object off the detector is as at its edge."""
    known = _polynomials(*place_grid(shape, degree).T, shape, degree)
    return _polynomials(np.asarray(x, float), np.asarray(y, float), shape, degree) @ np.linalg.inv(known)


def _polynomials(x: np.ndarray, y: np.ndarray, shape: tuple[int, int], degree: int) -> np.ndarray:
    across, up = (
        chebvander(np.clip(2 * (value + 0.5) / side - 1, -1, 1), degree)
        for value, side in zip((x, y), shape[::-1], strict=True)
    )
    return np.stack([across[:, i] * up[:, j] for i in range(degree + 1) for j in range(degree + 1 - i)], axis=1)


def sample(profile: galsim.GSObject, pixel_scale: float, grid: Grid, diffusion: float = 0.0) -> np.ndarray:
    """Return the transform (grid.shape), complex64, of a profile (arcsec) convolved with the response of a pixel.

    Parameters
    ----------
    diffusion : sigma, pixels, of the Gaussian by which charge diffuses before it is collected; 0 for none
    """
    rows, columns = grid.shape
    # half the plane is enough, which GalSim's underscored method, alone, can draw
    bounds = galsim.BoundsI(0, columns - 2, -rows // 2, rows // 2 - 1)
    image = galsim.ImageCF(bounds, scale=2 * np.pi / (grid.size * pixel_scale))
    profile._drawKImage(image)
    out = np.zeros(grid.shape, np.complex64)
    # the last column, half the sampling frequency of the folded grid, is beyond every profile's reach
    np.multiply(image.array, response_of(grid, diffusion)[:, :-1], out=out[:, :-1])
    out[0] = 0
    return out


def response_of(grid: Grid, diffusion: float) -> np.ndarray:
    """Return the transform of a square pixel and of the diffusion of charge."""
    up, across = (np.sinc(axis / (2 * np.pi)) * np.exp(-((axis * diffusion) ** 2) / 2) for axis in grid.axes())
    return (up[:, None] * across[None, :]).astype(np.float32)


def folds_of(profiles: list[galsim.GSObject], pixel_scale: float) -> int:
    """Return how many times the Nyquist frequency of the pixels the transforms of profiles reach."""
    reach = max(profile.maxk for profile in profiles) * pixel_scale
    return int(np.clip(np.ceil(reach / np.pi), 1, 4))


def sample_model(profiles: list[galsim.GSObject], pixel_scale: float, size: int, diffusion: float = 0.0) -> PsfModel:
    """Return the model of PSF profiles (arcsec, in the frame of the pixels), one a node, the same everywhere.

    Parameters
    ----------
    profiles : unit-flux GalSim profiles, one a node
    pixel_scale : arcsec
    size : largest stamp, pixels a side, a power of two
    diffusion : sigma of charge diffusion, pixels
    """
    grid = Grid(size, folds_of(profiles, pixel_scale))
    return model(np.stack([sample(profile, pixel_scale, grid, diffusion) for profile in profiles]), grid)


def model(nodes: np.ndarray, grid: Grid, variation: Variation | None = None) -> PsfModel:
    """Return the model of sampled PSFs: their mean and the principal modes of what they differ by."""
    core = Grid(min(grid.size, CORE), grid.folds)
    centre = grid.within(nodes, core.size)
    if core.size < grid.size:
        # the light beyond the core's edges would be folded into it
        power = np.abs(centre).max(axis=0)
        seen = power > FAINTEST * power.max()
        centre = np.stack([_cut(star_image(node, grid, grid.folds), grid.folds, core.size) * seen for node in nodes])
    mean = centre.mean(axis=0)
    rest = (centre - mean).reshape(len(nodes), -1)
    if variation is not None:
        rest = np.concatenate([rest, variation.differences.reshape(-1, rest.shape[1])])
    # columns but the first stand for two frequencies each
    weight = np.full(core.shape, 2.0, np.float32)
    weight[:, 0] = 1.0
    gram = ((rest * weight.ravel()) @ rest.conj().T).real
    power, vectors = np.linalg.eigh(gram.astype(float))
    strongest = np.argsort(power)[::-1]
    strongest = strongest[power[strongest] > 1e-12 * power.max(initial=1e-30)]
    modes = (vectors[:, strongest].T.astype(np.float32) @ rest).reshape(-1, *core.shape)
    peaks = np.array([np.abs(star_image(mode, core, core.folds)).max() for mode in modes])
    largest = peaks * np.abs(vectors[:, strongest]).max(axis=0, initial=0.0)
    kept = largest > _NEGLIGIBLE
    mixing = vectors[:, strongest][:, kept]
    light = np.zeros((len(rest), 1))
    light[: len(nodes)] = 1.0
    return PsfModel(
        nodes,
        grid,
        core,
        np.concatenate([mean[None], modes[kept]]).astype(np.complex64),
        np.concatenate([light, mixing], axis=1).astype(np.float32),
        np.concatenate([[np.abs(star_image(mean, core, core.folds)).max()], peaks[kept]]),
        variation.degree if variation is not None else 0,
        variation.shape if variation is not None else (1, 1),
    )
