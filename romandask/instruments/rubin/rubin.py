"""The instrument Rubin: LSSTCam with 189 detectors, the atmosphere, and a cadence."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field
from typing import Annotated, ClassVar, Literal

import galsim
import numpy as np
import pandas as pd
from pydantic import AfterValidator, BeforeValidator, Field, model_validator

from romandask.instruments.exposure import WHOLE, Exposure, pixel_areas
from romandask.instruments.instrument import InstrumentContext, InstrumentSettings, PointingSettings, Publication
from romandask.instruments.readout import Light, Readout
from romandask.instruments.rubin.bands import BANDS, COLLECTING_AREA, COLOUR_BAND, REFERENCE_BAND
from romandask.instruments.rubin.cadence import cadence
from romandask.instruments.rubin.ccd_readout import CcdReadout
from romandask.instruments.rubin.focal_plane import CENTRES, DETECTOR_SHAPE, PIXEL_SCALE, corners, header_of
from romandask.instruments.rubin.psf import RubinPsf
from romandask.kernels.detectors.simple_detector import Detector
from romandask.kernels.rendering.psf import BrightPsf, PsfModel
from romandask.kernels.rendering.psf_layout import PsfLayout
from romandask.kernels.universe.bandpasses import rubin_bandpass
from romandask.model.filters import RUBIN, keys_by
from romandask.model.settings import band_in, distinct
from romandask.model.sky import Region
from romandask.model.spectra import Bandpass
from romandask.products.images import ImageProduct

DARK_CURRENT = 0.2
"""Dark current, electrons per second and pixel."""
TILE_MARGIN = 0.3
"""Largest distance by which coadd tiles extend beyond the region that they cover, degrees."""
PUBLICATION = Publication(
    source="Troxel et al. 2023",
    # counts of the paper over the unique areas of its 1039 tiles, square degrees
    galaxies=6_831_656 / (1039 * 0.125**2),
    stars=159_575 / (1039 * 0.125**2),
)


Band = Annotated[str, AfterValidator(band_in(BANDS, RUBIN))]
"""Name of a band, or another name of its filter."""


@dataclass(frozen=True)
class Rubin:
    """Rubin Observatory with LSSTCam; implements `Instrument`, where the members are described."""

    settings: RubinSettings
    """The `rubin` section of a pipeline."""
    _: KW_ONLY
    n_waves: int = 5
    """Number of PSF nodes per band."""
    seed: int = 0
    """Seed of the survey, from which the PSF variations of each visit are drawn."""
    name: str = "rubin"
    title: str = "Rubin"
    facility: tuple[str, str] = ("Rubin Observatory", "LSSTCam")
    code: int = 1
    blend_role: Literal["blended"] = "blended"
    publication: Publication = PUBLICATION
    data_model_elements: Mapping[str, str] = field(default_factory=dict, compare=False)
    coadd_scale: float = PIXEL_SCALE
    pixel_scale: float = PIXEL_SCALE
    shape: tuple[int, int] = DETECTOR_SHAPE
    detectors: tuple[int, ...] = tuple(range(len(CENTRES)))
    field_radius: float = 2.06
    knot_smoothing: float = 0.0
    aperture: float = 1.5
    detection: Literal["median", "peaks"] = "peaks"
    detection_bands: tuple[str, ...] | None = None
    detector: Detector = Detector(saturation=1e5, read_noise=9.0)
    visit_seconds: float = 30.0
    psf_layout: PsfLayout | None = None

    @property
    def bands(self) -> tuple[str, ...]:
        """Bands of this pipeline."""
        return self.settings.bands

    @property
    def reference_band(self) -> str:
        """Band i, or the middle one of this pipeline's bands."""
        return REFERENCE_BAND if REFERENCE_BAND in self.bands else self.bands[len(self.bands) // 2]

    @property
    def colour_band(self) -> str:
        """Band g, or the reference band."""
        return COLOUR_BAND if COLOUR_BAND in self.bands else self.reference_band

    @property
    def picture_bands(self) -> tuple[str, ...]:
        """Those of z, i, r and g that this pipeline has; all its bands if it has none of these."""
        return tuple(band for band in "zirg" if band in self.bands) or self.bands

    def bandpass(self, band: str) -> Bandpass:
        """Return a bandpass with its PSF nodes."""
        return rubin_bandpass(band, self.n_waves, COLLECTING_AREA)

    def plan(self, region: Region, seed: int) -> pd.DataFrame:
        """Generate a five-year cadence: a fixed field grid, dithered each night and rotated at each filter change."""
        settings = self.settings.pointings
        return cadence(
            region,
            seed,
            bands=self.bands,
            start=settings.start,
            means={str(band): mean for band, mean in settings.visits.items()},
            seeing=settings.seeing,
            area=len(CENTRES) * self.shape[0] * self.shape[1] * (PIXEL_SCALE / 3600) ** 2,
            radius=self.field_radius + TILE_MARGIN,
        )

    def footprints(self, visits: pd.DataFrame) -> np.ndarray:
        """Return the corners (n, 189, 4, 2), degrees, of the detectors of visits (columns ra, dec, pa)."""
        return corners(visits, self.shape)

    def refused(self, visits: pd.DataFrame) -> np.ndarray:
        """Return False for every visit: no limits of Rubin's pointing are simulated."""
        return np.zeros(len(visits), bool)

    def header(self, exposure: Exposure) -> dict:
        """Return the TAN header of an exposure."""
        return header_of(exposure.detector, exposure.ra, exposure.dec, exposure.pa, self.shape)

    @property
    def psf_settings(self) -> dict[str, object]:
        """Settings of the turbulence, and the seed of its patterns."""
        return self.settings.model_dump(include={"atmosphere", "outer_scale"}) | {"seed": self.seed}

    def psf(self, exposure: Exposure) -> PsfModel:
        """Return the PSF of an exposure, which varies over the detector."""
        return self._psf.over_detector(exposure)

    def psf_at(self, exposure: Exposure, x: float, y: float) -> PsfModel:
        """Return the PSF of an exposure at one position of the detector, pixels."""
        return self._psf.at(exposure, x, y)

    def psf_key(self, exposure: Exposure) -> tuple:
        """Return a key of the PSF of an exposure; each exposure has its own PSF."""
        return self._psf.key(exposure)

    def psf_edges(self, exposure: Exposure) -> dict[int, float]:
        """Return the surface brightness of a unit star at the edges of stamps, by stamp size."""
        return self.psf(exposure).edges

    def bright_psfs(self, exposure: Exposure) -> tuple[BrightPsf, ...]:
        """Return no PSFs: the PSF of bright stars is that of all objects."""
        return ()

    def profiles(self, exposure: Exposure, x: float, y: float) -> list[galsim.GSObject]:
        """Return the PSF at a position of the detector, pixels, as GalSim profiles, one per node."""
        return self._psf.profiles(exposure, x, y)

    def effective_psf(self, exposures: list[Exposure], weights: np.ndarray) -> PsfModel:
        """Return the weighted mean PSF of some exposures of one band; it is round."""
        return self._psf.effective(exposures, weights)

    @property
    def _psf(self) -> RubinPsf:
        return RubinPsf(
            atmosphere=self.settings.atmosphere,
            outer_scale=self.settings.outer_scale,
            n_waves=self.n_waves,
            shape=self.shape,
            seed=self.seed,
        )

    def background(self, exposure: Exposure, header: dict, rows: slice = WHOLE, columns: slice = WHOLE) -> np.ndarray:
        """Return the expected electrons (ny, nx) of sky and dark current."""
        areas = pixel_areas(header, self.shape, rows, columns)
        return ((areas * self._sky_rate(exposure) + DARK_CURRENT) * exposure.exptime).astype(np.float32)

    def sky_noise(self, exposure: Exposure, background: np.ndarray | float) -> float:
        """Return the mean noise of an empty pixel, electrons rms."""
        return float(np.sqrt(np.mean(background) + self.detector.read_noise**2))

    def pixel_noise(self, exposure: Exposure) -> float:
        """Return the mean noise of an empty pixel, electrons rms, for pixels of nominal size."""
        rate = PIXEL_SCALE**2 * self._sky_rate(exposure) + DARK_CURRENT
        return self.sky_noise(exposure, rate * exposure.exptime)

    def _sky_rate(self, exposure: Exposure) -> float:
        """Return the surface brightness of the sky, electrons per second and arcsec2."""
        return self.bandpass(exposure.band).ab_photons() * 10 ** (-0.4 * exposure.sky_brightness)

    @property
    def calibrated(self) -> bool:
        """False: the constants of the amplifiers are drawn from the seed."""
        return False

    def calibrations(self, detectors: Sequence[int]) -> ImageProduct | None:
        """Return None."""
        return None

    def readout(self, seed: int, calibration: ImageProduct | None) -> Readout:
        """Return the readout of the CCDs; the calibration is not used."""
        settings = self.settings
        return CcdReadout(instrument=self, seed=seed, cosmic_rays=settings.cosmic_rays, sensor=settings.sensor)

    def effects(
        self,
        readout: Readout,
        light: Light,
        expected: np.ndarray,
        left: Sequence[tuple[Exposure, pd.DataFrame]],
    ) -> dict[str, np.ndarray]:
        """Return no images: the effects of a CCD are not simulated separately."""
        return {}

    @property
    def coadd(self) -> Literal["draw", "warp"]:
        """Method of coaddition: "draw" with mode: coadd, "warp" with mode: visits."""
        return "draw" if self.settings.mode == "coadd" else "warp"


class RubinPointings(PointingSettings):
    """Source of Rubin's visits: an OpSim database, or a generated five-year cadence."""

    source: Literal["cadence", "opsim"] = "cadence"
    path: str | None = Field(None, description="OpSim SQLite file, or visit table in Parquet, below `data`")
    start: float = Field(60980.0, description="first night of the cadence, MJD")
    dither: str | None = Field(
        None,
        description="columns with the places of the visits, with source: opsim: `descDithered` for descDitheredRA, "
        "descDitheredDec and descDitheredRotTelPos; `field`, or not set, for fieldRA and fieldDec",
    )
    visits: Annotated[dict[Band, Annotated[int, Field(ge=0, le=10_000)]], BeforeValidator(keys_by(RUBIN.find))] = Field(
        {name: band.visits for name, band in BANDS.items()}, description="mean visits of a point, by band"
    )
    seeing: float = Field(0.6, gt=0, description="median atmospheric FWHM at 500 nm and zenith, arcsec")

    @model_validator(mode="after")
    def _has_places(self) -> RubinPointings:
        if self.dither is not None and self.source != "opsim":
            raise ValueError(f"dither needs source: opsim (found source: {self.source})")
        return self

    @property
    def read_options(self) -> dict[str, str | None]:
        """The family of columns with the places, if the visits are those of a database."""
        return {"dither": self.dither} if self.source == "opsim" else {}


class RubinSettings(InstrumentSettings):
    """The `rubin` section of a pipeline."""

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
        return Rubin(self, n_waves=context.n_waves, seed=context.seed)
