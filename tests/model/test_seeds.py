"""Random generators seeded by identity."""

import numpy as np

from romandask.model.seeds import rng


def test_each_identity_has_its_own_reproducible_stream():
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


def test_similar_identities_have_different_streams():
    """Seeds such as visit * sca or seed + visit + sca, which public pipelines use, would repeat many of these."""
    first_numbers = {
        rng(seed, "x", visit, sca).integers(1 << 62) for seed in range(3) for visit in range(40) for sca in range(18)
    }
    assert len(first_numbers) == 3 * 40 * 18
