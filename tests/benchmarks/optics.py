"""Transforms of Roman's PSFs straight from the pupil, and by GalSim's OpticalPSF, on one core.

Prints seconds a PSF of each, their ratio, and how much they differ; run with `python tests/benchmarks/optics.py`.
"""

from __future__ import annotations

import time

import galsim.roman
import numpy as np

from romandask.instruments.roman.bands import BANDS
from romandask.instruments.roman.optics import MIDDLE, optics, pupil, transforms
from romandask.kernels.rendering.galsim_sampling import sample
from romandask.kernels.rendering.psf import Grid, place_grid, star_image
from romandask.kernels.universe.bandpasses import roman_bandpass

SIDE = (galsim.roman.n_pix, galsim.roman.n_pix)
CASES = [(7, "H158", 8, 128), (3, "Y106", 8, 128), (7, "H158", 4, 1024), (7, "H158", 2, 2048)]
"""SCA, band, binning of the pupil, pixels: the places of an SCA, then bright stars."""


def main() -> None:
    """Time both, a wavelength after another, each at all its places."""
    print(f"{'':24s}{'GalSim':>10s}{'here':>10s}{'ratio':>8s}{'of peak':>10s}")
    for sca, band, pupil_bin, size in CASES:
        grid = Grid(size, BANDS[band].frequency_folds if pupil_bin > 2 else 2)
        wave = float(roman_bandpass(band, 5).nodes[2])
        places = [tuple(place) for place in place_grid(SIDE, 2)] if size == 128 else [MIDDLE]
        pupil(sca, band, pupil_bin)
        optics(sca, band, wave, pupil_bin, MIDDLE)
        spent, most = np.zeros(2), 0.0
        for place in places:
            start = time.perf_counter()
            theirs = sample(optics(sca, band, wave, pupil_bin, place), galsim.roman.pixel_scale, grid)
            middle = time.perf_counter()
            ours = transforms(sca, band, np.array([wave]), pupil_bin, place, grid, 0.0)[0]
            spent += middle - start, time.perf_counter() - middle
            expected = star_image(theirs, grid)
            most = max(most, float(np.abs(star_image(ours, grid) - expected).max() / expected.max()))
        a, b = spent / len(places)
        print(f"SCA {sca:2d} {band} 1/{pupil_bin} {size:5d} px {a:8.3f} s {b:8.3f} s {a / b:7.1f} {most:9.1e}")


if __name__ == "__main__":
    main()
