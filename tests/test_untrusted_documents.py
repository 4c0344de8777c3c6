"""Documents that were edited by hand, cut short or made up: an error, or an answer that is one."""

from __future__ import annotations

import json
import random
from collections.abc import Callable
from contextlib import suppress
from copy import deepcopy
from functools import cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np
import pytest

from retropole.api.plan_checking import against, planned_error
from retropole.base.errors import ReadError, Refusal
from retropole.base.uncertainty.purpose import Need
from retropole.cli import run
from retropole.export import FORMATS, TREE_FORMATS, read_transform
from retropole.report import render_report
from retropole.report.pole_plan import describe_plan, render_pole_plan
from retropole.result import REPORT_FILE, encode
from retropole.result.certification import FieldTestDoc, field_test_document
from retropole.result.decoding import decode, decode_plan, decode_site, parsed
from retropole.result.pole_plan import MovedDoc, MovedErrorDoc
from tests.report.made_up import made_up
from tests.report.plans import made_picture, made_plan
from tests.report.site.made_up import document_of, made_up_site
from tests.report.test_field_test import made_up as field_test
from tests.tiers import first_of

NASTY: tuple[Any, ...] = (
    *(None, True, False, "", [], {}, [[]], 0, -1, 3, 10**30, 0.5, -0.0, 1e-320, 1e13, 1e308),
    *("x" * 20_000, "nan", "\x00\x1b[2J", "</script><script>alert(1)</script>", "\ud7ff", "ok"),
    *([0.0] * 6, [[0.0] * 6] * 6, [[1e308] * 4] * 4, {"x": 1e308}, [None], -1e-4, "target"),
)


