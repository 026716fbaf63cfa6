"""Image differences: a sharp image is blurred to the PSF of another image, matched to it and subtracted."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy import fft, ndimage

from romandask.kernels.coadding.pixel_map import PixelMap
from romandask.kernels.measurement.convolve import convolve

WIDTH_SIGMAS = (0.8, 1.6, 3.2)
"""Sigmas of the Gaussians that make the matching kernel wider or narrower, pixels."""
STRETCH_SIGMAS = (1.2, 2.4)
"""Sigmas of the Gaussians that make the matching kernel elongated, pixels."""
DEGREE = 2
"""Degree of the polynomials with which each term varies over the image."""
STAMP_HALF_WIDTH = 12
"""Half the width of the stamps around objects, pixels."""
CLIPPING_ROUNDS = 3
"""Number of fits, after each of which the worst tenth of the stamps is left out."""


def matching_kernel(sharp: np.ndarray, sharp_scale: float, blunt: np.ndarray, blunt_scale: float) -> np.ndarray:
    """Return the kernel that turns the sharp PSF into the blunt one.

    Parameters
    ----------
    sharp, blunt : ndarray, shape (odd, odd)
        PSFs of unit flux, centred on the middle pixel: the share of the light in each pixel of the two images.
    sharp_scale, blunt_scale : float, arcsec per pixel

    Returns
    -------
    ndarray, shape (n, n)
        The kernel on pixels of the sharp image.
    """
    ratio = sharp_scale / blunt_scale
    side = int(blunt.shape[0] / ratio) | 1
    offset = np.arange(side) - side // 2
    middle = blunt.shape[0] // 2
    positions = np.meshgrid(offset * ratio + middle, offset * ratio + middle, indexing="ij")
    target_psf = ndimage.map_coordinates(blunt.astype(float), positions, order=5) * ratio**2
    source_psf = np.zeros((side, side))
    cut = min(side, sharp.shape[0])
    low, inner = (side - cut) // 2, (sharp.shape[0] - cut) // 2
    source_psf[low : low + cut, low : low + cut] = sharp[inner : inner + cut, inner : inner + cut]
    n = fft.next_fast_len(2 * side)
    frequency = np.hypot(fft.fftfreq(n)[:, None], fft.rfftfreq(n)[None, :])
    a, b = (fft.rfft2(fft.ifftshift(_padded(image, n))) for image in (source_psf, target_psf))
    # the blunt image has no information beyond its Nyquist frequency
    quotient = np.where(frequency < ratio / 2, b * a.conj() / np.maximum(np.abs(a) ** 2, 1e-6), 0)
    kernel = fft.fftshift(fft.irfft2(quotient, s=(n, n)))
    low = n // 2 - side // 2
    return kernel[low : low + side, low : low + side]


def _padded(image: np.ndarray, n: int) -> np.ndarray:
    """Return an image of odd side, padded with zeros to (n, n), with its middle pixel at n // 2."""
    out = np.zeros((n, n))
    low = n // 2 - image.shape[0] // 2
    out[low : low + image.shape[0], low : low + image.shape[0]] = image
    return out


def blurred(
    read: Callable[[slice, slice], np.ndarray], shape: tuple[int, int], kernel: np.ndarray, onto: PixelMap, area: float
) -> np.ndarray:
    """Convolve a sharp image with a kernel and interpolate it at some pixels of a target image.

    Parameters
    ----------
    read : callable
        Returns some rows and columns of the sharp image, flux of a pixel.
    shape : tuple of int
        Rows and columns of the sharp image.
    kernel : ndarray, shape (n, n)
        Kernel on pixels of the sharp image.
    onto : PixelMap
        Map from the pixels of the target to those of the sharp image.
    area : float
        Area of a target pixel over that of a sharp one.

    Returns
    -------
    ndarray, shape of `onto`, float32
        Flux of a target pixel.
    """
    positions = onto.dense()
    reach = kernel.shape[0] // 2 + 4
    window = tuple(
        slice(int(max(positions[..., k].min() - reach, 0)), int(min(positions[..., k].max() + reach, length)))
        for k, length in ((1, shape[0]), (0, shape[1]))
    )
    part = convolve(read(*window), kernel.astype(np.float32))
    part_positions = positions[..., 1] - window[0].start, positions[..., 0] - window[1].start
    return (ndimage.map_coordinates(part, part_positions, order=3, mode="nearest") * area).astype(np.float32)


@dataclass(frozen=True)
class Matched:
    """Fit of a template to an image: kernel coefficients and a smooth background, both polynomials in position."""

    coefficients: np.ndarray
    """Polynomial coefficients of each basis kernel, (kernels, polynomials); the first kernel leaves the template as it
    is."""
    background: np.ndarray
    """Polynomial coefficients of the background, (polynomials,)."""
    shape: tuple[int, int]
    """Rows and columns of the image."""

    def image(self, template: np.ndarray) -> np.ndarray:
        """Return the matched template (ny, nx), without background."""
        total = np.zeros(self.shape, np.float32)
        for kernel, values in zip(basis_kernels(), self.coefficients, strict=True):
            total += surface(values, self.shape) * convolved(template, kernel)
        return total

    def sky(self) -> np.ndarray:
        """Return the background (ny, nx)."""
        return surface(self.background, self.shape)


