"""The commands of `romandask calibration`: calibration files of Roman's detectors."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from romandask.engine.progress import busy
from romandask.export.command import report_written
from romandask.export.options import Folder

calibration_app = typer.Typer(no_args_is_help=True)


@calibration_app.callback()
def calibrating(context: typer.Context) -> None:
    """Calibration files of Roman's detectors."""
    context.with_resource(busy("on calibration files"))


@calibration_app.command()
def make(
    out: Folder,
    seed: Annotated[int, typer.Option("--seed", min=0, help="The same files from the same seed.")] = 0,
    sca: Annotated[list[int] | None, typer.Option("--sca", help="SCA, 1-18; may be repeated; default: all.")] = None,
) -> None:
    """Make calibration files of made-up detectors, with the statistics of the real ones: 1.6 GB an SCA."""
    from romandask.instruments.roman.calibration import make_files
    from romandask.instruments.roman.focal_plane import SCAS

    report_written(make_files(out, seed, sca or SCAS))


@calibration_app.command()
def check(
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="Folder of sca01.fits to sca18.fits.")],
) -> None:
    """Check that calibration files have every extension of table 1 of Troxel et al. (2023), with its type and shape."""
    from romandask.instruments.roman.calibration import check_files

    for path in check_files(folder):
        Console().print(f"{path}: as it should be", highlight=False, soft_wrap=True)
