"""Parquet files are read in slices of rows, and damage to them is reported."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from romandask.ingest import parquet
from romandask.model.errors import UserError


def test_large_row_groups_are_read_in_pieces_and_a_damaged_page_is_reported(tmp_path):
    path = tmp_path / "t.parquet"
    frame = pd.DataFrame({"id": np.arange(50_000), "x": np.random.default_rng(1).normal(size=50_000)})
    pq.write_table(pa.Table.from_pandas(frame), path, row_group_size=50_000, write_page_checksum=True)
    got = parquet.read(path, ["x", "id"], 30_001, 45_000)
    np.testing.assert_array_equal(got["id"].to_numpy(), np.arange(30_001, 45_000))
    assert max(len(chunk) for chunk in got["id"].chunks) <= parquet.CHUNK
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 0xFF
    path.write_bytes(data)
    with pytest.raises(UserError, match=r"t\.parquet: cannot be read"):
        parquet.read(path, ["x", "id"], 0, 50_000)
