"""Source catalogs on their way in: batches of rows by their place on the sky, then galaxies, stars and quarantine."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import pandas as pd

from romandask.ingest import instance_catalog, skycatalogs, table
from romandask.ingest.rows import COMPONENTS, Batch, Source, merge_components
from romandask.kernels.rendering.scene import component_spectra, magnification
from romandask.kernels.universe.dust import Dust, no_dust
from romandask.kernels.universe.galaxy_rows import flux_columns
from romandask.kernels.universe.synthetic_photometry import band_photons, njy
from romandask.model.errors import UserError
from romandask.model.settings import TruthSettings
from romandask.model.sky import Region
from romandask.model.spectra import NJY_ZERO_POINT, Bandpass, LibrarySpectra, SpectrumLibrary
from romandask.products.hats import with_spatial_index
from romandask.products.schemas import schema
from romandask.products.tables import TableProduct
from romandask.products.units import Unit
from romandask.storage.paths import AnyPath, access_errors_explained, resolve_below

SPECTRA = ("bulge_sed", "disk_sed", "knots_sed", "sed")
_BATCH_BYTES = 600 << 20


def open_sources(settings: TruthSettings, data: AnyPath) -> tuple[Source, ...]:
    """Return the source catalogs that the settings name, checked.

    Raises
    ------
    UserError
        Naming the file, column or key that is missing or wrong.
    """
    opened = {"skycatalogs": skycatalogs.open_source, "instance_catalog": instance_catalog.open_source}
    if settings.source in opened:
        place = resolve_below(data, str(settings.path))
        with access_errors_explained(place):
            return (opened[settings.source](place),)
    found = []
    for kind, each in (("galaxy", settings.galaxy_table), ("star", settings.star_table)):
        if each is not None:
            place = resolve_below(data, each.path)
            with access_errors_explained(place):
                found.append(table.open_source(place, dict(each.columns), kind))
    return tuple(found)


def ingested_rows(sources: tuple[Source, ...]) -> TableProduct:
    """Return the rows of source catalogs in their normal form (schema: catalogs/ingested.yaml), a unit a batch."""
    pairs = tuple((number, batch) for number, source in enumerate(sources) for batch in source.batches())
    states = [source.state() for source in sources]
    names = [f"{number}-{batch.name}" if len(sources) > 1 else batch.name for number, batch in pairs]
    units = tuple(
        Unit(name, {"source": states[number], "start": batch.start, "stop": batch.stop})
        for name, (number, batch) in zip(names, pairs, strict=True)
    )
    return TableProduct(
        stage="truth/ingested",
        units=units,
        make=_ReadBatch(sources, pairs),
        schema=schema("ingested"),
        bytes_per_unit=_BATCH_BYTES,
    )


@dataclass(frozen=True, eq=False)
class _ReadBatch:
    sources: tuple[Source, ...]
    pairs: tuple[tuple[int, Batch], ...]

    def __call__(self, index: int) -> pd.DataFrame:
        number, batch = self.pairs[index]
        frame = self.sources[number].read(batch)
        placed = np.isfinite(frame["ra"]) & np.isfinite(frame["dec"]) & (frame["dec"].abs() <= 90)
        located = with_spatial_index(frame[placed])
        return pd.concat([frame[~placed].assign(_healpix_29=np.int64(-1)), located], ignore_index=True)


def edges_of(rows: TableProduct) -> tuple[float, ...]:
    """Return the edges, nm, of the top-hat bins of ingested rows; empty where there are none."""
    source: _ReadBatch = rows.make  # type: ignore[assignment]
    return next((each.edges for each in source.sources if each.edges), ())


def source_rows(rows: TableProduct) -> int:
    """Return the number of rows of the source catalogs."""
    source: _ReadBatch = rows.make  # type: ignore[assignment]
    counts = [each.count() for each in source.sources]
    return sum(count for count in counts if count is not None)


@dataclass(frozen=True)
class RowsSummary:
    """What a pass over all ingested rows tells."""

    cells: np.ndarray
    """HEALPix cells with rows."""
    spectra: tuple[str, ...]
    """Names of spectra, sorted."""


def scan_rows(rows: TableProduct, order: int) -> RowsSummary:
    """Return the cells and the names of spectra of all good ingested rows, a batch at a time."""
    cells: set[int] = set()
    names: set[str] = set()
    for index in range(len(rows.units)):
        frame = rows.select(index, ["_healpix_29", "reason", *SPECTRA])
        frame = frame[frame["reason"] == ""]
        cells |= set(np.unique(frame["_healpix_29"].to_numpy() >> (2 * (29 - order))).tolist())
        for column in SPECTRA:
            names |= set(frame[column].unique().tolist())
    return RowsSummary(np.array(sorted(cells), np.int64), tuple(sorted(names - {""})))


@dataclass(frozen=True)
class Assemble:
    """Makes the truth catalogs' partitions of ingested rows."""

    settings: TruthSettings
    region: Region
    bandpasses: dict[str, Bandpass]
    rows: TableProduct
    edges: tuple[float, ...]
    library: SpectrumLibrary
    unusable: dict[str, str]
    """By name of a spectrum, why it cannot be used."""
    cells: np.ndarray
    kind: str

    def __call__(self, index: int) -> pd.DataFrame:
        """Return the rows of one cell."""
        merged = self.merged(index)
        good = merged[(merged["reason"] == "") & (merged["kind"] == self.kind)]
        inside = self.region.contains(good["ra"], good["dec"], self.settings.margin)
        good = with_spatial_index(good[inside])
        # components merge to the position of the first: all lie within the cell of the rows that were read
        return self._galaxies(good) if self.kind == "galaxy" else self._stars(good)

    def merged(self, index: int) -> pd.DataFrame:
        """Return the cell's rows, components made galaxies, with reasons."""
        shift = 2 * (29 - self.settings.order)
        cell = int(self.cells[index])
        parts = [_selected(self.rows, unit, cell << shift, (cell + 1) << shift) for unit in range(len(self.rows.units))]
        parts = [part for part in parts if len(part)]
        if not parts:
            return self.rows.empty().assign(n_rows=np.empty(0, np.int32))
        frame = pd.concat(parts, ignore_index=True)
        frame = frame.assign(reason=self.reasons(frame))
        return merge_components(frame[frame["reason"] == ""])

    def reasons(self, frame: pd.DataFrame) -> np.ndarray:
        """Return why rows cannot be used, those of their spectra included."""
        reason = frame["reason"].to_numpy(object).copy()
        blue = min(bandpass.wave[0] for bandpass in self.bandpasses.values())
        red = max(bandpass.wave[-1] for bandpass in self.bandpasses.values())
        place = {name: row for row, name in enumerate(self.library.names)}
        stretch = 1 + frame["redshift"].fillna(0).to_numpy()
        for column in SPECTRA:
            names = frame[column]
            if column != "sed":
                names = names.where(np.isfinite(frame[column.replace("_sed", "_magnorm")]), "")
            bad = names.map(lambda name: self.unusable.get(name, "")).to_numpy(object)
            index = names.map(place).fillna(-1).to_numpy(int)
            known = index >= 0
            short = np.zeros(len(frame), bool)
            low, high = self.library.limits[index[known]].T if known.any() else (0, 0)
            short[known] = (blue / stretch[known] < low) | (red / stretch[known] > high)
            bad = np.where((bad == "") & short, "spectrum does not cover the bands", bad)
            reason = np.where(reason == "", bad, reason)
        return reason

    def _galaxies(self, frame: pd.DataFrame) -> pd.DataFrame:
        if not len(frame):
            return schema("galaxies", tuple(self.bandpasses)).empty_table().to_pandas()
        place = {name: row for row, name in enumerate(self.library.names)}
        sed = {f"{c}_sed": frame[f"{c}_sed"].map(place).fillna(-1).to_numpy(int) for c in COMPONENTS}
        lengths = frame["sed_val_disk"].map(len).to_numpy()
        red = max(bandpass.wave[-1] for bandpass in self.bandpasses.values()) / (1 + frame["redshift"].to_numpy())
        extended = (lengths > 0) & (red > (self.edges[-1] if self.edges else np.inf))
        frame = frame.rename(columns={"id": "galaxy_id"}).assign(**sed, sed_extended=extended)
        # a component without light may have no size
        for column in (name for name in frame if name.startswith("size_")):
            frame[column] = frame[column].fillna(0.0)
        photons = 0.0
        milky_way = Dust(frame["MW_av"].to_numpy(float), frame["MW_rv"].to_numpy(float))
        for component in COMPONENTS:
            own = "bulge" if component == "bulge" else "disk"
            magnorm = frame[f"{component}_magnorm"].to_numpy(float)
            lit = np.isfinite(magnorm)
            av, rv = (np.where(lit, frame[f"{own}_{name}"].to_numpy(float), 0.0) for name in ("av", "rv"))
            photons = photons + band_photons(
                magnorm,
                component_spectra(frame, component, self.library, self.edges),
                frame["redshift"].to_numpy(float),
                Dust(av, rv),
                milky_way,
                tuple(self.bandpasses.values()),
                "rest" if self.settings.dust == "physical" else "observed",
            )
        frame = frame.assign(
            **{
                f"{own}_{name}": frame[f"{own}_{name}"].fillna(value)
                for own in ("bulge", "disk")
                for name, value in (("av", 0.0), ("rv", 3.1))
            }
        )
        return self._with_fluxes(frame, photons * magnification(frame)[:, None])

    def _stars(self, frame: pd.DataFrame) -> pd.DataFrame:
        if not len(frame):
            return schema("stars", tuple(self.bandpasses)).empty_table().to_pandas()
        place = {name: row for row, name in enumerate(self.library.names)}
        spectra = LibrarySpectra(self.library, frame["sed"].map(place).to_numpy(int))
        milky_way = Dust(frame["MW_av"].to_numpy(float), frame["MW_rv"].to_numpy(float))
        none = np.zeros(len(frame))
        unit = band_photons(none, spectra, none, no_dust(len(frame)), milky_way, tuple(self.bandpasses.values()))
        magnorm = frame["magnorm"].to_numpy(float).copy()
        for k, (band, bandpass) in enumerate(self.bandpasses.items()):
            rows = np.isnan(magnorm) & (frame["ref_band"].to_numpy() == f"lsst_{band}")
            magnorm[rows] = frame["ref_mag"].to_numpy(float)[rows] + 2.5 * np.log10(
                njy(unit[0, rows, k], bandpass) / NJY_ZERO_POINT
            )
        if np.isnan(magnorm).any():
            band = frame.loc[np.isnan(magnorm), "ref_band"].iloc[0]
            raise UserError(
                f"stars of the source have their brightness in {band}, which is none of this survey's bands"
            )
        frame = frame.assign(magnorm=magnorm, sed=spectra.index)
        return self._with_fluxes(frame, unit * 10 ** (-0.4 * magnorm)[None, :, None])

    def _with_fluxes(self, frame: pd.DataFrame, photons: np.ndarray) -> pd.DataFrame:
        columns: dict[str, np.ndarray] = {}
        for k, (band, bandpass) in enumerate(self.bandpasses.items()):
            columns |= flux_columns(band, njy(photons[:, :, k], bandpass))
        return frame.assign(**columns)


@dataclass(frozen=True)
class Quarantine:
    """Makes the rows that were set aside: of each batch those that are bad by themselves, of each cell those that
    are at odds with others."""

    assemble: Assemble

    def __call__(self, index: int) -> pd.DataFrame:
        """Return the rows of a batch, or after all batches those of a cell."""
        rows = self.assemble.rows
        if index < len(rows.units):
            frame = rows.select(index)
            frame = frame.assign(reason=self.assemble.reasons(frame))
        else:
            frame = self.assemble.merged(index - len(rows.units))
        bad = frame[frame["reason"] != ""]
        return bad[["source", "row", "id", "reason"]]


def _selected(rows: TableProduct, unit: int, low: int, high: int) -> pd.DataFrame:
    """Return a batch's rows between two HEALPix cells of order 29; a batch that is not stored is made once."""
    if rows.has(unit):
        return rows.select(unit, None, (low, high))
    frame = _made(rows.make, unit)
    return frame[(frame["_healpix_29"] >= low) & (frame["_healpix_29"] < high)]


@lru_cache(maxsize=8)
def _made(make: Any, unit: int) -> pd.DataFrame:
    return make(unit)
