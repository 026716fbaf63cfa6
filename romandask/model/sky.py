"""Geometry on the sphere: unit vectors, convex polygons, the survey's region and HEALPix cells that cover it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import astropy.units as u
import cdshealpix.nested as healpix
import numpy as np
from astropy.coordinates import Latitude, Longitude
from scipy.spatial import cKDTree

from romandask.model.errors import UserError

ARCSEC = np.pi / 180 / 3600
"""One arcsecond in radians."""
MOST_CELLS = 1_000_000
"""HEALPix cells of a region, and so partitions of a catalog: each is planned by itself."""
_PAIRS = 200_000
"""Pairs of polygons that are compared at a time: some tens of megabytes."""
_FOOTPRINTS = 20_000
"""Footprints that positions are compared with at a time."""


def unit_vectors(ra, dec) -> np.ndarray:
    """Return unit vectors (..., 3) of positions in degrees."""
    ra, dec = np.radians(ra), np.radians(dec)
    return np.stack([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)], axis=-1)


def radec(vectors) -> tuple[np.ndarray, np.ndarray]:
    """Return right ascension in [0, 360) and declination, degrees, of vectors (..., 3)."""
    x, y, z = np.moveaxis(np.asarray(vectors), -1, 0)
    return np.degrees(np.arctan2(y, x)) % 360, np.degrees(np.arctan2(z, np.hypot(x, y)))


def chord(angle: float) -> float:
    """Return the chord, on the unit sphere, of an angle in arcsec: 2 sin(theta / 2)."""
    return 2 * np.sin(angle * ARCSEC / 2)


def from_tangent_plane(ra: float, dec: float, xi, eta) -> tuple[np.ndarray, np.ndarray]:
    """Deproject gnomonic offsets (east, north; degrees) about a centre to right ascension and declination."""
    xi, eta = np.radians(xi), np.radians(eta)
    a, d = np.radians(ra), np.radians(dec)
    centre = np.array([np.cos(d) * np.cos(a), np.cos(d) * np.sin(a), np.sin(d)])
    east = np.array([-np.sin(a), np.cos(a), 0.0])
    north = np.array([-np.sin(d) * np.cos(a), -np.sin(d) * np.sin(a), np.cos(d)])
    return radec(centre + np.multiply.outer(xi, east) + np.multiply.outer(eta, north))


def touching_pairs(first: np.ndarray, second: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the index pairs of convex spherical polygons that overlap.

    Parameters
    ----------
    first, second : arrays (n, k, 2) and (m, l, 2) of corners, right ascension and declination in degrees,
        in order along the boundary, each polygon smaller than a hemisphere.

    Two convex polygons are disjoint if and only if the great circle of some edge of one has the whole other
    polygon on its outer side: exact at RA 0 and at the poles.
    """
    a, b = unit_vectors(first[..., 0], first[..., 1]), unit_vectors(second[..., 0], second[..., 1])
    if len(a) == 0 or len(b) == 0:
        return np.empty(0, int), np.empty(0, int)
    centre_a, radius_a = _caps(a)
    centre_b, radius_b = _caps(b)
    near = cKDTree(centre_a).sparse_distance_matrix(
        cKDTree(centre_b), radius_a.max() + radius_b.max() + 1e-12, output_type="ndarray"
    )
    i, j = near["i"], near["j"]
    keep = near["v"] <= radius_a[i] + radius_b[j] + 1e-12
    i, j = i[keep], j[keep]
    touching = np.ones(len(i), bool)
    for start in range(0, len(i), _PAIRS):
        part = slice(start, start + _PAIRS)
        touching[part] = ~(_outside(a[i[part]], b[j[part]]) | _outside(b[j[part]], a[i[part]]))
    i, j = i[touching], j[touching]
    order = np.lexsort((j, i))
    return i[order], j[order]


def covering_sums(footprints: np.ndarray, ra, dec, weights: np.ndarray | None = None) -> np.ndarray:
    """Return, for positions in degrees, the sum of the weights (n,), or the number, of the footprints over them.

    Footprints are those of `covering_pairs`.
    """
    ra, dec = np.broadcast_arrays(np.asarray(ra, float), np.asarray(dec, float))
    share = np.ones(len(footprints)) if weights is None else np.asarray(weights, float)
    sums = np.zeros(ra.size)
    for which, point in _covering(footprints, ra.ravel(), dec.ravel()):
        sums += np.bincount(point, weights=share[which], minlength=ra.size)
    return sums.reshape(ra.shape)


