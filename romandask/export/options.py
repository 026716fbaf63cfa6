"""Annotated arguments and options that several commands share."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from romandask.storage.paths import parse_path

Source = Annotated[str, typer.Argument(metavar="PIPELINE", help="YAML file, or name of a pipeline of the package.")]
Overrides = Annotated[
    list[str] | None,
    typer.Argument(metavar="KEY=VALUE", help="Settings that override the pipeline, for example coadds.pixfrac=0.8."),
]
StoreArgument = Annotated[
    Any, typer.Argument(metavar="STORE", parser=parse_path, help="Folder of the store, or s3://BUCKET/FOLDER.")
]
Folder = Annotated[Path, typer.Argument(metavar="OUT", help="Folder of the files.")]
ExposureNames = Annotated[
    list[str] | None, typer.Option("--exposure", help="Name, for example H158-12-7; may be repeated.")
]
TileNames = Annotated[list[str] | None, typer.Option("--tile", help="Name; may be repeated.")]
TileBands = Annotated[
    list[str] | None, typer.Option("--band", help="Band of the tiles; may be repeated; default: all.")
]
Bands = Annotated[list[str] | None, typer.Option("--band", help="May be repeated; default: all.")]
