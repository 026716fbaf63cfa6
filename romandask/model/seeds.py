"""Random generators seeded by what they are used for, independent of the order of execution."""

from __future__ import annotations

import hashlib
import json

import numpy as np


def rng(seed: int, stage: str, *identity: int | str) -> np.random.Generator:
    """Return the random generator of one item of a survey.

    The stage and the identity are hashed to 128 bits. Two items therefore never share a random stream because the
    sums or products of their numbers agree, and the order in which items are made does not matter.

    Parameters
    ----------
    seed : int
        Seed of the survey.
    stage : str
        Name of the stage.
    *identity : int or str
        Identity of the item within the stage, for example instrument, visit and detector.

    Examples
    --------
    >>> float(rng(1, "exposures", "roman", 7, 3).random()) == float(rng(1, "exposures", "roman", 3, 7).random())
    False
    """
    words = [stage, *(value if isinstance(value, str) else int(value) for value in identity)]
    digest = hashlib.blake2b(json.dumps(words).encode(), digest_size=16).digest()
    key = np.frombuffer(digest, dtype="<u4")
    return np.random.Generator(np.random.SFC64(np.random.SeedSequence([int(seed), *map(int, key)])))


def realisation_key(realisation: int) -> tuple[int, ...]:
    """Return the part of the identity in `rng` that stands for a noise realisation; empty for realisation 0."""
    return (realisation,) if realisation else ()
