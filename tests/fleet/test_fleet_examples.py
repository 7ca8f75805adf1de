"""The files of `examples/fleet` can be read, and what they call exists."""

from __future__ import annotations

import re
import shlex
import tomllib
from pathlib import Path
from typing import Any

import pytest
import yaml

from stereo_sfm.cli import _build_parser  # pyright: ignore[reportPrivateUsage]
from stereo_sfm.drivers.choice import SourceChoice
from stereo_sfm.fleet.plan import load_plan

ROOT = Path(__file__).parents[2]
FOLDER = ROOT / "examples" / "fleet"


def read(name: str) -> Any:
    return yaml.safe_load((FOLDER / name).read_text())


def test_the_plan_is_valid() -> None:
    pytest.importorskip("obstore")
    plan = load_plan(FOLDER / "plan.toml")
    assert plan.fleet.keep_images_days and plan.config() and plan.listed
    assert all(SourceChoice.of(walk.source) for walk in plan.listed)


def commands() -> list[list[str]]:
    """Of `stereo-sfm` and `ray`, as words, wherever they stand in a file."""
    text = "\n".join(path.read_text() for path in sorted(FOLDER.iterdir()))
    return [shlex.split(line) for line in re.findall(r"(?m)(?:^#|exec head|-) +((?:stereo-sfm|ray) .*)$", text)]


def test_commands_of_the_package_are_parsed() -> None:
    ours = [words[1:] for words in commands() if words[0] == "stereo-sfm"]
    assert ours
    for words in ours:
        options = _build_parser(words[0]).parse_args(words)  # exits where an option does not exist
        assert (FOLDER / Path(options.plan).name).is_file()


def test_commands_of_ray_exist() -> None:
    pytest.importorskip("ray")
    from ray.scripts.scripts import cli

    services = [s for s in read("compose.yaml")["services"].values() if s.get("entrypoint") == ["ray"]]
    called = [words[1:] for words in commands() if words[0] == "ray"]
    called += [shlex.split(service["command"]) for service in services]
    assert len(called) >= 6
    for command, *options in called:
        known = {name for option in cli.commands[command].params for name in (*option.opts, *option.secondary_opts)}
        assert {word.partition("=")[0] for word in options} <= known, options


def test_the_cluster_is_valid() -> None:
    pytest.importorskip("ray")
    pytest.importorskip("jsonschema")  # raises what is wrong
    util = pytest.importorskip("ray.autoscaler._private.util")
    util.validate_config(util.prepare_config(read("cluster.yaml")))


def test_services_name_what_exists() -> None:
    compose = read("compose.yaml")
    services = compose["services"]
    for service in services.values():
        assert set(service.get("depends_on", [])) <= services.keys()
        for volume in service.get("volumes", []):
            place = volume.partition(":")[0]
            assert place in compose["volumes"] or (FOLDER / place).exists()
    head = re.search(r"--address (\w+):(\d+)", (FOLDER / "compose.yaml").read_text())
    assert head is not None and f"--port={head[2]}" in services[head[1]]["command"]
    bucket = services["bucket"]["entrypoint"][2].rpartition("s/")[2]
    assert load_plan_root() == f"s3://{bucket}"
    built = re.search(r"build -t (\S+) --build-arg EXTRAS=(\w+)", (FOLDER / "compose.yaml").read_text())
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    assert built is not None and built[2] in extras and built[1] == services["worker"]["image"]
    assert re.search(r"(?m)^ARG EXTRAS\b", (ROOT / "Containerfile").read_text())


def load_plan_root() -> str:
    return tomllib.loads((FOLDER / "plan.toml").read_text())["fleet"]["root"]
