"""Readout of the simple detector: sky, Poisson noise, saturation, read noise, rounding to whole electrons."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa

from romandask.instruments.exposure import Exposure
from romandask.instruments.readout import Light
from romandask.kernels.detectors.simple_detector import (
    NOT_DRAWN,
    NOT_DRAWN_VALUE,
    SIMPLE_FLAGS,
    WHOLE,
    Detector,
    observe,
)
from romandask.model.seeds import rng
from romandask.storage.arrays import Variable


@dataclass(frozen=True, kw_only=True)
class SimpleReadout:
    """Readout with the simple detector; implements `Readout`."""

    name: str
    """Name of the instrument."""
    detector: Detector
    """Saturation and read noise."""
    shape: tuple[int, int]
    """Shape of the detector (ny, nx), pixels."""
    seed: int
    """Seed of the survey."""
    seconds_per_pixel: float = 1.0e-7
    draws_parts: bool = True

    @property
    def variables(self) -> tuple[Variable, ...]:
        """The observed image and its data quality."""
        quality = {
            "long_name": "data quality",
            "flag_masks": list(SIMPLE_FLAGS.values()),
            "flag_meanings": " ".join(SIMPLE_FLAGS),
        }
        electrons = {"units": "electron", "long_name": "observed image", "not_drawn_value": NOT_DRAWN_VALUE}
        return (
            Variable("image", "int32", self.shape, ("y", "x"), electrons, fill=NOT_DRAWN_VALUE),
            Variable("dq", "uint8", self.shape, ("y", "x"), quality, fill=NOT_DRAWN),
        )

    @property
    def tables(self) -> dict[str, pa.Schema]:
        """No tables."""
        return {}

    @property
    def settings(self) -> dict[str, Any]:
        """No settings in addition to those of all instruments."""
        return {}

    def earlier(self, table: pd.DataFrame, row: int) -> np.ndarray:
        """Return no rows: the simple detector has no persistence."""
        return np.empty(0, int)

    def inputs(self, exposure: Exposure) -> tuple[tuple[str, str], ...]:
        """Return no units."""
        return ()

    def leave(self, light: Light) -> pd.DataFrame:
        """Raise NotImplementedError: the simple detector has no persistence."""
        raise NotImplementedError("the simple detector leaves nothing to later exposures")

    def __call__(self, light: Light, left: Sequence[tuple[Exposure, pd.DataFrame]]) -> dict[str, Any]:
        """Return image, truth and dq of an exposure; `left` is not used."""
        exposure, expected = light.exposure, light.expected()
        generator = partial(rng, self.seed, "exposures", self.name, exposure.visit, exposure.detector)
        image, dq = observe(expected, light.background, self.detector, generator, light.window)
        if light.window != WHOLE:
            drawn = expected[light.window]
            expected = np.full(expected.shape, NOT_DRAWN_VALUE, np.float32)
            expected[light.window] = drawn
        return {"image": image, "truth": expected, "dq": dq}
