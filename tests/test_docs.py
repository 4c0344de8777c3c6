"""The documentation builds, its links lead somewhere, and what it says of the program is so."""

from __future__ import annotations

import importlib.util
import re
import shlex
import subprocess
import sys
from collections.abc import Iterator
from html import unescape
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

import click
import pytest

from retropole.base.reasons import page as page_of
from retropole.base.reasons import reasons, tables
from retropole.base.sensors import SENSORS
from retropole.cli import cli
from tests.paths import PACKAGE, ROOT

DOCS = ROOT / "docs"
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "CHANGELOG.md"]
PAGES += sorted(DOCS.rglob("*.md"))
NEEDED = ("sphinx", "myst_parser", "furo", "latex2mathml")


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    for name in NEEDED:
        if importlib.util.find_spec(name) is None:
            pytest.skip(f"{name} is not installed: pip install 'retropole[docs]'")
    out = tmp_path_factory.mktemp("site")
    # The lists of objects beside the pages and the types of arguments take half of the time.
    quick = "-D", "toc_object_entries=0", "-D", "autodoc_typehints=none"
    done = subprocess.run(
        [sys.executable, "-m", "sphinx", "-q", "-W", "--keep-going", *quick, str(DOCS), str(out)],
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    return out


class Links(HTMLParser):
    """What a page points to, what it loads, and where one can point to in it."""

    def __init__(self, page: Path) -> None:
        super().__init__()
        self.links: list[str] = []
        self.loaded: list[str] = []
        self.anchors: set[str] = set()
        self.feed(page.read_text(encoding="utf-8"))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        found = dict(attrs)
        self.anchors |= {value for key in ("id", "name") if (value := found.get(key))}
        if tag == "a":
            self.links += [link] if (link := found.get("href")) else []
        elif tag in ("link", "script", "img", "iframe"):
            self.loaded += [v for key in ("href", "src") if (v := found.get(key))]


@pytest.mark.full
def test_links_and_anchors_of_the_site_exist(site: Path) -> None:
    pages = {page.resolve(): Links(page) for page in site.rglob("*.html")}
    assert len(pages) > 20
    broken = []
    for page, own in pages.items():
        for link in own.links + own.loaded:
            parts = urlsplit(link)
            if parts.scheme or parts.netloc:
                continue
            path = (page.parent / unquote(parts.path)).resolve() if parts.path else page
            anchors = pages[path].anchors if path in pages else set()
            if not path.is_file() or (
                parts.fragment and path in pages and unquote(parts.fragment) not in anchors
            ):
                broken.append(f"{page.name}: {link}")
    assert not broken


class Prose(HTMLParser):
    """The words of a page, without code and scripts."""

    LEFT_OUT = frozenset({"code", "pre", "script", "style"})

    def __init__(self, page: Path) -> None:
        super().__init__()
        self.depth, self.words = 0, ""
        self.feed(page.read_text(encoding="utf-8"))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.depth += tag in self.LEFT_OUT

    def handle_endtag(self, tag: str) -> None:
        self.depth -= tag in self.LEFT_OUT

    def handle_data(self, data: str) -> None:
        if not self.depth:
            self.words += data


@pytest.mark.full
def test_no_markup_is_left_in_the_words_of_a_page(site: Path) -> None:
    raw = re.compile(r".{0,40}(?:`|:(?:class|func|mod|ref|py:obj):|TypeAliasForwardRef).{0,40}")
    left = {page.name: raw.findall(Prose(page).words) for page in site.rglob("*.html")}
    assert not {name: own for name, own in left.items() if own}


@pytest.mark.full
def test_site_loads_nothing_from_elsewhere(site: Path) -> None:
    for page in site.rglob("*.html"):
        assert not [link for link in Links(page).loaded if urlsplit(link).netloc], page.name


def anchors_of(page: Path) -> set[str]:
    """The anchors of a page's headings as GitHub makes them, for whoever reads it in a clone."""
    headings = re.findall(r"^#+ (.+)$", text_of(page), flags=re.M)
    return {re.sub(r"[^\w\- ]", "", one).lower().replace(" ", "-") for one in headings}


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.name)
def test_links_between_sources_exist(page: Path) -> None:
    for target in re.findall(r"\]\((?!https?:)([^)\s]+)\)", text_of(page)):
        path, _, anchor = target.partition("#")
        found = page.parent / path if path else page
        assert found.exists(), target
        if anchor and found.suffix == ".md":
            assert anchor in anchors_of(found), target


