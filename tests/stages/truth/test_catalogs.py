"""Truth catalogs: generated or from source catalogs, as HATS collections and as exported files."""

from pathlib import Path

import galsim
import h5py
import lsdb
import numpy as np
import pandas as pd
import pyarrow.dataset as ds
import pyarrow.parquet as pq
import pytest
from astropy.io import fits
from astropy.table import Table
from conftest import command
from hats.io.validation import is_valid_catalog, is_valid_collection
from hats.loaders import read_hats
from rich.console import Console

from romandask.engine.graph import UnitGraph
from romandask.engine.progress import Reporter
from romandask.engine.runners import InProcess
from romandask.export.truth import export_truth
from romandask.ingest.rows import TEXT_COLUMNS
from romandask.ingest.table import MAPPED_COLUMNS
from romandask.instruments.rubin.rubin import Rubin, RubinSettings
from romandask.model.errors import UserError
from romandask.model.settings import TruthSettings
from romandask.model.sky import Cone, Region, chord, unit_vectors
from romandask.pipeline import pipeline_of
from romandask.products.hats import WIDTH, margin, write_catalog_files
from romandask.run import ingest
from romandask.stage_graph import stage_products
from romandask.stages.truth.catalogs import truth
from romandask.stages.truth.ingested import _ReadBatch
from romandask.storage.store import Store
from romandask.survey import Survey

REGION = Region(53.0, 53.04, -40.03, -40.0)
BANDS = {band: Rubin(RubinSettings()).bandpass(band) for band in "gri"}
SAMPLE = Region(53.5, 56.3, -37.1, -34.2)
EVERYWHERE = {"ra": [0, 360], "dec": [-90, 90]}


def made(order: int, **settings):
    return truth(TruthSettings(order=order, margin=0.0, nside=64, **settings), Path("."), REGION, BANDS, 7)


def sample(shared, **settings):
    options = {"source": "skycatalogs", "path": "skycatalogs_sample", "seds": "seds", "order": 6} | settings
    return truth(TruthSettings(**options), shared, SAMPLE, BANDS, 1)


def stored(product, store):
    """Return the product after all its units and HATS files have been stored."""
    UnitGraph.of(product, store).compute(scheduler="sync")
    if product.pixels is not None:
        write_catalog_files(product, store)
    return product.stored(store)


def plain(frame):
    """Return rows sorted by id, without the columns of top-hat spectra."""
    key = "galaxy_id" if "galaxy_id" in frame else "id"
    columns = [name for name in frame if not name.startswith("sed_val")]
    return frame.sort_values(key, ignore_index=True)[columns]


@pytest.mark.slow
def test_rows_do_not_depend_on_partitions():
    coarse, fine = made(8), made(11)
    for kind in ("galaxies", "stars"):
        first, second = (plain(getattr(catalogs, kind).all_rows()) for catalogs in (coarse, fine))
        pd.testing.assert_frame_equal(first, second)
        assert first.iloc[:, 1].is_unique
    assert not set(coarse.stars.all_rows()["id"]) & set(coarse.galaxies.all_rows()["galaxy_id"])


def test_a_smaller_region_has_the_same_rows_as_a_larger_one():
    """The edge of a region has no effect on the rows inside it."""
    small = Region(53.01, 53.03, -40.02, -40.01)
    settings = TruthSettings(order=11, margin=0.0, nside=64)
    inner = plain(truth(settings, Path("."), small, BANDS, 7).galaxies.all_rows())
    whole = plain(made(11).galaxies.all_rows())
    kept = whole[small.contains(whole["ra"], whole["dec"])].reset_index(drop=True)
    pd.testing.assert_frame_equal(inner, kept)


def test_a_variant_of_the_universe_differs_in_its_shear_alone():
    plus, minus = (plain(made(9, shear=(sign * 0.02, -sign * 0.01)).galaxies.all_rows()) for sign in (1, -1))
    np.testing.assert_allclose(plus["shear_1"] - minus["shear_1"], 0.04, atol=1e-12)
    np.testing.assert_allclose(plus["shear_2"] - minus["shear_2"], -0.02, atol=1e-12)
    same = [name for name in plus if not name.startswith(("shear", "flux"))]
    pd.testing.assert_frame_equal(plus[same], minus[same])
    with pytest.raises(ValueError, match="weak regime"):
        TruthSettings(shear=(0.3, 0.0))


