"""The normal form of source catalogs: one row per object, or per component of one, for every input format.

Rows that cannot be used are kept, with the reason for their quarantine.
"""

from __future__ import annotations

import re
import zlib
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import pandas as pd

from romandask.storage.paths import AnyPath, file_state

COMPONENTS = ("bulge", "disk", "knots")
MAX_ROWS = 200_000
"""Largest number of rows of a batch."""
DARK_MAGNORM = 50.0
"""Magnorm at and above which an object of an instance catalog has no light (imSim skips it, instcat.py)."""
MAX_REDSHIFT = 50.0
"""Largest redshift. A larger value is an error in the catalog, as is any value beyond one of the limits below."""
MIN_MAGNITUDE = -10.0
"""Magnitude of the brightest object; Venus has -5."""
MAX_SIZE_ARCSEC = 600.0
"""Largest half-light radius, arcsec; that of the Large Magellanic Cloud is larger, but no survey treats it as one
object."""
MAX_KNOTS = 10_000
"""Largest number of knots of a galaxy."""
MAX_AV = 100.0
"""Largest A_v, mag; towards the centre of the Galaxy it is 30."""

FLOAT_COLUMNS = tuple(
    (
        "ra dec redshift shear_1 shear_2 convergence size_bulge_true size_minor_bulge_true size_disk_true "
        "size_minor_disk_true position_angle_unlensed bulge_magnorm disk_magnorm knots_magnorm bulge_av bulge_rv "
        "disk_av disk_rv MW_av MW_rv magnorm ref_mag"
    ).split()
)
FLUX_COLUMNS = tuple(f"lsst_flux_{band}" for band in "ugrizy")
TEXT_COLUMNS = ("bulge_sed", "disk_sed", "knots_sed", "sed", "ref_band")
TOPHAT_COLUMNS = tuple(f"sed_val_{component}" for component in COMPONENTS)
COLUMNS = (
    "source",
    "row",
    "reason",
    "kind",
    "id",
    *FLOAT_COLUMNS,
    "n_knots",
    *TEXT_COLUMNS,
    *TOPHAT_COLUMNS,
    *FLUX_COLUMNS,
)
"""Columns of the normal form.

- `source`, `row`: file of the row, and number of the row or line in it, from 0.
- `reason`: why the row is quarantined; "" for a good row.
- `kind`: "galaxy" or "star". Stars have NaN in the columns of galaxies.
- `ra`, `dec`: position as observed, degrees.
- `size_*`: half-light radii along the axes before lensing, arcsec.
- `position_angle_unlensed`: degrees east of north.
- `shear_*`: lensing shear with GalSim's on-sky signs.
- `*_magnorm`, `magnorm`: AB magnitude at 500 nm of the rest-frame spectrum without dust; inf if there is no such
  component. A star may have the AB magnitude `ref_mag` in `ref_band` instead.
- `*_sed`, `sed`: name of a spectrum, "" if there is none.
- `sed_val_*`: top-hat spectrum, empty if there is none.
- `lsst_flux_*`: photons /s/cm2, NaN if the source has no fluxes.
"""
_EMPTY_SPECTRUM = np.zeros(0, np.float32)


@dataclass(frozen=True)
class Batch:
    """A range of rows or bytes of a file, read by one task."""

    path: AnyPath
    """The file."""
    start: int
    """First row (tables) or byte of the uncompressed text (instance catalogs)."""
    stop: int
    """End of the range, exclusive."""
    key: str = ""
    """Path of the file relative to the source, with slashes; empty to use the name of the file."""

    @property
    def source(self) -> str:
        """Value of the column `source` in the rows of the batch."""
        return self.key or self.path.name

    @property
    def name(self) -> str:
        """Name of the batch, unique in the source and safe as a file name."""
        safe = re.sub(r"[^A-Za-z0-9._-]", "_", self.source)
        if safe != self.source:
            safe += f"-{zlib.crc32(self.source.encode()):08x}"
        return f"{safe}-{self.start}"


class Source(Protocol):
    """A source catalog that is read in batches."""

    @property
    def edges(self) -> tuple[float, ...]:
        """Rest-frame edges of the bins of top-hat spectra, nm; empty if no row has such a spectrum."""

    def batches(self) -> tuple[Batch, ...]:
        """Return the batches of the source, in order."""

    def read(self, batch: Batch) -> pd.DataFrame:
        """Return all rows of a batch in the normal form."""

    def state(self) -> Any:
        """Return what identifies the content of the source, as JSON values; part of the input hash of its units."""

    def count(self) -> int | None:
        """Return the number of rows of the source, or None if it is known only after reading."""


def file_states(paths: dict[str, AnyPath]) -> dict[str, list[int]]:
    """Return the size (bytes) and the modification time (ns) of each file, by its key."""
    return {key: file_state(path) for key, path in sorted(paths.items())}


