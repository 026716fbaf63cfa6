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

from romandask.ingest.identifiers import MISSING
from romandask.model.spectra import MAGNORM_WAVE
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
NOT_A_NUMBER = "spectrum holds NaN or infinite values"
NEGATIVE = "spectrum is negative somewhere"
NO_LIGHT = "spectrum has no light at 500 nm, where magnorm is defined"

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
- `ra`, `dec`: position as observed, degrees; a right ascension from -360 to 360 is brought into 0 to 360.
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

    @property
    def components(self) -> bool:
        """Whether rows of galaxies with the same identifier are components of one galaxy, not duplicates."""

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
    # a right ascension of -30 is one of 330; beyond 360 degrees it is an error of the catalog
    turned = np.abs(out["ra"]) <= 360
    out["ra"][turned] = np.mod(out["ra"][turned], 360.0) % 360.0
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


def with_reasons(frame: pd.DataFrame, edges: tuple[float, ...] = ()) -> pd.DataFrame:
    """Return rows with `reason` filled in for those that must be quarantined; a reason that is already set is kept.

    Parameters
    ----------
    frame : DataFrame
        Rows in the normal form.
    edges : tuple of float, nm
        Rest-frame edges of the bins of top-hat spectra; empty if there are none.
    """
    reason = frame["reason"].to_numpy(object).copy()
    for text, bad in quarantine_reasons(frame, edges).items():
        reason[np.asarray(bad, bool) & (reason == "")] = text
    return frame.assign(reason=reason)


def quarantine_reasons(frame: pd.DataFrame, edges: tuple[float, ...] = ()) -> dict[str, np.ndarray]:
    """Return the reasons for quarantine, in order of precedence, each with the rows (bool) to which it applies."""
    value = {name: frame[name].to_numpy() for name in (*FLOAT_COLUMNS, "n_knots", "id", "sed", "ref_band")}
    galaxy = frame["kind"].to_numpy(object) == "galaxy"
    star = ~galaxy
    lit = {c: galaxy & np.isfinite(value[f"{c}_magnorm"]) for c in COMPONENTS}
    shaped = {"bulge": lit["bulge"], "disk": lit["disk"] | lit["knots"]}
    with np.errstate(invalid="ignore", over="ignore"):
        inverse_magnification = (1 - value["convergence"]) ** 2 - value["shear_1"] ** 2 - value["shear_2"] ** 2
        axes = {c: (value[f"size_{c}_true"], value[f"size_minor_{c}_true"]) for c in shaped}
        sized = {c: (a >= 0) & (b >= 0) & np.isfinite(a) & np.isfinite(b) for c, (a, b) in axes.items()}
        # the tolerance allows for sizes in single precision
        ordered = {c: b <= a * (1 + 1e-6) for c, (a, b) in axes.items()}
        own_dust = {"bulge": lit["bulge"], "disk": shaped["disk"]}
        lengths = {c: np.fromiter(map(len, frame[f"sed_val_{c}"]), int, len(frame)) for c in COMPONENTS}
        faults = {c: _tophat_faults(frame[f"sed_val_{c}"], lengths[c], edges) for c in COMPONENTS}
        known = {c: (frame[f"{c}_sed"].to_numpy(object) != "") | (lengths[c] > 0) for c in COMPONENTS}
        has_magnitude = np.isfinite(value["magnorm"]) | (np.isfinite(value["ref_mag"]) & (value["ref_band"] != ""))
        dust = [value["MW_av"]] + [np.where(own_dust[c], value[f"{c}_av"], 0) for c in own_dust]
        magnitudes = [np.where(galaxy, value[f"{c}_magnorm"], 0) for c in COMPONENTS]
        magnitudes += [np.where(star, value[name], 0) for name in ("magnorm", "ref_mag")]
        return {
            MISSING: value["id"] < 0,
            "position is not a number": ~(np.isfinite(value["ra"]) & np.isfinite(value["dec"])),
            "right ascension is beyond -360 to 360 degrees": np.abs(value["ra"]) > 360,
            "declination is beyond -90 to 90 degrees": np.abs(value["dec"]) > 90,
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
                (lengths[c] != 0) & (lengths[c] != max(len(edges) - 1, 0)) for c in COMPONENTS
            ),
            **{text: _any(lit[c] & faults[c][text] for c in COMPONENTS) for text in faults["disk"]},
            "no spectrum is named": _any(lit[c] & ~known[c] for c in COMPONENTS) | (star & (value["sed"] == "")),
            "no component has light": galaxy & ~_any(lit[c] for c in COMPONENTS),
            "magnorm is not a number": star & ~has_magnitude,
            "a flux of the source is infinite": _any(np.isinf(frame[name].to_numpy()) for name in FLUX_COLUMNS),
            f"brighter than magnitude {MIN_MAGNITUDE:g}": _any(each < MIN_MAGNITUDE for each in magnitudes),
        }


def _tophat_faults(spectra: pd.Series, lengths: np.ndarray, edges: tuple[float, ...]) -> dict[str, np.ndarray]:
    """Return the reasons why top-hat spectra cannot be used, each with the rows (bool) to which it applies."""
    out = {text: np.zeros(len(spectra), bool) for text in (NOT_A_NUMBER, NEGATIVE, NO_LIGHT)}
    rows = np.flatnonzero(lengths == len(edges) - 1) if edges else np.empty(0, int)
    if len(rows):
        values = np.stack(spectra.iloc[rows].to_list())
        at_500 = values[:, np.clip(np.searchsorted(edges, MAGNORM_WAVE, side="right") - 1, 0, len(edges) - 2)]
        out[NOT_A_NUMBER][rows] = ~np.isfinite(values).all(axis=1)
        out[NEGATIVE][rows] = (values < 0).any(axis=1)
        out[NO_LIGHT][rows] = ~(at_500 > 0)
    return out


def _any(conditions: Any) -> np.ndarray:
    return np.any(list(conditions), axis=0)
