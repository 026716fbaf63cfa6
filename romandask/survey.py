"""A survey: a pipeline and a store, and its lazy products, read where they are stored and made where they are not."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property
from typing import Any, Literal, TypeVar

import dask.dataframe as dd
import numpy as np
import pandas as pd
import xarray as xr

from romandask.instruments.instrument import Instrument
from romandask.model.errors import UserError
from romandask.model.sky import Cone, Region
from romandask.model.spectra import Bandpass
from romandask.model.tiles import Tile
from romandask.pipeline import Pipeline, load_pipeline
from romandask.products.images import ImageProduct
from romandask.products.tables import TableProduct
from romandask.stage_graph import find_stage, stage_products
from romandask.stages.analysis.blend_statistics import Statistics, matrix, statistics_of
from romandask.stages.analysis.friends_of_friends import group_of, matches_of
from romandask.stages.analysis.validation import depths, residuals, with_truth
from romandask.stages.coadds.psf_at import Spectrum, coadd_psf
from romandask.stages.cutouts import Positions, Wanted, cutouts, located
from romandask.stages.detections.truth_match import completeness
from romandask.stages.detections.zero_points import FLUXES
from romandask.stages.pointings import visits
from romandask.stages.truth.catalogs import TruthCatalogs, truth_of
from romandask.storage.manifest import read_records
from romandask.storage.paths import AnyPath, access_errors_explained, parse_path
from romandask.storage.store import Store

Value = TypeVar("Value")


class Survey:
    """The products of one survey.

    Parameters
    ----------
    pipeline : Pipeline
        Its settings.
    store : Store or None
        Where its units are kept; None to make everything on demand.
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
        """The box on the sky."""
        return self.pipeline.region.region()

    @cached_property
    def instruments(self) -> dict[str, Instrument]:
        """Instruments by survey name."""
        return self.pipeline.instruments()

    @cached_property
    def tiles(self) -> list[Tile]:
        """The tiles whose unique areas touch the region."""
        return self.pipeline.coadds.grid().covering(self.region)

    @cached_property
    def bandpasses(self) -> dict[str, Bandpass]:
        """All bands of all instruments; the truth holds a flux for each."""
        return {
            band: instrument.bandpass(band) for instrument in self.instruments.values() for band in instrument.bands
        }

    @property
    def data(self) -> AnyPath:
        """The folder that the paths of source files are relative to."""
        return parse_path(self.pipeline.data, "data")

    def output(self, name: str) -> Any:
        """Return what the stage of a product builds, for example of `coadds/roman`; with a store it reads units there.

        Raises
        ------
        UserError
            If the survey has no such product.
        """
        if name not in self._outputs:
            stage, survey = find_stage(name, tuple(self.instruments))
            built = stage.build(self, survey)
            made_anew = stage.on_demand or name in self._not_from_store
            self._outputs[name] = built if self.store is None or made_anew else built.stored(self.store)
        return self._outputs[name]

    def product(self, name: str) -> Any:
        """Return the lazy product, an ImageProduct or a TableProduct, of that name."""
        return self.output(name).product

    def once(self, build: Callable[..., Value], *arguments: str) -> Value:
        """Return `build(survey, *arguments)`, called once: for values that several stages share."""
        if (build, arguments) not in self._shared:
            self._shared[build, arguments] = build(self, *arguments)
        return self._shared[build, arguments]

    def ignore_stored(self, name: str) -> None:
        """Make a product anew, whatever the store has of it: what is stored is stale, and others depend on its content.

        Call it before products that depend on it are built.
        """
        self._not_from_store.add(name)
        self._outputs.pop(name, None)

    def use_stored(self, name: str) -> None:
        """Read a product from the store again, where it has just been made."""
        if name not in self._not_from_store:
            return
        self._not_from_store.discard(name)
        self._outputs.pop(name, None)
        if any(name in one.reads for one in stage_products(self)):
            # what was built with the product reads its units: from now on from the store
            self._outputs.clear()
            self._shared.clear()

    @property
    def sharpest(self) -> str:
        """The survey whose coadds have the smallest pixels."""
        return min(self.instruments, key=lambda name: self.instruments[name].coadd_scale)

    @property
    def truth_catalogs(self) -> TruthCatalogs:
        """The truth catalogs and the spectra that they refer to."""
        return self.once(truth_of)

    def truth(self, kind: str, region: Region | Cone | None = None) -> dd.DataFrame:
        """Return the lazy truth catalog `galaxies` or `stars` (schema: catalogs/<kind>.yaml).

        With a region only the partitions that it touches are read, and only its rows are returned.
        """
        kinds = ("galaxies", "stars", "quarantine") if region is None else ("galaxies", "stars")
        product = self._one(vars(self.truth_catalogs), kind, kinds)
        return product.frame if region is None else product.within(region)

    def pointings(self, survey: str) -> pd.DataFrame:
        """Return the exposures of an instrument, one row a visit and detector."""
        self._instrument(survey)
        if survey not in self._pointings:
            self._pointings[survey] = self.product(f"pointings/{survey}").load(0)
        return self._pointings[survey]

    def visits(self, survey: str) -> pd.DataFrame:
        """Return all visits of an instrument's observing sequence, whether or not they touch the region."""
        settings = self.pipeline
        instrument = self._instrument(survey)
        return visits(instrument, settings.block(survey).pointings, self.data, self.region, settings.seed)

    def exposures(self, survey: str) -> xr.Dataset:
        """Return lazy exposures (exposure, y, x): image, truth, dq; coords visit, detector, band, mjd, header ...

        Of Rubin, and of Roman with detector: sca, also raw and variance, and the image is the calibrated one.
        """
        return self._of("exposures", survey).dataset

    def truth_index(self, survey: str) -> dd.DataFrame:
        """Return the lazy index of the objects on each exposure (schema: catalogs/truth_index.yaml)."""
        return self._of("truth_index", survey).frame

    def psfs(self, survey: str) -> xr.Dataset:
        """Return lazy PSF images (exposure, v, u): a unit star of flat f_nu, sampled 8 times finer than pixels."""
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
        """Return lazy cutouts (cutout, y, x) around objects, of every image that sees them, with their coordinates.

        Parameters
        ----------
        of : ids of objects; or a region or cone, for all objects in it; or a table with columns id, ra, dec
        layers : image, truth, dq, background, weight, psf of exposures; image, weight, noise, nimages of coadds
        bands : None for all
        size : pixels a side, even
        catalog : whose objects: truth (galaxies and stars), or an instrument's object table

        Raises
        ------
        UserError
            If an id is not in the catalog, or a name is not one of the above.
        """
        survey = self.sharpest if survey is None else survey
        found = located(of, self.tables(catalog), catalog)
        if images not in ("exposures", "coadds"):
            raise UserError(f"{images!r}: this survey has exposures, coadds")
        product = self._of(images, survey)
        wanted = (layers,) if isinstance(layers, str) else tuple(layers)
        chosen = (bands,) if isinstance(bands, str) else bands
        return cutouts(product, found, wanted, None if chosen is None else tuple(chosen), size)

    def tables(self, catalog: str) -> tuple[Positions, ...]:
        """Return the tables that hold the objects of a catalog: truth, or an instrument's."""
        if catalog == "truth":
            truth = self.truth_catalogs
            return Positions(truth.galaxies, "galaxy_id", "ra", "dec"), Positions(truth.stars, "id", "ra", "dec")
        if catalog not in self.instruments:
            raise UserError(f"catalog {catalog!r}: this survey has truth, {', '.join(self.instruments)}")
        return (Positions(self._of("objects", catalog), "objectId", "coord_ra", "coord_dec"),)

    def coadds(self, survey: str) -> xr.Dataset:
        """Return lazy coadds (tile, band, y, x): image, weight, noise, nimages, set, psf ...; coords tile, band, ..."""
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
        """Return the image of a unit star (v, u) at a place of drizzled coadds: see `stages.coadds.psf_at.coadd_psf`.

        It is as the coadd has it there, or, with a scale, sampled every so many arcsec with the star in the middle.
        """
        survey = next((name for name, one in self.instruments.items() if band in one.bands), self.sharpest)
        return coadd_psf(self._of("coadds", survey), ra, dec, band, stamp, scale, spectrum)

    def segmentation(self, survey: str) -> xr.Dataset:
        """Return the lazy maps of detected objects (tile, y, x): `segmentation`, the last 24 bits of objectId."""
        return self._of("detections", survey).dataset

    def differences(self) -> xr.Dataset:
        """Return the lazy differences (tile, y, x) of two surveys' tiles: difference, template, rms, nJy.

        Raises
        ------
        UserError
            If the survey does not have both bands (`differences.template` and `differences.science`).
        """
        return self._difference_product().dataset

    def difference_residuals(self) -> pd.DataFrame:
        """Return what is left of bright objects in the differences (schema: catalogs/residuals.yaml)."""
        product = self._difference_product()
        return pd.concat([product.load(k, ("residuals",))["residuals"] for k in range(len(product.units))])

    def truth_match(self, survey: str) -> dd.DataFrame:
        """Return the lazy true counterparts of a survey's objects (schema: catalogs/truth_match.yaml)."""
        return self._of("truth_match", survey).frame

    def truth_summary(self, survey: str) -> dd.DataFrame:
        """Return the lazy list of true objects, found or not (schema: catalogs/truth_summary.yaml)."""
        return self._of("truth_summary", survey).frame

    def completeness(self, survey: str) -> pd.DataFrame:
        """Return completeness and purity of a survey's objects by magnitude, in its reference band."""
        summary, matched = (self._of(stage, survey).all_rows() for stage in ("truth_summary", "truth_match"))
        return completeness(summary, matched, self._instrument(survey).reference_band)

    def objects_with_truth(self, survey: str) -> pd.DataFrame:
        """Return a survey's objects beside their true counterparts: flux_<band> (nJy), star, redshift, truth_id."""
        stages = ("objects", "truth_match", "truth_summary")
        return with_truth(*(self._of(stage, survey).all_rows() for stage in stages))

    def depths(self, survey: str) -> pd.Series:
        """Return the 5-sigma depths of point sources, AB mag by band."""
        return depths(self._of("objects", survey).all_rows(), self.bands(survey))

    def residuals(self, survey: str, flux: str = "kronFlux") -> pd.DataFrame:
        """Return bias, scatter and pulls of measured fluxes by band and magnitude (`stages.analysis.validation`)."""
        return residuals(
            self.objects_with_truth(survey), self.bands(survey), self._one({f: f for f in FLUXES}, flux, FLUXES)
        )

    def bands(self, survey: str) -> tuple[str, ...]:
        """Return the bands of an instrument."""
        return self._instrument(survey).bands

    def objects(self, survey: str) -> dd.DataFrame:
        """Return the lazy object table of a survey (schema: catalogs/objects.yaml)."""
        return self._of("objects", survey).frame

    def sample(self, survey: str) -> dd.DataFrame:
        """Return the lazy sample of a survey's objects that the groups are made of (schema: catalogs/samples.yaml)."""
        return self._of("samples", survey).frame

    def shear(self, survey: str) -> pd.DataFrame:
        """Return xi+ and xi- of the true shapes of a survey's sample (schema: catalogs/shear.yaml).

        Of a region too small for the shortest separation it has no rows. `stages.analysis.shear.significance` is the
        signal to noise of such a table.
        """
        return self._of("shear", survey).all_rows()

    def matches(self, linking_length: float | None = None) -> dd.DataFrame:
        """Return the lazy friends-of-friends groups of the samples of all surveys (schema: catalogs/groups.yaml).

        With a linking length (arcsec, no longer than the longest of the pipeline) the column `group` has the groups of
        that length: the stored forest, cut there.
        """
        products, longest = self.once(matches_of), max(self.pipeline.matches.linking_lengths)
        frame = products.groups.frame
        if linking_length is None:
            return frame
        if not 0 < linking_length <= longest:
            raise UserError(f"linking length {linking_length:g}: this survey's forest ends at {longest:g} arcsec")
        meta = frame._meta.assign(group=np.empty(0, np.int64))
        return frame.map_partitions(_with_group, products.merged.load(0), linking_length, meta=meta)

    @property
    def statistics(self) -> SurveyStatistics:
        """Statistics of the groups."""
        return SurveyStatistics(self.once(statistics_of), self.pipeline.matches.linking_lengths)

    @property
    def differs(self) -> bool:
        """True where the survey has both bands of the difference images."""
        return any(one.name.startswith("differences/") for one in stage_products(self))

    def _difference_product(self) -> ImageProduct:
        settings = self.pipeline.differences
        for name, instrument in self.instruments.items():
            if settings.science in instrument.bands:
                return self.output(f"differences/{name}")
        raise UserError(f"difference images need the bands {settings.template} and {settings.science}")

    def _of(self, stage: str, survey: str) -> Any:
        """Return what a stage builds for an instrument."""
        self._instrument(survey)
        return self.output(f"{stage}/{survey}")

    def _instrument(self, survey: str) -> Instrument:
        return self._one(self.instruments, survey, tuple(self.instruments))

    @staticmethod
    def _one(mapping: Any, name: str, valid: tuple[str, ...]) -> Any:
        if name not in valid:
            raise UserError(f"{name!r}: this survey has {', '.join(valid)}")
        return mapping[name]

    def __repr__(self) -> str:
        place = self.store.root if self.store else "not stored"
        lines = [f"Survey {self.pipeline.name} ({place})"]
        if self.store:
            for stage in self.store.stages():
                records = [record for _, record in read_records(self.store, stage) if record]
                size = sum(record.bytes for record in records)
                lines.append(f"  {stage:20s} {len(records):6d} units {size / 1e6:12.1f} MB")
        return "\n".join(lines)


