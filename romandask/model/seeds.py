"""Random generators seeded from identity, never from order."""

from __future__ import annotations

import hashlib
import json

import numpy as np


def rng(seed: int, stage: str, *identity: int | str) -> np.random.Generator:
    """Return the generator that belongs to one thing of one survey.

    The identity (stage, then for example survey, visit, detector) is hashed to 128 bits, so two things never
    share a stream because sums or products of their numbers agree, and the order of making does not matter.

    >>> float(rng(1, "exposures", "roman", 7, 3).random()) == float(rng(1, "exposures", "roman", 3, 7).random())
    False
    """
    words = [stage, *(value if isinstance(value, str) else int(value) for value in identity)]
    digest = hashlib.blake2b(json.dumps(words).encode(), digest_size=16).digest()
    key = np.frombuffer(digest, dtype="<u4")
    return np.random.Generator(np.random.SFC64(np.random.SeedSequence([int(seed), *map(int, key)])))


def realisation_key(realisation: int) -> tuple[int, ...]:
    """Return what tells the random numbers of a noise realisation from those of the first."""
    return (realisation,) if realisation else ()
