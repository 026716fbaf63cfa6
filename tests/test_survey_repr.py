"""What a survey and its datasets show of themselves at a prompt and in a notebook."""

import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest

import romandask as rd
from romandask.survey_repr import html_of, stage_lines, text_of


@pytest.fixture(scope="module")
def survey(tiny_store):
    return rd.open(tiny_store)


def bytes_of(folder: Path) -> int:
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())


def test_lines_have_the_bytes_on_disk(survey, tiny_store):
    lines = {line.stage: line for line in stage_lines(survey)}
    assert list(lines)[0].startswith("truth/")
    assert lines["exposures/roman"].bytes == bytes_of(tiny_store / "exposures" / "roman.zarr")
    assert lines["exposures/roman"].units == len(survey.exposures("roman").exposure)
    products = ("exposures", "coadds", "detections", "objects", "samples", "matches", "statistics", "shear")
    for name in products:
        total = sum(line.bytes for line in lines.values() if line.stage.split("/")[0] == name)
        assert total == pytest.approx(bytes_of(tiny_store / name), rel=0.02), name


def test_text_names_the_survey_and_its_stages(survey, tiny_store):
    text = text_of(survey)
    assert text == repr(survey)
    assert text.splitlines()[0] == f"Survey tiny ({tiny_store})"
    assert "coadds/rubin" in text


def test_html_has_the_numbers_and_a_map(survey):
    html = survey._repr_html_()
    assert html == html_of(survey)
    assert len(html) < 60_000
    root = ElementTree.fromstring(html)
    text = "".join(root.itertext())
    assert f"{len(stage_lines(survey))} stages" in text
    for name in ("roman", "rubin"):
        assert f"{survey.instruments[name].title}: {len(survey.pointings(name))} exposures" in text
    assert root.find(".//svg") is not None
    assert len(root.findall(".//polygon")) > len(survey.pointings("roman"))


def test_a_survey_that_is_not_stored_shows_itself():
    survey = rd.Survey(rd.load_pipeline("tiny"))
    assert "not stored" in repr(survey)
    ElementTree.fromstring(survey._repr_html_())


def test_html_of_datasets_has_no_headers(survey):
    for dataset in (survey.exposures("roman"), survey.coadds("roman"), survey.segmentation("roman")):
        html = dataset._repr_html_()
        assert "NAXIS" not in html
        assert len(html) < 100_000
