"""The sky over Cerro Pachon: positions of Sun and Moon, altitudes, and sky brightness.

Arguments named mjd are times, MJD (UTC); ra and dec are positions, degrees. They are broadcast against each other.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from romandask.instruments.rubin.bands import BANDS
from romandask.model.sky import unit_vectors

LATITUDE, LONGITUDE = -30.2446, -70.7494
"""Geographic position of the observatory, degrees (LSST Key Numbers)."""
SUN_V = -26.76
"""AB magnitude of the Sun in V (Willmer 2018)."""
EXTINCTION_V = 0.172
"""Extinction in V, mag per airmass, of Krisciunas & Schaefer (1991)."""


def hour_angle(ra: ArrayLike, mjd: ArrayLike) -> np.ndarray:
    """Return the hour angle, degrees, from the mean sidereal time (Meeus 1998, equation 12.4) with UT1 = UTC."""
    return (280.46061837 + 360.98564736629 * (np.asarray(mjd) - 51544.5) + LONGITUDE - np.asarray(ra) + 180) % 360 - 180


def altitude(ra: ArrayLike, dec: ArrayLike, mjd: ArrayLike) -> np.ndarray:
    """Return the altitude, degrees, without refraction."""
    hour, dec, latitude = np.radians(hour_angle(ra, mjd)), np.radians(dec), np.radians(LATITUDE)
    return np.degrees(np.arcsin(np.sin(latitude) * np.sin(dec) + np.cos(latitude) * np.cos(dec) * np.cos(hour)))


def parallactic_angle(ra: ArrayLike, dec: ArrayLike, mjd: ArrayLike) -> np.ndarray:
    """Return the position angle of the zenith at a position, degrees east of north."""
    hour, dec, latitude = np.radians(hour_angle(ra, mjd)), np.radians(dec), np.radians(LATITUDE)
    north = np.tan(latitude) * np.cos(dec) - np.sin(dec) * np.cos(hour)
    return np.degrees(np.arctan2(np.sin(hour), north))


def sun_position(mjd: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    """Return right ascension and declination of the Sun, degrees.

    The accuracy is 0.01 degrees (Astronomical Almanac, page C5).
    """
    days = np.asarray(mjd) - 51544.5
    anomaly = np.radians(357.528 + 0.9856003 * days)
    longitude = 280.460 + 0.9856474 * days + 1.915 * np.sin(anomaly) + 0.020 * np.sin(2 * anomaly)
    return _equatorial(longitude, np.zeros_like(longitude), days)


def moon_position(mjd: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    """Return the geocentric right ascension and declination of the Moon, degrees.

    The accuracy is 0.3 degrees (Astronomical Almanac, page D46).
    """
    days = np.asarray(mjd) - 51544.5
    t = days / 36525

    def wave(phase: float, rate: float) -> np.ndarray:
        """Return the sine of an angle, given in degrees at J2000 and in degrees per century."""
        return np.sin(np.radians(phase + rate * t))

    longitude = 218.32 + 481267.881 * t + 6.29 * wave(135.0, 477198.87) - 1.27 * wave(259.3, -413335.36)
    longitude += 0.66 * wave(235.7, 890534.22) + 0.21 * wave(269.9, 954397.74)
    longitude -= 0.19 * wave(357.5, 35999.05) + 0.11 * wave(186.5, 966404.03)
    latitude = 5.13 * wave(93.3, 483202.02) + 0.28 * wave(228.2, 960400.89)
    latitude -= 0.28 * wave(318.3, 6003.15) + 0.17 * wave(217.6, -407332.21)
    return _equatorial(longitude, latitude, days)


def _equatorial(longitude: np.ndarray, latitude: np.ndarray, days: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return right ascension and declination of ecliptic coordinates, degrees, `days` after J2000."""
    obliquity = np.radians(23.439 - 4e-7 * days)
    x, y, z = np.moveaxis(unit_vectors(longitude, latitude), -1, 0)
    y, z = np.cos(obliquity) * y - np.sin(obliquity) * z, np.sin(obliquity) * y + np.cos(obliquity) * z
    return np.degrees(np.arctan2(y, x)) % 360, np.degrees(np.arcsin(z))


def moon_phase(mjd: ArrayLike) -> np.ndarray:
    """Return the phase angle of the Moon, degrees: 0 at full moon, 180 at new moon."""
    cos_elongation = np.sum(unit_vectors(*moon_position(mjd)) * unit_vectors(*sun_position(mjd)), axis=-1)
    return 180 - np.degrees(np.arccos(np.clip(cos_elongation, -1, 1)))


def moonlight(mjd: ArrayLike) -> np.ndarray:
    """Return the illuminated fraction of the Moon times the sine of its altitude, 0 to 1; 0 if the Moon is down."""
    sin_altitude = np.sin(np.radians(np.maximum(altitude(*moon_position(mjd), mjd), 0)))
    return (1 + np.cos(np.radians(moon_phase(mjd)))) / 2 * sin_altitude


def sky_brightness(band: str, ra: ArrayLike, dec: ArrayLike, mjd: ArrayLike) -> np.ndarray:
    """Return the sky brightness, AB mag / arcsec2: airglow, scattered moonlight and twilight.

    Airglow (`RubinBand.airglow` at zenith) and moonlight follow Krisciunas & Schaefer (1991). Their moonlight in V is
    transferred to a band with the colour of the Sun and wavelength^-2, between Rayleigh and Mie scattering. Twilight is
    V = 22.3 with the Sun at -15 degrees and one magnitude brighter per degree (Patat et al. 2006), with the colour of
    the Sun. Both were fitted to visits of an OpSim baseline 3.
    """
    zenith_distance = 90 - altitude(ra, dec, mjd)
    path = 1 / np.sqrt(1 - 0.96 * np.sin(np.radians(zenith_distance)) ** 2)
    airglow = 10 ** (-0.4 * (BANDS[band].airglow + BANDS[band].extinction * (path - 1))) * path
    colour = BANDS[band].sun - SUN_V
    moon_ra, moon_dec = moon_position(mjd)
    moon_altitude = altitude(moon_ra, moon_dec, mjd)
    moon_path = 1 / np.sqrt(1 - 0.96 * np.cos(np.radians(np.maximum(moon_altitude, 0))) ** 2)
    phase = moon_phase(mjd)
    distance = np.degrees(np.arccos(np.sum(unit_vectors(moon_ra, moon_dec) * unit_vectors(ra, dec), axis=-1)))
    scattered = 10**5.36 * (1.06 + np.cos(np.radians(distance)) ** 2) + 10 ** (6.15 - distance / 40)
    scattered *= (BANDS[band].effective_wave / 550) ** -2 * (1 - 10 ** (-0.4 * EXTINCTION_V * path))
    moon = 3.84 + 0.026 * phase + 4e-9 * phase**4 + BANDS[band].extinction * moon_path
    # from nanolamberts: 34.08 nL is V = 22.5 mag / arcsec2
    moonlit = np.where(moon_altitude > 0, scattered * 10 ** (-0.4 * moon), 0) / 34.08 * 10 ** (-0.4 * (22.5 + colour))
    twilight = 10 ** (-0.4 * (22.3 - (altitude(*sun_position(mjd), mjd) + 15) + colour))
    return -2.5 * np.log10(airglow + moonlit + twilight)
