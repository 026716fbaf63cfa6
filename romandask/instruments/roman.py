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
from galsim.roman import roman_psfs
from pydantic import Field, NonNegativeInt, model_validator

from romandask.instruments.exposure import WHOLE, Exposure, pixel_areas
from romandask.instruments.roman_focal_plane import SCAS, corners, header_of
from romandask.instruments.roman_plan import reference_plan
from romandask.instruments.roman_sun import FURTHEST, NEAREST, sun_angle
from romandask.kernels.bandpasses import galsim_roman_bandpasses, roman_bandpass
from romandask.kernels.detector import Detector
from romandask.kernels.psf import PsfBasis, sample_basis
from romandask.model.config import Section
from romandask.model.sky import Region
from romandask.model.spectra import Bandpass

SIDE = galsim.roman.n_pix
KNOT_SMOOTHING = 0.2
"""Sigma, arcsec, of the Gaussian that smooths each knot (paper, section 3)."""


class RomanPointings(Section):
    """Where Roman looks: an observing sequence in a FITS file, or the reference survey's plan over the region."""

    source: Literal["plan", "obseq"] = "plan"
    path: str | None = Field(None, description="obseq FITS file, below `data`")
    start: float = Field(61541.0, ge=51544, le=88069, description="first day of the plan, MJD (years 2000 to 2100)")
    dithers: dict[str, tuple[NonNegativeInt, ...]] = Field(
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
        missing = [band for band in self.bands if not sum(self.pointings.dithers.get(band, ()))]
        if missing and self.pointings.source == "plan":
            raise ValueError(f"pointings.dithers has no exposures for {', '.join(missing)}")
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
    detectors: tuple[int, ...] = SCAS
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
        """Return the visits of the reference survey that cover a region. Nothing is random: the seed is not used."""
        settings = self.settings.pointings
        visits = reference_plan(region, self.bands, settings.dithers, settings.start)
        return visits.assign(seeing=np.nan, airmass=np.nan, sky_brightness=np.nan)

    def footprints(self, visits: pd.DataFrame) -> np.ndarray:
        """Return the corners (n, 18, 4, 2), degrees, of all SCAs of some visits (columns ra, dec, pa)."""
        return corners(visits["ra"], visits["dec"], visits["pa"], self.shape)

    def refused(self, visits: pd.DataFrame) -> np.ndarray:
        """True where the Sun is too near to a visit or too far from it (columns ra, dec, mjd): GalSim's own rule."""
        angle = sun_angle(visits["ra"], visits["dec"], visits["mjd"])
        return (angle < NEAREST) | (angle > FURTHEST)

    def header(self, exposure: Exposure) -> dict:
        """Return the exact TAN-SIP header of an exposure."""
        return header_of(exposure.detector, exposure.ra, exposure.dec, exposure.pa)

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


def _date(mjd: float):
    return datetime(1858, 11, 17) + timedelta(days=mjd)


# GalSim keeps the pupils of ten SCAs, half a gigabyte; a worker draws one SCA at a time
roman_psfs._make_aperture.resize(1)


@lru_cache(maxsize=1)
def _psf(sca: int, band: str, n_waves: int, size: int) -> PsfBasis:
    nodes = roman_bandpass(band, n_waves).nodes
    profiles = [galsim.roman.getPSF(sca, band, pupil_bin=8, wavelength=wave) for wave in nodes]
    return sample_basis(profiles, galsim.roman.pixel_scale, size)
