"""The normal form of source catalogs: one row an object (or a component of one), good and bad, whatever the format."""

from __future__ import annotations

import re
import zlib
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import pandas as pd

from romandask.storage.paths import AnyPath, file_state

COMPONENTS = ("bulge", "disk", "knots")
BANDS = "ugrizy"
MAX_ROWS = 200_000
"""Rows of a batch at most."""
DARK = 50.0
"""Magnorm from which instance catalogs mean an object without light (imSim skips it, instcat.py)."""
FIRST_GALAXY = 50.0
"""Redshift beyond which there is none; a larger one is a mistake of its catalog, as are the limits that follow."""
BRIGHTEST = -10.0
"""Magnitude; of Venus -5."""
MAX_SIZE_ARCSEC = 600.0
"""Half-light radius, arcsec; that of the Large Magellanic Cloud is larger, its light is no survey's object."""
MOST_KNOTS = 10_000
MOST_DUST = 100.0
"""A_v, mag; of the Galaxy's centre 30."""

FLOATS = tuple(
    (
        "ra dec redshift shear_1 shear_2 convergence size_bulge_true size_minor_bulge_true size_disk_true "
        "size_minor_disk_true position_angle_unlensed bulge_magnorm disk_magnorm knots_magnorm bulge_av bulge_rv "
        "disk_av disk_rv MW_av MW_rv magnorm ref_mag"
    ).split()
)
FLUXES = tuple(f"lsst_flux_{band}" for band in BANDS)
TEXTS = ("bulge_sed", "disk_sed", "knots_sed", "sed", "ref_band")
BINS = tuple(f"sed_val_{component}" for component in COMPONENTS)
COLUMNS = ("source", "row", "reason", "kind", "id", *FLOATS, "n_knots", *TEXTS, *BINS, *FLUXES)
"""Columns of the normal form.

`source` and `row` say where a row comes from (file, and row or line of it from 0), `reason` why it cannot be used ("" =
good), `kind` is "galaxy" or "star". Positions are as observed, degrees; sizes are half-light radii along the axes
before lensing, arcsec; `position_angle_unlensed` is in degrees east of north; shears have GalSim's on-sky signs.
`*_magnorm` and `magnorm` are AB magnitudes at 500 nm of the undusted rest-frame spectrum; inf: no such component.
`*_sed` and `sed` name spectra, `sed_val_*` hold top-hat spectra ("" and empty where there is none). Instead of a
magnorm a star may have the AB magnitude `ref_mag` in `ref_band`. Stars have NaN in the galaxies' columns.
`lsst_flux_*` are photons /s/cm2, NaN where the source has none.
"""
_NO_BINS = np.zeros(0, np.float32)


@dataclass(frozen=True)
class Batch:
    """A part of a file that one task reads."""

    path: AnyPath
    start: int
    """First row (tables) or byte (text)."""
    stop: int
    key: str = ""
    """Place of the file relative to the source, with slashes; the file's name where empty."""

    @property
    def source(self) -> str:
        """The file as the rows name it."""
        return self.key or self.path.name

    @property
    def name(self) -> str:
        """A name that is unique in the source and safe as a file name."""
        safe = re.sub(r"[^A-Za-z0-9._-]", "_", self.source)
        if safe != self.source:
            safe += f"-{zlib.crc32(self.source.encode()):08x}"
        return f"{safe}-{self.start}"


class Source(Protocol):
    """A catalog that can be read in batches."""

    @property
    def edges(self) -> tuple[float, ...]:
        """Rest-frame edges of the top-hat bins, nm; empty if no row has a top-hat spectrum."""

    def batches(self) -> tuple[Batch, ...]:
        """Return the parts of the source, in order."""

    def read(self, batch: Batch) -> pd.DataFrame:
        """Return all rows of a batch in the normal form."""

    def state(self) -> Any:
        """Return what identifies the files, as JSON values."""

    def count(self) -> int | None:
        """Return the rows of the source, None if only reading tells."""


