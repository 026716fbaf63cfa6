"""Catalog schemas: Arrow schemas, with units, UCDs and descriptions, read from catalogs/<product>.yaml."""

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
    """Return the schema of a product.

    Parameters
    ----------
    name : str
        Name of the file in catalogs/, without .yaml.
    bands : tuple of str
        Bands for which columns with {band} in their name are repeated. Columns with {rubin} are repeated for the six
        LSST bands.
    """
    content = read_yaml(resource_folder("catalogs") / f"{name}.yaml")
    fields = []
    for column in content["columns"]:
        for placeholder, values in (("{band}", bands), ("{rubin}", tuple("ugrizy")), ("", ("",))):
            if placeholder in column["name"]:
                fields += [_field(column, placeholder, value) for value in values]
                break
    return pa.schema(fields, metadata={"description": content["description"]})


def _field(column: dict, placeholder: str, value: str) -> pa.Field:
    name, description = column["name"], column["description"]
    if placeholder:
        name, description = name.replace(placeholder, value), description.replace(placeholder, value)
    metadata = {"unit": column.get("unit") or "", "ucd": column.get("ucd") or "", "description": description}
    return pa.field(name, TYPES[column["dtype"]], metadata=metadata)
