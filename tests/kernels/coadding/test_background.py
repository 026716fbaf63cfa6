"""The background mesh of an exposure: it stands for the estimate of the whole exposure, in any window."""

import numpy as np
import pytest
import sep

from romandask.kernels.coadding.background import BACKGROUND_MESH, background_at, background_mesh, mesh_shape


@pytest.fixture(scope="module")
def exposure():
    random = np.random.default_rng(3)
    y, x = np.mgrid[0:1400, 0:1300] / 1400
    level = 100 + 30 * x - 20 * y * y + 8 * np.sin(5 * x + 3 * y)
    image = random.poisson(level).astype(np.int32)
    mask = random.random(image.shape) < 0.01
    image[mask] = 60000
    return image, mask, level


def test_the_mesh_stands_for_the_estimate_of_sep(exposure):
    image, mask, level = exposure
    whole = sep.Background(image.astype(np.float32), mask=mask, bw=BACKGROUND_MESH, bh=BACKGROUND_MESH).back()
    found = background_at(background_mesh(image, mask), image.shape, slice(0, 1400), slice(0, 1300))
    # the noise of a pixel is 10
    assert np.abs(found - whole).max() < 0.1
    assert (found - whole).std() < 0.01 * (whole - level).std()


def test_a_window_has_the_background_of_the_whole(exposure):
    image, mask, _ = exposure
    mesh = background_mesh(image, mask)
    whole = background_at(mesh, image.shape, slice(0, 1400), slice(0, 1300))
    np.testing.assert_array_equal(
        background_at(mesh, image.shape, slice(511, 700), slice(3, 999)), whole[511:700, 3:999]
    )


@pytest.mark.parametrize("shape", [(4088, 4088), (300, 300), (4004, 4096), (40, 33)])
def test_the_mesh_has_samples_enough(shape):
    assert all(count >= max(4, length / 64) for count, length in zip(mesh_shape(shape), shape, strict=True))
    mesh = background_mesh(np.full(shape, 7.0), np.zeros(shape, bool))
    assert mesh.shape == mesh_shape(shape)
    np.testing.assert_allclose(background_at(mesh, shape, slice(0, shape[0]), slice(0, shape[1])), 7, rtol=1e-6)
