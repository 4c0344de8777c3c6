"""What is handed out installs and runs: wheel, source archive, container, conda recipe.

    pytest -m "full or nightly" tests/test_packaging.py

builds both archives, installs each into a virtual environment that holds nothing else, and types
there what the README says first. It takes the registry of packages, and some two minutes.
"""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
import tarfile
import time
import tomllib
import venv
import zipfile
from email import message_from_bytes, policy
from pathlib import Path
from typing import Any

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from packaging.version import Version

import retropole
from tests.paths import PACKAGE, ROOT

PYPROJECT: dict[str, Any] = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
PROJECT: dict[str, Any] = PYPROJECT["project"]
README = (ROOT / "README.md").read_text(encoding="utf-8")

MOST_LINES = 3
"""To type, from the archive to an answer that is held against the truth."""

PAPER = "Automatic Calibration of Dual-LiDARs Using Two Poles Stickered with Retro-Reflective Tape"
"""Title of the paper of the method, Xue et al. 2019."""

LARGEST_ARCHIVE = 5_000_000
"""Bytes; the pictures of the documentation take most of the source archive."""


def same_requirements(ours: list[str], theirs: list[str]) -> bool:
    """Whether two lists ask for the same, whatever way they write it."""
    return {str(Requirement(r)).lower() for r in ours} == {
        str(Requirement(r)).lower() for r in theirs
    }


def recipe() -> dict[str, Any]:
    yaml = pytest.importorskip("yaml", reason="PyYAML is not installed")
    loaded: dict[str, Any] = yaml.safe_load((ROOT / "recipe" / "recipe.yaml").read_text())
    return loaded


def test_the_conda_recipe_says_what_pyproject_says() -> None:
    found = recipe()
    python = f"python {PROJECT['requires-python']}"
    run, host = found["requirements"]["run"], found["requirements"]["host"]
    assert found["context"]["version"] == retropole.__version__
    assert found["package"]["name"] == PROJECT["name"]
    assert same_requirements(run, [python, *PROJECT["dependencies"]])
    assert same_requirements(host, [python, "pip", *PYPROJECT["build-system"]["requires"]])
    scripts = [f"{name} = {place}" for name, place in PROJECT["scripts"].items()]
    assert found["build"]["python"]["entry_points"] == scripts
    about = found["about"]
    assert (about["summary"], about["license"]) == (PROJECT["description"], PROJECT["license"])
    assert (ROOT / about["license_file"]).is_file()


def pinned(name: str) -> dict[str, Version]:
    """The versions that a constraint file gives, by the names of their packages."""
    lines = (ROOT / "constraints" / f"{name}.txt").read_text(encoding="utf-8").splitlines()
    found = [Requirement(line) for line in lines if not line.startswith("#")]
    assert all(len(one.specifier) == 1 and "==" in str(one) for one in found)
    versions = {canonicalize_name(one.name): str(one.specifier)[2:] for one in found}
    assert len(versions) == len(found)
    return {package: Version(version) for package, version in versions.items()}


def test_the_constraints_name_every_dependency_within_its_bounds() -> None:
    lists = [PROJECT["dependencies"], *PROJECT["optional-dependencies"].values()]
    every = [Requirement(line) for lines in lists for line in lines]
    allowed = [one for one in every if one.name != PROJECT["name"]]
    oldest, newest = pinned("oldest"), pinned("newest")
    assert oldest.keys() == newest.keys() == {canonicalize_name(one.name) for one in allowed}
    for one in allowed:
        name = canonicalize_name(one.name)
        (lower,) = [each.version for each in one.specifier if each.operator == ">="]
        assert oldest[name] == Version(lower), f"{one}: oldest.txt has another"
        assert newest[name] in one.specifier
        assert oldest[name] <= newest[name]