def file_states(paths: dict[str, AnyPath]) -> dict[str, list[int]]:
    """Return by key the bytes and the time of change (ns) of files."""
    return {key: file_state(path) for key, path in sorted(paths.items())}


def normal_form(source: str, row: np.ndarray, kind: str | np.ndarray, columns: dict[str, Any]) -> pd.DataFrame:
    """Return rows in the normal form, with an empty reason where `columns` has none; what is left out is absent."""
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
    for name in FLOATS:
        out[name] = np.broadcast_to(np.asarray(columns.get(name, np.nan), float), count).copy()
    for component in COMPONENTS:
        value = out[f"{component}_magnorm"]
        # NaN means, as inf does, that the component has no light
        value[galaxy & np.isnan(value)] = np.inf
    knots = np.broadcast_to(np.asarray(columns.get("n_knots", 0), float), count)
    out["n_knots"] = np.clip(np.nan_to_num(knots, nan=0.0), -1, 2**31 - 1).astype(np.int32)
    for name in TEXTS:
        value = columns.get(name, "")
        out[name] = np.full(count, value, object) if isinstance(value, str) else value
    for name in BINS:
        out[name] = columns[name] if name in columns else empty_bins(count)
    for name in FLUXES:
        out[name] = np.broadcast_to(np.asarray(columns.get(name, np.nan), np.float32), count).copy()
    return pd.DataFrame(out, columns=list(COLUMNS))


def empty_bins(count: int) -> np.ndarray:
    """Return a column of empty top-hat spectra."""
    out = np.empty(count, object)
    out.fill(_NO_BINS)
    return out


def identifiers(values: np.ndarray, pattern: str = r"(-?\d{1,18})") -> np.ndarray:
    """Return integers (int64) of numbers or texts, -1 where there is none; `pattern` finds the digits in a text."""
    values = np.asarray(values)
    if values.dtype.kind in "iub":
        return np.where(values > np.iinfo(np.int64).max, -1, values).astype(np.int64)
    if values.dtype.kind == "f":
        with np.errstate(invalid="ignore"):
            whole = np.isfinite(values) & (values == np.floor(values)) & (np.abs(values) < 2.0**53)
        return np.where(whole, np.where(whole, values, 0).astype(np.int64), -1)
    found = pd.Series(values, dtype=object).astype(str).str.extract(f"^{pattern}$")[0]
    return found.fillna("-1").to_numpy(str).astype(np.int64) if len(found) else np.empty(0, np.int64)


def repeats(ids: np.ndarray) -> np.ndarray:
    """Return the rows whose id an earlier row has; ids below 0 are none."""
    order = np.sort(ids)
    values = np.unique(order[1:][order[1:] == order[:-1]])
    rows = np.flatnonzero(np.isin(ids, values[values >= 0])) if len(values) else np.empty(0, np.int64)
    first = np.unique(ids[rows], return_index=True)[1]
    return np.delete(rows, first)


def with_reasons(frame: pd.DataFrame, bins: int = 0, repeated: np.ndarray | None = None) -> pd.DataFrame:
    """Return rows with `reason` filled where it was empty and the row cannot be used.

    Parameters
    ----------
    bins : length that a top-hat spectrum must have
    repeated : True where an earlier row of the file has the same id
    """
    reason = frame["reason"].to_numpy(object).copy()
    for text, bad in quarantine_reasons(frame, bins).items():
        reason[np.asarray(bad, bool) & (reason == "")] = text
    if repeated is not None:
        name = np.where(frame["kind"] == "galaxy", "duplicate galaxy_id", "duplicate id")
        reason = np.where(np.asarray(repeated, bool) & (reason == ""), name, reason)
    return frame.assign(reason=reason)


