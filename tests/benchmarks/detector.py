"""One SCA with every effect of the detector, against the simple detector and GalSim's own calls, on one core.

Prints seconds and ratios; run with `python tests/benchmarks/detector.py`.
"""

from __future__ import annotations

import time
import warnings

import galsim
import galsim.roman
import numpy as np

from romandask.kernels import sca
from romandask.kernels.brighter_fatter import brighter_fatter
from romandask.kernels.detector import Detector, observe
from romandask.kernels.sca_exposure import Response, calibrate, expose
from romandask.kernels.synthetic_sca import planes as made_up
from romandask.model.seeds import rng

SEED = 20230992
BLOCKS = ("BFE", "IPC", "GAIN")


def seconds(work, repeat: int = 3) -> float:
    """Return the least time of some runs after one that compiles."""
    work()
    times = []
    for _ in range(repeat):
        start = time.perf_counter()
        work()
        times.append(time.perf_counter() - start)
    return min(times)


def main() -> None:
    """Run the benchmark."""
    warnings.simplefilter("ignore")
    values = dict(made_up(lambda name: rng(SEED, "calibration", 7, name)))
    values |= {name: values[name].astype(np.float32) for name in ("CNL", "READ")}

    def planes(name: str, rows: slice) -> np.ndarray:
        return values[name] if name in BLOCKS else values[name][..., rows, :]

    response = Response(np.ones((64, 64), np.float32), np.ones((32, 32), np.float32), 139.8)
    light = np.full((4088, 4088), 185.0, np.float32)
    light[::40, ::40] += 2e4
    simple = seconds(lambda: observe(light, 0.0, Detector(1e5, 8.5), rng(SEED, "simple")))
    full = seconds(lambda: expose(light, planes, response, lambda name, block: rng(SEED, name, block)))
    numbers, _ = expose(light, planes, response, lambda name, block: rng(SEED, name, block))
    back = seconds(lambda: calibrate(numbers, planes, response))
    print(f"simple model      {simple:6.2f} s")
    print(f"every effect      {full:6.2f} s  {full / simple:.1f} times the simple model")
    print(f"calibrated again  {back:6.2f} s")
    image = galsim.ImageF(np.pad(light, 4))
    ours = {
        "IPC": lambda: sca.interpixel_capacitance(image.array, values["IPC"], 8),
        "nonlinearity": lambda: sca.nonlinear(image.array, values["CNL"]),
        "persistence": lambda: sca.persistence(image.array, values["PERSIST"], 300.0),
    }
    exposures = [galsim.ImageF(image.array.copy())]
    theirs = {
        "IPC": lambda: galsim.roman.applyIPC(image.copy()),
        "nonlinearity": lambda: galsim.roman.applyNonlinearity(image.copy()),
        "persistence": lambda: galsim.roman.applyPersistence(image.copy(), exposures),
    }
    for name in ours:
        mine, other = seconds(ours[name]), seconds(theirs[name])
        print(f"{name:16s}  {mine:6.2f} s  galsim.roman {other:6.2f} s  ratio {other / mine:.1f}")
    moving = seconds(lambda: brighter_fatter(image.array, values["BFE"], 128))
    print(f"brighter-fatter   {moving:6.2f} s  (none in galsim.roman)")


if __name__ == "__main__":
    main()
