"""The stages of a survey: all declarations in order, the products of a survey, and which product reads which."""

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
from romandask.stages.detections.coadd_noise import COADD_NOISE
from romandask.stages.detections.detections import DETECTIONS
from romandask.stages.detections.objects import OBJECTS
from romandask.stages.detections.truth_match import TRUTH_MATCH, TRUTH_SUMMARY
from romandask.stages.detections.zero_points import ZERO_POINTS
from romandask.stages.exposures.exposures import EXPOSURES
from romandask.stages.pointings import POINTINGS
from romandask.stages.psf_images import PSF_IMAGES
from romandask.stages.psf_models import PSF_MODELS
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
    PSF_MODELS,
    EXPOSURES,
    COADDS,
    COADD_NOISE,
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
    # no stage reads this one: at the end it uses the workers that other stages leave free
    TRUTH_INDEX,
    PSF_IMAGES,
)
"""All stages, each after the stages that it reads. A new stage is one line here."""


@dataclass(frozen=True)
class StageProduct:
    """A product of a survey, and the products that it depends on."""

    name: str
    """Name, for example `coadds/roman`; also the path of the product in the store."""
    stage: Stage
    """Stage that makes the product."""
    survey: str
    """Name of the instrument; empty if the stage is not per survey."""
    reads: frozenset[str]
    """Names of the products that the units of this one are made from."""
    known_after: frozenset[str]
    """Names of the products whose content determines which units this one has."""

    @property
    def kind(self) -> str:
        """First part of the name, for example `truth`, `coadds` or `matches`."""
        return self.name.split("/")[0]


def with_margins(stages: tuple[Stage, ...]) -> list[Stage]:
    """Return the given stages, with the stage of its margin after each HATS catalog."""
    with_margin_stages = []
    for stage in stages:
        with_margin_stages.append(stage)
        if stage.sky is not None:
            with_margin_stages.append(
                replace(
                    stage,
                    name=stage.name + MARGIN,
                    build=partial(_margin_of, stage),
                    unit=f"margin of a {stage.unit}",
                    summary="The rows of other partitions within at least 10 arcsec of each partition.",
                    reads=(stage.name,),
                    finish=None,
                    tables={},
                )
            )
    return with_margin_stages


def _margin_of(stage: Stage, context: SurveyContext, survey: str) -> TableProduct:
    return margin(context.output(product_name(stage, survey)).product)


def product_name(stage: Stage, survey: str) -> str:
    """Return the name of the product of a stage for a survey (an empty string if the stage is not per survey)."""
    if not stage.per_survey:
        return stage.name
    name = stage.name.removesuffix(MARGIN)
    return f"{name}/{survey}" + (MARGIN if stage.name.endswith(MARGIN) else "")


EVERY_STAGE: tuple[Stage, ...] = tuple(with_margins(STAGES))
"""All stages, including those of margins."""


def find_stage(name: str, surveys: tuple[str, ...]) -> tuple[Stage, str]:
    """Return the stage of a product, and the survey that the product belongs to.

    Parameters
    ----------
    name : str
        Name of the product, for example `coadds/roman`.
    surveys : tuple of str
        Names of the instruments.

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
    """Return the products that a run of a survey stores, each after the products that it reads."""
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
            name=product_name(stage, survey),
            stage=stage,
            survey=survey,
            reads=frozenset(_resolved(stage.reads, stage, survey, surveys)) & names,
            known_after=frozenset(_resolved(stage.units_known_after, stage, survey, surveys)) & names,
        )
        for stage, survey in present
    ]


def _resolved(names: tuple[str, ...], reader: Stage, survey: str, surveys: tuple[str, ...]) -> set[str]:
    """Return the names of the products that a stage reads for a survey.

    Parameters
    ----------
    names : tuple of str
        Names of stages as in `Stage.reads`.
    reader : Stage
        Stage that reads them.
    survey : str
        Survey for which it reads them.
    surveys : tuple of str
        Names of all instruments.
    """
    products = set()
    for name in names:
        all_surveys, stage = name.endswith("/*"), _BY_NAME[name.removesuffix("/*")]
        if stage.per_survey and (all_surveys or not reader.per_survey):
            products |= {product_name(stage, instrument) for instrument in surveys}
        else:
            products.add(product_name(stage, survey))
    return products


_BY_NAME = {stage.name: stage for stage in EVERY_STAGE}


@dataclass(frozen=True)
class Selection:
    """A selection of products, as a user names them."""

    only: tuple[str, ...] = ()
    """Names (`coadds/roman`) or kinds (`coadds`) of products; empty for all."""
    start: str | None = None
    """Name or kind of the first product, in the order of the plan; None for the first of all."""

    def of(self, products: list[StageProduct]) -> list[StageProduct]:
        """Return the selected products, in order.

        Raises
        ------
        UserError
            If the survey has no product of a given name or kind.
        """
        for name in (*self.only, *((self.start,) if self.start else ())):
            if not any(_is(product, name) for product in products):
                kinds = ", ".join(dict.fromkeys(product.kind for product in products))
                raise UserError(f"stage {name!r}: this survey has {kinds}, each followed by /<survey> or /<part>")
        first = next((k for k, product in enumerate(products) if self.start and _is(product, self.start)), 0)
        return [
            product for product in products[first:] if not self.only or any(_is(product, name) for name in self.only)
        ]


def _is(product: StageProduct, name: str) -> bool:
    """Return whether a name is that of a product, or its kind."""
    return name in (product.name, product.kind)
