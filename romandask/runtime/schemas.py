"""Catalog schemas: catalogs/<product>.yaml to an Arrow schema with units, UCDs and descriptions."""

from __future__ import annotations

from functools import lru_cache

import pyarrow as pa

from romandask.model.config import read_yaml
from romandask.model.resources import resource_folder

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
    """Return the schema of a product; columns named with {band} are repeated for every band."""
    content = read_yaml(resource_folder("catalogs") / f"{name}.yaml")
    fields = []
    for column in content["columns"]:
        for band in bands if "{band}" in column["name"] else ("",):
            metadata = {
                "unit": column.get("unit") or "",
                "ucd": column.get("ucd") or "",
                "description": column["description"].replace("{band}", band),
            }
            fields.append(pa.field(column["name"].replace("{band}", band), TYPES[column["dtype"]], metadata=metadata))
    return pa.schema(fields, metadata={"description": content["description"]})
