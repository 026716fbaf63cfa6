"""Rubin's LSST camera: 189 detectors, the atmosphere, and a cadence."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Annotated, ClassVar, Literal

import galsim
import numpy as np
import pandas as pd
from pydantic import AfterValidator, Field, model_validator

from romandask.instruments.exposure import WHOLE, Exposure, pixel_areas
from romandask.instruments.instrument import (
    InstrumentContext,
    InstrumentSettings,
    Light,
    Publication,
    Readout,
)
from romandask.instruments.rubin.bands import BANDS, COLOUR_BAND, REFERENCE_BAND
from romandask.instruments.rubin.cadence import cadence
from romandask.instruments.rubin.ccd_readout import CcdReadout
from romandask.instruments.rubin.depth import SYSTEM_FWHM
from romandask.kernels.detectors.simple_detector import Detector
from romandask.kernels.rendering.psf import BrightPsf, PsfModel, place_grid
from romandask.kernels.rendering.seeing import (
    Pattern,
    elliptical_model,
    fried,
    kolmogorov_transfer,
    pattern,
    radial_model,
    von_karman_transfer,
)
from romandask.kernels.universe.bandpasses import rubin_bandpass
from romandask.model.seeds import rng
from romandask.model.settings import Section, distinct, one_of
from romandask.model.sky import Region
from romandask.model.spectra import Bandpass
from romandask.products.images import ImageProduct

SCALE = 0.2
"""arcsec a pixel"""
AREA = np.pi / 4 * 642.3**2
"""Effective collecting area, cm2."""
DARK = 0.2
"""Electrons a second."""
STAMP = 512
"""Largest stamp, pixels."""
DEGREE = 3
"""Of the polynomials by which the PSF varies over a detector."""
MARGIN = 0.3
"""Degrees by which tiles may stick out of the region that they cover."""


SIGMA = 2.3548200450309493
"""FWHM of a Gaussian over its sigma."""
FREQUENCY = np.linspace(0, 2.2 * np.pi * np.sqrt(2) / SCALE, 3000)
"""Radial frequencies at which transforms of PSFs are known, 1/arcsec."""

Band = Annotated[str, AfterValidator(one_of(BANDS))]


PUBLICATION = Publication(
    source="Troxel et al. 2023",
    # of its 1039 tiles' unique areas
    galaxies=6_831_656 / (1039 * 0.125**2),
    stars=159_575 / (1039 * 0.125**2),
)


class RubinPointings(Section):
    """Where Rubin looks: an OpSim database, or a generated five-year cadence."""

    source: Literal["cadence", "opsim"] = "cadence"
    path: str | None = Field(None, description="OpSim SQLite file, below `data`")
    start: float = Field(60980.0, description="first night of the cadence, MJD")
    visits: dict[Band, Annotated[int, Field(ge=0, le=10_000)]] = Field(
        {name: band.visits for name, band in BANDS.items()}, description="mean visits of a point, by band"
    )
    seeing: float = Field(0.6, gt=0, description="median atmospheric FWHM at 500 nm and zenith, arcsec")


class RubinSettings(InstrumentSettings):
    """The Rubin block of a pipeline."""

    every_band: ClassVar[tuple[str, ...]] = tuple(BANDS)
    usual_reference_band: ClassVar[str] = REFERENCE_BAND
    bands: Annotated[tuple[Band, ...], AfterValidator(distinct)] = Field(tuple(BANDS), min_length=1)
    mode: Literal["coadd", "visits"] = Field(
        "coadd", description="coadd: tiles are drawn directly; visits: each visit and detector, then warped and coadded"
    )
    sensor: Literal["ideal", "silicon"] = Field(
        "ideal", description="silicon: bright objects go through GalSim's model of the CCD, photon by photon (visits)"
    )
    cosmic_rays: bool = Field(True, description="in visits")
    pointings: RubinPointings = RubinPointings()
    atmosphere: Literal["kolmogorov", "von_karman"] = "kolmogorov"
    outer_scale: float = Field(25.0, gt=1, description="outer scale of von Karman turbulence, m")

    @model_validator(mode="after")
    def _every_band_visited(self) -> RubinSettings:
        missing = [band for band in self.bands if band not in self.pointings.visits]
        if missing and self.pointings.source == "cadence":
            raise ValueError(f"pointings.visits has no entry for {', '.join(missing)}")
        return self

    def instrument(self, context: InstrumentContext) -> Rubin:
        """Return Rubin with these settings."""
        return Rubin(self, context.n_waves, seed=context.seed)


@dataclass(frozen=True)
class Rubin:
    """What the stages need to know of Rubin."""

    settings: RubinSettings
    n_waves: int = 5
    name: str = "rubin"
    title: str = "Rubin"
    facility: tuple[str, str] = ("Rubin Observatory", "LSSTCam")
    code: int = 1
    blend_role: Literal["blended"] = "blended"
    publication: Publication = PUBLICATION
    data_model_elements: Mapping[str, str] = field(default_factory=dict, compare=False)
    coadd_scale: float = SCALE
    pixel_scale: float = SCALE
    shape: tuple[int, int] = (4000, 4072)
    detectors: tuple[int, ...] = tuple(range(189))
    field_radius: float = 2.06
    knot_smoothing: float = 0.0
    aperture: float = 1.5
    detection: Literal["median", "peaks"] = "peaks"
    detection_bands: tuple[str, ...] | None = None
    detector: Detector = Detector(saturation=1e5, read_noise=9.0)
    visit_seconds: float = 30.0
    seed: int = 0
    """Of the survey: visits have their own turbulence."""

    @property
    def bands(self) -> tuple[str, ...]:
        """Bands of this pipeline."""
        return self.settings.bands

    @property
    def reference_band(self) -> str:
        """i, or the middle one of this pipeline's bands."""
        return REFERENCE_BAND if REFERENCE_BAND in self.bands else self.bands[len(self.bands) // 2]

    @property
    def colour_band(self) -> str:
        """g, or the reference band."""
        return COLOUR_BAND if COLOUR_BAND in self.bands else self.reference_band

    @property
    def picture_bands(self) -> tuple[str, ...]:
        """z, i, r and g of this pipeline's bands; all of them where it has none of these."""
        return tuple(band for band in "zirg" if band in self.bands) or self.bands

    @property
    def psf_settings(self) -> dict[str, object]:
        """Turbulence, and the seed of its patterns."""
        return self.settings.model_dump(include={"atmosphere", "outer_scale"}) | {"seed": self.seed}

    @property
    def coadd(self) -> Literal["draw", "warp"]:
        """Whether tiles are drawn from the cadence, or made of its exposures."""
        return "draw" if self.settings.mode == "coadd" else "warp"

    @property
    def calibrated(self) -> bool:
        """False: amplifiers are made up from the seed."""
        return False

    def calibrations(self, detectors: Sequence[int]) -> ImageProduct | None:
        """Return None."""
        return None

    def readout(self, seed: int, calibration: ImageProduct | None) -> Readout:
        """Return the CCDs, which need no calibration."""
        return CcdReadout(self, seed, self.settings.cosmic_rays, self.settings.sensor)

    def effects(
        self,
        readout: Readout,
        light: Light,
        expected: np.ndarray,
        left: Sequence[tuple[Exposure, pd.DataFrame]],
    ) -> dict[str, np.ndarray]:
        """Return no images: the effects of a CCD are not taken apart."""
        return {}

    def bandpass(self, band: str) -> Bandpass:
        """Return a bandpass with this instrument's PSF nodes."""
        return rubin_bandpass(band, self.n_waves, AREA)

    def plan(self, region: Region, seed: int) -> pd.DataFrame:
        """Return a generated five-year cadence: a fixed field grid, dithers each night and at each filter change."""
        settings = self.settings.pointings
        return cadence(
            region,
            seed,
            bands=self.bands,
            start=settings.start,
            means={str(band): mean for band, mean in settings.visits.items()},
            seeing=settings.seeing,
            area=len(_CENTRES) * self.shape[0] * self.shape[1] * (SCALE / 3600) ** 2,
            radius=self.field_radius + MARGIN,
        )

    def refused(self, visits: pd.DataFrame) -> np.ndarray:
        """True where a visit cannot be pointed: never, for a camera that only rotates about its boresight."""
        return np.zeros(len(visits), bool)

    def footprints(self, visits: pd.DataFrame) -> np.ndarray:
        """Return the corners (n, 189, 4, 2), degrees, of the detectors of visits (ra, dec, pa; degrees), in order."""
        half = np.array(self.shape[::-1]) * SCALE / 2
        corners = _CENTRES[:, None, :] + half * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
        x, y = np.radians(corners.reshape(-1, 2).T / 3600)
        found = np.empty((len(visits), len(_CENTRES), 4, 2))
        # in parts, for the vectors take more memory than the corners
        for first in range(0, len(visits), 500):
            part = slice(first, first + 500)
            ra, dec, pa = (np.radians(visits[name].to_numpy(float)[part])[:, None] for name in ("ra", "dec", "pa"))
            xi, eta = -x * np.cos(pa) + y * np.sin(pa), x * np.sin(pa) + y * np.cos(pa)
            away, north = np.cos(dec) - eta * np.sin(dec), np.sin(dec) + eta * np.cos(dec)
            # about the boresight's meridian
            corner_ra = np.degrees(ra + np.arctan2(xi, away)) % 360
            corner_dec = np.degrees(np.arctan2(north, np.hypot(xi, away)))
            found[part] = np.stack([corner_ra, corner_dec], axis=-1).reshape(-1, len(_CENTRES), 4, 2)
        return found

    def header(self, exposure: Exposure) -> dict:
        """Return the header of an exposure: gnomonic about the boresight, +y at the position angle `pa`."""
        return _header(exposure, exposure.detector, self.shape)

    def psf(self, exposure: Exposure) -> PsfModel:
        """Return the PSF of an exposure: atmosphere and telescope, both with airmass^0.6, varying over the field."""
        return _psf(_Varying(self.psf_key(exposure), self, exposure))

    def psf_at(self, exposure: Exposure, x: float, y: float) -> PsfModel:
        """Return the PSF of an exposure at a place of the detector."""
        return self.model(exposure, np.array([x]), np.array([y]), np.empty((0, 2)), 0)

    def psf_key(self, exposure: Exposure) -> tuple:
        """Return what tells PSFs apart: each exposure has its own."""
        turbulence = self.settings.atmosphere, self.settings.outer_scale, exposure.seeing, exposure.airmass, self.seed
        return "rubin", exposure.band, self.n_waves, self.shape, exposure.visit, exposure.detector, *turbulence

    def psf_edges(self, exposure: Exposure) -> dict[int, float]:
        """Return how bright a unit star is at the edges of stamps."""
        return self.psf(exposure).edges

    def bright_psfs(self, exposure: Exposure) -> tuple[BrightPsf, ...]:
        """Return no PSFs of bright stars: seeing is the same for all."""
        return ()

    def profiles(self, exposure: Exposure, x: float, y: float) -> list[galsim.GSObject]:
        """Return GalSim's PSFs, one a node, at a place (pixels) of the detector."""
        thickness = exposure.airmass**0.6
        xx, yy, xy = self._covariance(exposure, np.array([x]), np.array([y]))[0]
        size = np.sqrt(xx * yy - xy**2)
        # a Gaussian of that covariance: distortion (xx - yy) / (xx + yy) and 2 xy / (xx + yy)
        shear = galsim.Shear(e1=(xx - yy) / (xx + yy), e2=2 * xy / (xx + yy))
        system = galsim.Gaussian(sigma=np.sqrt(size)).shear(shear)
        return [
            galsim.Convolve(self._atmosphere(exposure.seeing * (wave / 500) ** -0.3 * thickness, wave), system)
            for wave in self.bandpass(exposure.band).nodes
        ]

    def _atmosphere(self, fwhm: float, wave: float) -> galsim.GSObject:
        if self.settings.atmosphere == "kolmogorov":
            return galsim.Kolmogorov(fwhm=float(fwhm))
        return galsim.VonKarman(lam=float(wave), r0=fried(fwhm, wave), L0=self.settings.outer_scale)

    def _transfer(self, frequency: np.ndarray, fwhm: np.ndarray, wave: float, gaussian: np.ndarray) -> np.ndarray:
        """Return the transform of the atmosphere, of a FWHM, and of a round Gaussian, of another (arcsec)."""
        if self.settings.atmosphere == "kolmogorov":
            return kolmogorov_transfer(frequency, fwhm, gaussian)
        return von_karman_transfer(frequency, fwhm, gaussian, wave, self.settings.outer_scale)

    def _covariance(self, exposure: Exposure, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Return the covariance (n, 3), arcsec2, of the Gaussian part of the PSF at places of a detector, pixels.

        It is the telescope's and what the atmosphere, at 500 nm, differs by from its mean: turbulence.
        """
        ny, nx = self.shape
        u, v = _CENTRES[exposure.detector][:, None] + SCALE * (np.stack([x, y]) - [[(nx - 1) / 2], [(ny - 1) / 2]])
        here, thickness = _pattern(self.seed, exposure.visit), exposure.airmass**0.6
        telescope = (SYSTEM_FWHM * thickness / SIGMA) ** 2 * here.telescope(u, v)
        return telescope + (exposure.seeing * thickness / SIGMA) ** 2 * here.atmosphere(u, v)

    def model(self, exposure: Exposure, x: np.ndarray, y: np.ndarray, places: np.ndarray, degree: int) -> PsfModel:
        """Return the PSF at a place (1,) of an exposure, pixels, and by how much it differs at the places (n, 2)."""
        thickness = exposure.airmass**0.6
        transfers = [
            self._transfer(FREQUENCY, np.array(exposure.seeing * (wave / 500) ** -0.3 * thickness), wave, np.array(0.0))
            for wave in self.bandpass(exposure.band).nodes
        ]
        middle, others = self._covariance(exposure, x, y)[0], self._covariance(exposure, *places.T)
        return elliptical_model(FREQUENCY, np.array(transfers), middle, others, degree, self.shape, SCALE, STAMP)

    def effective_psf(self, exposures: list[Exposure], weights: np.ndarray, size: int = STAMP) -> PsfModel:
        """Return the weighted mean PSF of some exposures of one band, on this instrument's pixels.

        It is round: of hundreds of exposures, each turned and dithered, no ellipticity is left. Their sizes are those
        in the middle of their detectors.
        """
        share = np.asarray(weights) / np.sum(weights)
        seeing = np.array([exposure.seeing for exposure in exposures])
        thickness = np.array([exposure.airmass for exposure in exposures]) ** 0.6
        ny, nx = self.shape
        middle = np.array([(nx - 1) / 2]), np.array([(ny - 1) / 2])
        size2 = np.array([self._covariance(exposure, *middle)[0, :2].mean() for exposure in exposures])
        gaussian = (np.sqrt(size2) * SIGMA)[:, None]
        transfers = [
            share @ self._transfer(FREQUENCY, (seeing * (wave / 500) ** -0.3 * thickness)[:, None], wave, gaussian)
            for wave in self.bandpass(exposures[0].band).nodes
        ]
        return radial_model(FREQUENCY, np.array(transfers), SCALE, size)

    def background(self, exposure: Exposure, header: dict, rows: slice = WHOLE, columns: slice = WHOLE) -> np.ndarray:
        """Return the expected electrons (ny, nx) of sky and dark current."""
        sky = self.bandpass(exposure.band).ab_photons() * 10 ** (-0.4 * exposure.sky_brightness)
        return ((pixel_areas(header, self.shape, rows, columns) * sky + DARK) * exposure.exptime).astype(np.float32)

    def sky_noise(self, exposure: Exposure, background: np.ndarray | float) -> float:
        """Return the noise of an empty pixel, electrons rms."""
        return float(np.sqrt(np.mean(background) + self.detector.read_noise**2))

    def pixel_noise(self, exposure: Exposure) -> float:
        """Return the noise of an empty pixel, electrons rms, without making the image of the background."""
        sky = self.bandpass(exposure.band).ab_photons() * 10 ** (-0.4 * exposure.sky_brightness)
        return self.sky_noise(exposure, (SCALE**2 * sky + DARK) * exposure.exptime)


@lru_cache(maxsize=4096)
def _pattern(seed: int, visit: int) -> Pattern:
    return pattern(rng(seed, "exposures", "rubin", "psf", visit))


@dataclass(frozen=True)
class _Varying:
    """The PSF of an exposure: one with the same key is the same."""

    key: tuple
    rubin: Rubin = field(compare=False)
    exposure: Exposure = field(compare=False)


@lru_cache(maxsize=1)
def _psf(of: _Varying) -> PsfModel:
    ny, nx = of.rubin.shape
    middle = np.array([(nx - 1) / 2]), np.array([(ny - 1) / 2])
    return of.rubin.model(of.exposure, *middle, place_grid(of.rubin.shape, DEGREE), DEGREE)


def detector_centres() -> np.ndarray:
    """Return the centres (189, 2) of the detectors on the focal plane, arcsec: 21 rafts of 3 x 3.

    Raft pitch 127 mm, detector pitch 42.25 mm (LSST Camera, LCA-280), 20 arcsec a millimetre.
    """
    centres = [
        (127.0 * rx + 42.25 * cx, 127.0 * ry + 42.25 * cy)
        for ry in range(-2, 3)
        for rx in range(-2, 3)
        if not (abs(rx) == 2 and abs(ry) == 2)
        for cy in range(-1, 2)
        for cx in range(-1, 2)
    ]
    return np.array(centres) * 20.0


_CENTRES = detector_centres()


def _header(exposure: Exposure, detector: int, shape: tuple[int, int]) -> dict:
    angle = np.radians(exposure.pa)
    x, y = _CENTRES[detector]
    step = SCALE / 3600
    return {
        "CTYPE1": "RA---TAN",
        "CTYPE2": "DEC--TAN",
        "CUNIT1": "deg",
        "CUNIT2": "deg",
        "CRVAL1": float(exposure.ra),
        "CRVAL2": float(exposure.dec),
        "CRPIX1": (shape[1] + 1) / 2 - x / SCALE,
        "CRPIX2": (shape[0] + 1) / 2 - y / SCALE,
        "CD1_1": -step * np.cos(angle),
        "CD1_2": step * np.sin(angle),
        "CD2_1": step * np.sin(angle),
        "CD2_2": step * np.cos(angle),
        "RADESYS": "ICRS",
    }
