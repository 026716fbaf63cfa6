"""Readout of the CCDs of Rubin's camera: photon noise, blooming, amplifiers and calibration."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import pandas as pd
import pyarrow as pa

from romandask.instruments.exposure import Exposure
from romandask.instruments.instrument import Instrument
from romandask.instruments.readout import Light
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


@dataclass(frozen=True, kw_only=True)
class CcdReadout:
    """Readout of Rubin's CCDs; implements `Readout`."""

    instrument: Instrument
    """The instrument Rubin."""
    seed: int
    """Seed of the survey."""
    cosmic_rays: bool
    """True to add cosmic rays."""
    sensor: Literal["ideal", "silicon"]
    """With "silicon", bright objects are drawn photon by photon with GalSim's model of the CCD."""
    seconds_per_pixel: float = 7e-7
    draws_parts: bool = False

    @property
    def variables(self) -> tuple[Variable, ...]:
        """The calibrated image, its data quality and variance, and the raw data numbers."""
        shape, axes = self.instrument.shape, ("y", "x")
        flags = {"flag_masks": list(CCD_FLAGS.values()), "flag_meanings": " ".join(CCD_FLAGS)}
        return (
            Variable("image", "float32", shape, axes, {"units": "electron", "long_name": "calibrated image, with sky"}),
            Variable("dq", "uint16", shape, axes, {"long_name": "data quality", **flags}),
            Variable("raw", "int32", shape, axes, {"units": "DN", "long_name": "what was read"}),
            Variable("variance", "float32", shape, axes, {"units": "electron2", "long_name": "variance of the image"}),
        )

    @property
    def tables(self) -> dict[str, pa.Schema]:
        """No tables."""
        return {}

    @property
    def settings(self) -> dict[str, Any]:
        """The model of the sensor, and whether cosmic rays are added."""
        return {"sensor": self.sensor, "cosmic_rays": self.cosmic_rays}

    def earlier(self, table: pd.DataFrame, row: int) -> np.ndarray:
        """Return no rows: CCDs have no persistence."""
        return np.empty(0, int)

    def inputs(self, exposure: Exposure) -> tuple[tuple[str, str], ...]:
        """Return no units: the constants of the amplifiers are drawn from the seed."""
        return ()

    def leave(self, light: Light) -> pd.DataFrame:
        """Raise NotImplementedError: CCDs have no persistence."""
        raise NotImplementedError("a CCD leaves nothing to later exposures")

    def __call__(self, light: Light, left: Sequence[tuple[Exposure, pd.DataFrame]]) -> dict[str, Any]:
        """Return raw, image, truth, variance and dq of an exposure.

        Parameters
        ----------
        light : Light
            The light of the exposure.
        left : sequence
            Not used.
        """
        exposure, scene, sizes = light.exposure, light.scene, light.stamp_sizes
        bright = (scene.fluxes() >= MIN_ELECTRONS) & (sizes > 0)
        if self.sensor == "ideal" or not bright.any():
            expected = light.expected()
            return {**self.read(exposure, expected, light.background, None), "truth": expected}
        expected_faint, expected_bright = light.expected(~bright), light.expected(bright)

        def photon_seed(n: int) -> int:
            return int(self.random(exposure, "photons", int(scene.key[n])).integers(1, 1 << 31))

        bright_charge = through_silicon(
            scene,
            np.flatnonzero(bright),
            sizes,
            light.profiles,
            self.instrument.bandpass(exposure.band).nodes,
            self.instrument.shape,
            self.instrument.pixel_scale,
            photon_seed,
        )
        read = self.read(exposure, expected_faint, light.background, bright_charge)
        return {**read, "truth": expected_faint + expected_bright}

    def amplifiers(self, detector: int) -> Amplifiers:
        """Return the constants of the amplifiers of a detector, the same in all its exposures."""
        constants = self.instrument.detector
        random = rng(self.seed, "exposures", self.instrument.name, "amplifiers", detector)
        return amplifiers(random, constants.read_noise, constants.saturation)

    def read(
        self, exposure: Exposure, light: np.ndarray, background: np.ndarray, bright_charge: np.ndarray | None
    ) -> dict[str, np.ndarray]:
        """Return raw, image, variance and dq of an exposure.

        Parameters
        ----------
        exposure : Exposure
            The exposure.
        light : ndarray, shape (ny, nx), electrons
            Expected electrons of the objects, without those in `bright_charge`.
        background : ndarray, shape (ny, nx), electrons
            Expected electrons of sky and dark current.
        bright_charge : ndarray, shape (ny, nx), electrons, or None
            Charge of the objects that were drawn with the model of the silicon, photon noise included.
        """
        ny, nx = light.shape
        charge = np.empty((ny, nx), np.float32)
        for block, first in enumerate(range(0, ny, ROWS)):
            rows = slice(first, first + ROWS)
            mean = np.maximum(light[rows] + background[rows], 0)
            charge[rows] = poisson(mean, self.random(exposure, "light", block))
        if bright_charge is not None:
            charge += bright_charge
        dq = np.zeros((ny, nx), np.uint16)
        if self.cosmic_rays:
            rays = hits((ny, nx), tracks((ny, nx), exposure.exptime, self.random(exposure, "rays"), **RAYS))
            charge += rays
            dq[rays > COSMIC_RAY_THRESHOLD] = COSMIC_RAY
            # free the memory before the readout
            del rays
        constants = self.amplifiers(exposure.detector)
        charge, full = bleed(charge, constants)
        dq[full] |= SATURATED
        raw = read_out(charge, constants, lambda block: self.random(exposure, "read", block))
        image, variance = calibrate(raw, constants)
        return {"raw": raw, "image": image, "variance": variance, "dq": dq}

    def random(self, exposure: Exposure, *step: str | int) -> np.random.Generator:
        """Return the random generator of a step of an exposure, and of a block of rows or an object in this step."""
        return rng(self.seed, "exposures", self.instrument.name, exposure.visit, exposure.detector, *step)
