"""Checksums of exported files of every format: changed, truncated and missing files are found."""

import subprocess

import dask
import numpy as np
import pytest
from conftest import command

from romandask.export import sha256sums
from romandask.export.asdf import export_asdf
from romandask.export.fits import export_fits
from romandask.export.meds import export_meds
from romandask.export.moc import export_moc
from romandask.export.obscore import export_obscore
from romandask.export.psf import export_psf
from romandask.export.truth import export_truth
from romandask.model.errors import UserError
from romandask.model.sky import Cone
from romandask.survey import open_survey


@pytest.fixture(scope="module")
def exported(tiny_store, tmp_path_factory):
    """A folder with a file of every format."""
    out = tmp_path_factory.mktemp("exported")
    with dask.config.set(scheduler="synchronous"):
        survey = open_survey(tiny_store)
        tile, exposure = survey.tiles[0], survey.output("exposures/roman").names[0]
        written = export_fits(survey, out, "rubin", [], [tile.name], ["i"])
        written += export_asdf(survey, out, [], [tile.name], ["H158"])
        written += export_truth(survey, out)
        written += export_psf(survey, out, [exposure])
        written += export_moc(survey, out)
        written += export_meds(survey, out, Cone(tile.ra, tile.dec, 8.0), ["H158"], 32, "truth")
        for name in ("images.vot", "images.parquet"):
            export_obscore(survey, out / name)
            written.append(out / name)
    for path in written:
        sha256sums.note(path)
    return out


def damaged(folder) -> list[str]:
    return [name for name, why in sha256sums.check(folder) if why]


def test_files_of_every_format_are_listed_and_intact(exported):
    endings = {path.suffix for path in exported.iterdir()}
    assert {".fits", ".asdf", ".hdf5", ".vot", ".parquet"} <= endings
    names = sorted(path.name for path in exported.iterdir())
    assert sorted([sha256sums.NAME, *(name for name, _ in sha256sums.check(exported))]) == names
    assert not damaged(exported)
    # the standard tool reads the list
    subprocess.run(["sha256sum", "--quiet", "-c", sha256sums.NAME], cwd=exported, check=True)


def test_every_flipped_bit_and_truncation_is_found(exported):
    random = np.random.default_rng(11)
    files = sorted(exported.iterdir())
    for number in range(6 * len(files)):
        path = files[number % len(files)]
        content = path.read_bytes()
        position = int(random.integers(len(content)))
        changed = bytearray(content)
        changed[position] ^= 1 << int(random.integers(8))
        path.write_bytes(changed[:position] if number >= 4 * len(files) else changed)
        assert path.name in damaged(exported), (path.name, position)
        path.write_bytes(content)
    assert not damaged(exported)


def test_a_missing_file_and_a_damaged_list_are_found(exported, tmp_path):
    path = next(exported.glob("*.vot"))
    content = path.read_bytes()
    path.unlink()
    assert dict(sha256sums.check(exported))[path.name] == "is gone"
    path.write_bytes(content)
    (tmp_path / "one.txt").write_text("1")
    sha256sums.note(tmp_path / "one.txt")
    text = (tmp_path / sha256sums.NAME).read_text()
    (tmp_path / sha256sums.NAME).write_text(text.split("\n")[-2] + "\n")
    with pytest.raises(UserError, match="list itself is damaged"):
        sha256sums.note(tmp_path / "one.txt")


def test_the_command_line_writes_and_verifies_checksums(tiny_store, tmp_path):
    out = tmp_path / "out"
    done = command("export", "obscore", str(tiny_store), str(out / "images.fits"))
    assert done.returncode == 0, done.stderr
    done = command("verify", str(out))
    assert done.stdout.strip() == f"{out}: 1 files are as they were written"
    content = bytearray((out / "images.fits").read_bytes())
    content[4000] ^= 1
    (out / "images.fits").write_bytes(content)
    done = command("verify", str(out))
    assert done.returncode == 1
    assert "images.fits: not what was written" in done.stdout
    assert command("verify", str(out), "--forget").returncode == 2


@pytest.mark.slow
def test_verify_of_a_store_with_exported_files_verifies_the_store(tmp_path):
    (tmp_path / "one.txt").write_text("1")
    sha256sums.note(tmp_path / "one.txt")
    (tmp_path / "pipeline.yaml").write_text("- not a pipeline\n")
    done = command("verify", str(tmp_path))
    assert done.returncode == 2
    assert "pipeline.yaml" in done.stderr
