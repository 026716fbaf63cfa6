"""A sharp image blurred to match another, finer or coarser one, and subtracted from it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy import fft, ndimage

from romandask.kernels.coadding.pixel_map import PixelMap
from romandask.kernels.measurement.convolve import convolve

WIDTHS = (0.8, 1.6, 3.2)
"""Sigma, pixels, of the Gaussians by which the matching kernel may be wider or narrower."""
STRETCHES = (1.2, 2.4)
"""Sigma, pixels, of those by which it may be longer one way than the other."""
DEGREE = 2
"""Of the polynomials in place of each."""
HALF = 12
"""Half the side of the stamps around objects, pixels."""
ROUNDS = 3
"""In which the worst tenth of the stamps is left out."""


def matching_kernel(sharp: np.ndarray, sharp_scale: float, blunt: np.ndarray, blunt_scale: float) -> np.ndarray:
    """Return the kernel (n, n), on the sharp image's pixels, that turns one PSF into the other.

    Parameters
    ----------
    sharp, blunt : unit stars, centred on the pixel in the middle, each the share of light in a pixel of its image
    sharp_scale, blunt_scale : arcsec a pixel
    """
    ratio = sharp_scale / blunt_scale
    side = int(blunt.shape[0] / ratio) | 1
    offset = np.arange(side) - side // 2
    middle = blunt.shape[0] // 2
    there = np.meshgrid(offset * ratio + middle, offset * ratio + middle, indexing="ij")
    wanted = ndimage.map_coordinates(blunt.astype(float), there, order=5) * ratio**2
    given = np.zeros((side, side))
    cut = min(side, sharp.shape[0])
    low, inner = (side - cut) // 2, (sharp.shape[0] - cut) // 2
    given[low : low + cut, low : low + cut] = sharp[inner : inner + cut, inner : inner + cut]
    n = fft.next_fast_len(2 * side)
    frequency = np.hypot(fft.fftfreq(n)[:, None], fft.rfftfreq(n)[None, :])
    a, b = (fft.rfft2(fft.ifftshift(_padded(image, n))) for image in (given, wanted))
    # beyond its own pixels' limit the blunt image has nothing
    quotient = np.where(frequency < ratio / 2, b * a.conj() / np.maximum(np.abs(a) ** 2, 1e-6), 0)
    whole = fft.fftshift(fft.irfft2(quotient, s=(n, n)))
    low = n // 2 - side // 2
    return whole[low : low + side, low : low + side]


def _padded(image: np.ndarray, n: int) -> np.ndarray:
    """Return an odd image in a larger one whose middle is n / 2."""
    out = np.zeros((n, n))
    low = n // 2 - image.shape[0] // 2
    out[low : low + image.shape[0], low : low + image.shape[0]] = image
    return out


def blurred(
    read: Callable[[slice, slice], np.ndarray], shape: tuple[int, int], kernel: np.ndarray, onto: PixelMap, area: float
) -> np.ndarray:
    """Return a part of a target's pixels, made of a sharp image that is convolved and interpolated there.

    Parameters
    ----------
    read : gives some rows and columns of the sharp image, (ny, nx) flux of a pixel
    shape : of the sharp image
    onto : the map from the target's pixels to those of the sharp image
    area : of a target's pixel over a sharp one
    """
    places = onto.dense()
    reach = kernel.shape[0] // 2 + 4
    window = tuple(
        slice(int(max(places[..., k].min() - reach, 0)), int(min(places[..., k].max() + reach, side)))
        for k, side in ((1, shape[0]), (0, shape[1]))
    )
    part = convolve(read(*window), kernel.astype(np.float32))
    at = places[..., 1] - window[0].start, places[..., 0] - window[1].start
    return (ndimage.map_coordinates(part, at, order=3, mode="nearest") * area).astype(np.float32)


@dataclass(frozen=True)
class Matched:
    """How an image is made of a template: the template and what it is convolved with, and a smooth background."""

    coefficients: np.ndarray
    """(terms, polynomials): of each basis kernel in place; the first is the template itself."""
    background: np.ndarray
    """(polynomials,)"""
    shape: tuple[int, int]

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
    """Return the sum of `polynomials` with some coefficients over an image, float32."""
    up, across = (np.vander(2 * (np.arange(n) + 0.5) / n - 1, DEGREE + 1, increasing=True) for n in shape)
    powers = [(j, i) for i in range(DEGREE + 1) for j in range(DEGREE + 1 - i)]
    matrix = np.zeros((DEGREE + 1, DEGREE + 1))
    for value, power in zip(values, powers, strict=True):
        matrix[power] = value
    return (up @ matrix).astype(np.float32) @ across.T.astype(np.float32)


def polynomials(y: np.ndarray, x: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Return polynomials (n, ...) in place, each from -1 to 1 over an image."""
    v, u = 2 * (np.asarray(y) + 0.5) / shape[0] - 1, 2 * (np.asarray(x) + 0.5) / shape[1] - 1
    return np.stack([u**i * v**j for i in range(DEGREE + 1) for j in range(DEGREE + 1 - i)])


