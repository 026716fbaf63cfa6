"""Catalog schemas: catalogs/<product>.yaml to an Arrow schema with units, UCDs and descriptions."""

from __future__ import annotations

from functools import lru_cache

import pyarrow as pa

from romandask.model.resources import resource_folder
from romandask.model.settings import read_yaml

TYPES = {
    "int8": pa.int8(),
    "int16": pa.int16(),
    "int32": pa.int32(),
    "int64": pa.int64(),
    "float32": pa.float32(),
    "float64": pa.float64(),
    "bool": pa.bool_(),
    "string": pa.string(),
    "list<float32>": pa.list_(pa.float32()),
}


@lru_cache(maxsize=32)
def schema(name: str, bands: tuple[str, ...] = ()) -> pa.Schema:
    """Return the schema of a product; columns with {band} are repeated for every band, with {rubin} for LSST's."""
    content = read_yaml(resource_folder("catalogs") / f"{name}.yaml")
    fields = []
    for column in content["columns"]:
        for mark, values in (("{band}", bands), ("{rubin}", tuple("ugrizy")), ("", ("",))):
            if mark in column["name"]:
                fields += [_field(column, mark, value) for value in values]
                break
    return pa.schema(fields, metadata={"description": content["description"]})


def _field(column: dict, mark: str, value: str) -> pa.Field:
    name, description = column["name"], column["description"]
    if mark:
        name, description = name.replace(mark, value), description.replace(mark, value)
    metadata = {"unit": column.get("unit") or "", "ucd": column.get("ucd") or "", "description": description}
    return pa.field(name, TYPES[column["dtype"]], metadata=metadata)
