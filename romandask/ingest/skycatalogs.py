"""skyCatalogs (LSSTDESC): Parquet files a HEALPix pixel of galaxies and of stars, in its generations.

Galaxies: schema 1.1 to 1.3 (position angle; top-hat spectra), the schema from 1.5 on (ellipticities instead of the
angle), an early one (`shear_2_phosim`, of opposite sign), and any with named spectra instead of top-hats. Stars:
`pointsource` files (named spectra) and TRILEGAL files (effective temperature and magnitudes). The configuration holds
the object types, their files' names and the top-hat bins; from 1.3 on it includes a file an object type.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import yaml
from cdshealpix import from_ring

from romandask.ingest import parquet
from romandask.ingest.rows import COMPONENTS, FLUXES, MAX_ROWS, Batch, file_states, normal_form, with_reasons
from romandask.model.errors import UserError
from romandask.storage.paths import AnyPath

TEMPLATES = {
    "galaxy": "galaxy_(?P<healpix>\\d+).parquet",
    "star": "(?:pointsource|star)_(?P<healpix>\\d+).parquet",
    "trilegal": "trilegal_(?P<healpix>\\d+).parquet",
}
"""Files by object type, where the configuration does not say."""
KINDS = {"galaxy": "galaxy", "star": "star", "trilegal": "trilegal", "trilegal_star": "trilegal"}
"""Object types that are read; galaxies of diffsky have no spectra in their files, others vary or move."""
NAMES = {
    "redshift": ("redshift", "redshiftHubble", "redshift_hubble"),
    "position_angle_unlensed": ("position_angle_unlensed", "position_angle_true"),
}
"""Names of other generations, in order of preference; elsewhere the normal form's own name."""
SED_NAMES = ("{}_sed_file_path", "{}_sed_filepath", "{}_sed_file")
ELLIPTICITIES = tuple(f"ellipticity_{i}_{c}_true" for c in ("disk", "bulge") for i in (1, 2))
PLAIN = tuple(
    (
        "ra dec redshift shear_1 convergence size_bulge_true size_minor_bulge_true size_disk_true size_minor_disk_true "
        "bulge_magnorm disk_magnorm MW_av"
    ).split()
)
STAR_COLUMNS = tuple("id ra dec magnorm sed_filepath MW_av".split())
TRILEGAL_COLUMNS = tuple("id ra dec av logT".split())
PLAIN_ID = r"(-?\d{1,18})"
TRILEGAL_ID = r".*_hp(?:\d+)_(\d{1,12})"
"""TRILEGAL ids are texts, <source>_hp<pixel>_<number in the pixel>."""
MW_RV = 3.1
TOPHAT_ROWS = 100_000
"""Rows of a batch of galaxies with top-hat spectra at most: some 300 MB while it is read."""


@dataclass(frozen=True)
class File:
    """A file of one HEALPix pixel."""

    path: AnyPath
    kind: str
    """galaxy, star or trilegal"""
    order: int
    """HEALPix order of the pixel."""
    cell: int
    """The pixel, nested."""
    pixel: int
    """The pixel as the file's name has it."""
    flux: AnyPath | None
    """File of Rubin fluxes of the same objects."""


