"""Options that several commands share.

Arguments that commands of `romandask export` have too are in `romandask.export.options`.
"""

from __future__ import annotations

from typing import Annotated, Any

import typer

from romandask.storage.paths import AnyPath, parse_path


def source_path(text: str) -> AnyPath:
    """Return the path of an input."""
    return parse_path(text, "a source")


StoreOption = Annotated[
    Any,
    typer.Option("--store", metavar="FOLDER", parser=parse_path, help="Folder of the store, or s3://BUCKET/FOLDER."),
]
Workers = Annotated[
    int | None,
    typer.Option("--workers", min=0, help="Number of local worker processes; 0 runs everything in this process."),
]
Scheduler = Annotated[
    str | None, typer.Option("--scheduler", help="Address of an existing dask scheduler, for example tcp://host:8786.")
]
Spectra = Annotated[
    Any,
    typer.Option(
        "--seds",
        metavar="FOLDER",
        parser=source_path,
        help="Folder of the spectra that the catalog names, or exported seds.hdf5; default: seds beside the catalog.",
    ),
]
Order = Annotated[int, typer.Option("--order", min=3, max=12, help="HEALPix order of the partitions of the catalogs.")]
