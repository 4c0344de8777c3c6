"""Imports point one way, a layer per folder: the order in which the documentation names them."""

import ast
import re
import subprocess
import sys
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

from tests.paths import PACKAGE, ROOT

LAYERS = (
    # Ground: what all share.
    "base",
    # The steps, by what they return: poles, their pose, what two clouds have in common at a pose,
    # which poses there may be, the poses of all LiDARs, what follows from them.
    *("io", "extraction", "alignment", "surfaces", "hypotheses", "adjustment", "verdict"),
    # The method and its answer.
    *("pipeline", "checking", "ground", "carried", "result"),
    # Around the method, and what people touch.
    *("simulation", "planning", "fusion", "export", "report"),
    "api",
    *("fleet", "cli", "__main__"),
)
"""Modules and folders of the package; each imports only what stands before it."""

PUBLIC = {
    *(("api",), ("result",), ("base", "errors"), ("base", "files"), ("base", "version")),
    # Small pure mathematics of transforms.
    ("base", "se3"),
}
"""What others may build on, and `fleet` builds on alone."""

DOORS = {
    # `fleet` for its own commands, `report` for words and pictures.
    "cli": {"api", "base", "fleet", "report", "result"},
    # Of the steps, what a page works out of clouds that it is handed; no recording is read here.
    "report": {
        *("base", "result", "export", "checking", "fusion"),
        *("extraction", "surfaces", "hypotheses", "adjustment"),
    },
    # A recording is written in the frames that one is read in, a tree in the frames of a site, and
    # what was fused as it was.
    "export": {"base", "fusion", "io", "result"},
}
"""Rooms that what stands outermost may import; with time fewer."""

FILES = sorted(p for p in PACKAGE.rglob("*.py") if p != PACKAGE / "__init__.py")


def module_of(path: Path) -> tuple[str, ...]:
    """Name a file as Python does, without the package: ``("io", "pcd")``."""
    parts = path.relative_to(PACKAGE).with_suffix("").parts
    return parts[:-1] if parts[-1] == "__init__" else parts


MODULES = {module_of(path): path for path in FILES}


@cache
def tree_of(path: Path) -> ast.Module:
    return ast.parse(path.read_text())


@cache
def imports_of(path: Path) -> set[tuple[str, ...]]:
    """Modules of the package that a file imports, inside functions too."""
    package = path.relative_to(PACKAGE).parent.parts
    found: set[tuple[str, ...]] = set()
    for node in ast.walk(tree_of(path)):
        if not isinstance(node, ast.ImportFrom):
            continue
        named = tuple(node.module.split(".")) if node.module else ()
        if node.level:
            base = package[: len(package) - (node.level - 1)] + named
        elif named[0] == PACKAGE.name:
            base = named[1:]
        else:
            continue
        for alias in node.names:
            whole = (*base, alias.name)
            found.add(whole if whole in MODULES else base)
    return found & MODULES.keys() - {module_of(path)}


def test_imports_point_one_way() -> None:
    for path in FILES:
        own = module_of(path)[0]
        for name in imports_of(path):
            assert LAYERS.index(name[0]) <= LAYERS.index(own), f"{path} imports {'.'.join(name)}"


@pytest.mark.parametrize(
    "path", sorted((PACKAGE / "fleet").rglob("*.py")), ids=lambda p: str(p.relative_to(PACKAGE))
)
def test_a_fleet_stands_on_what_is_public(path: Path) -> None:
    for name in imports_of(path):
        public = {name[:1], name[:2]} & {("fleet",), *PUBLIC}
        assert public, f"{path} imports {'.'.join(name)}"


@pytest.mark.parametrize("room", DOORS)
def test_doors_are_narrow(room: str) -> None:
    """Neither a door that is not allowed, nor one that is allowed and not used."""
    used = {name[0] for own, path in MODULES.items() if own[0] == room for name in imports_of(path)}
    assert used - {room} == DOORS[room]


def test_no_import_cycle() -> None:
    graph = {name: imports_of(path) for name, path in MODULES.items()}
    list(TopologicalSorter(graph).static_order())


def test_every_folder_has_a_layer() -> None:
    assert {name[0] for name in MODULES} == set(LAYERS)


def test_the_package_stands_alone() -> None:
    """What stands beside it in a clone is in no wheel."""
    beside = {"benchmarks", "docs", "examples", "studies", "tests"}
    for path in FILES:
        for node in ast.walk(tree_of(path)):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            if isinstance(node, ast.ImportFrom) and not node.level and node.module:
                names = [node.module]
            assert beside.isdisjoint(name.partition(".")[0] for name in names), path