@dataclass(frozen=True)
class Source:
    """A folder of skyCatalogs files."""

    files: dict[str, File]
    """By name."""
    edges: tuple[float, ...]
    """Rest-frame edges of the top-hat bins, nm; empty where no file has top-hat spectra."""
    mw_rv: float
    """R_V of the Milky Way where a file has no such column."""
    rows: int
    """Most rows of a batch."""
    ignored: tuple[str, ...]
    """Object types of the configuration that are not read."""

    def batches(self) -> tuple[Batch, ...]:
        """Return slices of the files."""
        rows = {"galaxy": min(self.rows, TOPHAT_ROWS) if self.edges else self.rows}
        return tuple(
            batch
            for name, file in self.files.items()
            for batch in parquet.slices(file.path, name, rows.get(file.kind, self.rows))
        )

    def cell(self, batch: Batch) -> tuple[int, int]:
        """Return HEALPix order and nested cell of a batch's file; lensing moves some of its objects to neighbours."""
        file = self.files[batch.source]
        return file.order, file.cell

    def count(self) -> int:
        """Return the rows of all files, from their footers."""
        return sum(parquet.count(file.path) for file in self.files.values())

    def state(self) -> Any:
        """Return bytes and times of all files, and what the configuration says."""
        fluxes = {file.flux.name: file.flux for file in self.files.values() if file.flux}
        paths = {name: file.path for name, file in self.files.items()} | fluxes
        return {"files": file_states(paths), "edges": list(self.edges), "mw_rv": self.mw_rv}

    def read(self, batch: Batch) -> pd.DataFrame:
        """Return all rows of a batch in the normal form."""
        file = self.files[batch.source]
        schema = parquet.schema(file.path)
        reader = {"galaxy": _galaxies, "star": _stars, "trilegal": _trilegal}[file.kind]
        columns = reader(schema.names, batch, file, self.mw_rv)
        id_name, pattern = _identifier(file)
        repeated = parquet.repeated(batch, id_name, pattern)
        if file.flux:
            columns |= _fluxes(file, batch, columns["id"])
        kind = "galaxy" if file.kind == "galaxy" else "star"
        columns["id"] = _shifted(file, columns["id"])
        frame = normal_form(batch.source, np.arange(batch.start, batch.stop), kind, columns)
        return with_reasons(frame, len(self.edges) - 1, repeated)


def open_source(folder: AnyPath, rows: int = MAX_ROWS) -> Source:
    """Return the files of a folder, their columns checked.

    Parameters
    ----------
    folder : the folder, or a configuration file in it where it has several
    rows : most rows of a batch

    Raises
    ------
    UserError
        If the folder, its configuration or a column is missing, or a file is not Parquet.
    """
    config, folder = _configuration(folder)
    content = _read_config(config, folder)
    types = content.get("object_types")
    if types is None:
        types = {name: {} for name in TEMPLATES}
    if not isinstance(types, dict):
        raise UserError(f"{config}: key object_types holds {type(types).__name__}, expected a mapping of object types")
    files: dict[str, File] = {}
    for name, section in types.items():
        if name in KINDS:
            files |= _files(folder, config, name, section if isinstance(section, dict) else {}, content)
    parts = (*COMPONENTS, *(f"{component}_basic" for component in COMPONENTS))
    ignored = tuple(str(name) for name in types if name not in KINDS and name not in parts)
    if not files:
        other = f"; object types {', '.join(ignored)} are not read" if ignored else ""
        raise UserError(f"{folder}: holds no galaxy_<pixel>.parquet, pointsource or trilegal file{other}")
    tophat = False
    for file in files.values():
        names = parquet.schema(file.path).names
        _check(file, names)
        tophat |= any(f"sed_val_{c}" in names for c in COMPONENTS)
        if file.flux and _identifier(file)[0] not in parquet.schema(file.flux).names:
            raise UserError(f"{file.flux}: column {_identifier(file)[0]!r} is missing")
    try:
        mw_rv = float(content["MW_extinction_values"]["r_v"]["value"])
    except (KeyError, TypeError, ValueError):
        mw_rv = MW_RV
    return Source(files, _edges(config, content) if tophat else (), mw_rv, rows, ignored)


class _Loader(yaml.SafeLoader):
    """Safe YAML with `!include file`, files below one folder."""

    folder: AnyPath
    depth: int

    def include(self, node: yaml.ScalarNode) -> Any:
        path = (self.folder / str(self.construct_scalar(node))).resolve()
        if not path.is_relative_to(self.folder.resolve()) or not path.is_file() or self.depth > 5:
            raise UserError(f"{self.folder}: the configuration includes {path.name}, which is not there: copy it too")
        return _read_config(path, self.folder, self.depth + 1)


_Loader.add_constructor("!include", _Loader.include)


