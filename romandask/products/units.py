"""Units: the things that a stage makes, one by one; a survey may have hundreds of thousands, made when asked for."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, overload


@dataclass(frozen=True)
class Unit:
    """One thing that a stage makes."""

    name: str
    """Unique within the stage; also its file name."""
    settings: Any
    """Everything but upstream units that its content depends on, as values that JSON can hold."""
    inputs: tuple[tuple[str, str], ...] = ()
    """(stage, unit) of the upstream units that it reads."""
    cost: float = 1.0
    """Relative time, so that long units go first."""
    prerequisites: tuple[str, ...] = ()
    """Units of the same stage that must be there before it; `settings` and `inputs` say what it takes from them."""
    optional: tuple[tuple[str, str], ...] = ()
    """Upstream units that it reads where they are there, and can be made without."""
    affinity: str = ""
    """Units of one kin are made one after another: what a worker keeps for the one it has for the next."""


@dataclass(frozen=True)
class LazyUnits(Sequence[Unit]):
    """Units of which only the names are there; the rest is worked out for one when it is asked for."""

    names: tuple[str, ...]
    make: Callable[[int], Unit]

    def __reduce__(self) -> tuple[Any, ...]:
        # whoever makes units elsewhere is told which and needs their names alone
        return LazyUnits, (self.names, _not_here)

    def __len__(self) -> int:
        return len(self.names)

    @overload
    def __getitem__(self, index: int) -> Unit: ...
    @overload
    def __getitem__(self, index: slice) -> Sequence[Unit]: ...
    def __getitem__(self, index: int | slice) -> Unit | Sequence[Unit]:
        """Return one unit, or those of a slice."""
        if isinstance(index, slice):
            return [self.make(k) for k in range(*index.indices(len(self)))]
        return self.make(range(len(self))[index])

    def __iter__(self) -> Iterator[Unit]:
        return map(self.make, range(len(self)))


def _not_here(index: int) -> Unit:
    raise RuntimeError("units are worked out where the product was put together, not where they are made")


def names_of(units: Sequence[Unit]) -> tuple[str, ...]:
    """Return the names of units."""
    return units.names if isinstance(units, LazyUnits) else tuple(unit.name for unit in units)


@dataclass(frozen=True)
class Made:
    """What storing one unit wrote."""

    output: str
    """Hash of the content."""
    bytes: int
    rows: int
