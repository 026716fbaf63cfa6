"""How a CCD of Rubin's camera turns light into an exposure: photons, charge that overflows, amplifiers, calibration."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa

from romandask.instruments.exposure import Exposure
from romandask.instruments.instrument import Instrument, Light
from romandask.kernels.detectors.ccd import (
    CCD_FLAGS,
    COSMIC_RAY,
    COSMIC_RAY_THRESHOLD,
    RAYS,
    ROWS,
    Amplifiers,
    amplifiers,
    bleed,
    calibrate,
    read_out,
)
from romandask.kernels.detectors.cosmic_rays import hits, tracks
from romandask.kernels.detectors.poisson import poisson
from romandask.kernels.detectors.simple_detector import SATURATED
from romandask.kernels.rendering.silicon import MIN_ELECTRONS, through_silicon
from romandask.model.seeds import rng
from romandask.storage.arrays import Variable


@dataclass(frozen=True)
class CcdReadout:
    """Reads out exposures of Rubin's CCDs."""

    instrument: Instrument
    seed: int
    cosmic_rays: bool
    sensor: str
    """`ideal`; or `silicon`: bright objects go photon by photon through GalSim's model of the CCD."""
    seconds_per_pixel: float = 7e-7

    @property
    def tables(self) -> dict[str, pa.Schema]:
        """No tables."""
        return {}

    @property
    def settings(self) -> dict[str, Any]:
        """The model of the sensor, and whether there are cosmic rays."""
        return {"sensor": self.sensor, "cosmic_rays": self.cosmic_rays}

    def earlier(self, table: pd.DataFrame, row: int) -> np.ndarray:
        """Return no rows: the detector keeps nothing from one exposure to the next."""
        return np.empty(0, int)

    def inputs(self, exposure: Exposure) -> tuple[tuple[str, str], ...]:
        """Return no units: amplifiers are made up from the seed."""
        return ()

    def leave(self, light: Light) -> pd.DataFrame:
        """Raise NotImplementedError: nothing is left."""
        raise NotImplementedError("a CCD leaves nothing to later exposures")

    def __call__(self, light: Light, left: Sequence[tuple[Exposure, pd.DataFrame]]) -> dict[str, Any]:
        """Return raw, image, truth, variance and dq of an exposure, bright objects through the silicon if asked for."""
        exposure, scene, sizes = light.exposure, light.scene, light.stamp_sizes
        bright = (scene.fluxes() >= MIN_ELECTRONS) & (sizes > 0)
        if self.sensor == "ideal" or not bright.any():
            expected = light.expected()
            return {**self.read(exposure, expected, light.background, None), "truth": expected}
        faint, shining = light.expected(~bright), light.expected(bright)

        def seed(n: int) -> int:
            return int(self.random(exposure, "photons", int(scene.key[n])).integers(1, 1 << 31))

        caught = through_silicon(
            scene,
            np.flatnonzero(bright),
            sizes,
            light.profiles,
            self.instrument.bandpass(exposure.band).nodes,
            self.instrument.shape,
            self.instrument.pixel_scale,
            seed,
        )
        return {**self.read(exposure, faint, light.background, caught), "truth": faint + shining}

    def amplifiers(self, detector: int) -> Amplifiers:
        """Return the amplifiers of a detector: the same in all its exposures."""
        constants = self.instrument.detector
        random = rng(self.seed, "exposures", self.instrument.name, "amplifiers", detector)
        return amplifiers(random, constants.read_noise, constants.saturation)

    def read(
        self, exposure: Exposure, light: np.ndarray, background: np.ndarray, caught: np.ndarray | None
    ) -> dict[str, np.ndarray]:
        """Return raw, image, variance and dq of an exposure.

        Parameters
        ----------
        light : (ny, nx) expected electrons of objects
        background : (ny, nx) expected electrons of sky and dark current
        caught : (ny, nx) electrons of the objects that went through the silicon; None where all are in `light`
        """
        charge = np.empty(light.shape, np.float32)
        for block, first in enumerate(range(0, len(light), ROWS)):
            rows = slice(first, first + ROWS)
            mean = np.maximum(light[rows] + background[rows], 0)
            charge[rows] = poisson(mean, self.random(exposure, "light", block))
        if caught is not None:
            charge += caught
        dq = np.zeros(charge.shape, np.uint16)
        if self.cosmic_rays:
            rays = hits(charge.shape, tracks(charge.shape, exposure.exptime, self.random(exposure, "rays"), **RAYS))
            charge += rays
            dq[rays > COSMIC_RAY_THRESHOLD] = COSMIC_RAY
            del rays
        chips = self.amplifiers(exposure.detector)
        charge, full = bleed(charge, chips)
        dq[full] |= SATURATED
        raw = read_out(charge, chips, lambda block: self.random(exposure, "read", block))
        image, variance = calibrate(raw, chips)
        return {"raw": raw, "image": image, "variance": variance, "dq": dq}

    def random(self, exposure: Exposure, *step: str | int) -> np.random.Generator:
        """Return the random generator of a step, and block of rows, of an exposure."""
        return rng(self.seed, "exposures", self.instrument.name, exposure.visit, exposure.detector, *step)

    @property
    def variables(self) -> tuple[Variable, ...]:
        """The arrays of an exposure beside the noiseless image."""
        shape, axes = self.instrument.shape, ("y", "x")
        bits = {"flag_masks": list(CCD_FLAGS.values()), "flag_meanings": " ".join(CCD_FLAGS)}
        return (
            Variable("image", "float32", shape, axes, {"units": "electron", "long_name": "calibrated image, with sky"}),
            Variable("dq", "uint16", shape, axes, {"long_name": "data quality", **bits}),
            Variable("raw", "int32", shape, axes, {"units": "DN", "long_name": "what was read"}),
            Variable("variance", "float32", shape, axes, {"units": "electron2", "long_name": "variance of the image"}),
        )
