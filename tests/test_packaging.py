"""The files for other package managers state what pyproject.toml states, and are what their tools read."""

from __future__ import annotations

import ast
import re
import tomllib
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest
import yaml

from stereo_sfm import __version__
from stereo_sfm.service import config as service_config

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
ROS2 = ROOT / "packaging" / "ros2"
# conda-forge's names and REP 149's order of elements in format 3.
CONDA_NAMES = {"opencv-python-headless": "py-opencv", "matplotlib": "matplotlib-base"}
ORDER = ("name", "version", "description", "maintainer", "license", "buildtool_depend", "exec_depend", "export")


def test_the_conda_recipe_has_our_dependencies() -> None:
    recipe = yaml.safe_load((ROOT / "packaging" / "conda" / "recipe.yaml").read_text())
    assert recipe["schema_version"] == 1 and recipe["context"]["version"] == __version__
    wanted: dict[str, str] = {}
    for one in PROJECT["dependencies"]:
        name, limits = re.fullmatch(r"([\w-]+)(.*)", one).groups()  # pyright: ignore[reportOptionalMemberAccess]
        wanted[CONDA_NAMES.get(name, name)] = limits
    found = dict(line.split(" ", 1) for line in recipe["requirements"]["run"])
    assert found.pop("python").startswith(">=")
    assert found == wanted
    assert {"source", "build", "tests", "about"} <= set(recipe)


@pytest.mark.parametrize("name", ["foxglove-schemas-protobuf", "mcap-protobuf-support"])
def test_what_conda_forge_lacks_has_a_recipe(name: str) -> None:
    """Of the version that we are tested with."""
    recipe = yaml.safe_load((ROOT / "packaging" / "conda" / name / "recipe.yaml").read_text())
    lock = (ROOT / "requirements.lock").read_text()
    assert recipe["schema_version"] == 1 and recipe["package"]["name"] == name
    assert f"\n{name}=={recipe['context']['version']}\n" in lock
    assert re.fullmatch("[0-9a-f]{64}", recipe["source"]["sha256"]) and any(
        one.startswith(name) for one in PROJECT["dependencies"]
    )


def test_the_ros_package_is_valid() -> None:
    package = ElementTree.parse(ROS2 / "package.xml").getroot()
    assert package.tag == "package" and package.get("format") == "3"
    tags = [child.tag for child in package]
    assert [tag for k, tag in enumerate(tags) if tag not in tags[:k]] == list(ORDER)
    texts = {child.tag: (child.text or "").strip() for child in package}
    assert texts["version"] == __version__ and texts["license"] == PROJECT["license"]
    assert package.findtext("export/build_type") == "ament_cmake"
    cmake = (ROS2 / "CMakeLists.txt").read_text()
    assert f"project({texts['name']} " in cmake and "ament_package()" in cmake
    for folder in re.findall(r"install\(DIRECTORY ([\w ]+) DESTINATION", cmake)[0].split():
        assert any((ROS2 / folder).iterdir())


def test_the_launch_file_starts_the_service_with_a_valid_configuration() -> None:
    text = (ROS2 / "launch" / "stereo_sfm.launch.py").read_text()
    ast.parse(text)
    assert '["stereo-sfm", "serve", "-c"' in text
    for folder in (ROS2 / "config", ROOT / "examples" / "ros2"):
        service_config.load(folder / "robot.toml").pipeline()  # with the file of settings that it names
        yaml.safe_load((folder / "nav2_params.yaml").read_text())


def test_the_workflow_runs_the_same_script_on_every_python() -> None:
    flow = yaml.safe_load((ROOT / ".github" / "workflows" / "ci.yml").read_text())
    steps = [step.get("run") for step in flow["jobs"]["run"]["steps"]]
    assert ".ci/run" in steps
    stated = [line.rpartition(" ")[2] for line in PROJECT["classifiers"] if "Python ::" in line]
    for job in flow["jobs"].values():
        assert job["strategy"]["matrix"]["python"] == stated


@pytest.mark.parametrize("script", ["run", "prose", "try_release"])
def test_scripts_of_ci_can_be_executed(script: str) -> None:
    path = ROOT / ".ci" / script
    assert path.stat().st_mode & 0o111 and path.read_text().startswith("#!")
