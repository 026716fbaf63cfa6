"""Rows of skyCatalogs files in the normal form: galaxies, stars (`pointsource`) and TRILEGAL stars.

The column names differ between schema generations; `check_columns` and `read_rows` accept all of them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa

from romandask.ingest import parquet
from romandask.ingest.identifiers import INTEGER
from romandask.ingest.rows import (
    COMPONENTS,
    FLOAT_COLUMNS,
    FLUX_COLUMNS,
    MAX_ROWS,
    TOPHAT_COLUMNS,
    Batch,
    normal_form,
    with_reasons,
)
from romandask.ingest.units import factors
from romandask.model.errors import UserError
from romandask.storage.paths import AnyPath

ALTERNATIVE_NAMES = {
    "redshift": ("redshift", "redshiftHubble", "redshift_hubble"),
    "position_angle_unlensed": ("position_angle_unlensed", "position_angle_true"),
}
"""Names of a column in the different generations, in order of preference; other columns have the name they have in the
normal form."""
SED_NAMES = ("{}_sed_file_path", "{}_sed_filepath", "{}_sed_file")
"""Names of the column with the name of the spectrum of a component, in order of preference."""
ELLIPTICITIES = tuple(f"ellipticity_{i}_{c}_true" for c in ("disk", "bulge") for i in (1, 2))
"""Columns that replace the position angle from schema 1.5 on."""
GALAXY_COLUMNS = tuple(
    (
        "ra dec redshift shear_1 convergence size_bulge_true size_minor_bulge_true size_disk_true size_minor_disk_true "
        "bulge_magnorm disk_magnorm MW_av"
    ).split()
)
"""Required columns of galaxies that are taken over unchanged."""
STAR_COLUMNS = tuple("id ra dec magnorm sed_filepath MW_av".split())
"""Required columns of stars."""
TRILEGAL_COLUMNS = tuple("id ra dec av logT".split())
"""Required columns of TRILEGAL stars, in addition to one magnitude."""
TRILEGAL_BANDS = "irgzyu"
"""Bands whose magnitude gives the flux of a TRILEGAL star, in order of preference."""
TRILEGAL_ID = r".*_hp(?:[0-9]+)_([0-9]{1,12})"
"""Pattern of TRILEGAL identifiers, which are texts: <source>_hp<pixel>_<number in the pixel>."""
NUMBER_COLUMNS = {
    "galaxy": {name for column in GALAXY_COLUMNS for name in ALTERNATIVE_NAMES.get(column, (column,))}
    | set("shear_2 shear_2_phosim MW_rv knots_magnorm n_knots sersic_bulge sersic_disk".split())
    | {*ALTERNATIVE_NAMES["position_angle_unlensed"], *ELLIPTICITIES},
    "star": {"ra", "dec", "magnorm", "MW_av", "MW_rv"},
    "trilegal": {"ra", "dec", "av", "logT", *(f"{band}mag" for band in TRILEGAL_BANDS)},
}
"""Columns with numbers, by kind of file."""
MW_RV = 3.1
"""R_V of dust for which neither file nor configuration gives a value."""


@dataclass(frozen=True, kw_only=True)
class PixelFile:
    """A file with the objects of one type in one HEALPix pixel."""

    path: AnyPath
    """The file."""
    kind: str
    """galaxy, star or trilegal."""
    order: int
    """HEALPix order of the pixel."""
    cell: int
    """Number of the pixel in nested ordering."""
    pixel: int
    """Number of the pixel in the name of the file, whose ordering may be ring."""
    flux: AnyPath | None
    """File with the Rubin fluxes of the same objects."""


def identifier_column(file: PixelFile) -> tuple[str, str]:
    """Return the column of the identifiers of a file, and their pattern."""
    if file.kind == "galaxy":
        return "galaxy_id", INTEGER
    return "id", TRILEGAL_ID if file.kind == "trilegal" else INTEGER


def check_columns(file: PixelFile) -> None:
    """Check that a file has all required columns, that they hold numbers or texts as they should, and their units.

    Raises
    ------
    UserError
        If a column is missing, or if it holds something else or has a unit of another quantity.
    """
    names = parquet.schema(file.path).names
    needed: list[tuple[str, ...]]
    if file.kind == "star":
        needed = [(name,) for name in STAR_COLUMNS]
    elif file.kind == "trilegal":
        needed = [(name,) for name in TRILEGAL_COLUMNS] + [tuple(f"{band}mag" for band in TRILEGAL_BANDS)]
    else:
        needed = [("galaxy_id",)] + [ALTERNATIVE_NAMES.get(name, (name,)) for name in GALAXY_COLUMNS]
        needed += [("shear_2", "shear_2_phosim")]
        if not set(ELLIPTICITIES) <= set(names):
            needed.append(ALTERNATIVE_NAMES["position_angle_unlensed"])
        needed += [(f"sed_val_{c}", *(n.format(c) for n in SED_NAMES)) for c in ("bulge", "disk")]
        if "knots_magnorm" in names:
            needed.append(("n_knots",))
    for choices in needed:
        if not set(choices) & set(names):
            raise UserError(f"{file.path}: column {choices[0]!r} is missing (found {', '.join(names)})")
    factors(file.path, _columns_with_units(names), parquet.units(file.path))
    identifier, _ = identifier_column(file)
    for path in (file.path, *((file.flux,) if file.flux else ())):
        kinds = parquet.kinds(path)
        if identifier not in kinds:
            raise UserError(f"{path}: column {identifier!r} is missing (found {', '.join(kinds)})")
        for name, found in kinds.items():
            wanted = _wanted_kind(file, name)
            if wanted and found not in wanted:
                raise UserError(f"{path}: column {name!r} holds {found}: expected {wanted[0]}")
        parquet.check_identifiers(path, identifier)


def _wanted_kind(file: PixelFile, name: str) -> tuple[str, ...]:
    """Return what a column may hold; empty for a column that is not read."""
    if name == identifier_column(file)[0]:
        return ("text",) if file.kind == "trilegal" else ("number", "text")
    if name in TOPHAT_COLUMNS and file.kind == "galaxy":
        return ("lists",)
    if name in NUMBER_COLUMNS[file.kind] or name in FLUX_COLUMNS:
        return ("number",)
    texts = {n.format(c) for n in SED_NAMES for c in COMPONENTS} | {"sed_filepath", "object_type"}
    return ("text",) if name in texts else ()


def _columns_with_units(names: list[str]) -> dict[str, str]:
    """Return the columns, of those with the given names, that may have units, by column of the normal form."""
    choices = {name: ALTERNATIVE_NAMES.get(name, (name,)) for name in FLOAT_COLUMNS}
    choices |= {"MW_av": ("MW_av", "av"), "ref_mag": tuple(f"{band}mag" for band in TRILEGAL_BANDS)}
    found = {name: _first_present(names, *columns) for name, columns in choices.items()}
    return {name: column for name, column in found.items() if column}


def read_rows(batch: Batch, file: PixelFile, mw_rv: float, edges: tuple[float, ...]) -> pd.DataFrame:
    """Return all rows of a batch in the normal form.

    Parameters
    ----------
    batch : Batch
        Rows to read.
    file : PixelFile
        File of the batch.
    mw_rv : float
        R_V of the Milky Way if the file has no column for it.
    edges : tuple of float, nm
        Rest-frame edges of the bins of top-hat spectra; empty if there are none.
    """
    names = parquet.schema(file.path).names
    read = {"galaxy": _read_galaxies, "star": _read_stars, "trilegal": _read_trilegal}[file.kind]
    columns = read(names, batch, mw_rv)
    for name, factor in factors(file.path, _columns_with_units(names), parquet.units(file.path)).items():
        columns[name] = columns[name] * factor
    if file.flux:
        columns |= _read_fluxes(file, batch, columns["id"])
    kind = "galaxy" if file.kind == "galaxy" else "star"
    columns["id"] = _unique_over_files(file, columns["id"])
    frame = normal_form(batch.source, np.arange(batch.start, batch.stop), kind, columns)
    return with_reasons(frame, edges)


def _first_present(names: list[str], *choices: str) -> str | None:
    return next((name for name in choices if name in names), None)


def _read_galaxies(names: list[str], batch: Batch, mw_rv: float) -> dict[str, Any]:
    """Return the columns of galaxies; `names` are the columns of the file."""
    plain = {name: str(_first_present(names, *ALTERNATIVE_NAMES.get(name, (name,)))) for name in GALAXY_COLUMNS}
    plain |= {name: name for name in ("shear_2", "MW_rv", "knots_magnorm", "n_knots") if name in names}
    plain |= {name: name for name in ("shear_2_phosim", "sersic_bulge", "sersic_disk") if name in names}
    if angle := _first_present(names, *ALTERNATIVE_NAMES["position_angle_unlensed"]):
        plain["position_angle_unlensed"] = angle
    else:
        plain |= {name: name for name in ELLIPTICITIES}
    tophat = {c: f"sed_val_{c}" for c in COMPONENTS if f"sed_val_{c}" in names}
    named = {c: _first_present(names, *(n.format(c) for n in SED_NAMES)) for c in COMPONENTS if c not in tophat}
    # knots have the spectrum of the disk
    named = {c: name or named.get("disk") for c, name in named.items()}
    wanted = {"galaxy_id", *plain.values(), *tophat.values(), *(name for name in named.values() if name)}
    table = parquet.read(batch.path, sorted(wanted), batch.start, batch.stop)
    out: dict[str, Any] = {name: parquet.numbers(table[column]) for name, column in plain.items()}
    ids = parquet.identifiers_of(table["galaxy_id"])
    out |= {f"sed_val_{c}": parquet.float_lists(table[name]) for c, name in tophat.items()}
    out |= {f"{c}_sed": parquet.texts(table[name]) for c, name in named.items() if name}
    if "shear_2" not in out:
        # GCR: shear_2_phosim = -shear_2
        out["shear_2"] = -out["shear_2_phosim"]
    out["id"], reason = ids.values, ids.reason
    for component, index in (("bulge", 4), ("disk", 1)):
        if (name := f"sersic_{component}") in out:
            unexpected = np.isfinite(out[f"{component}_magnorm"]) & (out[name] != index)
            reason[unexpected & (reason == "")] = f"Sersic index of the {component} is not {index}"
    if "position_angle_unlensed" not in out:
        out["position_angle_unlensed"], twisted = _position_angle(out)
        reason[twisted & (reason == "")] = "bulge and disk differ in position angle"
    out.setdefault("MW_rv", np.full(len(table), mw_rv))
    # the top-hat spectra of cosmoDC2 include the dust of the galaxies; files with named spectra do not describe it
    return out | {"reason": reason, "bulge_av": 0.0, "bulge_rv": MW_RV, "disk_av": 0.0, "disk_rv": MW_RV}


def _position_angle(out: dict[str, Any]) -> tuple[np.ndarray, np.ndarray]:
    """Return position angles from ellipticities, degrees east of north, and where bulge and disk differ by over 1 deg.

    skyCatalogs draws Shear(-e1, -e2), which has the direction 90 deg + p for a position angle p (galaxy_object.py).
    """
    e1d, e2d, e1b, e2b = (out[name] for name in ELLIPTICITIES)
    disk, bulge = (np.degrees(np.arctan2(e2, e1)) / 2 % 180 for e1, e2 in ((e1d, e2d), (e1b, e2b)))
    lit = {c: np.isfinite(out[f"{c}_magnorm"]) for c in ("bulge", "disk")}
    elongated = (np.hypot(e1d, e2d) > 0.01) & (np.hypot(e1b, e2b) > 0.01)
    twisted = lit["bulge"] & lit["disk"] & elongated & (np.abs((disk - bulge + 90) % 180 - 90) > 1)
    return np.where(lit["bulge"] & ~lit["disk"] & ~np.isfinite(out.get("knots_magnorm", np.nan)), bulge, disk), twisted


def _read_stars(names: list[str], batch: Batch, mw_rv: float) -> dict[str, Any]:
    """Return the columns of stars; `names` are the columns of the file."""
    wanted = [*STAR_COLUMNS, *(name for name in ("object_type", "MW_rv") if name in names)]
    table = parquet.read(batch.path, wanted, batch.start, batch.stop)
    out: dict[str, Any] = {name: parquet.numbers(table[name]) for name in ("ra", "dec", "magnorm", "MW_av")}
    ids = parquet.identifiers_of(table["id"])
    out["sed"] = parquet.texts(table["sed_filepath"])
    out["MW_rv"] = parquet.numbers(table["MW_rv"]) if "MW_rv" in names else np.full(len(table), mw_rv)
    out["id"], reason = ids.values, ids.reason
    if "object_type" in names:
        reason[parquet.texts(table["object_type"]) != "star"] = "object_type is not star"
    return out | {"reason": reason}


def _read_trilegal(names: list[str], batch: Batch, mw_rv: float) -> dict[str, Any]:
    """Return the columns of TRILEGAL stars, as blackbodies with temperatures rounded to 100 K."""
    band = next(band for band in TRILEGAL_BANDS if f"{band}mag" in names)
    table = parquet.read(batch.path, [*TRILEGAL_COLUMNS, f"{band}mag"], batch.start, batch.stop)
    out: dict[str, Any] = {name: parquet.numbers(table[name]) for name in ("ra", "dec")}
    ids = parquet.identifiers_of(table["id"], TRILEGAL_ID)
    out["id"] = ids.values
    with np.errstate(over="ignore"):
        kelvin = 10 ** parquet.numbers(table["logT"])
    good = (kelvin >= 500) & (kelvin < 1e6)
    rounded = (np.round(np.where(good, kelvin, 5000) / 100) * 100).astype(int)
    out["sed"] = np.array([f"blackbody_{value}" for value in rounded], object)
    return out | {
        # skyCatalogs scales the spectrum to imag after extinction (trilegal_object.py)
        "ref_mag": parquet.numbers(table[f"{band}mag"]),
        "ref_band": f"lsst_{band}",
        "MW_av": parquet.numbers(table["av"]),
        "MW_rv": MW_RV,
        "reason": ids.reason_after(np.where(good, "", "effective temperature is not a number")),
    }


def read_magnitudes(batch: Batch) -> pd.DataFrame:
    """Return the magnitudes (<band>mag) of the TRILEGAL stars of a batch, in the bands that the file has."""
    names = [f"{band}mag" for band in TRILEGAL_BANDS if f"{band}mag" in parquet.schema(batch.path).names]
    table = parquet.read(batch.path, names, batch.start, batch.stop)
    return pd.DataFrame({name: parquet.numbers(table[name]) for name in names})


def _unique_over_files(file: PixelFile, ids: np.ndarray) -> np.ndarray:
    """Return identifiers that are unique over all files: TRILEGAL numbers the stars within each pixel."""
    if file.kind != "trilegal":
        return ids
    return np.where(ids < 0, ids, ids + ((file.pixel + 1) << 40))


def _read_fluxes(file: PixelFile, batch: Batch, ids: np.ndarray) -> dict[str, np.ndarray]:
    """Return the fluxes of the objects of a batch, joined by identifier.

    They are mostly in the same rows of the flux file; all of its rows are searched for the others.
    """
    path = file.flux
    assert path is not None
    column, pattern = identifier_column(file)
    names = [name for name in FLUX_COLUMNS if name in parquet.schema(path).names]
    total = parquet.count(path)

    def read_slice(start: int, stop: int) -> pd.DataFrame:
        table: pa.Table = parquet.read(path, [column, *names], start, stop)
        values = {name: parquet.numbers(table[name]).astype(np.float32) for name in names}
        index = parquet.identifiers_of(table[column], pattern).values
        return pd.DataFrame(values, index=index).loc[~pd.Index(index).duplicated() & (index >= 0)]

    same_rows = read_slice(batch.start, min(batch.stop, total))
    fluxes = same_rows.reindex(ids)
    missing = (ids >= 0) & ~np.isin(ids, same_rows.index)
    for start in range(0, total, MAX_ROWS) if missing.any() else ():
        part = read_slice(start, min(start + MAX_ROWS, total))
        matched = missing & np.isin(ids, part.index)
        fluxes.iloc[np.flatnonzero(matched)] = part.reindex(ids[matched]).to_numpy()
        missing &= ~matched
        if not missing.any():
            break
    return {name: fluxes[name].to_numpy() for name in names}