def surface(values: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Return a polynomial over an image.

    Parameters
    ----------
    values : ndarray, shape (polynomials,)
        Coefficients of the terms of `polynomials`.
    shape : tuple of int
        Rows and columns of the image.

    Returns
    -------
    ndarray, shape (ny, nx), float32
    """
    up, across = (np.vander(2 * (np.arange(n) + 0.5) / n - 1, DEGREE + 1, increasing=True) for n in shape)
    powers = [(j, i) for i in range(DEGREE + 1) for j in range(DEGREE + 1 - i)]
    matrix = np.zeros((DEGREE + 1, DEGREE + 1))
    for value, power in zip(values, powers, strict=True):
        matrix[power] = value
    return (up @ matrix).astype(np.float32) @ across.T.astype(np.float32)


def polynomials(y: ArrayLike, x: ArrayLike, shape: tuple[int, int]) -> np.ndarray:
    """Return the terms of a polynomial in position, with coordinates that run from -1 to 1 over an image.

    Parameters
    ----------
    y, x : array-like, shape (...), pixels
    shape : tuple of int
        Rows and columns of the image.

    Returns
    -------
    ndarray, shape (polynomials, ...)
    """
    v, u = 2 * (np.asarray(y) + 0.5) / shape[0] - 1, 2 * (np.asarray(x) + 0.5) / shape[1] - 1
    return np.stack([u**i * v**j for i in range(DEGREE + 1) for j in range(DEGREE + 1 - i)])


def basis_kernels() -> list[np.ndarray | None]:
    """Return the basis kernels: None for no convolution, then even kernels with a sum of 0.

    No kernel is odd, so no shift is fitted: the difference shows where two images are not registered.
    """
    kernels: list[np.ndarray | None] = [None]
    for sigma in WIDTH_SIGMAS:
        wide = _gaussian(sigma)
        wide[wide.shape[0] // 2, wide.shape[0] // 2] -= 1
        kernels.append(wide)
    for sigma in STRETCH_SIGMAS:
        gaussian = _gaussian(sigma)
        offset = np.arange(len(gaussian)) - len(gaussian) // 2
        y, x = np.meshgrid(offset, offset, indexing="ij")
        kernels += [gaussian * (x**2 - y**2) / sigma**2, gaussian * x * y / sigma**2]
    return kernels


def _gaussian(sigma: float) -> np.ndarray:
    half = int(np.ceil(4.5 * sigma))
    offset = np.arange(-half, half + 1)
    image = np.exp(-(offset[:, None] ** 2 + offset**2) / (2 * sigma**2))
    return image / image.sum()


def convolved(image: np.ndarray, kernel: np.ndarray | None) -> np.ndarray:
    """Return an image convolved with a kernel, or the image itself if the kernel is None."""
    return image if kernel is None else convolve(image, kernel.astype(np.float32))


def match(image: np.ndarray, template: np.ndarray, error: np.ndarray, x: np.ndarray, y: np.ndarray) -> Matched:
    """Fit a template to an image by least squares on stamps around some objects.

    The basis is that of Alard & Lupton (1998), restricted to even kernels. The flux of each object over that in the
    template depends on its colour. Each stamp is therefore scaled to the flux in the template, and the fit describes
    what most objects have in common.

    Parameters
    ----------
    image, template, error : ndarray, shape (ny, nx)
        Flux of a pixel in the image and in the template, and rms of the image. Pixels with an error of 0 are not used.
    x, y : ndarray, shape (n,), pixels
        Positions of bright objects.

    Returns
    -------
    Matched
        The template unchanged, without background, if no stamp can be used.
    """
    kernels = basis_kernels()
    basis = [convolved(template, kernel) for kernel in kernels]
    candidates = (_stamp(image, basis, error, int(round(v)), int(round(u))) for u, v in zip(x, y, strict=True))
    stamps = [stamp for stamp in candidates if stamp is not None]
    terms = len(polynomials(0, 0, image.shape))
    if not stamps:
        coefficients = np.zeros((len(kernels), terms))
        coefficients[0, 0] = 1.0
        return Matched(coefficients, np.zeros(terms), image.shape)
    solution = np.zeros(len(kernels) * terms)
    for _ in range(CLIPPING_ROUNDS):
        designs = [_design(stamp, image.shape) for stamp in stamps]
        normal = sum(design.T @ (design * weight[:, None]) for design, _, weight in designs)
        right = sum(design.T @ (weight * data) for design, data, weight in designs)
        solution = np.linalg.solve(normal + 1e-9 * np.trace(normal) / len(normal) * np.eye(len(normal)), right)
        misfit = [np.mean(weight * (data - design @ solution) ** 2) for design, data, weight in designs]
        limit = np.percentile(misfit, 90)
        kept = [stamp for stamp, value in zip(stamps, misfit, strict=True) if value <= limit]
        if len(kept) < 2 * terms:
            break
        stamps = kept
    coefficients = solution[: len(kernels) * terms].reshape(len(kernels), terms)
    return Matched(coefficients, solution[len(kernels) * terms :], image.shape)


@dataclass(frozen=True, kw_only=True)
class _Stamp:
    """Flattened stamp around an object."""

    data: np.ndarray
    """Pixels of the image, (pixels,)."""
    basis: np.ndarray
    """Pixels of the template convolved with each basis kernel, (kernels, pixels)."""
    weight: np.ndarray
    """Inverse variance, (pixels,)."""
    scale: float
    """Flux of the object over its flux in the template."""
    y: np.ndarray
    """Rows of the pixels, (pixels,)."""
    x: np.ndarray
    """Columns of the pixels, (pixels,)."""


def _stamp(image: np.ndarray, basis: list[np.ndarray], error: np.ndarray, row: int, column: int) -> _Stamp | None:
    """Return the stamp around a pixel; None at the edge, where pixels have no data, or for a scale of at most 0.2."""
    if not (
        STAMP_HALF_WIDTH <= row < image.shape[0] - STAMP_HALF_WIDTH
        and STAMP_HALF_WIDTH <= column < image.shape[1] - STAMP_HALF_WIDTH
    ):
        return None
    part = (
        slice(row - STAMP_HALF_WIDTH, row + STAMP_HALF_WIDTH + 1),
        slice(column - STAMP_HALF_WIDTH, column + STAMP_HALF_WIDTH + 1),
    )
    if not (error[part] > 0).all():
        return None
    data, unconvolved = image[part].ravel().astype(float), basis[0][part].ravel().astype(float)
    weight = error[part].ravel() ** -2.0
    # the scale is fitted together with a background level of the stamp, which is then discarded
    design = np.stack([unconvolved, np.ones_like(unconvolved)], axis=1)
    scale = float(np.linalg.lstsq(design * np.sqrt(weight)[:, None], data * np.sqrt(weight), rcond=None)[0][0])
    if not scale > 0.2:
        return None
    y, x = (positions.ravel() for positions in np.mgrid[part])
    return _Stamp(
        data=data, basis=np.stack([plane[part].ravel() for plane in basis]), weight=weight, scale=scale, y=y, x=x
    )


def _design(stamp: _Stamp, shape: tuple[int, int]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the design matrix (pixels, unknowns), the data and the weights of a stamp, scaled to the template."""
    terms = polynomials(stamp.y, stamp.x, shape)
    columns = (stamp.basis[:, None, :] * terms[None, :, :]).reshape(-1, len(stamp.data))
    return np.concatenate([columns, terms / stamp.scale]).T, stamp.data / stamp.scale, stamp.weight * stamp.scale**2


def dipoles(
    difference: np.ndarray, template: np.ndarray, error: np.ndarray, x: np.ndarray, y: np.ndarray
) -> np.ndarray:
    """Fit the residuals of objects in a difference: the share of their flux that is left, and their shift.

    The template, its gradients in x and y, and a constant are fitted to a stamp around each object.

    Parameters
    ----------
    difference, template, error : ndarray, shape (ny, nx)
        Difference, matched template, and rms of the difference; 0 for pixels without data.
    x, y : ndarray, shape (n,), pixels
        Positions of the objects.

    Returns
    -------
    ndarray, shape (n, 6)
        Share of the flux, shifts in x and y (pixels), and the errors of the three. A shift is the offset of the object
        from its position in the template. NaN where the stamp is not inside the image or has pixels without data.
    """
    residuals = np.full((len(x), 6), np.nan)
    for n, (column, row) in enumerate(zip(np.rint(x).astype(int), np.rint(y).astype(int), strict=True)):
        inside = (
            STAMP_HALF_WIDTH < row < difference.shape[0] - STAMP_HALF_WIDTH - 1
            and STAMP_HALF_WIDTH < column < difference.shape[1] - STAMP_HALF_WIDTH - 1
        )
        part = (
            slice(row - STAMP_HALF_WIDTH - 1, row + STAMP_HALF_WIDTH + 2),
            slice(column - STAMP_HALF_WIDTH - 1, column + STAMP_HALF_WIDTH + 2),
        )
        if not inside or not (error[part] > 0).all():
            continue
        model = template[part].astype(float)
        up, across = np.gradient(model)
        inner = slice(1, -1), slice(1, -1)
        columns = [model[inner].ravel(), -across[inner].ravel(), -up[inner].ravel(), np.ones(model[inner].size)]
        design = np.stack(columns, axis=1)
        weight = 1 / error[part][inner].ravel().astype(float)
        covariance = np.linalg.pinv((design * weight[:, None]).T @ (design * weight[:, None]))
        solution = covariance @ (design.T @ (difference[part][inner].ravel() * weight**2))
        residuals[n, :3], residuals[n, 3:] = solution[:3], np.sqrt(np.diag(covariance)[:3])
    return residuals
