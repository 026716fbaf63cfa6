"""Checksums of the files that belong to no unit (metadata and coordinates), so that damage to them is found too."""

from __future__ import annotations

import json
from collections.abc import Iterable

from romandask.storage.manifest import digest
from romandask.storage.paths import AnyPath, files_below, remove
from romandask.storage.store import Store, write_json


def write_checksums(store: Store, stage: str, paths: Iterable[AnyPath]) -> None:
    """Write the hashes of the given files of a stage; files that do not exist are left out."""
    # sorted, so that the hash of the hashes does not depend on the order of the paths
    files = [path for path in sorted(set(paths), key=str) if path.is_file()]
    hashes = {str(path.relative_to(store.root)): digest(path.read_bytes()) for path in files}
    write_json(_checksum_file(store, stage), {"files": hashes, "check": digest(hashes)})


def remove_checksums(store: Store, stage: str) -> None:
    """Remove the checksum file of a stage, before the stage's files are changed."""
    remove(_checksum_file(store, stage))


def has_checksums(store: Store, stage: str) -> bool:
    """Return whether a stage has a checksum file."""
    return _checksum_file(store, stage).exists()


def damaged_files(store: Store, stage: str) -> list[tuple[str, str]]:
    """Return the files of a stage that differ from their checksums.

    Returns
    -------
    list of (str, str)
        Path below the store and what is wrong with the file; empty if the stage has no checksum file.
    """
    path = _checksum_file(store, stage)
    if not path.exists():
        return []
    try:
        content = json.loads(path.read_bytes())
        hashes = content["files"]
        if content["check"] != digest(hashes):
            return [(path.name, "the checksums are damaged")]
    except (OSError, ValueError, KeyError, TypeError):
        return [(path.name, "the checksums are damaged")]
    damaged = []
    for name, expected in hashes.items():
        file = store.root / name
        if not file.is_file():
            damaged.append((name, "is missing"))
        elif digest(file.read_bytes()) != expected:
            damaged.append((name, "not what was written"))
    return damaged


def _checksum_file(store: Store, stage: str) -> AnyPath:
    return store.root / "manifest" / stage / "files.seal"


def image_metadata_files(store: Store, stage: str, arrays: Iterable[str]) -> list[AnyPath]:
    """Return the metadata files of an image product and all files of its coordinates.

    Parameters
    ----------
    store : Store
        Store with the product.
    stage : str
        Stage of the product.
    arrays : iterable of str
        Names of the arrays that hold units; every other array of the group is a coordinate.
    """
    root = store.images(stage)
    if not root.exists():
        return []
    unit_arrays = set(arrays)
    files = [root / "zarr.json", *(root / name / "zarr.json" for name in unit_arrays)]
    for folder in (path for path in root.iterdir() if path.is_dir() and path.name not in unit_arrays):
        files += files_below(folder)
    return files


def catalog_metadata_files(store: Store, stage: str) -> list[AnyPath]:
    """Return the paths of the files of a HATS catalog that hold no rows, whether they exist or not."""
    root = store.catalog(stage)
    names = ("hats.properties", "properties", "partition_info.csv", "dataset/_metadata", "dataset/_common_metadata")
    return [*(root / name for name in names), store.collection(stage) / "collection.properties"]
