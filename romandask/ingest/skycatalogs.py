"""skyCatalogs folders (LSSTDESC): their configuration, and their Parquet files, one per object type and HEALPix pixel.

All generations are read. Galaxies have schema 1.1 to 1.3 (position angle; top-hat spectra), the schema from 1.5 on
(ellipticities instead of the angle), or an early one (`shear_2_phosim`, of opposite sign); any of them may have named
spectra instead of top-hat spectra. Stars are in `pointsource` files (named spectra) or TRILEGAL files (effective
temperature and magnitudes). The configuration has the object types, the names of their files and the top-hat bins; from
1.3 on it includes one file per object type.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
import yaml
from cdshealpix import from_ring

from romandask.ingest import parquet
from romandask.ingest.rows import COMPONENTS, MAX_ROWS, Batch, file_states
from romandask.ingest.skycatalogs_rows import (
    MW_RV,
    PixelFile,
    check_columns,
    read_magnitudes,
    read_rows,
)
from romandask.model.errors import UserError
from romandask.storage.paths import AnyPath

TEMPLATES = {
    "galaxy": "galaxy_(?P<healpix>\\d+).parquet",
    "star": "(?:pointsource|star)_(?P<healpix>\\d+).parquet",
    "trilegal": "trilegal_(?P<healpix>\\d+).parquet",
}
"""File names of each kind of object if the configuration does not give them."""
KINDS = {"galaxy": "galaxy", "star": "star", "trilegal": "trilegal", "trilegal_star": "trilegal"}
"""Kind of object of each object type that is read. Galaxies of diffsky have no spectra in their files; the objects of
other types vary or move."""
TOPHAT_ROWS = 100_000
"""Largest number of rows of a batch of galaxies with top-hat spectra: reading it takes some 300 MB."""


@dataclass(frozen=True, kw_only=True)
class Source:
    """A folder of skyCatalogs files."""

    files: dict[str, PixelFile]
    """Files with objects, by name."""
    edges: tuple[float, ...]
    """Rest-frame edges of the bins of top-hat spectra, nm; empty if no file has top-hat spectra."""
    mw_rv: float
    """R_V of the Milky Way for files that have no column for it."""
    rows: int
    """Largest number of rows of a batch."""
    ignored: tuple[str, ...]
    """Object types of the configuration that are not read."""
    components: bool = False
    """Always False: a row is a galaxy or a star."""

    def batches(self) -> tuple[Batch, ...]:
        """Return the batches of all files."""
        rows = {"galaxy": min(self.rows, TOPHAT_ROWS) if self.edges else self.rows}
        return tuple(
            batch
            for name, file in self.files.items()
            for batch in parquet.slices(file.path, name, rows.get(file.kind, self.rows))
        )

    def cell(self, batch: Batch) -> tuple[int, int]:
        """Return the HEALPix order and the nested pixel of the file of a batch.

        Lensing moves some of its objects to neighbouring pixels.
        """
        file = self.files[batch.source]
        return file.order, file.cell

    def count(self) -> int:
        """Return the number of rows of all files, from their footers."""
        return sum(parquet.count(file.path) for file in self.files.values())

    def state(self) -> Any:
        """Return the sizes and modification times of all files, and the settings of the configuration."""
        fluxes = {file.flux.name: file.flux for file in self.files.values() if file.flux}
        paths = {name: file.path for name, file in self.files.items()} | fluxes
        return {"files": file_states(paths), "edges": list(self.edges), "mw_rv": self.mw_rv}

    def read(self, batch: Batch) -> pd.DataFrame:
        """Return all rows of a batch in the normal form."""
        return read_rows(batch, self.files[batch.source], self.mw_rv, self.edges)

    def trilegal_sample(self, rows: int) -> pd.DataFrame:
        """Return about `rows` good TRILEGAL stars, the first of each file, with all magnitudes that the files have.

        The columns are those of the normal form and <band>mag.
        """
        files = {name: file for name, file in self.files.items() if file.kind == "trilegal"}
        parts = [pd.DataFrame()]
        for name, file in files.items():
            batch = Batch(file.path, 0, min(parquet.count(file.path), -(-rows // len(files))), name)
            parts.append(self.read(batch).join(read_magnitudes(batch)))
        stars = pd.concat(parts, ignore_index=True)
        return stars[stars["reason"] == ""] if len(stars) else stars


def open_source(folder: AnyPath, rows: int = MAX_ROWS) -> Source:
    """Open a folder of skyCatalogs files and check their columns.

    Parameters
    ----------
    folder : path
        The folder, or one of the configuration files in it if there are several.
    rows : int
        Largest number of rows of a batch.

    Raises
    ------
    UserError
        If the folder, its configuration or a column is missing, or if a file is not Parquet.
    """
    config, folder = _configuration_file(folder)
    content = _read_config(config, folder)
    types = content.get("object_types")
    if types is None:
        types = {name: {} for name in TEMPLATES}
    if not isinstance(types, dict):
        raise UserError(f"{config}: key object_types holds {type(types).__name__}, expected a mapping of object types")
    files: dict[str, PixelFile] = {}
    for name, section in types.items():
        if name in KINDS:
            files |= _files(folder, config, name, section if isinstance(section, dict) else {}, content)
    parts = (*COMPONENTS, *(f"{component}_basic" for component in COMPONENTS))
    ignored = tuple(str(name) for name in types if name not in KINDS and name not in parts)
    if not files:
        raise UserError(_why_no_files(folder, config, types, ignored))
    tophat = False
    for file in files.values():
        names = parquet.schema(file.path).names
        check_columns(file)
        tophat |= any(f"sed_val_{c}" in names for c in COMPONENTS)
    try:
        mw_rv = float(content["MW_extinction_values"]["r_v"]["value"])
    except (KeyError, TypeError, ValueError):
        mw_rv = MW_RV
    edges = _tophat_edges(config, content) if tophat else ()
    return Source(files=files, edges=edges, mw_rv=mw_rv, rows=rows, ignored=ignored)


def _why_no_files(folder: AnyPath, config: AnyPath, types: dict[str, Any], ignored: tuple[str, ...]) -> str:
    """Return the message for a folder without a file of the object types that its configuration names."""
    found = sorted(path.name for path in folder.iterdir() if path.suffix == ".parquet")
    for kind, template in TEMPLATES.items():
        present = [name for name in found if re.fullmatch(template, name)]
        if present and not any(KINDS.get(str(name)) == kind for name in types):
            return (
                f"{config}: object_types names {', '.join(map(str, types))}, not {kind}, but the folder holds "
                f"{present[0]}: add {kind} to object_types"
            )
    other = f"; object types {', '.join(ignored)} are not read" if ignored else ""
    listed = f"{', '.join(found[:5])}{', ...' if len(found) > 5 else ''}" if found else "no .parquet file"
    read = ", ".join(str(name) for name in types if name in KINDS) or "that are read"
    return (
        f"{folder}: holds no galaxy_<pixel>.parquet, pointsource or trilegal file of the object types {read} of "
        f"{config.name} (found {listed}){other}"
    )


class _Loader(yaml.SafeLoader):
    """A safe YAML loader with `!include file`, for files below one folder."""

    folder: AnyPath
    depth: int

    def include(self, node: yaml.ScalarNode) -> Any:
        path = (self.folder / str(self.construct_scalar(node))).resolve()
        if not path.is_relative_to(self.folder.resolve()) or not path.is_file() or self.depth > 5:
            raise UserError(f"{self.folder}: the configuration includes {path.name}, which is not there: copy it too")
        return _read_config(path, self.folder, self.depth + 1)


_Loader.add_constructor("!include", _Loader.include)


def _read_config(path: AnyPath, folder: AnyPath, depth: int = 0) -> dict[str, Any]:
    """Return the content of a configuration file; `depth` counts nested includes."""
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


def _configuration_file(folder: AnyPath) -> tuple[AnyPath, AnyPath]:
    """Return the configuration file and the folder; `folder` may be either."""
    if folder.is_file():
        return folder, folder.parent
    if not folder.is_dir():
        raise UserError(f"{folder}: no such folder; set data=FOLDER so that truth.path lies below it")
    usual = folder / "skyCatalog.yaml"
    if usual.is_file():
        return usual, folder
    paths = [path for path in sorted(folder.glob("*.yaml")) if re.search(r"(?m)^object_types\s*:", path.read_text())]
    if not paths:
        raise UserError(f"{folder}: holds no skyCatalog.yaml: not a skyCatalogs folder")
    if len(paths) > 1:
        names = ", ".join(path.name for path in paths)
        raise UserError(f"{folder}: holds several configurations ({names}): name one of them instead of the folder")
    return paths[0], folder


def _tophat_edges(config: AnyPath, content: dict[str, Any]) -> tuple[float, ...]:
    """Return the edges of the top-hat bins, nm.

    Until schema 1.2 the configuration has them under SED_models, later under the object type of galaxies.
    """
    for section in (content.get("SED_models"), (content.get("object_types") or {}).get("galaxy")):
        if isinstance(section, dict) and "tophat" in section:
            try:
                bins = [(float(start), float(width)) for start, width in section["tophat"]["bins"]]
                factor = {"angstrom": 0.1, "nm": 1.0}[section["tophat"]["units"]]
                edges = tuple(factor * start for start, _ in bins) + (factor * sum(bins[-1]),)
            except (KeyError, TypeError, ValueError, IndexError):
                break
            if not np.allclose([start + width for start, width in bins[:-1]], [start for start, _ in bins[1:]]):
                raise UserError(f"{config}: the bins of tophat do not follow one another without gaps")
            return edges
    raise UserError(f"{config}: key SED_models.tophat (bins, units) is missing or not as skyCatalogs writes it")


def _files(folder: AnyPath, config: AnyPath, name: str, section: Any, content: dict[str, Any]) -> dict[str, PixelFile]:
    """Return the files of an object type, by name; `section` is its part of the configuration `content`."""
    kind = KINDS[name]
    template = section.get("file_template", TEMPLATES[kind].replace("trilegal", name))
    partition = section.get("area_partition") or content.get("area_partition") or {}
    nside, ordering = partition.get("nside", 32), partition.get("ordering", "ring")
    if not isinstance(nside, int) or nside < 1 or nside & (nside - 1) or ordering not in ("ring", "nested", "nest"):
        raise UserError(f"{config}: area_partition has nside {nside}, ordering {ordering}: expected a power of 2, ring")
    order = nside.bit_length() - 1
    flux_template = section.get("flux_file_template", template.replace("_(", "_flux_(", 1))
    try:
        pattern, flux_pattern = re.compile(template), re.compile(flux_template)
    except (re.error, TypeError):
        raise UserError(f"{config}: file_template of {name} is not a regular expression: {template}") from None
    if "healpix" not in pattern.groupindex or "healpix" not in flux_pattern.groupindex:
        raise UserError(f"{config}: file_template of {name} has no (?P<healpix>...): {template}")
    files: dict[str, PixelFile] = {}
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
            flux = flux_paths.get(match["healpix"])
            files[path.name] = PixelFile(path=path, kind=kind, order=order, cell=cell, pixel=pixel, flux=flux)
    return files
