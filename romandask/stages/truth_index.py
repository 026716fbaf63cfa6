"""Truth index: position and flux of every object with light on an exposure, or the reason why it is not drawn."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd

from romandask.kernels.rendering.scene import OFF_IMAGE
from romandask.products.schemas import schema
from romandask.products.tables import TableProduct
from romandask.products.units import LazyUnits, Unit
from romandask.stages.exposures.exposures import Exposures, has_exposures
from romandask.stages.exposures.render import RenderExposure, View
from romandask.stages.stage import UNITS_FROM_POINTINGS, Stage


def truth_index(exposures: Exposures) -> TableProduct:
    """Return the lazy truth index of the exposures of an instrument (schema: catalogs/truth_index.yaml).

    There is one unit per exposure. It has the same settings and inputs as the exposure, and is made without rendering
    the exposure.
    """
    renderer = exposures.renderer

    def unit(row: int) -> Unit:
        return exposures.units[row]

    return TableProduct(
        stage=f"truth_index/{renderer.instrument.name}",
        units=LazyUnits(exposures.names, unit),
        make=MakeIndex(renderer),
        schema=schema("truth_index"),
        bytes_per_unit=int(np.prod(renderer.instrument.shape)) * 16 + (520 << 20),
        seconds_per_unit=0.9,
    )


@dataclass(frozen=True)
class MakeIndex:
    """Makes the truth index of one exposure."""

    render: RenderExposure
    """Finds the objects of an exposure."""

    def __call__(self, index: int) -> pd.DataFrame:
        """Return the truth index of the exposure in a row of the pointings table."""
        view = self.render.view(index)
        return index_of(view, self.render.instrument.bandpass(view.exposure.band).ab_photons())


def index_of(view: View, ab_photons: float) -> pd.DataFrame:
    """Return the truth index of one exposure.

    Parameters
    ----------
    view : View
        Scene of the exposure.
    ab_photons : float, 1/s
        Photon rate of a source of AB magnitude 0.
    """
    drawable, truth = view.drawable, view.truth
    n = len(drawable.reasons)
    reasons, flux, stamp = drawable.reasons.copy(), np.zeros(n), np.zeros(n, np.int32)
    stamp[drawable.rows] = np.where(view.shown, view.stamps.size, 0)
    reasons[drawable.rows[~view.shown]] = OFF_IMAGE
    drawn = stamp > 0
    total = np.zeros(n)
    total[drawable.rows] = drawable.scene.fluxes()
    flux[drawn] = total[drawn]
    with np.errstate(divide="ignore"):
        magnitude = np.where(drawn, -2.5 * np.log10(flux / view.exposure.exptime / ab_photons), np.nan)
    galaxies = len(truth.galaxies)
    frame = pd.DataFrame(
        {
            "id": np.r_[truth.galaxies["galaxy_id"].to_numpy(np.int64), truth.stars["id"].to_numpy(np.int64)],
            "kind": np.where(np.arange(n) < galaxies, "galaxy", "star"),
            "visit": view.exposure.visit,
            "detector": view.exposure.detector,
            "band": view.exposure.band,
            "x": drawable.x,
            "y": drawable.y,
            "flux": flux,
            "mag": magnitude,
            "stamp": stamp,
            "drawn": drawn,
            "reason": reasons,
        }
    )
    return frame[reasons != OFF_IMAGE].reset_index(drop=True)


TRUTH_INDEX = Stage(
    name="truth_index",
    per_survey=True,
    build=lambda context, survey: truth_index(context.output(f"exposures/{survey}")),
    exists=has_exposures,
    reads=("truth/galaxies", "truth/stars", "calibration", "psf_models"),
    units_known_after=UNITS_FROM_POINTINGS,
    unit="visit and detector",
    summary="Position, flux and magnitude of every object with light on an exposure, or why it is not drawn.",
    shrink_with="lower render.largest",
    tables={"truth_index": "truth_index/<survey>/"},
)