def test_stars_take_the_spectra_of_a_folder(shared):
    catalogs = made(8, stars=300, star_seds=str(shared / "seds/starSED"))
    library, stars = catalogs.library, catalogs.stars.all_rows()
    names = np.array(library.names)[stars["sed"]]
    assert all("gz" in name for name in names)
    assert len(set(names)) > 8, "hot and cool stars"
    assert (stars[["flux_g", "flux_r", "flux_i"]] > 0).all(axis=None)
    with pytest.raises(UserError, match=r"no spectrum can be used"):
        made(8, star_seds=str(shared / "opsim"))


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::pandas.errors.Pandas4Warning", "ignore:The default suffix behavior")
def test_catalogs_are_hats_collections_that_lsdb_hats_pandas_and_pyarrow_read(tmp_path):
    catalogs, store = made(10, stars=60), Store(tmp_path)
    for name in ("galaxies", "stars"):
        product = stored(getattr(catalogs, name), store)
        rim = stored(margin(product), store)
        folder = store.collection(product.stage)
        assert is_valid_collection(folder, strict=True)
        assert is_valid_catalog(folder / "catalog", strict=True)
        frame = product.all_rows()
        assert read_hats(folder / "catalog").catalog_info.total_rows == len(frame)
        part = pd.read_parquet(folder / "catalog/dataset", filters=[("dec", ">", -40.015)])
        assert 0 < len(part) == (frame["dec"] > -40.015).sum() < len(frame)
        assert ds.dataset(folder / "catalog/dataset", format="parquet").count_rows() == len(frame)
        field = pq.read_schema(folder / "catalog/dataset/_common_metadata").field("ra")
        assert (field.metadata[b"unit"], field.metadata[b"ucd"]) == (b"deg", b"pos.eq.ra;meta.main")
        assert len(rim.all_rows()) > 0
    key = dict(ra=53.02, dec=-40.015)
    cone = lsdb.open_catalog(store.collection("truth/galaxies")).cone_search(**key, radius_arcsec=20)
    expected = catalogs.galaxies.all_rows()
    expected = expected[Cone(53.02, -40.015, 20).contains(expected["ra"], expected["dec"])]
    assert set(cone.compute()["galaxy_id"]) == set(expected["galaxy_id"])
    pairs = lsdb.open_catalog(store.collection("truth/stars")).crossmatch(
        lsdb.open_catalog(store.collection("truth/galaxies")), radius_arcsec=5, n_neighbors=50, suffixes=("_s", "_g")
    )
    stars, galaxies = catalogs.stars.all_rows(), catalogs.galaxies.all_rows()
    gap = unit_vectors(stars["ra"], stars["dec"])[:, None] - unit_vectors(galaxies["ra"], galaxies["dec"])[None]
    brute = (np.linalg.norm(gap, axis=2) <= chord(5)).sum()
    assert len(pairs.compute()) == brute, "pairs across partitions come from the margin"


def test_margins_hold_all_that_is_near(tmp_path):
    product = stored(made(11).galaxies, Store(tmp_path))
    rim = margin(product)
    every = product.all_rows()
    vectors = unit_vectors(every["ra"], every["dec"])
    home = every["_healpix_29"].to_numpy() >> (2 * (29 - 11))
    for index in range(0, len(product.units), 3):
        own, found = product.load(index), rim.load(index)
        outside = home != product.pixels[index]
        assert set(found["galaxy_id"]) <= set(every["galaxy_id"][outside])
        if own.empty:
            continue
        gap = np.linalg.norm(vectors[outside][:, None] - unit_vectors(own["ra"], own["dec"])[None], axis=2).min(axis=1)
        assert set(every["galaxy_id"][outside][gap < chord(WIDTH)]) <= set(found["galaxy_id"])


def test_a_cone_reads_its_own_pixels_alone(tmp_path):
    product = stored(made(11).galaxies, Store(tmp_path))
    cone = Cone(53.02, -40.015, 20.0)
    frame = product.within(cone)
    assert frame.npartitions < len(product.units)
    every = product.all_rows()
    inside = every[cone.contains(every["ra"], every["dec"])]
    for path in (tmp_path / "truth/galaxies/catalog/dataset").rglob("Npix=*.parquet"):
        pixel = int(path.stem.split("=")[1])
        if product.touching(cone.cells(11)).count(product.pixels.index(pixel)) == 0:
            path.write_bytes(b"not to be read")
    assert set(frame.compute()["galaxy_id"]) == set(inside["galaxy_id"])


