"""HATS collections: catalogs with margins, and the files that let pandas, pyarrow, hats and LSDB read them."""

from __future__ import annotations

from dataclasses import dataclass

import cdshealpix.nested as healpix
import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
from hats.catalog import CatalogType, TableProperties
from hats.catalog.dataset.collection_properties import CollectionProperties
from hats.pixel_math.spatial_index import SPATIAL_INDEX_COLUMN, compute_spatial_index

from romandask.products.tables import TableProduct
from romandask.products.units import LazyUnits, Unit
from romandask.storage.manifest import read_record
from romandask.storage.paths import AnyPath, remove, write_bytes
from romandask.storage.store import MARGIN, Store

WIDTH = 10.0
"""Rows this near to a partition, arcsec, are in its margin: further than any linking length in use."""
RIM_ORDER = 13
"""HEALPix order of the cells around a partition that make its margin: 26 arcsec wide, 18 where they are flattest."""
RIM = 18.0
"""So far, arcsec, a margin reaches anywhere."""


def with_spatial_index(frame: pd.DataFrame, ra: str = "ra", dec: str = "dec") -> pd.DataFrame:
    """Return the rows sorted by, and with, their HEALPix cell of order 29."""
    index = compute_spatial_index(frame[ra].to_numpy(float), frame[dec].to_numpy(float))
    return frame.assign(**{SPATIAL_INDEX_COLUMN: index}).sort_values(
        SPATIAL_INDEX_COLUMN, kind="stable", ignore_index=True
    )


def margin(product: TableProduct) -> TableProduct:
    """Return the margin of a catalog: for each partition the rows of others around it, within WIDTH at least."""
    order, pixels = product.order or 0, np.array(product.pixels or (), np.int64)
    rims = [rim(pixel, order) for pixel in pixels.tolist()]
    around = [product.touching_cells(cells, RIM_ORDER) for cells in rims]

    def unit(index: int) -> Unit:
        inputs = tuple((product.stage, product.names[k]) for k in around[index])
        return Unit(product.names[index], {"width": WIDTH, "rim": RIM_ORDER}, inputs)

    return TableProduct(
        stage=product.stage + MARGIN,
        units=LazyUnits(product.names, unit),
        make=_MakeMargin(product, order),
        schema=product.schema,
        pixels=product.pixels,
        order=product.order,
        bytes_per_unit=product.bytes_per_unit,
        seconds_per_unit=0.05 * product.seconds_per_unit,
        store=product.store,
    )


@dataclass(frozen=True)
class _MakeMargin:
    product: TableProduct
    order: int

    def __call__(self, index: int) -> pd.DataFrame:
        found = self.product.rows_in(rim((self.product.pixels or ())[index], self.order), RIM_ORDER)
        return found.sort_values(SPATIAL_INDEX_COLUMN, kind="stable", ignore_index=True)


def rim(pixel: int, order: int) -> np.ndarray:
    """Return the cells of RIM_ORDER that lie along the outside of a cell, corners included."""
    edges, corners = healpix.external_neighbours(np.array([pixel], np.uint64), order, RIM_ORDER - order)
    found = np.concatenate([np.ravel(edges), np.ravel(corners)]).astype(np.int64)
    return np.unique(found[found >= 0])


def rows_around(product: TableProduct, pixel: int, order: int, columns: list[str]) -> pd.DataFrame:
    """Return some columns of the rows of a catalog in a HEALPix cell of any order and then along its outside."""
    places = [(np.array([pixel]), order), (rim(pixel, order), RIM_ORDER)]
    return pd.concat([product.rows_in(*place, columns) for place in places])


def inner_rim(pixel: int, order: int) -> np.ndarray:
    """Return the cells of RIM_ORDER that lie along the inside of a cell."""
    around = np.unique(healpix.neighbours(rim(pixel, order).astype(np.uint64), RIM_ORDER).astype(np.int64))
    return around[around >> 2 * (RIM_ORDER - order) == pixel]


def write_catalog_files(product: TableProduct, store: Store, ra: str = "ra", dec: str = "dec") -> None:
    """Write hats.properties, partition_info.csv, dataset/_metadata and dataset/_common_metadata of a stored catalog.

    With the margin's, written after the catalog's own, comes collection.properties.
    """
    root = store.catalog(product.stage)
    rows, metadata, present = 0, None, []
    for name, pixel in zip(product.names, product.pixels or (), strict=True):
        record = read_record(store, product.stage, name)
        if record is None or record.rows == 0:
            continue
        path = store.partition(product.stage, product.order or 0, pixel)
        with path.open("rb") as file:
            footer = pq.read_metadata(file)
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
    properties = dict(
        obs_collection=product.stage.replace("/", "_"),
        dataproduct_type=CatalogType.OBJECT,
        hats_nrows=rows,
        hats_col_ra=ra,
        hats_col_dec=dec,
        hats_col_healpix=SPATIAL_INDEX_COLUMN,
        hats_col_healpix_order=29,
    )
    if product.stage.endswith(MARGIN):
        primary = product.stage.removesuffix(MARGIN).replace("/", "_")
        properties |= dict(
            dataproduct_type=CatalogType.MARGIN, hats_primary_table_url=primary, hats_margin_threshold=WIDTH
        )
        _write_collection(store.collection(product.stage), primary)
    TableProperties.model_validate(properties).to_properties_file(root)


def _write_collection(folder: AnyPath, name: str) -> None:
    content = dict(
        obs_collection=name, hats_primary_table_url="catalog", all_margins=["margin"], default_margin="margin"
    )
    CollectionProperties.model_validate(content).to_properties_file(folder)


def _drop_strays(product: TableProduct, store: Store, present: set[int]) -> None:
    """Remove partitions that no unit of the catalog has (an earlier configuration's)."""
    dataset = store.catalog(product.stage) / "dataset"
    wanted = {store.partition(product.stage, product.order or 0, pixel) for pixel in present}
    for path in dataset.glob("Norder=*/Dir=*/Npix=*.parquet"):
        if path not in wanted:
            remove(path)
