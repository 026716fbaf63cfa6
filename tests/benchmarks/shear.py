"""Cosmic shear of a generated survey of the paper's footprint: xi+ and xi- against theory, errors, signal to noise.

python tests/benchmarks/shear.py [side in degrees: the whole footprint without]

The sample is as dense as the paper's, 69 galaxies a square arcminute: the brightest in H158.
"""

import resource
import sys
import time
from pathlib import Path

import numpy as np
import pandas as pd

from romandask.instruments.roman.roman import Roman, RomanSettings
from romandask.kernels.measurement.shear import signal_to_noise
from romandask.model.settings import LensingSettings, TruthSettings
from romandask.model.sky import Region
from romandask.stages.analysis.shear import SHAPE_COLUMNS, true_shapes
from romandask.stages.analysis.two_point import significance, two_point
from romandask.stages.truth.catalogs import truth

DENSITY = 69.0
SEED = 20230987


def main(side: float | None) -> None:
    region = Region(51.0, 56.0, -42.0, -38.0)
    if side is not None:
        region = Region(53.5 - side / 1.53, 53.5 + side / 1.53, -40 - side / 2, -40 + side / 2)
    settings = TruthSettings(order=7, nside=1024, margin=0)
    bandpasses = {"H158": Roman(RomanSettings()).bandpass("H158")}
    catalogs = truth(settings, Path("."), region, bandpasses, SEED)
    start, parts = time.perf_counter(), []
    for index in range(len(catalogs.galaxies.units)):
        rows = catalogs.galaxies.load(index)
        rows = rows[region.contains(rows["ra"], rows["dec"]) & (rows["flux_H158"] > 10 ** (0.4 * (31.4 - 26.0)))]
        kept = rows[["ra", "dec", "redshift", "flux_H158"]].astype({"redshift": np.float32})
        parts.append(kept.assign(**true_shapes(rows[SHAPE_COLUMNS])))
    frame = pd.concat(parts, ignore_index=True).sort_values("flux_H158", ascending=False)
    frame = frame.iloc[: int(DENSITY * region.area)]
    faintest = 31.4 - 2.5 * np.log10(frame["flux_H158"].iloc[-1])
    print(
        f"{len(frame)} galaxies, H158 < {faintest:.2f}, mean redshift {frame['redshift'].mean():.2f}, on "
        f"{region.area / 3600:.2f} square degrees, made in {time.perf_counter() - start:.0f} s"
    )
    start = time.perf_counter()
    table = two_point(frame, LensingSettings(), region)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    print(f"xi, jackknife and covariance: {time.perf_counter() - start:.0f} s on one core, peak {peak:.2f} GiB")
    columns = ["separation", "xip", "xip_theory", "xip_error", "xip_jackknife", "xim", "xim_theory", "xim_error"]
    print(table[columns].to_string(float_format=lambda value: f"{value:.3g}"))
    for kind in ("xip", "xim"):
        pull = (table[kind] - table[f"{kind}_theory"]) / table[f"{kind}_error"]
        ratio = table[f"{kind}_jackknife"] / table[f"{kind}_error"]
        print(
            f"{kind}: pulls {pull.mean():.2f} +- {pull.std():.2f}, jackknife over Gaussian errors {ratio.median():.2f}"
        )
    matrix = np.array([*table["covariance_xip"], *table["covariance_xim"]], float)
    theory = np.concatenate([table["xip_theory"], table["xim_theory"]])
    print(
        f"rms of a component {table['sigma'].iloc[0]:.3f}; signal to noise {significance(table):.1f} measured, "
        f"{signal_to_noise(theory, (matrix + matrix.T) / 2):.1f} of the theory; the paper's 47"
    )


if __name__ == "__main__":
    main(float(sys.argv[1]) if len(sys.argv) > 1 else None)
