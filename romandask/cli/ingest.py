"""Commands that convert real catalogs into the truth catalogs of a store."""

from __future__ import annotations

from typing import Annotated, Any

import typer
from rich.console import Console

from romandask.cli.interrupts import resumable
from romandask.cli.options import Order, Spectra, StoreOption, Workers, source_path
from romandask.engine.progress import Reporter
from romandask.model.errors import UserError
from romandask.storage.paths import AnyPath, resolve_below

ingest_app = typer.Typer(no_args_is_help=True, help="Convert a real catalog into the truth catalogs of a store.")


@ingest_app.command()
def skycatalogs(
    source: Annotated[
        Any, typer.Argument(metavar="SRC", parser=source_path, help="Folder of skyCatalogs files, or its YAML file.")
    ],
    store: StoreOption,
    seds: Spectra = None,
    order: Order = 5,
    workers: Workers = 0,
) -> None:
    """Convert skyCatalogs to HATS catalogs with fluxes in all ten bands; invalid rows are quarantined."""
    _ingest(source, {"source": "skycatalogs", "path": str(source)}, store, seds, order, workers)


@ingest_app.command("instance-catalog")
def instance_catalog(
    source: Annotated[
        Any, typer.Argument(metavar="SRC", parser=source_path, help="phoSim instance catalog, plain or .gz.")
    ],
    store: StoreOption,
    seds: Spectra = None,
    order: Order = 5,
    workers: Workers = 0,
) -> None:
    """Convert a DC2 instance catalog.

    The components of a galaxy become one row, and shears get the on-sky sign convention.
    """
    _ingest(source, {"source": "instance_catalog", "path": str(source)}, store, seds, order, workers)


@ingest_app.command()
def table(
    columns: Annotated[
        Any,
        typer.Argument(
            metavar="MAP",
            parser=source_path,
            help="YAML file with sections galaxies and stars, each with a path and columns (our name: file's name).",
        ),
    ],
    store: StoreOption,
    seds: Spectra = None,
    order: Order = 5,
    workers: Workers = 0,
) -> None:
    """Convert Parquet or FITS tables, with a map of their columns."""
    from romandask.model.settings import read_yaml

    sections = read_yaml(columns)
    unknown = sorted(set(sections) - {"galaxies", "stars"})
    if unknown or not sections:
        raise UserError(f"{columns}: holds {', '.join(unknown) or 'nothing'}; expected sections galaxies and stars")
    content: dict[str, Any] = {"source": "table"}
    for section, key in (("galaxies", "galaxy_table"), ("stars", "star_table")):
        if isinstance(sections.get(section), dict) and "path" in sections[section]:
            # relative to the folder of the map
            path = resolve_below(columns.parent, str(sections[section]["path"]))
            content[key] = sections[section] | {"path": str(path)}
        elif section in sections:
            raise UserError(f"{columns}: section {section} must hold path and columns")
    _ingest(columns, content, store, seds, order, workers)


@resumable()
def _ingest(
    source: AnyPath, truth: dict[str, Any], store: AnyPath, seds: AnyPath | None, order: int, workers: int | None
) -> None:
    from romandask import run as running
    from romandask.engine.clients import runner
    from romandask.pipeline import instrument_types, pipeline_of
    from romandask.storage.store import Store
    from romandask.survey import Survey

    content = {
        "name": "ingest",
        "seed": 0,
        "region": {"ra": [0, 360], "dec": [-90, 90]},
        "truth": {**truth, "order": order, "seds": str(seds or source.parent / "seds")},
        **{name: {} for name in instrument_types()},
    }
    settings = pipeline_of(content, str(source))
    survey = Survey(settings, Store(store))
    # opened before anything is written, so that an invalid source leaves no store behind
    survey.output("truth/ingested")
    Store(store).prepare()
    reporter = Reporter(Console())
    with runner(workers or 0, settings.run.memory_limit) as execution:
        counts = running.ingest(survey, execution, reporter)
    reporter.say(f"rows in {counts['in']} = rows out {counts['out']} + quarantined {counts['quarantined']}")