def quarantine_reasons(frame: pd.DataFrame, bins: int = 0) -> dict[str, np.ndarray]:
    """Return by reason the rows that it holds for; the first that holds is the one to give."""
    value = {name: frame[name].to_numpy() for name in (*FLOATS, "n_knots", "id", "sed", "ref_band")}
    galaxy = frame["kind"].to_numpy(object) == "galaxy"
    star = ~galaxy
    lit = {c: galaxy & np.isfinite(value[f"{c}_magnorm"]) for c in COMPONENTS}
    shaped = {"bulge": lit["bulge"], "disk": lit["disk"] | lit["knots"]}
    with np.errstate(invalid="ignore", over="ignore"):
        lens = (1 - value["convergence"]) ** 2 - value["shear_1"] ** 2 - value["shear_2"] ** 2
        place = np.isfinite(value["ra"]) & np.isfinite(value["dec"]) & (np.abs(value["dec"]) <= 90)
        axes = {c: (value[f"size_{c}_true"], value[f"size_minor_{c}_true"]) for c in shaped}
        sized = {c: (a >= 0) & (b >= 0) & np.isfinite(a) & np.isfinite(b) for c, (a, b) in axes.items()}
        # sizes may be float32 in the file
        ordered = {c: b <= a * (1 + 1e-6) for c, (a, b) in axes.items()}
        own_dust = {"bulge": lit["bulge"], "disk": shaped["disk"]}
        lengths = {c: np.fromiter(map(len, frame[f"sed_val_{c}"]), int, len(frame)) for c in COMPONENTS}
        known = {c: (frame[f"{c}_sed"].to_numpy(object) != "") | (lengths[c] > 0) for c in COMPONENTS}
        bright = np.isfinite(value["magnorm"]) | (np.isfinite(value["ref_mag"]) & (value["ref_band"] != ""))
        dust = [value["MW_av"]] + [np.where(own_dust[c], value[f"{c}_av"], 0) for c in own_dust]
        magnitudes = [np.where(galaxy, value[f"{c}_magnorm"], 0) for c in COMPONENTS]
        magnitudes += [np.where(star, value[name], 0) for name in ("magnorm", "ref_mag")]
        return {
            "id is missing, negative or not an integer": value["id"] < 0,
            "position is not a number": ~place,
            "right ascension is beyond -360 to 360 degrees": np.abs(value["ra"]) > 360,
            "redshift is not a number": galaxy & (~np.isfinite(value["redshift"]) | (value["redshift"] < 0)),
            f"redshift above {FIRST_GALAXY:g}": galaxy & (value["redshift"] > FIRST_GALAXY),
            "shear or convergence beyond the weak regime": galaxy & (~(lens > 0) | ~(np.abs(value["convergence"]) < 1)),
            "size is negative or not a number": _any(shaped[c] & ~sized[c] for c in shaped),
            f"size above {MAX_SIZE_ARCSEC:g} arcsec": _any(shaped[c] & (axes[c][0] > MAX_SIZE_ARCSEC) for c in shaped),
            "minor axis above the major axis": _any(shaped[c] & ~ordered[c] for c in shaped),
            "position angle is not a number": galaxy & ~np.isfinite(value["position_angle_unlensed"]),
            "position angle is beyond -360 to 360 degrees": galaxy & (np.abs(value["position_angle_unlensed"]) > 360),
            "knots have light but no number": lit["knots"] & (value["n_knots"] < 1),
            f"more than {MOST_KNOTS} knots": lit["knots"] & (value["n_knots"] > MOST_KNOTS),
            f"A_v above {MOST_DUST:g} mag": _any(each > MOST_DUST for each in dust),
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
            "spectrum has a wrong number of bins": _any((lengths[c] != 0) & (lengths[c] != bins) for c in COMPONENTS),
            "no spectrum is named": _any(lit[c] & ~known[c] for c in COMPONENTS) | (star & (value["sed"] == "")),
            "no component has light": galaxy & ~_any(lit[c] for c in COMPONENTS),
            "magnorm is not a number": star & ~bright,
            f"brighter than magnitude {BRIGHTEST:g}": _any(each < BRIGHTEST for each in magnitudes),
        }


