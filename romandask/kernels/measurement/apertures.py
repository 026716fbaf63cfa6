"""Sums in elliptical apertures with neighbours replaced, as Source Extractor does with MASK_TYPE CORRECT.

A pixel without data, or in the isophote of another object, is replaced by the pixel opposite the object's centre. If
that pixel is unusable too, neither is summed.
"""

from __future__ import annotations

import numba
import numpy as np

MASKED, TRUNCATED, ALL_MASKED = 0x0020, 0x0010, 0x0040
"""Flags, with the values of sep: pixels without data, an aperture beyond the image, an aperture without any data."""
_SUBPIXELS = 5
"""Subpixels along a side of a pixel at the edge of an aperture."""


@numba.njit(nogil=True, cache=True, error_model="numpy")
def ellipse(a, b, theta):
    """Return the coefficients (cxx, cyy, cxy) of x^2, y^2 and xy of an ellipse.

    Parameters
    ----------
    a, b : float, pixels
        Semi-axes.
    theta : float, radians
        Angle of the major axis from the x axis.
    """
    c, s = np.cos(theta), np.sin(theta)
    aa, bb = 1 / (a * a), 1 / (b * b)
    return c * c * aa + s * s * bb, s * s * aa + c * c * bb, 2 * c * s * (aa - bb)


@numba.njit(nogil=True, cache=True, error_model="numpy")
def _usable_pixel(image, mask, segments, label, px, py, x, y):
    """Return whether a pixel can be summed, and x and y of the pixel whose value counts: itself or the opposite one."""
    other = segments[py, px] != 0 and segments[py, px] != label
    if not other and not mask[py, px]:
        return True, px, py
    qx, qy = int(np.floor(2 * x - px + 0.5)), int(np.floor(2 * y - py + 0.5))
    if qx < 0 or qy < 0 or qx >= image.shape[1] or qy >= image.shape[0] or mask[qy, qx]:
        return False, px, py
    return segments[qy, qx] == 0 or segments[qy, qx] == label, qx, qy


@numba.njit(nogil=True, cache=True, error_model="numpy")
def kron_radii(image, mask, segments, label, x, y, a, b, theta, reach):
    """Return the Kron radii of objects: the first moments of the elliptical radius of their light.

    Source Extractor's FLUX_AUTO uses 2.5 times this radius (Kron 1980).

    Parameters
    ----------
    image, mask : ndarray, shape (ny, nx)
        Flux of a pixel, and True for no data.
    segments : ndarray, shape (ny, nx)
        Number of the object in whose isophote a pixel lies, 0 for none.
    label : ndarray, shape (n,)
        Number of each object in `segments`.
    x, y, a, b : ndarray, shape (n,), pixels
        Centres and semi-axes.
    theta : ndarray, shape (n,), radians
    reach : float, semi-axes
        Elliptical radius within which the moment is taken.

    Returns
    -------
    ndarray, shape (n,), semi-axes
        NaN where there is no light.
    """
    out = np.full(len(x), np.nan)
    ny, nx = image.shape
    for n in range(len(x)):
        cxx, cyy, cxy = ellipse(a[n], b[n], theta[n])
        half = reach * a[n] + 1
        total, first = 0.0, 0.0
        for py in range(max(0, int(y[n] - half)), min(ny, int(y[n] + half) + 2)):
            for px in range(max(0, int(x[n] - half)), min(nx, int(x[n] + half) + 2)):
                dx, dy = px - x[n], py - y[n]
                square = cxx * dx * dx + cyy * dy * dy + cxy * dx * dy
                if square > reach * reach:
                    continue
                good, qx, qy = _usable_pixel(image, mask, segments, label[n], px, py, x[n], y[n])
                if good:
                    total += image[qy, qx]
                    first += np.sqrt(square) * image[qy, qx]
        if total > 0 and first > 0:
            out[n] = first / total
    return out


@numba.njit(nogil=True, cache=True, error_model="numpy")
def _pixel_share(cxx, cyy, cxy, dx, dy, square):
    """Return the share of a pixel, at (dx, dy) from the centre, that lies in an ellipse of squared radius `square`."""
    middle = cxx * dx * dx + cyy * dy * dy + cxy * dx * dy
    # upper limit to the change of the radius from the centre of a pixel to its corners, 0.71 pixels away
    change = 0.72 * np.sqrt(max(cxx, cyy) + abs(cxy))
    radius, limit = np.sqrt(middle), np.sqrt(square)
    if radius + change < limit:
        return 1.0
    if radius - change > limit:
        return 0.0
    count = 0
    for j in range(_SUBPIXELS):
        v = dy + (j + 0.5) / _SUBPIXELS - 0.5
        for i in range(_SUBPIXELS):
            u = dx + (i + 0.5) / _SUBPIXELS - 0.5
            count += cxx * u * u + cyy * v * v + cxy * u * v <= square
    return count / (_SUBPIXELS * _SUBPIXELS)


