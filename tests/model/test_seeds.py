import numpy as np

from romandask.model.seeds import rng


def test_the_same_identity_gives_the_same_numbers_and_no_other_does():
    first = rng(1, "exposures", "roman", 7, 3).random(4)
    np.testing.assert_array_equal(first, rng(1, "exposures", "roman", np.int64(7), np.int32(3)).random(4))
    others = [
        rng(2, "exposures", "roman", 7, 3),
        rng(1, "coadds", "roman", 7, 3),
        rng(1, "exposures", "rubin", 7, 3),
        rng(1, "exposures", "roman", 3, 7),
        rng(1, "exposures", "roman", 73),
        rng(1, "exposures", "roman", 7, 3, 0),
    ]
    assert all(not np.array_equal(first, other.random(4)) for other in others)


def test_sums_and_products_of_identities_do_not_collide():
    """visit * sca and seed + visit + sca, as public pipelines have it, would repeat many of these."""
    drawn = {
        rng(seed, "x", visit, sca).integers(1 << 62) for seed in range(3) for visit in range(40) for sca in range(18)
    }
    assert len(drawn) == 3 * 40 * 18
