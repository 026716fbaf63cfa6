"""Clusters that something else starts: their settings files do what they say."""

import importlib.util
import os
import stat
import sys
from contextlib import contextmanager
from pathlib import Path

import dask
import dask_gateway
import dask_jobqueue
import jsonschema
import pytest
import yaml
from conftest import MINI, ROOT
from distributed import LocalCluster, Security
from output_hashes import output_hashes
from rich.console import Console

from romandask import run as running
from romandask.engine.clients import InProcess, runner
from romandask.engine.progress import Reporter
from romandask.model.errors import UserError
from romandask.pipeline import load_pipeline
from romandask.stage_graph import Selection
from romandask.storage.store import Store
from romandask.survey import Survey

FILES = ROOT / "pipelines" / "cluster"
SOME = Selection(("truth", "pointings"))


def content(name: str) -> dict:
    return yaml.safe_load((FILES / f"{name}.yaml").read_text())


@contextmanager
def settings(*names: str, **more):
    """Dask with the settings of some files."""
    with dask.config.set(dask.config.merge(dask.config.config, *map(content, names), more)):
        yield


def tool(path: Path, text: str) -> None:
    path.write_text(f"#!/bin/bash\n{text}\n")
    path.chmod(path.stat().st_mode | stat.S_IXUSR)


@pytest.fixture
def queue(tmp_path, monkeypatch):
    """SLURM's two commands for a queue of this machine: a job is a process of its own."""
    folder = tmp_path / "bin"
    folder.mkdir()
    tool(folder / "sbatch", 'cp "${@: -1}" job.sh; setsid bash job.sh > job.log 2>&1 & echo "Submitted batch job $!"')
    tool(folder / "scancel", 'for job in "$@"; do kill -- "-$job"; done')
    monkeypatch.setenv("PATH", str(folder), prepend=os.pathsep)
    monkeypatch.setenv("PYTHONWARNINGS", "default")
    monkeypatch.chdir(tmp_path)


def test_jobs_of_a_queue_make_the_same_over_tls(queue, tmp_path):
    """dask-jobqueue with slurm.yaml: the job that it writes is run, and joins with its certificates."""
    pipeline = load_pipeline("tiny", list(MINI))
    place = Store(tmp_path / "here")
    place.prepare()
    running.run(Survey(pipeline, place), InProcess(), Reporter(Console(quiet=True)), SOME)
    on_loopback = {"host": "127.0.0.1", "dashboard_address": "127.0.0.1:0"}
    with (
        settings("workers", "slurm"),
        dask_jobqueue.SLURMCluster(
            security=Security.temporary(),
            shared_temp_directory=str(tmp_path),
            scheduler_options=on_loopback,
            python=sys.executable,
        ) as cluster,
    ):
        cluster.scale(1)
        assert cluster.scheduler_address.startswith("tls://127.0.0.1:")
        with cluster.get_client() as client:
            client.wait_for_workers(1, timeout=120)
            (worker,) = client.scheduler_info()["workers"].values()
            assert (worker["nthreads"], worker["memory_limit"]) == (1, 2 << 30)
            job = (tmp_path / "job.sh").read_text()
            assert "#SBATCH --mem=2560M" in job
            assert "#SBATCH -t 12:00:00" in job
            with pytest.raises(UserError, match=r"the cluster: a worker has 2\.00 GiB, run\.memory_limit is 3"):
                running.run_on(client, load_pipeline("tiny", [*MINI, "run.memory_limit=3"]), tmp_path / "none")
            assert not (tmp_path / "none").exists()
            summary = running.run_on(client, pipeline, tmp_path / "there", SOME)
    assert not summary.failed
    assert output_hashes(tmp_path / "there") == output_hashes(tmp_path / "here")
    assert len(output_hashes(tmp_path / "here")) >= 5


def test_with_tls_nothing_unencrypted_is_spoken_or_accepted(tmp_path):
    """tls.yaml, its names those of certificates that are there."""
    made = Security.temporary()
    for name, text in (("ca", made.tls_ca_file), ("host", made.tls_worker_cert), ("host-key", made.tls_worker_key)):
        (tmp_path / f"{name}.pem").write_text(text)
    tls = content("tls")["distributed"]["comm"]["tls"]
    there = {
        key: str(tmp_path / value) if isinstance(value, str) else {k: str(tmp_path / v) for k, v in value.items()}
        for key, value in tls.items()
    }
    with (
        settings("workers", "tls", distributed={"comm": {"tls": there}}),
        LocalCluster(
            1,
            threads_per_worker=1,
            processes=False,
            protocol="tls://",
            security=Security(),
            host="127.0.0.1",
            dashboard_address="127.0.0.1:0",
            memory_limit="2GiB",
        ) as cluster,
    ):
        address = cluster.scheduler_address
        assert address.startswith("tls://")
        with runner(1, 2.0, address) as found:
            assert address in found.description
        with (
            pytest.raises(UserError, match=r"no dask scheduler answers there \(encryption required"),
            runner(1, 2.0, address.replace("tls://", "tcp://")),
        ):
            pass


def test_the_operator_takes_the_cluster_of_kubernetes():
    """Its own definition of what a DaskCluster is; and commands and mounts that fit each other."""
    (folder,) = importlib.util.find_spec("dask_kubernetes").submodule_search_locations
    charts = Path(folder) / "operator/deployment/helm/dask-kubernetes-operator/crds"
    definition = yaml.safe_load((charts / "daskcluster.yaml").read_text())
    (version,) = definition["spec"]["versions"]
    cluster = content("kubernetes")
    assert cluster["apiVersion"] == f"{definition['spec']['group']}/{version['name']}"
    assert cluster["kind"] == definition["spec"]["names"]["kind"]
    schema = version["schema"]["openAPIV3Schema"]
    jsonschema.validate(cluster, schema, jsonschema.Draft202012Validator)
    known = schema["properties"]["spec"]["properties"]
    assert set(cluster["spec"]) <= set(known)
    for role in ("worker", "scheduler"):
        pod = cluster["spec"][role]["spec"]
        assert set(pod) <= set(known[role]["properties"]["spec"]["properties"])
        (container,) = pod["containers"]
        assert container["name"] == role
        assert container["args"][:2] == ["dask", role]
        assert {mount["name"] for mount in container["volumeMounts"]} == {volume["name"] for volume in pod["volumes"]}
    service = cluster["spec"]["scheduler"]["service"]
    assert service["selector"]["dask.org/cluster-name"] == cluster["metadata"]["name"]
    assert (
        f"tls://{cluster['metadata']['name']}-scheduler:{service['ports'][0]['port']}"
        in (cluster["spec"]["worker"]["spec"]["containers"][0]["args"])
    )


@pytest.mark.parametrize(("name", "module"), [("gateway", dask_gateway), ("slurm", dask_jobqueue)])
def test_every_setting_is_one_that_the_package_knows(name, module):
    defaults = yaml.safe_load(next(Path(module.__file__).parent.glob("*.yaml")).read_text())

    def unknown(mine: dict, theirs: dict, before: str = "") -> list[str]:
        out = []
        for key, value in mine.items():
            if key not in theirs:
                out.append(before + key)
            elif isinstance(value, dict) and theirs[key]:
                out += unknown(value, theirs[key], f"{before}{key}.")
        return out

    assert not unknown(content(name), defaults)
