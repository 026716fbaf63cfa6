"""Exported images: the values that other tools read from the files are those of the store."""

import warnings

import asdf
import dask
import numpy as np
import pandas as pd
import pytest
import roman_datamodels as rdm
from astropy import units
from astropy.coordinates import SkyCoord
from astropy.io import fits
from astropy.table import Table
from astropy.wcs import WCS
from mocpy import MOC

from romandask.export.asdf import export_asdf
from romandask.export.fits import export_fits
from romandask.export.moc import export_moc
from romandask.export.obscore import export_obscore
from romandask.instruments.exposure import exposure_of
from romandask.model.errors import UserError
from romandask.stages.pointings import corners_of
from romandask.survey import open_survey


@pytest.fixture(scope="module")
def survey(tiny_store):
    with dask.config.set(scheduler="synchronous"):
        yield open_survey(tiny_store)


def test_fits_images_have_the_stored_pixels_and_valid_checksums(survey, tmp_path):
    """astropy reads the stored pixels, with the WCS of the store."""
    roman = survey.output("exposures/roman")
    tile = survey.tiles[0].name
    (one,) = export_fits(survey, tmp_path, "roman", [roman.names[1]], [], [])
    (two,) = export_fits(survey, tmp_path, "rubin", [], [tile], ["i"])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with fits.open(one, checksum=True) as hdus:
            assert [hdu.name for hdu in hdus] == ["PRIMARY", "SCI", "ERR", "DQ"]
            stored = roman.load(1)
            np.testing.assert_array_equal(hdus["SCI"].data, stored["image"])
            np.testing.assert_array_equal(hdus["DQ"].data, stored["dq"])
            assert hdus["SCI"].header["BUNIT"] == "electron"
            assert hdus["DQ"].header["BIT*"]
            # the median absolute deviation of the image is a whole number of electrons, so std is used
            empty = (stored["truth"] < 0.5) & (stored["dq"] == 0)
            scatter = float(hdus["SCI"].data[empty].std(dtype=float))
            assert scatter == pytest.approx(np.median(hdus["ERR"].data[empty]), rel=0.03)
            assert scatter == pytest.approx(hdus[0].header["SKYERR"], rel=0.03)
            at = WCS(hdus["ERR"].header).all_pix2world([[0, 0], [4087, 4000]], 0)
            exposure = exposure_of(survey.pointings("roman").iloc[1])
            expected = WCS(survey.instruments["roman"].header(exposure)).all_pix2world([[0, 0], [4087, 4000]], 0)
            np.testing.assert_allclose(at, expected, rtol=0, atol=1e-12)
        with fits.open(two, checksum=True) as hdus:
            assert [hdu.name for hdu in hdus] == ["PRIMARY", "SCI", "ERR", "DQ", "WHT", "NIMAGES", "PSF"]
            coadd = survey.coadds("rubin").sel(band="i").isel(tile=0)
            np.testing.assert_array_equal(hdus["SCI"].data, coadd["image"])
            np.testing.assert_array_equal(hdus["WHT"].data, coadd["weight"])
            # the weights of these tiles are inverse variances
            covered = hdus["WHT"].data > 0
            error = hdus["ERR"].data[covered] * np.sqrt(hdus["WHT"].data[covered])
            np.testing.assert_allclose(error, 1, rtol=0.02)
            assert "CRVAL1" not in hdus["PSF"].header
            assert WCS(hdus["SCI"].header).wcs.crval[0] == pytest.approx(float(coadd["ra"]))
    assert not list(tmp_path.glob(".*"))


