"""Where the Sun lets Roman look, and how Roman then rolls: GalSim's ephemeris, for any number of visits at once."""

from __future__ import annotations

import galsim.roman
import numpy as np
from coord import degrees
from coord.util import ecliptic_obliquity
from galsim.roman.roman_wcs import theta_fpa

from romandask.instruments.roman.focal_plane import axes
from romandask.model.sky import unit_vectors

NEAREST, FURTHEST = 90 - galsim.roman.max_sun_angle, 90 + galsim.roman.max_sun_angle
"""Angle between the Sun and the boresight, degrees."""
LARGEST_ROLL = 15.0
"""The roll may differ this much, degrees, from the one that turns the solar panels to the Sun."""


def sun_vectors(mjd) -> np.ndarray:
    """Return the unit vectors (..., 3) from the Earth to the Sun at some MJD, as GalSim's pointing rules take them."""
    # GalSim passes dates on as calendar dates without fractions of a second, and takes the obliquity of the year
    days = np.floor(np.asarray(mjd, dtype=float) * 86400 + 5e-7) / 86400 - 51544.5
    anomaly = np.radians(357.528 + 0.9856003 * days)
    longitude = np.radians(280.46 + 0.9856474 * days + 1.915 * np.sin(anomaly) + 0.020 * np.sin(2 * anomaly))
    day = np.floor(np.asarray(mjd, dtype=float) - 40587).astype(np.int64)
    year = day.astype("datetime64[D]").astype("datetime64[Y]").astype(np.int64) + 1970
    tilt = _obliquity(year)
    return np.stack([np.cos(longitude), np.sin(longitude) * np.cos(tilt), np.sin(longitude) * np.sin(tilt)], axis=-1)


def sun_angle(ra, dec, mjd) -> np.ndarray:
    """Return the angle between positions and the Sun at some MJD, degrees."""
    sun, there = np.broadcast_arrays(sun_vectors(mjd), unit_vectors(ra, dec))
    return np.degrees(np.arctan2(np.linalg.norm(np.cross(sun, there), axis=-1), (sun * there).sum(-1)))


def best_roll(ra, dec, mjd) -> np.ndarray:
    """Return the position angle (degrees) of the focal plane with the solar panels facing the Sun.

    The observatory's +Z axis points from the field to the Sun, and the focal plane is turned by theta_fpa = 120 degrees
    from it: observing sequences of the mission's reference survey follow this within the allowed roll of 15 degrees.
    (galsim.roman.bestPA has the opposite sign of the angle, and turns it by 180 degrees where the Sun is more than
    90 degrees away.)
    """
    _, east, north = axes(ra, dec)
    sun = sun_vectors(mjd)
    return (np.degrees(np.arctan2((sun * east).sum(-1), (sun * north).sum(-1))) + theta_fpa / degrees) % 360


def roll_offset(ra, dec, pa, mjd) -> np.ndarray:
    """Return by how much position angles of the focal plane differ from the best roll, degrees in -180..180."""
    return (pa - best_roll(ra, dec, mjd) + 180) % 360 - 180


def leads(ra, dec, mjd) -> np.ndarray:
    """True where the Sun is to the ecliptic east of a position: the leading season, of the two in a year."""
    sun, there = sun_vectors(mjd), unit_vectors(ra, dec)
    year_tilt = _obliquity(2000)
    pole = np.array([0.0, -np.sin(year_tilt), np.cos(year_tilt)])
    return (np.cross(there, sun) * pole).sum(-1) > 0


def _obliquity(year) -> np.ndarray:
    years, places = np.unique(year, return_inverse=True)
    values = np.array([ecliptic_obliquity(int(one)).rad for one in years])
    return values[places].reshape(np.shape(year))
