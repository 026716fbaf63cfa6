"""Sums in elliptical apertures from which neighbours are taken out, as Source Extractor's MASK_TYPE CORRECT does it.

A pixel of another object's isophote, or without data, is given the value of the pixel opposite, as seen from the
object's centre; where that one is another's too, nothing.
"""

from __future__ import annotations

import numba
import numpy as np

MASKED, TRUNCATED, ALL_MASKED = 0x0020, 0x0010, 0x0040
"""Flags, those of sep: pixels without data, an aperture beyond the image, an aperture without any data."""
_FINE = 5
"""Places along a pixel at the aperture's edge at which it is asked whether it is inside."""


@numba.njit(nogil=True, cache=True, error_model="numpy")
def ellipse(a, b, theta):
    """Return the coefficients of x^2, y^2 and xy of an ellipse of radius 1: (cxx, cyy, cxy)."""
    c, s = np.cos(theta), np.sin(theta)
    aa, bb = 1 / (a * a), 1 / (b * b)
    return c * c * aa + s * s * bb, s * s * aa + c * c * bb, 2 * c * s * (aa - bb)


@numba.njit(nogil=True, cache=True, error_model="numpy")
def _clean(image, mask, segments, label, px, py, x, y):
    """Return whether a pixel has a value that is the object's or the sky's, and where: there, or opposite."""
    other = segments[py, px] != 0 and segments[py, px] != label
    if not other and not mask[py, px]:
        return True, px, py
    qx, qy = int(np.floor(2 * x - px + 0.5)), int(np.floor(2 * y - py + 0.5))
    if qx < 0 or qy < 0 or qx >= image.shape[1] or qy >= image.shape[0] or mask[qy, qx]:
        return False, px, py
    return segments[qy, qx] == 0 or segments[qy, qx] == label, qx, qy


@numba.njit(nogil=True, cache=True, error_model="numpy")
def kron_radii(image, mask, segments, label, x, y, a, b, theta, reach):
    """Return the first moment (n,) of the light's elliptical radius, in units of the semi-axes, within `reach` of them.

    NaN where there is no light (Kron 1980; FLUX_AUTO of Source Extractor has 2.5 times this).
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
                good, qx, qy = _clean(image, mask, segments, label[n], px, py, x[n], y[n])
                if good:
                    total += image[qy, qx]
                    first += np.sqrt(square) * image[qy, qx]
        if total > 0 and first > 0:
            out[n] = first / total
    return out


@numba.njit(nogil=True, cache=True, error_model="numpy")
def _inside(cxx, cyy, cxy, dx, dy, square):
    """Return the share of a pixel that lies in an ellipse."""
    middle = cxx * dx * dx + cyy * dy * dy + cxy * dx * dy
    # a pixel is within 0.71 of its centre, over which the radius changes by less than this
    change = 0.72 * np.sqrt(max(cxx, cyy) + abs(cxy))
    radius, limit = np.sqrt(middle), np.sqrt(square)
    if radius + change < limit:
        return 1.0
    if radius - change > limit:
        return 0.0
    count = 0
    for j in range(_FINE):
        v = dy + (j + 0.5) / _FINE - 0.5
        for i in range(_FINE):
            u = dx + (i + 0.5) / _FINE - 0.5
            count += cxx * u * u + cyy * v * v + cxy * u * v <= square
    return count / (_FINE * _FINE)


@numba.njit(nogil=True, cache=True, error_model="numpy")
def sums(image, error, mask, segments, label, x, y, a, b, theta, radius):
    """Return flux, rms of white noise and flags (n,) of ellipses of `radius` times the semi-axes.

    Parameters
    ----------
    image, error, mask : (ny, nx)
    segments : (ny, nx) number of the object in whose isophote a pixel lies, 0 for none
    label : (n,) number of each object there
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
                share = _inside(cxx, cyy, cxy, px - x[n], py - y[n], radius[n] * radius[n])
                if share == 0:
                    continue
                if mask[py, px]:
                    flags[n] |= MASKED
                else:
                    data = True
                good, qx, qy = _clean(image, mask, segments, label[n], px, py, x[n], y[n])
                if good:
                    flux[n] += share * image[qy, qx]
                    noise[n] += share * error[qy, qx] ** 2
        if not data:
            flags[n] |= ALL_MASKED
        noise[n] = np.sqrt(noise[n])
    return flux, noise, flags


@numba.njit(nogil=True, cache=True, error_model="numpy")
def blendedness(image, mask, segments, label, x, y, x2, y2, xy):
    """Return the share (n,) of the light at each object that is its neighbours': 1 - child / parent.

    Both are sums under a Gaussian of the object's second moments, the parent's of the image as it is, the child's with
    neighbours taken out (Bosch et al. 2018 have it of absolute values). NaN where there is no light.
    """
    out = np.full(len(x), np.nan)
    ny, nx = image.shape
    for n in range(len(x)):
        # a pixel's own width keeps the moments of a line of pixels positive
        xx, yy, both = x2[n] + 1 / 12, y2[n] + 1 / 12, xy[n]
        determinant = xx * yy - both * both
        if not determinant > 0:
            continue
        half = 3 * np.sqrt(max(xx, yy)) + 1
        parent, child = 0.0, 0.0
        for py in range(max(0, int(y[n] - half)), min(ny, int(y[n] + half) + 2)):
            for px in range(max(0, int(x[n] - half)), min(nx, int(x[n] + half) + 2)):
                dx, dy = px - x[n], py - y[n]
                square = (yy * dx * dx + xx * dy * dy - 2 * both * dx * dy) / determinant
                if square > 9 or mask[py, px]:
                    continue
                weight = np.exp(-square / 2)
                parent += weight * image[py, px]
                good, qx, qy = _clean(image, mask, segments, label[n], px, py, x[n], y[n])
                if good:
                    child += weight * image[qy, qx]
        if parent > 0:
            out[n] = min(max(1 - child / parent, 0.0), 1.0)
    return out
