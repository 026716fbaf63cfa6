"""One full SCA drizzled onto a full tile, image and noise, on one core: against exact maps and the `drizzle` package.

Prints seconds, the ratio and the largest differences; run with `python tests/benchmarks/drizzle.py`.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

# ruff: noqa: E402
# this file has the name of the package: let it not be found in its place
sys.path[:] = [path for path in sys.path if Path(path).resolve() != Path(__file__).resolve().parent]

import numpy as np
from astropy.wcs import WCS
from drizzle.resample import Drizzle

from romandask.instruments.exposure import Exposure
from romandask.instruments.roman.roman import Roman, RomanSettings
from romandask.kernels.coadding.drizzle import Sums
from romandask.kernels.coadding.pixel_map import pixel_map, strips
from romandask.model.tiles import tangent_header

PIXELS, SCALE, PIXFRAC = 8825, 0.0575, 0.7
SHAPE = (4088, 4088)
WINDOW = (slice(0, PIXELS), slice(0, PIXELS))


def ours(source: WCS, target: WCS, planes: list[np.ndarray], weight: np.ndarray) -> tuple[float, Sums]:
    """Return seconds and sums."""
    start = time.process_time()
    sums = Sums((PIXELS, PIXELS), len(planes), PIXFRAC)
    onto = pixel_map(source, target, *(slice(0, n) for n in SHAPE))
    sums.add(
        (
            [plane[part.rows, part.columns] for plane in planes],
            weight[part.rows, part.columns],
            onto.part(part.rows, part.columns),
        )
        for part in strips(onto, WINDOW)
    )
    return time.process_time() - start, sums


def package(
    source: WCS, target: WCS, planes: list[np.ndarray], weight: np.ndarray
) -> tuple[float, float, list[Drizzle], float]:
    """Return seconds of the exact map and of the drizzling, its results, and the largest error of our map, pixels."""
    start = time.process_time()
    exact = np.empty((*SHAPE, 2))
    for first in range(0, SHAPE[0], 256):
        y, x = np.mgrid[first : min(first + 256, SHAPE[0]), 0 : SHAPE[1]]
        sky = source.all_pix2world(x.ravel(), y.ravel(), 0)
        exact[first : first + 256] = np.stack(target.all_world2pix(*sky, 0), -1).reshape(*x.shape, 2)
    mapped = time.process_time()
    sums = [Drizzle(kernel="square", fillval="0", out_shape=(PIXELS, PIXELS), disable_ctx=True) for _ in planes]
    for drizzle, plane in zip(sums, planes, strict=True):
        drizzle.add_image(plane, exptime=1.0, pixmap=exact, weight_map=weight, pixfrac=PIXFRAC, in_units="cps")
    end = time.process_time()
    onto = pixel_map(source, target, *(slice(0, n) for n in SHAPE))
    error = max(
        np.abs(onto.part(part.rows, part.columns).dense() - exact[part.rows, part.columns]).max()
        for part in strips(onto, WINDOW)
    )
    return mapped - start, end - mapped, sums, float(error)


def main() -> None:
    """Run the benchmark."""
    exposure = Exposure(visit=1, detector=7, band="H158", mjd=61541.0, exptime=139.8, ra=53.0, dec=-40.0, pa=30.0)
    source = WCS(Roman(RomanSettings()).header(exposure))
    ra, dec = source.all_pix2world(2043.5, 2043.5, 0)
    target = WCS(tangent_header(float(ra), float(dec), PIXELS, SCALE))
    random = np.random.default_rng(1)
    planes = [random.normal(mean, 1, SHAPE).astype(np.float32) for mean in (1, 0)]
    weight = np.full(SHAPE, 139.8, np.float32)
    weight[random.random(SHAPE) < 0.01] = 0
    ours(source, target, planes, weight)  # compiles
    # ours takes light per pixel, the package surface brightness
    along_y, along_x = np.gradient(pixel_map(source, target, *(slice(0, n) for n in SHAPE)).dense(), axis=(0, 1))
    areas = np.abs(along_x[..., 0] * along_y[..., 1] - along_x[..., 1] * along_y[..., 0])
    light = [(plane * areas).astype(np.float32) for plane in planes]
    del along_y, along_x, areas
    seconds, sums = min((ours(source, target, light, weight) for _ in range(3)), key=lambda found: found[0])
    exact, drizzling, oracle, error = package(source, target, planes, weight)
    print(f"ours               {seconds:6.2f} s  image, noise and weight, map included")
    print(f"exact map          {exact:6.2f} s")
    print(f"drizzle package    {drizzling:6.2f} s  image and noise")
    print(f"ratio {(exact + drizzling) / seconds:.1f}, without the map {drizzling / seconds:.1f}")
    # the package leaves out pixels at the outline of the map that it is given
    inner = (slice(4, -4), slice(4, -4))
    total = sums.weight.copy()
    good = oracle[0].out_wht[inner] > 1e-2 * 139.8
    differences = [np.abs(total - oracle[0].out_wht)[inner].max() / 139.8]
    for mine, other in zip(sums.means(), oracle, strict=True):
        differences.append(np.abs(mine - other.out_img)[inner][good].max())
    print("largest difference of weight (shares), image (of its mean), noise (of its rms): ", end="")
    print(", ".join(f"{value:.1e}" for value in differences))
    print(f"largest error of the map {error:.1e} tile pixels")


if __name__ == "__main__":
    main()