def _read_config(path: AnyPath, folder: AnyPath, depth: int = 0) -> dict[str, Any]:
    try:
        loader = _Loader(path.read_text())
        loader.folder, loader.depth = folder, depth
        try:
            content = loader.get_single_data()
        finally:
            loader.dispose()
    except (yaml.YAMLError, UnicodeDecodeError, OSError) as error:
        problem = getattr(error, "problem", None) or getattr(error, "strerror", None) or "not text"
        raise UserError(f"{path}: not valid YAML ({problem})") from None
    if not isinstance(content, dict):
        raise UserError(f"{path}: holds {type(content).__name__}, expected a mapping of settings")
    return content


def _configuration(folder: AnyPath) -> tuple[AnyPath, AnyPath]:
    if folder.is_file():
        return folder, folder.parent
    if not folder.is_dir():
        raise UserError(f"{folder}: no such folder; set data=FOLDER so that truth.path lies below it")
    usual = folder / "skyCatalog.yaml"
    if usual.is_file():
        return usual, folder
    found = [path for path in sorted(folder.glob("*.yaml")) if re.search(r"(?m)^object_types\s*:", path.read_text())]
    if not found:
        raise UserError(f"{folder}: holds no skyCatalog.yaml: not a skyCatalogs folder")
    if len(found) > 1:
        names = ", ".join(path.name for path in found)
        raise UserError(f"{folder}: holds several configurations ({names}): name one of them instead of the folder")
    return found[0], folder


def _edges(config: AnyPath, content: dict[str, Any]) -> tuple[float, ...]:
    """Return the edges of the top-hat bins; until schema 1.2 under SED_models, later under the galaxies."""
    for place in (content.get("SED_models"), (content.get("object_types") or {}).get("galaxy")):
        if isinstance(place, dict) and "tophat" in place:
            try:
                bins = [(float(start), float(width)) for start, width in place["tophat"]["bins"]]
                factor = {"angstrom": 0.1, "nm": 1.0}[place["tophat"]["units"]]
                edges = tuple(factor * start for start, _ in bins) + (factor * sum(bins[-1]),)
            except (KeyError, TypeError, ValueError, IndexError):
                break
            if not np.allclose([start + width for start, width in bins[:-1]], [start for start, _ in bins[1:]]):
                raise UserError(f"{config}: the bins of tophat do not follow one another without gaps")
            return edges
    raise UserError(f"{config}: key SED_models.tophat (bins, units) is missing or not as skyCatalogs writes it")


def _files(folder: AnyPath, config: AnyPath, name: str, section: Any, content: dict[str, Any]) -> dict[str, File]:
    kind = KINDS[name]
    template = section.get("file_template", TEMPLATES[kind].replace("trilegal", name))
    partition = section.get("area_partition") or content.get("area_partition") or {}
    nside, ordering = partition.get("nside", 32), partition.get("ordering", "ring")
    if not isinstance(nside, int) or nside < 1 or nside & (nside - 1) or ordering not in ("ring", "nested", "nest"):
        raise UserError(f"{config}: area_partition has nside {nside}, ordering {ordering}: expected a power of 2, ring")
    order = nside.bit_length() - 1
    fluxes = section.get("flux_file_template", template.replace("_(", "_flux_(", 1))
    try:
        pattern, flux_pattern = re.compile(template), re.compile(fluxes)
    except (re.error, TypeError):
        raise UserError(f"{config}: file_template of {name} is not a regular expression: {template}") from None
    if "healpix" not in pattern.groupindex or "healpix" not in flux_pattern.groupindex:
        raise UserError(f"{config}: file_template of {name} has no (?P<healpix>...): {template}")
    files: dict[str, File] = {}
    flux_paths = {}
    for path in sorted(folder.iterdir()):
        if match := flux_pattern.fullmatch(path.name):
            flux_paths[match["healpix"]] = path
    for path in sorted(folder.iterdir()):
        if match := pattern.fullmatch(path.name):
            pixel = int(match["healpix"])
            if pixel >= 12 * nside**2:
                raise UserError(f"{path}: {pixel} is not a HEALPix pixel of nside {nside}")
            cell = int(from_ring(np.array([pixel], np.uint64), order)[0]) if ordering == "ring" else pixel
            files[path.name] = File(path, kind, order, cell, pixel, flux_paths.get(match["healpix"]))
    return files