def test_the_citation_is_of_this_version() -> None:
    text = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    assert f"\nversion: {retropole.__version__}\n" in text
    assert f"\nlicense: {PROJECT['license']}\n" in text
    page = (ROOT / "docs" / "method.md").read_text(encoding="utf-8")
    assert f"version = {{{retropole.__version__}}}" in page
    title = (
        "Automatic Calibration of Dual-LiDARs Using Two Poles Stickered with Retro-Reflective Tape"
    )
    assert title in text
    assert title in page


def test_the_container_is_made_of_what_there_is() -> None:
    text = (ROOT / "Dockerfile").read_text(encoding="utf-8")
    bracket = re.search(r"\.whl\)\[([^\]]+)\]", text)
    assert bracket is not None
    assert set(bracket[1].split(",")) <= PROJECT["optional-dependencies"].keys()
    ignored = (ROOT / ".dockerignore").read_text(encoding="utf-8").splitlines()
    kept = {line.removeprefix("!") for line in ignored if line.startswith("!")}
    copied = {
        word for line in re.findall(r"^COPY (.*)$", text, flags=re.M) for word in line.split()[:-1]
    }
    assert copied <= kept
    assert all((ROOT / name).exists() for name in copied)
    # Who runs it is not root: the last user named is another one.
    assert re.findall(r"^USER (\S+)$", text, flags=re.M)[-1:] == ["retropole"]


def test_the_licence_is_an_expression_and_the_versions_of_python_are_reported() -> None:
    assert PROJECT["license"] == "Apache-2.0"
    assert not [c for c in PROJECT["classifiers"] if c.startswith("License ::")]
    told = [c.rsplit(" ", 1)[-1] for c in PROJECT["classifiers"] if "Python :: 3." in c]
    assert told[0] == PROJECT["requires-python"].removeprefix(">=")
    assert f"{sys.version_info[0]}.{sys.version_info[1]}" in told


def first_lines() -> list[str]:
    """What the README has a newcomer type who has no files: to the first answer, and its check."""
    blocks = re.findall(r"^```sh\n(.*?)^```", README, flags=re.S | re.M)
    (install,) = [block for block in blocks if block.startswith("pip install .")]
    (first,) = [block for block in blocks if block.startswith("retropole simulate")]
    lines = [*install.splitlines(), *first.splitlines()]
    assert len(lines) <= MOST_LINES
    return lines


def test_the_first_lines_of_the_readme_are_three() -> None:
    lines = first_lines()
    assert "retropole evaluate" in lines[-1]
    assert "--truth" in lines[-1]


def bare() -> dict[str, str]:
    """The environment of one who has installed nothing: no path of ours, none of Python's."""
    names = ("HOME", "TMPDIR", "SYSTEMROOT", "LANG", "SSL_CERT_FILE", "REQUESTS_CA_BUNDLE")
    kept = {name: os.environ[name] for name in names if name in os.environ}
    return kept | {name: own for name, own in os.environ.items() if name.startswith("PIP_")}


class Fresh:
    """A virtual environment that holds pip, and a folder to type in."""

    def __init__(self, folder: Path) -> None:
        venv.create(folder / "venv", with_pip=True)
        self.bin = folder / "venv" / ("Scripts" if os.name == "nt" else "bin")
        self.work = folder / "work"
        self.work.mkdir()

    def type(self, line: str) -> str:
        """Type a line; every part of it has to succeed."""
        env = bare() | {"PATH": f"{self.bin}{os.pathsep}{os.defpath}"}
        done = subprocess.run(
            line, shell=True, cwd=self.work, env=env, capture_output=True, text=True
        )
        assert done.returncode == 0, f"{line}\n{done.stdout[-2000:]}\n{done.stderr[-2000:]}"
        return done.stdout


