"""A survey: the lazy products of a pipeline, read from a store as far as they are stored, otherwise made on demand."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from typing import Any, Literal, TypeVar

import dask.dataframe as dd
import pandas as pd
import xarray as xr

from romandask.engine.graph import UnitGraph
from romandask.instruments.instrument import Instrument
from romandask.model.errors import UserError
from romandask.model.sky import Cone, Region
from romandask.model.spectra import Bandpass
from romandask.model.tiles import Tile
from romandask.pipeline import Pipeline, load_pipeline
from romandask.products.images import ImageProduct
from romandask.products.tables import TableProduct
from romandask.stage_graph import find_stage, stage_products
from romandask.stages.analysis.blend_statistics import SurveyStatistics, statistics_of
from romandask.stages.analysis.differences import science_survey
from romandask.stages.analysis.friends_of_friends import cut_groups, matches_of
from romandask.stages.analysis.validation import depths, residuals, with_truth
from romandask.stages.coadds.psf_at import Spectrum, coadd_psf
from romandask.stages.cutouts import cutouts
from romandask.stages.detections.truth_match import completeness
from romandask.stages.detections.zero_points import FLUXES
from romandask.stages.pointings import visits
from romandask.stages.truth.catalogs import TruthCatalogs, truth_of
from romandask.stages.wanted import Positions, Wanted, located
from romandask.storage.paths import AnyPath, access_errors_explained, parse_path
from romandask.storage.store import Store
from romandask.survey_graph import unit_graph
from romandask.survey_repr import html_of, text_of

Value = TypeVar("Value")


class Survey:
    """Lazy products of a survey: xarray datasets and dask data frames with one chunk or partition for each unit.

    Units that the store has are read, all others are made when they are computed. The argument `survey` of methods is
    the name of an instrument of the pipeline, for example `roman`. Methods raise UserError for an instrument, catalog,
    band, layer or flux that the survey does not have. Schemas of tables are files of the folder `catalogs/`.

    Parameters
    ----------
    pipeline : Pipeline
        Settings of the survey.
    store : Store, optional
        Store of the survey; without one, every product is made on demand.
    """

    def __init__(self, pipeline: Pipeline, store: Store | None = None):
        self.pipeline = pipeline
        self.store = store
        self._outputs: dict[str, Any] = {}
        self._shared: dict[tuple[Callable[..., Any], tuple[str, ...]], Any] = {}
        self._pointings: dict[str, pd.DataFrame] = {}
        self._not_from_store: set[str] = set()

    @cached_property
    def region(self) -> Region:
        """Region of the survey, a box on the sky."""
        return self.pipeline.region.region()

    @cached_property
    def instruments(self) -> dict[str, Instrument]:
        """Instruments by name, in the order of the pipeline."""
        return self.pipeline.instruments()

    @cached_property
    def tiles(self) -> list[Tile]:
        """Tiles of the coadds: those whose unique areas overlap the region."""
        return self.pipeline.coadds.grid().covering(self.region)

    @cached_property
    def bandpasses(self) -> dict[str, Bandpass]:
        """Bandpasses of all instruments, by band; the truth has a flux for each."""
        return {
            band: instrument.bandpass(band) for instrument in self.instruments.values() for band in instrument.bands
        }

    @property
    def data(self) -> AnyPath:
        """Folder that paths of source files in the pipeline are relative to."""
        return parse_path(self.pipeline.data, "data")

    @property
    def sharpest(self) -> str:
        """Name of the instrument whose coadds have the smallest pixels."""
        return min(self.instruments, key=lambda name: self.instruments[name].coadd_scale)

    def output(self, name: str) -> Any:
        """Return what the stage of a product builds: the lazy product, or an object with it and what it is made from.

        Parameters
        ----------
        name : str
            Name of the product, for example `coadds/roman`.
        """
        if name not in self._outputs:
            stage, survey = find_stage(name, tuple(self.instruments))
            built = stage.build(self, survey)
            always_made = stage.on_demand or name in self._not_from_store
            self._outputs[name] = built if self.store is None or always_made else built.stored(self.store)
        return self._outputs[name]

    def product(self, name: str) -> ImageProduct | TableProduct:
        """Return a lazy product by name (see `output`)."""
        return self.output(name).product

    def once(self, build: Callable[..., Value], *arguments: str) -> Value:
        """Return `build(self, *arguments)`; repeated calls return the same object, so that stages can share it."""
        if (build, arguments) not in self._shared:
            self._shared[build, arguments] = build(self, *arguments)
        return self._shared[build, arguments]

    def ignore_stored(self, name: str) -> None:
        """Make a product although it is stored, because it is stale; call this before dependent products are built."""
        self._not_from_store.add(name)
        self._outputs.pop(name, None)

    def use_stored(self, name: str) -> None:
        """Read a product from the store again, after `ignore_stored` and after a run has stored it."""
        if name not in self._not_from_store:
            return
        self._not_from_store.discard(name)
        self._outputs.pop(name, None)
        if any(name in product.reads for product in stage_products(self)):
            # products built from the one that is not read would make its units again
            self._outputs.clear()
            self._shared.clear()

    @property
    def truth_catalogs(self) -> TruthCatalogs:
        """Lazy truth catalogs and the spectra that they refer to."""
        return self.once(truth_of)

    def truth(self, kind: str, region: Region | Cone | None = None) -> dd.DataFrame:
        """Return a lazy truth catalog.

        Parameters
        ----------
        kind : {"galaxies", "stars", "quarantine"}
            Catalog (schema: catalogs/<kind>.yaml).
        region : Region or Cone, optional
            Return only the rows of this area and read only the partitions that overlap it; not for `quarantine`.
        """
        catalogs = {"galaxies": self.truth_catalogs.galaxies, "stars": self.truth_catalogs.stars}
        if region is None:
            return _select(catalogs | {"quarantine": self.truth_catalogs.quarantine}, kind).frame
        return _select(catalogs, kind).within(region)

    def pointings(self, survey: str) -> pd.DataFrame:
        """Return the exposures of an instrument, one row per visit and detector (schema: catalogs/pointings.yaml)."""
        self._instrument(survey)
        if survey not in self._pointings:
            self._pointings[survey] = self.output(f"pointings/{survey}").load(0)
        return self._pointings[survey]

    def visits(self, survey: str) -> pd.DataFrame:
        """Return all visits of the observing sequence of an instrument, whether or not they overlap the region."""
        settings = self.pipeline
        instrument = self._instrument(survey)
        return visits(instrument, settings.block(survey).pointings, self.data, self.region, settings.seed)

    def exposures(self, survey: str) -> xr.Dataset:
        """Return lazy exposures.

        Returns
        -------
        Dataset, dims (exposure, y, x)
            `image` (observed), `truth` (noiseless, electrons) and `dq` (data quality). For Rubin, and for Roman with
            `detector: sca`, also `raw` and `variance`, and `image` is calibrated. Coordinates: visit, detector, band,
            mjd, exptime, ra, dec, pa and header (WCS).
        """
        return self._of("exposures", survey).dataset

    def truth_index(self, survey: str) -> dd.DataFrame:
        """Return the lazy index of the true objects on each exposure (schema: catalogs/truth_index.yaml)."""
        return self._of("truth_index", survey).frame

    def psfs(self, survey: str) -> xr.Dataset:
        """Return lazy PSF images, dims (exposure, v, u): a star of unit flux and flat f_nu, 8 samples per pixel."""
        return self._of("psfs", survey).dataset

    def cutouts(
        self,
        of: Wanted,
        layers: str | Sequence[str] = ("image",),
        bands: str | Sequence[str] | None = None,
        size: int = 48,
        survey: str | None = None,
        images: Literal["exposures", "coadds"] = "exposures",
        catalog: str = "truth",
    ) -> xr.Dataset:
        """Return lazy cutouts, dims (cutout, y, x), around objects, from every image that contains them.

        Parameters
        ----------
        of : sequence of int, Region, Cone or DataFrame
            Ids of objects; an area, for all objects in it; or a table with columns id, ra and dec (degrees).
        layers : str or sequence of str
            `image`, `truth`, `dq`, `background`, `weight`, `psf` of exposures; `image`, `weight`, `noise`, `nimages`
            of coadds.
        bands : str or sequence of str, optional
            All bands by default.
        size : int, pixels
            Side of the cutouts, even, from 8 to 256.
        survey : str, optional
            Instrument; by default the one whose coadds have the smallest pixels.
        images : {"exposures", "coadds"}
            Images that are cut.
        catalog : str
            Catalog of the objects: `truth` (galaxies and stars) or the name of an instrument, for its object table.

        Raises
        ------
        UserError
            If the catalog has no object with one of the ids, or an argument is not one of the above.
        """
        survey = self.sharpest if survey is None else survey
        objects = located(of, self.tables(catalog), catalog)
        if images not in ("exposures", "coadds"):
            raise UserError(f"{images!r}: this survey has exposures, coadds")
        layer_names = (layers,) if isinstance(layers, str) else tuple(layers)
        band_names = (bands,) if isinstance(bands, str) else None if bands is None else tuple(bands)
        return cutouts(self._of(images, survey), objects, layer_names, band_names, size)

    def tables(self, catalog: str) -> tuple[Positions, ...]:
        """Return the tables with the objects of a catalog: `truth`, or the name of an instrument."""
        if catalog == "truth":
            truth = self.truth_catalogs
            return Positions(truth.galaxies, "galaxy_id", "ra", "dec"), Positions(truth.stars, "id", "ra", "dec")
        if catalog not in self.instruments:
            raise UserError(f"catalog {catalog!r}: this survey has truth, {', '.join(self.instruments)}")
        return (Positions(self._of("objects", catalog), "objectId", "coord_ra", "coord_dec"),)

    def coadds(self, survey: str) -> xr.Dataset:
        """Return lazy coadds.

        Returns
        -------
        Dataset, dims (tile, band, y, x)
            `image` (nJy), `weight`, `noise` (realisations, nJy), `nimages` (number of exposures), `dq` and `psf`; for
            drizzled coadds also `set` and `input_psf`. Coordinates: tile, band, tile_id, ra, dec and header (WCS).
        """
        return self._of("coadds", survey).dataset

    def psf(
        self,
        ra: float,
        dec: float,
        band: str,
        stamp: int | None = None,
        scale: float | None = None,
        spectrum: Spectrum | None = None,
    ) -> xr.DataArray:
        """Return the PSF of a drizzled coadd at a position, dims (v, u): the image of a star of unit flux.

        Parameters
        ----------
        ra, dec : float, degrees
        band : str
        stamp : int, pixels, optional
            Side of the image; by default that of the stored PSFs.
        scale : float, arcsec, optional
            Distance between samples, with the star in the middle. By default the pixels of the coadd are returned.
        spectrum : callable, optional
            Photons per nm of the star, in any unit, at a wavelength in nm; by default flat f_nu.

        Raises
        ------
        UserError
            If no drizzled coadd has the band, or no exposure contains the position.
        """
        survey = next((name for name in self.instruments if band in self.bands(name)), self.sharpest)
        return coadd_psf(self._of("coadds", survey), ra, dec, band, stamp, scale, spectrum)

    def segmentation(self, survey: str) -> xr.Dataset:
        """Return lazy segmentation maps, dims (tile, y, x): the last 24 bits of objectId, or 0 for no object."""
        return self._of("detections", survey).dataset

    def differences(self) -> xr.Dataset:
        """Return lazy difference images, dims (tile, y, x), nJy: `difference`, matched `template` and `rms`.

        Raises
        ------
        UserError
            If the survey lacks one of the bands `differences.template` and `differences.science`.
        """
        return self._differences().dataset

    def difference_residuals(self) -> pd.DataFrame:
        """Return the residuals of bright objects in the difference images (schema: catalogs/residuals.yaml)."""
        product = self._differences()
        return pd.concat([product.load(k, ("residuals",))["residuals"] for k in range(len(product.units))])

    def truth_match(self, survey: str) -> dd.DataFrame:
        """Return the lazy true counterparts of objects (schema: catalogs/truth_match.yaml)."""
        return self._of("truth_match", survey).frame

    def truth_summary(self, survey: str) -> dd.DataFrame:
        """Return the lazy table of true objects, detected or not (schema: catalogs/truth_summary.yaml)."""
        return self._of("truth_summary", survey).frame

    def completeness(self, survey: str) -> pd.DataFrame:
        """Return completeness and purity by magnitude in the reference band (`stages.detections.truth_match`)."""
        summary, matched = (self._of(stage, survey).all_rows() for stage in ("truth_summary", "truth_match"))
        return completeness(summary, matched, self._instrument(survey).reference_band)

    def objects_with_truth(self, survey: str) -> pd.DataFrame:
        """Return the objects with a true counterpart, and its truth_id, star, redshift and flux_<band> (nJy)."""
        stages = ("objects", "truth_match", "truth_summary")
        return with_truth(*(self._of(stage, survey).all_rows() for stage in stages))

    def depths(self, survey: str) -> pd.Series:
        """Return the 5-sigma depths of point sources by band, AB mag."""
        return depths(self._of("objects", survey).all_rows(), self.bands(survey))

    def residuals(self, survey: str, flux: str = "kronFlux") -> pd.DataFrame:
        """Return bias, scatter and pulls of measured fluxes by band and true magnitude (`stages.analysis.validation`).

        Parameters
        ----------
        survey : str
        flux : {"kronFlux", "apFlux", "psfFlux"}
        """
        return residuals(self.objects_with_truth(survey), self.bands(survey), _select({f: f for f in FLUXES}, flux))

    def bands(self, survey: str) -> tuple[str, ...]:
        """Return the bands of an instrument."""
        return self._instrument(survey).bands

    def objects(self, survey: str) -> dd.DataFrame:
        """Return the lazy object table (schema: catalogs/objects.yaml)."""
        return self._of("objects", survey).frame

    def sample(self, survey: str) -> dd.DataFrame:
        """Return the lazy sample of objects that friends of friends uses (schema: catalogs/samples.yaml)."""
        return self._of("samples", survey).frame

    def shear(self, survey: str) -> pd.DataFrame:
        """Return the two-point functions of the true shapes of the sample (schema: catalogs/shear.yaml).

        The table has no rows if the region is too small for the shortest separation. Its signal-to-noise ratio is
        `stages.analysis.two_point.significance`.
        """
        return self._of("shear", survey).all_rows()

    def matches(self, linking_length: float | None = None) -> dd.DataFrame:
        """Return the lazy friends-of-friends groups of the samples of two surveys (schema: catalogs/groups.yaml).

        Parameters
        ----------
        linking_length : float, arcsec, optional
            Add a column `group` with the groups of this length, at most the longest of `matches.linking_lengths`.

        Raises
        ------
        UserError
            If the linking length is not possible, or the survey has only one of the two surveys.
        """
        products, longest = self.once(matches_of), max(self.pipeline.matches.linking_lengths)
        if linking_length is None:
            return products.groups.frame
        if not 0 < linking_length <= longest:
            raise UserError(f"linking length {linking_length:g}: this survey's forest ends at {longest:g} arcsec")
        return cut_groups(products, linking_length)

    @property
    def statistics(self) -> SurveyStatistics:
        """Statistics of the groups: the blend matrix, unrecognised blends, their colours and sizes."""
        return SurveyStatistics(self.once(statistics_of), self.pipeline.matches.linking_lengths)

    @property
    def differs(self) -> bool:
        """True if the survey has both bands of the difference images."""
        return any(product.name.startswith("differences/") for product in stage_products(self))

    def _differences(self) -> ImageProduct:
        return self.output(f"differences/{science_survey(self)}")

    def _of(self, stage: str, survey: str) -> Any:
        """Return what a stage builds for an instrument."""
        self._instrument(survey)
        return self.output(f"{stage}/{survey}")

    def _instrument(self, survey: str) -> Instrument:
        return _select(self.instruments, survey)

    def graph(self, stages: Sequence[str] = (), region: Region | None = None) -> UnitGraph:
        """Return the stale units as a lazy dask collection (see `romandask.survey_graph.unit_graph`)."""
        return unit_graph(self, stages, region)

    def __reduce__(self) -> tuple[Any, ...]:
        return Survey, (self.pipeline, self.store)

    def __repr__(self) -> str:
        return text_of(self)

    def _repr_html_(self) -> str:
        return html_of(self)


def _select(values: Mapping[str, Value], name: str) -> Value:
    """Return the value of a name; an unknown name is a UserError with the known ones."""
    if name not in values:
        raise UserError(f"{name!r}: this survey has {', '.join(values)}")
    return values[name]


def open_survey(path: str | AnyPath) -> Survey:
    """Open a stored survey.

    Parameters
    ----------
    path : str or path
        Folder of the store, or s3://BUCKET/FOLDER.

    Raises
    ------
    UserError
        If the folder is not a store, or cannot be reached.
    """
    store = Store(parse_path(path))
    with access_errors_explained(store.root):
        is_store = store.pipeline.is_file()
    if not is_store:
        raise UserError(f"{path}: not a romandask store (it has no pipeline.yaml); make one with romandask run")
    return Survey(load_pipeline(store.pipeline), store)
