"""The graph of a survey as a dask collection: the same bytes as a run, on any scheduler, whole or of a region."""

import io

import cloudpickle
import pytest
from conftest import MINI
from distributed import Client, LocalCluster
from output_hashes import output_hashes
from rich.console import Console

from romandask import run as running
from romandask.engine.progress import Reporter
from romandask.engine.runners import InProcess
from romandask.engine.verify import verify
from romandask.model.errors import UserError
from romandask.model.sky import Region
from romandask.pipeline import load_pipeline
from romandask.stage_graph import Selection, stage_products
from romandask.storage.store import Store
from romandask.survey import Survey
from romandask.survey_graph import runnable

STAGES = ("truth", "pointings")


def survey_in(folder) -> Survey:
    return Survey(load_pipeline("tiny", list(MINI)), Store(folder))


@pytest.fixture(scope="module")
def reference(tmp_path_factory) -> dict[str, str]:
    """Output hashes of the truth and the pointings, made by a run."""
    survey = survey_in(tmp_path_factory.mktemp("run") / "store")
    survey.store.prepare()
    running.run(survey, InProcess(), Reporter(Console(file=io.StringIO())), Selection(STAGES))
    return output_hashes(survey.store.root)


def test_the_graph_has_a_layer_for_each_stage_and_an_edge_for_each_input(tmp_path):
    survey = survey_in(tmp_path / "store")
    graph = survey.graph()
    layers = graph.__dask_graph__().layers
    assert len(layers) - 1 == sum(len(survey.product(one.name).units) > 0 for one in stage_products(survey))
    assert not (tmp_path / "store").exists(), "nothing is written before the graph is computed"
    graph.__dask_graph__().validate()
    low_level = graph.__dask_graph__().to_dict()
    for stage in graph.stages:
        units = {unit.name: unit for unit in stage.product.units}
        for name in stage.tasks:
            read = {graph.key(source) for source in (*units[name].inputs, *units[name].optional)}
            needed = low_level[graph.key((stage.product.stage, name))].dependencies
            assert {key for key in needed if not key[0].startswith(("begin-", "products-"))} == read, name


def test_the_products_of_a_graph_share_what_they_are_made_from_in_a_worker(tmp_path):
    """A copy of each, with all that is upstream, would fill a worker of a large survey."""
    graph = survey_in(tmp_path / "store").graph()
    assert len(graph.part(set(graph.units()[:1]), {}).products.by_stage) == len(graph.stages), "those of all parts"
    together = len(cloudpickle.dumps(graph.products))
    assert together < 0.2 * sum(len(cloudpickle.dumps(product)) for product in graph.products.by_stage.values())


@pytest.mark.slow
@pytest.mark.parametrize("scheduler", ["sync", "threads", "client"])
def test_any_scheduler_makes_the_same_units_and_complete_catalogs(scheduler, tmp_path, reference):
    survey = survey_in(tmp_path / "store")
    graph = survey.graph(STAGES)
    if scheduler == "client":
        with (
            LocalCluster(
                n_workers=1, threads_per_worker=1, processes=False, dashboard_address="127.0.0.1:0"
            ) as cluster,
            Client(cluster),
        ):
            made = graph.compute()
    else:
        made = graph.compute(scheduler=scheduler)
    assert {name: result.output for name, result in made.items()} == reference == output_hashes(tmp_path / "store")
    assert all(result.made for result in made.values())
    products = Selection(STAGES).of(stage_products(survey))
    for verified in verify(runnable(survey, products), survey.store):
        assert not verified.damaged
    assert (tmp_path / "store" / "truth" / "galaxies" / "catalog" / "hats.properties").exists()
    assert not len(survey_in(tmp_path / "store").graph(STAGES))


def test_the_graph_of_a_region_has_what_its_tiles_are_made_from(tmp_path):
    survey = survey_in(tmp_path / "store")
    stages = ("truth", "pointings", "psf_models", "exposures", "coadds", "coadd_noise", "detections", "statistics")
    whole, tile = survey.graph(stages), survey.tiles[0]
    region = Region(tile.ra - 1e-4, tile.ra + 1e-4, tile.dec - 1e-4, tile.dec + 1e-4)
    part = survey.graph(stages, region)
    assert 0 < len(part) < len(whole)
    names = {stage.product.stage: set(stage.tasks) for stage in part.stages}
    assert {name.split("_")[0] for name in names["detections/roman"]} == {tile.name.split("_")[0]}
    for stage in part.stages:
        for name in stage.tasks:
            assert all(unit in names[other] for other, unit in stage.sources[name]), name
    assert "statistics/blends" not in names, "it covers the whole survey"


def test_the_graph_needs_a_store():
    with pytest.raises(UserError, match="no store"):
        Survey(load_pipeline("tiny", list(MINI))).graph()
