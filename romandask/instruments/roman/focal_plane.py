"""Geometry of Roman's focal plane: positions of the 18 SCAs on the sky, vectorised over visits.

GalSim's WCS has no aberration of starlight and does not depend on the date. The header of an SCA is therefore a
constant distortion, rotated and shifted to a position that depends on the visit. The rotation is not exactly that of a
rigid body. GalSim derives the position angle of an SCA from a point one degree north of it on the tangent plane of the
whole focal plane, which moves the corners by some milliarcseconds with the roll. This module repeats each step, so that
its headers agree with those of GalSim.
"""

from __future__ import annotations

from functools import lru_cache

import galsim
import galsim.roman
import numpy as np
from numpy.typing import ArrayLike

from romandask.instruments.exposure import footprint
from romandask.model.sky import radec, unit_vectors

SCAS = tuple(range(1, galsim.roman.n_sca + 1))
"""Numbers of the SCAs, 1 to 18."""
_WCS_KEYS = ("CTYPE", "CUNIT", "CRPIX", "CRVAL", "CD", "A_", "B_", "LONPOLE", "EQUINOX")


def axes(ra: ArrayLike, dec: ArrayLike) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return unit vectors (..., 3) to positions in degrees, and to the east and to the north at these positions."""
    a, d = np.radians(np.broadcast_arrays(ra, dec))
    east = np.stack([-np.sin(a), np.cos(a), np.zeros_like(a)], axis=-1)
    north = np.stack([-np.sin(d) * np.cos(a), -np.sin(d) * np.sin(a), np.cos(d)], axis=-1)
    return unit_vectors(ra, dec), east, north


def move(
    ra: ArrayLike, dec: ArrayLike, pa: ArrayLike, x: ArrayLike, y: ArrayLike
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the position of the focal plane after an offset along its own axes.

    The position angle is parallel-transported along the great circle, so that neighbouring positions keep their offsets
    relative to each other at any declination.

    Parameters
    ----------
    ra, dec, pa : array-like, degrees
        Position of the centre of the focal plane, and its position angle.
    x, y : array-like, degrees
        Gnomonic offset; at position angle 0, x is to the west and y to the north.

    Returns
    -------
    ra, dec, pa : ndarray, degrees
    """
    centre, east, north = axes(ra, dec)
    angle, x, y = np.radians(pa)[..., None], np.radians(x)[..., None], np.radians(y)[..., None]
    # unit vectors along the axes of the focal plane
    y_axis, x_axis = north * np.cos(angle) + east * np.sin(angle), north * np.sin(angle) - east * np.cos(angle)
    target = centre + x * x_axis + y * y_axis
    target /= np.linalg.norm(target, axis=-1, keepdims=True)
    transport = (target * y_axis).sum(-1, keepdims=True) / (1 + (target * centre).sum(-1, keepdims=True))
    y_axis = y_axis - transport * (target + centre)
    new_ra, new_dec = radec(target)
    _, east, north = axes(new_ra, new_dec)
    return new_ra, new_dec, np.degrees(np.arctan2((y_axis * east).sum(-1), (y_axis * north).sum(-1))) % 360


def separations(
    ra: ArrayLike, dec: ArrayLike, pa: ArrayLike, other_ra: ArrayLike, other_dec: ArrayLike
) -> tuple[np.ndarray, np.ndarray]:
    """Return the gnomonic offsets of other positions along the axes of focal planes; the inverse of `move`.

    Parameters
    ----------
    ra, dec, pa : array-like, degrees
        Position of the centre of the focal plane, and its position angle.
    other_ra, other_dec : array-like, degrees
        Other positions.

    Returns
    -------
    x, y : ndarray, degrees
    """
    centre, east, north = axes(ra, dec)
    other = unit_vectors(other_ra, other_dec)
    cos_distance = (other * centre).sum(-1)
    xi, eta = ((other * axis).sum(-1) / cos_distance for axis in (east, north))
    angle = np.radians(pa)
    x, y = eta * np.sin(angle) - xi * np.cos(angle), xi * np.sin(angle) + eta * np.cos(angle)
    return np.degrees(x), np.degrees(y)


def header_of(sca: int, ra: float, dec: float, pa: float) -> dict:
    """Return the TAN-SIP header of an SCA of a visit.

    Parameters
    ----------
    sca : int
        Number of the SCA.
    ra, dec, pa : float, degrees
        Position of the centre of the focal plane, and its position angle.
    """
    template = _reference_headers()[sca]
    crval_ra, crval_dec, rotation = _reference_pixels(np.array([ra]), np.array([dec]), np.array([pa]), (sca,))
    c, s = np.cos(rotation[0, 0]), np.sin(rotation[0, 0])
    unrotated = np.array([[template["CD1_1"], template["CD1_2"]], [template["CD2_1"], template["CD2_2"]]])
    cd = np.array([[c, s], [-s, c]]) @ unrotated
    values = {"CRVAL1": crval_ra[0, 0], "CRVAL2": crval_dec[0, 0]}
    values |= {f"CD{i + 1}_{j + 1}": cd[i, j] for i in range(2) for j in range(2)}
    return template | {key: float(value) for key, value in values.items()}


