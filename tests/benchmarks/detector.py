"""One SCA with every effect of the detector, against the simple detector and GalSim's own calls, on one core.

Prints seconds and ratios; run with `python tests/benchmarks/detector.py`.
"""

from __future__ import annotations

import time
import warnings
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import galsim
import galsim.roman
import numpy as np

from romandask.instruments.exposure import Exposure
from romandask.instruments.roman.calibration import calibrations
from romandask.instruments.roman.calibration_source import CalibrationSource
from romandask.instruments.roman.roman import Roman, RomanSettings
from romandask.instruments.roman.sca_readout import ScaReadout, trapped_table
from romandask.kernels.detectors import sca
from romandask.kernels.detectors.brighter_fatter import brighter_fatter
from romandask.kernels.detectors.sca_exposure import Planes, accumulate, calibrate, read_out
from romandask.kernels.detectors.simple_detector import Detector, observe
from romandask.kernels.detectors.synthetic_sca import SCA_PIXELS
from romandask.model.seeds import rng
from romandask.storage.manifest import Record, write_record
from romandask.storage.store import Store

SEED = 20230992


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
    with TemporaryDirectory() as folder:
        run(Path(folder))


def run(folder: Path) -> None:
    """Time everything with the calibrations of one SCA in a store below a folder."""
    store, source = Store(folder), CalibrationSource(None, SEED)
    product = calibrations(source, [7])
    product.prepare(store)
    start = time.perf_counter()
    product.write(0, store)
    print(f"calibrations made {time.perf_counter() - start:6.2f} s  once an SCA")
    write_record(store, Record(product.stage, product.names[0], "", "", 0, 0, 0.0, 0))
    roman = Roman(RomanSettings(detector="sca"), n_waves=5, calibration=source)
    readout = ScaReadout(instrument=roman, calibration=product.stored(store), seed=SEED, cosmic_rays=False)
    exposure = Exposure(visit=1, detector=7, band="H158", mjd=61541.0, exptime=139.8, ra=53.0, dec=-40.0, pa=0.0)
    planes = readout.planes(exposure)
    response = readout.response(exposure, planes)
    light = np.full((4088, 4088), 185.0, np.float32)
    light[::40, ::40] += 2e4

    def of(step: str, block: int) -> np.random.Generator:
        return rng(SEED, step, block)

    held = {v.name: planes(v.name, slice(None)) for v in product.variables}

    def in_memory(name: str, rows: slice) -> np.ndarray:
        return held[name][..., rows, :] if held[name].shape[-1] == SCA_PIXELS else held[name]

    def every_effect(given: Planes) -> None:
        charge, _ = readout.charge(exposure, light, given, response)
        trapped_table(charge, given)
        read_out(charge, given, response, of)

    # the simple model before, between and after: what else the machine does is in all of them
    def observed() -> float:
        return seconds(lambda: observe(light, 0.0, Detector(1e5, 8.5), partial(rng, SEED, "simple")))

    simple = [observed()]
    kept = seconds(lambda: every_effect(in_memory))
    simple.append(observed())
    full = seconds(lambda: every_effect(readout.planes(exposure)))
    simple.append(observed())
    numbers, _ = read_out(accumulate(light, planes, response, of), planes, response, of)
    back = seconds(lambda: calibrate(numbers, planes, response))
    print(f"simple model      {min(simple):6.2f} s")
    print(f"every effect      {kept:6.2f} s  {kept / min(simple[:2]):.1f} times the simple model, traps found")
    print(f"  and calibrations read {full:.2f} s  {full / min(simple[1:]):.1f} times the simple model")
    print(f"calibrated again  {back:6.2f} s")
    values = {name: planes(name, slice(None)) for name in ("IPC", "CNL", "PERSIST", "BFE")}
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