def test_exposures_are_valid_level_2_images(survey, tmp_path):
    """roman_datamodels reads and validates them; the gwcs is the FITS WCS; the calibration gives the flux of a star."""
    product = survey.output("exposures/roman")
    (path,) = export_asdf(survey, tmp_path, [product.names[1]], [], [])
    stored, exposure = product.load(1), exposure_of(survey.pointings("roman").iloc[1])
    instrument = survey.instruments["roman"]
    with rdm.open(path) as model:
        assert isinstance(model, rdm.datamodels.ImageModel)
        model.validate()
        np.testing.assert_allclose(model.data * exposure.exptime, stored["image"], rtol=1e-6, atol=1e-3)
        assert model.meta.instrument.optical_element == exposure.band.replace("H158", "F158")
        assert model.meta.instrument.detector == f"WFI{exposure.detector:02d}"
        assert model.meta.exposure.exposure_time == exposure.exptime
        grid = np.linspace(0, 4087, 40)
        x, y = np.meshgrid(grid, grid)
        wcs = WCS(instrument.header(exposure))
        ra, dec = model.meta.wcs(x, y)
        expected = wcs.all_pix2world(x.ravel(), y.ravel(), 0)
        np.testing.assert_allclose(ra.ravel(), expected[0], rtol=0, atol=1e-10)
        np.testing.assert_allclose(dec.ravel(), expected[1], rtol=0, atol=1e-10)
        saturated = (stored["dq"] & 1) > 0
        flag = int(rdm.dqflags.pixel.SATURATED)
        np.testing.assert_array_equal((np.asarray(model.dq) & flag) > 0, saturated)
        empty = (stored["truth"] < 0.5) & (stored["dq"] == 0)
        assert float(model.data[empty].std(dtype=float)) == pytest.approx(float(np.median(model.err[empty])), rel=0.03)
        # 20 AB mag are 3631e-8 Jy
        photons = instrument.bandpass(exposure.band).ab_photons() * 1e-8
        light = photons * model.meta.photometry.conversion_megajanskys * model.meta.photometry.pixel_area
        assert light * 1e6 == pytest.approx(3631e-8, rel=1e-6)
    assert not list(tmp_path.glob(".*"))