@pytest.fixture(scope="module")
def archives(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Build the wheel from the source archive, as a package index would be given them."""
    folder = tmp_path_factory.mktemp("archives")
    fresh = Fresh(folder)
    try:
        fresh.type("pip install --quiet build twine")
    except AssertionError as error:
        pytest.skip(f"no registry of packages: {str(error)[-200:]}")
    fresh.type(
        f"python -m build --outdir {shlex.quote(str(folder / 'dist'))} {shlex.quote(str(ROOT))}"
    )
    fresh.type(f"twine check --strict {shlex.quote(str(folder / 'dist'))}/*")
    (wheel,) = (folder / "dist").glob("*.whl")
    (source,) = (folder / "dist").glob("*.tar.gz")
    return {"wheel": wheel, "sdist": source}


@pytest.mark.full
def test_the_archives_hold_what_they_should(archives: dict[str, Path]) -> None:
    with zipfile.ZipFile(archives["wheel"]) as wheel:
        names = set(wheel.namelist())
        (about,) = [name for name in names if name.endswith(".dist-info/METADATA")]
        fields = message_from_bytes(wheel.read(about), policy=policy.compat32)
    tree = [p for p in PACKAGE.rglob("*") if p.is_file() and "__pycache__" not in p.parts]
    ours = {f"retropole/{p.relative_to(PACKAGE).as_posix()}" for p in tree}
    assert {name for name in names if ".dist-info/" not in name} == ours
    assert fields["Version"] == retropole.__version__
    assert fields["License-Expression"] == PROJECT["license"]
    assert fields["Requires-Python"] == PROJECT["requires-python"]
    assert fields.get_all("Classifier") == sorted(PROJECT["classifiers"])
    core = [line for line in fields.get_all("Requires-Dist") or [] if "extra ==" not in line]
    assert same_requirements(
        [line.replace("_", "-") for line in core],
        [line.replace("_", "-") for line in PROJECT["dependencies"]],
    )
    with tarfile.open(archives["sdist"]) as source:
        inside = {name.partition("/")[2] for name in source.getnames()}
    tops = {name.partition("/")[0] for name in inside}
    needed = {
        "src",
        "tests",
        "docs",
        "examples",
        "benchmarks",
        "studies",
        "recipe",
        "constraints",
        "Dockerfile",
    }
    assert needed | {"LICENSE", "README.md", "CITATION.cff", "PKG-INFO"} <= tops
    assert not {top for top in tops if top.startswith(".") and top != ".gitignore"} - {
        ".dockerignore"
    }
    assert not [name for name in inside if "__pycache__" in name or name.endswith(".pyc")]
    assert not [name for name in inside if name.startswith("docs/_build")]
    assert all(archive.stat().st_size < LARGEST_ARCHIVE for archive in archives.values())


@pytest.mark.full
@pytest.mark.parametrize(
    "kind",
    # The wheel is built from the other.
    ["wheel", pytest.param("sdist", marks=pytest.mark.nightly)],
)
def test_a_newcomer_gets_from_the_archive_to_a_verified_answer(
    kind: str, archives: dict[str, Path], tmp_path: Path
) -> None:
    """The core alone, since no extra is needed; ``-s`` shows how long it took."""
    fresh = Fresh(tmp_path)
    install, *rest = first_lines()
    archive = shlex.quote(str(archives[kind]))
    start = time.monotonic()
    fresh.type(install.removesuffix(".") + archive)
    installed = time.monotonic()
    said = [fresh.type(line) for line in rest]
    end = time.monotonic()
    print(f"{kind}: installed in {installed - start:.0f} s, answered in {end - installed:.0f} s")
    error = re.search(r"^error +e_rt ([0-9.]+) (mm|cm),", said[-1], flags=re.M)
    assert error is not None, said[-1]
    assert float(error[1]) < (10 if error[2] == "mm" else 1)
    assert (fresh.work / "r" / "report.html").is_file()
    where = fresh.type('python -c "import retropole; print(retropole.__file__)"')
    assert str(fresh.bin.parent) in where
    assert fresh.type("retropole --version").split()[-1] == retropole.__version__
