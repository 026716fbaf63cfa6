"""CCDs: bleeding, sixteen amplifiers, and the calibration back to electrons."""

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


def equal_amplifiers(noise: float = 9.0, well: float = WELL) -> Amplifiers:
    ones = np.ones(AMPLIFIERS)
    return Amplifiers(GAIN * ones, BIAS * ones, noise * ones, well * ones)


def test_sixteen_amplifiers_cover_the_ccd_once():
    covered = np.zeros((4000, 4072), int)
    for _, _, rows, columns in segments(covered.shape):
        covered[rows, columns] += 1
        assert (rows.stop - rows.start, columns.stop - columns.start) == (2000, 509)
    assert (covered == 1).all()
    assert len(segments(covered.shape)) == 16


def test_excess_charge_moves_half_up_and_half_down_the_column():
    charge = np.zeros(SHAPE, np.float32)
    charge[50, 30] = 7.4 * WELL
    charge[52, 31] = 0.9 * WELL
    after, full = bleed(charge, equal_amplifiers())
    assert after.sum() == pytest.approx(charge.sum(), rel=1e-6)
    # the excess is 6.4 wells: 3.2 in each direction
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
    after, _ = bleed(charge, equal_amplifiers())
    assert after[:, 5].sum() == pytest.approx(11 * WELL)
    assert not after[middle:, 5].any()
    np.testing.assert_allclose(after[middle - 11 : middle, 5], WELL)
    assert not after[:middle, 9].any()
    np.testing.assert_allclose(after[middle : middle + 11, 9], WELL)
    # 5 wells move up and 5 down, of which 2 fit before the end of the column; at the end, one half is lost
    assert after[:, 20].sum() == pytest.approx((1 + 5 + 2) * WELL)
    assert after[:, 25].sum() == pytest.approx(6 * WELL)


def test_bleeding_agrees_with_a_loop_over_pixels():
    """Compare with a plain Python loop, for columns with several full pixels."""
    charge = rng(3, "charge").exponential(0.6 * WELL, SHAPE).astype(np.float32)
    after, full = bleed(charge, equal_amplifiers())
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
    # masks may differ for pixels that rounding brings to the full well
    assert np.mean(full != (slow >= WELL * (1 - 1e-5))) < 1e-4


def test_photon_transfer_recovers_gains_and_a_dark_noise_and_bias():
    chips = amplifiers(rng(1, "chips"), 9.0, 1e5)
    assert np.std(chips.gain) > 0.01
    light = [rng(1, "light", k).poisson(8000.0, SHAPE).astype(np.float32) for k in range(2)]
    raws = [read_out(charge, chips, lambda block, k=k: rng(1, "read", k, block)) for k, charge in enumerate(light)]
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


def test_the_calibrated_image_is_the_charge_with_its_variance():
    chips = amplifiers(rng(4, "chips"), 9.0, 1e5)
    charge = rng(4, "light").poisson(600.0, SHAPE).astype(np.float32)
    image, variance = calibrate(read_out(charge, chips, lambda block: rng(4, "read", block)), chips)
    residual = image - charge
    noise = over_pixels(chips.noise, SHAPE, slice(0, SHAPE[0]))
    assert residual.mean() == pytest.approx(0, abs=4 * 9 / np.sqrt(charge.size))
    assert np.std(residual / noise) == pytest.approx(1, abs=0.02)
    assert variance.mean() == pytest.approx(np.var(image), rel=0.03)


def test_muons_hit_once_per_square_centimetre_and_minute():
    shape, seconds = (4000, 4072), 3000.0
    muons = tracks(shape, seconds, rng(5, "rays"), **RAYS)
    expected = shape[0] * shape[1] * (PIXEL_SIZE * 1e-4) ** 2 * seconds / 60
    assert len(muons) == pytest.approx(expected, abs=4 * np.sqrt(expected) + 0.03 * expected)
    # perpendicular tracks through 100 micrometres: the most probable charge is 7500 electrons
    steep = muons[np.hypot(muons[:, 2], muons[:, 3]) < 3]
    assert np.percentile(steep[:, 4], 30) == pytest.approx(7500, rel=0.1)
    assert hits(shape, muons).sum() <= muons[:, 4].sum()