def basis_kernels() -> list[np.ndarray | None]:
    """Return the kernels that a template is convolved with: None for itself, and even ones without light.

    None is odd: no shift is fitted, so that where two images are not registered their difference shows it.
    """
    found: list[np.ndarray | None] = [None]
    for sigma in WIDTHS:
        wide = _gaussian(sigma)
        wide[wide.shape[0] // 2, wide.shape[0] // 2] -= 1
        found.append(wide)
    for sigma in STRETCHES:
        gaussian = _gaussian(sigma)
        offset = np.arange(len(gaussian)) - len(gaussian) // 2
        y, x = np.meshgrid(offset, offset, indexing="ij")
        found += [gaussian * (x**2 - y**2) / sigma**2, gaussian * x * y / sigma**2]
    return found


def _gaussian(sigma: float) -> np.ndarray:
    half = int(np.ceil(4.5 * sigma))
    offset = np.arange(-half, half + 1)
    image = np.exp(-(offset[:, None] ** 2 + offset**2) / (2 * sigma**2))
    return image / image.sum()


def convolved(image: np.ndarray, kernel: np.ndarray | None) -> np.ndarray:
    """Return an image convolved with a kernel; None for as it is."""
    return image if kernel is None else convolve(image, kernel.astype(np.float32))


def match(image: np.ndarray, template: np.ndarray, error: np.ndarray, x: np.ndarray, y: np.ndarray) -> Matched:
    """Return how an image is best made of a template, by least squares on stamps around some objects.

    The basis is that of Alard & Lupton (1998), of even kernels alone. Each object may be brighter or fainter than in
    the template, for its colour: only what is the same in most of them counts.

    Parameters
    ----------
    image, template, error : (ny, nx): flux of a pixel and its rms; a pixel whose error is 0 is not used
    x, y : (n,) of bright objects, pixels
    """
    kernels = basis_kernels()
    layers = [convolved(template, kernel) for kernel in kernels]
    stamps = [_stamp(image, layers, error, int(round(v)), int(round(u))) for u, v in zip(x, y, strict=True)]
    stamps = [stamp for stamp in stamps if stamp is not None]
    count = len(polynomials(0, 0, image.shape))
    if not stamps:
        coefficients = np.zeros((len(kernels), count))
        coefficients[0, 0] = 1.0
        return Matched(coefficients, np.zeros(count), image.shape)
    solution = np.zeros(len(kernels) * count)
    for _ in range(ROUNDS):
        designs = [_design(stamp, image.shape) for stamp in stamps]
        normal = sum(design.T @ (design * weight[:, None]) for design, _, weight in designs)
        right = sum(design.T @ (weight * data) for design, data, weight in designs)
        solution = np.linalg.solve(normal + 1e-9 * np.trace(normal) / len(normal) * np.eye(len(normal)), right)
        misfit = [np.mean(weight * (data - design @ solution) ** 2) for design, data, weight in designs]
        limit = np.percentile(misfit, 90)
        kept = [stamp for stamp, value in zip(stamps, misfit, strict=True) if value <= limit]
        if len(kept) < 2 * count:
            break
        stamps = kept
    coefficients = solution[: len(kernels) * count].reshape(len(kernels), count)
    return Matched(coefficients, solution[len(kernels) * count :], image.shape)


@dataclass(frozen=True)
class _Stamp:
    """An object on image and layers, scaled to the template's flux."""

    data: np.ndarray
    layers: np.ndarray
    """(layers, pixels)"""
    weight: np.ndarray
    scale: float
    y: np.ndarray
    x: np.ndarray


def _stamp(image: np.ndarray, layers: list[np.ndarray], error: np.ndarray, row: int, column: int) -> _Stamp | None:
    if not (HALF <= row < image.shape[0] - HALF and HALF <= column < image.shape[1] - HALF):
        return None
    part = slice(row - HALF, row + HALF + 1), slice(column - HALF, column + HALF + 1)
    if not (error[part] > 0).all():
        return None
    data, own = image[part].ravel().astype(float), layers[0][part].ravel().astype(float)
    weight = error[part].ravel() ** -2.0
    # a level of its own beside its flux, for the fit of the scale alone
    design = np.stack([own, np.ones_like(own)], axis=1)
    scale = float(np.linalg.lstsq(design * np.sqrt(weight)[:, None], data * np.sqrt(weight), rcond=None)[0][0])
    if not scale > 0.2:
        return None
    y, x = (place.ravel() for place in np.mgrid[part])
    return _Stamp(data, np.stack([layer[part].ravel() for layer in layers]), weight, scale, y, x)


def _design(stamp: _Stamp, shape: tuple[int, int]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the equations of a stamp: (pixels, unknowns), data and weights."""
    place = polynomials(stamp.y, stamp.x, shape)
    columns = (stamp.layers[:, None, :] * place[None, :, :]).reshape(-1, len(stamp.data))
    return np.concatenate([columns, place / stamp.scale]).T, stamp.data / stamp.scale, stamp.weight * stamp.scale**2


def dipoles(
    difference: np.ndarray, template: np.ndarray, error: np.ndarray, x: np.ndarray, y: np.ndarray
) -> np.ndarray:
    """Return what is left of objects in a difference, (n, 6): share of their light, shifts in x and y, errors.

    By a fit of the template, its gradients and a level to a stamp. A shift (pixels) is by how much the object would be
    off its place in the template; NaN where a stamp has pixels without data.

    Parameters
    ----------
    difference, template, error : (ny, nx): the template is the matched one; a pixel whose error is 0 has no data
    """
    found = np.full((len(x), 6), np.nan)
    for n, (column, row) in enumerate(zip(np.rint(x).astype(int), np.rint(y).astype(int), strict=True)):
        inside = HALF < row < difference.shape[0] - HALF - 1 and HALF < column < difference.shape[1] - HALF - 1
        part = slice(row - HALF - 1, row + HALF + 2), slice(column - HALF - 1, column + HALF + 2)
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
        found[n, :3], found[n, 3:] = solution[:3], np.sqrt(np.diag(covariance)[:3])
    return found