@numba.njit(nogil=True, cache=True, error_model="numpy")
def aperture_sums(image, error, mask, segments, label, x, y, a, b, theta, radius):
    """Return the fluxes of objects in elliptical apertures, with neighbours replaced.

    Parameters
    ----------
    image, error, mask : ndarray, shape (ny, nx)
        Flux of a pixel, its rms, and True for no data.
    segments, label, x, y, a, b, theta
        As in `kron_radii`.
    radius : ndarray, shape (n,), semi-axes
        Elliptical radius of each aperture.

    Returns
    -------
    flux : ndarray, shape (n,)
    noise : ndarray, shape (n,)
        Rms of the flux if the noise is white.
    flags : ndarray, shape (n,), int32
    """
    flux, noise, flags = np.zeros(len(x)), np.zeros(len(x)), np.zeros(len(x), np.int32)
    ny, nx = image.shape
    for n in range(len(x)):
        cxx, cyy, cxy = ellipse(a[n], b[n], theta[n])
        half = radius[n] * max(a[n], b[n]) + 1
        if x[n] - half < -1 or y[n] - half < -1 or x[n] + half > nx or y[n] + half > ny:
            flags[n] |= TRUNCATED
        data = False
        for py in range(max(0, int(y[n] - half)), min(ny, int(y[n] + half) + 2)):
            for px in range(max(0, int(x[n] - half)), min(nx, int(x[n] + half) + 2)):
                share = _pixel_share(cxx, cyy, cxy, px - x[n], py - y[n], radius[n] * radius[n])
                if share == 0:
                    continue
                if mask[py, px]:
                    flags[n] |= MASKED
                else:
                    data = True
                good, qx, qy = _usable_pixel(image, mask, segments, label[n], px, py, x[n], y[n])
                if good:
                    flux[n] += share * image[qy, qx]
                    noise[n] += share * error[qy, qx] ** 2
        if not data:
            flags[n] |= ALL_MASKED
        noise[n] = np.sqrt(noise[n])
    return flux, noise, flags


@numba.njit(nogil=True, cache=True, error_model="numpy")
def blendedness(image, mask, segments, label, x, y, x2, y2, xy):
    """Return the share of the light at each object that belongs to its neighbours: 1 - child / parent.

    Child and parent are sums weighted with a Gaussian that has the object's second moments. The parent is summed over
    the image itself, the child with neighbours replaced. Bosch et al. (2018) use absolute values.

    Parameters
    ----------
    image, mask, segments, label, x, y
        As in `kron_radii`.
    x2, y2, xy : ndarray, shape (n,), pixels^2
        Second moments.

    Returns
    -------
    ndarray, shape (n,)
        0 to 1; NaN where there is no light.
    """
    out = np.full(len(x), np.nan)
    ny, nx = image.shape
    for n in range(len(x)):
        # adding the variance of a pixel keeps the moments of a line of pixels positive
        xx, yy, cross = x2[n] + 1 / 12, y2[n] + 1 / 12, xy[n]
        determinant = xx * yy - cross * cross
        if not determinant > 0:
            continue
        half = 3 * np.sqrt(max(xx, yy)) + 1
        parent, child = 0.0, 0.0
        for py in range(max(0, int(y[n] - half)), min(ny, int(y[n] + half) + 2)):
            for px in range(max(0, int(x[n] - half)), min(nx, int(x[n] + half) + 2)):
                dx, dy = px - x[n], py - y[n]
                square = (yy * dx * dx + xx * dy * dy - 2 * cross * dx * dy) / determinant
                if square > 9 or mask[py, px]:
                    continue
                weight = np.exp(-square / 2)
                parent += weight * image[py, px]
                good, qx, qy = _usable_pixel(image, mask, segments, label[n], px, py, x[n], y[n])
                if good:
                    child += weight * image[qy, qx]
        if parent > 0:
            out[n] = min(max(1 - child / parent, 0.0), 1.0)
    return out
