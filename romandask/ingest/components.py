"""Components of galaxies that are rows of their own, as in instance catalogs, and their merger into galaxies."""

from __future__ import annotations

import numpy as np
import pandas as pd

from romandask.ingest.rows import COMPONENTS


def merge_components(frame: pd.DataFrame) -> pd.DataFrame:
    """Merge the rows that describe components of the same galaxy into one row per galaxy.

    Rows of galaxies with the same identifier are components of one galaxy. If several have the same component, all but
    the first are quarantined. All rows of a galaxy are quarantined if they disagree in position (by more than
    0.1 arcsec), redshift, lensing, position angle, dust of the Milky Way, or in the size and dust that disk and knots
    share. Of stars with the same identifier, all but the first are quarantined.

    Parameters
    ----------
    frame : DataFrame
        Rows in the normal form.

    Returns
    -------
    DataFrame
        Merged and quarantined rows, with the additional column `n_rows`, the number of source rows that each stands
        for. It is 1 for quarantined rows, so the number of input rows equals the sum of `n_rows` of the good rows plus
        the number of quarantined rows.
    """
    frame = frame.reset_index(drop=True).assign(n_rows=np.int32(1))
    good = frame["reason"] == ""
    stars = frame.index[good & (frame["kind"] == "star")]
    frame.loc[stars[frame.loc[stars, "id"].duplicated()], "reason"] = "duplicate id"
    galaxies = frame[good & (frame["kind"] == "galaxy")]
    several = galaxies[galaxies["id"].duplicated(keep=False)]
    if not len(several):
        return frame
    lit = pd.DataFrame({c: np.isfinite(several[f"{c}_magnorm"]) for c in COMPONENTS}, index=several.index)
    repeated = (lit & (lit.groupby(several["id"]).cumsum() > 1)).any(axis=1)
    frame.loc[several.index[repeated], "reason"] = "a component of this galaxy is listed twice"
    several, lit = several[~repeated], lit[~repeated]
    several = several[several["id"].duplicated(keep=False)]
    lit = lit.loc[several.index]
    for text, bad in _disagreements(several, lit).items():
        rows = bad.groupby(several["id"]).transform("any") & (frame.loc[several.index, "reason"] == "")
        frame.loc[several.index[rows], "reason"] = text
    several = several[frame.loc[several.index, "reason"] == ""]
    if not len(several):
        return frame
    merged = _combined(several, lit.loc[several.index])
    return pd.concat([frame.drop(several.index), merged]).sort_index().reset_index(drop=True)


def _combined(several: pd.DataFrame, lit: pd.DataFrame) -> pd.DataFrame:
    """Return one row per galaxy: its first row, with the columns of each component from the row that has it."""
    ids = several["id"]
    first = several.loc[~ids.duplicated()].copy()
    has_disk = lit["disk"].groupby(ids).transform("any")
    # knots share shape and dust with the disk, so their values are used only if no row has a disk
    shape = lit["disk"] | (lit["knots"] & ~has_disk)
    owners = (
        (lit["bulge"], "size_bulge_true size_minor_bulge_true bulge_magnorm bulge_av bulge_rv bulge_sed sed_val_bulge"),
        (shape, "size_disk_true size_minor_disk_true disk_av disk_rv"),
        (lit["disk"], "disk_magnorm disk_sed sed_val_disk"),
        (lit["knots"], "knots_magnorm n_knots knots_sed sed_val_knots"),
    )
    row_of_id = pd.Series(first.index, index=first["id"])
    for rows, names in owners:
        chosen = several[rows]
        chosen = chosen[~chosen["id"].duplicated()]
        rows_of_galaxies = row_of_id[chosen["id"]].to_numpy()
        for name in names.split():
            first.loc[rows_of_galaxies, name] = chosen[name].to_numpy()
    first["n_rows"] = ids.map(ids.value_counts())[first.index].astype(np.int32)
    return first


def _disagreements(several: pd.DataFrame, lit: pd.DataFrame) -> dict[str, pd.Series]:
    """Return, by reason, the rows that differ from the first row of their galaxy."""

    def differs(names: str, tolerance: float, among: pd.Series | None = None) -> pd.Series:
        out = np.zeros(len(several), bool)
        for name in names.split():
            value = several[name] if among is None else several[name].where(among)
            reference = value.groupby(several["id"]).transform("first")
            out |= ((value - reference).abs() > tolerance * (1 + reference.abs())).to_numpy()
        return pd.Series(out, several.index)

    first = {name: several[name].groupby(several["id"]).transform("first") for name in ("ra", "dec")}
    east = (several["ra"] - first["ra"] + 180) % 360 - 180
    distance = np.hypot(east * np.cos(np.radians(several["dec"])), several["dec"] - first["dec"]) * 3600
    angle = several["position_angle_unlensed"]
    turn = (angle - angle.groupby(several["id"]).transform("first") + 90) % 180 - 90
    disk = lit["disk"] | lit["knots"]
    return {
        "components of one id lie apart": distance > 0.1,
        "components of one id differ in redshift": differs("redshift", 1e-5),
        "components of one id differ in lensing": differs("shear_1 shear_2 convergence", 1e-5),
        "components of one id differ in position angle": turn.abs() > 0.01,
        "components of one id differ in dust of the Milky Way": differs("MW_av MW_rv", 1e-3),
        "disk and knots differ in size": differs("size_disk_true size_minor_disk_true", 1e-4, disk),
        "disk and knots differ in dust": differs("disk_av disk_rv", 1e-3, disk),
    }