def corners(ra: ArrayLike, dec: ArrayLike, pa: ArrayLike, shape: tuple[int, int]) -> np.ndarray:
    """Return the corners of all SCAs of n visits on the sky.

    Parameters
    ----------
    ra, dec, pa : array-like, shape (n,), degrees
        Positions of the centre of the focal plane, and its position angles.
    shape : tuple of int
        Shape of an SCA (ny, nx), pixels.

    Returns
    -------
    ndarray, shape (n, 18, 4, 2), degrees
        Right ascension and declination, in the order of `exposure.footprint`.
    """
    ra, dec, pa = (np.asarray(values, dtype=float) for values in (ra, dec, pa))
    crval_ra, crval_dec, rotation = _reference_pixels(ra, dec, pa, SCAS)
    plane = _plane_corners(shape)
    c, s = np.cos(rotation)[..., None], np.sin(rotation)[..., None]
    xi, eta = c * plane[..., 0] + s * plane[..., 1], c * plane[..., 1] - s * plane[..., 0]
    centre, east, north = (axis[:, :, None, :] for axis in axes(crval_ra, crval_dec))
    return np.stack(radec(centre + xi[..., None] * east + eta[..., None] * north), axis=-1)


def _reference_pixels(
    ra: np.ndarray, dec: np.ndarray, pa: np.ndarray, scas: tuple[int, ...]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return positions of the reference pixels of m SCAs in n visits, and position angles of the SCAs.

    Parameters
    ----------
    ra, dec, pa : ndarray, shape (n,), degrees
        Positions of the centre of the focal plane, and its position angles.
    scas : tuple of int
        Numbers of the SCAs.

    Returns
    -------
    crval_ra, crval_dec : ndarray, shape (n, m), degrees
    rotation : ndarray, shape (n, m), radians
    """
    u, v = _reference_offsets()[[SCAS.index(sca) for sca in scas]].T
    angle = np.radians(pa)[:, None]
    west, up = u * np.cos(angle) - v * np.sin(angle), u * np.sin(angle) + v * np.cos(angle)
    centre, east, north = (axis[:, None, :] for axis in axes(ra, dec))
    reference = centre - west[..., None] * east + up[..., None] * north
    crval_ra, crval_dec = radec(reference)
    # as in GalSim: the direction from the reference pixel to the point one degree north of it on the tangent plane
    _, own_east, own_north = axes(crval_ra, crval_dec)
    above = reference + np.radians(1.0) * north
    bearing = np.arctan2((above * own_east).sum(-1), (above * own_north).sum(-1))
    return crval_ra, crval_dec, angle + bearing


@lru_cache(maxsize=1)
def _reference_headers() -> dict[int, dict]:
    """Return GalSim's headers of all SCAs of a visit at ra 90, dec 0 and pa 0, where the SCAs are not rotated."""
    target = galsim.CelestialCoord(90 * galsim.degrees, 0 * galsim.degrees)
    # without a date GalSim assumes the vernal equinox, when the Sun is at ra 0, so that ra 90 is allowed
    wcs_of_scas = galsim.roman.getWCS(target, PA=0 * galsim.degrees, PA_is_FPA=True)
    return {sca: _header(wcs) for sca, wcs in wcs_of_scas.items()}


def _header(wcs: galsim.BaseWCS) -> dict:
    """Return the FITS header of a WCS of GalSim, without keys that are not part of the WCS."""
    full = galsim.FitsHeader()
    wcs.writeToFitsHeader(full, galsim.BoundsI(1, galsim.roman.n_pix, 1, galsim.roman.n_pix))
    return {key: full[key] for key in full.keys() if key.startswith(_WCS_KEYS)} | {"RADESYS": "ICRS"}  # noqa: SIM118


@lru_cache(maxsize=1)
def _reference_offsets() -> np.ndarray:
    """Return the offsets (18, 2) of the reference pixels from the centre, to the west and north at pa 0, radians."""
    headers = [_reference_headers()[sca] for sca in SCAS]
    ra, dec = (np.array([header[key] for header in headers]) for key in ("CRVAL1", "CRVAL2"))
    return np.radians(np.stack(separations(90.0, 0.0, 0.0, ra, dec), axis=1))


@lru_cache(maxsize=4)
def _plane_corners(shape: tuple[int, int]) -> np.ndarray:
    """Return the offsets (18, 4, 2) of the corners of unrotated SCAs from their reference pixels.

    Offsets are to the east and to the north on the tangent plane, radians.
    """
    offsets = []
    for header in (_reference_headers()[sca] for sca in SCAS):
        sky = footprint(header, shape)
        west, up = separations(header["CRVAL1"], header["CRVAL2"], 0.0, sky[:, 0], sky[:, 1])
        offsets.append(np.stack([-west, up], axis=1))
    return np.radians(offsets)
