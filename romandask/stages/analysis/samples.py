"""Samples: the clean objects of each survey, down to its completeness limit, that the joint analysis uses."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import pandas as pd

from romandask.kernels.measurement.counts import counts_limit
from romandask.kernels.measurement.detected_objects import FLAGS
from romandask.model.errors import UserError
from romandask.model.settings import MatchSettings
from romandask.model.spectra import ab_magnitude
from romandask.model.tiles import PatchGrid
from romandask.pipeline import instrument_types
from romandask.products.schemas import schema
from romandask.products.tables import TableProduct
from romandask.products.units import LazyUnits, Unit
from romandask.stages.stage import UNITS_FROM_POINTINGS, Stage, SurveyContext

ALLOWED = FLAGS["deblended"] | FLAGS["kron_nonpositive"]
"""Flags that clean objects may have. Troxel et al. (2023) allow the flags 1 and 2 of Source Extractor, of which sep has
one. `kron_nonpositive` is allowed because Source Extractor does not flag an aperture of the smallest size."""
EDGES = np.arange(16.0, 30.001, 0.1)
"""Edges of the magnitude bins in which objects are counted to find the limit."""


def limits(objects: TableProduct, matched: TableProduct, settings: MatchSettings, band: str) -> TableProduct:
    """Return the lazy magnitude limit of a survey's sample (schema: catalogs/limits.yaml), one unit.

    The limit is the magnitude at which the counts of clean objects fall to 80% of a power law fitted over 21-26 mag
    (Troxel et al. 2023, section 6). `matches.limits` overrides it. It is infinite for samples of all objects, and if
    there are too few objects for a fit.

    Parameters
    ----------
    objects : TableProduct
        Object table of the survey.
    matched : TableProduct
        True counterparts of the objects (schema: catalogs/truth_match.yaml).
    settings : MatchSettings
        Section `matches` of the pipeline.
    band : str
        Reference band, in which the limit holds.
    """
    stage = f"limits/{objects.stage.split('/')[1]}"
    override = (settings.limits or {}).get(band)
    unit_settings = {"sample": settings.sample, "limit": override, "band": band, "flags": ALLOWED}
    fixed_limit = np.inf if settings.sample == "all" else override
    sources = () if fixed_limit is not None else tuple((p.stage, name) for p in (objects, matched) for name in p.names)
    return TableProduct(
        stage=stage,
        units=(Unit("all", unit_settings, sources),),
        make=_Limit(_Clean(objects, matched, (band,)), fixed_limit, band),
        schema=schema("limits"),
        bytes_per_unit=400 << 20,
    )


def samples(
    objects: TableProduct,
    matched: TableProduct,
    limit: TableProduct,
    settings: MatchSettings,
    bands: tuple[str, ...],
    band: str,
) -> TableProduct:
    """Return the lazy sample of a survey's objects (schema: catalogs/samples.yaml), a HATS catalog.

    An object is clean if it has no flags but those in `ALLOWED` and has a true counterpart. The sample contains the
    clean objects whose dereddened magnitude is not fainter than the limit (Troxel et al. 2023, section 6). If
    `matches.sample` is `all`, it contains every object.

    Parameters
    ----------
    objects : TableProduct
        Object table of the survey.
    matched : TableProduct
        True counterparts of the objects (schema: catalogs/truth_match.yaml).
    limit : TableProduct
        Magnitude limit (schema: catalogs/limits.yaml).
    settings : MatchSettings
        Section `matches` of the pipeline.
    bands : tuple of str
        Bands of the survey.
    band : str
        Reference band, in which the limit holds.
    """
    unit_settings = {"sample": settings.sample, "bands": bands, "band": band, "flags": ALLOWED}
    tiles = set(matched.names)

    def unit(index: int) -> Unit:
        # the counterpart of an object is in the truth_match table of its tile
        names = dict.fromkeys(PatchGrid.image_of(name) for _, name in objects.units[index].inputs)
        tables = tuple((matched.stage, name) for name in names if name in tiles)
        return Unit(
            objects.names[index], unit_settings, ((objects.stage, objects.names[index]), *tables, (limit.stage, "all"))
        )

    return TableProduct(
        stage=f"samples/{objects.stage.split('/')[1]}",
        units=LazyUnits(objects.names, unit),
        make=_Sample(_Clean(objects, matched, bands), limit, settings.sample, band),
        schema=schema("samples", bands),
        pixels=objects.pixels,
        order=objects.order,
        bytes_per_unit=objects.bytes_per_unit,
    )


@dataclass(frozen=True)
class _Clean:
    """Returns the objects of a partition with dereddened magnitudes, true counterparts and whether they are clean."""

    objects: TableProduct
    matched: TableProduct
    bands: tuple[str, ...]

    def __call__(self, index: int) -> pd.DataFrame:
        fluxes = [f"{band}_{name}" for band in self.bands for name in ("kronFlux", "extinction")]
        columns = ["_healpix_29", "objectId", "coord_ra", "coord_dec", "tile", "flags", "half_light_radius"]
        frame = self.objects.select(index, [*columns, "extendedness", *fluxes])
        for band in self.bands:
            magnitude = ab_magnitude(frame[f"{band}_kronFlux"])
            frame[f"{band}_mag"] = magnitude - np.nan_to_num(frame[f"{band}_extinction"].to_numpy(float))
        tables = [
            self.matched.select(k, ["objectId", "truth_id", "star"])
            for k in map(self.matched.names.index, frame["tile"].unique())
        ]
        counterparts = pd.concat(tables) if tables else self.matched.empty()[["objectId", "truth_id", "star"]]
        frame = frame.merge(counterparts, on="objectId", how="left", validate="one_to_one")
        frame["truth_id"] = frame["truth_id"].fillna(-1).astype(np.int64)
        frame["star"] = frame["star"].fillna(False).astype(bool)
        return frame.assign(clean=((frame["flags"] & ~ALLOWED) == 0) & (frame["truth_id"] >= 0))


@dataclass(frozen=True)
class _Limit:
    """Makes the magnitude limit of a survey."""

    clean: _Clean
    fixed_limit: float | None
    """Limit, mag; None if it is measured."""
    band: str

    def __call__(self, index: int) -> pd.DataFrame:
        limit, slope, counted = self.fixed_limit, np.nan, 0
        if limit is None:
            counts = np.zeros(len(EDGES) - 1, np.int64)
            for k in range(len(self.clean.objects.units)):
                frame = self.clean(k)
                counts += np.histogram(frame.loc[frame["clean"], f"{self.band}_mag"], EDGES)[0]
            limit, slope = counts_limit(counts, EDGES)
            counted = int(counts.sum())
        return pd.DataFrame({"band": [self.band], "limit": [limit], "slope": [slope], "objects": [counted]})


@dataclass(frozen=True)
class _Sample:
    """Makes one partition of a sample."""

    clean: _Clean
    limit: TableProduct
    sample: Literal["clean", "all"]
    band: str

    def __call__(self, index: int) -> pd.DataFrame:
        frame = self.clean(index)
        if self.sample == "all":
            return frame
        faintest = float(self.limit.load(0)["limit"].iloc[0])
        return frame[frame["clean"] & (frame[f"{self.band}_mag"] <= faintest)].reset_index(drop=True)


def build_limits(context: SurveyContext, survey: str) -> TableProduct:
    """Return the lazy magnitude limit of a survey's sample (the `build` of the stage).

    Raises
    ------
    UserError
        If `matches.limits` names a band that is not a reference band.
    """
    settings = context.pipeline.matches
    bands = {instrument.reference_band for instrument in context.instruments.values()}
    # also allow the usual reference bands, so that the limits of a pipeline hold for runs without a survey or band
    usual = {settings_type.usual_reference_band for settings_type in instrument_types().values()}
    if unknown := set(settings.limits or {}) - bands - usual:
        raise UserError(f"matches.limits: {', '.join(sorted(unknown))}: they are those of {', '.join(sorted(bands))}")
    tables = context.output(f"objects/{survey}"), context.output(f"truth_match/{survey}")
    return limits(*tables, settings, context.instruments[survey].reference_band)


def build_samples(context: SurveyContext, survey: str) -> TableProduct:
    """Return the lazy sample of a survey's objects (the `build` of the stage)."""
    instrument = context.instruments[survey]
    return samples(
        context.output(f"objects/{survey}"),
        context.output(f"truth_match/{survey}"),
        context.output(f"limits/{survey}"),
        context.pipeline.matches,
        instrument.bands,
        instrument.reference_band,
    )


LIMITS = Stage(
    name="limits",
    per_survey=True,
    build=build_limits,
    reads=("objects", "truth_match"),
    units_known_after=UNITS_FROM_POINTINGS,
    unit="survey",
    summary="The magnitude in the reference band at which the counts of clean objects fall to 80% of a power law.",
    tables={"limits": "limits/<survey>/"},
)
SAMPLES = Stage(
    name="samples",
    per_survey=True,
    build=build_samples,
    reads=("objects", "truth_match", "limits"),
    units_known_after=UNITS_FROM_POINTINGS,
    unit="HEALPix cell",
    summary="The clean objects down to the magnitude limit, with dereddened magnitudes and true counterparts.",
    sky=("coord_ra", "coord_dec"),
    shrink_with="raise detections.order",
    tables={"samples": "samples/<survey>/"},
)
