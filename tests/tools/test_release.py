"""The release: its workflow, and the checks of a wheel that it publishes."""

from __future__ import annotations

import re
import shlex
import subprocess
import zipfile
from pathlib import Path

import pytest
import yaml

from salient.cli import make_parser
from salient.errors import RunFailed, UsageError
from salient.paths import ROOT
from salient.version import VERSION
from salient.wheel import check_metadata, check_platform, check_tag

WORKFLOW = yaml.safe_load((ROOT / ".github/workflows/release.yml").read_text(encoding="utf-8"))
JOBS = WORKFLOW["jobs"]
METADATA = {"Metadata-Version": "2.4", "Name": "salient-drive", "Version": VERSION, "Summary": "A drive",
            "License-Expression": "MIT", "Classifier": "Programming Language :: C", "Requires-Python": ">=3.11",
            "Description-Content-Type": "text/markdown"}


def test_only_a_tag_of_a_version_publishes():
    assert WORKFLOW[True] == {"push": {"tags": ["v[0-9]+.[0-9]+.[0-9]+"]}}  # YAML reads the key `on` as true
    for other in (ROOT / ".github/workflows").glob("*.yml"):
        assert ("id-token" in other.read_text(encoding="utf-8")) == (other.name == "release.yml")


def test_permissions_are_the_least_and_the_publishing_job_runs_no_code_of_the_repository():
    assert WORKFLOW["permissions"] == {}
    assert JOBS["build"]["permissions"] == {"contents": "read"}
    publish = JOBS["publish"]
    assert publish["permissions"] == {"id-token": "write"} and publish["environment"] == "pypi"
    assert publish["needs"] == "build" and all("run" not in step for step in publish["steps"])
    assert [step["uses"].split("@")[0] for step in publish["steps"]] == [
        "actions/download-artifact", "pypa/gh-action-pypi-publish"]
    assert "secrets" not in str(WORKFLOW)


def test_every_action_of_every_workflow_is_a_commit_whose_version_is_said():
    """Who owns an action may move its tags."""
    workflows = [path for folder in (ROOT, ROOT / "tests/tools/foreign")
                 for path in sorted((folder / ".github/workflows").glob("*.yml"))]
    assert len(workflows) == 3
    for path in workflows:
        uses = re.findall(r"uses: *(.*)", path.read_text(encoding="utf-8"))
        assert uses, path
        for use in uses:
            assert re.fullmatch(r"[\w-]+/[\w-]+@[0-9a-f]{40}  # v\d+\.\d+\.\d+", use), f"{path}: {use}"


def test_its_commands_exist_and_publish_the_folder_that_the_wheel_is_written_to():
    lines = [shlex.split(step["run"]) for step in JOBS["build"]["steps"] if "run" in step]
    _, wheel, tests = lines
    options = make_parser().parse_args([f"v{VERSION}" if word == "$GITHUB_REF_NAME" else word for word in wheel[1:]])
    assert (wheel[0], options.command, options.tag) == ("tools/salient", "wheel", f"v{VERSION}")
    assert (ROOT / wheel[0]).exists() and (ROOT / tests[-1]).exists() and tests[0] == "build/venv/bin/pytest"
    [upload] = [step for step in JOBS["build"]["steps"] if "upload-artifact" in step.get("uses", "")]
    assert upload["with"]["path"] == f"{options.out}/*.whl" and upload["with"]["if-no-files-found"] == "error"
    download = JOBS["publish"]["steps"][0]["with"]
    assert download == {"name": upload["with"]["name"], "path": "dist"}  # the action publishes dist


@pytest.mark.parametrize("tag", [VERSION, f"v{VERSION}.1", "v0.0.0", "", f"v{VERSION}\n"])
def test_another_tag_than_that_of_the_version_is_refused(tag):
    check_tag(f"v{VERSION}")
    with pytest.raises(UsageError, match=f"must be v{VERSION}"):
        check_tag(tag)


def wheel_of(folder: Path, metadata: dict[str, str], description: str = "# A drive\n") -> Path:
    path = folder / "salient_drive-1-py3-none-any.whl"
    with zipfile.ZipFile(path, "w") as archive:
        text = "".join(f"{name}: {value}\n" for name, value in metadata.items())
        archive.writestr("salient_drive-1.dist-info/METADATA", f"{text}\n{description}")
    return path


def test_metadata_that_a_registry_takes_passes(tmp_path):
    check_metadata(wheel_of(tmp_path, METADATA))


@pytest.mark.parametrize(("change", "message"), [
    ({"Summary": None}, "no summary"),
    ({"License-Expression": None}, "no licence"),
    ({"License-Expression": "of my own"}, "of my own"),
    ({"Classifier": None}, "no classifiers"),
    ({"Requires-Python": "three"}, "three"),
    ({"Version": "9.9.9"}, "version 9.9.9"),
    ({"Description-Content-Type": "text/plain"}, "text/plain"),
])
def test_metadata_that_it_would_refuse_or_show_wrongly_is_named(tmp_path, change, message):
    metadata = {name: value for name, value in {**METADATA, **change}.items() if value is not None}
    with pytest.raises(RunFailed, match=message):
        check_metadata(wheel_of(tmp_path, metadata))


def test_a_page_without_a_text_is_named(tmp_path):
    with pytest.raises(RunFailed, match="no description"):
        check_metadata(wheel_of(tmp_path, METADATA, description=""))


def test_a_program_that_needs_a_library_of_the_system_is_refused(tmp_path, monkeypatch):
    shown = 'the following external versioned symbols: libc.so.6 {"GLIBC_2.34"}'
    monkeypatch.setattr(subprocess, "run", lambda *_, **__: subprocess.CompletedProcess([], 0, shown, ""))
    with pytest.raises(RunFailed, match=r"do not run on every Linux: .*GLIBC_2\.34"):
        check_platform(tmp_path / "a.whl")
