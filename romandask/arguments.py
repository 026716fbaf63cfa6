"""Arguments that several commands have, and what they do alike."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer

from romandask.model.errors import UserError


def _folder(text: str) -> Path:
    """Return a folder: an address would become one that is named as it is."""
    if "://" in text:
        raise UserError(f"{text}: a store is a folder of this machine, or one that is mounted on it; addresses are not")
    return Path(text)


Source = Annotated[
    str, typer.Argument(metavar="PIPELINE", help="A YAML file, or the name of a pipeline that came with the package.")
]
Overrides = Annotated[
    list[str] | None, typer.Argument(metavar="[KEY=VALUE]...", help="Settings, for example coadds.pixfrac=0.8.")
]
Place = Annotated[Path, typer.Option("--store", metavar="FOLDER", parser=_folder, help="Folder of the store.")]
Workers = Annotated[int | None, typer.Option("--workers", min=0, help="Local processes; 0 runs in this one.")]
Scheduler = Annotated[
    str | None, typer.Option("--scheduler", help="Address of an existing dask scheduler, tcp://host:port.")
]
StoreArgument = Annotated[Path, typer.Argument(metavar="STORE", parser=_folder, help="Folder of the store.")]
Spectra = Annotated[
    Path | None, typer.Option("--seds", help="Folder of the spectra that are named; default: seds beside SRC.")
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
