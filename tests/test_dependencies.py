"""The core stands alone, each absent extra is named, and no licence forbids the project's own."""

from __future__ import annotations

import json
import subprocess
import sys
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest
from packaging.utils import canonicalize_name

from tests.licences import brought_by, extras, fault, licence_of
from tests.tiers import first_of

CORE_ALONE = """
import json, sys
absent = set(json.loads(sys.argv.pop(1)))
class Absent:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in absent:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)
sys.meta_path.insert(0, Absent())
from retropole.__main__ import main
main()
"""


def core_alone(folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    """Run a command where nothing beyond the core can be imported."""
    core = {"retropole", *brought_by(None)[0]}
    absent = [
        module
        for module, packages in packages_distributions().items()
        if not core & {canonicalize_name(package) for package in packages}
    ]
    assert {"laspy", "lxml", "matplotlib", "rosbags", "yaml"} <= set(absent)
    return subprocess.run(
        [sys.executable, "-c", CORE_ALONE, json.dumps(absent), *words],
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=120,
    )


@pytest.mark.full
def test_the_core_needs_no_extra(tmp_path: Path) -> None:
    clouds = ("s/lidar0.pcd", "s/lidar1.pcd")
    ways = (
        ("simulate", "street", "--seed", "1", "--out", "s"),
        ("calibrate", *clouds, "--out", "out"),
        ("report", "out"),
        ("check", "out", *clouds),
        ("export", "out", "--to", "json"),
        ("export", "out", "--to", "urdf", "--out", "robot.urdf"),
        ("export", "robot.urdf", "--to", "json"),
        ("detect", clouds[0]),
        ("info", clouds[0]),
    )
    for words in ways:
        done = core_alone(tmp_path, *words)
        assert done.returncode == 0, f"{words}: {done.stderr[-800:]}"
    for extra, options in (
        ("ros", ("--to", "mcap", "--out", "a.mcap")),
        ("urdf", ("--into", "robot.urdf")),
    ):
        done = core_alone(tmp_path, "export", "out", *options)
        assert done.returncode == 2
        assert f"pip install 'retropole[{extra}]'" in done.stderr


@pytest.mark.parametrize(
    ("name", "extra"),
    first_of(
        [
            ("a.las", "las"),
            ("a.mcap", "ros"),
            ("a.laz", "las"),
            ("a.bag", "ros"),
            ("a.db3", "ros"),
        ],
        2,
    ),
)
@pytest.mark.full
def test_what_is_absent_is_named(name: str, extra: str, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(b"\x00" * 1000)
    done = core_alone(tmp_path, "info", name)
    assert done.returncode == 2
    assert f"pip install 'retropole[{extra}]'" in done.stderr


@pytest.mark.full
def test_no_licence_forbids_ours() -> None:
    for extra in (None, *extras()):
        for name, package in brought_by(extra)[0].items():
            licence = licence_of(name, package)
            assert fault(licence, "core" if extra is None else extra) is None, (name, licence)


@pytest.mark.parametrize(
    ("licence", "source", "found"),
    [
        ("GPL-3.0-or-later", "las", "GPL"),
        ("GNU General Public License v3 (GPLv3)", "las", "GPL"),
        ("AGPL-3.0", "las", "GPL"),
        ("LGPL-2.1", "las", None),
        ("GNU Lesser General Public License v2 or later (LGPLv2+)", "las", None),
        ("LGPL-2.1", "core", "GPL"),
        ("", "core", "unknown"),
        ("BSD-3-Clause AND MIT", "core", None),
    ],
)
def test_faults_of_licences(licence: str, source: str, found: str | None) -> None:
    assert fault(licence, source) == found
