"""Transforms of Roman's PSFs, computed from the pupil, against GalSim's PSFs."""

import galsim.roman
import numpy as np
import pytest

from romandask.instruments.roman.optics import MIDDLE, WideNodes, optics, transforms
from romandask.kernels.rendering.galsim_sampling import sample
from romandask.kernels.rendering.psf import Grid, star_image

PIXEL = galsim.roman.pixel_scale


@pytest.mark.parametrize(
    ("sca", "band", "wave", "pupil_bin", "position", "grid"),
    [
        # the grid of SCA 7's pupil is 1.5 times as wide as necessary, and a smaller one is used
        (7, "H158", 1577.0, 8, MIDDLE, Grid(128, 2)),
        (7, "Y106", 930.0, 8, (4000.0, 12.0), Grid(512, 3)),
        (18, "F184", 1840.0, 8, (30.0, 2000.0), Grid(128, 2)),
        # the full grid of SCA 3 and 5 is used, with the leakage of GalSim's interpolant beyond the optical cutoff
        (3, "Y106", 1060.0, 8, (100.0, 3000.0), Grid(128, 3)),
        (5, "H158", 1577.0, 4, MIDDLE, Grid(1024, 2)),
    ],
)
def test_transforms_agree_with_galsim(sca, band, wave, pupil_bin, position, grid):
    found = transforms(sca, band, np.array([wave]), pupil_bin, position, grid, 0.3)[0]
    expected = sample(optics(sca, band, wave, pupil_bin, position), PIXEL, grid, 0.3)
    # the tolerance allows for GalSim's interpolation between frequencies
    assert np.abs(found - expected).max() < 2e-4
    stars = [star_image(transform, grid, grid.folds) for transform in (found, expected)]
    assert np.abs(stars[0] - stars[1]).max() < 2e-6 * stars[1].max()
    assert found[len(found) // 2, 0] == pytest.approx(1.0, abs=1e-6)


def test_wide_nodes_return_the_same_transforms_at_every_call():
    grid = Grid(64, 2)
    nodes = WideNodes(sca=4, band="H158", waves=(1400.0, 1700.0), pupil_bin=8, grid=grid, diffusion=0.0)
    expected = transforms(4, "H158", np.array(nodes.waves), 8, MIDDLE, grid, 0.0)
    for _ in range(2):
        np.testing.assert_array_equal(np.stack(list(nodes)), expected)
