"""Construction of the truth catalogs: HATS catalogs of galaxies and stars, generated or from source catalogs."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np
import pandas as pd

from romandask.ingest import spectra as spectra_files
from romandask.model.errors import UserError
from romandask.model.settings import TruthSettings
from romandask.model.sky import Region, cell_area
from romandask.model.spectra import Bandpass
from romandask.products.images import ImageProduct
from romandask.products.schemas import schema
from romandask.products.tables import TableProduct
from romandask.products.units import Unit
from romandask.stages.stage import Stage, SurveyContext
from romandask.stages.truth.generated import GenerateGalaxies, GenerateStars, NoQuarantine, matter, templates
from romandask.stages.truth.ingested import Assemble, Quarantine, edges_of, ingested_rows, open_sources, summary_of
from romandask.stages.truth.truth_catalogs import TruthCatalogs
from romandask.storage.arrays import write_coordinate, write_group
from romandask.storage.manifest import digest
from romandask.storage.paths import AnyPath, files_below, resolve_below
from romandask.storage.store import Store

MAX_LISTED_AREA = 1e7
"""Area of a region, arcmin^2, from which on its cells are not listed one by one."""
BYTES_PER_ROW = 2800
"""Peak memory per galaxy while a partition is made, for its row, its random numbers and its photons, bytes."""
SOURCE_DENSITY = 600.0
"""Density of galaxies, 1/arcmin^2, that partitions of source catalogs are planned for."""
Inputs = tuple[tuple[str, str], ...]
"""(stage, unit) of the units that a unit reads."""
SomeProduct = TypeVar("SomeProduct", TableProduct, ImageProduct)


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
    settings : TruthSettings
        The `truth` section of the pipeline.
    data : path
        Folder that paths in the settings are relative to.
    region : Region
        Region of the survey.
    bandpasses : dict of str to Bandpass
        Bandpasses by band; the catalogs have the flux of every object in each of them.
    seed : int
        Seed of the survey.
    store : Store, optional
        Store that stored units are read from.
    rows : TableProduct, optional
        Ingested rows, from `stages.truth.ingested.ingested_rows`; by default the source catalogs are opened here.

    Raises
    ------
    UserError
        If a source file is missing or invalid.
    """
    if settings.source == "generate":
        return _generated(settings, data, region, bandpasses, seed, store)
    if rows is None:
        rows = _with_store(ingested_rows(open_sources(settings, data)), store)
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
    field = _with_store(matter(settings, region, seed), store)
    galaxy_maker = GenerateGalaxies(
        settings=settings, region=region, bandpasses=bandpasses, seed=seed, spectra=spectra, cells=cells, matter=field
    )
    star_maker = GenerateStars(
        settings=settings, region=region, bandpasses=bandpasses, seed=seed, spectra=spectra, cells=cells
    )
    shared = {
        "seed": seed,
        "bands": tuple(bandpasses),
        "region": vars(region),
        "spectra": digest(spectra.library.photons),
    }
    # settings on which the catalog does not depend
    without_effect = {
        "galaxies": {"stars", "star_seds", "order"},
        "stars": {"galaxies", "nside", "shear", "dust", "order", "star_seds"},
    }
    unit_settings = {
        kind: shared | {"settings": settings.model_dump(exclude=names)} for kind, names in without_effect.items()
    }
    catalog = _catalog_factory(settings, cells, tuple(bandpasses), settings.galaxies)
    galaxies = catalog("galaxies", galaxy_maker, unit_settings["galaxies"], ((field.stage, "all"),))
    quarantine = TableProduct(stage="truth/quarantine", units=(), make=NoQuarantine(), schema=schema("quarantine"))
    return TruthCatalogs(
        galaxies=_with_store(galaxies, store),
        stars=_with_store(catalog("stars", star_maker, unit_settings["stars"], ()), store),
        quarantine=_with_store(quarantine, store),
        structure=field,
        ingested=None,
        library=spectra.library,
        edges=(),
        internal_frame=_internal_frame(settings),
    )


def _from_sources(
    settings: TruthSettings,
    data: AnyPath,
    region: Region,
    bandpasses: dict[str, Bandpass],
    store: Store | None,
    rows: TableProduct,
) -> TruthCatalogs:
    summary = summary_of(rows, settings.order)
    folder = resolve_below(data, settings.seds or "seds")
    library, unusable = spectra_files.read_folder(folder, list(summary.spectra))
    edges = edges_of(rows)
    cells = summary.cells
    if region.area < MAX_LISTED_AREA:
        cells = np.intersect1d(cells, region.cells(settings.order, settings.margin))
    makers = {
        kind: Assemble(
            settings=settings,
            region=region,
            bandpasses=bandpasses,
            rows=rows,
            edges=edges,
            library=library,
            unusable=unusable,
            cells=cells,
            summary=summary,
            kind=kind,
        )
        for kind in ("galaxy", "star")
    }
    unit_settings = {
        "settings": settings.model_dump(),
        "bands": tuple(bandpasses),
        "region": vars(region),
        "spectra": digest(library.photons),
        "unusable": unusable,
    }
    inputs = tuple((rows.stage, unit.name) for unit in rows.units)
    catalog = _catalog_factory(settings, cells, tuple(bandpasses), SOURCE_DENSITY)
    galaxies = _with_store(catalog("galaxies", makers["galaxy"], unit_settings, inputs), store)
    stars = _with_store(catalog("stars", makers["star"], unit_settings, inputs), store)
    per_batch = [
        Unit(
            name=unit.name,
            # rows of other batches make them duplicates
            settings=unit_settings | {"duplicates": digest(summary.duplicates.get(number, np.empty(0, np.int64)))},
            inputs=((rows.stage, unit.name),),
        )
        for number, unit in enumerate(rows.units)
    ]
    per_cell = [
        Unit(
            name=f"cell-{unit.name}",
            settings=unit_settings,
            inputs=(*inputs, (galaxies.stage, unit.name), (stars.stage, unit.name)),
        )
        for unit in galaxies.units
    ]
    quarantine = TableProduct(
        stage="truth/quarantine",
        units=(*per_batch, *per_cell),
        make=Quarantine(makers["galaxy"], galaxies, stars),
        schema=schema("quarantine"),
        bytes_per_unit=max(rows.bytes_per_unit, galaxies.bytes_per_unit),
    )
    return TruthCatalogs(
        galaxies=galaxies,
        stars=stars,
        quarantine=_with_store(quarantine, store),
        structure=None,
        ingested=rows,
        library=library,
        edges=edges,
        internal_frame=_internal_frame(settings),
    )


