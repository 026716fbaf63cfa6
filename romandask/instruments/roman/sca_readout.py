"""How an SCA turns light into an exposure, with the calibrations of its product and what earlier exposures left.

Exposures of one SCA follow one another: charge that one leaves in traps comes out in those after it. What each leaves
is written with it, a small table, and depends on nothing that was there before (of trapped charge a thousandth would be
trapped again), so that an exposure needs those tables alone and none is drawn twice.
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
from romandask.instruments.instrument import Instrument, Light
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
"""Seconds."""


def before(table: pd.DataFrame, index: int) -> np.ndarray:
    """Return the rows of a pointings table whose afterglow is in the exposure of a row, in order of time.

    They are those of the same detector that ended within MEMORY exposure times before it began.
    """
    start, exptime = table["mjd"].to_numpy(float) * DAY, table["exptime"].to_numpy(float)
    gap = start[index] - start - exptime
    same = table["detector"].to_numpy() == table["detector"].iat[index]
    found = np.flatnonzero(same & (start < start[index]) & (gap <= MEMORY * exptime[index]))
    return found[np.argsort(start[found], kind="stable")]


def age(earlier: Exposure, later: Exposure) -> float:
    """Return the seconds from the end of an exposure to the middle of a later one, a second in the least."""
    return max((later.mjd - earlier.mjd) * DAY + later.exptime / 2 - earlier.exptime, 1.0)


def age_and_traps(exposure: Exposure, left: Sequence[tuple[Exposure, pd.DataFrame]]) -> list[tuple[Trapped, float]]:
    """Return what exposures before one left, each with its age (s) in the middle of that one."""
    return [
        (Trapped(table["pixel"].to_numpy(), table["charge"].to_numpy()), age(earlier, exposure))
        for earlier, table in left
    ]


def trapped_table(charge: np.ndarray, planes: Planes) -> pd.DataFrame:
    """Return what stays in traps of a charge (4096, 4096), electrons (schema: catalogs/trapped.yaml)."""
    return pd.DataFrame(vars(trap(charge, planes)))


@dataclass(frozen=True)
class ScaReadout:
    """Reads out exposures with every effect of their SCA."""

    instrument: Instrument
    calibration: ImageProduct
    """What `calibrations()` returned."""
    seed: int
    cosmic_rays: bool
    seconds_per_pixel: float = 7e-7

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
        """Charge that stays in traps."""
        return {"trapped": schema("trapped")}

    @property
    def settings(self) -> dict[str, Any]:
        """Whether there are cosmic rays."""
        return {"cosmic_rays": self.cosmic_rays}

    def earlier(self, table: pd.DataFrame, row: int) -> np.ndarray:
        """Return the rows of the exposures of the same SCA whose afterglow an exposure has, in order of time."""
        return before(table, row)

    def inputs(self, exposure: Exposure) -> tuple[tuple[str, str], ...]:
        """Return the calibration of the exposure's SCA."""
        return ((self.calibration.stage, self.calibration.names[self.unit(exposure)]),)

    def leave(self, light: Light) -> pd.DataFrame:
        """Return the charge that an exposure leaves in traps: it depends on its own light alone."""
        planes = self.planes(light.exposure)
        electrons, response = light.expected() + light.background, self.response(light.exposure, planes)
        return trapped_table(self.charge(light.exposure, electrons, planes, response)[0], planes)

    def __call__(self, light: Light, left: Sequence[tuple[Exposure, pd.DataFrame]]) -> dict[str, Any]:
        """Return raw, image, truth, variance, dq and the table of trapped charge of an exposure."""
        expected = light.expected()
        return {**self.read(light.exposure, expected + light.background, left), "truth": expected}

    def unit(self, exposure: Exposure) -> int:
        """Return the number of an exposure's SCA in the calibrations."""
        return self.calibration.names.index(unit_name(exposure.detector))

    def charge(
        self, exposure: Exposure, light: np.ndarray, planes: Planes, response: Response
    ) -> tuple[np.ndarray, np.ndarray | None]:
        """Return what light (electrons) leaves in the pixels, and what of it is cosmic rays' (both (4096, 4096))."""
        rays = self.rays(exposure)
        return accumulate(light, planes, response, partial(self.random, exposure), rays), rays

    def rays(self, exposure: Exposure) -> np.ndarray | None:
        """Return the electrons (4096, 4096) of cosmic rays; None where there are to be none."""
        if not self.cosmic_rays:
            return None
        return hits(
            SCA_SHAPE,
            tracks(SCA_SHAPE, exposure.exptime, self.random(exposure, "rays", 0)),
        )

    def read(
        self, exposure: Exposure, light: np.ndarray, left: Sequence[tuple[Exposure, pd.DataFrame]]
    ) -> dict[str, Any]:
        """Return raw, image, variance, dq and the table of trapped charge of an exposure.

        Parameters
        ----------
        light : (4088, 4088) expected electrons of objects, sky and thermal emission
        left : exposures before it and what they left
        """
        planes = self.planes(exposure)
        response = self.response(exposure, planes)
        charge, rays = self.charge(exposure, light, planes, response)
        late = afterglow(age_and_traps(exposure, left))
        trapped = trapped_table(charge, planes)
        raw, dq = read_out(charge, planes, response, partial(self.random, exposure), late, rays)
        del charge, rays, late
        image, variance = calibrate(raw, planes, response)
        return {"raw": raw, "image": image, "variance": variance, "dq": dq, "trapped": trapped}

    def planes(self, exposure: Exposure) -> Planes:
        """Return the calibrations of an exposure's SCA, some rows at a time."""
        product, index = self.calibration, self.unit(exposure)
        axes = {variable.name: variable.axes for variable in product.variables}
        if not product.has(index):
            whole = _made(product.make, index)

            def of_whole(name: str, rows: slice) -> np.ndarray:
                return whole[name][..., rows, :] if axes[name][-1] == "x" else whole[name]

            return of_whole

        # what is asked for a few rows at a time, in their order, is read as it is stored
        read = product.reader(index)
        last: dict[str, tuple[int, np.ndarray]] = {}

        def of_store(name: str, rows: slice) -> np.ndarray:
            if axes[name][-1] != "x":
                if name not in last:
                    last[name] = 0, read(name, ())
                return last[name][1]
            everything = slice(None)
            if rows == slice(None) or rows.start // ROWS_A_FILE != (rows.stop - 1) // ROWS_A_FILE:
                return read(name, (rows, everything))
            part = rows.start // ROWS_A_FILE
            if name not in last or last[name][0] != part:
                last.pop(name, None)
                last[name] = part, read(name, (slice(part * ROWS_A_FILE, (part + 1) * ROWS_A_FILE), everything))
            first = part * ROWS_A_FILE
            return last[name][1][..., rows.start - first : rows.stop - first, :]

        return of_store

    def response(self, exposure: Exposure, planes: Planes) -> Response:
        """Return how an SCA answers the light of a band: means over its photons of a flat spectrum."""
        band = self.instrument.bandpass(exposure.band)
        efficiency, electrons = (
            band_mean(planes(name, slice(None)), WAVES, band.wave, band.weights / band.wave).astype(np.float32)
            for name in ("RELQE2", "QYIELD")
        )
        return Response(efficiency, electrons, exposure.exptime)

    def random(self, exposure: Exposure, step: str, block: int) -> np.random.Generator:
        """Return the random generator of a step and block of rows of an exposure."""
        name = self.instrument.name
        return rng(self.seed, "exposures", name, exposure.visit, exposure.detector, step, block)


@lru_cache(maxsize=1)
def _made(make: Callable[[int], dict[str, Any]], index: int) -> dict[str, np.ndarray]:
    """Return the calibrations of an SCA that are not stored: long in the making, so kept until the next SCA's."""
    return make(index)