class SurveyStatistics:
    """Statistics of the groups, as tables."""

    def __init__(self, products: Statistics, lengths: tuple[float, ...]):
        self._products = products
        self._lengths = lengths

    def blends(self, linking_length: float | None = None) -> pd.DataFrame:
        """Return the blend matrix: numbers of groups by Roman objects (rows) and Rubin objects (columns)."""
        return matrix(self._products.blends.all_rows(), self._length(linking_length))

    def unrecognised(self, linking_length: float | None = None) -> pd.DataFrame:
        """Return unrecognised blends by i magnitude (schema: catalogs/unrecognised.yaml)."""
        return self._of(self._products.unrecognised, linking_length)

    def chance(self, linking_length: float | None = None) -> pd.DataFrame:
        """Return what `unrecognised` is where Rubin's objects are moved, so that chance alone makes groups."""
        return self._of(self._products.chance, linking_length)

    def distributions(self, linking_length: float | None = None) -> pd.DataFrame:
        """Return colours and sizes of blends and of single objects (schema: catalogs/distributions.yaml)."""
        return self._of(self._products.distributions, linking_length)

    def _of(self, product: TableProduct, length: float | None) -> pd.DataFrame:
        table = product.all_rows()
        return table[np.isclose(table["linking_length"], self._length(length))].reset_index(drop=True)

    def _length(self, length: float | None) -> float:
        length = self._lengths[0] if length is None else length
        if not np.isclose(length, self._lengths).any():
            raise UserError(f"linking length {length}: this survey has {', '.join(map(str, self._lengths))} arcsec")
        return length


def _with_group(groups: pd.DataFrame, merged: pd.DataFrame, length: float) -> pd.DataFrame:
    return groups.assign(group=group_of(groups, merged, length))


def open_survey(path: str | AnyPath) -> Survey:
    """Open a stored survey: its folder, or s3://BUCKET/FOLDER.

    Raises
    ------
    UserError
        If it is not a store, or cannot be reached.
    """
    store = Store(parse_path(path))
    with access_errors_explained(store.root):
        there = store.pipeline.is_file()
    if not there:
        raise UserError(f"{path}: not a romandask store (it has no pipeline.yaml); make one with romandask run")
    return Survey(load_pipeline(store.pipeline), store)
