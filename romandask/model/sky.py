"""Spherical geometry: unit vectors, convex polygons, the regions of a survey and the HEALPix cells that cover them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import astropy.units as u
import cdshealpix.nested as healpix
import numpy as np
from astropy.coordinates import Latitude, Longitude
from numpy.typing import ArrayLike
from scipy.spatial import cKDTree

from romandask.model.errors import UserError

ARCSEC = np.pi / 180 / 3600
"""One arcsecond in radians."""
MAX_CELLS = 1_000_000
"""Largest number of HEALPix cells of a region; each cell is a catalog partition, which is planned separately."""
_PAIRS_PER_BATCH = 200_000
"""Number of polygon pairs that are compared at a time; takes some tens of megabytes."""
_FOOTPRINTS_PER_BATCH = 20_000
"""Number of footprints that positions are compared with at a time."""


def unit_vectors(ra: ArrayLike, dec: ArrayLike) -> np.ndarray:
    """Return unit vectors (..., 3) of positions in degrees."""
    ra, dec = np.radians(ra), np.radians(dec)
    return np.stack([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)], axis=-1)


def radec(vectors: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    """Return right ascension in [0, 360) and declination, degrees, of vectors (..., 3)."""
    x, y, z = np.moveaxis(np.asarray(vectors), -1, 0)
    return np.degrees(np.arctan2(y, x)) % 360, np.degrees(np.arctan2(z, np.hypot(x, y)))


def chord(angle: float) -> float:
    """Return the chord, on the unit sphere, of an angle in arcsec: 2 sin(theta / 2)."""
    return 2 * np.sin(angle * ARCSEC / 2)


def from_tangent_plane(ra: float, dec: float, xi: ArrayLike, eta: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    """Deproject gnomonic offsets to the sky.

    Parameters
    ----------
    ra, dec : float, degrees
        Tangent point.
    xi, eta : float or array, degrees
        Offsets in the tangent plane, towards east and north.

    Returns
    -------
    tuple of arrays
        Right ascension and declination, degrees.
    """
    xi, eta = np.radians(xi), np.radians(eta)
    a, d = np.radians(ra), np.radians(dec)
    centre = np.array([np.cos(d) * np.cos(a), np.cos(d) * np.sin(a), np.sin(d)])
    east = np.array([-np.sin(a), np.cos(a), 0.0])
    north = np.array([-np.sin(d) * np.cos(a), -np.sin(d) * np.sin(a), np.cos(d)])
    return radec(centre + np.multiply.outer(xi, east) + np.multiply.outer(eta, north))


def touching_pairs(first: np.ndarray, second: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the index pairs of convex spherical polygons that overlap, sorted.

    Two convex polygons are disjoint if and only if the great circle through some edge of one has the whole other
    polygon on its outer side. The test is exact, also at right ascension 0 and at the poles.

    Parameters
    ----------
    first, second : array, shapes (n, k, 2) and (m, l, 2), degrees
        Right ascension and declination of the corners, in order along the boundary. Each polygon is smaller than a
        hemisphere.

    Returns
    -------
    tuple of int arrays, shape (pairs,)
        Indices into `first` and `second`.
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
    for start in range(0, len(i), _PAIRS_PER_BATCH):
        part = slice(start, start + _PAIRS_PER_BATCH)
        touching[part] = ~(_outside(a[i[part]], b[j[part]]) | _outside(b[j[part]], a[i[part]]))
    i, j = i[touching], j[touching]
    order = np.lexsort((j, i))
    return i[order], j[order]


def covering_sums(
    footprints: np.ndarray, ra: ArrayLike, dec: ArrayLike, weights: np.ndarray | None = None
) -> np.ndarray:
    """Return the summed weight, or the number, of the footprints that cover each position.

    Parameters
    ----------
    footprints : array, shape (n, 4, 2), degrees
        Corners, as in `covering_pairs`.
    ra, dec : array, degrees
        Positions; the two are broadcast against each other.
    weights : array, shape (n,), optional
        Weight of each footprint; 1 by default.

    Returns
    -------
    array
        Sums, with the broadcast shape of `ra` and `dec`.
    """
    ra, dec = np.broadcast_arrays(np.asarray(ra, float), np.asarray(dec, float))
    weights = np.ones(len(footprints)) if weights is None else np.asarray(weights, float)
    sums = np.zeros(ra.size)
    for footprint, point in _covering(footprints, ra.ravel(), dec.ravel()):
        sums += np.bincount(point, weights=weights[footprint], minlength=ra.size)
    return sums.reshape(ra.shape)


def covering_pairs(footprints: np.ndarray, ra, dec, margin: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Return the index pairs of footprints and the positions inside them, sorted.

    Parameters
    ----------
    footprints : array, shape (n, 4, 2), degrees
        Right ascension and declination of the corners. Footprints are convex and much smaller than the sky; their
        edges are arcs of great circles.
    ra, dec : array, shape (m,), degrees
        Positions.
    margin : float, arcsec
        Positions up to this far outside an edge count as inside.

    Returns
    -------
    tuple of int arrays, shape (pairs,)
        Indices into the footprints and into the positions.
    """
    parts = [np.stack(pair) for pair in _covering(footprints, np.asarray(ra, float), np.asarray(dec, float), margin)]
    footprint, point = np.concatenate([np.empty((2, 0), int), *parts], axis=1)
    order = np.lexsort((point, footprint))
    return footprint[order], point[order]


