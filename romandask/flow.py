"""The stages in order: what each needs a unit, the plan, the run and the status of a store."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from importlib.metadata import version

import numpy as np

from romandask.incoming import source_rows
from romandask.model.errors import UserError
from romandask.pipeline import Pipeline
from romandask.runtime.cluster import Runner
from romandask.runtime.hats import margin, write_catalog_files
from romandask.runtime.images import ImageProduct
from romandask.runtime.lock import locked
from romandask.runtime.manifest import digest, read_record
from romandask.runtime.progress import Reporter
from romandask.runtime.sealed import catalog_files, image_files, seal, sealed, unseal
from romandask.runtime.store import MARGIN, Store, write_bytes, write_json
from romandask.runtime.tables import TableProduct
from romandask.runtime.work import Task
from romandask.survey import Survey
from romandask.truth import write_spectra

Product = ImageProduct | TableProduct
INTERPRETER = 420 << 20
"""Resident memory of a worker before it makes anything, bytes."""
PACKAGES = (
    "romandask",
    "astropy",
    "camb",
    "dask",
    "distributed",
    "drizzle",
    "galsim",
    "glass",
    "healpy",
    "numba",
    "numpy",
    "pyarrow",
    "scipy",
    "sep",
    "xarray",
    "zarr",
)


@dataclass(frozen=True)
class Stage:
    """One stage: the product that it stores."""

    name: str
    product: Callable[[Survey], Product]
    position: tuple[str, str] | None = None
    """Columns of right ascension and declination where the product is a HATS catalog."""


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


@dataclass
class Summary:
    """What a run did."""

    made: dict[str, int] = field(default_factory=dict)
    kept: dict[str, int] = field(default_factory=dict)
    failed: list[str] = field(default_factory=list)
    """stage/unit of units that were set aside, and of those that wait for them."""


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
    """Return the stages of a survey in the order in which they run."""
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
    found += [
        Stage(f"truth_index/{name}", lambda s, name=name: s.truth_index_product(name))
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
    return found


def _first(survey: Survey) -> Stage:
    if survey.pipeline.truth.source == "generate":
        return Stage("truth/structure", lambda s: s.truth_catalogs.structure)
    return Stage("truth/incoming", lambda s: s.incoming_product)


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


def run(pipeline: Pipeline, store: Store, runner: Runner, reporter: Reporter) -> Summary:
    """Make and store, in order, what is missing or no longer what the pipeline asks for."""
    summary = Summary()
    with locked(store.root):
        survey = _begin(pipeline, store)
        for stage in stages(survey):
            _make_stage(stage, survey, store, runner, reporter, summary)
    return summary


def ingest(pipeline: Pipeline, store: Store, runner: Runner, reporter: Reporter) -> dict[str, int]:
    """Make and store the truth catalogs alone; return rows `in` the source, `out` and `quarantined`.

    Raises
    ------
    RuntimeError
        If the numbers do not add up.
    """
    summary = Summary()
    with locked(store.root):
        survey = _begin(pipeline, store)
        for stage in stages(survey):
            if stage.name.startswith("truth/"):
                _make_stage(stage, survey, store, runner, reporter, summary)
    catalogs = survey.truth_catalogs
    out = sum(int(product.column("n_rows").sum()) for product in (catalogs.galaxies, catalogs.stars))
    aside = {row["stage"]: row["rows"] for row in run_figures(store)}.get("truth/quarantine", 0)
    counts = {"in": source_rows(survey.incoming_product), "out": out, "quarantined": aside}
    if summary.failed or counts["in"] != counts["out"] + counts["quarantined"]:
        raise RuntimeError(f"rows are missing: {counts}; failed units: {summary.failed}")
    return counts


def _begin(pipeline: Pipeline, store: Store) -> Survey:
    """Store the resolved settings and the packages' versions, and return the survey."""
    write_bytes(store.pipeline, pipeline.to_yaml().encode())
    write_json(store.root / "versions.json", {name: version(name) for name in PACKAGES})
    seal(store, "store", [store.pipeline, store.root / "versions.json"])
    return Survey(pipeline, store)


def _make_stage(
    stage: Stage, survey: Survey, store: Store, runner: Runner, reporter: Reporter, summary: Summary
) -> None:
    _run_stage(stage, stage.product(survey), store, runner, reporter, summary)
    if stage.name == "truth/galaxies":
        write_spectra(survey.truth_catalogs, store)
        seal(store, "truth/seds", sorted(store.images("truth/seds").rglob("*")))


