"""Output of the command `plan`: a table, or two lines per stage on a narrow terminal."""

from __future__ import annotations

from collections.abc import Sequence

from rich.console import Console
from rich.measure import Measurement
from rich.table import Column, Table

from romandask.run import PlannedStage

_HEADERS = ("units", "image bytes", "core hours", "worker memory")


def print_plan(rows: Sequence[PlannedStage], memory_limit: float, console: Console) -> None:
    """Print the plan of a survey with all its numbers, whatever the width of the console.

    Parameters
    ----------
    rows : sequence of PlannedStage
        The stages.
    memory_limit : float
        Memory limit of a worker, GiB.
    console : rich.console.Console
        Destination. If it is too narrow for the table, the name of a stage has a line of its own.
    """
    stages = {row.stage: _cells(row) for row in rows}
    stages["total"] = (
        str(sum(row.units for row in rows)),
        f"{sum(row.bytes for row in rows) / 1e9:.2f} GB",
        f"{sum(row.hours for row in rows):.2f}",
        f"limit {memory_limit:.2f} GiB",
    )
    table = Table(Column("stage", no_wrap=True), *(Column(header, no_wrap=True) for header in _HEADERS))
    for name, cells in stages.items():
        table.add_row(name, *cells)
    needed = Measurement.get(console, console.options.update(width=10_000), table).maximum
    if needed <= console.width:
        console.print(table)
        return
    # the headers are split, because they are wider than most numbers
    lines = [tuple(header.partition(" ")[k] for header in _HEADERS) for k in (0, 2)]
    widths = [max(map(len, column)) for column in zip(*lines, *stages.values(), strict=True)]
    gap = " " * max(1, min(3, (console.width - sum(widths)) // len(widths)))
    text = ["stage", *(_aligned(cells, widths, gap) for cells in lines)]
    for name, cells in stages.items():
        text += [name, _aligned(cells, widths, gap)]
    console.print("\n".join(text), highlight=False, markup=False, soft_wrap=True)


def _cells(row: PlannedStage) -> tuple[str, ...]:
    size = f"{row.bytes / 1e9:.2f} GB" if row.bytes else "-"
    hours = f"{row.hours:.2f}" if row.hours else "-"
    return str(row.units), size, hours, f"{row.memory / 2**30:.2f} GiB"


def _aligned(cells: Sequence[str], widths: Sequence[int], gap: str) -> str:
    return gap.join(cell.rjust(width) for cell, width in zip(cells, widths, strict=True))
