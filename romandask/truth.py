"""The true universe: galaxies and stars as HATS catalogs, from the generator or from skyCatalogs files."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import zarr

from romandask.formats import skycatalogs
from romandask.formats import spectra as spectra_files
from romandask.kernels import universe
from romandask.kernels.bandpasses import rubin_bandpass
from romandask.kernels.photometry import Spectra, njy
from romandask.kernels.scene import COMPONENTS, Truth, galaxy_photons, star_photons
from romandask.model.config import TruthSettings
from romandask.model.sky import Region, cell_area, cells_in_cone
from romandask.model.spectra import Bandpass, LibrarySpectra, SpectrumLibrary, TophatSpectra
from romandask.runtime.hats import with_spatial_index
from romandask.runtime.products import TableProduct, Unit
from romandask.runtime.schemas import schema
from romandask.runtime.store import Store, write_coordinate

WIDE = 1e7
"""Square arcminutes above which the cells of a region are not listed one by one."""
_NO_BINS = np.zeros(0, np.float32)


@dataclass(frozen=True)
class TruthCatalogs:
    """The truth catalogs and the spectra that they refer to."""

    galaxies: TableProduct
    stars: TableProduct
    quarantine: TableProduct
    library: SpectrumLibrary
    edges: tuple[float, ...]
    """Edges of top-hat bins, nm; empty where no galaxy has a top-hat spectrum."""
    internal_frame: str
    source_rows: int = 0
    """Rows of the source files that the region touches."""

    def near(self, ra: float, dec: float, radius: float) -> Truth:
        """Return the rows of the partitions that touch a cone (degrees), with their spectra."""
        pixels = set(map(int, cells_in_cone(ra, dec, radius, self.galaxies.order or 0)))
        tables = []
        for product in (self.galaxies, self.stars):
            chosen = [index for index, pixel in enumerate(product.pixels or ()) if pixel in pixels]
            parts = [product.load(index) for index in chosen]
            empty = product.schema.empty_table().to_pandas()
            filled = [part for part in parts if len(part)]
            tables.append(pd.concat(filled, ignore_index=True) if filled else empty)
        return bind(tables[0], tables[1], self.library, self.edges, self.internal_frame)

    def inputs(self, ra: float, dec: float, radius: float) -> tuple[tuple[str, str], ...]:
        """Return the units that `near` reads."""
        pixels = set(map(int, cells_in_cone(ra, dec, radius, self.galaxies.order or 0)))
        return tuple(
            (product.stage, unit.name)
            for product in (self.galaxies, self.stars)
            for unit, pixel in zip(product.units, product.pixels or (), strict=True)
            if pixel in pixels
        )


def truth(
    settings: TruthSettings, data: Path, region: Region, bandpasses: dict[str, Bandpass], seed: int
) -> TruthCatalogs:
    """Return the lazy truth catalogs over a region.

    Parameters
    ----------
    data : folder that the settings' paths are below
    bandpasses : by band; the catalogs hold the flux of every object in each

    Raises
    ------
    UserError
        If a source file is missing or not what it should be.
    """
    frame = "rest" if settings.dust == "physical" else "observed"
    if settings.source == "generate":
        library = spectra_files.templates(universe.GALAXY_TEMPLATES, universe.STAR_TEMPERATURES)
        cells = region.cells(settings.order, settings.margin)
        common = (settings, region, bandpasses, seed, library, cells)
        makers: dict[str, Callable[[int], pd.DataFrame]] = {
            "galaxies": _GenerateGalaxies(*common), "stars": _GenerateStars(*common), "quarantine": _Nothing()
        }  # fmt: skip
        source_state: Any = "generate"
        edges: tuple[float, ...] = ()
        files: list[str] = []
        rows = 0
    else:
        source = skycatalogs.open_source(data / str(settings.path))
        near = skycatalogs.around(region.cells(skycatalogs.ORDER, settings.margin).tolist())
        parents = [cell for cell in near if cell in source.galaxies or cell in source.stars]
        names = skycatalogs.sed_names(source, parents)
        library, unusable = spectra_files.read_folder(data / (settings.seds or "seds"), names)
        depth = 2 * (settings.order - skycatalogs.ORDER)
        children = [np.arange(cell << depth, (cell + 1) << depth) for cell in skycatalogs.around(parents)]
        cells = np.concatenate(children) if children else np.empty(0, np.int64)
        if region.area < WIDE:
            cells = np.intersect1d(cells, region.cells(settings.order, settings.margin))
        options = (settings, region, bandpasses, source, library, unusable, cells)
        makers = {
            "galaxies": _ReadGalaxies(*options), "stars": _ReadStars(*options),
            "quarantine": _ReadBad(source, unusable, tuple(parents)),
        }  # fmt: skip
        source_state = {"files": source.files(), "seds": list(library.names)}
        edges = source.edges
        rows = skycatalogs.count_rows(source, parents)
        files = [
            f"{kind}_{cell}" for cell in parents for kind in ("galaxy", "pointsource") if cell in _kind(source, kind)
        ]
    bands = tuple(bandpasses)
    state = {
        "settings": settings.model_dump(),
        "seed": seed,
        "source": source_state,
        "bands": bands,
        "region": vars(region),
    }
    units = tuple(Unit(f"{settings.order}-{cell}", {**state, "cell": int(cell)}) for cell in cells)
    per_cell = int(cell_area(settings.order) * settings.galaxies * 1500) + (200 << 20)

    def table(kind: str) -> TableProduct:
        return TableProduct(
            f"truth/{kind}", units, makers[kind], schema(kind, bands), tuple(map(int, cells)), settings.order, per_cell
        )

    quarantine = TableProduct(
        "truth/quarantine",
        tuple(Unit(name, state) for name in files),
        makers["quarantine"],
        schema("quarantine"),
    )
    return TruthCatalogs(table("galaxies"), table("stars"), quarantine, library, edges, frame, rows)


def write_spectra(catalogs: TruthCatalogs, store: Store) -> None:
    """Write truth/seds.zarr: the library that the catalogs' `*_sed` columns index, and the edges of top-hat bins."""
    group = zarr.open_group(store.images("truth/seds"), mode="a")
    library = catalogs.library
    write_coordinate(group, "wave", library.wave, ("wave",), {"units": "nm", "long_name": "rest-frame wavelength"})
    text = {"long_name": "photon density over that at 500 nm"}
    write_coordinate(group, "photons", library.photons, ("sed", "wave"), text)
    if library.names:
        write_coordinate(group, "sed", np.array(library.names, object), ("sed",), {"long_name": "name"})
    if catalogs.edges:
        text = {"units": "nm", "long_name": "rest-frame edges of the bins of sed_val_*"}
        write_coordinate(group, "tophat_edges", np.array(catalogs.edges), ("edge",), text)


