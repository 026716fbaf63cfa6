"""skyCatalogs: Parquet files a HEALPix pixel (nside 32, RING) of galaxies with top-hat spectra and of point sources."""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
from cdshealpix import from_ring
from cdshealpix.nested import neighbours

from romandask.model.config import read_yaml
from romandask.model.errors import UserError

ORDER = 5
"""HEALPix order of the files (nside 32)."""
GALAXY_COLUMNS = tuple(
    (
        "galaxy_id ra dec redshift shear_1 shear_2 convergence size_bulge_true size_minor_bulge_true size_disk_true "
        "size_minor_disk_true position_angle_unlensed bulge_magnorm disk_magnorm knots_magnorm n_knots MW_av MW_rv "
        "sed_val_bulge sed_val_disk sed_val_knots"
    ).split()
)
STAR_COLUMNS = tuple("object_type id ra dec magnorm sed_filepath MW_av MW_rv".split())


@dataclass(frozen=True)
class Source:
    """A folder of skyCatalogs files."""

    folder: Path
    galaxies: dict[int, Path]
    """By nested HEALPix cell of order 5."""
    stars: dict[int, Path]
    edges: tuple[float, ...]
    """Rest-frame edges of the top-hat bins, nm."""

    def files(self) -> dict[str, tuple[int, str]]:
        """Return (bytes, name) of every file, for the inputs' hash."""
        paths = [*self.galaxies.values(), *self.stars.values()]
        return {path.name: (path.stat().st_size, str(path.stat().st_mtime_ns)) for path in paths}


def open_source(folder: Path) -> Source:
    """Return the files of a folder, their columns checked.

    Raises
    ------
    UserError
        If the folder, its configuration or a column is missing, or a file is not Parquet.
    """
    if not folder.is_dir():
        raise UserError(f"{folder}: no such folder; set data=FOLDER so that truth.path lies below it")
    config = folder / "skyCatalog.yaml"
    if not config.is_file():
        raise UserError(f"{folder}: holds no skyCatalog.yaml: not a skyCatalogs folder")
    content = read_yaml(config)
    try:
        bins = content["SED_models"]["tophat"]["bins"]
        factor = {"angstrom": 0.1, "nm": 1.0}[content["SED_models"]["tophat"]["units"]]
        edges = tuple(factor * start for start, _ in bins) + (factor * (bins[-1][0] + bins[-1][1]),)
    except (KeyError, TypeError, ValueError, IndexError):
        raise UserError(
            f"{config}: key SED_models.tophat (bins, units) is missing or not as skyCatalogs writes it"
        ) from None
    galaxies = _files(folder, r"galaxy_(\d+)\.parquet")
    stars = _files(folder, r"pointsource_(\d+)\.parquet")
    if not galaxies:
        raise UserError(f"{folder}: holds no galaxy_<pixel>.parquet file")
    for paths, columns in ((galaxies, GALAXY_COLUMNS), (stars, STAR_COLUMNS)):
        for path in paths.values():
            _check(path, columns)
    return Source(folder, galaxies, stars, edges)


def read_galaxies(source: Source, cell: int) -> pd.DataFrame:
    """Return all rows of a file (by nested cell), with `reason`, empty where the row is good."""
    frame = _read(source.galaxies[cell], GALAXY_COLUMNS)
    sizes = frame[[name for name in frame if name.startswith("size_")]]
    lens = (1 - frame["convergence"]) ** 2 - frame["shear_1"] ** 2 - frame["shear_2"] ** 2
    lights = [np.isfinite(frame[f"{component}_magnorm"]) for component in ("bulge", "disk", "knots")]
    lengths = [frame[f"sed_val_{c}"].map(len).to_numpy() for c in ("bulge", "disk", "knots")]
    reasons = {
        "position is not a number": ~_positions_good(frame),
        "redshift is not a number": ~np.isfinite(frame["redshift"]) | (frame["redshift"] < 0),
        "shear or convergence beyond the weak regime": ~(lens > 0) | ~(frame["convergence"] < 1),
        "size is negative or not a number": ~((sizes >= 0) & np.isfinite(sizes)).all(axis=1),
        "position angle is not a number": ~np.isfinite(frame["position_angle_unlensed"]),
        "R_v below 1": (frame["MW_av"] != 0) & ~(frame["MW_rv"] >= 1),
        "spectrum has a wrong number of bins": np.any([n != len(source.edges) - 1 for n in lengths], axis=0),
        "no component has light": ~np.any(lights, axis=0),
        "duplicate galaxy_id": frame["galaxy_id"].duplicated(),
    }
    return frame.assign(reason=_first_reason(frame, reasons))