def _covering(
    footprints: np.ndarray, ra: np.ndarray, dec: np.ndarray, margin: float = 0.0
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield the pairs of `covering_pairs` in batches of footprints."""
    points = unit_vectors(ra, dec)
    tree = cKDTree(points) if len(points) else None
    for start in range(0, len(footprints) if tree is not None else 0, _FOOTPRINTS_PER_BATCH):
        corners = unit_vectors(*np.moveaxis(footprints[start : start + _FOOTPRINTS_PER_BATCH], -1, 0))
        middle, radius = _caps(corners)
        reach = radius.max() + chord(1.0 + margin)
        near = cKDTree(middle).sparse_distance_matrix(tree, reach, output_type="ndarray")
        footprint, point = near["i"], near["j"]
        normals = np.cross(corners, np.roll(corners, -1, axis=1))
        normals *= np.sign(np.einsum("nkc,nc->nk", normals, middle))[..., None]
        normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
        inside = (np.einsum("pkc,pc->pk", normals[footprint], points[point]) >= -margin * ARCSEC).all(axis=1)
        yield footprint[inside] + start, point[inside]


def _caps(corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the centres (n, 3) and chord radii (n,) of caps that enclose polygons with corners (n, k, 3)."""
    centre = corners.sum(axis=1)
    centre /= np.linalg.norm(centre, axis=1, keepdims=True)
    return centre, np.linalg.norm(corners - centre[:, None], axis=2).max(axis=1)


def _outside(polygons: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Return True for pairs (n,) where an edge of polygons[n] separates it from others[n]."""
    normals = np.cross(polygons, np.roll(polygons, -1, axis=1))
    inward = np.sign(np.einsum("nkc,nc->nk", normals, polygons.sum(axis=1)))
    return (np.einsum("nkc,nlc->nkl", normals * inward[..., None], others) < 0).all(axis=2).any(axis=1)


@dataclass(frozen=True)
class Region:
    """A box in right ascension and declination; ra_min > ra_max if it crosses right ascension 0."""

    ra_min: float
    """Lower right ascension, degrees."""
    ra_max: float
    """Upper right ascension, degrees."""
    dec_min: float
    """Lower declination, degrees."""
    dec_max: float
    """Upper declination, degrees."""

    @property
    def width(self) -> float:
        """Extent in right ascension, degrees (not multiplied by cos(dec))."""
        return (self.ra_max - self.ra_min) % 360 or 360.0

    @property
    def centre(self) -> tuple[float, float]:
        """Right ascension and declination of the centre, degrees."""
        return (self.ra_min + self.width / 2) % 360, (self.dec_min + self.dec_max) / 2

    @property
    def area(self) -> float:
        """Solid angle, square arcminutes."""
        heights = np.sin(np.radians(self.dec_max)) - np.sin(np.radians(self.dec_min))
        return float(np.radians(self.width) * heights * (180 * 60 / np.pi) ** 2)

    def contains(self, ra, dec, margin: float = 0.0) -> np.ndarray:
        """Return True for positions inside the box grown by a margin.

        Without a margin the lower edges belong to the box and the upper edges do not, so adjacent boxes share no
        position.

        Parameters
        ----------
        ra, dec : array, degrees
            Positions.
        margin : float, arcsec
            Distance by which the box is grown on all sides.
        """
        low, high = self.dec_min - margin / 3600, self.dec_max + margin / 3600
        limit = min(max(abs(low), abs(high)), 89.0)
        grow = margin / 3600 / np.cos(np.radians(limit))
        offset = (np.asarray(ra) - self.ra_min + grow) % 360
        return (offset < min(self.width + 2 * grow, 360.0)) & (np.asarray(dec) >= low) & (np.asarray(dec) < high)

    def cells(self, order: int, margin: float = 0.0) -> np.ndarray:
        """Return the HEALPix cells that may touch the box grown by a margin, sorted.

        Parameters
        ----------
        order : int
            HEALPix order, nested scheme.
        margin : float, arcsec
            Distance by which the box is grown on all sides.

        Raises
        ------
        UserError
            If the box has more than MAX_CELLS cells.
        """
        if self.area > MAX_CELLS * cell_area(order):
            raise UserError(
                f"region has {self.area / cell_area(order):.3g} HEALPix cells of order {order}, "
                f"at most {MAX_CELLS} can be planned: lower truth.order, detections.order and matches.order, or make "
                "the region smaller"
            )
        ra, dec = self.centre
        # the point furthest from the centre lies on an edge; edges are sampled at 1/64 of their length
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
    """A circular region of the sky."""

    ra: float
    """Right ascension of the centre, degrees."""
    dec: float
    """Declination of the centre, degrees."""
    radius: float
    """Angular radius, arcsec."""

    def contains(self, ra: ArrayLike, dec: ArrayLike) -> np.ndarray:
        """Return True for positions (degrees) inside the cone or on its edge."""
        gap = np.linalg.norm(unit_vectors(ra, dec) - unit_vectors(self.ra, self.dec), axis=-1)
        return gap <= chord(self.radius)

    def cells(self, order: int) -> np.ndarray:
        """Return the HEALPix cells (nested scheme) of an order that may touch the cone, sorted."""
        return cells_in_cone(self.ra, self.dec, self.radius / 3600, order)


def cells_in_cone(ra: float, dec: float, radius: float, order: int) -> np.ndarray:
    """Return the HEALPix cells (nested scheme) of an order that may touch a cone, sorted; all angles in degrees."""
    lon, lat = Longitude(ra * u.deg), Latitude(dec * u.deg)
    cells, _, _ = healpix.cone_search(lon, lat, min(radius, 180.0) * u.deg, order, flat=True)
    return np.sort(np.asarray(cells, dtype=np.int64))


def cell_of(ra, dec, order: int) -> np.ndarray:
    """Return the HEALPix cell (nested scheme) of an order that contains each position in degrees."""
    lon, lat = Longitude(np.atleast_1d(ra) * u.deg), Latitude(np.atleast_1d(dec) * u.deg)
    return healpix.lonlat_to_healpix(lon, lat, order).astype(np.int64)


def cell_area(order: int) -> float:
    """Return the solid angle of a HEALPix cell of an order, square arcminutes."""
    return 4 * np.pi * (180 * 60 / np.pi) ** 2 / (12 * 4**order)


def offset_positions(
    ra: ArrayLike, dec: ArrayLike, separation: ArrayLike, position_angle: ArrayLike
) -> tuple[np.ndarray, np.ndarray]:
    """Return positions at a separation and position angle from given positions.

    Parameters
    ----------
    ra, dec : array, degrees
        Right ascension and declination of the starting positions.
    separation : array, radians
        Angle along the great circle.
    position_angle : array, radians
        Direction of the great circle at the starting position, east of north.

    Returns
    -------
    tuple of arrays
        Right ascension in [0, 360) and declination, degrees.
    """
    a, d = np.radians(ra), np.radians(dec)
    sin_dec = np.sin(d) * np.cos(separation) + np.cos(d) * np.sin(separation) * np.cos(position_angle)
    east = np.sin(position_angle) * np.sin(separation) * np.cos(d)
    delta_ra = np.arctan2(east, np.cos(separation) - np.sin(d) * sin_dec)
    return np.degrees(a + delta_ra) % 360, np.degrees(np.arcsin(np.clip(sin_dec, -1, 1)))
