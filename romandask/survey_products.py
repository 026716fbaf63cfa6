"""The products of a survey by stage, each lazy: read where it is stored, made where not."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import Any

import pandas as pd

from romandask.instruments.instrument import Instrument
from romandask.instruments.roman.calibration import calibrations
from romandask.model.errors import UserError
from romandask.model.sky import Region
from romandask.model.spectra import Bandpass
from romandask.model.tiles import Tile
from romandask.pipeline import Pipeline
from romandask.products.images import ImageProduct
from romandask.products.schemas import schema
from romandask.products.tables import TableProduct, conform, to_frame
from romandask.products.units import Unit
from romandask.stages.analysis.blend_statistics import SURVEYS, Samples, Statistics, statistics
from romandask.stages.analysis.differences import differences
from romandask.stages.analysis.friends_of_friends import SHIFT, Matches, matches
from romandask.stages.analysis.samples import limits, samples
from romandask.stages.analysis.shear import Lensing, lensing
from romandask.stages.coadds.coadds import coadds
from romandask.stages.detections.detections import detections, objects
from romandask.stages.detections.truth_match import REFERENCE_BANDS, reference_band, truth_match, truth_summary
from romandask.stages.detections.zero_points import zero_points
from romandask.stages.exposures import exposures
from romandask.stages.pointings import pointings
from romandask.stages.psf_images import psfs
from romandask.stages.truth.catalogs import TruthCatalogs, truth
from romandask.stages.truth.ingested import ingested_rows, open_sources
from romandask.stages.truth_index import truth_index
from romandask.storage.manifest import read_record
from romandask.storage.paths import AnyPath, file_state, parse_path, resolve_below
from romandask.storage.store import Store, read_parquet


class SurveyProducts:
    """The products of one survey.

    Parameters
    ----------
    pipeline : its settings
    store : where its units are kept; None to make everything on demand
    """

    def __init__(self, pipeline: Pipeline, store: Store | None = None):
        self.pipeline = pipeline
        self.store = store
        self._made: dict[tuple[str, str], Any] = {}

    @cached_property
    def region(self) -> Region:
        """The box on the sky."""
        return self.pipeline.region.region()

    @cached_property
    def instruments(self) -> dict[str, Instrument]:
        """Instruments by name."""
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
        """The folder that source files are below."""
        return parse_path(self.pipeline.data, "data")

    @cached_property
    def ingested_product(self) -> TableProduct:
        """The rows of the source catalogs, where truth is not generated."""
        return self._stored(ingested_rows(open_sources(self.pipeline.truth, self.data)))

    @cached_property
    def truth_catalogs(self) -> TruthCatalogs:
        """The truth catalogs."""
        settings = self.pipeline
        rows = None if settings.truth.source == "generate" else self.ingested_product
        return truth(settings.truth, self.data, self.region, self.bandpasses, settings.seed, self.store, rows)

    def pointing_product(self, survey: str) -> TableProduct:
        """The pointings as a product of one unit."""
        settings = self.pipeline
        block = getattr(settings, survey)
        state = {
            "settings": block.model_dump(),
            "region": settings.region.model_dump(),
            "seed": settings.seed,
            "coadds": settings.coadds.model_dump(exclude={"pixfrac"}),
            "source": _state(self.data, block.pointings.path),
        }
        return self._stored(
            TableProduct(
                stage=f"pointings/{survey}",
                units=(Unit("all", state),),
                make=_MakePointings(self, survey),
                schema=schema("pointings"),
                bytes_per_unit=1 << 30,
            )
        )

    def exposure_product(self, survey: str) -> ImageProduct:
        """The exposures of an instrument."""
        instrument, settings = self._instrument(survey), self.pipeline
        return self._once(
            "exposures",
            survey,
            lambda: exposures(
                self.pointings(survey),
                self.truth_catalogs,
                instrument,
                settings.render,
                settings.seed,
                self.calibration_product if survey == "roman" and settings.calibration() else None,
                self.store,
            ),
        )

    @property
    def calibration_product(self) -> ImageProduct:
        """The calibrations of the SCAs that Roman's exposures use."""
        source = self.pipeline.calibration()
        if source is None:
            raise UserError("this survey has no calibrations: they belong to roman.detector: sca")
        scas = sorted(set(self.pointings("roman")["detector"].tolist()))
        return self._once("calibration", "roman", lambda: calibrations(source, scas))

    def truth_index_product(self, survey: str) -> TableProduct:
        """The truth index of an instrument's exposures."""
        return self._once("truth_index", survey, lambda: truth_index(self.exposure_product(survey)))

    def psf_product(self, survey: str) -> ImageProduct:
        """The PSF images of an instrument's exposures: made when asked for."""
        return self._once("psfs", survey, lambda: psfs(self.exposure_product(survey)))

    def coadd_product(self, survey: str) -> ImageProduct:
        """The coadds of an instrument."""
        self._instrument(survey)
        return self._once(
            "coadds", survey, lambda: coadds(self.exposure_product(survey), self.tiles, self.pipeline.coadds)
        )

    def detection_product(self, survey: str) -> ImageProduct:
        """The detections of each tile."""
        settings = self.pipeline.detections
        return self._once("detections", survey, lambda: detections(self.coadd_product(survey), settings, self.region))

    def truth_match_product(self, survey: str) -> TableProduct:
        """The true counterparts of the objects of each tile."""
        settings = self.pipeline.detections
        return self._once("truth_match", survey, lambda: truth_match(self.detection_product(survey), settings))

    def truth_summary_product(self, survey: str) -> TableProduct:
        """The true objects of each tile."""
        matched, settings = self.truth_match_product(survey), self.pipeline.detections
        found = self.detection_product(survey)
        return self._once("truth_summary", survey, lambda: truth_summary(matched, found, settings))

    def zero_points_product(self, survey: str) -> TableProduct:
        """The offsets of an instrument's magnitudes, from its stars."""
        bands = self._instrument(survey).bands
        summary, found = self.truth_summary_product(survey), self.detection_product(survey)
        return self._once("zero_points", survey, lambda: zero_points(summary, found, bands))

    def object_product(self, survey: str) -> TableProduct:
        """The object table."""
        found, settings = self.detection_product(survey), self.pipeline.detections
        zero, tiles = self.zero_points_product(survey), self.coadd_product(survey)
        return self._once("objects", survey, lambda: objects(found, tiles, settings, self.region, zero))

    def limit_product(self, survey: str) -> TableProduct:
        """The faintest magnitude of a survey's sample."""
        settings, bands = self.pipeline.matches, {reference_band(one): name for name, one in self.instruments.items()}
        # One pipeline's limits serve its runs with a survey, or that band, left out.
        if unknown := set(settings.limits or {}) - {*bands, *REFERENCE_BANDS}:
            raise UserError(f"matches.limits: {', '.join(sorted(unknown))}: they are those of {', '.join(bands)}")
        band, matched = reference_band(self._instrument(survey)), self.truth_match_product(survey)
        return self._once("limits", survey, lambda: limits(self.object_product(survey), matched, settings, band))

    def sample_product(self, survey: str) -> TableProduct:
        """The sample of a survey's objects."""
        instrument, settings = self._instrument(survey), self.pipeline.matches
        tables = self.object_product(survey), self.truth_match_product(survey), self.limit_product(survey)
        bands = instrument.bands, reference_band(instrument)
        return self._once("samples", survey, lambda: samples(*tables, settings, *bands))

    def lensing_products(self, survey: str) -> Lensing:
        """The stages of the two-point functions of the shapes of a survey's sample."""
        sample, galaxies = self.sample_product(survey), self.truth_catalogs.galaxies
        return self._once(
            "lensing", survey, lambda: lensing(sample, galaxies, self.pipeline.lensing, self.region, self.store)
        )

    @property
    def differs(self) -> bool:
        """True where the survey has both bands of the difference images."""
        settings = self.pipeline.differences
        bands = {band for instrument in self.instruments.values() for band in instrument.bands}
        return {settings.template, settings.science} <= bands

    @property
    def difference_product(self) -> ImageProduct:
        """The differences of Rubin's tiles and Roman's."""
        settings = self.pipeline.differences
        if not self.differs:
            raise UserError(f"difference images need {settings.template} of Roman and {settings.science} of Rubin")
        tiles = self.coadd_product("roman"), self.coadd_product("rubin")
        found = self.detection_product("rubin")
        return self._once("differences", "rubin", lambda: differences(*tiles, found, settings))

    @property
    def match_products(self) -> Matches:
        """The stages of friends of friends."""
        tables = {name: self.sample_product(name) for name in self.instruments}
        return self._once("matches", "all", lambda: matches(tables, self.pipeline.matches, self.region, self.store))

    @property
    def chance_products(self) -> Matches:
        """The same of a sky in which one survey is moved."""
        tables, settings = {name: self.sample_product(name) for name in self.instruments}, self.pipeline.matches
        return self._once("chance", "all", lambda: matches(tables, settings, self.region, self.store, "chance", SHIFT))

    @property
    def statistic_products(self) -> Statistics:
        """The tables of the statistics stage."""
        truth = self.truth_catalogs
        known = Samples(
            {name: self.sample_product(name) for name in SURVEYS},
            {name: reference_band(self._instrument(name)) for name in SURVEYS},
            truth.galaxies,
            truth.stars,
        )
        made = statistics(self.match_products, self.chance_products, known, self.pipeline.matches.linking_lengths)
        return Statistics(*(self._stored(table) for table in vars(made).values()))

    def make_pointings(self, survey: str) -> pd.DataFrame:
        """Return the pointings made afresh, whatever the store has."""
        settings = self.pipeline
        block, grid = getattr(settings, survey), settings.coadds.grid()
        instrument = self._instrument(survey)
        frame = pointings(instrument, block.pointings, self.data, self.region, self.tiles, grid.side, settings.seed)
        return to_frame(conform(frame, schema("pointings"), f"pointings/{survey}"))

    def _read_pointings(self, survey: str) -> pd.DataFrame:
        self._instrument(survey)
        stage = f"pointings/{survey}"
        if self.store is not None and read_record(self.store, stage, "all"):
            return to_frame(read_parquet(self.store.table(stage, "all")))
        return self.make_pointings(survey)

    def _instrument(self, survey: str) -> Instrument:
        return self._one(self.instruments, survey, tuple(self.instruments))

    def _one(self, mapping, name: str, valid: tuple[str, ...]):
        if name not in valid:
            raise UserError(f"{name!r}: this survey has {', '.join(valid)}")
        return mapping[name]

    def _once(self, kind: str, survey: str, make: Callable[[], Any]) -> Any:
        """Return a product, made at the first asking: with a store it reads what is there."""
        if (kind, survey) not in self._made:
            self._made[kind, survey] = self._stored(make())
        return self._made[kind, survey]

    def _stored(self, product):
        stored = getattr(product, "stored", None)
        return product if self.store is None or stored is None else stored(self.store)


class _MakePointings:
    """Makes the pointings of one instrument; holds the pipeline alone, so that it travels light."""

    def __init__(self, survey: SurveyProducts, name: str):
        self._pipeline, self._name = survey.pipeline, name

    def __call__(self, index: int) -> pd.DataFrame:
        return SurveyProducts(self._pipeline).make_pointings(self._name)


def _state(data: AnyPath, path: str | None):
    """Return what identifies the content of a source file without reading it."""
    if path is None:
        return None
    file = resolve_below(data, path)
    return (path, *file_state(file)) if file.is_file() else (path,)