def read_stars(source: Source, cell: int, unusable: dict[str, str]) -> pd.DataFrame:
    """Return all rows of a point source file, with `reason`; `unusable` gives, by SED name, why it cannot be used."""
    frame = _read(source.stars[cell], STAR_COLUMNS)
    reasons = {
        "position is not a number": ~_positions_good(frame),
        "magnorm is not a number": ~np.isfinite(frame["magnorm"]),
        "object_type is not star": frame["object_type"] != "star",
        "R_v below 1": (frame["MW_av"] != 0) & ~(frame["MW_rv"] >= 1),
        "duplicate id": frame["id"].duplicated(),
    }
    for text in sorted(set(unusable.values())):
        reasons[text] = frame["sed_filepath"].map(lambda name, text=text: unusable.get(name) == text)
    return frame.assign(reason=_first_reason(frame, reasons))


def sed_names(source: Source, cells: list[int]) -> list[str]:
    """Return the spectra that the point sources of some files name, sorted."""
    names: set[str] = set()
    for cell in cells:
        if cell in source.stars:
            names.update(
                pq.read_table(source.stars[cell], columns=["sed_filepath"])["sed_filepath"].unique().to_pylist()
            )
    return sorted(name for name in names if name)


def around(cells: list[int]) -> list[int]:
    """Return cells of order 5 with their neighbours, sorted: lensing moves some objects out of their file's pixel."""
    found = neighbours(np.array(cells, np.uint64), ORDER) if cells else np.empty(0)
    return sorted({int(cell) for cell in np.ravel(found) if cell >= 0})


def count_rows(source: Source, cells: list[int]) -> int:
    """Return the rows of the files of some cells, from their footers."""
    paths = [files[cell] for files in (source.galaxies, source.stars) for cell in cells if cell in files]
    return sum(pq.read_metadata(path).num_rows for path in paths)


def _positions_good(frame: pd.DataFrame) -> pd.Series:
    return np.isfinite(frame["ra"]) & np.isfinite(frame["dec"]) & (frame["dec"].abs() <= 90)


def _first_reason(frame: pd.DataFrame, reasons: dict[str, pd.Series]) -> np.ndarray:
    out = np.full(len(frame), "", dtype=object)
    for text, bad in reasons.items():
        out[np.asarray(bad, bool) & (out == "")] = text
    return out


def _files(folder: Path, pattern: str) -> dict[int, Path]:
    found = {}
    for path in sorted(folder.iterdir()):
        if match := re.fullmatch(pattern, path.name):
            ring = int(match.group(1))
            if ring >= 12 * 4**ORDER:
                raise UserError(f"{path}: {ring} is not a HEALPix pixel of nside 32")
            found[int(from_ring(np.array([ring], np.uint64), ORDER)[0])] = path
    return found


def _check(path: Path, columns: tuple[str, ...]) -> None:
    try:
        names = pq.read_schema(path).names
    except (pa.ArrowInvalid, OSError):
        raise UserError(f"{path}: not a complete Parquet file ({path.stat().st_size} bytes): copy it again") from None
    for name in columns:
        if name not in names:
            raise UserError(f"{path}: column {name!r} is missing (found {', '.join(names)})")


@lru_cache(maxsize=20)
def _read(path: Path, columns: tuple[str, ...]) -> pd.DataFrame:
    return pq.read_table(path, columns=list(columns)).to_pandas()