def merge_components(frame: pd.DataFrame) -> pd.DataFrame:
    """Return rows with those of one galaxy made one, and `n_rows`, the source rows that went into each.

    Rows of galaxies with the same id are components of one. Of several with the same component all but the first are
    set aside; so are all rows of a galaxy that disagree in place (0.1 arcsec), redshift, lensing, position angle, dust
    of the Milky Way, or in the size and own dust that disk and knots share. Repeated stars are set aside too. Rows set
    aside keep n_rows = 1: rows in = sum of n_rows of good rows + rows set aside.
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
    differ = _disagreements(several, lit)
    for text, bad in differ.items():
        rows = bad.groupby(several["id"]).transform("any") & (frame.loc[several.index, "reason"] == "")
        frame.loc[several.index[rows], "reason"] = text
    several = several[frame.loc[several.index, "reason"] == ""]
    if not len(several):
        return frame
    merged = _combined(several, lit.loc[several.index])
    return pd.concat([frame.drop(several.index), merged]).sort_index().reset_index(drop=True)


def _combined(several: pd.DataFrame, lit: pd.DataFrame) -> pd.DataFrame:
    """Return the first row of each galaxy, with the columns of each component from the row that has it."""
    ids = several["id"]
    first = several.loc[~ids.duplicated()].copy()
    has_disk = lit["disk"].groupby(ids).transform("any")
    # knots have the shape and the dust of the disk: theirs count where no row has a disk
    shape = lit["disk"] | (lit["knots"] & ~has_disk)
    owners = (
        (lit["bulge"], "size_bulge_true size_minor_bulge_true bulge_magnorm bulge_av bulge_rv bulge_sed sed_val_bulge"),
        (shape, "size_disk_true size_minor_disk_true disk_av disk_rv"),
        (lit["disk"], "disk_magnorm disk_sed sed_val_disk"),
        (lit["knots"], "knots_magnorm n_knots knots_sed sed_val_knots"),
    )
    place = pd.Series(first.index, index=first["id"])
    for rows, names in owners:
        chosen = several[rows]
        chosen = chosen[~chosen["id"].duplicated()]
        where = place[chosen["id"]].to_numpy()
        for name in names.split():
            first.loc[where, name] = chosen[name].to_numpy()
    first["n_rows"] = ids.map(ids.value_counts())[first.index].astype(np.int32)
    return first


def _disagreements(several: pd.DataFrame, lit: pd.DataFrame) -> dict[str, pd.Series]:
    """Return by reason the rows that differ from the first of their galaxy."""

    def off(names: str, tolerance: float, among: pd.Series | None = None) -> pd.Series:
        out = np.zeros(len(several), bool)
        for name in names.split():
            value = several[name] if among is None else several[name].where(among)
            reference = value.groupby(several["id"]).transform("first")
            out |= ((value - reference).abs() > tolerance * (1 + reference.abs())).to_numpy()
        return pd.Series(out, several.index)

    first = {name: several[name].groupby(several["id"]).transform("first") for name in ("ra", "dec")}
    east = (several["ra"] - first["ra"] + 180) % 360 - 180
    apart = np.hypot(east * np.cos(np.radians(several["dec"])), several["dec"] - first["dec"]) * 3600
    angle = several["position_angle_unlensed"]
    turn = (angle - angle.groupby(several["id"]).transform("first") + 90) % 180 - 90
    disk = lit["disk"] | lit["knots"]
    return {
        "components of one id lie apart": apart > 0.1,
        "components of one id differ in redshift": off("redshift", 1e-5),
        "components of one id differ in lensing": off("shear_1 shear_2 convergence", 1e-5),
        "components of one id differ in position angle": turn.abs() > 0.01,
        "components of one id differ in dust of the Milky Way": off("MW_av MW_rv", 1e-3),
        "disk and knots differ in size": off("size_disk_true size_minor_disk_true", 1e-4, disk),
        "disk and knots differ in dust": off("disk_av disk_rv", 1e-3, disk),
    }


def _any(conditions: Any) -> np.ndarray:
    return np.any(list(conditions), axis=0)
