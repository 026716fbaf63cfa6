"""Roman's focal plane: where its 18 SCAs fall on the sky, for any number of visits at once.

GalSim's WCS has no aberration and nothing that depends on the date: the header of an SCA is a constant distortion,
turned and put at a place that follow from the visit. The turn is not quite that of a rigid body: GalSim takes the
position angle of an SCA from a point one degree north of it on the tangent plane of the whole focal plane, which moves
corners by some milliarcseconds with the roll. It is repeated here step by step, so that headers are GalSim's own.
"""

from __future__ import annotations

from functools import lru_cache

import galsim
import galsim.roman
import numpy as np

from romandask.instruments.exposure import footprint
from romandask.model.sky import radec, unit_vectors

SCAS = tuple(range(1, galsim.roman.n_sca + 1))
_WANTED = ("CTYPE", "CUNIT", "CRPIX", "CRVAL", "CD", "A_", "B_", "LONPOLE", "EQUINOX")


def axes(ra, dec) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the unit vectors (..., 3) of positions in degrees, and those to the east and to the north of them."""
    a, d = np.radians(np.broadcast_arrays(ra, dec))
    east = np.stack([-np.sin(a), np.cos(a), np.zeros_like(a)], axis=-1)
    north = np.stack([-np.sin(d) * np.cos(a), -np.sin(d) * np.sin(a), np.cos(d)], axis=-1)
    return unit_vectors(ra, dec), east, north


def move(ra, dec, pa, x, y) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return where the focal plane's centre comes to (ra, dec, pa; degrees) by gnomonic offsets along its own axes.

    x (degrees) runs to the west and y to the north at position angle 0. The position angle is transported in parallel
    along the great circle, so that neighbours keep their places relative to each other wherever they are.
    """
    centre, east, north = axes(ra, dec)
    angle, x, y = np.radians(pa)[..., None], np.radians(x)[..., None], np.radians(y)[..., None]
    up, side = north * np.cos(angle) + east * np.sin(angle), north * np.sin(angle) - east * np.cos(angle)
    there = centre + x * side + y * up
    there /= np.linalg.norm(there, axis=-1, keepdims=True)
    up = up - (there * up).sum(-1, keepdims=True) / (1 + (there * centre).sum(-1, keepdims=True)) * (there + centre)
    new_ra, new_dec = radec(there)
    _, east, north = axes(new_ra, new_dec)
    return new_ra, new_dec, np.degrees(np.arctan2((up * east).sum(-1), (up * north).sum(-1))) % 360


def separations(ra, dec, pa, other_ra, other_dec) -> tuple[np.ndarray, np.ndarray]:
    """Return the gnomonic offsets (x, y; degrees) of other positions along the axes of focal planes: undoes `move`."""
    centre, east, north = axes(ra, dec)
    there = unit_vectors(other_ra, other_dec)
    distance = (there * centre).sum(-1)
    xi, eta = ((there * axis).sum(-1) / distance for axis in (east, north))
    angle = np.radians(pa)
    x, y = eta * np.sin(angle) - xi * np.cos(angle), xi * np.sin(angle) + eta * np.cos(angle)
    return np.degrees(x), np.degrees(y)


def header_of(sca: int, ra: float, dec: float, pa: float) -> dict:
    """Return the TAN-SIP header of an SCA of a visit at a position and position angle of the focal plane, degrees."""
    template = _reference()[sca]
    crval_ra, crval_dec, turn = _places(np.array([ra]), np.array([dec]), np.array([pa]), (sca,))
    c, s = np.cos(turn[0, 0]), np.sin(turn[0, 0])
    unturned = np.array([[template["CD1_1"], template["CD1_2"]], [template["CD2_1"], template["CD2_2"]]])
    cd = np.array([[c, s], [-s, c]]) @ unturned
    values = {"CRVAL1": crval_ra[0, 0], "CRVAL2": crval_dec[0, 0]}
    values |= {f"CD{i + 1}_{j + 1}": cd[i, j] for i in range(2) for j in range(2)}
    return template | {key: float(value) for key, value in values.items()}


