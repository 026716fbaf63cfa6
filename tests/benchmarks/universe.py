"""The generated universe at size: time and rows of its partitions, and two-point functions against theory.

    python tests/benchmarks/universe.py [degrees a side] [nside]

Galaxy clustering and cosmic shear of a box as TreeCorr measures them, against pyccl with the same n(z) and the window
of the HEALPix shells.
"""

import resource
import sys
import time
from pathlib import Path

import numpy as np
import pandas as pd
import pyccl
import treecorr

from romandask.instruments.roman.roman import Roman, RomanSettings
from romandask.instruments.rubin.rubin import Rubin, RubinSettings
from romandask.kernels.universe.structure import bias
from romandask.model.cosmology import Cosmology
from romandask.model.settings import TruthSettings
from romandask.model.sky import Region
from romandask.stages.truth.catalogs import truth

COLUMNS = ["ra", "dec", "redshift", "shear_1", "shear_2", "flux_r", "flux_i", "flux_H158"]


def main(side: float, nside: int) -> None:
    region = Region(
        53.5 - side / 2 / np.cos(np.radians(40)),
        53.5 + side / 2 / np.cos(np.radians(40)),
        -40 - side / 2,
        -40 + side / 2,
    )
    bandpasses = {band: Rubin(RubinSettings()).bandpass(band) for band in "ugrizy"}
    bandpasses |= {band: Roman(RomanSettings()).bandpass(band) for band in ("Y106", "J129", "H158", "F184")}
    catalogs = truth(TruthSettings(order=7, nside=nside, margin=0), Path("."), region, bandpasses, 20230987)
    start = time.perf_counter()
    catalogs.structure.load(0)
    print(f"structure, nside {nside}: {time.perf_counter() - start:.0f} s, peak {peak():.2f} GiB")
    parts, start = [], time.perf_counter()
    for index in range(len(catalogs.galaxies.units)):
        parts.append(catalogs.galaxies.load(index)[COLUMNS])
    seconds = time.perf_counter() - start
    frame = pd.concat(parts, ignore_index=True)
    size = region.area / 3600
    print(
        f"{len(frame)} galaxies on {size:.2f} square degrees ({len(frame) / size / 1e6:.3f} million each) in "
        f"{seconds:.0f} s: {seconds / len(frame) * 1e6:.1f} us a galaxy; peak {peak():.2f} GiB"
    )
    compare(frame, region, nside)


def compare(frame: pd.DataFrame, region: Region, nside: int) -> None:
    cosmology = Cosmology()
    theory = pyccl.Cosmology(
        Omega_c=cosmology.omega_m - cosmology.omega_b,
        Omega_b=cosmology.omega_b,
        h=cosmology.h,
        n_s=cosmology.n_s,
        sigma8=cosmology.sigma_8,
        transfer_function="eisenstein_hu",
        matter_power_spectrum="halofit",
    )
    i = 31.4 - 2.5 * np.log10(frame["flux_i"])
    chosen = frame[(i < 25.3)].sample(frac=0.25, random_state=1)
    density, edges = np.histogram(chosen["redshift"], np.linspace(0, 3, 61))
    middle = (edges[1:] + edges[:-1]) / 2
    ell = np.unique(np.geomspace(2, 2 * nside, 200).astype(int))
    dense = np.arange(2, 2 * nside + 1)
    tracers = {
        "w": pyccl.NumberCountsTracer(theory, has_rsd=False, dndz=(middle, density), bias=(middle, bias(middle))),
        "xi": pyccl.WeakLensingTracer(theory, dndz=(middle, density)),
    }
    window = square_window(dense, nside)
    limits = dict(min_sep=2.5, max_sep=120, nbins=10, sep_units="arcmin")
    data = treecorr.Catalog(
        ra=chosen["ra"], dec=chosen["dec"], ra_units="deg", dec_units="deg", g1=chosen["shear_1"], g2=chosen["shear_2"]
    )
    random = np.random.default_rng(2)
    n = 2 * len(chosen)
    ra = random.uniform(region.ra_min, region.ra_max, n)
    dec = np.degrees(np.arcsin(random.uniform(*np.sin(np.radians([region.dec_min, region.dec_max])), n)))
    uniform = treecorr.Catalog(ra=ra, dec=dec, ra_units="deg", dec_units="deg")
    dd, rr, dr = (treecorr.NNCorrelation(**limits) for _ in range(3))
    dd.process(data)
    rr.process(uniform)
    dr.process(data, uniform)
    clustering, _ = dd.calculateXi(rr=rr, dr=dr)
    shear = treecorr.GGCorrelation(**limits)
    shear.process(data)
    theta = shear.meanr / 60

    def expected(kind: str, function: str, power: int) -> np.ndarray:
        tracer = tracers[kind]
        sparse = pyccl.angular_cl(theory, tracer, tracer, ell)
        cl = np.exp(np.interp(np.log(dense), np.log(ell), np.log(sparse))) * window**power
        return pyccl.correlation(theory, ell=dense, C_ell=cl, theta=theta, type=function, method="Bessel")

    w, plus = expected("w", "NN", 4), expected("xi", "GG+", 4)
    print("arcmin      w   theory  ratio |      xi+   theory  ratio")
    for row in range(len(theta)):
        print(
            f"{theta[row] * 60:6.1f} {clustering[row]:7.4f} {w[row]:7.4f} {clustering[row] / w[row]:6.2f} | "
            f"{shear.xip[row]:.2e} {plus[row]:.2e} {shear.xip[row] / plus[row]:6.2f}"
        )


def square_window(ell: np.ndarray, nside: int) -> np.ndarray:
    """The window of a square pixel of the same area, averaged over directions to second order."""
    side = np.sqrt(np.pi / 3) / nside
    return np.exp(-((ell * side) ** 2) / 24)


def peak() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20


if __name__ == "__main__":
    main(float(sys.argv[1]) if len(sys.argv) > 1 else 1.0, int(sys.argv[2]) if len(sys.argv) > 2 else 512)
