"""The stale units of a survey as one lazy dask graph, and the stages of a survey as the engine runs them."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Protocol

import numpy as np

from romandask.engine.graph import StageUnits, UnitGraph
from romandask.engine.run_stages import RunnableStage, write_stage_files
from romandask.engine.staleness import Source, StoredOutputs, find_stale
from romandask.model.errors import UserError
from romandask.model.sky import Region, touching_pairs
from romandask.products.images import ImageProduct
from romandask.products.tables import TableProduct
from romandask.stage_graph import Selection, StageProduct, stage_products
from romandask.stages.exposures.exposures import Exposures
from romandask.stages.stage import Product, SurveyContext
from romandask.storage.paths import AnyPath
from romandask.storage.store import Store


class StoredSurvey(SurveyContext, Protocol):
    """A survey whose products can be built and stored."""

    def product(self, name: str) -> Product:
        """Return a lazy product by name."""

    def ignore_stored(self, name: str) -> None:
        """Make a product although it is stored."""

    def use_stored(self, name: str) -> None:
        """Read a product from the store again."""


@dataclass(frozen=True)
class _Finish:
    """Writes the files of a stage that belong to no unit. It is picklable if the survey is."""

    write: Callable[[SurveyContext, Store], tuple[str, list[AnyPath]]]
    survey: StoredSurvey

    def __call__(self) -> tuple[str, list[AnyPath]]:
        return self.write(self.survey, store_of(self.survey))


def store_of(survey: StoredSurvey) -> Store:
    """Return the store of a survey.

    Raises
    ------
    UserError
        If the survey has no store.
    """
    if survey.store is None:
        raise UserError("this survey has no store: open one with romandask.open, or run a pipeline with --store")
    return survey.store


def runnable(survey: StoredSurvey, products: list[StageProduct]) -> list[RunnableStage]:
    """Return products of a survey in the form in which the engine runs and verifies them."""
    unit_lists = {name for product in products for name in product.known_after}
    read = {name for product in products for name in product.reads}
    return [_runnable(survey, product, product.name in unit_lists, product.name not in read) for product in products]


def _runnable(survey: StoredSurvey, product: StageProduct, decides_units: bool, last: bool) -> RunnableStage:
    """Return one product for the engine.

    Parameters
    ----------
    survey : StoredSurvey
        Survey with a store.
    product : StageProduct
        The product.
    decides_units : bool
        True if the content of the product determines which units others have.
    last : bool
        True if no other product reads this one.
    """

    def ended(made: int) -> None:
        if decides_units:
            survey.use_stored(product.name)

    finish = product.stage.finish
    return RunnableStage(
        name=product.name,
        product=lambda: survey.product(product.name),
        reads=product.reads,
        known_after=product.known_after,
        last=last,
        sky=product.stage.sky,
        finish=None if finish is None else _Finish(finish, survey),
        ended=ended,
    )


def ignore_stale_unit_lists(survey: StoredSurvey, products: list[StageProduct]) -> None:
    """Let a survey make, not read, the stale products that determine which units the given products have."""
    if survey.store is None:
        return
    stored = StoredOutputs(survey.store)
    for name in sorted({name for product in products for name in product.known_after}):
        todo = find_stale(survey.product(name), stored)
        if todo.tasks or todo.failed:
            survey.ignore_stored(name)


def unit_graph(survey: StoredSurvey, stages: Sequence[str] = (), region: Region | None = None) -> UnitGraph:
    """Return the stale units of a survey as a lazy dask collection: a layer for each stage, a task for each unit.

    Nothing is made or changed before it is computed. `unit_graph(...).compute()` makes and stores the units on threads;
    inside a `distributed.Client`, on its cluster. The command `romandask run` computes the same graph, with progress,
    a log, and failures set aside.

    Parameters
    ----------
    survey : StoredSurvey
        Survey with a store.
    stages : sequence of str
        Names (`coadds/roman`) or kinds (`coadds`) of the products to make; by default all.
    region : Region, optional
        Make only the units of tiles, exposures and HEALPix partitions that touch this area, and those that they are
        made from. Units that cover the whole survey are left out.

    Raises
    ------
    UserError
        If the survey has no store or no such product.
    """
    store, products = store_of(survey), stage_products(survey)
    selected = Selection(tuple(stages)).of(products)
    ignore_stale_unit_lists(survey, selected)
    stored, planned = StoredOutputs(store), set[Source]()
    units: list[StageUnits] = []
    for declared, stage in zip(selected, runnable(survey, selected), strict=True):
        product = survey.product(declared.name)
        todo = find_stale(product, stored, planned)
        planned |= {(declared.name, name) for name in todo.tasks}
        if todo.tasks:
            write_files = partial(write_stage_files, sky=stage.sky, finish=stage.finish)
            units.append(
                StageUnits(product=product, tasks=todo.tasks, sources=todo.sources, last=stage.last, finish=write_files)
            )
    if region is not None:
        units = _within(survey, units, region)
    return UnitGraph(units, store)


def _within(survey: StoredSurvey, stages: list[StageUnits], region: Region) -> list[StageUnits]:
    """Return the units that touch a region, and the units that these are made from."""
    wanted: set[Source] = set()
    for stage in stages:
        touching = _touching(survey, stage.product, region)
        wanted |= {(stage.product.stage, name) for name in stage.tasks if name in touching}
    kept = []
    for stage in reversed(stages):
        names = [name for name in stage.tasks if (stage.product.stage, name) in wanted]
        # earlier units of the same stage are needed too
        for name in names:
            for source in stage.sources[name]:
                if source not in wanted:
                    wanted.add(source)
                    names += [source[1]] if source[0] == stage.product.stage else []
        chosen = set(names)
        tasks = {name: task for name, task in stage.tasks.items() if name in chosen}
        if tasks:
            kept.append(replace(stage, tasks=tasks, sources={name: stage.sources[name] for name in tasks}))
    return kept[::-1]


def _touching(survey: StoredSurvey, product: Product, region: Region) -> Collection[str]:
    """Return the names of the units of a product that touch a region; none if units have no place on the sky."""
    if isinstance(product, TableProduct) and product.pixels is not None:
        return {product.names[index] for index in product.touching(region.cells(product.order or 0))}
    instrument = product.stage.split("/")[-1]
    if isinstance(product, ImageProduct) and product.axes[0] == "tile":
        tiles = [tile.name for tile in survey.pipeline.coadds.grid().covering(region)]
        return {name for name in product.names if name.startswith(tuple(tiles))}
    if instrument in survey.instruments:
        exposures = survey.output(f"exposures/{instrument}")
        if isinstance(exposures, Exposures) and product.names == exposures.names:
            corners = np.array(
                [
                    [region.ra_min, region.dec_min],
                    [region.ra_min + region.width, region.dec_min],
                    [region.ra_min + region.width, region.dec_max],
                    [region.ra_min, region.dec_max],
                ]
            )
            found, _ = touching_pairs(exposures.footprints, corners[None])
            return {product.names[index] for index in found}
    return ()