def normal_form(source: str, row: np.ndarray, kind: str | np.ndarray, columns: dict[str, Any]) -> pd.DataFrame:
    """Return rows in the normal form.

    Parameters
    ----------
    source : str
        Value of the column `source`.
    row : ndarray of int, shape (n,)
        Values of the column `row`.
    kind : str or ndarray of str, shape (n,)
        Values of the column `kind`.
    columns : dict
        Other columns by name, as arrays or as one value for all rows; `id` is required. Columns that are left out are
        filled with the value that means "none": NaN, "", 0 knots or an empty spectrum.
    """
    count = len(row)
    kinds = np.full(count, kind, object) if isinstance(kind, str) else kind
    galaxy = kinds == "galaxy"
    out: dict[str, Any] = {
        "source": np.full(count, source, object),
        "row": np.asarray(row, np.int64),
        "reason": columns.get("reason", np.full(count, "", object)),
        "kind": kinds,
        "id": np.asarray(columns["id"], np.int64),
    }
    for name in FLOAT_COLUMNS:
        out[name] = np.broadcast_to(np.asarray(columns.get(name, np.nan), float), count).copy()
    for component in COMPONENTS:
        value = out[f"{component}_magnorm"]
        # NaN, like inf, means that the component has no light
        value[galaxy & np.isnan(value)] = np.inf
    knots = np.broadcast_to(np.asarray(columns.get("n_knots", 0), float), count)
    out["n_knots"] = np.clip(np.nan_to_num(knots, nan=0.0), -1, 2**31 - 1).astype(np.int32)
    for name in TEXT_COLUMNS:
        value = columns.get(name, "")
        out[name] = np.full(count, value, object) if isinstance(value, str) else value
    for name in TOPHAT_COLUMNS:
        out[name] = columns[name] if name in columns else empty_spectra(count)
    for name in FLUX_COLUMNS:
        out[name] = np.broadcast_to(np.asarray(columns.get(name, np.nan), np.float32), count).copy()
    return pd.DataFrame(out, columns=list(COLUMNS))


def empty_spectra(count: int) -> np.ndarray:
    """Return a column of empty top-hat spectra."""
    out = np.empty(count, object)
    out.fill(_EMPTY_SPECTRUM)
    return out


def identifiers(values: np.ndarray, pattern: str = r"(-?\d{1,18})") -> np.ndarray:
    """Return identifiers as int64.

    Parameters
    ----------
    values : ndarray of number or str
        Identifiers as read.
    pattern : str
        Regular expression that a text must match in full; its first group is the identifier.

    Returns
    -------
    ndarray of int64
        Identifiers, -1 where a value is missing, is not an integer or does not match.
    """
    values = np.asarray(values)
    if values.dtype.kind in "iub":
        return np.where(values > np.iinfo(np.int64).max, -1, values).astype(np.int64)
    if values.dtype.kind == "f":
        with np.errstate(invalid="ignore"):
            whole = np.isfinite(values) & (values == np.floor(values)) & (np.abs(values) < 2.0**53)
        return np.where(whole, np.where(whole, values, 0).astype(np.int64), -1)
    digits = pd.Series(values, dtype=object).astype(str).str.extract(f"^{pattern}$")[0]
    return digits.fillna("-1").to_numpy(str).astype(np.int64) if len(digits) else np.empty(0, np.int64)


def duplicate_rows(ids: np.ndarray) -> np.ndarray:
    """Return the numbers of the rows whose identifier occurs in an earlier row; negative ones are ignored."""
    order = np.sort(ids)
    values = np.unique(order[1:][order[1:] == order[:-1]])
    rows = np.flatnonzero(np.isin(ids, values[values >= 0])) if len(values) else np.empty(0, np.int64)
    first = np.unique(ids[rows], return_index=True)[1]
    return np.delete(rows, first)


def with_reasons(frame: pd.DataFrame, tophat_bins: int = 0, duplicate: np.ndarray | None = None) -> pd.DataFrame:
    """Return rows with `reason` filled in for those that must be quarantined; a reason that is already set is kept.

    Parameters
    ----------
    frame : DataFrame
        Rows in the normal form.
    tophat_bins : int
        Number of bins that a top-hat spectrum must have.
    duplicate : ndarray of bool, optional
        True where an earlier row of the file has the same identifier.
    """
    reason = frame["reason"].to_numpy(object).copy()
    for text, bad in quarantine_reasons(frame, tophat_bins).items():
        reason[np.asarray(bad, bool) & (reason == "")] = text
    if duplicate is not None:
        duplicate_text = np.where(frame["kind"] == "galaxy", "duplicate galaxy_id", "duplicate id")
        reason = np.where(np.asarray(duplicate, bool) & (reason == ""), duplicate_text, reason)
    return frame.assign(reason=reason)


