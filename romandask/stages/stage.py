"""The declaration of a stage, and what the code that builds it may ask a survey for.

A stage is declared once, beside the function that builds its product. Everything else that knows stages (the run, the
plan, the diagram, the documentation) reads the declarations, which `romandask.stage_graph` collects.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol, TypeVar

import pandas as pd

from romandask.instruments.instrument import Instrument
from romandask.model.sky import Region
from romandask.model.spectra import Bandpass
from romandask.model.tiles import Tile
from romandask.pipeline import Pipeline
from romandask.products.images import ImageProduct
from romandask.products.tables import TableProduct
from romandask.storage.paths import AnyPath
from romandask.storage.store import Store

UNITS_FROM_POINTINGS = ("pointings", "truth/ingested")
"""`units_known_after` of the stages made from exposures: pointings and source catalogs decide which units there are."""

Product = ImageProduct | TableProduct
Value = TypeVar("Value")


class StageOutput(Protocol):
    """What a stage builds: a lazy product, or a value that holds one and what it is made of."""

    @property
    def product(self) -> Product:
        """The lazy product, whose units a run stores."""

    def stored(self, store: Store) -> Any:
        """Return the same value, its product reading the units that a store has."""


class SurveyContext(Protocol):
    """A survey as the builders of stages see it."""

    pipeline: Pipeline
    store: Store | None

    @property
    def region(self) -> Region:
        """The box on the sky."""

    @property
    def data(self) -> AnyPath:
        """The folder that the paths of source files are relative to."""

    @property
    def instruments(self) -> dict[str, Instrument]:
        """Instruments by survey name, in the order of the pipeline."""

    @property
    def tiles(self) -> list[Tile]:
        """The tiles whose unique areas touch the region."""

    @property
    def bandpasses(self) -> dict[str, Bandpass]:
        """All bands of all instruments."""

    def pointings(self, survey: str) -> pd.DataFrame:
        """Return the pointings table of an instrument."""

    def output(self, name: str) -> Any:
        """Return what the stage of a product builds, for example of `coadds/roman`; built once."""

    def once(self, build: Callable[..., Value], *arguments: str) -> Value:
        """Return `build(survey, *arguments)`, called once: for values that several stages share."""


def _always(context: SurveyContext, survey: str) -> bool:
    return True


@dataclass(frozen=True, kw_only=True)
class Stage:
    """One stage of a survey: what it builds, and from what."""

    name: str
    """For example `coadds`, whose products are `coadds/<survey>`; or the one product of the stage, `truth/galaxies`."""
    build: Callable[[SurveyContext, str], StageOutput]
    """Return the output for a survey; of a stage that is not per survey for the empty string."""
    unit: str
    """What one unit is, for people: `tile and band`."""
    summary: str
    """What the stage makes and how, one sentence."""
    reads: tuple[str, ...] = ()
    """Names of the stages whose units its units are made from. A stage per survey reads the product of its own
    survey of another stage per survey, with `<name>/*` those of all surveys; a stage of the whole survey reads all."""
    per_survey: bool = False
    """True where each instrument has a product of its own."""
    units_known_after: tuple[str, ...] = ()
    """Stages whose content decides which units this one has: it cannot be put together before they have ended."""
    exists: Callable[[SurveyContext, str], bool] = _always
    """Whether a survey (with an instrument) has the stage: settings may leave it out."""
    on_demand: bool = False
    """True where a run does not store it: it is made when it is asked for."""
    sky: tuple[str, str] | None = None
    """Columns of right ascension and declination where the product is a HATS catalog: then it has a margin."""
    shrink_with: str = "lower the size of the survey"
    """What to change where a unit does not fit a worker's memory."""
    finish: Callable[[SurveyContext, Store], tuple[str, list[AnyPath]]] | None = None
    """Write what the stage has beside its units; return a name and the files, whose checksums are kept under it."""
    tables: Mapping[str, str] = field(default_factory=dict)
    """Tables by schema (`catalogs/<schema>.yaml`): where each is in the store."""