def _internal_frame(settings: TruthSettings) -> str:
    return "rest" if settings.dust == "physical" else "observed"


def _with_store(product: SomeProduct, store: Store | None) -> SomeProduct:
    return product if store is None else product.stored(store)


def _catalog_factory(
    settings: TruthSettings, cells: np.ndarray, bands: tuple[str, ...], density: float
) -> Callable[[str, Callable[[int], pd.DataFrame], dict[str, Any], Inputs], TableProduct]:
    """Return a function that constructs a truth catalog with one partition per cell.

    Parameters
    ----------
    settings : TruthSettings
        The `truth` section of the pipeline.
    cells : ndarray of int
        HEALPix cells of the partitions, of order `settings.order`.
    bands : tuple of str
        Bands of the fluxes.
    density : float, 1/arcmin^2
        Density of objects, for the estimates of memory and time.

    Returns
    -------
    callable
        catalog(kind, make, unit_settings, inputs) returns the catalog. `kind` is "galaxies" or "stars"; `make` makes a
        partition; the settings, to which the cell is added, and the inputs are those of every unit.
    """
    row_bytes = int(cell_area(settings.order) * density * BYTES_PER_ROW)
    # with few rows, spectra and dust need most of the memory
    bytes_per_unit = max(row_bytes + (150 << 20), 220 << 20)

    def catalog(
        kind: str, make: Callable[[int], pd.DataFrame], unit_settings: dict[str, Any], inputs: Inputs
    ) -> TableProduct:
        units = tuple(
            Unit(name=f"{settings.order}-{cell}", settings={**unit_settings, "cell": int(cell)}, inputs=inputs)
            for cell in cells
        )
        return TableProduct(
            stage=f"truth/{kind}",
            units=units,
            make=make,
            schema=schema(kind, bands),
            pixels=tuple(map(int, cells)),
            order=settings.order,
            bytes_per_unit=bytes_per_unit,
            seconds_per_unit=cell_area(settings.order) * density * 1.1e-5,
        )

    return catalog


def truth_of(context: SurveyContext) -> TruthCatalogs:
    """Return the truth catalogs of a survey."""
    pipeline = context.pipeline
    rows = None if pipeline.truth.source == "generate" else context.output("truth/ingested")
    return truth(pipeline.truth, context.data, context.region, context.bandpasses, pipeline.seed, context.store, rows)


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
    summary="Matter of the generated universe in redshift shells on the sky, with its convergence and shear.",
    shrink_with="lower truth.nside",
)
INGESTED = Stage(
    name="truth/ingested",
    build=lambda context, _: ingested_rows(open_sources(context.pipeline.truth, context.data)),
    exists=lambda context, survey: not _generated_truth(context, survey),
    unit="batch of rows of a source catalog",
    summary="Rows of source catalogs in a common form, with the reason for each row that cannot be used.",
    tables={"ingested": "truth/ingested/"},
)
GALAXIES = Stage(
    name="truth/galaxies",
    build=lambda context, _: context.once(truth_of).galaxies,
    reads=("truth/structure", "truth/ingested"),
    units_known_after=("truth/ingested",),
    unit="HEALPix cell",
    summary="True galaxies, generated or from source catalogs, with bulge, disk, knots, lensing, dust, spectra and the "
    "fluxes in all bands.",
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
    summary="True stars, from a model of the Galaxy or from source catalogs, with spectra and the fluxes in all bands.",
    sky=("ra", "dec"),
    shrink_with="raise truth.order",
    tables={"stars": "truth/stars/"},
)
QUARANTINE = Stage(
    name="truth/quarantine",
    build=lambda context, _: context.once(truth_of).quarantine,
    reads=("truth/ingested", "truth/galaxies", "truth/stars"),
    units_known_after=("truth/ingested",),
    unit="batch of rows or HEALPix cell",
    summary="Rows of source catalogs that cannot be used, each with the reason.",
    shrink_with="raise truth.order",
    tables={"quarantine": "truth/quarantine/"},
)


def write_spectra(catalogs: TruthCatalogs, store: Store) -> None:
    """Write truth/seds.zarr: the spectra to which the columns `*_sed` refer, and the edges of the top-hat bins."""
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
