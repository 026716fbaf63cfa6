"""Markdown tables that the documentation has of the stages, from their declarations."""

from __future__ import annotations

from romandask.model.resources import resource_folder
from romandask.model.settings import read_yaml
from romandask.stage_graph import STAGES


def stage_table() -> str:
    """Return a table of all stages: name, unit, what each reads, and what it makes."""
    lines = ["| stage | unit | reads | content |", "| --- | --- | --- | --- |"]
    for stage in STAGES:
        name = f"{stage.name}/<survey>" if stage.per_survey else stage.name
        reads = ", ".join(f"`{read}`" for read in stage.reads)
        summary = stage.summary + (" Made on demand, not stored." if stage.on_demand else "")
        lines.append(f"| `{name}` | {stage.unit} | {reads} | {summary} |")
    return "\n".join(lines) + "\n"


def table_locations() -> str:
    """Return a table of all schemas: where each table is in a store, and how it is partitioned."""
    places: dict[str, list[str]] = {}
    for stage in STAGES:
        for schema, place in stage.tables.items():
            places.setdefault(schema, []).append(f"`{place}`")
    lines = ["| schema | table in the store | partitioning |", "| --- | --- | --- |"]
    for schema, found in places.items():
        partitioning = read_yaml(resource_folder("catalogs") / f"{schema}.yaml")["partitioning"]
        lines.append(f"| `{schema}.yaml` | {', '.join(found)} | {partitioning} |")
    return "\n".join(lines) + "\n"
