"""Documents that were edited by hand, cut short or made up: an error, or an answer that is one."""

from __future__ import annotations

import json
import random
from copy import deepcopy
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from retropole.api.plan_checking import against, planned_error
from retropole.base.errors import ReadError, Refusal
from retropole.base.uncertainty.purpose import Need
from retropole.cli import run
from retropole.export import FORMATS, read_transform
from retropole.report import render_report
from retropole.report.pole_plan import PlanPicture, render_pole_plan
from retropole.report.pole_plan_text import describe_plan
from retropole.result import encode
from retropole.result.decoding import decode, decode_plan
from retropole.result.folder import REPORT_FILE
from retropole.result.pole_plan import MovedDoc, MovedErrorDoc
from tests.report.made_up import Run, made_up
from tests.report.plans import made_picture, made_plan

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


@pytest.fixture(scope="module")
def whole() -> Run:
    """A run and its result."""
    return made_up("ok", 400)


def hold_result(data: bytes, whole: Run, folder: Path, dice: random.Random) -> bool:
    """Hand a document to all that take it; whether it was taken for a result."""
    path = folder / "result.json"
    path.write_bytes(data)
    out = folder / "out.txt"
    code = run(["export", str(path), "--to", dice.choice(list(FORMATS)), "--out", str(out)])
    assert code in (0, 2, 3)
    try:
        document = decode(data)
    except ReadError:
        return False
    page = render_report(document, whole.placements)
    assert "nan" not in page.split("<script")[0].lower().split(">")
    try:
        transform = read_transform(path)
    except (Refusal, ReadError):
        return True
    assert np.isfinite(transform.T_parent_child).all()
    if transform.covariance is not None:
        assert np.linalg.eigvalsh(transform.covariance)[0] > -1e-5 * transform.covariance.max()
    return True


def test_an_edited_result_is_an_error_or_a_result(whole: Run, tmp_path: Path) -> None:
    hold_many(whole, tmp_path, range(150))


@pytest.mark.full
@pytest.mark.parametrize("part", range(20))
def test_many_edited_results(part: int, whole: Run, tmp_path: Path) -> None:
    hold_many(whole, tmp_path, range(1000 * (part + 1), 1000 * (part + 2)))


def hold_plan(data: bytes, whole: Run, picture: PlanPicture, *, is_shown: bool) -> bool:
    """Hand a plan to all that take one; whether it was taken for one."""
    try:
        plan = decode_plan(data)
    except ReadError:
        return False
    poles = whole.result.poles.target
    for lidar in (None, *(each.name for each in plan.lidars)):
        for some in (poles, poles[:1], []):
            assert len(against(plan, some, lidar)) > 0
    assert planned_error(plan) > 0
    assert "nan" not in describe_plan(plan).split()
    as_drawn = [len(each.poles) for each in plan.placements] == list(map(len, picture.chosen))
    if is_shown and as_drawn:
        assert render_pole_plan(plan, picture) if plan.predicted else plan.moved
    return True


@pytest.mark.parametrize("is_moved", [False, True])
def test_an_edited_plan_is_an_error_or_a_plan(is_moved: bool, whole: Run) -> None:
    picture = made_picture(2)
    plan = made_plan(picture, need=Need(0.02, 20.0))
    if is_moved:
        moved = MovedDoc(
            poles=["A"], errors=[MovedErrorDoc(lidar="rear", sigma_m=0.01, alone_m=0.02)]
        )
        plan = msgspec.structs.replace(
            plan, predicted=[], more=[], rehearsal=None, probability=None, moved=moved
        )
    document, taken = json.loads(encode(plan)), 0
    assert hold_plan(encode(plan), whole, picture, is_shown=True)
    for seed in range(250):
        data = mutated(document, random.Random(seed))
        try:
            taken += hold_plan(data, whole, picture, is_shown=seed % 10 == 0)
        except Exception as error:
            raise AssertionError(f"seed {seed}: {type(error).__name__}") from error
    assert 0.05 < taken / 250 < 0.6


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


def hold_many(whole: Run, folder: Path, seeds: range) -> None:
    document = json.loads(encode(whole.result))
    taken = 0
    for seed in seeds:
        dice = random.Random(seed)
        data = mutated(document, dice)
        try:
            taken += hold_result(data, whole, folder, dice)
        except Exception as error:
            raise AssertionError(f"seed {seed}: {type(error).__name__}") from error
    # Neither refuses everything nor takes everything.
    assert 0.05 < taken / len(seeds) < 0.6
    assert not (folder / REPORT_FILE).exists()
