"""Roman's Wide Field Instrument, from the files that ship with GalSim: optics, WCS, bandpasses, sky."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime, timedelta
from functools import lru_cache
from typing import Literal

import galsim
import galsim.roman
import numpy as np
import pandas as pd
from coord.util import sun_position_ecliptic
from galsim.roman.roman_wcs import theta_fpa
from pydantic import Field, model_validator

from romandask.instruments.exposure import WHOLE, Exposure, footprint, pixel_areas
from romandask.kernels.bandpasses import galsim_roman_bandpasses, roman_bandpass
from romandask.kernels.detector import Detector
from romandask.kernels.psf import PsfBasis, sample_basis
from romandask.model.config import Section
from romandask.model.errors import UserError
from romandask.model.sky import Region, from_tangent_plane, unit_vectors
from romandask.model.spectra import Bandpass

SCAS = tuple(range(1, 19))
SIDE = galsim.roman.n_pix
SCA_RADIUS = 0.105
"""From the centre of an SCA to its corners, with a margin for the approximate centre; degrees."""
EXPTIME = 139.8
"""Seconds."""
KNOT_SMOOTHING = 0.2
"""Sigma, arcsec, of the Gaussian that smooths each knot (paper, section 3)."""
LONG_STEP, SHORT_STEP = 0.80, 0.40
"""Steps of the focal plane along its axes, degrees."""
DITHER = (0.0162, 0.0274)
"""Diagonal dither over the chip gaps, degrees along the focal plane's axes."""
VISIT_SECONDS = 169.7
"""From the start of an exposure to the start of the next."""


class RomanPointings(Section):
    """Where Roman looks: an observing sequence in a FITS file, or a small dithered plan over the region."""

    source: Literal["plan", "obseq"] = "plan"
    path: str | None = Field(None, description="obseq FITS file, below `data`")
    start: float = Field(61541.0, description="first night of the plan, MJD")
    dithers: dict[str, tuple[int, ...]] = Field(
        {"Y106": (4, 3), "J129": (4, 4), "H158": (4, 3), "F184": (4, 3)},
        description="dithers at every field, for each pass, by band",
    )


class RomanSettings(Section):
    """The Roman block of a pipeline."""

    bands: tuple[Literal["Y106", "J129", "H158", "F184"], ...] = ("Y106", "J129", "H158", "F184")
    pointings: RomanPointings = RomanPointings()
    detector: Literal["simple"] = "simple"

    @model_validator(mode="after")
    def _every_band_dithered(self) -> RomanSettings:
        missing = [band for band in self.bands if band not in self.pointings.dithers]
        if missing and self.pointings.source == "plan":
            raise ValueError(f"pointings.dithers has no entry for {', '.join(missing)}")
        return self


