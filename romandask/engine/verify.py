"""Verify a store: every stored byte against what the manifest says was written."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from romandask.engine.run_stages import RunnableStage
from romandask.products.images import ImageProduct
from romandask.products.tables import TableProduct
from romandask.storage.checksums import damaged_files, remove_checksums
from romandask.storage.manifest import Record, read_records
from romandask.storage.paths import remove, remove_folder
from romandask.storage.store import Store

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


def verify(stages: list[RunnableStage], store: Store, only: str | None = None) -> Iterator[Verified]:
    """Yield, stage by stage, how many units are stored and which are not as they were written. Nothing is changed.

    Parameters
    ----------
    only : str or None
        Name of one stage's product, or of one of `BESIDE`; None for all.
    """
    for stage in stages:
        if only is not None and stage.name != only:
            continue
        records = dict(read_records(store, stage.name))
        if not records:
            continue
        product, damaged = stage.product(), []
        numbers = {name: index for index, name in enumerate(product.names)}
        for name, record in records.items():
            why = _damage(product, store, numbers, name, record)
            if why is not None:
                damaged.append((name, why))
        yield Verified(stage.name, len(records), tuple(damaged + damaged_files(store, stage.name)))
    for name in BESIDE:
        if only in (None, name):
            yield Verified(name, 0, tuple(damaged_files(store, name)))


def forget(store: Store, verified: Verified) -> None:
    """Remove the records of the damaged units of a stage, so that the next run makes them again.

    Where metadata beside the units of an image product is damaged, the content of its arrays is no longer certain: the
    records of all its units are removed.
    """
    beside = {name for name, _ in damaged_files(store, verified.stage)}
    for name, _ in verified.damaged:
        if name not in beside:
            remove(store.record(verified.stage, name))
    if not beside:
        return
    remove_checksums(store, verified.stage)
    for name in beside:
        remove(store.root / name)
    if store.images(verified.stage).exists():
        remove_folder(store.images(verified.stage))
        for name in store.recorded(verified.stage):
            remove(store.record(verified.stage, name))
    remove(store.catalog(verified.stage) / "hats.properties")


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
