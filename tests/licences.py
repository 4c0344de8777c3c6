"""Licences of all that an installation of this project brings, from the metadata of the packages.

    python -m tests.licences            # the core and every extra that is installed
    python -m tests.licences las ros    # the core and these extras

Each line names a package, its version, its licence and what brings it. The exit code is 1 where one
is neither permissive nor weak copyleft, or says nothing; the LGPL is let into extras alone.
"""

from __future__ import annotations

import re
import sys
from importlib.metadata import Distribution, PackageNotFoundError, distribution

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

PROJECT = "retropole"

PERMISSIVE = re.compile(
    r"\b(MIT|BSD|0BSD|Apache|ISC|PSF|Python Software Foundation|Zlib|CC0|Public Domain|MPL"
    r"|Mozilla Public|LGPL|Lesser General Public|HPND|Zope)\b",
    re.IGNORECASE,
)

STRICT = re.compile(r"\bA?GPL|(?<!Lesser )General Public License", re.IGNORECASE)
"""The GNU licences that reach what is linked with them."""

LESSER = re.compile(r"\bLGPL|Lesser General Public", re.IGNORECASE)

LOOKED_UP = {
    # One file of it, an Emacs mode, is under the GPL; no program runs it.
    "docutils": "public domain and BSD-2-Clause",
    # Its metadata leaves the choice: any licence that the OSI approves.
    "apsw": "any OSI-approved, such as MIT",
    # No metadata; the licence file of its source.
    "urdf-parser-py": "BSD-3-Clause",
}
"""Licences of packages whose metadata does not tell, and where they were found."""


def brought_by(extra: str | None) -> tuple[dict[str, Distribution], set[str]]:
    """Packages that an extra brings (None: the core), by name, and those that are not installed."""
    found: dict[str, Distribution] = {}
    absent: set[str] = set()
    seen: set[str] = set()
    todo = [PROJECT if extra is None else f"{PROJECT}[{extra}]"]
    while todo:
        wanted = Requirement(todo.pop())
        try:
            package = distribution(wanted.name)
        except PackageNotFoundError:
            absent.add(wanted.name)
            continue
        found[canonicalize_name(wanted.name)] = package
        for line in package.requires or []:
            needed = Requirement(line)
            asked = {*wanted.extras, ""}
            if needed.marker and not any(needed.marker.evaluate({"extra": e}) for e in asked):
                continue
            needed.marker = None
            if str(needed) not in seen:
                seen.add(str(needed))
                todo.append(str(needed))
    del found[PROJECT]
    return found, absent


def licence_of(name: str, package: Distribution) -> str:
    """What the metadata says: the SPDX expression, else the classifiers, else the first line."""
    if name in LOOKED_UP:
        return LOOKED_UP[name]
    fields = package.metadata
    if "License-Expression" in fields:
        return fields["License-Expression"]
    lines = fields.get_all("Classifier") or []
    classified = [line.split(" :: ")[-1] for line in lines if line.startswith("License ::")]
    if classified:
        return ", ".join(classified)
    text = str((fields.get_all("License") or [""])[0])
    return text.strip().split("\n")[0][:60]


def fault(licence: str, source: str) -> str | None:
    """Say what is wrong with a licence; None where the project may depend on it."""
    if STRICT.search(licence) or (source == "core" and LESSER.search(licence)):
        return "GPL"
    if not PERMISSIVE.search(licence):
        return "unknown"
    return None


def extras() -> list[str]:
    """Every extra of the project."""
    return sorted(distribution(PROJECT).metadata.get_all("Provides-Extra") or [])


def main(asked: list[str]) -> int:
    """Print the licences; 1 where one is at fault."""
    core, _ = brought_by(None)
    lines = {name: (package, "core") for name, package in core.items()}
    brought = {extra: brought_by(extra) for extra in asked or extras()}
    # What two extras bring is listed with the smaller one.
    for extra, (packages, absent) in sorted(brought.items(), key=lambda item: len(item[1][0])):
        if absent:
            print(f"{extra}: not installed: {', '.join(sorted(absent))}")
        for name, package in packages.items():
            lines.setdefault(name, (package, extra))
    faults = 0
    for name, (package, source) in sorted(lines.items()):
        licence = licence_of(name, package)
        wrong = fault(licence, source)
        faults += wrong is not None
        print(f"{name:30} {package.version:14} {source:9} {licence}", f"  <- {wrong}" * bool(wrong))
    print(f"{len(lines)} packages, {faults} at fault")
    return int(faults > 0)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