@pytest.mark.slow
def test_the_real_sample_reads_with_its_inf_and_nan(shared):
    catalogs = sample(shared)
    galaxies, stars, bad = (table.all_rows() for table in (catalogs.galaxies, catalogs.stars, catalogs.quarantine))
    assert np.isinf(galaxies["bulge_magnorm"]).any(), "inf magnorm: no such component"
    assert np.isfinite(galaxies[["flux_g", "flux_r", "flux_i"]].to_numpy()).all()
    assert (bad["reason"] == "SED not in the library").sum() > 100
    assert len(galaxies) + len(stars) > 400
    assert (stars[["flux_g", "flux_r", "flux_i"]] > 0).all(axis=None)
    assert (galaxies["lsst_flux_r"] > 0).mean() > 0.5, "flux files are joined"


def test_colours_of_the_real_sample_are_those_that_skycatalogs_gives(shared):
    """The published fluxes have other throughputs: the colours of the same objects agree within their scatter."""
    both = sample(shared).galaxies.all_rows()
    both = both[(both["lsst_flux_r"] > 1e-6) & (both["flux_r"] > 0)]
    assert len(both) > 200
    for band in "ri":
        ratio = 2.5 * np.log10(both[f"flux_{band}"] / both[f"lsst_flux_{band}"])
        assert (ratio - ratio.median()).std() < 0.12


@pytest.mark.slow
def test_a_source_is_read_once(tmp_path, shared, monkeypatch):
    """Cells and spectra are found from the stored rows, without a second pass over the files."""
    read, batch = [], _ReadBatch.__call__

    def counted(maker, index):
        read.append(index)
        return batch(maker, index)

    monkeypatch.setattr(_ReadBatch, "__call__", counted)
    _, survey = ingested(tmp_path, shared, {"source": "skycatalogs", "path": "skycatalogs_sample"})
    assert sorted(read) == list(range(len(survey.output("truth/ingested").units)))


def ingested(tmp_path, shared, settings, seds="seds"):
    content = {
        "name": "ingest",
        "seed": 0,
        "region": EVERYWHERE,
        "roman": {},
        "rubin": {},
        "data": str(shared),
        "truth": {"order": 4, "seds": str(shared / seds), **settings},
    }
    store = Store(tmp_path / "store")
    store.prepare()
    counts = ingest(Survey(pipeline_of(content, "test"), store), InProcess(), Reporter(Console()))
    return counts, Survey(pipeline_of(content, "test"), store)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("settings", "rows"),
    [
        ({"source": "skycatalogs", "path": "skycatalogs_sample"}, 4987),
        ({"source": "instance_catalog", "path": "dc2_instance_catalog/example_instance_catalog.txt"}, 1998),
    ],
)
def test_every_row_of_a_source_is_out_or_in_quarantine(shared, tmp_path, settings, rows):
    counts, survey = ingested(tmp_path, shared, settings)
    assert counts["in"] == rows == counts["out"] + counts["quarantined"]
    galaxies, stars = survey.truth("galaxies").compute(), survey.truth("stars").compute()
    assert counts["out"] == galaxies["n_rows"].sum() + stars["n_rows"].sum()
    assert len(galaxies) > 40
    assert len(stars) > 300
    bands = [name for name in galaxies if name.startswith("flux_") and not name.endswith("noMW")]
    assert len(bands) == 10
    assert (galaxies[bands].to_numpy() >= 0).all()
    assert (galaxies["flux_r_noMW"] >= galaxies["flux_r"]).all()
    for kind in ("galaxies", "stars"):
        assert is_valid_collection(survey.store.collection(f"truth/{kind}"), strict=True)


