"""Settings of Roman in a pipeline."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

from pydantic import AfterValidator, Field, NonNegativeInt, model_validator

from romandask.instruments.instrument import InstrumentContext, InstrumentSettings, PointingSettings
from romandask.instruments.roman.bands import BANDS, REFERENCE_BAND
from romandask.instruments.roman.calibration_source import CalibrationSource
from romandask.instruments.roman.roman import Roman
from romandask.model.settings import distinct, one_of
from romandask.storage.paths import resolve_below


class RomanPointings(PointingSettings):
    """Source of Roman's visits: an observing sequence in a FITS file, or the plan of the reference survey."""

    source: Literal["plan", "obseq"] = "plan"
    path: str | None = Field(None, description="obseq FITS file, below `data`")
    start: float = Field(61541.0, ge=51544, le=88069, description="first day of the plan, MJD (years 2000 to 2100)")
    dithers: dict[str, tuple[NonNegativeInt, ...]] = Field(
        {name: band.dithers for name, band in BANDS.items()},
        description="dithers at every field, for each pass, by band",
    )


class RomanSettings(InstrumentSettings):
    """The `roman` section of a pipeline."""

    every_band: ClassVar[tuple[str, ...]] = tuple(BANDS)
    usual_reference_band: ClassVar[str] = REFERENCE_BAND
    bands: Annotated[tuple[Annotated[str, AfterValidator(one_of(BANDS))], ...], AfterValidator(distinct)] = Field(
        tuple(BANDS), min_length=1
    )
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
