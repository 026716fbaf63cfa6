"""The instrument Roman: the Wide Field Instrument, with optics, WCS, bandpasses and sky of the files in GalSim."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field
from datetime import datetime, timedelta
from typing import Annotated, ClassVar, Literal

import galsim
import galsim.roman
import numpy as np
import pandas as pd
from pydantic import AfterValidator, BeforeValidator, Field, NonNegativeInt, model_validator

from romandask.instruments.exposure import WHOLE, Exposure, pixel_areas
from romandask.instruments.instrument import InstrumentContext, InstrumentSettings, PointingSettings, Publication
from romandask.instruments.readout import Light, Readout
from romandask.instruments.roman.bands import BANDS, COLOUR_BAND, REFERENCE_BAND
from romandask.instruments.roman.calibration import calibrations
from romandask.instruments.roman.calibration_source import CalibrationSource
from romandask.instruments.roman.focal_plane import SCAS, corners, header_of
from romandask.instruments.roman.optics import (
    ACTIVE_PIXELS,
    MIDDLE,
    PSF_EXTENT_PIXELS,
    WideNodes,
    edges,
    optics,
    over_sca,
    transforms,
)
from romandask.instruments.roman.plan import reference_plan
from romandask.instruments.roman.sca_effects import effect_images
from romandask.instruments.roman.sca_readout import ScaReadout
from romandask.instruments.roman.sun import FURTHEST, NEAREST, sun_angle
from romandask.instruments.simple_readout import SimpleReadout
from romandask.kernels.detectors.simple_detector import Detector
from romandask.kernels.rendering.psf import BrightPsf, Grid, PsfModel, model
from romandask.kernels.rendering.psf_layout import PsfLayout
from romandask.kernels.universe.bandpasses import galsim_roman_bandpasses, roman_bandpass
from romandask.model.filters import ROMAN, keys_by
from romandask.model.settings import band_in, distinct
from romandask.model.sky import Region
from romandask.model.spectra import Bandpass
from romandask.products.images import ImageProduct
from romandask.storage.paths import resolve_below

Band = Annotated[str, AfterValidator(band_in(BANDS, ROMAN))]
"""Name of a band, or another name of its filter."""
_POSITION_PSF_PIXELS = 256
"""Side of the PSF at one position, pixels."""
KNOT_SMOOTHING = 0.2
"""Sigma of the Gaussian that smooths each knot, arcsec (Troxel et al. 2023, section 3)."""
PUBLICATION = Publication(
    source="Troxel et al. 2023",
    depths={name: band.depth for name, band in BANDS.items() if band.depth is not None},
    # counts of the paper over the unique areas of its 1039 tiles, square degrees
    galaxies=12_432_713 / (1039 * 0.125**2),
    stars=215_613 / (1039 * 0.125**2),
)


@dataclass(frozen=True)
class Roman:
    """The Roman Space Telescope with WFI; implements `Instrument`, where the members are described."""

    settings: RomanSettings
    """The `roman` section of a pipeline."""
    _: KW_ONLY
    n_waves: int = 5
    """Number of PSF nodes per band."""
    calibration: CalibrationSource | None = None
    """Calibrations of the SCAs; None for the simple detector (`detector: simple` in the settings)."""
    name: str = "roman"
    title: str = "Roman"
    facility: tuple[str, str] = ("Roman Space Telescope", "WFI")
    code: int = 0
    blend_role: Literal["sharp"] = "sharp"
    publication: Publication = PUBLICATION
    data_model_elements: Mapping[str, str] = field(
        default_factory=lambda: {name: band.optical_element for name, band in BANDS.items()}, compare=False
    )
    coadd_scale: float = 0.0575
    pixel_scale: float = galsim.roman.pixel_scale
    shape: tuple[int, int] = (ACTIVE_PIXELS, ACTIVE_PIXELS)
    detectors: tuple[int, ...] = SCAS
    field_radius: float = 0.6
    knot_smoothing: float = KNOT_SMOOTHING
    aperture: float = 0.5
    detection: Literal["median", "peaks"] = "median"
    detection_bands: tuple[str, ...] | None = None
    coadd: Literal["drizzle"] = "drizzle"
    detector: Detector = Detector(saturation=1e5, read_noise=galsim.roman.read_noise)
    visit_seconds: float = 139.8

    @property
    def bands(self) -> tuple[str, ...]:
        """Bands of this pipeline."""
        return self.settings.bands

    @property
    def reference_band(self) -> str:
        """Band H158, or the middle one of this pipeline's bands."""
        return REFERENCE_BAND if REFERENCE_BAND in self.bands else self.bands[len(self.bands) // 2]

    @property
    def colour_band(self) -> str:
        """Band F184, or the reference band."""
        return COLOUR_BAND if COLOUR_BAND in self.bands else self.reference_band

    @property
    def picture_bands(self) -> tuple[str, ...]:
        """Bands of this pipeline, from red to blue."""
        return tuple(band for band in reversed(BANDS) if band in self.bands)

    def bandpass(self, band: str) -> Bandpass:
        """Return a bandpass with its PSF nodes."""
        return roman_bandpass(band, self.n_waves)

    def plan(self, region: Region, seed: int) -> pd.DataFrame:
        """Generate the visits of the reference survey that cover a region; nothing is random, the seed is not used."""
        settings = self.settings.pointings
        visits = reference_plan(region, self.bands, settings.dithers, settings.start)
        return visits.assign(seeing=np.nan, airmass=np.nan, sky_brightness=np.nan)

    def footprints(self, visits: pd.DataFrame) -> np.ndarray:
        """Return the corners (n, 18, 4, 2), degrees, of all SCAs of visits (columns ra, dec, pa)."""
        return corners(visits["ra"], visits["dec"], visits["pa"], self.shape)

    def refused(self, visits: pd.DataFrame) -> np.ndarray:
        """Return a mask of the visits at a forbidden distance from the Sun, by the rule of `galsim.roman`."""
        angle = sun_angle(visits["ra"], visits["dec"], visits["mjd"])
        return (angle < NEAREST) | (angle > FURTHEST)

    def header(self, exposure: Exposure) -> dict:
        """Return the exact TAN-SIP header of an exposure."""
        return header_of(exposure.detector, exposure.ra, exposure.dec, exposure.pa)

    @property
    def psf_settings(self) -> dict[str, object]:
        """Settings of the variation over an SCA, of bright stars, of charge diffusion and of the detector model."""
        settings = self.settings.model_dump(include={"psf_degree", "bright_stars", "charge_diffusion"})
        return {**settings, "detector": self.settings.detector}

    def diffusion(self, sca: int) -> float:
        """Return sigma, pixels, of the diffusion of charge in an SCA before the charge is collected."""
        return self.settings.charge_diffusion if self.calibration is None else self.calibration.diffusion(sca)

    @property
    def psf_layout(self) -> PsfLayout:
        """Sizes of the PSF models of all bands: the PSF is the same in all exposures of an SCA and band."""
        folds, degree = max(band.frequency_folds for band in BANDS.values()), self.settings.psf_degree
        bright = sorted(self.settings.bright_stars.items(), reverse=True)
        return PsfLayout(
            nodes=self.n_waves,
            grid=Grid(PSF_EXTENT_PIXELS // 8, folds),
            positions=(degree + 1) * (degree + 2) // 2 if degree else 0,
            bright=tuple(
                (len(_bright_waves(np.arange(self.n_waves), pupil_bin)), _bright_grid(folds, pupil_bin))
                for _, pupil_bin in bright
            ),
        )

    def psf(self, exposure: Exposure) -> PsfModel:
        """Return the PSF of the SCA and band of an exposure, which varies over the SCA."""
        sca, degree = exposure.detector, self.settings.psf_degree
        return over_sca(sca, exposure.band, self.n_waves, degree, self.diffusion(sca))

    def psf_at(self, exposure: Exposure, x: float, y: float) -> PsfModel:
        """Return the PSF at one position of the SCA, pixels, for stamps of up to 256 pixels.

        If the PSF does not vary over the SCA (`psf_degree: 0` in the settings), it is that in the middle of the SCA.
        """
        if not self.settings.psf_degree:
            x, y = MIDDLE
        grid, diffusion = (
            Grid(_POSITION_PSF_PIXELS, BANDS[exposure.band].frequency_folds),
            self.diffusion(exposure.detector),
        )
        waves = self.bandpass(exposure.band).nodes
        return model(transforms(exposure.detector, exposure.band, waves, 8, (x, y), grid, diffusion), grid)

    def psf_key(self, exposure: Exposure) -> tuple:
        """Return a key of the PSF, which is the same in all exposures of an SCA and band."""
        return "roman", exposure.detector, exposure.band, self.n_waves, self.diffusion(exposure.detector)

    def psf_edges(self, exposure: Exposure) -> dict[int, float]:
        """Return the surface brightness of a unit star at the edges of stamps, by stamp size."""
        return edges(exposure.detector, exposure.band, self.n_waves, self.diffusion(exposure.detector))

    def bright_psfs(self, exposure: Exposure) -> tuple[BrightPsf, ...]:
        """Return the PSFs of bright stars, from finer pupils, which extend further (Troxel et al. 2023, section 4.2).

        The PSF of an unbinned or weakly binned pupil covers more pixels. Setting `bright_stars` has the magnitudes and
        the binning.
        """
        bandpass, diffusion = self.bandpass(exposure.band), self.diffusion(exposure.detector)
        zero_point = bandpass.ab_photons() * exposure.exptime
        psfs = []
        for magnitude, pupil_bin in sorted(self.settings.bright_stars.items(), reverse=True):
            waves = _bright_waves(bandpass.nodes, pupil_bin)
            position = np.interp(bandpass.nodes, waves, np.arange(len(waves)))
            shares = np.clip(1 - np.abs(position[:, None] - np.arange(len(waves))), 0, 1)
            grid = _bright_grid(BANDS[exposure.band].frequency_folds, pupil_bin)
            nodes = WideNodes(
                sca=exposure.detector,
                band=exposure.band,
                waves=tuple(waves),
                pupil_bin=pupil_bin,
                grid=grid,
                diffusion=diffusion,
            )
            psfs.append(BrightPsf(zero_point * 10 ** (-0.4 * magnitude), grid, nodes, shares))
        return tuple(psfs)

    def profiles(self, exposure: Exposure, x: float, y: float) -> list[galsim.GSObject]:
        """Return the PSF at a position, pixels, as GalSim profiles, one per node."""
        waves = self.bandpass(exposure.band).nodes
        return [optics(exposure.detector, exposure.band, wave, 8, (x, y)) for wave in waves]

    def effective_psf(self, exposures: list[Exposure], weights: np.ndarray) -> PsfModel:
        """Raise NotImplementedError: Roman's tiles are drizzled from exposures, never drawn directly."""
        raise NotImplementedError("Roman's tiles are drizzled from exposures")

    def background(self, exposure: Exposure, header: dict, rows: slice = WHOLE, columns: slice = WHOLE) -> np.ndarray:
        """Return the expected electrons (ny, nx) of zodiacal and stray light, thermal emission and dark current.

        With the full detector model the dark current is not included: it comes from the calibration of the SCA.
        """
        centre = galsim.CelestialCoord(header["CRVAL1"] * galsim.degrees, header["CRVAL2"] * galsim.degrees)
        level = galsim.roman.getSkyLevel(
            galsim_roman_bandpasses()[exposure.band],
            world_pos=centre,
            date=_date(exposure.mjd),
            exptime=exposure.exptime,
        )
        # a Python number, so that the product with float32 areas stays float32
        level = float(level) * (1 + galsim.roman.stray_light_fraction)
        dark = galsim.roman.dark_current if self.calibration is None else 0.0
        flat = galsim.roman.thermal_backgrounds[exposure.band] + dark
        return (pixel_areas(header, self.shape, rows, columns) * level + flat * exposure.exptime).astype(np.float32)

    def sky_noise(self, exposure: Exposure, background: np.ndarray) -> float:
        """Return the mean noise of an empty pixel, electrons rms."""
        return float(np.sqrt(np.mean(background) + self.detector.read_noise**2))

    def pixel_noise(self, exposure: Exposure) -> float:
        """Return the mean noise of an empty pixel, electrons rms."""
        return self.sky_noise(exposure, self.background(exposure, self.header(exposure)))

    @property
    def calibrated(self) -> bool:
        """True with the full detector model (`detector: sca` in the settings)."""
        return self.calibration is not None

    def calibrations(self, detectors: Sequence[int]) -> ImageProduct | None:
        """Return the lazy calibrations of some SCAs; None for the simple detector."""
        return None if self.calibration is None else calibrations(self.calibration, detectors)

    def readout(self, seed: int, calibration: ImageProduct | None) -> Readout:
        """Return the readout of the SCAs with all effects, or of the simple detector if `calibration` is None."""
        if calibration is None:
            return SimpleReadout(name=self.name, detector=self.detector, shape=self.shape, seed=seed)
        return ScaReadout(instrument=self, calibration=calibration, seed=seed, cosmic_rays=self.settings.cosmic_rays)

    def effects(
        self,
        readout: Readout,
        light: Light,
        expected: np.ndarray,
        left: Sequence[tuple[Exposure, pd.DataFrame]],
    ) -> dict[str, np.ndarray]:
        """Return an image of each effect of an SCA; none for the simple detector."""
        return effect_images(readout, light, expected, left) if isinstance(readout, ScaReadout) else {}


def _bright_waves(nodes: np.ndarray, pupil_bin: int) -> np.ndarray:
    """Return the wavelengths at which a PSF of bright stars is sampled, given the nodes of the band."""
    # the core of the brightest stars is far above saturation; three wavelengths are enough for their spikes
    return nodes if pupil_bin == 4 else np.linspace(nodes[0], nodes[-1], 3)


def _bright_grid(folds: int, pupil_bin: int) -> Grid:
    """Return the frequencies of a PSF of bright stars, given the highest frequency of the band."""
    # only the core has power at the highest frequencies of the short bands
    return Grid(PSF_EXTENT_PIXELS // pupil_bin, folds if pupil_bin == 4 else 2)


def _date(mjd: float) -> datetime:
    return datetime(1858, 11, 17) + timedelta(days=mjd)


class RomanPointings(PointingSettings):
    """Source of Roman's visits: an observing sequence in a FITS file, or the plan of the reference survey."""

    source: Literal["plan", "obseq"] = "plan"
    path: str | None = Field(None, description="obseq FITS file, below `data`")
    start: float = Field(61541.0, ge=51544, le=88069, description="first day of the plan, MJD (years 2000 to 2100)")
    dithers: Annotated[dict[Band, tuple[NonNegativeInt, ...]], BeforeValidator(keys_by(ROMAN.find))] = Field(
        {name: band.dithers for name, band in BANDS.items()},
        description="dithers at every field, for each pass, by band",
    )


class RomanSettings(InstrumentSettings):
    """The `roman` section of a pipeline."""

    every_band: ClassVar[tuple[str, ...]] = tuple(BANDS)
    usual_reference_band: ClassVar[str] = REFERENCE_BAND
    bands: Annotated[tuple[Band, ...], AfterValidator(distinct)] = Field(tuple(BANDS), min_length=1)
    pointings: RomanPointings = RomanPointings()
    detector: Literal["simple", "sca"] = Field(
        "simple", description="sky, Poisson and read noise alone, or every effect of each SCA (paper, section 4.4)"
    )
    calibration: str | None = Field(
        None,
        description="folder of the SCAs' calibration files, below `data`, with detector: sca; if not set, calibrations "
        "are drawn from the seed",
    )
    cosmic_rays: bool = Field(False, description="add cosmic rays, with detector: sca")
    psf_degree: int = Field(
        5,
        ge=0,
        le=8,
        description="degree of the polynomials by which PSFs vary over an SCA; 0: the PSF in the middle everywhere",
    )
    bright_stars: dict[float, Literal[1, 2, 4]] = Field(
        {15.0: 4, 12.0: 2},
        description="pupil pixels that are binned for the PSF of stars brighter than each magnitude (8 for all others)",
    )
    charge_diffusion: float = Field(0.0, ge=0, le=2, description="sigma of the diffusion of charge, pixels; 0 for none")

    @model_validator(mode="after")
    def _belongs_to_the_detector(self) -> RomanSettings:
        if self.detector == "simple" and (self.calibration is not None or self.cosmic_rays):
            raise ValueError("calibration and cosmic_rays need detector: sca")
        if self.detector == "sca" and self.charge_diffusion:
            raise ValueError("charge_diffusion is that of the calibration (CHRGDIFF) with detector: sca: leave it out")
        return self

    @model_validator(mode="after")
    def _every_band_dithered(self) -> RomanSettings:
        missing = [band for band in self.bands if not sum(self.pointings.dithers.get(band, ()))]
        if missing and self.pointings.source == "plan":
            raise ValueError(f"pointings.dithers has no exposures for {', '.join(missing)}")
        return self

    def instrument(self, context: InstrumentContext) -> Roman:
        """Return Roman with these settings."""
        source = None
        if self.detector == "sca":
            folder = None if self.calibration is None else resolve_below(context.data, self.calibration)
            source = CalibrationSource(folder, context.seed)
        return Roman(self, n_waves=context.n_waves, calibration=source)
