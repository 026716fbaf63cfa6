"""Declaration of a stage, and the part of a survey that the functions that build stages use.

A stage is declared once, beside the function that builds its product. All other code that handles stages (the run, the
plan, the diagram, the documentation) reads the declarations, which `romandask.stage_graph` collects.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol, Self, TypeVar

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
"""`units_known_after` of stages that are made from exposures: the pointings and the source catalogs decide which units
these stages have."""

Product = ImageProduct | TableProduct
Value = TypeVar("Value")


class StageOutput(Protocol):
    """The result of building a stage: a lazy product, or an object that holds the product and its origin."""

    @property
    def product(self) -> Product:
        """The lazy product, whose units a run stores."""

    def stored(self, store: Store) -> Self:
        """Return a copy whose product reads its stored units from `store`."""


class SurveyContext(Protocol):
    """A survey, as seen by the functions that build stages."""

    pipeline: Pipeline
    """Settings of the survey."""
    store: Store | None
    """Store that stored units are read from; None if there is no store."""

    @property
    def region(self) -> Region:
        """Box on the sky that the survey covers."""

    @property
    def data(self) -> AnyPath:
        """Folder that the paths of source files are relative to."""

    @property
    def instruments(self) -> dict[str, Instrument]:
        """Instruments by survey name, in the order of the pipeline."""

    @property
    def tiles(self) -> list[Tile]:
        """Tiles whose inner areas touch the region."""

    @property
    def bandpasses(self) -> dict[str, Bandpass]:
        """Bandpasses of all instruments, by band."""

    def pointings(self, survey: str) -> pd.DataFrame:
        """Return the pointings table of an instrument."""

    def output(self, name: str) -> Any:
        """Return the output of the stage that builds a product, for example `coadds/roman`; it is built only once.

        The type of the output depends on the stage.
        """

    def once(self, build: Callable[..., Value], *arguments: str) -> Value:
        """Return `build(survey, *arguments)`, which is called only once; used for values that several stages share."""


def _always(context: SurveyContext, survey: str) -> bool:
    return True


@dataclass(frozen=True, kw_only=True)
class Stage:
    """One stage of a survey: the product that it builds, and the products that it reads."""

    name: str
    """Name of the stage. A stage per survey, for example `coadds`, has the products `coadds/<survey>`; any other stage
    has one product of the same name, for example `truth/galaxies`."""
    build: Callable[[SurveyContext, str], StageOutput]
    """Returns the output for a survey. A stage that is not per survey is called with the empty string."""
    unit: str
    """What one unit is, in words, for example `tile and band`; shown to the user."""
    summary: str
    """What the product contains and how it is made, in one sentence; shown to the user."""
    reads: tuple[str, ...] = ()
    """Names of the stages whose units this stage reads. If both stages are per survey, the product of the same survey
    is read, or those of all surveys with `<name>/*`. A stage that is not per survey reads those of all surveys."""
    per_survey: bool = False
    """True if each instrument has its own product."""
    units_known_after: tuple[str, ...] = ()
    """Names of the stages whose content decides which units this stage has. The units cannot be listed before these
    stages are complete."""
    exists: Callable[[SurveyContext, str], bool] = _always
    """Whether the stage exists for a survey; the settings of some pipelines leave it out."""
    on_demand: bool = False
    """True if a run does not store the product; its units are then made when they are requested."""
    sky: tuple[str, str] | None = None
    """Columns of right ascension and declination if the product is a HATS catalog, which then also has a margin;
    otherwise None."""
    shrink_with: str = "lower the size of the survey"
    """Advice to the user if a unit does not fit the memory of a worker."""
    finish: Callable[[SurveyContext, Store], tuple[str, list[AnyPath]]] | None = None
    """Writes files that belong to no unit, once all units are stored. Returns a name and the files, whose checksums are
    stored under that name."""
    tables: Mapping[str, str] = field(default_factory=dict)
    """Path in the store of each table, by its schema (`catalogs/<schema>.yaml`)."""
