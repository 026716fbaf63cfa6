"""Statistically faithful calibrations of an SCA that does not exist, seeded by its number.

The ranges are those of Roman's detectors as published (Mosby et al. 2020; Givans et al. 2022; Troxel et al. 2023,
table 1).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from romandask.kernels.detectors.sca import STIMULI

SCA_PIXELS = 4096
"""Pixels along a side, the border of reference pixels included."""
SCA_SHAPE = (SCA_PIXELS, SCA_PIXELS)
REFERENCE_PIXELS = 4
"""Reference pixels at each edge, which see no light."""
CHANNELS = 32
"""Readout channels, stripes of 128 columns."""
WAVES = np.linspace(400.0, 2400.0, 50)
"""Wavelengths, nm, of RELQE2 and QYIELD."""
DISCONNECTED, HOT, ADJACENT, LOW_EFFICIENCY, NOISY, REFERENCE = 1, 2, 4, 8, 16, 32
BAD_BITS = {
    "disconnected": DISCONNECTED,
    "hot": HOT,
    "adjacent": ADJACENT,
    "low_efficiency": LOW_EFFICIENCY,
    "noisy": NOISY,
    "reference": REFERENCE,
}
"""Bits of BADPIX: a disconnected pixel reads nothing; adjacent ones touch it or a hot one."""
AREAS = np.array([[0.010, 0.015, 0.025], [0.015, 0.050, 0.395], [0.025, 0.395, -2.04]])
"""A quarter of the brighter-fatter area kernel, 1e-6 an electron, (dy, dx) from (2, 2) to (0, 0); the whole is 0."""

Generator = Callable[[str], np.random.Generator]
"""Gives the random generator of a named part of an SCA."""


def bad_pixels(of: Generator) -> np.ndarray:
    """Return BADPIX (y, x) uint32: disconnected and hot pixels with their neighbours, weak, noisy, reference."""
    rng = of("BADPIX")
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


def relative_efficiency(of: Generator, bits: np.ndarray) -> np.ndarray:
    """Return RELQE1 (y, x): 1 with a slope of a per cent, 0.7% from pixel to pixel, weak pixels 0.2 to 0.8."""
    rng = of("RELQE1")
    along = np.linspace(-1, 1, SCA_PIXELS, dtype=np.float32)
    tilt = rng.normal(0, 0.005, 5)
    plane = 1 + tilt[0] * along[:, None] + tilt[1] * along + tilt[2] * along[:, None] * along
    plane = plane + tilt[3] * (along[:, None] ** 2 - 1 / 3) + tilt[4] * (along**2 - 1 / 3)
    plane = (plane + 0.007 * rng.standard_normal(SCA_SHAPE, np.float32)).astype(np.float32)
    weak = bits & LOW_EFFICIENCY > 0
    plane[weak] = rng.uniform(0.2, 0.8, weak.sum())
    plane[bits & REFERENCE > 0] = 0
    return plane


def coloured_efficiency(of: Generator) -> np.ndarray:
    """Return RELQE2 (50, 64, 64): smooth in wavelength, 0.3% from block to block, mean 1 at every wavelength."""
    rng = of("RELQE2")
    shapes = np.stack([np.ones(50), np.linspace(-1, 1, 50), np.cos(np.linspace(0, np.pi, 50))])
    planes = np.tensordot(shapes.T, rng.normal(0, 0.002, (3, 64, 64)), 1)
    return (1 + planes - planes.mean(axis=(1, 2), keepdims=True)).astype(np.float32)


def electrons_a_photon(of: Generator) -> np.ndarray:
    """Return QYIELD (50, 32, 32): 1 beyond 800 nm, to about 1.5 at 400 nm, 1% from block to block."""
    rng = of("QYIELD")
    excess = np.clip((800 - WAVES) / 400, 0, 1) * 0.5
    return (1 + excess[:, None, None] * rng.normal(1, 0.01, (32, 32))).astype(np.float32)


def charge_diffusion(of: Generator) -> np.ndarray:
    """Return CHRGDIFF (3, 32, 32): the covariance (yy, xx, xy), pixels^2, of diffusion with sigma 0.29 +- 2%."""
    rng = of("CHRGDIFF")
    square = (0.29 * rng.normal(1, 0.02, (2, 32, 32))) ** 2
    return np.concatenate([square, rng.normal(0, 1e-3, (1, 32, 32))]).astype(np.float32)


def area_kernels(of: Generator) -> np.ndarray:
    """Return BFE (5, 5, 32, 32), 1/electron, axes (dy, dx): AREAS with 4% from block to block; each sums to zero."""
    half = np.concatenate([AREAS, AREAS[:, 1::-1]], axis=1)
    kernel = np.concatenate([half, half[1::-1]]) * 1e-6
    strength = of("BFE").normal(1, 0.04, (32, 32))
    return (kernel[:, :, None, None] * strength).astype(np.float32)


def released_charge(of: Generator) -> np.ndarray:
    """Return PERSIST (6, y, x), electrons: about 1e-4 of the charge at 1e4 e, 2e-3 at full well, 30% a pixel."""
    rng = of("PERSIST")
    share = np.array([5e-5, 7e-5, 1e-4, 3e-4, 2e-3, 2.5e-3]) * STIMULI
    scatter = np.exp(0.3 * rng.standard_normal(SCA_SHAPE, np.float32))
    planes = share.astype(np.float32)[:, None, None] * scatter
    planes[:, _border()] = 0
    return planes


def dark_current(of: Generator, bits: np.ndarray) -> np.ndarray:
    """Return DARK (y, x), e/s: median 0.015, 30% a pixel; hot pixels 1 to 100, their neighbours a tenth."""
    rng = of("DARK")
    plane = 0.015 * np.exp(0.3 * rng.standard_normal(SCA_SHAPE, np.float32))
    hot = bits & HOT > 0
    plane[hot] = 10 ** rng.uniform(0, 2, hot.sum())
    near = (bits & ADJACENT > 0) & ~hot
    plane[near] += 10 ** rng.uniform(-2, 0, near.sum())
    plane[bits & REFERENCE > 0] = 0
    return plane.astype(np.float32)


def rate_exponent(of: Generator) -> np.ndarray:
    """Return CRNL (1, y, x): exponent of the count rate, 0.003 / ln 10 (0.3% a decade) +- 20%."""
    rng = of("CRNL")
    return (0.003 / np.log(10) * (1 + 0.2 * rng.standard_normal((1, *SCA_SHAPE), np.float32))).astype(np.float32)


def full_well(of: Generator) -> np.ndarray:
    """Return SATURATE (y, x) int32, electrons: 1.1e5 +- 4%."""
    return (1.1e5 * (1 + 0.04 * of("SATURATE").standard_normal(SCA_SHAPE, np.float32))).astype(np.int32)


def nonlinearity(of: Generator) -> np.ndarray:
    """Return CNL (3, y, x) float64: b2, b3, b4 that take 3%, 1% and 0.5% of 1e5 e, 10% a pixel."""
    rng = of("CNL")
    size = np.array([3e-2 / 1e5, 1e-2 / 1e5**2, 5e-3 / 1e5**3])
    scatter = 1 + 0.1 * rng.standard_normal((3, *SCA_SHAPE), np.float32)
    return size[:, None, None] * scatter


def capacitance(of: Generator) -> np.ndarray:
    """Return IPC (3, 3, 512, 512), axes (dy, dx): 0.94 in the middle, 0.0135 beside, 0.0015 at corners, 3% a block."""
    rng = of("IPC")
    kernel = np.array([[0.0015, 0.0135, 0.0015], [0.0135, 0.0, 0.0135], [0.0015, 0.0135, 0.0015]])
    planes = kernel[:, :, None, None] * (1 + 0.03 * rng.standard_normal((3, 3, 512, 512), np.float32))
    planes[1, 1] = 1 - planes.sum(axis=(0, 1))
    return planes.astype(np.float32)


def noise(of: Generator, bits: np.ndarray) -> np.ndarray:
    """Return READ (3, y, x) float64: reset noise and its scatter, DN; read noise of an exposure, e, 8.5 +- 10%.

    Noisy pixels have 2 to 10 times the read noise.
    """
    rng = of("READ")
    planes = np.empty((3, *SCA_SHAPE))
    planes[0] = 20 * (1 + 0.05 * rng.standard_normal(SCA_SHAPE, np.float32))
    planes[1] = 2 * (1 + 0.05 * rng.standard_normal(SCA_SHAPE, np.float32))
    planes[2] = 8.5 * np.exp(0.1 * rng.standard_normal(SCA_SHAPE, np.float32))
    noisy = bits & NOISY > 0
    planes[2, noisy] *= rng.uniform(2, 10, noisy.sum())
    return planes


def gain(of: Generator) -> np.ndarray:
    """Return GAIN (32, 32), e/DN, blocks of 128 pixels: 1.6 +- 1.5% a readout channel (column), 0.3% a block."""
    rng = of("GAIN")
    return (1.6 * rng.normal(1, 0.015, CHANNELS) * rng.normal(1, 0.003, (32, CHANNELS))).astype(np.float32)


def bias(of: Generator) -> np.ndarray:
    """Return BIAS (y, x) uint16, DN: 6700, 150 from channel to channel, 60 from pixel to pixel."""
    rng = of("BIAS")
    stripes = np.repeat(rng.normal(6700, 150, CHANNELS), SCA_PIXELS // CHANNELS)
    return np.rint(stripes + 60 * rng.standard_normal(SCA_SHAPE, np.float32)).astype(np.uint16)


def _border() -> np.ndarray:
    edge = np.ones(SCA_SHAPE, bool)
    edge[REFERENCE_PIXELS:-REFERENCE_PIXELS, REFERENCE_PIXELS:-REFERENCE_PIXELS] = False
    return edge


def planes(of: Generator) -> Iterator[tuple[str, np.ndarray]]:
    """Yield the calibrations of an SCA by name, one at a time: together they are 1.5 GB."""
    bits = bad_pixels(of)
    yield "RELQE1", relative_efficiency(of, bits)
    yield "RELQE2", coloured_efficiency(of)
    yield "QYIELD", electrons_a_photon(of)
    yield "CHRGDIFF", charge_diffusion(of)
    yield "BFE", area_kernels(of)
    yield "PERSIST", released_charge(of)
    yield "DARK", dark_current(of, bits)
    yield "CRNL", rate_exponent(of)
    yield "SATURATE", full_well(of)
    yield "CNL", nonlinearity(of)
    yield "IPC", capacitance(of)
    yield "BADPIX", bits
    yield "READ", noise(of, bits)
    yield "GAIN", gain(of)
    yield "BIAS", bias(of)
