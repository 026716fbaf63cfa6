"""Units: the pieces in which a stage makes its product. A survey may have hundreds of thousands of them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, overload


@dataclass(frozen=True)
class Unit:
    """One piece of a product, made and stored by one task."""

    name: str
    """Name, unique within the stage; also the file name."""
    settings: Any
    """Everything that the content depends on apart from upstream units, as JSON values."""
    inputs: tuple[tuple[str, str], ...] = ()
    """(stage, unit) of the upstream units that this unit reads."""
    cost: float = 1.0
    """Relative time to make the unit; the most expensive units are made first."""
    prerequisites: tuple[str, ...] = ()
    """Units of the same stage that must be stored first. What this unit takes from them is covered by `settings` and
    `inputs`."""
    optional: tuple[tuple[str, str], ...] = ()
    """(stage, unit) of upstream units that this unit reads if they are stored, and does not need."""


@dataclass(frozen=True)
class LazyUnits(Sequence[Unit]):
    """Sequence of units with known names; each unit is constructed when it is accessed.

    A serialised copy, such as a worker receives, has only the names; its units cannot be accessed.
    """

    names: tuple[str, ...]
    """Names of the units."""
    make: Callable[[int], Unit]
    """Constructs the unit with a given index."""

    def __reduce__(self) -> tuple[Any, ...]:
        # a worker receives the index of a unit and needs only its name; `make` may hold large objects
        return LazyUnits, (self.names, _unavailable)

    def __len__(self) -> int:
        return len(self.names)

    @overload
    def __getitem__(self, index: int) -> Unit: ...
    @overload
    def __getitem__(self, index: slice) -> Sequence[Unit]: ...
    def __getitem__(self, index: int | slice) -> Unit | Sequence[Unit]:
        """Return one unit, or a list of the units of a slice."""
        if isinstance(index, slice):
            return [self.make(k) for k in range(*index.indices(len(self)))]
        return self.make(range(len(self))[index])

    def __iter__(self) -> Iterator[Unit]:
        return map(self.make, range(len(self)))


def _unavailable(index: int) -> Unit:
    raise RuntimeError("units were serialised as names only; access them in the process that constructed the product")


def names_of(units: Sequence[Unit]) -> tuple[str, ...]:
    """Return the names of units."""
    return units.names if isinstance(units, LazyUnits) else tuple(unit.name for unit in units)


@dataclass(frozen=True)
class Made:
    """Summary of a unit that has been written."""

    output: str
    """Hash of the content."""
    bytes: int
    """Uncompressed size, bytes."""
    rows: int
    """Number of rows of a table, or of elements of the largest array of an image product."""