def nodes(value: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Every place of a document but its root."""
    found = []
    if isinstance(value, dict | list):
        for key, each in value.items() if isinstance(value, dict) else enumerate(value):
            found += [(*path, key), *nodes(each, (*path, key))]
    return found


def edited(document: Any, dice: random.Random) -> bytes:
    """Replace, remove, repeat, negate or scale something in a document."""
    document = json.loads(json.dumps(document))
    for _ in range(dice.choice((1, 1, 1, 2, 4))):
        *way, last = dice.choice(nodes(document))
        place = document
        for key in way:
            place = place[key]
        what = dice.randrange(6)
        if what == 0:
            del place[last]
        elif what == 1 and isinstance(place, list):
            place.insert(last, place[last])
        elif what == 2:
            place[last] = scaled(place[last], dice.choice((-1.0, 0.0, 1e-9, 1e9, 1e150)))
        else:
            place[last] = deepcopy(dice.choice(NASTY))
        if not nodes(document):
            break
    return json.dumps(document).encode()


def scaled(value: Any, factor: float) -> Any:
    """Scale every number of a value."""
    if isinstance(value, list):
        return [scaled(each, factor) for each in value]
    if isinstance(value, dict):
        return {key: scaled(each, factor) for key, each in value.items()}
    return value * factor if isinstance(value, float) else value


def damaged(data: bytes, dice: random.Random) -> bytes:
    """Cut a document, or change some of its bytes."""
    if dice.random() < 0.3:
        return data[: dice.randrange(len(data))]
    changed = bytearray(data)
    for _ in range(dice.choice((1, 2, 8))):
        at, any_byte = dice.randrange(len(changed)), bytes([dice.randrange(256)])
        what = dice.choice((b"", b"9", b"-", b"e3", b"null", b"[", b'"', any_byte))
        changed[at : at + dice.choice((0, 1, 1, 4))] = what
    return bytes(changed)


def mutated(document: Any, dice: random.Random) -> bytes:
    """Make another document of one."""
    if dice.random() < 0.8:
        return edited(document, dice)
    return damaged(json.dumps(document).encode(), dice)


class Kind(NamedTuple):
    """A kind of documents that are read again: one as it is written today, and its reader."""

    whole: bytes
    read: Callable[[bytes], Any]


RUN = cache(partial(made_up, "ok", 400))


def result_whole() -> Kind:
    return Kind(encode(RUN().result), decode)


def site_whole() -> Kind:
    site = made_up_site("ok", lidars=3, placements=2, count=20, surveyed=True)
    return Kind(encode(document_of(site)), decode_site)


PICTURE = cache(partial(made_picture, 2))


def plan_whole(*, is_moved: bool = False) -> Kind:
    plan = made_plan(PICTURE(), need=Need(0.02, 20.0))
    if is_moved:
        error = MovedErrorDoc(lidar="rear", sigma_m=0.01, alone_m=0.02)
        moved = MovedDoc(poles=["A"], errors=[error])
        plan = msgspec.structs.replace(
            plan, predicted=[], more=[], rehearsal=None, probability=None, moved=moved
        )
    return Kind(encode(plan), decode_plan)


def certificate_whole() -> Kind:
    test = field_test_document({("a", "b"): field_test()}, lidars="ab", radius=0.02, inputs=[])
    return Kind(encode(test), partial(parsed, kind=FieldTestDoc, what="certificate"))


WHOLE: dict[str, Callable[[], Kind]] = {
    "result": result_whole,
    "site": site_whole,
    "plan": plan_whole,
    "moved plan": partial(plan_whole, is_moved=True),
    "certificate": certificate_whole,
}


@pytest.mark.parametrize("kind", WHOLE)
def test_what_is_damaged_is_read_without_an_error_before(kind: str) -> None:
    """Documents of an older schema would all fail at its name, and test nothing."""
    whole, read = WHOLE[kind]()
    again = msgspec.json.decode(encode(read(whole)))
    assert again == msgspec.json.decode(whole)


def hold_result(path: Path, dice: random.Random) -> None:
    """Hand a document to all that take it; an error where it is none."""
    out = path.with_name("out.txt")
    assert run(["export", str(path), "--to", dice.choice(list(FORMATS)), "--out", str(out)]) in DONE
    assert_no_nan(render_report(decode(path.read_bytes()), RUN().placements))
    try:
        transform = read_transform(path)
    except (Refusal, ReadError):
        return
    assert np.isfinite(transform.T_parent_child).all()
    if transform.covariance is not None:
        assert np.linalg.eigvalsh(transform.covariance)[0] > -1e-5 * transform.covariance.max()


def hold_site(path: Path, dice: random.Random) -> None:
    """Hand a document of a site to all that take it; an error where it is none."""
    out, to = path.with_name("out.txt"), dice.choice(list(TREE_FORMATS))
    assert run(["export", str(path), "--to", to, "--out", str(out)]) in DONE
    document = decode_site(path.read_bytes())
    for lidar in document.lidars:
        assert lidar.T_site_lidar is None or np.isfinite(lidar.T_site_lidar).all()
    assert_no_nan(render_report(document))


def hold_plan(path: Path, dice: random.Random) -> None:
    """Hand a plan to all that take one; an error where it is none."""
    plan, picture = decode_plan(path.read_bytes()), PICTURE()
    poles = RUN().result.poles.target
    for lidar in (None, *(each.name for each in plan.lidars)):
        for some in (poles, poles[:1], []):
            assert len(against(plan, some, lidar)) > 0
    assert planned_error(plan) > 0
    assert "nan" not in describe_plan(plan).split()
    if len(plan.lidars) == len(picture.lidars) and dice.random() < 0.1:
        assert render_pole_plan(plan, picture) if plan.predicted else plan.moved


DONE = (0, 2, 3)
"""Exit codes of what ended as it should."""


class Held(NamedTuple):
    """What a file is called, who takes it, and the least share of edited ones that are taken."""

    name: str
    hold: Callable[[Path, random.Random], None]
    taken: float


HOLD = {
    "result": Held("result.json", hold_result, 0.05),
    # Most numbers of a site are of its joint covariance, and each of them is needed.
    "site": Held("site-result.json", hold_site, 0.01),
    "plan": Held("plan.json", hold_plan, 0.05),
    "moved plan": Held("plan.json", hold_plan, 0.05),
}


def assert_no_nan(page: str) -> None:
    assert "nan" not in page.split("<script")[0].lower().split(">")


@pytest.mark.parametrize(
    ("kind", "count"), first_of([("result", 50), ("site", 20), ("plan", 100), ("moved plan", 100)])
)
def test_an_edited_document_is_an_error_or_one(kind: str, count: int, tmp_path: Path) -> None:
    hold_many(kind, tmp_path, range(count))


@pytest.mark.full
@pytest.mark.parametrize("kind", HOLD)
def test_more_edited_documents(kind: str, tmp_path: Path) -> None:
    hold_many(kind, tmp_path, range(1000, 1200))


@pytest.mark.nightly
@pytest.mark.parametrize("kind", HOLD)
@pytest.mark.parametrize("part", range(20))
def test_many_edited_documents(part: int, kind: str, tmp_path: Path) -> None:
    hold_many(kind, tmp_path, range(1000 * (part + 1), 1000 * (part + 2)))


@pytest.mark.parametrize(
    ("field", "value", "said"),
    [
        (("lidars",), [], "lidars"),
        (("placements",), [], "placements"),
        (("predicted",), [], "predicted"),
        (("placements", 0, "poles"), [], "poles"),
        (("placements", 0, "poles", 0, "seen"), [], "seen"),
        (("placements", 0, "poles", 0, "words"), "", "words"),
        (("placements", 0, "poles", 0, "seen", 0, "lidar"), "nobody", "seen"),
        (("placements", 0, "poles", 1, "name"), "A", "same name"),
        (("placements", 0, "poles", 0, "lean_rad"), 1.0, "lean_rad"),
        (("lidars", 1, "name"), "front", "same name"),
        (("predicted", 0, "lidar"), "front", "predicted"),
        (("predicted", 0, "predicted_error", 0, "sigma_m"), 0.0, "sigma_m"),
        (("predicted", 0, "predicted_error", 0, "sigma_m"), 0.5, "by its covariance"),
        (("predicted", 0, "predicted_error"), [], "predicted_error"),
        (("predicted", 0, "bounds_m"), [], "bounds_m"),
        (("placements", 0, "tape", 0, "start"), "nan", "tape"),
        (("range_m",), 0.0, "range_m"),
        (("moved",), {"poles": ["A"], "errors": []}, "moved.errors"),
    ],
)
def test_what_is_wrong_with_a_plan_is_named(field: tuple[Any, ...], value: Any, said: str) -> None:
    document = json.loads(encode(made_plan(made_picture())))
    place = document
    for key in field[:-1]:
        place = place[key]
    place[field[-1]] = value
    with pytest.raises(ReadError, match=said):
        decode_plan(json.dumps(document).encode())


def hold_many(kind: str, folder: Path, seeds: range) -> None:
    """Damage a document in many ways, and hand each to all that take one of its kind."""
    document = json.loads(WHOLE[kind]().whole)
    held, taken = HOLD[kind], 0
    path = folder / held.name
    for seed in seeds:
        dice = random.Random(seed)
        path.write_bytes(mutated(document, dice))
        try:
            with suppress(ReadError):
                held.hold(path, dice)
                taken += 1
        except Exception as error:
            raise AssertionError(f"seed {seed}: {type(error).__name__}") from error
    # Neither refuses everything nor takes everything.
    assert held.taken < taken / len(seeds) < 0.6
    assert not (folder / REPORT_FILE).exists()
