"""Sun angle and roll of Roman's visits, with the ephemeris of GalSim, vectorised over visits."""

from __future__ import annotations

import galsim.roman
import numpy as np
from coord import degrees
from coord.util import ecliptic_obliquity
from galsim.roman.roman_wcs import theta_fpa
from numpy.typing import ArrayLike

from romandask.instruments.roman.focal_plane import axes
from romandask.model.sky import unit_vectors

NEAREST, FURTHEST = 90 - galsim.roman.max_sun_angle, 90 + galsim.roman.max_sun_angle
"""Smallest and largest angle between the Sun and the boresight, degrees."""
LARGEST_ROLL = 15.0
"""Largest difference of the roll from the best roll, at which the solar panels face the Sun, degrees."""


def sun_vectors(mjd: ArrayLike) -> np.ndarray:
    """Return unit vectors (..., 3) from the Earth to the Sun at times, MJD, as GalSim's pointing rules use them."""
    # GalSim truncates times to whole seconds and uses the obliquity at the start of the year
    days = np.floor(np.asarray(mjd, dtype=float) * 86400 + 5e-7) / 86400 - 51544.5
    anomaly = np.radians(357.528 + 0.9856003 * days)
    longitude = np.radians(280.46 + 0.9856474 * days + 1.915 * np.sin(anomaly) + 0.020 * np.sin(2 * anomaly))
    day = np.floor(np.asarray(mjd, dtype=float) - 40587).astype(np.int64)
    year = day.astype("datetime64[D]").astype("datetime64[Y]").astype(np.int64) + 1970
    tilt = _obliquity(year)
    return np.stack([np.cos(longitude), np.sin(longitude) * np.cos(tilt), np.sin(longitude) * np.sin(tilt)], axis=-1)


def sun_angle(ra: ArrayLike, dec: ArrayLike, mjd: ArrayLike) -> np.ndarray:
    """Return the angle between positions and the Sun, degrees.

    Parameters
    ----------
    ra, dec : array-like, degrees
        Positions.
    mjd : array-like, MJD
        Times.
    """
    sun, position = np.broadcast_arrays(sun_vectors(mjd), unit_vectors(ra, dec))
    return np.degrees(np.arctan2(np.linalg.norm(np.cross(sun, position), axis=-1), (sun * position).sum(-1)))


def best_roll(ra: ArrayLike, dec: ArrayLike, mjd: ArrayLike) -> np.ndarray:
    """Return the position angle of the focal plane, degrees, at which the solar panels face the Sun.

    The +Z axis of the observatory points from the field towards the Sun, and the focal plane is rotated from it by
    theta_fpa = 120 degrees. The observing sequences of the mission's reference survey follow this rule within the
    allowed roll of 15 degrees. (`galsim.roman.bestPA` has the opposite sign of the angle, and differs by 180 degrees
    where the Sun is more than 90 degrees away.)

    Parameters
    ----------
    ra, dec : array-like, degrees
        Positions of the centre of the focal plane.
    mjd : array-like, MJD
        Times.
    """
    _, east, north = axes(ra, dec)
    sun = sun_vectors(mjd)
    return (np.degrees(np.arctan2((sun * east).sum(-1), (sun * north).sum(-1))) + theta_fpa / degrees) % 360


def roll_offset(ra: ArrayLike, dec: ArrayLike, pa: ArrayLike, mjd: ArrayLike) -> np.ndarray:
    """Return the difference of position angles of the focal plane from the best roll, degrees, -180 to 180.

    Parameters
    ----------
    ra, dec, pa : array-like, degrees
        Positions of the centre of the focal plane, and its position angles.
    mjd : array-like, MJD
        Times.
    """
    return (np.asarray(pa) - best_roll(ra, dec, mjd) + 180) % 360 - 180


def leads(ra: ArrayLike, dec: ArrayLike, mjd: ArrayLike) -> np.ndarray:
    """Return a mask of the times at which the Sun is east of a position in ecliptic longitude: the leading season.

    A position can be observed in two seasons per year; in the other one the Sun is to the west.

    Parameters
    ----------
    ra, dec : array-like, degrees
        Positions.
    mjd : array-like, MJD
        Times.
    """
    sun, position = sun_vectors(mjd), unit_vectors(ra, dec)
    tilt = float(_obliquity(np.array(2000)))
    pole = np.array([0.0, -np.sin(tilt), np.cos(tilt)])
    return (np.cross(position, sun) * pole).sum(-1) > 0


def _obliquity(year: np.ndarray) -> np.ndarray:
    """Return the obliquity of the ecliptic in calendar years, radians."""
    years, index = np.unique(year, return_inverse=True)
    values = np.array([ecliptic_obliquity(int(number)).rad for number in years])
    return values[index].reshape(year.shape)