def test_an_instance_catalogs_fluxes_are_galsims(shared, tmp_path):
    """Fluxes of stars in the real file are compared with GalSim, from SED file and magnorm; there is a little dust."""
    _, survey = ingested(
        tmp_path, shared, {"source": "instance_catalog", "path": "dc2_instance_catalog/example_instance_catalog.txt"}
    )
    stars = survey.truth("stars").compute().nlargest(5, "flux_r")
    at_500 = galsim.Bandpass(galsim.LookupTable([499.95, 500.05], [1.0, 1.0], interpolant="linear"), "nm")
    reference = galsim.Bandpass("LSST_r.dat", "nm").withZeropoint("AB")
    for row in stars.itertuples():
        table = np.loadtxt(shared / "seds" / survey.truth_catalogs.library.names[row.sed])
        table = table[(table[:, 0] > 250) & (table[:, 0] < 2600)]
        sed = galsim.SED(galsim.LookupTable(*table.T, interpolant="linear"), "nm", "flambda")
        magnitude = sed.withMagnitude(row.magnorm, at_500.withZeropoint("AB")).calculateMagnitude(reference)
        assert 31.4 - 2.5 * np.log10(row.flux_r_noMW) == pytest.approx(magnitude, abs=2e-3)
        assert row.dust_r == pytest.approx(0.86 * row.MW_av, rel=0.05)


