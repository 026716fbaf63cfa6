"""Sphinx extension: Markdown that is generated from the code at build time.

A page holds a line `<!-- generated: NAME -->`; it is replaced by the text of the function of that name in `CONTENT`.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

from sphinx.application import Sphinx
from typer.cli import get_docs_for_click
from typer.main import get_command

from romandask import Pipeline
from romandask.cli.main import app
from romandask.report.stage_tables import stage_table, table_locations

PLAIN_TYPES = {"string": "text", "number": "number", "integer": "integer", "boolean": "true or false"}
BOUNDS = (("minimum", "≥"), ("exclusiveMinimum", ">"), ("maximum", "≤"), ("exclusiveMaximum", "<"))
Schema = dict[str, Any]


def commands() -> str:
    """Return the help of every command, as typer writes it, without the title of the program."""
    command = get_command(app)
    context = command.make_context("romandask", [], resilient_parsing=True)
    text = get_docs_for_click(obj=command, ctx=context, name="romandask")
    return re.sub(r"^# `romandask`\n", "", text)


def settings() -> str:
    """Return a table of the settings of every section of a pipeline, from the schema of `romandask.Pipeline`."""
    schema = Pipeline.model_json_schema()
    plain = {key: value for key, value in schema["properties"].items() if _section(value) is None}
    parts = ["## Top level\n", _table(plain, "", set(schema["required"]), schema["$defs"])]
    for key, value in schema["properties"].items():
        name = _section(value)
        if name is not None:
            section = schema["$defs"][name]
            parts += [f"## `{key}`\n", section["description"] + "\n"]
            parts.append(_table(section["properties"], f"{key}.", set(section.get("required", ())), schema["$defs"]))
    return "\n".join(parts)


CONTENT = {
    "commands": commands,
    "settings": settings,
    "stages": stage_table,
    "tables": table_locations,
}


def _section(value: Schema) -> str | None:
    """Return the name of the section that a property holds; None for a plain value."""
    references = [option.get("$ref") for option in (value, *value.get("anyOf", ()))]
    return next((reference.rpartition("/")[2] for reference in references if reference), None)


def _table(properties: dict[str, Schema], prefix: str, required: set[str], sections: Schema) -> str:
    rows = ["| key | value | default | description |", "| --- | --- | --- | --- |"]
    for row in _rows(properties, prefix, required, sections):
        rows.append("| " + " | ".join(cell.replace("|", "\\|") for cell in row) + " |")
    return "\n".join(rows) + "\n"


def _rows(
    properties: dict[str, Schema], prefix: str, required: set[str], sections: Schema
) -> Iterator[tuple[str, str, str, str]]:
    for key, value in properties.items():
        name = _section(value)
        default = "required" if key in required else _default(value.get("default"))
        if name is None:
            yield f"`{prefix}{key}`", _kind(value), default, value.get("description", "")
        else:
            section = sections[name]
            if value.get("default", ...) is None:
                yield f"`{prefix}{key}`", "section", default, value.get("description", section["description"])
            yield from _rows(section["properties"], f"{prefix}{key}.", set(section.get("required", ())), sections)


def _default(value: Any) -> str:
    if value is None:
        return "none"
    return f"`{_yaml(value)}`" if value != "" else "empty"


def _yaml(value: Any) -> str:
    """Return a value as a pipeline file holds it, on one line."""
    if isinstance(value, dict):
        return "{" + ", ".join(f"{key}: {_yaml(item)}" for key, item in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(_yaml, value)) + "]"
    return str(value).lower() if isinstance(value, bool) else str(value)


def _kind(value: Schema) -> str:
    """Return what a value may be, in words."""
    options = [option for option in value.get("anyOf", ()) if option.get("type") != "null"]
    if options:
        return " or ".join(_kind(option) for option in options)
    if "enum" in value:
        return ", ".join(f"`{item}`" for item in value["enum"])
    if value.get("type") == "array":
        return f"list of {_kind(value['items'])}" if "items" in value else f"list of {len(value['prefixItems'])}"
    if value.get("type") == "object":
        inner = value.get("additionalProperties")
        return f"mapping to {_kind(inner)}" if isinstance(inner, dict) else "mapping"
    bounds = [f"{sign} {value[key]:g}" for key, sign in BOUNDS if key in value]
    return ", ".join([PLAIN_TYPES.get(value.get("type", ""), "value"), *bounds])


def _insert(_: Sphinx, __: str, source: list[str]) -> None:
    source[0] = re.sub(r"<!-- generated: (\w+) -->", lambda found: CONTENT[found[1]](), source[0])


def setup(sphinx: Sphinx) -> dict[str, Any]:
    """Connect the extension."""
    sphinx.connect("source-read", _insert)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