def bind(
    galaxies: pd.DataFrame, stars: pd.DataFrame, library: SpectrumLibrary, edges: tuple[float, ...], frame: str
) -> Truth:
    """Return rows together with the spectra they refer to."""
    return Truth(
        galaxies,
        stars,
        {component: _spectra(galaxies, component, library, edges) for component in COMPONENTS},
        LibrarySpectra(library, stars["sed"].to_numpy(int)),
        frame,
    )


def _spectra(galaxies: pd.DataFrame, component: str, library: SpectrumLibrary, edges: tuple[float, ...]) -> Spectra:
    index = galaxies[f"{component}_sed"].to_numpy(int)
    if len(index) and (index < 0).all():
        return TophatSpectra(np.stack(galaxies[f"sed_val_{component}"].to_numpy()).astype(float), np.array(edges))
    return LibrarySpectra(library, index)


def _with_fluxes(truth: Truth, kind: str, bandpasses: dict[str, Bandpass]) -> pd.DataFrame:
    if kind == "stars":
        fluxes = {band: star_photons(truth, bandpass) for band, bandpass in bandpasses.items()}
        frame = truth.stars
    else:
        fluxes = {
            band: np.sum([galaxy_photons(truth, bandpass, component) for component in COMPONENTS], axis=0)
            for band, bandpass in bandpasses.items()
        }
        frame = truth.galaxies
    columns = {f"flux_{band}": njy(value.sum(axis=1), bandpasses[band]) for band, value in fluxes.items()}
    return with_spatial_index(frame.assign(**columns))


@dataclass(frozen=True)
class _Nothing:
    def __call__(self, index: int) -> pd.DataFrame:
        raise IndexError("the generator sets no rows aside")


@dataclass(frozen=True)
class _Generate:
    settings: TruthSettings
    region: Region
    bandpasses: dict[str, Bandpass]
    seed: int
    library: SpectrumLibrary
    cells: np.ndarray

    def _rows(self, index: int, make: Callable[..., pd.DataFrame], density: float) -> pd.DataFrame:
        depth = 2 * (universe.CELL_ORDER - self.settings.order)
        first = int(self.cells[index]) << depth
        wanted = self.region.cells(universe.CELL_ORDER, self.settings.margin)
        wanted = wanted[(wanted >= first) & (wanted < first + (1 << depth))]
        r_band = rubin_bandpass("r", 2, 1.0)
        parts = [make(int(cell), self.seed, density, self.library, r_band) for cell in wanted]
        parts = [part for part in parts if len(part)] or [make(first, self.seed, 0.0, self.library, r_band)]
        frame = pd.concat(parts, ignore_index=True)
        return frame[self.region.contains(frame["ra"], frame["dec"], self.settings.margin)].reset_index(drop=True)


