"""Synthetic calibrations of an SCA with realistic statistics, from the random generators of its number.

The ranges are those of Roman's detectors as published (Mosby et al. 2020; Givans et al. 2022; Troxel et al. 2023,
table 1). Names in capitals (RELQE1) are the calibrations of that table.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from romandask.kernels.detectors.sca import STIMULI

SCA_PIXELS = 4096
"""Pixels along a side, reference pixels included."""
SCA_SHAPE = (SCA_PIXELS, SCA_PIXELS)
"""Rows and columns, reference pixels included."""
REFERENCE_PIXELS = 4
"""Width of the border of reference pixels, which detect no light, at each edge, pixels."""
CHANNELS = 32
"""Number of readout channels; each is a stripe of 128 columns."""
WAVES = np.linspace(400.0, 2400.0, 50)
"""Wavelengths of RELQE2 and QYIELD, nm."""
DISCONNECTED, HOT, ADJACENT, LOW_EFFICIENCY, NOISY, REFERENCE = 1, 2, 4, 8, 16, 32
BAD_BITS = {
    "disconnected": DISCONNECTED,
    "hot": HOT,
    "adjacent": ADJACENT,
    "low_efficiency": LOW_EFFICIENCY,
    "noisy": NOISY,
    "reference": REFERENCE,
}
"""Bits of BADPIX, by name. A disconnected pixel has no signal; an adjacent pixel is next to a disconnected or a hot
one."""
AREA_KERNEL_QUARTER = np.array([[0.010, 0.015, 0.025], [0.015, 0.050, 0.395], [0.025, 0.395, -2.04]])
"""A quarter of the brighter-fatter area kernel, 1e-6/electron: (dy, dx) from (2, 2) to (0, 0). The sum of the whole
kernel is 0."""

Generators = Callable[[str], np.random.Generator]
"""Returns the random generator of a calibration of the SCA, given the name of the calibration."""


def bad_pixels(generators: Generators) -> np.ndarray:
    """Return BADPIX, (y, x) uint32: disconnected, hot, low-efficiency, noisy and reference pixels, and neighbours.

    The neighbours of disconnected and hot pixels are marked as adjacent.
    """
    rng = generators("BADPIX")
    bits = np.zeros(SCA_SHAPE, np.uint32)
    inner = SCA_PIXELS - 2 * REFERENCE_PIXELS
    for bit, share in ((DISCONNECTED, 3e-4), (HOT, 1e-3), (LOW_EFFICIENCY, 8e-4), (NOISY, 2e-3)):
        count = rng.poisson(share * inner**2)
        y, x = rng.integers(REFERENCE_PIXELS, SCA_PIXELS - REFERENCE_PIXELS, (2, count))
        bits[y, x] |= np.uint32(bit)
        if bit in (DISCONNECTED, HOT):
            for dy, dx in ((0, 1), (0, -1), (1, 0), (-1, 0)):
                bits[y + dy, x + dx] |= np.uint32(ADJACENT)
    bits[_border()] = REFERENCE
    return bits


def relative_efficiency(generators: Generators, bits: np.ndarray) -> np.ndarray:
    """Return RELQE1, (y, x): mean 1, slopes of about 1%, scatter of 0.7% per pixel, 0.2 to 0.8 in weak pixels."""
    rng = generators("RELQE1")
    along = np.linspace(-1, 1, SCA_PIXELS, dtype=np.float32)
    tilt = rng.normal(0, 0.005, 5)
    plane = 1 + tilt[0] * along[:, None] + tilt[1] * along + tilt[2] * along[:, None] * along
    plane = plane + tilt[3] * (along[:, None] ** 2 - 1 / 3) + tilt[4] * (along**2 - 1 / 3)
    plane = (plane + 0.007 * rng.standard_normal(SCA_SHAPE, np.float32)).astype(np.float32)
    weak = bits & LOW_EFFICIENCY > 0
    plane[weak] = rng.uniform(0.2, 0.8, weak.sum())
    plane[bits & REFERENCE > 0] = 0
    return plane


def coloured_efficiency(generators: Generators) -> np.ndarray:
    """Return RELQE2, (50, 64, 64): smooth in wavelength, scatter of 0.3% per block, mean 1 at every wavelength."""
    rng = generators("RELQE2")
    shapes = np.stack([np.ones(50), np.linspace(-1, 1, 50), np.cos(np.linspace(0, np.pi, 50))])
    planes = np.tensordot(shapes.T, rng.normal(0, 0.002, (3, 64, 64)), 1)
    return (1 + planes - planes.mean(axis=(1, 2), keepdims=True)).astype(np.float32)


def electrons_per_photon(generators: Generators) -> np.ndarray:
    """Return QYIELD, (50, 32, 32): 1 above 800 nm, rising to about 1.5 at 400 nm.

    The excess over 1 has a scatter of 1% per block.
    """
    rng = generators("QYIELD")
    excess = np.clip((800 - WAVES) / 400, 0, 1) * 0.5
    return (1 + excess[:, None, None] * rng.normal(1, 0.01, (32, 32))).astype(np.float32)


def charge_diffusion(generators: Generators) -> np.ndarray:
    """Return CHRGDIFF, (3, 32, 32), pixels^2: covariance (yy, xx, xy) of a charge diffusion of sigma 0.29 +- 2%."""
    rng = generators("CHRGDIFF")
    square = (0.29 * rng.normal(1, 0.02, (2, 32, 32))) ** 2
    return np.concatenate([square, rng.normal(0, 1e-3, (1, 32, 32))]).astype(np.float32)


def area_kernels(generators: Generators) -> np.ndarray:
    """Return BFE, (5, 5, 32, 32), 1/electron, axes (dy, dx).

    Kernels are the one of AREA_KERNEL_QUARTER with a scatter of 4% per block; each sums to zero.
    """
    half = np.concatenate([AREA_KERNEL_QUARTER, AREA_KERNEL_QUARTER[:, 1::-1]], axis=1)
    kernel = np.concatenate([half, half[1::-1]]) * 1e-6
    strength = generators("BFE").normal(1, 0.04, (32, 32))
    return (kernel[:, :, None, None] * strength).astype(np.float32)


def released_charge(generators: Generators) -> Iterator[np.ndarray]:
    """Yield the six planes of PERSIST, (y, x), electrons: about 1e-4 of a charge of 1e4 e, 2e-3 at full well.

    The scatter is 30% per pixel.
    """
    rng = generators("PERSIST")
    share = np.array([5e-5, 7e-5, 1e-4, 3e-4, 2e-3, 2.5e-3]) * STIMULI
    scatter = np.exp(0.3 * rng.standard_normal(SCA_SHAPE, np.float32))
    scatter[_border()] = 0
    for factor in share.astype(np.float32):
        yield factor * scatter


def dark_current(generators: Generators, bits: np.ndarray) -> np.ndarray:
    """Return DARK, (y, x), electrons per second.

    The median is 0.015, the scatter 30% per pixel. Hot pixels have 1 to 100, their neighbours 0.01 to 1 more than
    the others.
    """
    rng = generators("DARK")
    plane = 0.015 * np.exp(0.3 * rng.standard_normal(SCA_SHAPE, np.float32))
    hot = bits & HOT > 0
    plane[hot] = 10 ** rng.uniform(0, 2, hot.sum())
    near = (bits & ADJACENT > 0) & ~hot
    plane[near] += 10 ** rng.uniform(-2, 0, near.sum())
    plane[bits & REFERENCE > 0] = 0
    return plane.astype(np.float32)


def rate_exponent(generators: Generators) -> np.ndarray:
    """Return CRNL, (1, y, x): exponent of the count rate, 0.003 / ln 10 (0.3% per decade) +- 20%."""
    rng = generators("CRNL")
    return (0.003 / np.log(10) * (1 + 0.2 * rng.standard_normal((1, *SCA_SHAPE), np.float32))).astype(np.float32)


def full_well(generators: Generators) -> np.ndarray:
    """Return SATURATE, (y, x) int32, electrons: 1.1e5 +- 4%."""
    return (1.1e5 * (1 + 0.04 * generators("SATURATE").standard_normal(SCA_SHAPE, np.float32))).astype(np.int32)


def nonlinearity(generators: Generators) -> Iterator[np.ndarray]:
    """Yield the three planes of CNL, (y, x) float64: b2, b3, b4 that remove 3%, 1% and 0.5% of a charge of 1e5 e.

    The scatter is 10% per pixel.
    """
    rng = generators("CNL")
    size = np.array([3e-2 / 1e5, 1e-2 / 1e5**2, 5e-3 / 1e5**3])
    for typical in size:
        yield typical * (1 + 0.1 * rng.standard_normal(SCA_SHAPE, np.float32)).astype(float)


def capacitance(generators: Generators) -> np.ndarray:
    """Return IPC, (3, 3, 512, 512), axes (dy, dx).

    Kernels have 0.94 in the middle, 0.0135 at the sides and 0.0015 at the corners, with a scatter of 3% per block.
    """
    rng = generators("IPC")
    kernel = np.array([[0.0015, 0.0135, 0.0015], [0.0135, 0.0, 0.0135], [0.0015, 0.0135, 0.0015]])
    planes = kernel[:, :, None, None] * (1 + 0.03 * rng.standard_normal((3, 3, 512, 512), np.float32))
    planes[1, 1] = 1 - planes.sum(axis=(0, 1))
    return planes.astype(np.float32)


def noise(generators: Generators, bits: np.ndarray) -> Iterator[np.ndarray]:
    """Yield the three planes of READ, (y, x) float64: reset noise and its scatter (DN), and read noise (electrons).

    The read noise of an exposure is 8.5 +- 10%; noisy pixels have 2 to 10 times that.
    """
    rng = generators("READ")
    for mean in (20, 2):
        yield (mean * (1 + 0.05 * rng.standard_normal(SCA_SHAPE, np.float32))).astype(float)
    plane = (8.5 * np.exp(0.1 * rng.standard_normal(SCA_SHAPE, np.float32))).astype(float)
    noisy = bits & NOISY > 0
    plane[noisy] *= rng.uniform(2, 10, noisy.sum())
    yield plane


def gain(generators: Generators) -> np.ndarray:
    """Return GAIN, (32, 32), electrons per DN, in blocks of 128 x 128 pixels.

    The mean is 1.6, the scatter 1.5% per readout channel (column of blocks) and 0.3% per block.
    """
    rng = generators("GAIN")
    return (1.6 * rng.normal(1, 0.015, CHANNELS) * rng.normal(1, 0.003, (32, CHANNELS))).astype(np.float32)


def bias(generators: Generators) -> np.ndarray:
    """Return BIAS, (y, x) uint16, DN: mean 6700, scatter 150 per readout channel and 60 per pixel."""
    rng = generators("BIAS")
    stripes = np.repeat(rng.normal(6700, 150, CHANNELS), SCA_PIXELS // CHANNELS)
    return np.rint(stripes + 60 * rng.standard_normal(SCA_SHAPE, np.float32)).astype(np.uint16)


def _border() -> np.ndarray:
    """Return a mask of the reference pixels."""
    edge = np.ones(SCA_SHAPE, bool)
    edge[REFERENCE_PIXELS:-REFERENCE_PIXELS, REFERENCE_PIXELS:-REFERENCE_PIXELS] = False
    return edge


def planes(generators: Generators) -> Iterator[tuple[str, np.ndarray | Iterator[np.ndarray]]]:
    """Yield name and values of each calibration of an SCA, one at a time: together they take 1.5 GB.

    The values of the three largest are iterators over the planes of the first axis.
    """
    bits = bad_pixels(generators)
    yield "RELQE1", relative_efficiency(generators, bits)
    yield "RELQE2", coloured_efficiency(generators)
    yield "QYIELD", electrons_per_photon(generators)
    yield "CHRGDIFF", charge_diffusion(generators)
    yield "BFE", area_kernels(generators)
    yield "PERSIST", released_charge(generators)
    yield "DARK", dark_current(generators, bits)
    yield "CRNL", rate_exponent(generators)
    yield "SATURATE", full_well(generators)
    yield "CNL", nonlinearity(generators)
    yield "IPC", capacitance(generators)
    yield "BADPIX", bits
    yield "READ", noise(generators, bits)
    yield "GAIN", gain(generators)
    yield "BIAS", bias(generators)