def corners(ra, dec, pa, shape: tuple[int, int]) -> np.ndarray:
    """Return the corners (n, 18, 4, 2), degrees, of all SCAs (images of `shape`) of n visits; order as `footprint`."""
    ra, dec, pa = (np.asarray(values, dtype=float) for values in (ra, dec, pa))
    crval_ra, crval_dec, turn = _places(ra, dec, pa, SCAS)
    plane = _plane_corners(shape)
    c, s = np.cos(turn)[..., None], np.sin(turn)[..., None]
    xi, eta = c * plane[..., 0] + s * plane[..., 1], c * plane[..., 1] - s * plane[..., 0]
    centre, east, north = (axis[:, :, None, :] for axis in axes(crval_ra, crval_dec))
    return np.stack(radec(centre + xi[..., None] * east + eta[..., None] * north), axis=-1)


def _places(ra: np.ndarray, dec: np.ndarray, pa: np.ndarray, scas: tuple[int, ...]) -> tuple[np.ndarray, ...]:
    """Return where SCAs are (n, m): ra and dec of their reference pixels (degrees), position angles (radians)."""
    u, v = _reference_offsets()[[SCAS.index(sca) for sca in scas]].T
    angle = np.radians(pa)[:, None]
    west, up = u * np.cos(angle) - v * np.sin(angle), u * np.sin(angle) + v * np.cos(angle)
    centre, east, north = (axis[:, None, :] for axis in axes(ra, dec))
    place = centre - west[..., None] * east + up[..., None] * north
    crval_ra, crval_dec = radec(place)
    # GalSim: the direction, seen from the reference pixel, of the point one degree up on the tangent plane
    _, its_east, its_north = axes(crval_ra, crval_dec)
    above = place + np.radians(1.0) * north
    bearing = np.arctan2((above * its_east).sum(-1), (above * its_north).sum(-1))
    return crval_ra, crval_dec, angle + bearing


@lru_cache(maxsize=1)
def _reference() -> dict[int, dict]:
    """Return GalSim's headers of all SCAs of one visit at dec 0 and pa 0, where none of them is turned."""
    target = galsim.CelestialCoord(90 * galsim.degrees, 0 * galsim.degrees)
    # without a date GalSim takes the vernal equinox, when the Sun is at ra 0
    every = galsim.roman.getWCS(target, PA=0 * galsim.degrees, PA_is_FPA=True)
    return {sca: _header(wcs) for sca, wcs in every.items()}


def _header(wcs: galsim.BaseWCS) -> dict:
    full = galsim.FitsHeader()
    wcs.writeToFitsHeader(full, galsim.BoundsI(1, galsim.roman.n_pix, 1, galsim.roman.n_pix))
    return {key: full[key] for key in full.keys() if key.startswith(_WANTED)} | {"RADESYS": "ICRS"}  # noqa: SIM118


@lru_cache(maxsize=1)
def _reference_offsets() -> np.ndarray:
    """Return the reference pixels (18, 2) of the SCAs on the tangent plane, to the west and up at pa 0; radians."""
    headers = [_reference()[sca] for sca in SCAS]
    ra, dec = (np.array([header[key] for header in headers]) for key in ("CRVAL1", "CRVAL2"))
    return np.radians(np.stack(separations(90.0, 0.0, 0.0, ra, dec), axis=1))


@lru_cache(maxsize=4)
def _plane_corners(shape: tuple[int, int]) -> np.ndarray:
    """Return the corners (18, 4, 2) of unturned SCAs, radians to the east and north about their reference pixels."""
    found = []
    for header in (_reference()[sca] for sca in SCAS):
        sky = footprint(header, shape)
        west, up = separations(header["CRVAL1"], header["CRVAL2"], 0.0, sky[:, 0], sky[:, 1])
        found.append(np.stack([-west, up], axis=1))
    return np.radians(found)