@dataclass(frozen=True)
class Roman:
    """What the stages need to know of Roman."""

    settings: RomanSettings
    n_waves: int = 5
    name: str = "roman"
    coadd_scale: float = 0.0575
    """arcsec"""
    pixel_scale: float = galsim.roman.pixel_scale
    shape: tuple[int, int] = (SIDE, SIDE)
    field_radius: float = 0.6
    knot_smoothing: float = KNOT_SMOOTHING
    aperture: float = 0.5
    detection: Literal["median", "mean"] = "median"
    detection_bands: tuple[str, ...] | None = None
    coadd_from: Literal["exposures", "pointings"] = "exposures"
    detector: Detector = Detector(saturation=1e5, read_noise=galsim.roman.read_noise)

    @property
    def bands(self) -> tuple[str, ...]:
        """Bands of this pipeline."""
        return self.settings.bands

    def bandpass(self, band: str) -> Bandpass:
        """Return a bandpass with this instrument's PSF nodes."""
        return roman_bandpass(band, self.n_waves)

    def plan(self, region: Region, seed: int) -> pd.DataFrame:
        """Return a small dithered plan: fields in steps of the focal plane, diagonal dithers, one roll a pass.

        Passes are half a year apart, so that one leads and one trails the Sun; each band and pass takes the first night
        on which the region can be observed. Nothing is random: the seed is not used.
        """
        ra, dec = region.centre
        settings = self.settings.pointings
        rows = []
        clock = settings.start
        for number in range(max(len(settings.dithers[band]) for band in self.bands)):
            mjd = first_observable(ra, dec, max(clock, settings.start + 182.6 * number))
            for band in self.bands:
                counts = settings.dithers[band]
                pa = best_roll(ra, dec, mjd)
                for dither in range(counts[number] if number < len(counts) else 0):
                    for field_ra, field_dec in _fields(region, pa, dither):
                        rows.append((band, mjd, EXPTIME, field_ra, field_dec, pa))
                        mjd += VISIT_SECONDS / 86400
            clock = mjd
        return pd.DataFrame(rows, columns=["band", "mjd", "exptime", "ra", "dec", "pa"]).assign(
            visit=np.arange(len(rows)), seeing=np.nan, airmass=np.nan, sky_brightness=np.nan
        )

    def footprints(self, visit: Exposure, ra: float, dec: float, radius: float) -> dict[int, np.ndarray]:
        """Return the corners of the SCAs of a visit that may reach into a cone.

        Raises GalSim's ValueError where the Sun is too near or too far.
        """
        # the exact WCS costs milliseconds an SCA: ask only for those whose centre is near enough
        offsets, angle = _sca_offsets(), np.radians(visit.pa)
        xi = -offsets[:, 0] * np.cos(angle) + offsets[:, 1] * np.sin(angle)
        eta = offsets[:, 0] * np.sin(angle) + offsets[:, 1] * np.cos(angle)
        centres = unit_vectors(*from_tangent_plane(visit.ra, visit.dec, xi, eta))
        gap = np.linalg.norm(centres - unit_vectors(ra, dec), axis=1)
        near = tuple(sca for sca, distance in zip(SCAS, gap, strict=True) if distance < np.radians(radius + SCA_RADIUS))
        return {sca: footprint(header, self.shape) for sca, header in _headers(visit, near).items()} if near else {}

    def header(self, exposure: Exposure) -> dict:
        """Return the exact TAN-SIP header of an exposure."""
        return _headers(exposure, (exposure.detector,))[exposure.detector]

    def psf(self, exposure: Exposure, size: int) -> PsfBasis:
        """Return the PSF basis of an exposure, for stamps up to `size`: one PSF an SCA and band, as in the paper."""
        return _psf(exposure.detector, exposure.band, self.n_waves, size)

    def background(self, exposure: Exposure, header: dict, rows: slice = WHOLE, columns: slice = WHOLE) -> np.ndarray:
        """Return the expected electrons (ny, nx) of zodiacal and stray light, thermal emission and dark current."""
        coord = galsim.CelestialCoord(header["CRVAL1"] * galsim.degrees, header["CRVAL2"] * galsim.degrees)
        level = galsim.roman.getSkyLevel(
            galsim_roman_bandpasses()[exposure.band],
            world_pos=coord,
            date=_date(exposure.mjd),
            exptime=exposure.exptime,
        )
        level *= 1 + galsim.roman.stray_light_fraction
        flat = galsim.roman.thermal_backgrounds[exposure.band] + galsim.roman.dark_current
        return (pixel_areas(header, self.shape, rows, columns) * level + flat * exposure.exptime).astype(np.float32)

    def sky_noise(self, exposure: Exposure, background: np.ndarray) -> float:
        """Return the noise of an empty pixel, electrons rms."""
        return float(np.sqrt(np.mean(background) + self.detector.read_noise**2))


def first_observable(ra: float, dec: float, start: float) -> float:
    """Return the first day from `start` (MJD), in whole days, on which the Sun's elongation allows a position."""
    for day in range(400):
        if best_roll(ra, dec, start + day) is not None:
            return start + day
    raise UserError(f"region at ra {ra:.2f}, dec {dec:.2f}: never observable in the 400 days from MJD {start:.0f}")


def _fields(region: Region, pa: float, dither: int) -> list[tuple[float, float]]:
    """Return (ra, dec) of the focal-plane centres that may reach the region, in steps of the focal plane."""
    ra, dec = region.centre
    half_width = region.width / 2 * np.cos(np.radians(min(abs(region.dec_min), abs(region.dec_max))))
    reach = np.hypot(half_width, (region.dec_max - region.dec_min) / 2) + 0.55
    columns, lines = (int(np.ceil(reach / step)) for step in (LONG_STEP, SHORT_STEP))
    angle = np.radians(pa)
    fields = []
    for i in range(-columns, columns + 1):
        for j in range(-lines, lines + 1):
            x, y = i * LONG_STEP + dither * DITHER[0], j * SHORT_STEP + dither * DITHER[1]
            xi, eta = -x * np.cos(angle) + y * np.sin(angle), x * np.sin(angle) + y * np.cos(angle)
            field_ra, field_dec = from_tangent_plane(ra, dec, xi, eta)
            fields.append((float(field_ra), float(field_dec)))
    return fields