@pytest.mark.slow
def test_a_table_with_a_map_of_its_columns(shared, tmp_path):
    galaxies = {
        "objid": np.arange(50),
        "alpha": np.linspace(10, 10.2, 50),
        "delta": np.linspace(-5, -4.9, 50),
        "z": np.linspace(0.1, 2, 50),
        "m": np.full(50, 24.0),
        "hlr": np.full(50, 0.4),
        "spectrum": ["flat"] * 50,
    }
    galaxies["hlr"][3] = -1.0
    galaxies["z"][4] = np.nan
    Table(galaxies).write(tmp_path / "g.fits")
    wave = np.linspace(50, 3000, 3000)
    np.savetxt(tmp_path / "flat", np.stack([wave, wave**-2.0], 1))
    (tmp_path / "short").write_text("400 1\n500 1\n600 1\n")
    (tmp_path / "map.yaml").write_text(
        "galaxies:\n  path: g.fits\n  columns: {id: objid, ra: alpha, dec: delta, redshift: z, disk_magnorm: m, "
        "size_disk_true: hlr, disk_sed: spectrum}\n"
    )
    done = command("ingest", "table", str(tmp_path / "map.yaml"), "--store", "s", "--seds", str(tmp_path), cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "rows in 50 = rows out 48 + quarantined 2" in done.stdout
    frame = pd.read_parquet(tmp_path / "s/truth/galaxies/catalog/dataset")
    # for flat f_nu, magnorm at 500 nm in the rest frame fixes the flux in every band, up to the factor 1 + z
    expected = 24.0 - 2.5 * np.log10(1 + frame["redshift"])
    np.testing.assert_allclose(31.4 - 2.5 * np.log10(frame["flux_H158"]), expected, atol=2e-3)
    reasons = pd.read_parquet(tmp_path / "s/truth/quarantine")["reason"]
    assert sorted(reasons) == ["redshift is not a number", "size is negative or not a number"]
    text = (tmp_path / "map.yaml").read_text()
    (tmp_path / "map.yaml").write_text(text.replace("disk_sed: spectrum", "disk_sed: '=short'"))
    done = command("ingest", "table", str(tmp_path / "map.yaml"), "--store", "t", "--seds", str(tmp_path), cwd=tmp_path)
    assert "rows out 0 + quarantined 50" in done.stdout, done.stderr
    assert "spectrum does not cover the bands" in set(pd.read_parquet(tmp_path / "t/truth/quarantine")["reason"])
    (tmp_path / "map.yaml").write_text(text.replace("redshift: z", "redshft: z"))
    done = command("ingest", "table", str(tmp_path / "map.yaml"), "--store", "u", cwd=tmp_path)
    assert done.returncode == 2
    assert "redshft" in done.stderr
    assert "Traceback" not in done.stderr
    assert not (tmp_path / "u").exists()


@pytest.mark.slow
def test_truth_leaves_as_fits_and_hdf5(tmp_path, shared):
    _, survey = ingested(tmp_path, shared, {"source": "skycatalogs", "path": "skycatalogs_sample"})
    export_truth(survey, tmp_path / "out")
    galaxies = survey.truth("galaxies").compute()
    with fits.open(tmp_path / "out/galaxies.fits") as hdus:
        hdus.verify("exception")
        table = hdus[1].data
        assert len(table) == len(galaxies)
        np.testing.assert_array_equal(table["galaxy_id"], galaxies["galaxy_id"])
        np.testing.assert_array_equal(table["flux_H158"], galaxies["flux_H158"].to_numpy())
        np.testing.assert_array_equal(table["sed_extended"], galaxies["sed_extended"])
        np.testing.assert_array_equal(table["sed_val_disk"][7], galaxies["sed_val_disk"].iloc[7])
        assert hdus[1].columns["size_disk_true"].unit == "arcsec"
    with h5py.File(tmp_path / "out/seds.hdf5") as file:
        assert file["flambda"].shape == (len(file["name"]), len(file["wave"]))
        assert len(file["tophat_edges"]) == 31
    (survey.store.record("truth/stars", survey.truth_catalogs.stars.names[0])).unlink()
    with pytest.raises(UserError, match="truth/stars is not all there: 1 of"):
        export_truth(Survey(survey.pipeline, survey.store), tmp_path / "again")


@pytest.mark.slow
def test_exported_truth_is_read_again_without_loss(tmp_path, shared):
    instances = {"source": "instance_catalog", "path": "dc2_instance_catalog/example_instance_catalog.txt"}
    _, survey = ingested(tmp_path / "first", shared, instances)
    out = tmp_path / "out"
    export_truth(survey, out)
    tables = {}
    for key, name, identifier in (("galaxy_table", "galaxies", "galaxy_id"), ("star_table", "stars", "id")):
        found = fits.getdata(out / f"{name}.fits").names
        columns = {column: column for column in MAPPED_COLUMNS if column in found} | {"id": identifier}
        columns |= {column: f"{column}_name" for column in TEXT_COLUMNS if f"{column}_name" in found}
        tables[key] = {"path": str(out / f"{name}.fits"), "columns": columns}
    counts, again = ingested(tmp_path / "second", shared, {"source": "table", **tables}, out / "seds.hdf5")
    assert counts["quarantined"] == 0
    for name in ("galaxies", "stars"):
        first, second = (plain(one.truth(name).compute()) for one in (survey, again))
        spectra = [column for column in first if column == "sed" or column.endswith("_sed")]
        for column in spectra:
            names = [np.array([*one.truth_catalogs.library.names, ""], object) for one in (survey, again)]
            assert (names[0][first[column]] == names[1][second[column]]).all()
        ignored = ["n_rows", *spectra]
        pd.testing.assert_frame_equal(first.drop(columns=ignored), second.drop(columns=ignored), rtol=1e-6)


@pytest.mark.slow
def test_a_missing_column_or_a_truncated_file_is_named(shared, tmp_path):
    folder = tmp_path / "s"
    folder.mkdir()
    (folder / "skyCatalog.yaml").write_bytes((shared / "skycatalogs_sample/skyCatalog.yaml").read_bytes())
    table = pq.read_table(shared / "skycatalogs_sample/galaxy_9683.parquet")
    pq.write_table(table.drop_columns(["convergence"]), folder / "galaxy_9683.parquet")
    done = command("ingest", "skycatalogs", str(folder), "--store", "x", cwd=tmp_path)
    assert done.returncode == 2
    assert "galaxy_9683.parquet" in done.stderr
    assert "convergence" in done.stderr
    path = folder / "galaxy_9683.parquet"
    path.write_bytes(path.read_bytes()[:5000])
    done = command("ingest", "skycatalogs", str(folder), "--store", "x", cwd=tmp_path)
    assert done.returncode == 2
    assert "5000 bytes" in done.stderr
    assert not (tmp_path / "x").exists()


def test_stages_of_a_source_begin_with_its_rows(shared):
    content = {
        "name": "n",
        "seed": 0,
        "region": EVERYWHERE,
        "data": str(shared),
        "roman": {},
        "rubin": {},
        "truth": {"source": "skycatalogs", "path": "skycatalogs_sample"},
    }
    names = [one.name for one in stage_products(Survey(pipeline_of(content, "test")))]
    assert names[:5] == [
        "truth/ingested",
        "truth/galaxies",
        "truth/galaxies_margin",
        "truth/stars",
        "truth/stars_margin",
    ]
