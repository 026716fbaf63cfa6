"""The stages of a survey: their declarations in order, the products that a survey has of them, and what each reads."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

from romandask.model.errors import UserError
from romandask.products.hats import margin
from romandask.products.tables import TableProduct
from romandask.stages.analysis.blend_statistics import STATISTICS
from romandask.stages.analysis.differences import DIFFERENCES
from romandask.stages.analysis.friends_of_friends import CHANCE, MATCHES
from romandask.stages.analysis.samples import LIMITS, SAMPLES
from romandask.stages.analysis.shear import SHAPES, SHEAR, SHEAR_PAIRS
from romandask.stages.calibration import CALIBRATION
from romandask.stages.coadds.coadds import COADDS
from romandask.stages.detections.detections import DETECTIONS
from romandask.stages.detections.objects import OBJECTS
from romandask.stages.detections.truth_match import TRUTH_MATCH, TRUTH_SUMMARY
from romandask.stages.detections.zero_points import ZERO_POINTS
from romandask.stages.exposures.exposures import EXPOSURES
from romandask.stages.pointings import POINTINGS
from romandask.stages.psf_images import PSF_IMAGES
from romandask.stages.stage import Stage, SurveyContext
from romandask.stages.truth.catalogs import GALAXIES, INGESTED, QUARANTINE, STARS, STRUCTURE
from romandask.stages.truth_index import TRUTH_INDEX
from romandask.storage.store import MARGIN

STAGES: tuple[Stage, ...] = (
    STRUCTURE,
    INGESTED,
    GALAXIES,
    STARS,
    QUARANTINE,
    POINTINGS,
    CALIBRATION,
    EXPOSURES,
    COADDS,
    DETECTIONS,
    TRUTH_MATCH,
    TRUTH_SUMMARY,
    ZERO_POINTS,
    OBJECTS,
    LIMITS,
    SAMPLES,
    DIFFERENCES,
    SHAPES,
    SHEAR_PAIRS,
    SHEAR,
    *MATCHES,
    *CHANCE,
    *STATISTICS,
    # no stage reads it: it runs where other stages leave workers free
    TRUTH_INDEX,
    PSF_IMAGES,
)
"""Each stage after those that it reads. A new stage is one line here."""


@dataclass(frozen=True)
class StageProduct:
    """One product that a survey has of a stage."""

    name: str
    """For example `coadds/roman`; also its place in the store."""
    stage: Stage
    survey: str
    """Empty where the stage is not per survey."""
    reads: frozenset[str]
    """Names of the products whose units its units are made from."""
    known_after: frozenset[str]
    """Names of the products whose content decides which units it has."""

    @property
    def kind(self) -> str:
        """First part of the name: `truth`, `coadds`, `matches`."""
        return self.name.split("/")[0]


def with_margins(stages: tuple[Stage, ...]) -> list[Stage]:
    """Return stages, each catalog followed by the stage of its margin."""
    found = []
    for stage in stages:
        found.append(stage)
        if stage.sky is not None:
            found.append(
                replace(
                    stage,
                    name=stage.name + MARGIN,
                    build=partial(_margin_of, stage),
                    unit=f"{stage.unit}, margin",
                    summary="Rows of other partitions within 10 arcsec of each partition.",
                    reads=(stage.name,),
                    finish=None,
                    tables={},
                )
            )
    return found


def _margin_of(stage: Stage, context: SurveyContext, survey: str) -> TableProduct:
    return margin(context.output(product_name(stage, survey)).product)


def product_name(stage: Stage, survey: str) -> str:
    """Return the name of the product of a stage for a survey (the empty string for a stage that is not per survey)."""
    if not stage.per_survey:
        return stage.name
    name = stage.name.removesuffix(MARGIN)
    return f"{name}/{survey}" + (MARGIN if stage.name.endswith(MARGIN) else "")


EVERY_STAGE: tuple[Stage, ...] = tuple(with_margins(STAGES))
"""The declared stages and those of margins."""


def find_stage(name: str, surveys: tuple[str, ...]) -> tuple[Stage, str]:
    """Return the stage of a product and the survey that the product belongs to.

    Raises
    ------
    UserError
        If no stage has a product of that name.
    """
    for stage in EVERY_STAGE:
        for survey in surveys if stage.per_survey else ("",):
            if product_name(stage, survey) == name:
                return stage, survey
    raise UserError(f"{name!r}: this survey has {', '.join(surveys)}")


def stage_products(context: SurveyContext) -> list[StageProduct]:
    """Return the products that a run of a survey stores, each after those that it is made from."""
    surveys = tuple(context.instruments)
    present = [
        (stage, survey)
        for stage in EVERY_STAGE
        if not stage.on_demand
        for survey in (surveys if stage.per_survey else ("",))
        if stage.exists(context, survey)
    ]
    names = {product_name(stage, survey) for stage, survey in present}
    return [
        StageProduct(
            product_name(stage, survey),
            stage,
            survey,
            frozenset(_resolved(stage.reads, stage, survey, surveys)) & names,
            frozenset(_resolved(stage.units_known_after, stage, survey, surveys)) & names,
        )
        for stage, survey in present
    ]


def _resolved(names: tuple[str, ...], reader: Stage, survey: str, surveys: tuple[str, ...]) -> set[str]:
    """Return the products that the names of stages in a declaration stand for."""
    found = set()
    for name in names:
        every, stage = name.endswith("/*"), _BY_NAME[name.removesuffix("/*")]
        if stage.per_survey and (every or not reader.per_survey):
            found |= {product_name(stage, one) for one in surveys}
        else:
            found.add(product_name(stage, survey))
    return found


_BY_NAME = {stage.name: stage for stage in EVERY_STAGE}


@dataclass(frozen=True)
class Selection:
    """Some of the stages, as a user names them."""

    only: tuple[str, ...] = ()
    """Names (`coadds/roman`) or kinds (`coadds`) of products; none for all."""
    start: str | None = None
    """The first of them, in the order of the plan."""

    def of(self, products: list[StageProduct]) -> list[StageProduct]:
        """Return the selected products, in order.

        Raises
        ------
        UserError
            If the survey has no such stage.
        """
        for name in (*self.only, *((self.start,) if self.start else ())):
            if not any(_is(product, name) for product in products):
                kinds = ", ".join(dict.fromkeys(product.kind for product in products))
                raise UserError(f"stage {name!r}: this survey has {kinds}, each followed by /<survey> or /<part>")
        first = next((k for k, product in enumerate(products) if self.start and _is(product, self.start)), 0)
        chosen = products[first:]
        return [one for one in chosen if not self.only or any(_is(one, name) for name in self.only)]


def _is(product: StageProduct, name: str) -> bool:
    return name in (product.name, product.kind)