def _check(file: File, names: list[str]) -> None:
    needed: list[tuple[str, ...]]
    if file.kind == "star":
        needed = [(name,) for name in STAR_COLUMNS]
    elif file.kind == "trilegal":
        needed = [(name,) for name in TRILEGAL_COLUMNS] + [tuple(f"{band}mag" for band in "irgzyu")]
    else:
        needed = [("galaxy_id",)] + [NAMES.get(name, (name,)) for name in PLAIN] + [("shear_2", "shear_2_phosim")]
        if not set(ELLIPTICITIES) <= set(names):
            needed.append(NAMES["position_angle_unlensed"])
        needed += [(f"sed_val_{c}", *(n.format(c) for n in SED_NAMES)) for c in ("bulge", "disk")]
        if "knots_magnorm" in names:
            needed.append(("n_knots",))
    for choices in needed:
        if not set(choices) & set(names):
            raise UserError(f"{file.path}: column {choices[0]!r} is missing (found {', '.join(names)})")


def _first(names: list[str], *choices: str) -> str | None:
    return next((name for name in choices if name in names), None)


def _galaxies(names: list[str], batch: Batch, file: File, mw_rv: float) -> dict[str, Any]:
    plain = {name: str(_first(names, *NAMES.get(name, (name,)))) for name in PLAIN}
    plain |= {name: name for name in ("shear_2", "MW_rv", "knots_magnorm", "n_knots") if name in names}
    plain |= {name: name for name in ("shear_2_phosim", "sersic_bulge", "sersic_disk") if name in names}
    if angle := _first(names, *NAMES["position_angle_unlensed"]):
        plain["position_angle_unlensed"] = angle
    else:
        plain |= {name: name for name in ELLIPTICITIES}
    lists = {c: f"sed_val_{c}" for c in COMPONENTS if f"sed_val_{c}" in names}
    named = {c: _first(names, *(n.format(c) for n in SED_NAMES)) for c in COMPONENTS if c not in lists}
    # knots have the spectrum of the disk
    named = {c: name or named.get("disk") for c, name in named.items()}
    wanted = {"galaxy_id", *plain.values(), *lists.values(), *(name for name in named.values() if name)}
    table = parquet.read(batch.path, sorted(wanted), batch.start, batch.stop)
    out: dict[str, Any] = {name: parquet.numbers(table[column]) for name, column in plain.items()}
    out["id"] = parquet.integers(table["galaxy_id"], PLAIN_ID)
    out |= {f"sed_val_{c}": parquet.bins(table[name]) for c, name in lists.items()}
    out |= {f"{c}_sed": parquet.texts(table[name]) for c, name in named.items() if name}
    if "shear_2" not in out:
        # GCR: shear_2_phosim = -shear_2
        out["shear_2"] = -out["shear_2_phosim"]
    reason = np.full(len(table), "", object)
    for component, index in (("bulge", 4), ("disk", 1)):
        if (name := f"sersic_{component}") in out:
            odd = np.isfinite(out[f"{component}_magnorm"]) & (out[name] != index)
            reason[odd & (reason == "")] = f"Sersic index of the {component} is not {index}"
    if "position_angle_unlensed" not in out:
        out["position_angle_unlensed"], twisted = _position_angle(out)
        reason[twisted & (reason == "")] = "bulge and disk differ in position angle"
    out.setdefault("MW_rv", np.full(len(table), mw_rv))
    # the top-hat spectra of cosmoDC2 hold the galaxies' own dust; files with named spectra tell of none
    return out | {"reason": reason, "bulge_av": 0.0, "bulge_rv": MW_RV, "disk_av": 0.0, "disk_rv": MW_RV}


