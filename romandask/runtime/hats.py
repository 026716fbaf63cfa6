"""HATS catalogs: the files beside the partitions that let pandas, pyarrow, hats and LSDB read them."""

from __future__ import annotations

import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
from hats.catalog import CatalogType, TableProperties
from hats.pixel_math.spatial_index import SPATIAL_INDEX_COLUMN, compute_spatial_index

from romandask.runtime.manifest import read_record
from romandask.runtime.products import TableProduct
from romandask.runtime.store import Store, write_bytes


def with_spatial_index(frame: pd.DataFrame, ra: str = "ra", dec: str = "dec") -> pd.DataFrame:
    """Return the rows sorted by, and with, their HEALPix cell of order 29."""
    index = compute_spatial_index(frame[ra].to_numpy(float), frame[dec].to_numpy(float))
    return frame.assign(**{SPATIAL_INDEX_COLUMN: index}).sort_values(
        SPATIAL_INDEX_COLUMN, kind="stable", ignore_index=True
    )


def write_catalog_files(product: TableProduct, store: Store, ra: str = "ra", dec: str = "dec") -> None:
    """Write hats.properties, partition_info.csv, dataset/_metadata and dataset/_common_metadata of a stored catalog."""
    root = store.catalog(product.stage)
    rows, metadata, present = 0, None, []
    for unit, pixel in zip(product.units, product.pixels or (), strict=True):
        record = read_record(store, product.stage, unit.name)
        if record is None or record.rows == 0:
            continue
        path = store.partition(product.stage, product.order or 0, pixel)
        footer = pq.read_metadata(path)
        footer.set_file_path(str(path.relative_to(root / "dataset")))
        if metadata is None:
            metadata = footer
        else:
            metadata.append_row_groups(footer)
        rows += record.rows
        present.append(pixel)
    _drop_strays(product, store, set(present))
    info = "Norder,Npix\n" + "".join(f"{product.order},{pixel}\n" for pixel in present)
    write_bytes(root / "partition_info.csv", info.encode())
    for name, content in (("_common_metadata", None), ("_metadata", metadata)):
        sink = pa.BufferOutputStream()
        if content is None:
            pq.write_metadata(product.schema, sink)
        else:
            content.write_metadata_file(sink)
        write_bytes(root / "dataset" / name, sink.getvalue().to_pybytes())
    # validated from a mapping: the model's own signature does not tell its optional fields
    content = dict(
        obs_collection=product.stage.replace("/", "_"),
        dataproduct_type=CatalogType.OBJECT,
        hats_nrows=rows,
        hats_col_ra=ra,
        hats_col_dec=dec,
        hats_col_healpix=SPATIAL_INDEX_COLUMN,
        hats_col_healpix_order=29,
    )
    TableProperties.model_validate(content).to_properties_file(root)


def _drop_strays(product: TableProduct, store: Store, present: set[int]) -> None:
    """Remove partitions that no unit of the catalog has (an earlier configuration's)."""
    dataset = store.catalog(product.stage) / "dataset"
    wanted = {store.partition(product.stage, product.order or 0, pixel) for pixel in present}
    for path in dataset.glob("Norder=*/Dir=*/Npix=*.parquet"):
        if path not in wanted:
            path.unlink()
