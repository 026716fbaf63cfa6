"""A third telescope in every position: it is surveyed like the others, and changes nothing of their results."""

import io

import pytest
from conftest import MINI
from output_hashes import output_hashes
from rich.console import Console
from third_instrument import WithThird

from romandask.engine.progress import Reporter
from romandask.engine.runners import InProcess
from romandask.model.errors import UserError
from romandask.model.resources import resource_folder
from romandask.model.settings import apply_overrides, read_yaml, validate
from romandask.run import run
from romandask.stage_graph import Selection, stage_products
from romandask.storage.store import Store
from romandask.survey import Survey

TO_STATISTICS = Selection(
    (
        *("truth", "pointings", "psf_models", "exposures", "coadds", "coadd_noise", "detections", "truth_match"),
        *(
            "truth_summary",
            "zero_points",
            "objects",
            "limits",
            "samples",
            "differences",
            "matches",
            "chance",
            "statistics",
        ),
    )
)


def pipeline(position: int | None, *more: str) -> WithThird:
    third = [] if position is None else ["third.pointings.visits={r: 8}", f"position={position}"]
    others = ["matches.limits={H158: 25.0, i: 25.0}", "differences.template=H158", "differences.science=i"]
    content = apply_overrides(read_yaml(resource_folder("pipelines") / "tiny.yaml"), [*MINI, *others, *third, *more])
    return validate(WithThird, content, "tiny with a third telescope")


def surveyed(position: int | None, folder) -> Survey:
    survey = Survey(pipeline(position), Store(folder))
    survey.store.prepare()
    summary = run(survey, InProcess(), Reporter(Console(file=io.StringIO())), TO_STATISTICS)
    assert not summary.failed
    return survey


@pytest.fixture(scope="module")
def two(tmp_path_factory) -> dict[str, str]:
    folder = tmp_path_factory.mktemp("two") / "store"
    surveyed(None, folder)
    return output_hashes(folder)


@pytest.mark.slow
@pytest.mark.parametrize("position", [0, 1, 2])
def test_a_third_telescope_in_any_position_changes_nothing_of_the_other_two(position, two, tmp_path):
    survey = surveyed(position, tmp_path / "store")
    assert list(survey.instruments)[position] == "third"
    three = output_hashes(tmp_path / "store")
    # the truth has more columns: a flux in each band
    same = {name for name in two if not name.startswith(("truth/galaxies", "truth/stars"))}
    assert len(same) > 50
    assert {name: three[name] for name in same} == {name: two[name] for name in same}
    objects = survey.objects("third").compute()
    assert len(objects) >= 2
    assert "VIS_kronFlux" in objects
    assert set(survey.matches().compute()["survey"]) == {"roman", "rubin"}


def test_blends_are_those_of_the_surveys_that_the_pipeline_names():
    survey = Survey(pipeline(1, "matches.surveys=[roman, third]"))
    reads = next(one.reads for one in stage_products(survey) if one.name == "matches/local")
    assert reads == {"samples/roman", "samples/rubin", "samples/third"}
    groups = survey.output("matches/groups").make
    assert groups.surveys == {0: "roman", 5: "third"}
    with pytest.raises(UserError, match=r"matches\.surveys: roman, euclid: two different ones of roman, third, rubin"):
        Survey(pipeline(1, "matches.surveys=[roman, euclid]")).output("matches/groups")


def test_without_both_surveys_there_are_no_blends():
    names = {one.name for one in stage_products(Survey(pipeline(0, "rubin=null")))}
    assert "samples/third" in names
    assert "samples/roman" in names
    assert not {name for name in names if name.startswith(("matches/", "statistics/", "chance/"))}