def test_modules_stay_small() -> None:
    for path in FILES:
        assert len(path.read_text().splitlines()) <= 600, path


def test_the_top_holds_the_method_alone() -> None:
    top = {path.name for path in PACKAGE.glob("*.py")}
    assert top == {"__init__.py", "__main__.py", "pipeline.py"}


def test_import_leaves_heavy_parts_alone() -> None:
    heavy = ["matplotlib", "laspy", "pypcd4", "rich", "pandas", "scipy.stats"]
    heavy += ["scipy.optimize", "rosbags", "mcap", "yaml", "pyproj"]
    ours = "import sys, retropole.pipeline, retropole.cli, retropole.report"
    code = f"{ours}; print([m for m in {heavy} if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


@pytest.mark.parametrize("words", [("--version",), ("--help",), ("calibrate", "--help")])
def test_the_command_starts_without_what_computes(words: tuple[str, ...]) -> None:
    # SciPy takes twice as long to import as all else that a command needs to start.
    heavy = ["scipy", "small_gicp", "retropole.pipeline"]
    heavy += ["numpy"] if words == ("--version",) else []
    ours = f"import sys; from retropole.cli import run; run({words})"
    code = f"{ours}; print('loaded', [m for m in {heavy} if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "loaded []"


WORDS = re.compile(r"(?<!`)`([A-Za-z_][\w.]*)`(?!`)")
"""Names in single backticks: of the package, where they are Python's."""

ELSEWHERE = {"retropole", "tf", "tf2_ros", "fork", "scipy", "optimize", "ndimage"}
"""Names of other programs, and what no module assigns."""


def names_in(tree: ast.Module) -> set[str]:
    """All names that a module uses, defines or takes."""
    found: set[str] = set()
    for node in ast.walk(tree):
        match node:
            case ast.FunctionDef(name=name) | ast.ClassDef(name=name) | ast.Name(id=name):
                found.add(name)
            case ast.arg(arg=name) | ast.Attribute(attr=name) | ast.keyword(arg=str(name)):
                found.add(name)
            case ast.alias(name=name):
                found.update(name.split("."))
    return found


@cache
def all_names() -> frozenset[str]:
    every = {part for name in MODULES for part in name}
    return frozenset(every.union(*(names_in(tree_of(path)) for path in FILES)))


@pytest.mark.full
def test_names_in_docstrings_exist() -> None:
    for path in FILES:
        for node in ast.walk(tree_of(path)):
            if isinstance(node, ast.Constant) and isinstance(node.value, str):
                for word in WORDS.findall(node.value):
                    unknown = set(word.split(".")) - all_names() - ELSEWHERE
                    assert not unknown, f"{path}:{node.lineno} names `{word}`"


@pytest.mark.full
def test_names_of_modules_in_docstrings_and_architecture_exist() -> None:
    """Of `room.module` and `module.name` both parts are where they are said to be."""
    by_stem: dict[str, set[str]] = {}
    for name, path in MODULES.items():
        inside = names_in(tree_of(path)) | {m[-1] for m in MODULES if m[:-1] == name}
        by_stem.setdefault(name[-1], set()).update(inside)
    texts = [(path, path.read_text(encoding="utf-8")) for path in FILES]
    page = ROOT / "docs" / "architecture.md"
    for path, text in [*texts, (page, page.read_text(encoding="utf-8"))]:
        for word in WORDS.findall(text):
            first, _, rest = word.removeprefix("retropole.").partition(".")
            if rest and first in by_stem and rest not in {"py", "toml"}:
                assert rest.partition(".")[0] in by_stem[first], f"{path} names `{word}`"


METHOD = ("extraction", "alignment", "surfaces", "hypotheses", "adjustment", "verdict")


def test_a_constant_has_one_meaning_in_the_method() -> None:
    """Of a name that is set in two modules a reader would take one for the other."""
    seen: dict[str, tuple[str, ...]] = {}
    for module, path in MODULES.items():
        if module[0] not in METHOD:
            continue
        for node in tree_of(path).body:
            if not isinstance(node, ast.Assign | ast.AnnAssign):
                continue
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            for name in (n.id for t in targets for n in ast.walk(t) if isinstance(n, ast.Name)):
                if name.isupper() and len(name) > 1:
                    assert seen.setdefault(name, module) == module, (
                        f"{name}: {seen[name]}, {module}"
                    )
