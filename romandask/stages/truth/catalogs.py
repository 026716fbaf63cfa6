"""The true universe: galaxies and stars as HATS catalogs, generated or from source catalogs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from scipy.spatial import cKDTree

from romandask.ingest import spectra as spectra_files
from romandask.kernels.rendering.scene import Truth, bind
from romandask.kernels.universe.dust import Dust
from romandask.model.errors import UserError
from romandask.model.settings import TruthSettings
from romandask.model.sky import Region, cell_area, cells_in_cone, unit_vectors
from romandask.model.spectra import Bandpass, SpectrumLibrary
from romandask.products.images import ImageProduct
from romandask.products.schemas import schema
from romandask.products.tables import TableProduct
from romandask.products.units import Unit
from romandask.stages.stage import Stage, SurveyContext
from romandask.stages.truth.generated import GenerateGalaxies, GenerateStars, NothingSetAside, matter, templates
from romandask.stages.truth.ingested import Assemble, Quarantine, edges_of, ingested_rows, open_sources, scan_rows
from romandask.storage.arrays import write_coordinate, write_group
from romandask.storage.manifest import digest
from romandask.storage.paths import AnyPath, files_below, resolve_below
from romandask.storage.store import Store

WIDE = 1e7
"""Square arcminutes above which the cells of a region are not listed one by one."""
NEAR_ORDER = 11
"""HEALPix order of the cells, 1.7 arcmin wide, that decide which rows are near."""
BYTES_A_ROW = 2800
"""Peak memory of a galaxy while a partition is made: its row, its random numbers and its photons."""
SOURCE_DENSITY = 600.0
"""Galaxies a square arcminute that partitions of source catalogs are sized for."""


@dataclass(frozen=True)
class TruthCatalogs:
    """The truth catalogs and the spectra that they refer to."""

    galaxies: TableProduct
    stars: TableProduct
    quarantine: TableProduct
    structure: ImageProduct | None
    """Matter of a generated universe."""
    ingested: TableProduct | None
    """Rows of source catalogs."""
    library: SpectrumLibrary
    edges: tuple[float, ...]
    """Edges of top-hat bins, nm; empty where no galaxy has a top-hat spectrum."""
    internal_frame: str
    """"rest" or "observed": where the galaxies' own dust acts."""

    def near(self, ra: float, dec: float, radius: float, stars_radius: float) -> Truth:
        """Return the rows around cones (degrees), with their spectra: no more of a partition than the cones need."""
        galaxies = _rows_near(self.galaxies, ra, dec, radius)
        stars = _rows_near(self.stars, ra, dec, stars_radius)
        return bind(galaxies, stars, self.library, self.edges, self.internal_frame)

    def brief(self, ra: float, dec: float, radius: float, bands: Sequence[str]) -> pd.DataFrame:
        """Return id, star, ra, dec, redshift and flux_<band> (nJy) of all objects around a cone (degrees)."""
        fluxes = [f"flux_{band}" for band in bands]
        galaxies = _rows_near(self.galaxies, ra, dec, radius, ["galaxy_id", "ra", "dec", "redshift", *fluxes])
        stars = _rows_near(self.stars, ra, dec, radius, ["id", "ra", "dec", *fluxes])
        galaxies = galaxies.rename(columns={"galaxy_id": "id"}).assign(star=False)
        both = [galaxies, stars.assign(star=True, redshift=0.0)]
        found = pd.concat([part for part in both if len(part)] or both, ignore_index=True)
        return found[["id", "star", "ra", "dec", "redshift", *fluxes]]

    def milky_way(self, at: np.ndarray, ra: float, dec: float, radius: float) -> Dust:
        """Return the Milky Way's dust at some places, (n, 3) unit vectors: that of the nearest galaxy around a cone.

        Of a cone without galaxies nothing is known of it: NaN.
        """
        rows = _rows_near(self.galaxies, ra, dec, radius, ["ra", "dec", "MW_av", "MW_rv"])
        if not len(rows):
            return Dust(np.full(len(at), np.nan), np.full(len(at), 3.1))
        _, near = cKDTree(unit_vectors(rows["ra"].to_numpy(), rows["dec"].to_numpy())).query(at)
        return Dust(rows["MW_av"].to_numpy(float)[near], rows["MW_rv"].to_numpy(float)[near])

    def inputs(self, ra: float, dec: float, radius: float, stars_radius: float) -> tuple[tuple[str, str], ...]:
        """Return the units that `near` reads."""
        return tuple(
            (product.stage, product.names[index])
            for product, reach in ((self.galaxies, radius), (self.stars, stars_radius))
            for index in product.touching(cells_in_cone(ra, dec, reach, product.order or 0))
        )