class _GenerateGalaxies(_Generate):
    def __call__(self, index: int) -> pd.DataFrame:
        frame = self._rows(index, universe.galaxies, self.settings.galaxies)
        frame = frame.assign(**{f"sed_val_{component}": [_NO_BINS] * len(frame) for component in COMPONENTS})
        frame_of_dust = "rest" if self.settings.dust == "physical" else "observed"
        none = pd.DataFrame({"sed": np.empty(0, int)})
        return _with_fluxes(bind(frame, none, self.library, (), frame_of_dust), "galaxies", self.bandpasses)


class _GenerateStars(_Generate):
    def __call__(self, index: int) -> pd.DataFrame:
        frame = self._rows(index, universe.stars, self.settings.stars)
        none = pd.DataFrame({f"{component}_sed": np.empty(0, int) for component in COMPONENTS})
        return _with_fluxes(bind(none, frame, self.library, (), "rest"), "stars", self.bandpasses)


@dataclass(frozen=True)
class _Read:
    settings: TruthSettings
    region: Region
    bandpasses: dict[str, Bandpass]
    source: skycatalogs.Source
    library: SpectrumLibrary
    unusable: dict[str, str]
    cells: np.ndarray

    def _inside(self, frame: pd.DataFrame, index: int) -> pd.DataFrame:
        """Good rows of the partition and of the region."""
        good = frame[frame["reason"] == ""]
        good = good[self.region.contains(good["ra"], good["dec"], self.settings.margin)]
        located = with_spatial_index(good)
        depth = 2 * (29 - self.settings.order)
        mine = (located["_healpix_29"].to_numpy() >> depth) == int(self.cells[index])
        return located[mine].reset_index(drop=True)

    def _files(self, index: int, files: dict[int, Path]) -> list[int]:
        """The files that may hold rows of the partition: its own and those around."""
        own = int(self.cells[index]) >> (2 * (self.settings.order - skycatalogs.ORDER))
        return [cell for cell in skycatalogs.around([own]) if cell in files]


class _ReadGalaxies(_Read):
    def __call__(self, index: int) -> pd.DataFrame:
        files = self._files(index, self.source.galaxies)
        parts = [self._inside(skycatalogs.read_galaxies(self.source, cell), index) for cell in files]
        parts = [part for part in parts if len(part)]
        if not parts:
            return schema("galaxies", tuple(self.bandpasses)).empty_table().to_pandas()
        frame = pd.concat(parts, ignore_index=True)
        frame["n_knots"] = frame["n_knots"].fillna(0)
        # NaN means, as inf does, that the component has no light
        for component in COMPONENTS:
            frame[f"{component}_magnorm"] = frame[f"{component}_magnorm"].fillna(np.inf)
            frame[f"{component}_sed"] = -1
        # cosmoDC2's spectra hold the galaxies' own dust
        frame = frame.assign(bulge_av=0.0, bulge_rv=3.1, disk_av=0.0, disk_rv=3.1)
        none = pd.DataFrame({"sed": np.empty(0, int)})
        return _with_fluxes(bind(frame, none, self.library, self.source.edges, "rest"), "galaxies", self.bandpasses)


class _ReadStars(_Read):
    def __call__(self, index: int) -> pd.DataFrame:
        files = self._files(index, self.source.stars)
        parts = [self._inside(skycatalogs.read_stars(self.source, cell, self.unusable), index) for cell in files]
        parts = [part for part in parts if len(part)]
        if not parts:
            return schema("stars", tuple(self.bandpasses)).empty_table().to_pandas()
        frame = pd.concat(parts, ignore_index=True)
        place = {name: row for row, name in enumerate(self.library.names)}
        frame["sed"] = frame["sed_filepath"].map(place).astype(int)
        none = pd.DataFrame({f"{component}_sed": np.empty(0, int) for component in COMPONENTS})
        return _with_fluxes(bind(none, frame, self.library, (), "rest"), "stars", self.bandpasses)


@dataclass(frozen=True)
class _ReadBad:
    source: skycatalogs.Source
    unusable: dict[str, str]
    parents: tuple[int, ...]

    def __call__(self, index: int) -> pd.DataFrame:
        pairs = [
            (cell, kind)
            for cell in self.parents
            for kind in ("galaxy", "pointsource")
            if cell in _kind(self.source, kind)
        ]
        cell, kind = pairs[index]
        if kind == "galaxy":
            frame, name = skycatalogs.read_galaxies(self.source, cell), "galaxy_id"
        else:
            frame, name = skycatalogs.read_stars(self.source, cell, self.unusable), "id"
        bad = frame[frame["reason"] != ""]
        return pd.DataFrame(
            {"source": _kind(self.source, kind)[cell].name, "row": bad.index, "id": bad[name], "reason": bad["reason"]}
        )


def _kind(source: skycatalogs.Source, kind: str) -> dict[int, Path]:
    return source.galaxies if kind == "galaxy" else source.stars
