"""Samples: the objects of each survey that the joint analysis counts, clean and above their completeness limit."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd

from romandask.kernels.measurement.counts import counts_limit
from romandask.kernels.measurement.extract import FLAGS
from romandask.model.errors import UserError
from romandask.model.settings import MatchSettings
from romandask.model.spectra import ab_magnitude
from romandask.pipeline import instrument_types
from romandask.products.schemas import schema
from romandask.products.tables import TableProduct
from romandask.products.units import LazyUnits, Unit
from romandask.stages.stage import UNITS_FROM_POINTINGS, Stage, SurveyContext

ALLOWED = FLAGS["deblended"] | FLAGS["kron_nonpositive"]
"""Flags that clean objects may have: of Source Extractor's 1 and 2, which Troxel et al. (2023) allow, sep has one; that
an aperture is the least one Source Extractor does not tell."""
EDGES = np.arange(16.0, 30.001, 0.1)
"""Bins of magnitude in which objects are counted for their limit."""


def limits(objects: TableProduct, matched: TableProduct, settings: MatchSettings, band: str) -> TableProduct:
    """Return the lazy limit of a survey's sample in its reference band (schema: catalogs/limits.yaml), one unit.

    It is where the counts of clean objects fall to 80% of a power law fitted over 21-26 mag (Troxel et al. 2023,
    section 6), unless the settings tell it; infinite for samples of all objects, and where there are too few to fit.
    """
    stage = f"limits/{objects.stage.split('/')[1]}"
    limit = (settings.limits or {}).get(band)
    state = {"sample": settings.sample, "limit": limit, "band": band, "flags": ALLOWED}
    told = np.inf if settings.sample == "all" else limit
    sources = () if told is not None else tuple((p.stage, name) for p in (objects, matched) for name in p.names)
    maker = _Limit(_Clean(objects, matched, (band,)), told, band)
    return TableProduct(
        stage=stage, units=(Unit("all", state, sources),), make=maker, schema=schema("limits"), bytes_per_unit=400 << 20
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

    Parameters
    ----------
    objects, matched, limit : objects, truth_match and limits of the survey
    bands, band : all of the survey, and the reference band, in which the limit holds

    A clean object has no flag but those allowed, a counterpart in the truth, and is not fainter than the limit,
    dereddened (Troxel et al. 2023, section 6).
    """
    state = {"sample": settings.sample, "bands": bands, "band": band, "flags": ALLOWED}
    tiles = set(matched.names)

    def unit(index: int) -> Unit:
        # an object's counterpart is in the table of its tile
        tables = tuple((matched.stage, name) for _, name in objects.units[index].inputs if name in tiles)
        return Unit(objects.names[index], state, ((objects.stage, objects.names[index]), *tables, (limit.stage, "all")))

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
    """The rows of an object table with dereddened magnitudes, counterparts, and whether they are clean."""

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
        known = pd.concat(tables) if tables else self.matched.empty()[["objectId", "truth_id", "star"]]
        frame = frame.merge(known, on="objectId", how="left", validate="one_to_one")
        frame["truth_id"] = frame["truth_id"].fillna(-1).astype(np.int64)
        frame["star"] = frame["star"].fillna(False).astype(bool)
        return frame.assign(clean=((frame["flags"] & ~ALLOWED) == 0) & (frame["truth_id"] >= 0))


@dataclass(frozen=True)
class _Limit:
    rows: _Clean
    told: float | None
    band: str

    def __call__(self, index: int) -> pd.DataFrame:
        limit, slope, counted = self.told, np.nan, 0
        if limit is None:
            counts = np.zeros(len(EDGES) - 1, np.int64)
            for k in range(len(self.rows.objects.units)):
                frame = self.rows(k)
                counts += np.histogram(frame.loc[frame["clean"], f"{self.band}_mag"], EDGES)[0]
            limit, slope = counts_limit(counts, EDGES)
            counted = int(counts.sum())
        return pd.DataFrame({"band": [self.band], "limit": [limit], "slope": [slope], "objects": [counted]})


@dataclass(frozen=True)
class _Sample:
    rows: _Clean
    limit: TableProduct
    sample: str
    band: str

    def __call__(self, index: int) -> pd.DataFrame:
        frame = self.rows(index)
        if self.sample == "all":
            return frame
        faintest = float(self.limit.load(0)["limit"].iloc[0])
        return frame[frame["clean"] & (frame[f"{self.band}_mag"] <= faintest)].reset_index(drop=True)


def build_limits(context: SurveyContext, survey: str) -> TableProduct:
    """Return the lazy magnitude limit of an instrument's sample.

    Raises
    ------
    UserError
        If `matches.limits` names a band that is no reference band.
    """
    settings = context.pipeline.matches
    bands = {instrument.reference_band for instrument in context.instruments.values()}
    # one pipeline's limits also serve its runs with a survey, or that band, left out
    usual = {kind.usual_reference_band for kind in instrument_types().values()}
    if unknown := set(settings.limits or {}) - bands - usual:
        raise UserError(f"matches.limits: {', '.join(sorted(unknown))}: they are those of {', '.join(sorted(bands))}")
    tables = context.output(f"objects/{survey}"), context.output(f"truth_match/{survey}")
    return limits(*tables, settings, context.instruments[survey].reference_band)


def build_samples(context: SurveyContext, survey: str) -> TableProduct:
    """Return the lazy sample of an instrument's objects."""
    instrument = context.instruments[survey]
    tables = (context.output(f"{stage}/{survey}") for stage in ("objects", "truth_match", "limits"))
    return samples(*tables, context.pipeline.matches, instrument.bands, instrument.reference_band)


LIMITS = Stage(
    name="limits",
    per_survey=True,
    build=build_limits,
    reads=("objects", "truth_match"),
    units_known_after=UNITS_FROM_POINTINGS,
    unit="survey",
    summary="The magnitude at which counts of clean objects fall to 80% of a power law.",
    tables={"limits": "limits/<survey>/"},
)
SAMPLES = Stage(
    name="samples",
    per_survey=True,
    build=build_samples,
    reads=("objects", "truth_match", "limits"),
    units_known_after=UNITS_FROM_POINTINGS,
    unit="HEALPix cell",
    summary="Clean objects to that limit, with dereddened magnitudes and their true counterparts.",
    sky=("coord_ra", "coord_dec"),
    shrink_with="raise detections.order",
    tables={"samples": "samples/<survey>/"},
)