def covering_pairs(footprints: np.ndarray, ra, dec, margin: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Return the index pairs (footprint, position) of positions in degrees that lie in footprints, sorted.

    Footprints (n, 4, 2), degrees, are convex and much smaller than the sky; edges are arcs of great circles, and
    positions up to `margin` arcsec outside an edge count as inside.
    """
    parts = [np.stack(pair) for pair in _covering(footprints, np.asarray(ra, float), np.asarray(dec, float), margin)]
    which, point = np.concatenate([np.empty((2, 0), int), *parts], axis=1)
    order = np.lexsort((point, which))
    return which[order], point[order]


def _covering(
    footprints: np.ndarray, ra: np.ndarray, dec: np.ndarray, margin: float = 0.0
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield the pairs of `covering_pairs`, some thousands of footprints at a time."""
    points = unit_vectors(ra, dec)
    tree = cKDTree(points) if len(points) else None
    for start in range(0, len(footprints) if tree is not None else 0, _FOOTPRINTS):
        corners = unit_vectors(*np.moveaxis(footprints[start : start + _FOOTPRINTS], -1, 0))
        middle, radius = _caps(corners)
        reach = radius.max() + chord(1.0 + margin)
        near = cKDTree(middle).sparse_distance_matrix(tree, reach, output_type="ndarray")
        which, point = near["i"], near["j"]
        normals = np.cross(corners, np.roll(corners, -1, axis=1))
        normals *= np.sign(np.einsum("nkc,nc->nk", normals, middle))[..., None]
        normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
        inside = (np.einsum("pkc,pc->pk", normals[which], points[point]) >= -margin * ARCSEC).all(axis=1)
        yield which[inside] + start, point[inside]


def _caps(corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    centre = corners.sum(axis=1)
    centre /= np.linalg.norm(centre, axis=1, keepdims=True)
    return centre, np.linalg.norm(corners - centre[:, None], axis=2).max(axis=1)


def _outside(polygons: np.ndarray, others: np.ndarray) -> np.ndarray:
    """True where an edge of polygons[n] separates it from others[n]."""
    normals = np.cross(polygons, np.roll(polygons, -1, axis=1))
    inward = np.sign(np.einsum("nkc,nc->nk", normals, polygons.sum(axis=1)))
    return (np.einsum("nkc,nlc->nkl", normals * inward[..., None], others) < 0).all(axis=2).any(axis=1)


@dataclass(frozen=True)
class Region:
    """A box in right ascension and declination; it may cross RA 0 (then ra_min > ra_max)."""

    ra_min: float
    """degrees"""
    ra_max: float
    """degrees"""
    dec_min: float
    """degrees"""
    dec_max: float
    """degrees"""

    @property
    def width(self) -> float:
        """Extent in right ascension, degrees of RA."""
        return (self.ra_max - self.ra_min) % 360 or 360.0

    @property
    def centre(self) -> tuple[float, float]:
        """Right ascension and declination of the middle, degrees."""
        return (self.ra_min + self.width / 2) % 360, (self.dec_min + self.dec_max) / 2

    @property
    def area(self) -> float:
        """True solid angle, square arcminutes."""
        heights = np.sin(np.radians(self.dec_max)) - np.sin(np.radians(self.dec_min))
        return float(np.radians(self.width) * heights * (180 * 60 / np.pi) ** 2)

    def contains(self, ra, dec, margin: float = 0.0) -> np.ndarray:
        """True where a position lies inside the box grown by `margin` arcsec; the upper edges are outside.

        Without a margin the lower edges are inside and the upper ones outside, so boxes that meet share nothing.
        """
        low, high = self.dec_min - margin / 3600, self.dec_max + margin / 3600
        limit = min(max(abs(low), abs(high)), 89.0)
        grow = margin / 3600 / np.cos(np.radians(limit))
        offset = (np.asarray(ra) - self.ra_min + grow) % 360
        return (offset < min(self.width + 2 * grow, 360.0)) & (np.asarray(dec) >= low) & (np.asarray(dec) < high)

    def cells(self, order: int, margin: float = 0.0) -> np.ndarray:
        """Return the HEALPix cells (nested, `order`) that may touch the box grown by `margin` arcsec, sorted.

        Raises
        ------
        UserError
            Where they would be more than MOST_CELLS.
        """
        if self.area > MOST_CELLS * cell_area(order):
            raise UserError(
                f"region has {self.area / cell_area(order):.3g} HEALPix cells of order {order}, "
                f"at most {MOST_CELLS} can be planned: lower truth.order, detections.order and matches.order, or make "
                "the region smaller"
            )
        ra, dec = self.centre
        # the furthest point from the centre lies on the edge; points along it are at most 1/64 of it apart
        along = np.linspace(0, 1, 65)
        edge_ra = self.ra_min + self.width * np.concatenate([along, along, along * 0, along * 0 + 1])
        height = self.dec_min + (self.dec_max - self.dec_min) * along
        edge_dec = np.concatenate([along * 0 + self.dec_min, along * 0 + self.dec_max, height, height])
        furthest = (unit_vectors(edge_ra, edge_dec) @ unit_vectors(ra, dec)).min()
        radius = np.arccos(np.clip(furthest, -1, 1)) + (margin + 1) * ARCSEC
        radius += np.radians(max(self.width, self.dec_max - self.dec_min)) / 128
        cells = cells_in_cone(ra, dec, np.degrees(radius), order)
        lon, lat = healpix.healpix_to_lonlat(cells, order)
        reach = 1.2 * np.degrees(np.sqrt(4 * np.pi / (12 * 4**order))) * 3600
        inside = self.contains(lon.to_value("deg"), lat.to_value("deg"), margin + reach)
        return np.sort(cells[inside].astype(np.int64))


@dataclass(frozen=True)
class Cone:
    """All positions within an angle of one."""

    ra: float
    """degrees"""
    dec: float
    """degrees"""
    radius: float
    """arcsec"""

    def contains(self, ra, dec) -> np.ndarray:
        """True where a position (degrees) lies inside or on the edge."""
        gap = np.linalg.norm(unit_vectors(ra, dec) - unit_vectors(self.ra, self.dec), axis=-1)
        return gap <= chord(self.radius)

    def cells(self, order: int) -> np.ndarray:
        """Return the HEALPix cells (nested, `order`) that may touch the cone, sorted."""
        return cells_in_cone(self.ra, self.dec, self.radius / 3600, order)


def cells_in_cone(ra: float, dec: float, radius: float, order: int) -> np.ndarray:
    """Return the HEALPix cells (nested) that may touch a cone; all angles in degrees."""
    lon, lat = Longitude(ra * u.deg), Latitude(dec * u.deg)
    cells, _, _ = healpix.cone_search(lon, lat, min(radius, 180.0) * u.deg, order, flat=True)
    return np.sort(np.asarray(cells, dtype=np.int64))


def cell_of(ra, dec, order: int) -> np.ndarray:
    """Return the HEALPix cell (nested, `order`) of positions in degrees."""
    lon, lat = Longitude(np.atleast_1d(ra) * u.deg), Latitude(np.atleast_1d(dec) * u.deg)
    return healpix.lonlat_to_healpix(lon, lat, order).astype(np.int64)


def cell_area(order: int) -> float:
    """Return the area of a HEALPix cell, square arcminutes."""
    return 4 * np.pi * (180 * 60 / np.pi) ** 2 / (12 * 4**order)


def displaced(ra, dec, angle, bearing) -> tuple[np.ndarray, np.ndarray]:
    """Return positions (degrees) an `angle` away along a great circle that leaves at `bearing`, both radians."""
    a, d = np.radians(ra), np.radians(dec)
    height = np.sin(d) * np.cos(angle) + np.cos(d) * np.sin(angle) * np.cos(bearing)
    east = np.sin(bearing) * np.sin(angle) * np.cos(d)
    turn = np.arctan2(east, np.cos(angle) - np.sin(d) * height)
    return np.degrees(a + turn) % 360, np.degrees(np.arcsin(np.clip(height, -1, 1)))
