"""Folders of Parquet files: those of a HATS catalog or collection are its partitions alone."""

from __future__ import annotations

from romandask.model.errors import UserError
from romandask.storage.paths import AnyPath

PROPERTIES = ("hats.properties", "properties")
"""Names of the file with the properties of a HATS catalog, in its versions."""
COLLECTION = "collection.properties"
"""File with the properties of a HATS collection: a catalog with its margins and indexes."""
PARTITION = "Norder="
"""Beginning of the folders that hold partitions. Other files of a catalog repeat its rows, such as its thumbnail."""
KINDS = ("object", "source", "map", "association")
"""Types of HATS catalogs whose rows are no repetitions of those of another catalog."""


def parquet_files(folder: AnyPath) -> dict[str, AnyPath]:
    """Return the Parquet files of a folder, at any depth, by their path relative to it.

    Of a HATS collection these are the partitions of its primary catalog; margins, indexes and thumbnails, which repeat
    rows, are left out, as are names that begin with _ or a dot.

    Raises
    ------
    UserError
        If there is no such file, or the folder is a margin or an index.
    """
    root = folder
    if (folder / COLLECTION).is_file():
        primary = _properties(folder / COLLECTION).get("hats_primary_table_url", "")
        root = folder / primary
        if not primary or not root.is_dir():
            raise UserError(f"{folder / COLLECTION}: names the catalog {primary!r}, which is not there: copy it too")
    files = {file.relative_to(root).parts: file for file in sorted(root.rglob("*.parquet"))}
    files = {parts: file for parts, file in files.items() if not any(part.startswith(("_", ".")) for part in parts)}
    if any(part.startswith(PARTITION) for parts in files for part in parts):
        files = {parts: file for parts, file in files.items() if any(part.startswith(PARTITION) for part in parts)}
    for described in sorted(path for name in PROPERTIES for path in root.rglob(name)):
        kind = _properties(described).get("dataproduct_type", KINDS[0])
        if kind in KINDS:
            continue
        if described.parent == root:
            raise UserError(f"{folder}: is the {kind} of a HATS catalog, which repeats its rows: name the catalog")
        below = described.parent.relative_to(root).parts
        files = {parts: file for parts, file in files.items() if parts[: len(below)] != below}
    if not files:
        raise UserError(f"{root}: holds no .parquet file")
    return {file.relative_to(folder).as_posix(): file for file in files.values()}


def _properties(path: AnyPath) -> dict[str, str]:
    """Return the content of a properties file: lines `key=value`, and remarks after #."""
    pairs = [line.partition("=") for line in path.read_text().splitlines() if not line.startswith("#")]
    return {key.strip(): value.strip() for key, sign, value in pairs if sign}