def test_tiles_are_valid_level_3_mosaics(survey, tmp_path):
    """Surface brightness, WCS, bits of the exposures, and the metadata of a simulated community product."""
    tile = survey.tiles[0]
    (path,) = export_asdf(survey, tmp_path, [], [tile.name], ["H158"])
    coadd = survey.coadds("roman").sel(band="H158").isel(tile=0).compute()
    product = survey.output("coadds/roman")
    sets = product.load(product.index(0, "H158", 0, 0), ("sets",))["sets"]
    with rdm.open(path) as model:
        assert isinstance(model, rdm.datamodels.MosaicModel)
        model.validate()
        # MJy/sr over the solid angle of a pixel is its flux
        pixel = (survey.instruments["roman"].coadd_scale * np.pi / 648000) ** 2
        np.testing.assert_allclose(np.asarray(model.data) * pixel * 1e15, coadd["image"], rtol=1e-5, atol=1e-3)
        np.testing.assert_array_equal(model.weight, coadd["weight"])
        covered = np.asarray(model.weight) > 0
        assert (np.asarray(model.err)[covered] > 0).all()
        ra, dec = model.meta.wcs(10.0, 20.0)
        maker = WCS(tile.header(coadd.sizes["x"], survey.instruments["roman"].coadd_scale))
        np.testing.assert_allclose(
            [ra, dec], [float(v) for v in maker.all_pix2world(10.0, 20.0, 0)], rtol=0, atol=1e-10
        )
        names = list(model.meta.resample.members)
        y, x = np.argwhere(covered)[len(np.argwhere(covered)) // 2]
        bits = {name for k, name in enumerate(names) if int(model.context[k // 32, y, x]) >> (k % 32) & 1}
        assert bits == set(sets.loc[sets["set"] == int(coadd["set"][y, x]), "exposure"])
        assert len(bits) == int(coadd["nimages"][y, x])
        # number of electrons of that flux in the exposure time of the pixel
        bright = np.unravel_index(int(coadd["image"].values.argmax()), covered.shape)
        flux, number = float(coadd["image"].values[bright]), int(coadd["nimages"].values[bright])
        seconds = number * float(survey.pointings("roman")["exptime"].iloc[0])
        electrons = survey.instruments["roman"].bandpass("H158").ab_photons() / 3631e9 * seconds * flux
        found = float(np.sqrt(model.var_poisson[bright])) / float(model.data[bright])
        assert found == pytest.approx(1 / np.sqrt(electrons), rel=1e-4)
        assert model.meta.ccsp["simulated_flag"] is True
        ccsp = asdf.schema.load_schema("asdf://stsci.edu/datamodels/roman/schemas/CCSP/ccsp_minimal-2.0.0")
        for name in model.meta.ccsp:
            assert name in ccsp["properties"]["ccsp"]["properties"], name
        assert model.meta.coadd_info.time_first < model.meta.coadd_info.time_last


def test_missing_images_and_unknown_endings_are_refused(survey, tmp_path):
    with pytest.raises(UserError, match="nearest H158"):
        export_fits(survey, tmp_path / "out", "roman", ["H158-999999-1"], [], [])
    with pytest.raises(UserError, match="band 'H160'"):
        export_fits(survey, tmp_path / "out", "roman", [], [survey.tiles[0].name], ["H160"])
    with pytest.raises(UserError, match=r"\.vot, "):
        export_obscore(survey, tmp_path / "out" / "images.csv")
    assert not (tmp_path / "out").exists()


def test_the_obscore_table_describes_all_images(survey, tmp_path):
    roman, rubin = survey.output("coadds/roman"), survey.output("coadds/rubin")
    exposures = survey.output("exposures/roman")
    count = export_obscore(survey, tmp_path / "images.vot")
    assert count == len(exposures.names) + len(roman.image_names) + len(rubin.image_names)
    table = Table.read(tmp_path / "images.vot", format="votable")
    assert set(table["obs_id"]) == {*exposures.names, *roman.image_names, *rubin.image_names}
    assert len(set(table["obs_publisher_did"])) == count
    one = table[table["obs_id"] == exposures.names[0]][0]
    row = survey.pointings("roman").iloc[0]
    assert one["t_min"] == row["mjd"]
    assert one["t_exptime"] == row["exptime"]
    polygon = np.array(one["s_region"].split()[2:], float).reshape(4, 2)
    np.testing.assert_allclose(polygon, corners_of(survey.pointings("roman").iloc[:1])[0], atol=1e-6)
    middle = SkyCoord(one["s_ra"], one["s_dec"], unit="deg")
    assert middle.separation(SkyCoord(*polygon.mean(axis=0), unit="deg")).arcsec < 5
    assert table["em_min"].unit == units.m
    h158 = table[table["em_band"] == "H158"]
    assert (h158["em_min"] < 1.45e-6).all()
    assert (h158["em_max"] > 1.7e-6).all()
    sharp = table[(table["instrument_name"] == "LSSTCam") & (table["em_band"] == "i")]
    np.testing.assert_allclose(sharp["s_resolution"], 0.75, atol=0.15)
    assert export_obscore(survey, tmp_path / "images.parquet") == count
    assert len(pd.read_parquet(tmp_path / "images.parquet")) == count


def test_mocs_cover_the_images_and_their_objects(survey, tmp_path):
    paths = {path.name: path for path in export_moc(survey, tmp_path)}
    roman = MOC.from_fits(paths["coadds-roman-H158.moc.fits"])
    side = survey.pipeline.coadds.grid().side / 3600
    # two neighbours share their overlap; cells at the edges stick out by half their 13 arcsec
    union = (2 * side - 2 * survey.pipeline.coadds.overlap * survey.pipeline.coadds.scale / 3600) * side
    area = roman.sky_fraction * 4 * np.pi * np.degrees(1) ** 2
    assert union < area < union + 6 * side * 15 / 3600
    objects = survey.objects("roman").compute()
    assert roman.contains_lonlat(
        objects["coord_ra"].to_numpy() * units.deg, objects["coord_dec"].to_numpy() * units.deg
    ).all()
    assert {"exposures-roman-F184.moc.fits", "coadds-rubin-u.moc.fits"} <= set(paths)
