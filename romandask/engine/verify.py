"""Verification of a store: compare the stored bytes with the hashes in the manifest."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from romandask.engine.run_stages import RunnableStage
from romandask.engine.staleness import remove_failures
from romandask.products.images import ImageProduct
from romandask.products.tables import TableProduct
from romandask.storage.checksums import damaged_files, remove_checksums
from romandask.storage.manifest import Record, read_records
from romandask.storage.paths import remove, remove_folder
from romandask.storage.store import Store

OTHER_FILES = ("truth/seds", "store")
"""Names of the checksums of files that belong to no unit: the spectral library, and settings with versions."""
ALL_UNITS = "*"
"""Stands for the units of a stage whose names cannot be known."""


@dataclass(frozen=True)
class Verified:
    """Result of the verification of one stage."""

    stage: str
    """Name of the stage, or one of `OTHER_FILES`."""
    units: int
    """Number of units with a record."""
    damaged: tuple[tuple[str, str], ...]
    """Name and damage of each unit or metadata file whose content differs from what was written."""


def verify(stages: list[RunnableStage], store: Store, only: str | None = None) -> Iterator[Verified]:
    """Yield, for each stored stage, the number of units and the damaged units. Nothing is changed.

    Parameters
    ----------
    stages : list of RunnableStage
        Stages of the survey.
    store : Store
        The store to read.
    only : str or None
        Name of one stage, or one of `OTHER_FILES`; None for all.
    """
    for stage in stages:
        if only is not None and stage.name != only:
            continue
        records = dict(read_records(store, stage.name))
        if not records:
            continue
        damaged: list[tuple[str, str]] = []
        try:
            product = stage.product()
        except Exception as error:
            # its units follow from products that are damaged too, which were verified before
            sources = ", ".join(sorted(stage.known_after))
            reason = f"cannot be verified before {sources} is made again ({type(error).__name__})"
            yield Verified(stage.name, len(records), ((ALL_UNITS, reason),))
            continue
        numbers = {name: index for index, name in enumerate(product.names)}
        for name, record in records.items():
            damage = _damage(product, store, numbers, name, record)
            if damage is not None:
                damaged.append((name, damage))
        yield Verified(stage.name, len(records), tuple(damaged + damaged_files(store, stage.name)))
    for name in OTHER_FILES:
        if only in (None, name):
            yield Verified(name, 0, tuple(damaged_files(store, name)))


def forget(store: Store, verified: Verified) -> None:
    """Remove the records of the damaged units of a stage, so that the next run makes these units again.

    If metadata of an image product is damaged, the content of its arrays is uncertain: the arrays and the records of
    all units are removed. Failures of units are removed too: units that have read damaged data failed, and would be
    skipped, because that data will be the same as before when it is made again.
    """
    if verified.damaged:
        remove_failures(store)
    metadata = {name for name, _ in damaged_files(store, verified.stage)}
    for name, _ in verified.damaged:
        if name not in metadata and name != ALL_UNITS:
            remove(store.record(verified.stage, name))
    if not metadata:
        return
    remove_checksums(store, verified.stage)
    for name in metadata:
        remove(store.root / name)
    if store.images(verified.stage).exists():
        remove_folder(store.images(verified.stage))
        for name in store.recorded(verified.stage):
            remove(store.record(verified.stage, name))
    remove(store.catalog(verified.stage) / "hats.properties")


def _damage(
    product: ImageProduct | TableProduct, store: Store, numbers: dict[str, int], name: str, record: Record | None
) -> str | None:
    """Return a description of the damage of a unit, or None if it is intact."""
    if record is None:
        return f"{store.record(product.stage, name)}: the record is damaged"
    if name not in numbers:
        return "the survey has no such unit any more"
    try:
        output = product.verify(numbers[name], store)
    except Exception as error:
        # a decoder of damaged bytes can raise anything
        return f"cannot be read ({type(error).__name__}: {str(error).splitlines()[0] if str(error) else ''})"
    return None if output == record.output else "not what was written"