def _rows_near(
    product: TableProduct, ra: float, dec: float, radius: float, wanted: list[str] | None = None
) -> pd.DataFrame:
    """Return the rows of the cells that touch a cone, sorted by their place: of columns all but those of fluxes."""
    order = max(product.order or 0, NEAR_ORDER)
    columns = wanted or [name for name in product.schema.names if not name.startswith(("flux_", "dust_", "lsst_flux_"))]
    return product.rows_in(cells_in_cone(ra, dec, radius, order), order, columns)


def truth(
    settings: TruthSettings,
    data: AnyPath,
    region: Region,
    bandpasses: dict[str, Bandpass],
    seed: int,
    store: Store | None = None,
    rows: TableProduct | None = None,
) -> TruthCatalogs:
    """Return the lazy truth catalogs over a region.

    Parameters
    ----------
    data : folder that the settings' paths are below
    bandpasses : by band; the catalogs hold the flux of every object in each
    store : where units that are there are read from
    rows : the source catalogs' rows (stages.truth.ingested); opened here where they are not given

    Raises
    ------
    UserError
        If a source file is missing or not what it should be.
    """
    if settings.source == "generate":
        return _generated(settings, data, region, bandpasses, seed, store)
    if rows is None:
        rows = _kept(ingested_rows(open_sources(settings, data)), store)
    return _from_sources(settings, data, region, bandpasses, store, rows)


def _generated(
    settings: TruthSettings,
    data: AnyPath,
    region: Region,
    bandpasses: dict[str, Bandpass],
    seed: int,
    store: Store | None,
) -> TruthCatalogs:
    spectra = templates(resolve_below(data, settings.star_seds) if settings.star_seds else None)
    cells = region.cells(settings.order, settings.margin)
    field = _kept(matter(settings, region, seed), store)
    common = (settings, region, bandpasses, seed, spectra, cells)
    shared = {
        "seed": seed,
        "bands": tuple(bandpasses),
        "region": vars(region),
        "spectra": digest(spectra.library.photons),
    }
    table = _tables(settings, cells, tuple(bandpasses), settings.galaxies)
    apart = ("stars", "star_seds", "order"), ("galaxies", "nside", "shear", "dust", "order", "star_seds")
    state = [shared | {"settings": settings.model_dump(exclude=set(names))} for names in apart]
    return TruthCatalogs(
        _kept(table("galaxies", GenerateGalaxies(*common, field), state[0], ((field.stage, "all"),)), store),
        _kept(table("stars", GenerateStars(*common), state[1], ()), store),
        _kept(
            TableProduct(stage="truth/quarantine", units=(), make=NothingSetAside(), schema=schema("quarantine")), store
        ),
        field,
        None,
        spectra.library,
        (),
        _frame(settings),
    )


def _from_sources(
    settings: TruthSettings,
    data: AnyPath,
    region: Region,
    bandpasses: dict[str, Bandpass],
    store: Store | None,
    rows: TableProduct,
) -> TruthCatalogs:
    found = scan_rows(rows, settings.order)
    folder = resolve_below(data, settings.seds or "seds")
    library, unusable = spectra_files.read_folder(folder, list(found.spectra))
    edges = edges_of(rows)
    # components of a galaxy that lie apart across an edge are each looked at where they are
    cells = found.cells
    if region.area < WIDE:
        cells = np.intersect1d(cells, region.cells(settings.order, settings.margin))
    makers = {
        kind: Assemble(settings, region, bandpasses, rows, edges, library, unusable, cells, kind)
        for kind in ("galaxy", "star")
    }
    state = {
        "settings": settings.model_dump(),
        "bands": tuple(bandpasses),
        "region": vars(region),
        "spectra": digest(library.photons),
        "unusable": unusable,
    }
    inputs = tuple((rows.stage, unit.name) for unit in rows.units)
    table = _tables(settings, cells, tuple(bandpasses), SOURCE_DENSITY)
    galaxies = _kept(table("galaxies", makers["galaxy"], state, inputs), store)
    per_batch = [Unit(unit.name, state, ((rows.stage, unit.name),)) for unit in rows.units]
    per_cell = [Unit(f"cell-{unit.name}", state, inputs) for unit in galaxies.units]
    quarantine = TableProduct(
        stage="truth/quarantine",
        units=(*per_batch, *per_cell),
        make=Quarantine(makers["galaxy"]),
        schema=schema("quarantine"),
        bytes_per_unit=max(rows.bytes_per_unit, galaxies.bytes_per_unit),
    )
    stars = _kept(table("stars", makers["star"], state, inputs), store)
    return TruthCatalogs(galaxies, stars, _kept(quarantine, store), None, rows, library, edges, _frame(settings))


def _frame(settings: TruthSettings) -> str:
    return "rest" if settings.dust == "physical" else "observed"


def _kept(product: Any, store: Store | None) -> Any:
    return product if store is None else product.stored(store)