def _position_angle(out: dict[str, Any]) -> tuple[np.ndarray, np.ndarray]:
    """Return degrees east of north from ellipticities, and where bulge and disk differ by more than a degree.

    skyCatalogs draws Shear(-e1, -e2), the direction 90 deg + p of a position angle p (galaxy_object.py).
    """
    e1d, e2d, e1b, e2b = (out[name] for name in ELLIPTICITIES)
    disk, bulge = (np.degrees(np.arctan2(e2, e1)) / 2 % 180 for e1, e2 in ((e1d, e2d), (e1b, e2b)))
    lit = {c: np.isfinite(out[f"{c}_magnorm"]) for c in ("bulge", "disk")}
    flat = (np.hypot(e1d, e2d) > 0.01) & (np.hypot(e1b, e2b) > 0.01)
    twisted = lit["bulge"] & lit["disk"] & flat & (np.abs((disk - bulge + 90) % 180 - 90) > 1)
    return np.where(lit["bulge"] & ~lit["disk"] & ~np.isfinite(out.get("knots_magnorm", np.nan)), bulge, disk), twisted


def _stars(names: list[str], batch: Batch, file: File, mw_rv: float) -> dict[str, Any]:
    wanted = [*STAR_COLUMNS, *(name for name in ("object_type", "MW_rv") if name in names)]
    table = parquet.read(batch.path, wanted, batch.start, batch.stop)
    out: dict[str, Any] = {name: parquet.numbers(table[name]) for name in ("ra", "dec", "magnorm", "MW_av")}
    out["id"] = parquet.integers(table["id"], PLAIN_ID)
    out["sed"] = parquet.texts(table["sed_filepath"])
    out["MW_rv"] = parquet.numbers(table["MW_rv"]) if "MW_rv" in names else np.full(len(table), mw_rv)
    reason = np.full(len(table), "", object)
    if "object_type" in names:
        reason[parquet.texts(table["object_type"]) != "star"] = "object_type is not star"
    return out | {"reason": reason}


def _trilegal(names: list[str], batch: Batch, file: File, mw_rv: float) -> dict[str, Any]:
    band = next(band for band in "irgzyu" if f"{band}mag" in names)
    table = parquet.read(batch.path, [*TRILEGAL_COLUMNS, f"{band}mag"], batch.start, batch.stop)
    out: dict[str, Any] = {name: parquet.numbers(table[name]) for name in ("ra", "dec")}
    out["id"] = parquet.integers(table["id"], TRILEGAL_ID)
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
        "reason": np.where(good, "", "effective temperature is not a number").astype(object),
    }


def _identifier(file: File) -> tuple[str, str]:
    if file.kind == "galaxy":
        return "galaxy_id", PLAIN_ID
    return "id", TRILEGAL_ID if file.kind == "trilegal" else PLAIN_ID


def _shifted(file: File, ids: np.ndarray) -> np.ndarray:
    """Return ids that are unique over files: TRILEGAL numbers its stars within a pixel."""
    if file.kind != "trilegal":
        return ids
    return np.where(ids < 0, ids, ids + ((file.pixel + 1) << 40))


def _fluxes(file: File, batch: Batch, ids: np.ndarray) -> dict[str, np.ndarray]:
    """Return the fluxes of a batch's objects, joined by id: mostly the same rows of the flux file, else wherever."""
    path = file.flux
    assert path is not None
    column, pattern = _identifier(file)
    names = [name for name in FLUXES if name in parquet.schema(path).names]
    total = parquet.count(path)

    def take(start: int, stop: int) -> pd.DataFrame:
        table: pa.Table = parquet.read(path, [column, *names], start, stop)
        values = {name: parquet.numbers(table[name]).astype(np.float32) for name in names}
        index = parquet.integers(table[column], pattern)
        return pd.DataFrame(values, index=index).loc[~pd.Index(index).duplicated() & (index >= 0)]

    same = take(batch.start, min(batch.stop, total))
    found = same.reindex(ids)
    missing = (ids >= 0) & ~np.isin(ids, same.index)
    for start in range(0, total, MAX_ROWS) if missing.any() else ():
        part = take(start, min(start + MAX_ROWS, total))
        here = missing & np.isin(ids, part.index)
        found.iloc[np.flatnonzero(here)] = part.reindex(ids[here]).to_numpy()
        missing &= ~here
        if not missing.any():
            break
    return {name: found[name].to_numpy() for name in names}
