"""Readout of Roman's SCAs with the full detector model: calibrations, and persistence of earlier exposures.

Charge that an exposure leaves in traps is released in later exposures of the same SCA. Each exposure stores a small
table of this charge. The table depends only on the light of that exposure: charge from earlier exposures that would be
trapped again, about a thousandth, is neglected. An exposure therefore needs only the tables of earlier exposures, and
no exposure is drawn twice.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa

from romandask.instruments.exposure import Exposure
from romandask.instruments.instrument import Instrument
from romandask.instruments.readout import Light
from romandask.instruments.roman.calibration import unit_name
from romandask.kernels.detectors.cosmic_rays import hits, tracks
from romandask.kernels.detectors.sca import MEMORY, band_mean
from romandask.kernels.detectors.sca_exposure import (
    FLAGS,
    Planes,
    Response,
    Trapped,
    accumulate,
    afterglow,
    calibrate,
    read_out,
    trap,
)
from romandask.kernels.detectors.simple_detector import DQ_FLAGS
from romandask.kernels.detectors.synthetic_sca import SCA_SHAPE, WAVES
from romandask.model.seeds import rng
from romandask.products.images import ImageProduct
from romandask.products.schemas import schema
from romandask.storage.arrays import ROWS_A_FILE, Variable

DAY = 86400.0
"""One day, seconds."""


def before(table: pd.DataFrame, index: int) -> np.ndarray:
    """Return the earlier exposures whose persistence is simulated in an exposure.

    They are the exposures of the same detector that ended at most MEMORY exposure times before the exposure begins.

    Parameters
    ----------
    table : DataFrame
        Pointings (schema: catalogs/pointings.yaml).
    index : int
        Row of the exposure.

    Returns
    -------
    ndarray of int
        Rows of the earlier exposures, in order of time.
    """
    start, exptime = table["mjd"].to_numpy(float) * DAY, table["exptime"].to_numpy(float)
    gap = start[index] - start - exptime
    same = table["detector"].to_numpy() == table["detector"].iat[index]
    rows = np.flatnonzero(same & (start < start[index]) & (gap <= MEMORY * exptime[index]))
    return rows[np.argsort(start[rows], kind="stable")]


def age(earlier: Exposure, later: Exposure) -> float:
    """Return the time from the end of an exposure to the middle of a later one, seconds, at least one second."""
    return max((later.mjd - earlier.mjd) * DAY + later.exptime / 2 - earlier.exptime, 1.0)


def age_and_traps(exposure: Exposure, left: Sequence[tuple[Exposure, pd.DataFrame]]) -> list[tuple[Trapped, float]]:
    """Return the trapped charge of earlier exposures, each with its `age` in an exposure, seconds.

    Parameters
    ----------
    exposure : Exposure
        The exposure in which the charge is released.
    left : sequence of (Exposure, DataFrame)
        Earlier exposures, each with its table of trapped charge.
    """
    return [
        (Trapped(table["pixel"].to_numpy(), table["charge"].to_numpy()), age(earlier, exposure))
        for earlier, table in left
    ]


def trapped_table(charge: np.ndarray, planes: Planes) -> pd.DataFrame:
    """Return the trapped part of a charge (4096, 4096), electrons, as a table (schema: catalogs/trapped.yaml)."""
    return pd.DataFrame(vars(trap(charge, planes)))


@dataclass(frozen=True, kw_only=True)
class ScaReadout:
    """Readout of Roman's SCAs with all detector effects; implements `Readout`."""

    instrument: Instrument
    """The instrument Roman."""
    calibration: ImageProduct
    """Calibrations of the SCAs, from `calibration.calibrations`."""
    seed: int
    """Seed of the survey."""
    cosmic_rays: bool
    """True to add cosmic rays."""
    seconds_per_pixel: float = 7e-7
    draws_parts: bool = False

    @property
    def variables(self) -> tuple[Variable, ...]:
        """The calibrated image, its data quality and variance, and the raw data numbers."""
        shape, axes, bits = self.instrument.shape, ("y", "x"), {**DQ_FLAGS, **FLAGS}
        masks = {"long_name": "data quality", "flag_masks": list(bits.values()), "flag_meanings": " ".join(bits)}
        electrons = {"units": "electron", "long_name": "calibrated image, sky included"}
        return (
            Variable("image", "float32", shape, axes, electrons),
            Variable("dq", "uint16", shape, axes, masks),
            Variable("raw", "uint16", shape, axes, {"units": "DN", "long_name": "what was read"}),
            Variable("variance", "float32", shape, axes, {"units": "electron2", "long_name": "variance of the image"}),
        )

    @property
    def tables(self) -> dict[str, pa.Schema]:
        """Table of the charge that stays in traps."""
        return {"trapped": schema("trapped")}

    @property
    def settings(self) -> dict[str, Any]:
        """Whether cosmic rays are added."""
        return {"cosmic_rays": self.cosmic_rays}

    def earlier(self, table: pd.DataFrame, row: int) -> np.ndarray:
        """Return the rows of the earlier exposures with persistence in an exposure; see `before`."""
        return before(table, row)

    def inputs(self, exposure: Exposure) -> tuple[tuple[str, str], ...]:
        """Return the unit of the calibration of an exposure's SCA."""
        return ((self.calibration.stage, self.calibration.names[self.unit(exposure)]),)

    def leave(self, light: Light) -> pd.DataFrame:
        """Return the table of the charge that an exposure leaves in traps; it depends only on the light given."""
        planes = self.planes(light.exposure)
        electrons, response = light.expected() + light.background, self.response(light.exposure, planes)
        return trapped_table(self.charge(light.exposure, electrons, planes, response)[0], planes)

    def __call__(self, light: Light, left: Sequence[tuple[Exposure, pd.DataFrame]]) -> dict[str, Any]:
        """Return raw, image, truth, variance, dq and the table `trapped` of an exposure."""
        expected = light.expected()
        return {**self.read(light.exposure, expected + light.background, left), "truth": expected}

    def unit(self, exposure: Exposure) -> int:
        """Return the index of the calibration unit of an exposure's SCA."""
        return self.calibration.names.index(unit_name(exposure.detector))

    def charge(
        self, exposure: Exposure, light: np.ndarray, planes: Planes, response: Response
    ) -> tuple[np.ndarray, np.ndarray | None]:
        """Return the charge in the pixels before readout, and the part of it from cosmic rays.

        Parameters
        ----------
        exposure : Exposure
            The exposure.
        light : ndarray, shape (4088, 4088), electrons
            Expected electrons of objects, sky and thermal emission.
        planes : Planes
            Calibrations of the SCA.
        response : Response
            Response of the SCA in the band.

        Returns
        -------
        charge : ndarray, shape (4096, 4096), electrons
        rays : ndarray, shape (4096, 4096), electrons, or None
            None without cosmic rays.
        """
        rays = self.rays(exposure)
        return accumulate(light, planes, response, partial(self.random, exposure), rays), rays

    def rays(self, exposure: Exposure) -> np.ndarray | None:
        """Return the electrons (4096, 4096) of cosmic rays; None without cosmic rays."""
        if not self.cosmic_rays:
            return None
        return hits(SCA_SHAPE, tracks(SCA_SHAPE, exposure.exptime, self.random(exposure, "rays", 0)))

    def read(
        self, exposure: Exposure, light: np.ndarray, left: Sequence[tuple[Exposure, pd.DataFrame]]
    ) -> dict[str, Any]:
        """Return raw, image, variance, dq and the table `trapped` of an exposure.

        Parameters
        ----------
        exposure : Exposure
            The exposure.
        light : ndarray, shape (4088, 4088), electrons
            Expected electrons of objects, sky and thermal emission.
        left : sequence of (Exposure, DataFrame)
            Earlier exposures, each with its table of trapped charge.
        """
        planes = self.planes(exposure)
        response = self.response(exposure, planes)
        charge, rays = self.charge(exposure, light, planes, response)
        persistence = afterglow(age_and_traps(exposure, left))
        trapped = trapped_table(charge, planes)
        raw, dq = read_out(charge, planes, response, partial(self.random, exposure), persistence, rays)
        # free the memory before the calibration
        del charge, rays, persistence
        image, variance = calibrate(raw, planes, response)
        return {"raw": raw, "image": image, "variance": variance, "dq": dq, "trapped": trapped}

    def planes(self, exposure: Exposure) -> Planes:
        """Return the function that reads rows of the calibrations of an exposure's SCA."""
        product, index = self.calibration, self.unit(exposure)
        axes = {variable.name: variable.axes for variable in product.variables}
        if not product.has(index):
            made = _made(product.make, index)

            def made_rows(name: str, rows: slice) -> np.ndarray:
                return made[name][..., rows, :] if axes[name][-1] == "x" else made[name]

            return made_rows

        # rows are requested a few at a time in increasing order: the rows of the last file are kept for each array,
        # with the number of the file
        read = product.reader(index)
        kept: dict[str, tuple[int, np.ndarray]] = {}

        def stored_rows(name: str, rows: slice) -> np.ndarray:
            if axes[name][-1] != "x":
                if name not in kept:
                    kept[name] = 0, read(name, ())
                return kept[name][1]
            all_columns = slice(None)
            if rows == slice(None) or rows.start // ROWS_A_FILE != (rows.stop - 1) // ROWS_A_FILE:
                return read(name, (rows, all_columns))
            file = rows.start // ROWS_A_FILE
            first = file * ROWS_A_FILE
            if name not in kept or kept[name][0] != file:
                # free the memory before reading
                kept.pop(name, None)
                kept[name] = file, read(name, (slice(first, first + ROWS_A_FILE), all_columns))
            return kept[name][1][..., rows.start - first : rows.stop - first, :]

        return stored_rows

    def response(self, exposure: Exposure, planes: Planes) -> Response:
        """Return the response of an SCA in the band of an exposure, averaged over the photons of a flat f_nu spectrum.

        A source of flat f_nu has a photon density proportional to 1 / wavelength.
        """
        band = self.instrument.bandpass(exposure.band)
        efficiency, electrons = (
            band_mean(planes(name, slice(None)), WAVES, band.wave, band.weights / band.wave).astype(np.float32)
            for name in ("RELQE2", "QYIELD")
        )
        return Response(efficiency, electrons, exposure.exptime)

    def random(self, exposure: Exposure, step: str, block: int) -> np.random.Generator:
        """Return the random generator of a block of rows in a step of an exposure."""
        name = self.instrument.name
        return rng(self.seed, "exposures", name, exposure.visit, exposure.detector, step, block)


@lru_cache(maxsize=1)
def _made(make: Callable[[int], dict[str, Any]], index: int) -> dict[str, np.ndarray]:
    """Return the calibrations of an SCA that are not stored; cached, because they take long to make."""
    return make(index)
