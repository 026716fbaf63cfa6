"""Seals: hashes of the files that belong to no unit, metadata and coordinates, so that their damage is found too."""

from __future__ import annotations

import json
from collections.abc import Iterable

from romandask.storage.manifest import digest
from romandask.storage.paths import AnyPath, files_below, remove
from romandask.storage.store import Store, write_json


def write_checksums(store: Store, stage: str, paths: Iterable[AnyPath]) -> None:
    """Write the hashes of some files of a stage."""
    # each once, in an order that is always the same
    files = [path for path in sorted(set(paths), key=str) if path.is_file()]
    found = {str(path.relative_to(store.root)): digest(path.read_bytes()) for path in files}
    write_json(_place(store, stage), {"files": found, "check": digest(found)})


def remove_checksums(store: Store, stage: str) -> None:
    """Take a stage's seal away, before its files are changed."""
    remove(_place(store, stage))


def has_checksums(store: Store, stage: str) -> bool:
    """True where a stage has a seal."""
    return _place(store, stage).exists()


def damaged_files(store: Store, stage: str) -> list[tuple[str, str]]:
    """Return the sealed files of a stage that are not as they were, each with what was found."""
    path = _place(store, stage)
    if not path.exists():
        return []
    try:
        content = json.loads(path.read_bytes())
        files = content["files"]
        if content["check"] != digest(files):
            return [(path.name, "the seal is damaged")]
    except (OSError, ValueError, KeyError, TypeError):
        return [(path.name, "the seal is damaged")]
    found = []
    for name, expected in files.items():
        file = store.root / name
        if not file.is_file():
            found.append((name, "is missing"))
        elif digest(file.read_bytes()) != expected:
            found.append((name, "not what was written"))
    return found


def _place(store: Store, stage: str) -> AnyPath:
    return store.root / "manifest" / stage / "files.seal"


def image_metadata_files(store: Store, stage: str, arrays: Iterable[str]) -> list[AnyPath]:
    """Return the metadata of an image product's arrays, and its coordinates."""
    root = store.images(stage)
    if not root.exists():
        return []
    units = set(arrays)
    found = [root / "zarr.json", *(root / name / "zarr.json" for name in units)]
    for folder in (path for path in root.iterdir() if path.is_dir() and path.name not in units):
        found += files_below(folder)
    return found


def catalog_metadata_files(store: Store, stage: str) -> list[AnyPath]:
    """Return the files of a HATS catalog that hold no rows."""
    root = store.catalog(stage)
    names = ("hats.properties", "properties", "partition_info.csv", "dataset/_metadata", "dataset/_common_metadata")
    return [*(root / name for name in names), store.collection(stage) / "collection.properties"]
