"""Observing sequences of Roman visits: FITS files with a table in HDU 1, as the mission publishes them.

`romandask.ingest.obseq` reads these files and describes their columns.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
import pandas as pd
import typer
from astropy.io import fits

from romandask.export.command import export_command, report_written
from romandask.export.files import completed, make_folder
from romandask.export.options import Overrides, Source
from romandask.ingest.obseq import COLUMNS
from romandask.model.errors import UserError
from romandask.pipeline import load_pipeline
from romandask.survey import Survey


def export_obseq(survey: Survey, path: Path) -> int:
    """Write all visits of the sharpest survey as an observing sequence.

    Parameters
    ----------
    survey : Survey
        Survey, stored or not. The visits are those of `survey.sharpest`, also outside the region.
    path : Path
        FITS file.

    Returns
    -------
    int
        Number of visits.

    Raises
    ------
    UserError
        If the folder of the file cannot be created.
    """
    visits = survey.visits(survey.sharpest)
    make_folder(path.parent)
    write_obseq(path, visits)
    return len(visits)


def write_obseq(path: Path, visits: pd.DataFrame) -> None:
    """Write visits as an observing sequence; `romandask.ingest.obseq.read` is the inverse.

    The table is that of the mission's own file: five columns of doubles and one of text; the row index is the visit.

    Parameters
    ----------
    path : Path
        FITS file. It appears under its name when it is complete.
    visits : DataFrame
        Columns visit, band, mjd, exptime (s), ra, dec and pa (degrees).

    Raises
    ------
    UserError
        If the visits are not numbered 0, 1, 2...
    """
    visits = visits.sort_values("visit")
    if not np.array_equal(visits["visit"], np.arange(len(visits))):
        raise UserError(f"{path}: column 'visit': expected 0 to {len(visits) - 1} once each, as it is the row's index")
    bands = visits["band"].astype(str).tolist()
    names = dict(zip(COLUMNS[:-1], ("mjd", "exptime", "ra", "dec", "pa"), strict=True))
    columns = [fits.Column(name, "D", array=visits[own_name].to_numpy(float)) for name, own_name in names.items()]
    columns.append(fits.Column(COLUMNS[-1], f"{max(4, *map(len, bands), 0)}A", array=bands))
    with completed(path) as temporary:
        fits.BinTableHDU.from_columns(columns).writeto(temporary, overwrite=True)


@export_command("obseq")
def command(
    pipeline: Source,
    out: Annotated[Path, typer.Argument(metavar="OUT", help="FITS file.")],
    overrides: Overrides = None,
) -> None:
    """Write all Roman visits of a pipeline as an observing sequence (FITS) that GalSim-based tools read."""
    count = export_obseq(Survey(load_pipeline(pipeline, overrides)), out)
    report_written([out], f"{count} visits")
