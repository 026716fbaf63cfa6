"""A made-up third telescope, whose one band VIS is LSST's r, and pipelines that have it in any position."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, ClassVar

import numpy as np
import pandas as pd
from pydantic import AfterValidator

from romandask.instruments.exposure import Exposure
from romandask.instruments.instrument import InstrumentContext, InstrumentSettings
from romandask.instruments.rubin.bands import COLLECTING_AREA
from romandask.instruments.rubin.rubin import Rubin, RubinPointings, RubinSettings
from romandask.kernels.rendering.psf import PsfModel
from romandask.kernels.universe.bandpasses import rubin_bandpass
from romandask.model.settings import one_of
from romandask.model.sky import Region
from romandask.model.spectra import Bandpass
from romandask.pipeline import Pipeline


@dataclass(frozen=True)
class Third(Rubin):
    """A telescope like Rubin, with another name, number and band."""

    name: str = "third"
    title: str = "Third"
    code: int = 5
    blend_role: None = None
    publication: None = None

    @property
    def bands(self) -> tuple[str, ...]:
        """Its one band."""
        return ("VIS",)

    def bandpass(self, band: str) -> Bandpass:
        """Return LSST's r band under its own name."""
        return replace(rubin_bandpass("r", self.n_waves, COLLECTING_AREA), name="VIS")

    def effective_psf(self, exposures: list[Exposure], weights: np.ndarray) -> PsfModel:
        """Return Rubin's PSF in r."""
        return super().effective_psf([replace(exposure, band="r") for exposure in exposures], weights)

    def plan(self, region: Region, seed: int) -> pd.DataFrame:
        """Return the visits that Rubin would make in r."""
        return Rubin(self.settings, n_waves=self.n_waves).plan(region, seed).assign(band="VIS")


class ThirdSettings(InstrumentSettings):
    """The block of the third telescope."""

    every_band: ClassVar[tuple[str, ...]] = ("VIS",)
    usual_reference_band: ClassVar[str] = "VIS"
    bands: tuple[Annotated[str, AfterValidator(one_of(["VIS"]))], ...] = ("VIS",)
    pointings: RubinPointings = RubinPointings()

    def instrument(self, context: InstrumentContext) -> Third:
        """Return the telescope."""
        settings = RubinSettings(bands=("r",), pointings=self.pointings)
        return Third(settings, n_waves=context.n_waves, seed=context.seed)


class WithThird(Pipeline):
    """A pipeline that may have the third telescope, in any position among the instruments."""

    third: ThirdSettings | None = None
    position: int = 2

    def blocks(self) -> dict[str, InstrumentSettings]:
        """Return the blocks of the instruments, the third telescope's in its position."""
        blocks = super().blocks()
        if "third" not in blocks:
            return blocks
        names = [name for name in blocks if name != "third"]
        names.insert(self.position, "third")
        return {name: blocks[name] for name in names}