def _tables(
    settings: TruthSettings, cells: np.ndarray, bands: tuple[str, ...], density: float
) -> Callable[..., TableProduct]:
    """Return a function that makes the product of one kind of object over the cells."""
    rows = int(cell_area(settings.order) * density * BYTES_A_ROW)
    # of few rows the spectra and dust are most
    per_cell = max(rows + (150 << 20), 220 << 20)

    def table(kind: str, make: Callable[[int], pd.DataFrame], state: Any, inputs: tuple) -> TableProduct:
        units = tuple(Unit(f"{settings.order}-{cell}", {**state, "cell": int(cell)}, inputs) for cell in cells)
        pixels = tuple(map(int, cells))
        seconds = cell_area(settings.order) * density * 1.1e-5
        return TableProduct(
            stage=f"truth/{kind}",
            units=units,
            make=make,
            schema=schema(kind, bands),
            pixels=pixels,
            order=settings.order,
            bytes_per_unit=per_cell,
            seconds_per_unit=seconds,
        )

    return table


def truth_of(context: SurveyContext) -> TruthCatalogs:
    """Return the truth catalogs of a survey."""
    settings = context.pipeline
    rows = None if settings.truth.source == "generate" else context.output("truth/ingested")
    return truth(settings.truth, context.data, context.region, context.bandpasses, settings.seed, context.store, rows)


def _structure(context: SurveyContext, survey: str) -> ImageProduct:
    structure = context.once(truth_of).structure
    if structure is None:
        raise UserError("this survey has no matter field: its truth is read from source catalogs")
    return structure


def _write_spectra(context: SurveyContext, store: Store) -> tuple[str, list[AnyPath]]:
    write_spectra(context.once(truth_of), store)
    return "truth/seds", files_below(store.images("truth/seds"))


def _generated_truth(context: SurveyContext, survey: str) -> bool:
    return context.pipeline.truth.source == "generate"


STRUCTURE = Stage(
    name="truth/structure",
    build=_structure,
    exists=_generated_truth,
    unit="survey",
    summary="Matter shells of the generated universe on the sky, with their convergence and shear.",
    shrink_with="lower truth.nside",
)
INGESTED = Stage(
    name="truth/ingested",
    build=lambda context, _: ingested_rows(open_sources(context.pipeline.truth, context.data)),
    exists=lambda context, survey: not _generated_truth(context, survey),
    unit="batch of rows of a source catalog",
    summary="Rows of source catalogs in one normal form, bad rows marked with the reason.",
    tables={"ingested": "truth/ingested/"},
)
GALAXIES = Stage(
    name="truth/galaxies",
    build=lambda context, _: context.once(truth_of).galaxies,
    reads=("truth/structure", "truth/ingested"),
    units_known_after=("truth/ingested",),
    unit="HEALPix cell",
    summary="True galaxies, generated or from source catalogs: bulge, disk, knots, lensing, dust, spectra, fluxes in "
    "all bands.",
    sky=("ra", "dec"),
    shrink_with="raise truth.order",
    finish=_write_spectra,
    tables={"galaxies": "truth/galaxies/"},
)
STARS = Stage(
    name="truth/stars",
    build=lambda context, _: context.once(truth_of).stars,
    reads=("truth/ingested",),
    units_known_after=("truth/ingested",),
    unit="HEALPix cell",
    summary="True stars: a Galactic model, or source catalogs.",
    sky=("ra", "dec"),
    shrink_with="raise truth.order",
    tables={"stars": "truth/stars/"},
)
QUARANTINE = Stage(
    name="truth/quarantine",
    build=lambda context, _: context.once(truth_of).quarantine,
    reads=("truth/ingested",),
    units_known_after=("truth/ingested",),
    unit="batch, then HEALPix cell",
    summary="Rows of source catalogs that cannot be used, each with the reason.",
    shrink_with="raise truth.order",
    tables={"quarantine": "truth/quarantine/"},
)


def write_spectra(catalogs: TruthCatalogs, store: Store) -> None:
    """Write truth/seds.zarr: the library that the catalogs' `*_sed` columns index, and the edges of top-hat bins."""
    group = write_group(store.images("truth/seds"), "a")
    library = catalogs.library
    write_coordinate(group, "wave", library.wave, ("wave",), {"units": "nm", "long_name": "rest-frame wavelength"})
    text = {"long_name": "photon density over that at 500 nm"}
    write_coordinate(group, "photons", library.photons, ("sed", "wave"), text)
    if library.names:
        write_coordinate(group, "sed", np.array(library.names, object), ("sed",), {"long_name": "name"})
    if catalogs.edges:
        text = {"units": "nm", "long_name": "rest-frame edges of the bins of sed_val_*"}
        write_coordinate(group, "tophat_edges", np.array(catalogs.edges), ("edge",), text)
