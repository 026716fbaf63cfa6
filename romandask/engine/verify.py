"""Verification: every stored byte against what the manifest says was written."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from romandask.products.images import ImageProduct
from romandask.products.tables import TableProduct
from romandask.stage_graph import stages
from romandask.storage.checksums import damaged_files, remove_checksums
from romandask.storage.manifest import Record, read_records
from romandask.storage.paths import remove, remove_folder
from romandask.storage.store import Store
from romandask.survey import Survey

BESIDE = ("truth/seds", "store")
"""What is stored beside the units of stages: the library of spectra, and settings and versions."""


@dataclass(frozen=True)
class Verified:
    """What was found of one stage."""

    stage: str
    units: int
    """With a record."""
    damaged: tuple[tuple[str, str], ...]
    """Units, and files beside them, that are not as they were written, each with what was found."""


def verify(survey: Survey, only: str | None = None) -> Iterator[Verified]:
    """Yield, a stage at a time, what is stored and what of it is not as it was written. Nothing is changed.

    Parameters
    ----------
    only : a stage; None for all
    """
    store = survey.store
    assert store is not None
    for stage in stages(survey):
        if only is not None and stage.name != only:
            continue
        records = dict(read_records(store, stage.name))
        if not records:
            continue
        product, found = stage.product(survey), []
        numbers = {name: index for index, name in enumerate(product.names)}
        for name, record in records.items():
            why = _damage(product, store, numbers, name, record)
            if why is not None:
                found.append((name, why))
        yield Verified(stage.name, len(records), tuple(found + damaged_files(store, stage.name)))
    for name in BESIDE:
        if only in (None, name):
            yield Verified(name, 0, tuple(damaged_files(store, name)))


def forget(survey: Survey, found: Verified) -> None:
    """Remove the records of what is damaged in a stage, so that the next run makes it anew.

    Where files beside an image product's units are damaged, what the arrays are cannot be told for sure any more: all
    its units are forgotten.
    """
    store = survey.store
    assert store is not None
    beside = {name for name, _ in damaged_files(store, found.stage)}
    for name, _ in found.damaged:
        if name not in beside:
            remove(store.record(found.stage, name))
    if not beside:
        return
    remove_checksums(store, found.stage)
    for name in beside:
        remove(store.root / name)
    if store.images(found.stage).exists():
        remove_folder(store.images(found.stage))
        for name in store.recorded(found.stage):
            remove(store.record(found.stage, name))
    remove(store.catalog(found.stage) / "hats.properties")


def _damage(
    product: ImageProduct | TableProduct, store: Store, numbers: dict[str, int], name: str, record: Record | None
) -> str | None:
    """Return what is wrong with a unit; None where nothing is."""
    if record is None:
        return f"{store.record(product.stage, name)}: the record is damaged"
    if name not in numbers:
        return "the survey has no such unit any more"
    try:
        output = product.verify(numbers[name], store)
    except Exception as error:
        # whatever a decoder makes of damaged bytes
        return f"cannot be read ({type(error).__name__}: {str(error).splitlines()[0] if str(error) else ''})"
    return None if output == record.output else "not what was written"