def _run_stage(
    stage: Stage, product: Product, store: Store, runner: Runner, reporter: Reporter, summary: Summary
) -> None:
    tasks, kept, blocked = _tasks(product, store)
    summary.kept[stage.name] = kept
    summary.failed += [f"{stage.name}/{name} (an input is missing)" for name in blocked]
    _drop_strays(product, store)
    made = 0
    if tasks:
        unseal(store, stage.name)
        product.prepare(store)
        # a unit that is made again reads its upstream from the store, never its own former self
        with reporter.stage(stage.name, len(tasks)) as meter:
            for outcome in runner.run(product, tasks, store):
                meter.advance()
                if outcome.record is not None:
                    made += 1
                    continue
                name = product.names[outcome.index]
                summary.failed.append(f"{stage.name}/{name}")
                write_bytes(_failure_path(store, product, name), str(outcome.failure).encode())
    summary.made[stage.name] = made
    if stage.position is not None and (made or not (store.catalog(product.stage) / "hats.properties").exists()):
        write_catalog_files(product, store, *stage.position)  # type: ignore[arg-type]
    if made or not sealed(store, stage.name):
        if isinstance(product, ImageProduct):
            seal(store, stage.name, image_files(store, stage.name, [v.name for v in product.variables]))
        elif stage.position is not None:
            seal(store, stage.name, catalog_files(store, stage.name))


def _tasks(product: Product, store: Store) -> tuple[list[Task], int, list[str]]:
    """Return the units to make, how many are done, and those that wait for an input that failed."""
    outputs: dict[tuple[str, str], str | None] = {}

    def output(source: tuple[str, str]) -> str | None:
        if source not in outputs:
            record = read_record(store, *source)
            outputs[source] = record.output if record else None
        return outputs[source]

    tasks: dict[str, Task] = {}
    blocked: list[str] = []
    waiting: dict[str, tuple[str, ...]] = {}
    kept = 0
    for index, unit in enumerate(product.units):
        upstream = [output(source) for source in unit.inputs]
        if None in upstream:
            blocked.append(unit.name)
            store.record(product.stage, unit.name).unlink(missing_ok=True)
            continue
        upstream += [output(source) for source in unit.optional]
        inputs = digest(product.stage, unit.settings, version("romandask"), upstream)
        record = read_record(store, product.stage, unit.name)
        if record is not None and record.inputs == inputs:
            kept += 1
            continue
        store.record(product.stage, unit.name).unlink(missing_ok=True)
        tasks[unit.name] = Task(index, inputs, unit.cost, unit.kin)
        waiting[unit.name] = unit.after
    held = _held(waiting, set(blocked))
    chosen = [
        replace(task, after=tuple(tasks[other].index for other in waiting[name] if other in tasks))
        for name, task in tasks.items()
        if name not in held
    ]
    return chosen, kept, blocked + sorted(held)


def _held(waiting: dict[str, tuple[str, ...]], missing: set[str]) -> set[str]:
    """Return the units that cannot be made because one that they come after cannot."""
    held: set[str] = set()
    while found := {name for name, after in waiting.items() if name not in held and set(after) & (missing | held)}:
        held |= found
    return held


def _drop_strays(product: Product, store: Store) -> None:
    """Remove the records of units that the stage no longer has, and of failures that are tried again."""
    names = set(product.names)
    for path in store.records(product.stage):
        if path.stem not in names:
            path.unlink()
    for path in store.record(product.stage, "x").parent.glob("*.failed"):
        path.unlink()


def _failure_path(store: Store, product: Product, name: str):
    return store.record(product.stage, name).with_suffix(".failed")


def status(survey: Survey) -> list[tuple[str, int, int, int]]:
    """Return (stage, units, done, failed) of every stage of a store; units is -1 where it is not known yet."""
    store = survey.store
    assert store is not None
    rows = []
    for stage in stages(survey):
        folder = store.record(stage.name, "x").parent
        failed = len(list(folder.glob("*.failed")))
        done = len(store.records(stage.name))
        known = stage.name.startswith(("truth/", "pointings/"))
        if known or all(read_record(store, f"pointings/{name}", "all") for name in survey.instruments):
            units = len(stage.product(survey).units)
        else:
            units = -1
        rows.append((stage.name, units, done, failed))
    return rows


def run_figures(store: Store) -> list[dict]:
    """Return, a stage, units, seconds of work, bytes, rows and the largest memory of a worker, from the manifest."""
    rows = []
    for folder in sorted(path for path in (store.root / "manifest").glob("*/*") if path.is_dir()):
        stage = f"{folder.parent.name}/{folder.name}"
        records = [record for path in store.records(stage) if (record := read_record(store, stage, path.stem))]
        if records:
            rows.append(
                {
                    "stage": stage,
                    "units": len(records),
                    "seconds": sum(record.seconds for record in records),
                    "bytes": sum(record.bytes for record in records),
                    "rows": sum(record.rows for record in records),
                    "peak_bytes": max(record.peak_bytes for record in records),
                    "warnings": sum(len(record.warnings) for record in records),
                }
            )
    return rows


def stored_versions(store: Store) -> dict[str, str]:
    """Return the package versions that the store was made with."""
    return json.loads((store.root / "versions.json").read_text())
