"""Settings of Rubin in a pipeline."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

from pydantic import AfterValidator, Field, model_validator

from romandask.instruments.instrument import InstrumentContext, InstrumentSettings, PointingSettings
from romandask.instruments.rubin.bands import BANDS, REFERENCE_BAND
from romandask.instruments.rubin.rubin import Rubin
from romandask.model.settings import distinct, one_of

Band = Annotated[str, AfterValidator(one_of(BANDS))]
"""Name of a band."""


class RubinPointings(PointingSettings):
    """Source of Rubin's visits: an OpSim database, or a generated five-year cadence."""

    source: Literal["cadence", "opsim"] = "cadence"
    path: str | None = Field(None, description="OpSim SQLite file, below `data`")
    start: float = Field(60980.0, description="first night of the cadence, MJD")
    visits: dict[Band, Annotated[int, Field(ge=0, le=10_000)]] = Field(
        {name: band.visits for name, band in BANDS.items()}, description="mean visits of a point, by band"
    )
    seeing: float = Field(0.6, gt=0, description="median atmospheric FWHM at 500 nm and zenith, arcsec")


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
