"""Pipeline files, overrides, and the errors for wrong settings."""

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from romandask.model.errors import UserError
from romandask.model.settings import apply_overrides
from romandask.pipeline import load_pipeline, pipeline_of, shipped


def test_shipped_pipelines_are_valid_and_survive_a_round_trip_through_yaml():
    assert {"tiny", "dc2_sample"} <= set(shipped())
    for name in shipped():
        settings = load_pipeline(name)
        assert pipeline_of(yaml.safe_load(settings.to_yaml()), name) == settings


def test_overrides_set_nested_keys():
    settings = load_pipeline("tiny", ["coadds.pixfrac=0.8", "rubin.bands=[g, i]", "seed=3"])
    assert settings.coadds.pixfrac == 0.8
    assert settings.rubin.bands == ("g", "i")
    assert settings.seed == 3


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("coadds.pixfrak=0.8", ["coadds.pixfrak", "coadds.pixfrac"]),
        ("coads.pixfrac=0.8", ["coads", "coadds"]),
        ("roman.pointings.sorce=plan", ["roman.pointings.sorce", "roman.pointings.source"]),
        ("coadds.pixfrac=2", ["coadds.pixfrac", "2"]),
        ("roman.bands=[H159]", ["roman.bands", "H159"]),
        ("region.dec=[3, 1]", ["region", "dec"]),
        ("coadds.pixfrac", ["key=value"]),
        ("seed.x=1", ["seed"]),
        ("coadds.overlap=600", ["overlap"]),
        ("truth.source=skycatalogs", ["truth.path"]),
        ("roman.pointings.dithers={H158: [1]}", ["dithers", "Y106"]),
        ("seed=[1", ["not a valid value"]),
    ],
)
def test_a_wrong_setting_gives_a_one_line_error_that_names_it(override, words):
    with pytest.raises(UserError) as caught:
        load_pipeline("tiny", [override])
    for word in words:
        assert word in str(caught.value)
    assert "\n" not in str(caught.value)


def test_one_error_names_all_wrong_keys():
    with pytest.raises(UserError, match=r"sead.*seed.*regoin|regoin.*sead"):
        load_pipeline("tiny", ["sead=1", "regoin=2"])


def test_files_that_are_not_pipelines_are_rejected(tmp_path):
    (tmp_path / "list.yaml").write_text("- a\n- b\n")
    (tmp_path / "broken.yaml").write_text("a: [1\nb: 2")
    (tmp_path / "code.yaml").write_text("!!python/object/apply:os.system [echo]")
    for name, word in (
        ("list", "mapping"),
        ("broken", "not valid YAML"),
        ("code", "not valid YAML"),
        ("none", "no such pipeline"),
    ):
        with pytest.raises(UserError, match=word):
            load_pipeline(tmp_path / f"{name}.yaml")


@given(st.text(max_size=30))
def test_any_override_text_is_applied_or_raises_user_error(text):
    try:
        apply_overrides({"a": {"b": 1}}, [text])
    except UserError:
        pass