def test_pages_that_the_code_names_exist() -> None:
    files = [p for name in ("src", "benchmarks", "studies", "tests") for p in named(ROOT / name)]
    said = {(p.name, page) for p in files for page in re.findall(r"docs/[\w/]+\.md", text_of(p))}
    assert len(said) > 20
    assert not {(name, page) for name, page in said if not (ROOT / page).is_file()}
    prefixed = {f"{one}_few_points" for one in tables().prefixes}
    anchors = {f"docs/reasons.md#{one}" for one in anchors_of(DOCS / "reasons.md")}
    assert {page_of(code) for code in (*reasons(), *prefixed)} <= anchors


def named(folder: Path) -> list[Path]:
    return [*folder.rglob("*.py"), *folder.rglob("*.toml")]


def text_of(path: Path) -> str:
    return path.read_text(encoding="utf-8")


def command_lines() -> Iterator[tuple[str, list[str]]]:
    """Every command line of retropole in a code block or in backticks that shows one."""
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        blocks = re.findall(r"^ *```(\S*)[^\n]*\n(.*?)^ *```", text, flags=re.S | re.M)
        shown = [block for language, block in blocks if language in ("", "sh")]
        shown += re.findall(r"`(retropole [^`\n]+)`", text)
        for line in "\n".join(shown).replace("\\\n", " ").splitlines():
            for part in re.split(r"\s(?:&&|\|\||\||>>?|<)\s", line):
                start = re.search(r"(?:^|\s)retropole\s+(?=[a-zA-Z])", part)
                if start and not part.lstrip().startswith(("pip ", "#")):
                    yield page.name, shlex.split(part[start.end() :])


@pytest.mark.parametrize(("page", "words"), list(command_lines()), ids=lambda v: str(v)[:60])
def test_command_lines_exist(page: str, words: list[str]) -> None:
    if words[0] == "COMMAND":
        return
    assert words[0] in cli.commands, f"{page}: there is no command {words[0]}"
    command = cli.commands[words[0]]
    if isinstance(command, click.Group) and words[1:2] and words[1] in command.commands:
        words = words[1:]
        command = command.commands[words[0]]
    options = {
        name: option
        for option in command.params
        if isinstance(option, click.Option)
        for name in option.opts
    }
    arguments = [p for p in command.params if isinstance(p, click.Argument)]
    rest, given = words[1:], 0
    while rest:
        word = rest.pop(0).strip("[]")
        if not word.startswith("-") or word[1:2].isdigit():
            given += 1
            continue
        if word in ("--help", "-h"):
            continue
        assert word in options, f"{page}: {words[0]} has no option {word}"
        option = options[word]
        count = 0 if option.is_flag else option.nargs
        values, rest = [value.strip("[]") for value in rest[:count]], rest[count:]
        assert len(values) == count, f"{page}: {word} takes {count} values"
        if count == 1 and not values[0].isupper() and not isinstance(option.type, click.Path):
            option.type.convert(values[0], option, None)
    if all(argument.nargs == 1 for argument in arguments):
        assert given <= len(arguments), f"{page}: {' '.join(words)}"


def test_parts_that_the_program_writes_are_fresh() -> None:
    """Where one is not: python docs/make_pages.py."""
    spec = importlib.util.spec_from_file_location("make_pages", DOCS / "make_pages.py")
    assert spec is not None
    assert spec.loader is not None
    pages = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(pages)
    for name, (page, _) in pages.PARTS.items():
        assert (DOCS / page).read_text(encoding="utf-8") == pages.fresh(name), page


@pytest.mark.full
def test_every_code_has_its_entry_on_the_page(site: Path) -> None:
    anchors = Links(site / "reasons.html").anchors
    missing = {code for code in reasons() if code.replace("_", "-") not in anchors}
    assert not missing


@pytest.mark.full
def test_every_sensor_has_its_row_on_the_page(site: Path) -> None:
    page = unescape((site / "sensors.html").read_text(encoding="utf-8"))
    for sensor in SENSORS.values():
        assert sensor.name in page
        assert sensor.source.replace("'", "’") in page.replace("'", "’")


def test_api_has_every_public_module() -> None:
    text = "".join(p.read_text(encoding="utf-8") for p in sorted((DOCS / "api").glob("*.rst")))
    listed = re.findall(r"^\.\. automodule:: retropole\.(\S+)", text, flags=re.M)
    assert len(listed) == len(set(listed))
    tops = {p.stem for p in PACKAGE.glob("*.py")} | {p.parent.name for p in PACKAGE.glob("*/*.py")}
    assert tops - {"__init__", "__main__", "cli"} == {n for n in listed if "." not in n}


def test_made_pictures_are_small() -> None:
    for path in (DOCS / "images").rglob("*.png"):
        assert path.name == "result.png" or path.stat().st_size < 300_000, path
