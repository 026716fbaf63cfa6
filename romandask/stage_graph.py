"""The stages of a survey, each after those that it is made from, and the plan: what each needs a unit."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from romandask.model.errors import UserError
from romandask.products.hats import margin
from romandask.products.images import ImageProduct
from romandask.products.memory import INTERPRETER
from romandask.products.tables import TableProduct
from romandask.storage.store import MARGIN
from romandask.survey import Survey

Product = ImageProduct | TableProduct


@dataclass(frozen=True)
class Stage:
    """One stage: the product that it stores."""

    name: str
    product: Callable[[Survey], Product]
    position: tuple[str, str] | None = None
    """Columns of right ascension and declination where the product is a HATS catalog."""


@dataclass(frozen=True)
class Chosen:
    """Some of the stages."""

    only: tuple[str, ...] = ()
    """Names (coadds/roman) or kinds (coadds) of stages; none for all."""
    start: str | None = None
    """The first of them, in the order of the plan."""

    def of(self, every: list[Stage]) -> list[Stage]:
        """Return the chosen ones, in order.

        Raises
        ------
        UserError
            If the survey has no such stage.
        """
        for name in (*self.only, *((self.start,) if self.start else ())):
            if not any(_is(stage, name) for stage in every):
                kinds = ", ".join(dict.fromkeys(stage.name.split("/")[0] for stage in every))
                raise UserError(f"stage {name!r}: this survey has {kinds}, each followed by /<survey> or /<part>")
        first = next((k for k, stage in enumerate(every) if self.start and _is(stage, self.start)), 0)
        return [stage for stage in every[first:] if not self.only or any(_is(stage, name) for name in self.only)]


def tier(stage: str) -> int:
    """Return the tier of a stage, 0 to 2: none is put together before those of an earlier one have ended.

    What they leave tells which units it has: source rows (0) those of truth and pointings (1), these those of all
    others (2).
    """
    if stage == "truth/ingested":
        return 0
    return 1 if stage.startswith(("truth/", "pointings/")) else 2


def reads(product: Product) -> frozenset[str]:
    """Return the names of the stages whose units those of a product are made from."""
    return frozenset(stage for unit in product.units for stage, _ in (*unit.inputs, *unit.optional))


def _is(stage: Stage, name: str) -> bool:
    return name in (stage.name, stage.name.split("/")[0])


@dataclass(frozen=True)
class Planned:
    """A row of the plan."""

    stage: str
    units: int
    bytes: int
    """Uncompressed size of the images; 0 where it depends on what is found."""
    memory: int
    """Peak of a worker, bytes."""
    hours: float
    """Of one core, as measured on a laptop."""


_SETTING = {
    "coadds": "lower coadds.pixels",
    "detections": "lower coadds.pixels",
    "truth/structure": "lower truth.nside",
    "truth": "raise truth.order",
    "objects": "raise detections.order",
    "differences": "lower coadds.pixels",
    "matches": "raise matches.order",
    "chance": "raise matches.order",
    "samples": "raise detections.order",
    "exposures": "lower render.largest",
    "truth_index": "lower render.largest",
}
"""What makes the units of a stage smaller."""


def stages(survey: Survey) -> list[Stage]:
    """Return the stages of a survey, each after those that it is made from; the earlier one's units go first."""
    names = list(survey.instruments)
    found = [_first(survey)]
    found += _with_margin("truth/galaxies", lambda s: s.truth_catalogs.galaxies, ("ra", "dec"))
    found += _with_margin("truth/stars", lambda s: s.truth_catalogs.stars, ("ra", "dec"))
    found.append(Stage("truth/quarantine", lambda s: s.truth_catalogs.quarantine))
    found += [Stage(f"pointings/{name}", lambda s, name=name: s.pointing_product(name)) for name in names]
    if survey.pipeline.calibration() is not None:
        found.append(Stage("calibration/roman", lambda s: s.calibration_product))
    found += [
        Stage(f"exposures/{name}", lambda s, name=name: s.exposure_product(name))
        for name, instrument in survey.instruments.items()
        if instrument.coadd != "draw"
    ]
    for kind in ("coadd", "detection"):
        found += [
            Stage(f"{kind}s/{name}", lambda s, kind=kind, name=name: getattr(s, f"{kind}_product")(name))
            for name in names
        ]
    for kind in ("truth_match", "truth_summary", "zero_points"):
        found += [
            Stage(f"{kind}/{name}", lambda s, kind=kind, name=name: getattr(s, f"{kind}_product")(name))
            for name in names
        ]
    for name in names:
        found += _with_margin(f"objects/{name}", lambda s, name=name: s.object_product(name), ("coord_ra", "coord_dec"))
    for name in names:
        found.append(Stage(f"limits/{name}", lambda s, name=name: s.limit_product(name)))
        sample = f"samples/{name}"
        found += _with_margin(sample, lambda s, name=name: s.sample_product(name), ("coord_ra", "coord_dec"))
    if survey.differs:
        found.append(Stage("differences/rubin", lambda s: s.difference_product))
    for part, stage in (("shapes", "shapes"), ("pairs", "shear_pairs"), ("shear", "shear")):
        found += [
            Stage(f"{stage}/{name}", lambda s, part=part, name=name: getattr(s.lensing_products(name), part))
            for name in names
        ]
    if {"roman", "rubin"} <= set(names):
        for kind, products in (("matches", "match_products"), ("chance", "chance_products")):
            found += [
                Stage(f"{kind}/{part}", lambda s, products=products, part=part: getattr(getattr(s, products), part))
                for part in ("local", "crossing", "merged")
            ]
            groups = f"{kind}/groups"
            found += _with_margin(groups, lambda s, p=products: getattr(s, p).groups, ("coord_ra", "coord_dec"))
        found += [
            Stage(f"statistics/{part}", lambda s, part=part: getattr(s.statistic_products, part))
            for part in ("blends", "unrecognised", "distributions", "chance")
        ]
    # nothing waits for it: it is made where other stages leave workers free
    found += [
        Stage(f"truth_index/{name}", lambda s, name=name: s.truth_index_product(name))
        for name, instrument in survey.instruments.items()
        if instrument.coadd != "draw"
    ]
    return found


