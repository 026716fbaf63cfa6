"""Files of spectra are read, or the reason is told for which one cannot be used."""

from __future__ import annotations

import codecs
import gzip

import numpy as np
import pytest

from romandask.export.truth import write_spectra
from romandask.ingest.spectra import read_folder
from romandask.model.errors import UserError

GOOD = "300 1\n400 1\n500 2\n600 1\n"


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        (GOOD.replace("400 1", "400 nan"), "SED file: spectrum holds NaN or infinite values"),
        (GOOD.replace("400 1", "400 inf"), "SED file: spectrum holds NaN or infinite values"),
        (GOOD.replace("400 1", "nan 1"), "SED file: spectrum holds NaN or infinite values"),
        (GOOD.replace("400 1", "400 -1"), "SED file: spectrum is negative somewhere"),
        (
            GOOD.replace(" 1", " 0").replace(" 2", " 0"),
            "SED file: spectrum has no light at 500 nm, where magnorm is defined",
        ),
        ("600 1\n700 1\n", "SED file: spectrum has no light at 500 nm, where magnorm is defined"),
        ("600 1\n500 1\n400 1\n", "SED file: wavelengths do not increase"),
        (GOOD.replace("400 1", "400 one"), "SED file cannot be read"),
        ("300\n400\n", "SED file cannot be read"),
        ("", "SED file cannot be read"),
    ],
)
@pytest.mark.filterwarnings("ignore:loadtxt")
def test_unusable_spectra_have_a_reason(tmp_path, text, reason):
    (tmp_path / "s").write_text(text)
    (tmp_path / "good").write_text(GOOD)
    library, reasons = read_folder(tmp_path, ["s", "good"])
    assert library.names == ("good",)
    assert reasons == {"s": reason}


def test_exported_spectra_are_read_and_other_files_refused(tmp_path):
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder/s").write_text(GOOD)
    library, _ = read_folder(tmp_path / "folder", ["s", "blackbody_5000"])
    write_spectra(tmp_path / "seds.hdf5", library, ())
    again, reasons = read_folder(tmp_path / "seds.hdf5", ["s", "other"])
    assert again.names == ("s",)
    assert reasons == {"other": "SED not in the library"}
    row = library.names.index("s")
    np.testing.assert_allclose(again.photons[0], library.photons[row], rtol=1e-12)
    assert again.limits.tolist() == [library.limits[row].tolist()]
    with pytest.raises(UserError, match=r"folder/s: not a file of spectra as `romandask export truth` writes it"):
        read_folder(tmp_path / "folder/s", ["s"])


def test_a_byte_order_mark_is_left_out(tmp_path):
    (tmp_path / "plain").write_text(GOOD)
    (tmp_path / "bom").write_bytes(codecs.BOM_UTF8 + GOOD.encode())
    (tmp_path / "bom.gz").write_bytes(gzip.compress(codecs.BOM_UTF8 + GOOD.encode()))
    library, reasons = read_folder(tmp_path, ["plain", "bom", "bom.gz"])
    assert not reasons
    assert (library.photons == library.photons[0]).all()
    assert np.ptp(library.photons[0]) > 0
