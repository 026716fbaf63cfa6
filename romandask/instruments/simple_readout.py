"""The readout of the simple detector: sky, Poisson noise, saturation, read noise, whole electrons."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa

from romandask.instruments.exposure import Exposure
from romandask.instruments.instrument import Light
from romandask.kernels.detectors.simple_detector import DQ_FLAGS, Detector, observe
from romandask.model.seeds import rng
from romandask.storage.arrays import Variable


@dataclass(frozen=True)
class SimpleReadout:
    """Reads out exposures with the simple detector."""

    name: str
    """Of the instrument."""
    detector: Detector
    shape: tuple[int, int]
    """(ny, nx) pixels."""
    seed: int
    seconds_per_pixel: float = 2.5e-7

    @property
    def variables(self) -> tuple[Variable, ...]:
        """The observed image and its data quality."""
        masks = {
            "long_name": "data quality",
            "flag_masks": list(DQ_FLAGS.values()),
            "flag_meanings": " ".join(DQ_FLAGS),
        }
        text = {"units": "electron", "long_name": "observed image"}
        return (
            Variable("image", "int32", self.shape, ("y", "x"), text),
            Variable("dq", "uint8", self.shape, ("y", "x"), masks),
        )

    @property
    def tables(self) -> dict[str, pa.Schema]:
        """No tables."""
        return {}

    @property
    def settings(self) -> dict[str, Any]:
        """Nothing beside what all instruments share."""
        return {}

    def earlier(self, table: pd.DataFrame, row: int) -> np.ndarray:
        """Return no rows: the detector keeps nothing from one exposure to the next."""
        return np.empty(0, int)

    def inputs(self, exposure: Exposure) -> tuple[tuple[str, str], ...]:
        """Return no units."""
        return ()

    def leave(self, light: Light) -> pd.DataFrame:
        """Raise NotImplementedError: nothing is left."""
        raise NotImplementedError("the simple detector leaves nothing to later exposures")

    def __call__(self, light: Light, left: Sequence[tuple[Exposure, pd.DataFrame]]) -> dict[str, Any]:
        """Return image, truth and dq of an exposure."""
        exposure, expected = light.exposure, light.expected()
        random = rng(self.seed, "exposures", self.name, exposure.visit, exposure.detector)
        image, dq = observe(expected, light.background, self.detector, random)
        return {"image": image, "truth": expected, "dq": dq}
