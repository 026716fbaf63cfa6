"""Ingestion of source catalogs: batches of rows, then the galaxies, stars and quarantined rows of HEALPix cells."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import pandas as pd

from romandask.ingest import instance_catalog, skycatalogs, table
from romandask.ingest.components import merge_components
from romandask.ingest.rows import COMPONENTS, Batch, Source
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
from romandask.stages.truth.scan import SPECTRA, RowsSummary, scan_rows
from romandask.storage.paths import AnyPath, access_errors_explained, resolve_below

LOST_FIRST = "the first component of this galaxy cannot be used"
"""Reason for the quarantine of components that lie in another HEALPix cell than the first one."""
BAD_FLUX = "flux is not a number"
"""Reason for the quarantine of an object without a finite flux in every band."""
_BATCH_BYTES = 600 << 20
"""Peak memory of reading one batch, bytes."""


def open_sources(settings: TruthSettings, data: AnyPath) -> tuple[Source, ...]:
    """Return the source catalogs that the settings name, after checking them.

    Parameters
    ----------
    settings : TruthSettings
        The `truth` section of the pipeline.
    data : path
        Folder that paths in the settings are relative to.

    Raises
    ------
    UserError
        If a file, column or key is missing or wrong; the message names it.
    """
    openers: dict[str, Callable[[AnyPath], Source]] = {
        "skycatalogs": skycatalogs.open_source,
        "instance_catalog": instance_catalog.open_source,
    }
    if settings.source in openers:
        path = resolve_below(data, str(settings.path))
        with access_errors_explained(path):
            return (openers[settings.source](path),)
    sources = []
    for kind, table_settings in (("galaxy", settings.galaxy_table), ("star", settings.star_table)):
        if table_settings is not None:
            path = resolve_below(data, table_settings.path)
            with access_errors_explained(path):
                sources.append(table.open_source(path, dict(table_settings.columns), kind))
    return tuple(sources)


def ingested_rows(sources: tuple[Source, ...]) -> TableProduct:
    """Return the lazy normal form of source catalogs (schema: catalogs/ingested.yaml), with one unit per batch."""
    pairs = tuple((number, batch) for number, source in enumerate(sources) for batch in source.batches())
    states = [source.state() for source in sources]
    names = [f"{number}-{batch.name}" if len(sources) > 1 else batch.name for number, batch in pairs]
    units = tuple(
        Unit(name=name, settings={"source": states[number], "start": batch.start, "stop": batch.stop})
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
    """Reads the rows of a batch, sorted by HEALPix cell; rows without a valid position come first, with cell -1."""

    sources: tuple[Source, ...]
    pairs: tuple[tuple[int, Batch], ...]
    """Index of the source, and the batch, of each unit."""

    def __call__(self, index: int) -> pd.DataFrame:
        number, batch = self.pairs[index]
        frame = self.sources[number].read(batch)
        valid = np.isfinite(frame["ra"]) & np.isfinite(frame["dec"]) & (frame["dec"].abs() <= 90)
        indexed = with_spatial_index(frame[valid])
        return pd.concat([frame[~valid].assign(_healpix_29=np.int64(-1)), indexed], ignore_index=True)


def sources_of(rows: TableProduct) -> tuple[Source, ...]:
    """Return the source catalogs of ingested rows."""
    assert isinstance(rows.make, _ReadBatch)
    return rows.make.sources


def edges_of(rows: TableProduct) -> tuple[float, ...]:
    """Return the rest-frame edges, nm, of the top-hat bins of ingested rows; empty if no row has a top-hat spectrum."""
    return next((source.edges for source in sources_of(rows) if source.edges), ())


def source_rows(rows: TableProduct) -> int:
    """Return the number of rows of the source catalogs."""
    counts = [source.count() for source in sources_of(rows)]
    return sum(count for count in counts if count is not None)


def summary_of(rows: TableProduct, order: int) -> RowsSummary:
    """Return what is known only from all ingested rows together, for HEALPix cells of the given order."""
    assert isinstance(rows.make, _ReadBatch)
    return scan_rows(rows, order, tuple(rows.make.sources[number].components for number, _ in rows.make.pairs))


@dataclass(frozen=True, kw_only=True)
class Assemble:
    """Makes the partitions of a truth catalog from ingested rows."""

    settings: TruthSettings
    region: Region
    bandpasses: dict[str, Bandpass]
    """Bandpasses of the survey, by band."""
    rows: TableProduct
    """Ingested rows, from `ingested_rows`."""
    edges: tuple[float, ...]
    """Rest-frame edges of the bins of top-hat spectra, nm."""
    library: SpectrumLibrary
    """Spectra that rows refer to by name."""
    unusable: dict[str, str]
    """Reason why a spectrum cannot be used, by its name."""
    cells: np.ndarray
    """HEALPix cells of the partitions, nested scheme, of order `settings.order`."""
    summary: RowsSummary
    """What is known only from all rows together."""
    kind: str
    """Kind of the objects of the catalog: "galaxy" or "star"."""

    def __call__(self, index: int) -> pd.DataFrame:
        """Return the rows of one partition (schema: catalogs/galaxies.yaml or catalogs/stars.yaml)."""
        merged = merge_components(self.rows_of(index))
        good = merged[(merged["reason"] == "") & (merged["kind"] == self.kind)]
        good = with_spatial_index(good[self.inside(good)])
        # a merged galaxy has the position of its first component, so it lies in the cell as all rows do
        made = self._galaxies(good) if self.kind == "galaxy" else self._stars(good)
        fluxes = made[[name for name in made.columns if name.startswith("flux_")]].to_numpy(float)
        return made[np.isfinite(fluxes).all(axis=1)]

    def inside(self, frame: pd.DataFrame) -> np.ndarray:
        """Return which rows lie in the region with its margin."""
        return np.asarray(self.region.contains(frame["ra"], frame["dec"], self.settings.margin))

    def rows_of(self, index: int) -> pd.DataFrame:
        """Return the rows of a cell before the components of each galaxy are merged, without those that are bad alone.

        All components of a galaxy are in the cell of its first row.
        """
        shift = 2 * (29 - self.settings.order)
        cell = int(self.cells[index])
        strays = self.summary.strays
        parts = []
        for unit in range(len(self.rows.units)):
            own = _selected(self.rows, unit, cell << shift, (cell + 1) << shift)
            moved = strays[strays["unit"] == unit]
            if len(moved):
                arriving = moved[moved["home"] == cell]
                others = [_selected(self.rows, unit, at, at + 1) for at in arriving["_healpix_29"].unique()]
                others = [part[part["row"].isin(arriving["row"])] for part in others]
                own = pd.concat([own[~own["row"].isin(moved["row"])], *others], ignore_index=True)
            if len(own):
                # in the order of the file, of which the first row gives the position of a galaxy
                parts.append(self.with_reasons(own, unit).sort_values("row"))
        if not parts:
            return self.rows.empty()
        frame = pd.concat(parts, ignore_index=True)
        frame = frame[frame["reason"] == ""]
        # a galaxy has the position of its first row, and lies in the cell of that
        first = frame.groupby(["kind", "id"])["_healpix_29"].transform("first").to_numpy()
        return frame.assign(reason=np.where(first >> shift == cell, "", LOST_FIRST).astype(object))

    def with_reasons(self, frame: pd.DataFrame, unit: int) -> pd.DataFrame:
        """Return rows of a unit with the reason why each cannot be used.

        Added to the faults of the row itself are an identifier that an earlier row has, and faults of its spectra.
        """
        reason = frame["reason"].to_numpy(object).copy()
        later = frame["row"].isin(self.summary.duplicates.get(unit, ())).to_numpy() & (reason == "")
        duplicate = np.where(frame["kind"] == "galaxy", "duplicate galaxy_id", "duplicate id")
        reason = np.where(later, duplicate, reason)
        blue = min(bandpass.wave[0] for bandpass in self.bandpasses.values())
        red = max(bandpass.wave[-1] for bandpass in self.bandpasses.values())
        library_index = self._library_index()
        stretch = 1 + frame["redshift"].fillna(0).to_numpy()
        for column in SPECTRA:
            names = frame[column]
            if column != "sed":
                names = names.where(np.isfinite(frame[column.replace("_sed", "_magnorm")]), "")
            bad = names.map(lambda name: self.unusable.get(name, "")).to_numpy(object)
            index = names.map(library_index).fillna(-1).to_numpy(int)
            known = index >= 0
            short = np.zeros(len(frame), bool)
            low, high = self.library.limits[index[known]].T if known.any() else (0, 0)
            short[known] = (blue / stretch[known] < low) | (red / stretch[known] > high)
            bad = np.where((bad == "") & short, "spectrum does not cover the bands", bad)
            reason = np.where(reason == "", bad, reason)
        return frame.assign(reason=reason)

    def _library_index(self) -> dict[str, int]:
        """Return the index of each spectrum of the library, by its name."""
        return {name: index for index, name in enumerate(self.library.names)}

    def _galaxies(self, frame: pd.DataFrame) -> pd.DataFrame:
        """Return good galaxies as rows of the truth catalog."""
        if not len(frame):
            return schema("galaxies", tuple(self.bandpasses)).empty_table().to_pandas()
        library_index = self._library_index()
        sed = {f"{c}_sed": frame[f"{c}_sed"].map(library_index).fillna(-1).to_numpy(int) for c in COMPONENTS}
        lengths = frame["sed_val_disk"].map(len).to_numpy()
        red = max(bandpass.wave[-1] for bandpass in self.bandpasses.values()) / (1 + frame["redshift"].to_numpy())
        extended = (lengths > 0) & (red > (self.edges[-1] if self.edges else np.inf))
        frame = frame.rename(columns={"id": "galaxy_id"}).assign(**sed, sed_extended=extended)
        # a component without light may have no size
        for column in [name for name in frame.columns if name.startswith("size_")]:
            frame[column] = frame[column].fillna(0.0)
        photons: np.ndarray | float = 0.0
        milky_way = Dust(frame["MW_av"].to_numpy(float), frame["MW_rv"].to_numpy(float))
        for component in COMPONENTS:
            # knots have the dust of the disk
            dust = "bulge" if component == "bulge" else "disk"
            magnorm = frame[f"{component}_magnorm"].to_numpy(float)
            lit = np.isfinite(magnorm)
            av, rv = (np.where(lit, frame[f"{dust}_{name}"].to_numpy(float), 0.0) for name in ("av", "rv"))
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
                f"{dust}_{name}": frame[f"{dust}_{name}"].fillna(value)
                for dust in ("bulge", "disk")
                for name, value in (("av", 0.0), ("rv", 3.1))
            }
        )
        return self._with_fluxes(frame, photons * magnification(frame)[:, None])

    def _stars(self, frame: pd.DataFrame) -> pd.DataFrame:
        """Return good stars as rows of the truth catalog.

        Raises
        ------
        UserError
            If a star has its brightness in a band that the survey does not have.
        """
        if not len(frame):
            return schema("stars", tuple(self.bandpasses)).empty_table().to_pandas()
        spectra = LibrarySpectra(self.library, frame["sed"].map(self._library_index()).to_numpy(int))
        milky_way = Dust(frame["MW_av"].to_numpy(float), frame["MW_rv"].to_numpy(float))
        zeros = np.zeros(len(frame))
        # photons of stars of magnorm 0
        unit = band_photons(zeros, spectra, zeros, no_dust(len(frame)), milky_way, tuple(self.bandpasses.values()))
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
        """Return rows with the flux columns of all bands; `photons` has the layout of `band_photons`."""
        columns: dict[str, np.ndarray] = {}
        for k, (band, bandpass) in enumerate(self.bandpasses.items()):
            columns |= flux_columns(band, njy(photons[:, :, k], bandpass))
        return frame.assign(**columns)


@dataclass(frozen=True)
class Quarantine:
    """Makes the quarantined rows.

    The first units are the batches, with the rows that are bad in themselves or have the identifier of an earlier row;
    the others are the cells, with components that contradict one another and objects without finite fluxes.
    """

    assemble: Assemble
    """Finds the reasons."""
    galaxies: TableProduct
    """Galaxies of the truth; what they lack has no finite flux."""
    stars: TableProduct
    """Stars of the truth."""

    def __call__(self, index: int) -> pd.DataFrame:
        """Return the quarantined rows of a unit (schema: catalogs/quarantine.yaml)."""
        rows = self.assemble.rows
        if index < len(rows.units):
            bad = self.assemble.with_reasons(rows.select(index), index)
        else:
            bad = self._of_cell(index - len(rows.units))
        return bad.loc[bad["reason"] != "", ["source", "row", "id", "reason"]]

    def _of_cell(self, index: int) -> pd.DataFrame:
        """Return the rows of a cell that contradict other rows, and those of objects without finite fluxes."""
        rows = self.assemble.rows_of(index)
        merged = merge_components(rows)
        bad = merged[merged["reason"] != ""]
        good = merged[merged["reason"] == ""]
        good = good[self.assemble.inside(good)]
        parts = [bad]
        for kind, product, name in (("galaxy", self.galaxies, "galaxy_id"), ("star", self.stars, "id")):
            ids = good.loc[good["kind"] == kind, "id"]
            lost = ids[~ids.isin(product.select(index, [name])[name])]
            # a merged galaxy stands for several rows
            of_lost = rows[(rows["kind"] == kind) & rows["id"].isin(lost)].merge(
                bad[["source", "row"]], how="left", indicator=True
            )
            parts.append(of_lost[of_lost["_merge"] == "left_only"].assign(reason=BAD_FLUX))
        return pd.concat([part for part in parts if len(part)] or parts[:1], ignore_index=True)


def _selected(rows: TableProduct, unit: int, low: int, high: int) -> pd.DataFrame:
    """Return the rows of a batch with low <= _healpix_29 < high; a batch that is not stored is made and cached."""
    if rows.has(unit):
        return rows.select(unit, None, (low, high))
    frame = _cached_batch(rows.make, unit)
    return frame[(frame["_healpix_29"] >= low) & (frame["_healpix_29"] < high)]


@lru_cache(maxsize=8)
def _cached_batch(make: Callable[[int], pd.DataFrame], unit: int) -> pd.DataFrame:
    return make(unit)
