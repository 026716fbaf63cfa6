"""Helpers for tests of source readers."""

from __future__ import annotations

import pandas as pd

from romandask.ingest.rows import Source


def read_all(source: Source) -> pd.DataFrame:
    """Return the rows of all batches of a source."""
    return pd.concat([source.read(batch) for batch in source.batches()], ignore_index=True)


def assert_same_rows(first: pd.DataFrame, second: pd.DataFrame, *ignored: str) -> None:
    """Check that two frames are equal apart from the columns `ignored`."""
    pd.testing.assert_frame_equal(first.drop(columns=list(ignored)), second.drop(columns=list(ignored)))
