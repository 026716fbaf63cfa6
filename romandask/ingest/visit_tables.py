"""Visit tables of Rubin's data releases (Parquet), with what they lack of an OpSim database derived.

The columns are those of the tables Visit (DP0.2, DP1) and of the consolidated database (visit1). A Parquet file may
also have OpSim's own names.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterable

import numpy as np
import pandas as pd
import pyarrow.parquet as pq

from romandask.ingest.parquet import schema
from romandask.instruments.rubin.bands import BANDS
from romandask.instruments.rubin.depth import SYSTEM_FWHM
from romandask.instruments.rubin.site_sky import sky_brightness
from romandask.model.errors import UserError
from romandask.storage.paths import AnyPath, local_copy

COLUMNS = {
    "visit": ("visitId", "visit", "visit_id"),
    "band": ("band", "physical_filter"),
    "mjd": ("obsStartMJD", "obs_start_mjd", "expMidptMJD", "exp_midpt_mjd"),
    "exptime": ("expTime", "exp_time"),
    "ra": ("ra", "s_ra"),
    "dec": ("dec", "decl", "s_dec"),
    "pa": ("skyRotation", "sky_rotation"),
    "seeing": ("seeing_zenith_500nm_median", "seeing"),
    "airmass": ("airmass", "zenithDistance", "zenith_distance"),
    "sky_brightness": (),
}
"""Names in visit tables of each of our columns, the first that is there.

expMidptMJD is half an exposure after the start. `seeing` is the FWHM of the PSF, arcsec, in the band and airmass of the
visit. zenithDistance is in degrees. The position angle skyRotation is that of the focal plane's +y, as OpSim's
rotSkyPos.
"""


def is_parquet(path: AnyPath) -> bool:
    """Return whether a file is in Parquet, by its first bytes."""
    with path.open("rb") as file:
        return bool(file.read(4) == b"PAR1")


def columns_of(path: AnyPath) -> list[str]:
    """Return the names of the columns of a Parquet file.

    Raises
    ------
    UserError
        If the file is not complete, or has a row for each detector of a visit.
    """
    names: list[str] = schema(path).names
    if "detector" in {name.lower() for name in names}:
        raise UserError(
            f"{path}: has a column 'detector', so a row for each detector of a visit: give the table of visits"
        )
    return names


def rows_of(path: AnyPath, columns: Iterable[str]) -> pd.DataFrame:
    """Return some columns of a Parquet file; integers with missing values are objects, so that they keep all digits."""
    return pq.read_table(local_copy(path), columns=list(columns)).to_pandas(integer_object_nulls=True)


def completed(visits: pd.DataFrame, names: dict[str, str], where: str) -> pd.DataFrame:
    """Return visits with the quantities that OpSim has, derived from those of a visit table.

    Parameters
    ----------
    visits : DataFrame
        Numbers of the file, by our columns.
    names : dict
        Column of the file, by our column; without sky_brightness if the file has none.
    where : str
        First words of messages.

    Raises
    ------
    UserError
        If a PSF is narrower than telescope and camera alone.
    """
    if "midpt" in names["mjd"].lower():
        visits = visits.assign(mjd=visits["mjd"] - visits["exptime"] / 2 / 86400)
    if "zenith" in names["airmass"].lower():
        visits = visits.assign(airmass=1 / np.cos(np.radians(visits["airmass"])))
    if names["seeing"] == "seeing":
        visits = visits.assign(seeing=_atmosphere(visits))
        if (narrow := visits["seeing"].isna()).any():
            raise UserError(
                f"{where}column 'seeing', row {visits.index[narrow][0]}: the PSF is narrower than the telescope's "
                f"alone, as in {int(narrow.sum())} of {len(visits)} rows: give its FWHM in arcsec"
            )
    if "sky_brightness" not in names:
        warnings.warn(
            f"{where}no column {'skyBrightness'!r} (mag / arcsec2): the brightness of the sky is modelled from the "
            "positions of Sun and Moon",
            stacklevel=2,
        )
        sky = pd.Series(np.nan, visits.index)
        for band, group in visits.groupby("band"):
            sky[group.index] = sky_brightness(str(band), group["ra"], group["dec"], group["mjd"])
        visits = visits.assign(sky_brightness=sky)
    return visits


def _atmosphere(visits: pd.DataFrame) -> np.ndarray:
    """Return the FWHM of the atmosphere at 500 nm and zenith, arcsec; NaN if the PSF is too narrow to have one.

    It is the inverse of `romandask.instruments.rubin.depth.effective_fwhm`, after FWHMgeom = 0.822 FWHMeff + 0.052.
    """
    effective = (visits["seeing"].to_numpy(float) - 0.052) / 0.822
    at_zenith = effective / 1.16 / np.maximum(visits["airmass"].to_numpy(float), 1) ** 0.6
    waves = visits["band"].map({name: band.effective_wave for name, band in BANDS.items()}).to_numpy(float)
    squared = (at_zenith**2 - SYSTEM_FWHM**2) / 1.04
    return np.sqrt(np.where(squared > 0, squared, np.nan)) * (waves / 500) ** 0.3