def quarantine_reasons(frame: pd.DataFrame, tophat_bins: int = 0) -> dict[str, np.ndarray]:
    """Return the reasons for quarantine, in order of precedence, each with the rows (bool) to which it applies."""
    value = {name: frame[name].to_numpy() for name in (*FLOAT_COLUMNS, "n_knots", "id", "sed", "ref_band")}
    galaxy = frame["kind"].to_numpy(object) == "galaxy"
    star = ~galaxy
    lit = {c: galaxy & np.isfinite(value[f"{c}_magnorm"]) for c in COMPONENTS}
    shaped = {"bulge": lit["bulge"], "disk": lit["disk"] | lit["knots"]}
    with np.errstate(invalid="ignore", over="ignore"):
        inverse_magnification = (1 - value["convergence"]) ** 2 - value["shear_1"] ** 2 - value["shear_2"] ** 2
        positioned = np.isfinite(value["ra"]) & np.isfinite(value["dec"]) & (np.abs(value["dec"]) <= 90)
        axes = {c: (value[f"size_{c}_true"], value[f"size_minor_{c}_true"]) for c in shaped}
        sized = {c: (a >= 0) & (b >= 0) & np.isfinite(a) & np.isfinite(b) for c, (a, b) in axes.items()}
        # the tolerance allows for sizes in single precision
        ordered = {c: b <= a * (1 + 1e-6) for c, (a, b) in axes.items()}
        own_dust = {"bulge": lit["bulge"], "disk": shaped["disk"]}
        lengths = {c: np.fromiter(map(len, frame[f"sed_val_{c}"]), int, len(frame)) for c in COMPONENTS}
        known = {c: (frame[f"{c}_sed"].to_numpy(object) != "") | (lengths[c] > 0) for c in COMPONENTS}
        has_magnitude = np.isfinite(value["magnorm"]) | (np.isfinite(value["ref_mag"]) & (value["ref_band"] != ""))
        dust = [value["MW_av"]] + [np.where(own_dust[c], value[f"{c}_av"], 0) for c in own_dust]
        magnitudes = [np.where(galaxy, value[f"{c}_magnorm"], 0) for c in COMPONENTS]
        magnitudes += [np.where(star, value[name], 0) for name in ("magnorm", "ref_mag")]
        return {
            "id is missing, negative or not an integer": value["id"] < 0,
            "position is not a number": ~positioned,
            "right ascension is beyond -360 to 360 degrees": np.abs(value["ra"]) > 360,
            "redshift is not a number": galaxy & (~np.isfinite(value["redshift"]) | (value["redshift"] < 0)),
            f"redshift above {MAX_REDSHIFT:g}": galaxy & (value["redshift"] > MAX_REDSHIFT),
            "shear or convergence beyond the weak regime": galaxy
            & (~(inverse_magnification > 0) | ~(np.abs(value["convergence"]) < 1)),
            "size is negative or not a number": _any(shaped[c] & ~sized[c] for c in shaped),
            f"size above {MAX_SIZE_ARCSEC:g} arcsec": _any(shaped[c] & (axes[c][0] > MAX_SIZE_ARCSEC) for c in shaped),
            "minor axis above the major axis": _any(shaped[c] & ~ordered[c] for c in shaped),
            "position angle is not a number": galaxy & ~np.isfinite(value["position_angle_unlensed"]),
            "position angle is beyond -360 to 360 degrees": galaxy & (np.abs(value["position_angle_unlensed"]) > 360),
            "knots have light but no number": lit["knots"] & (value["n_knots"] < 1),
            f"more than {MAX_KNOTS} knots": lit["knots"] & (value["n_knots"] > MAX_KNOTS),
            f"A_v above {MAX_AV:g} mag": _any(each > MAX_AV for each in dust),
            "A_v is negative or not a number": _any(
                [~np.isfinite(value["MW_av"]) | (value["MW_av"] < 0)]
                + [own_dust[c] & ~(np.isfinite(value[f"{c}_av"]) & (value[f"{c}_av"] >= 0)) for c in own_dust]
            ),
            "R_v below 1": _any(
                [(value["MW_av"] != 0) & ~((value["MW_rv"] >= 1) & np.isfinite(value["MW_rv"]))]
                + [
                    own_dust[c] & (value[f"{c}_av"] != 0) & ~((value[f"{c}_rv"] >= 1) & np.isfinite(value[f"{c}_rv"]))
                    for c in own_dust
                ]
            ),
            "spectrum has a wrong number of bins": _any(
                (lengths[c] != 0) & (lengths[c] != tophat_bins) for c in COMPONENTS
            ),
            "no spectrum is named": _any(lit[c] & ~known[c] for c in COMPONENTS) | (star & (value["sed"] == "")),
            "no component has light": galaxy & ~_any(lit[c] for c in COMPONENTS),
            "magnorm is not a number": star & ~has_magnitude,
            f"brighter than magnitude {MIN_MAGNITUDE:g}": _any(each < MIN_MAGNITUDE for each in magnitudes),
        }


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


def _any(conditions: Any) -> np.ndarray:
    return np.any(list(conditions), axis=0)