def _first(survey: Survey) -> Stage:
    if survey.pipeline.truth.source == "generate":
        return Stage("truth/structure", lambda s: s.truth_catalogs.structure)
    return Stage("truth/ingested", lambda s: s.ingested_product)


def _with_margin(name: str, product: Callable[[Survey], TableProduct], position: tuple[str, str]) -> list[Stage]:
    """Return the stages of a HATS collection: the catalog, then its margin."""
    return [
        Stage(name, product, position),  # type: ignore[arg-type]
        Stage(name + MARGIN, lambda s: margin(product(s)), position),
    ]


def plan(survey: Survey) -> list[Planned]:
    """Return units, bytes and peak memory of every stage, making nothing but the pointings.

    Raises
    ------
    UserError
        Where a unit does not fit the memory of a worker, or an input is not what it should be.
    """
    limit = survey.pipeline.run.memory_limit
    rows = []
    for stage in stages(survey):
        product = stage.product(survey)
        memory = product.bytes_per_unit + INTERPRETER
        if memory > limit * 2**30 and product.units:
            setting = _SETTING.get(stage.name, _SETTING.get(stage.name.split("/")[0], "the size of the survey"))
            raise UserError(
                f"{stage.name} {product.names[0]} needs {memory / 2**30:.1f} GiB, worker limit {limit:.1f} GiB: "
                f"{setting}, or raise run.memory_limit"
            )
        size = 0
        if isinstance(product, ImageProduct):
            one = sum(int(np.prod(v.shape)) * np.dtype(v.dtype).itemsize for v in product.variables)
            size = one * len(product.units)
        hours = len(product.units) * product.seconds_per_unit / 3600
        rows.append(Planned(stage.name, len(product.units), size, memory, hours))
    return rows
