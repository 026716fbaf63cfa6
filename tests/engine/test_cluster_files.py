"""Settings files for clusters of SLURM, Kubernetes and dask-gateway, and for TLS."""

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
from romandask.engine.clients import runner
from romandask.engine.progress import Reporter
from romandask.engine.runners import InProcess
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
    """Set the dask configuration of some files."""
    with dask.config.set(dask.config.merge(dask.config.config, *map(content, names), more)):
        yield


def write_script(path: Path, text: str) -> None:
    path.write_text(f"#!/bin/bash\n{text}\n")
    path.chmod(path.stat().st_mode | stat.S_IXUSR)


@pytest.fixture
def queue(tmp_path, monkeypatch):
    """Fake sbatch and scancel that run a job as a local process."""
    folder = tmp_path / "bin"
    folder.mkdir()
    write_script(
        folder / "sbatch", 'cp "${@: -1}" job.sh; setsid bash job.sh > job.log 2>&1 & echo "Submitted batch job $!"'
    )
    write_script(folder / "scancel", 'for job in "$@"; do kill -- "-$job"; done')
    monkeypatch.setenv("PATH", str(folder), prepend=os.pathsep)
    monkeypatch.setenv("PYTHONWARNINGS", "default")
    monkeypatch.chdir(tmp_path)


@pytest.mark.slow
def test_a_slurm_job_connects_over_tls_and_makes_identical_units(queue, tmp_path):
    """dask-jobqueue with slurm.yaml writes a job script, which is run and connects with its certificates."""
    pipeline = load_pipeline("tiny", list(MINI))
    reference = Store(tmp_path / "here")
    reference.prepare()
    running.run(Survey(pipeline, reference), InProcess(), Reporter(Console(quiet=True)), SOME)
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


def test_a_cluster_with_tls_refuses_unencrypted_connections(tmp_path):
    """tls.yaml with the paths of temporary certificates."""
    made = Security.temporary()
    for name, text in (("ca", made.tls_ca_file), ("host", made.tls_worker_cert), ("host-key", made.tls_worker_key)):
        (tmp_path / f"{name}.pem").write_text(text)
    tls = content("tls")["distributed"]["comm"]["tls"]
    with_paths = {
        key: str(tmp_path / value) if isinstance(value, str) else {k: str(tmp_path / v) for k, v in value.items()}
        for key, value in tls.items()
    }
    with (
        settings("workers", "tls", distributed={"comm": {"tls": with_paths}}),
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
        with runner(1, 2.0, address) as execution:
            assert address in execution.description
        with (
            pytest.raises(UserError, match=r"no dask scheduler answers there \(encryption required"),
            runner(1, 2.0, address.replace("tls://", "tcp://")),
        ):
            pass


def test_the_kubernetes_cluster_is_valid_for_the_dask_operator():
    """kubernetes.yaml follows the schema of the dask operator, and its commands and mounts are consistent."""
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
def test_every_setting_is_known_to_its_package(name, module):
    defaults = yaml.safe_load(next(Path(module.__file__).parent.glob("*.yaml")).read_text())

    def unknown(settings: dict, known: dict, prefix: str = "") -> list[str]:
        keys = []
        for key, value in settings.items():
            if key not in known:
                keys.append(prefix + key)
            elif isinstance(value, dict) and known[key]:
                keys += unknown(value, known[key], f"{prefix}{key}.")
        return keys

    assert not unknown(content(name), defaults)