def best_roll(ra: float, dec: float, mjd: float) -> float | None:
    """Return the position angle (degrees) of the focal plane with the solar panels facing the Sun; None if too near it.

    The observatory's +Z axis points from the field to the Sun, and the focal plane is turned by theta_fpa = 120 degrees
    from it: observing sequences of the mission's reference survey follow this within the allowed roll of 15 degrees.
    (galsim.roman.bestPA has the opposite sign of the angle, and turns it by 180 degrees where the Sun is more than
    90 degrees away.)
    """
    date = _date(mjd)
    if not galsim.roman.allowedPos(galsim.CelestialCoord(ra * galsim.degrees, dec * galsim.degrees), date):
        return None
    lon = sun_position_ecliptic(date)
    sun = galsim.CelestialCoord.from_ecliptic(lon, 0 * galsim.degrees, date.year)
    difference, height = sun.ra.rad - np.radians(ra), np.radians(dec)
    east = np.cos(sun.dec.rad) * np.sin(difference)
    north = np.cos(height) * np.sin(sun.dec.rad) - np.sin(height) * np.cos(sun.dec.rad) * np.cos(difference)
    return float((np.degrees(np.arctan2(east, north)) + theta_fpa / galsim.degrees) % 360)


@lru_cache(maxsize=1)
def _sca_offsets() -> np.ndarray:
    """Return the centres (18, 2) of the SCAs on the focal plane, degrees along its own axes (x runs west at pa 0)."""
    # any allowed pointing will do: the focal plane is rigid
    headers = _headers(Exposure(0, 0, "H158", 61541.0, EXPTIME, 53.0, -40.0, 0.0), SCAS)
    west, north = [], []
    for header in headers.values():
        vector = unit_vectors(header["CRVAL1"], header["CRVAL2"])
        centre = unit_vectors(53.0, -40.0)
        a, d = np.radians(53.0), np.radians(-40.0)
        east_axis = np.array([-np.sin(a), np.cos(a), 0.0])
        north_axis = np.array([-np.sin(d) * np.cos(a), -np.sin(d) * np.sin(a), np.cos(d)])
        west.append(-np.degrees(vector @ east_axis / (vector @ centre)))
        north.append(np.degrees(vector @ north_axis / (vector @ centre)))
    return np.stack([west, north], axis=1)


def _headers(visit: Exposure, scas: tuple[int, ...]) -> dict[int, dict]:
    """Return the headers of some SCAs of a visit; its pa is that of the focal plane's centre."""
    target = galsim.CelestialCoord(visit.ra * galsim.degrees, visit.dec * galsim.degrees)
    all_wcs = galsim.roman.getWCS(
        target, PA=visit.pa * galsim.degrees, date=_date(visit.mjd), SCAs=list(scas), PA_is_FPA=True
    )
    return {sca: _header(all_wcs[sca]) for sca in scas}


def _date(mjd: float):
    return datetime(1858, 11, 17) + timedelta(days=mjd)


def _header(wcs: galsim.BaseWCS) -> dict:
    full = galsim.FitsHeader()
    wcs.writeToFitsHeader(full, galsim.BoundsI(1, SIDE, 1, SIDE))
    wanted = ("CTYPE", "CUNIT", "CRPIX", "CRVAL", "CD", "A_", "B_", "LONPOLE", "EQUINOX")
    return {key: full[key] for key in full.keys() if key.startswith(wanted)} | {"RADESYS": "ICRS"}  # noqa: SIM118


@lru_cache(maxsize=1)
def _psf(sca: int, band: str, n_waves: int, size: int) -> PsfBasis:
    nodes = roman_bandpass(band, n_waves).nodes
    profiles = [galsim.roman.getPSF(sca, band, pupil_bin=8, wavelength=wave) for wave in nodes]
    return sample_basis(profiles, galsim.roman.pixel_scale, size)
