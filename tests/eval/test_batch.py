"""Many recordings: one table, isolated failures, no repeated work, and no loss when a node dies."""

from __future__ import annotations

import csv
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest

from stereo_sfm.cli import main
from stereo_sfm.config import load
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.eval import batch
from stereo_sfm.jobs import Limits

ROOT = Path(__file__).parents[2]
SMALL = "sim:aisle?size=212x200&frames=12&rate=15&seed={}"


def rows(folder: Path) -> list[dict[str, str]]:
    with (folder / "results.csv").open() as stream:
        return list(csv.DictReader(stream))


def test_names_are_unique() -> None:
    assert batch.names(["a/x.mcap", "b/x.mcap", "y.mcap"]) == ["x_1", "x_2", "y"]
    assert batch.names(["sim:loop?size=424x400&seed=1", "sim:loop?seed=2", "tour 2.mcap"]) == [
        "sim_loop_size_424x400_seed_1", "sim_loop_seed_2", "tour_2",
    ]  # fmt: skip


def test_every_column_is_documented() -> None:
    rows = [line for line in (ROOT / "docs" / "tasks" / "batch.md").read_text().splitlines() if line.startswith("| `")]
    assert tuple(name for row in rows for name in re.findall(r"`([^`]+)`", row.split("|")[1])) == batch.COLUMNS


def test_a_missing_value_is_a_dash_empty_or_null(tmp_path: Path) -> None:
    parquet = pytest.importorskip("pyarrow.parquet")
    good = ["a", 12, 100.0, 3, 0, 1.5, 2.5, 30.0, "0123abcd"]
    batch.write_results([good, batch.table_row("b", {"ok": False, "error": "line\nno images"})], tmp_path)
    assert "| b | - | - | - | - | - | - | - | failed: no images |" in (tmp_path / "results.md").read_text()
    assert list(rows(tmp_path)[1].values()) == ["b", *[""] * 7, "failed: no images"]
    columns = parquet.read_table(tmp_path / "results.parquet").to_pydict()
    assert tuple(columns) == batch.COLUMNS
    assert columns["frames"] == [12, None] and columns["ATE mm"] == [2.5, None]


def test_a_long_reason_is_short_for_people_and_whole_for_programs(tmp_path: Path) -> None:
    reason = f"x is no dataset (known are {', '.join(map(str, range(200)))})"
    batch.write_results([batch.table_row("x", {"ok": False, "error": reason})], tmp_path)
    (line,) = (line for line in (tmp_path / "results.md").read_text().splitlines() if "no dataset" in line)
    assert "failed: x is no dataset (known are 0, 1," in line and line.endswith("… |") and len(line) < 220
    assert rows(tmp_path)[0]["result"] == f"failed: {reason}"


def test_the_extra_brings_what_the_table_needs() -> None:
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    assert set(extras["table"]) < set(extras["batch"])


def test_a_result_of_another_configuration_is_not_reused(tmp_path: Path) -> None:
    task = batch.BatchTask(SMALL.format(1), str(tmp_path / "a"), load(), False)
    assert batch.finished(task) is None
    result = batch.run_one(task)
    assert result["ok"], result
    assert batch.finished(task) is not None
    other = batch.BatchTask(task.spec, task.folder, load(None, ["seed=5"]), False)
    assert batch.finished(other) is None


def test_without_an_address_no_cluster_is_searched(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Ray stores the last cluster of this machine, and waits for minutes for one that has ended."""
    ray = pytest.importorskip("ray")
    asked: list[object] = []

    def init(**options: object) -> None:
        asked.append(options["address"])
        raise ConnectionError

    monkeypatch.setattr(ray, "init", init)
    task = batch.BatchTask(SMALL.format(1), str(tmp_path / "a"), load(), False)
    with pytest.raises(StereoSfmError, match=r"does not start on this computer .ConnectionError."):
        list(batch.run_batch([task], None))
    assert asked and set(asked) == {"local"}  # tried again: a busy computer starts it late
    asked.clear()
    with pytest.raises(ConnectionError):
        list(batch.run_batch([task], "10.0.0.1:6379"))
    assert asked == ["10.0.0.1:6379"]


def test_a_batch_has_the_limits_of_a_job(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    asked: list[Limits] = []

    def none(jobs: object, limits: Limits, address: str | None, extra: str) -> Iterator[object]:
        asked.append(limits)
        return iter(())

    monkeypatch.setattr(batch, "run_jobs", none)
    task = batch.BatchTask(SMALL.format(1), str(tmp_path / "a"), load(), False)
    assert not [*batch.run_batch([task]), *batch.run_batch([task], None, Limits(memory_gb=2.0, minutes=5.0))]
    assert asked == [Limits(), Limits(memory_gb=2.0, minutes=5.0)]


LISTENING = """
import sys
import psutil
from stereo_sfm.eval import batch

def look(task):
    ours = [psutil.Process(), *psutil.Process().children(recursive=True)]
    print(*{c.laddr.ip for p in ours for c in p.net_connections() if c.status == psutil.CONN_LISTEN})
    sys.exit()

batch.BatchTask.__reduce__ = look  # called when a task is given to Ray, all of which runs then
list(batch.run_batch([batch.BatchTask("sim:nothing", "/nowhere", batch.Config(), False)]))
"""


@pytest.mark.slow
def test_a_batch_on_this_machine_listens_on_loopback_alone() -> None:
    pytest.importorskip("ray")
    child = subprocess.run([sys.executable, "-c", LISTENING], capture_output=True, text=True)
    assert child.returncode == 0, child.stderr
    addresses = set(child.stdout.split())
    assert addresses and addresses <= {"127.0.0.1", "::ffff:127.0.0.1", "::1"}


@pytest.mark.slow
def test_a_failed_recording_stops_no_other_and_the_rest_is_resumed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    broken = tmp_path / "broken.mcap"
    broken.write_bytes(b"nothing")
    args = ["batch", SMALL.format(1), str(broken), SMALL.format(2), "-o", str(tmp_path / "out"), "--no-merge"]
    assert main(args) == 3
    states = ["failed" in row["result"] for row in rows(tmp_path / "out")]
    assert states == [False, True, False]
    capsys.readouterr()
    assert main(args) == 3
    assert capsys.readouterr().err.count("from before") == 2


@pytest.mark.slow
def test_two_nodes_one_killed_during_the_run(tmp_path: Path) -> None:
    ray = pytest.importorskip("ray")
    from ray.cluster_utils import Cluster

    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1})
    node = cluster.add_node(num_cpus=1)
    ray.init(address=cluster.address, log_to_driver=False)
    try:
        spec = "sim:aisle?size=212x200&frames=40&rate=15&seed={}"
        tasks = [batch.BatchTask(spec.format(k), str(tmp_path / str(k)), load(), False) for k in range(4)]
        results = {}
        for task, result in batch.run_batch(tasks, cluster.address):
            results[task.spec] = result
            if len(results) == 1:
                cluster.remove_node(node, allow_graceful=False)
        assert len(results) == 4
        assert all(r["ok"] for r in results.values())
    finally:
        ray.shutdown()
        cluster.shutdown()


def test_a_run_that_failed_is_no_good_recording() -> None:
    good = {"ok": True, "stats": {}, "failure": ""}
    assert batch.why_failed(good) == "" and batch.why_failed({"ok": True, "stats": {}}) == ""
    assert batch.why_failed({**good, "failure": "40 % of the frames have no pose"}).startswith("40 %")
    assert batch.why_failed({"ok": False, "error": "line\nno images"}) == "no images"
