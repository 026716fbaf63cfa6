"""A CCD: charge that overflows, sixteen amplifiers, and the way back to electrons."""

import numpy as np
import pytest

from romandask.kernels.detectors.ccd import (
    AMPLIFIERS,
    BIAS,
    GAIN,
    RAYS,
    Amplifiers,
    amplifiers,
    bleed,
    calibrate,
    over_pixels,
    read_out,
    segments,
)
from romandask.kernels.detectors.cosmic_rays import PIXEL_SIZE, hits, tracks
from romandask.model.seeds import rng

SHAPE = (400, 320)
WELL = 1000.0


def flat(noise: float = 9.0, well: float = WELL) -> Amplifiers:
    one = np.ones(AMPLIFIERS)
    return Amplifiers(GAIN * one, BIAS * one, noise * one, well * one)


def test_sixteen_amplifiers_cover_the_ccd_once():
    covered = np.zeros((4000, 4072), int)
    for _, _, rows, columns in segments(covered.shape):
        covered[rows, columns] += 1
        assert (rows.stop - rows.start, columns.stop - columns.start) == (2000, 509)
    assert (covered == 1).all()
    assert len(segments(covered.shape)) == 16


def test_what_a_pixel_cannot_hold_goes_half_up_half_down_its_column():
    charge = np.zeros(SHAPE, np.float32)
    charge[50, 30] = 7.4 * WELL
    charge[52, 31] = 0.9 * WELL
    after, full = bleed(charge, flat())
    assert after.sum() == pytest.approx(charge.sum(), rel=1e-6)
    # six and four tenths over: 3.2 either way
    np.testing.assert_allclose(after[46:55, 30] / WELL, [0.2, 1, 1, 1, 1, 1, 1, 1, 0.2], atol=1e-4)
    assert after[:, 31].sum() == pytest.approx(0.9 * WELL)
    np.testing.assert_array_equal(np.flatnonzero(full[:, 30]), np.arange(47, 54))
    assert full.sum() == 7


def test_charge_turns_back_at_the_middle_and_leaves_at_the_ends():
    charge = np.zeros(SHAPE, np.float32)
    middle = SHAPE[0] // 2
    charge[middle - 1, 5] = 11 * WELL
    charge[middle, 9] = 11 * WELL
    charge[2, 20] = 11 * WELL
    charge[SHAPE[0] - 1, 25] = 11 * WELL
    after, _ = bleed(charge, flat())
    assert after[:, 5].sum() == pytest.approx(11 * WELL)
    assert not after[middle:, 5].any()
    np.testing.assert_allclose(after[middle - 11 : middle, 5], WELL)
    assert not after[:middle, 9].any()
    np.testing.assert_allclose(after[middle : middle + 11, 9], WELL)
    # five up and five down, of which two find room; at the very end one half is lost
    assert after[:, 20].sum() == pytest.approx((1 + 5 + 2) * WELL)
    assert after[:, 25].sum() == pytest.approx(6 * WELL)


def test_bleeding_is_that_of_pixels_one_by_one():
    """Against the same rule written out slowly, on columns with several full pixels."""
    charge = rng(3, "charge").exponential(0.6 * WELL, SHAPE).astype(np.float32)
    after, full = bleed(charge, flat())
    slow = charge.astype(float).copy()
    half = SHAPE[0] // 2
    for columns in (slow[:half], slow[half:][::-1]):
        for column in columns.T:
            for y in range(len(column)):
                if column[y] > WELL:
                    up = down = (column[y] - WELL) / 2
                    column[y] = WELL
                    for k in range(y + 1, len(column)):
                        step = min(up, max(WELL - column[k], 0))
                        column[k], up = column[k] + step, up - step
                    down += up
                    for k in range(y - 1, -1, -1):
                        step = min(down, max(WELL - column[k], 0))
                        column[k], down = column[k] + step, down - step
    np.testing.assert_allclose(after, slow, atol=0.05)
    assert after.max() <= WELL * (1 + 1e-6)
    # but for what rounding brings to the limit
    assert np.mean(full != (slow >= WELL * (1 - 1e-5))) < 1e-4


def test_photon_transfer_gives_the_gains_and_the_dark_the_noise_and_bias():
    chips = amplifiers(rng(1, "chips"), 9.0, 1e5)
    assert np.std(chips.gain) > 0.01
    light = [rng(1, "light", k).poisson(8000.0, SHAPE).astype(np.float32) for k in range(2)]
    raws = [read_out(one, chips, lambda block, k=k: rng(1, "read", k, block)) for k, one in enumerate(light)]
    dark = read_out(np.zeros(SHAPE, np.float32), chips, lambda block: rng(2, "read", block))
    for j, i, rows, columns in segments(SHAPE):
        part, other = (raw[rows, columns].astype(float) for raw in raws)
        variance = np.var(part - other) / 2 - np.var(dark[rows, columns])
        signal = part.mean() - dark[rows, columns].mean()
        pixels = part.size
        assert signal / variance == pytest.approx(chips.gain[j, i], rel=4 * np.sqrt(2 / pixels) * 1.3)
        assert dark[rows, columns].mean() == pytest.approx(chips.bias[j, i], abs=4 * 9 / np.sqrt(pixels))
        rms = np.sqrt(np.var(dark[rows, columns]) - 1 / 12) * chips.gain[j, i]
        assert rms == pytest.approx(chips.noise[j, i], rel=4 / np.sqrt(2 * pixels))


def test_the_calibrated_image_is_what_was_caught_with_its_variance():
    chips = amplifiers(rng(4, "chips"), 9.0, 1e5)
    caught = rng(4, "light").poisson(600.0, SHAPE).astype(np.float32)
    image, variance = calibrate(read_out(caught, chips, lambda block: rng(4, "read", block)), chips)
    left = image - caught
    noise = over_pixels(chips.noise, SHAPE, slice(0, SHAPE[0]))
    assert left.mean() == pytest.approx(0, abs=4 * 9 / np.sqrt(caught.size))
    assert np.std(left / noise) == pytest.approx(1, abs=0.02)
    assert variance.mean() == pytest.approx(np.var(image), rel=0.03)


def test_muons_are_one_a_square_centimetre_and_minute():
    shape, seconds = (4000, 4072), 3000.0
    found = tracks(shape, seconds, rng(5, "rays"), **RAYS)
    expected = shape[0] * shape[1] * (PIXEL_SIZE * 1e-4) ** 2 * seconds / 60
    assert len(found) == pytest.approx(expected, abs=4 * np.sqrt(expected) + 0.03 * expected)
    # straight down through 100 micrometres: the most probable charge is 7500 electrons
    steep = found[np.hypot(found[:, 2], found[:, 3]) < 3]
    assert np.percentile(steep[:, 4], 30) == pytest.approx(7500, rel=0.1)
    assert hits(shape, found).sum() <= found[:, 4].sum()
