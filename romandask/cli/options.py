"""Options that several commands share, and the handling of interrupts.

Arguments that commands of `romandask export` have too are in `romandask.export.options`.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Annotated, Any

import typer

from romandask.storage.paths import AnyPath, parse_path


def source_place(text: str) -> AnyPath:
    """Return the place of something that is read."""
    return parse_path(text, "a source")


StoreOption = Annotated[
    Any,
    typer.Option("--store", metavar="FOLDER", parser=parse_path, help="Folder of the store, or s3://BUCKET/FOLDER."),
]
Workers = Annotated[int | None, typer.Option("--workers", min=0, help="Local processes; 0 runs in this one.")]
Scheduler = Annotated[
    str | None, typer.Option("--scheduler", help="Address of an existing dask scheduler, tcp://host:port.")
]
Spectra = Annotated[
    Any,
    typer.Option("--seds", parser=source_place, help="Folder of the spectra that are named; default: seds beside SRC."),
]
Order = Annotated[int, typer.Option("--order", min=3, max=12, help="HEALPix order of the partitions.")]


@contextmanager
def resumable(text: str = "stopped; the same command resumes") -> Iterator[None]:
    """Turn an interrupt into one line: what is stored stays, and the same command goes on from there."""
    try:
        yield
    except KeyboardInterrupt:
        print(text, file=sys.stderr)
        raise typer.Exit(130) from None
