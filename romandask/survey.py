"""A survey: a pipeline and a store; its products by name, lazy, read where they are stored and made where not."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import dask.dataframe as dd
import numpy as np
import pandas as pd
import xarray as xr

from romandask.calibration import calibrations
from romandask.coadds import coadds
from romandask.cutouts import Positions, Wanted, cutouts, located
from romandask.detections import detections, objects
from romandask.exposures import exposures
from romandask.incoming import incoming, open_sources
from romandask.instruments.exposure import Instrument
from romandask.matches import Matches, matches
from romandask.model.errors import UserError
from romandask.model.sky import Cone, Region
from romandask.model.spectra import Bandpass
from romandask.model.tiles import Tile
from romandask.pipeline import Pipeline, load_pipeline
from romandask.pointings import pointings, visits
from romandask.psfs import psfs
from romandask.runtime.manifest import read_record
from romandask.runtime.products import ImageProduct, TableProduct, conform, to_frame
from romandask.runtime.schemas import schema
from romandask.runtime.store import Store, read_parquet
from romandask.runtime.units import Unit
from romandask.star import Spectrum, coadd_psf
from romandask.statistics import Statistics, matrix, statistics
from romandask.truth import TruthCatalogs, truth
from romandask.truth_index import truth_index
from romandask.truth_match import completeness, reference_band, truth_match, truth_summary
from romandask.zero_points import zero_points


class Survey:
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

    # ---- what users ask for

    def truth(self, kind: str, region: Region | Cone | None = None) -> dd.DataFrame:
        """Return the lazy truth catalog `galaxies` or `stars` (schema: catalogs/<kind>.yaml).

        With a region only the partitions that it touches are read, and only its rows are returned.
        """
        kinds = ("galaxies", "stars", "quarantine") if region is None else ("galaxies", "stars")
        product = self._one(vars(self.truth_catalogs), kind, kinds)
        return product.frame if region is None else product.within(region)

    def pointings(self, survey: str) -> pd.DataFrame:
        """Return the exposures of an instrument, one row a visit and detector."""
        return self._once("pointings", survey, lambda: self._read_pointings(survey))

    def visits(self, survey: str) -> pd.DataFrame:
        """Return all visits of an instrument's observing sequence, whether or not they touch the region."""
        settings = self.pipeline
        instrument = self._instrument(survey)
        return visits(instrument, getattr(settings, survey).pointings, self.data, self.region, settings.seed)

    def exposures(self, survey: str) -> xr.Dataset:
        """Return lazy exposures (exposure, y, x): image, truth, dq; coords visit, detector, band, mjd, header ...

        With roman.detector: sca also raw and variance, and the image is the calibrated one.
        """
        return self.exposure_product(survey).dataset

    def truth_index(self, survey: str) -> dd.DataFrame:
        """Return the lazy index of the objects on each exposure (schema: catalogs/truth_index.yaml)."""
        return self.truth_index_product(survey).frame

    def psfs(self, survey: str) -> xr.Dataset:
        """Return lazy PSF images (exposure, v, u): a unit star of flat f_nu, sampled 8 times finer than pixels."""
        return self.psf_product(survey).dataset

    def cutouts(
        self,
        of: Wanted,
        layers: str | Sequence[str] = ("image",),
        bands: str | Sequence[str] | None = None,
        size: int = 48,
        survey: str = "roman",
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
        found = located(of, self.tables(catalog), catalog)
        kinds = {"exposures": self.exposure_product, "coadds": self.coadd_product}
        product = self._one(kinds, images, tuple(kinds))(survey)
        layers, bands = ((names,) if isinstance(names, str) else names for names in (layers, bands))
        return cutouts(product, found, tuple(layers), None if bands is None else tuple(bands), size)

    def tables(self, catalog: str) -> tuple[Positions, ...]:
        """Return the tables that hold the objects of a catalog: truth, or an instrument's."""
        if catalog == "truth":
            truth = self.truth_catalogs
            return Positions(truth.galaxies, "galaxy_id", "ra", "dec"), Positions(truth.stars, "id", "ra", "dec")
        if catalog not in self.instruments:
            raise UserError(f"catalog {catalog!r}: this survey has truth, {', '.join(self.instruments)}")
        return (Positions(self.object_product(catalog), "objectId", "coord_ra", "coord_dec"),)

    def coadds(self, survey: str) -> xr.Dataset:
        """Return lazy coadds (tile, band, y, x): image, weight, noise, nimages, set, psf ...; coords tile, band, ..."""
        return self.coadd_product(survey).dataset

    def psf(
        self, ra: float, dec: float, band: str, stamp: int | None = None, scale: float | None = None,
        spectrum: Spectrum | None = None,
    ) -> xr.DataArray:  # fmt: skip
        """Return the image of a unit star (v, u) at a place of Roman's coadds: see `romandask.star.coadd_psf`.

        It is as the coadd has it there, or, with a scale, sampled every so many arcsec with the star in the middle.
        """
        return coadd_psf(self.coadd_product("roman"), ra, dec, band, stamp, scale, spectrum)

    def segmentation(self, survey: str) -> xr.Dataset:
        """Return the lazy maps of detected objects (tile, y, x): `segmentation`, the last 24 bits of objectId."""
        return self.detection_product(survey).dataset

    def truth_match(self, survey: str) -> dd.DataFrame:
        """Return the lazy true counterparts of a survey's objects (schema: catalogs/truth_match.yaml)."""
        return self.truth_match_product(survey).frame

    def truth_summary(self, survey: str) -> dd.DataFrame:
        """Return the lazy list of true objects, found or not (schema: catalogs/truth_summary.yaml)."""
        return self.truth_summary_product(survey).frame

    def completeness(self, survey: str) -> pd.DataFrame:
        """Return completeness and purity of a survey's objects by magnitude, in H158 of Roman or i of Rubin."""
        tables = self.truth_summary_product(survey), self.truth_match_product(survey)
        return completeness(*(table.all_rows() for table in tables), reference_band(self._instrument(survey)))

    def objects(self, survey: str) -> dd.DataFrame:
        """Return the lazy object table of a survey (schema: catalogs/objects.yaml)."""
        return self.object_product(survey).frame

    def matches(self) -> dd.DataFrame:
        """Return the lazy friends-of-friends groups of all objects (schema: catalogs/groups.yaml)."""
        return self.match_products.groups.frame

    @property
    def statistics(self) -> SurveyStatistics:
        """Statistics of the groups."""
        return SurveyStatistics(self.statistic_products, self.pipeline.matches.linking_lengths)

    def __repr__(self) -> str:
        place = self.store.root if self.store else "not stored"
        lines = [f"Survey {self.pipeline.name} ({place})"]
        if self.store:
            for folder in sorted((self.store.root / "manifest").glob("*/*")):
                stage = f"{folder.parent.name}/{folder.name}"
                paths = self.store.records(stage)
                records = [record for path in paths if (record := read_record(self.store, stage, path.stem))]
                size = sum(record.bytes for record in records)
                lines.append(f"  {stage:20s} {len(records):6d} units {size / 1e6:12.1f} MB")
        return "\n".join(lines)

    # ---- the products behind them

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
    def data(self) -> Path:
        """The folder that source files are below."""
        return Path(self.pipeline.data)

    @cached_property
    def incoming_product(self) -> TableProduct:
        """The rows of the source catalogs, where truth is not generated."""
        return self._stored(incoming(open_sources(self.pipeline.truth, self.data)))

    @cached_property
    def truth_catalogs(self) -> TruthCatalogs:
        """The truth catalogs."""
        settings = self.pipeline
        rows = None if settings.truth.source == "generate" else self.incoming_product
        return truth(settings.truth, self.data, self.region, self.bandpasses, settings.seed, self.store, rows)

    def pointing_product(self, survey: str) -> TableProduct:
        """The pointings as a product of one unit."""
        settings = self.pipeline
        block = getattr(settings, survey)
        state = {
            "settings": block.model_dump(), "region": settings.region.model_dump(), "seed": settings.seed,
            "coadds": settings.coadds.model_dump(exclude={"pixfrac"}),
            "source": _state(self.data, block.pointings.path),
        }  # fmt: skip
        return self._stored(
            TableProduct(
                f"pointings/{survey}",
                (Unit("all", state),),
                _MakePointings(self, survey),
                schema("pointings"),
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
                self.pointings(survey), self.truth_catalogs, instrument, settings.render, settings.seed,
                self.calibration_product if survey == "roman" and settings.calibration() else None, self.store,
            ),
        )  # fmt: skip

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
        tables = self.truth_summary_product(survey), self.truth_match_product(survey)
        return self._once("zero_points", survey, lambda: zero_points(*tables, self.detection_product(survey), bands))

    def object_product(self, survey: str) -> TableProduct:
        """The object table."""
        found, settings = self.detection_product(survey), self.pipeline.detections
        zero, tiles = self.zero_points_product(survey), self.coadd_product(survey)
        return self._once("objects", survey, lambda: objects(found, tiles, settings, self.region, zero))

    @property
    def match_products(self) -> Matches:
        """The stages of friends of friends."""
        tables = {name: self.object_product(name) for name in self.instruments}
        return self._once("matches", "all", lambda: matches(tables, self.pipeline.matches, self.region, self.store))

    @property
    def statistic_products(self) -> Statistics:
        """The tables of the statistics stage."""
        made = statistics(
            self.match_products.groups, self.object_product("rubin"), self.pipeline.matches.linking_lengths
        )
        return Statistics(self._stored(made.blends), self._stored(made.unrecognised))

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
        table = self._products.unrecognised.all_rows()
        return table[np.isclose(table["linking_length"], self._length(linking_length))].reset_index(drop=True)

    def _length(self, length: float | None) -> float:
        length = self._lengths[0] if length is None else length
        if not np.isclose(length, self._lengths).any():
            raise UserError(f"linking length {length}: this survey has {', '.join(map(str, self._lengths))} arcsec")
        return length


class _MakePointings:
    """Makes the pointings of one instrument; holds the pipeline alone, so that it travels light."""

    def __init__(self, survey: Survey, name: str):
        self._pipeline, self._name = survey.pipeline, name

    def __call__(self, index: int) -> pd.DataFrame:
        return Survey(self._pipeline).make_pointings(self._name)


def _state(data: Path, path: str | None):
    """Return what identifies the content of a source file without reading it."""
    if path is None:
        return None
    file = data / path
    return (path, file.stat().st_size, file.stat().st_mtime_ns) if file.is_file() else (path,)


def open_survey(path: str | Path) -> Survey:
    """Open a stored survey.

    Raises
    ------
    UserError
        If the folder is not a store.
    """
    store = Store(Path(path).resolve())
    if not store.pipeline.is_file():
        raise UserError(f"{path}: not a romandask store (it has no pipeline.yaml); make one with romandask run")
    return Survey(load_pipeline(store.pipeline), store)
