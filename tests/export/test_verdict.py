"""The verdict of a calibration goes along with its pose, whatever the pose is written in."""

from __future__ import annotations

import io
import json
from pathlib import Path

import numpy as np
import pytest
from msgspec.structs import replace

from retropole.base.uncertainty.confirmation import UNUSABLE
from retropole.export import FORMATS, TREE_FORMATS, Transform, inverted, read_transform, read_tree
from retropole.export.recording import write_transforms
from retropole.result import ReasonDoc, encode, verdict_line
from tests.report.made_up import made_up
from tests.report.site.made_up import document_of, made_up_site

DOUBT = ReasonDoc("not_confirmed", "why", {"probability_wrong": 0.411})
LINE = (
    "verdict of the calibration: warn, not_confirmed; chance of a wrong pose 41.1 %; "
    "do not use it yet"
)


def written(folder: Path) -> Transform:
    result = replace(made_up("warn", 500).result, reasons=[DOUBT])
    (folder / "result.json").write_bytes(encode(result))
    return read_transform(folder)


def test_a_verdict_is_one_line() -> None:
    assert verdict_line("ok", []) == "verdict of the calibration: ok"
    assert verdict_line("warn", [DOUBT, DOUBT]) == LINE
    for wrong in (UNUSABLE, UNUSABLE + 0.01):
        said = verdict_line("warn", [replace(DOUBT, values={"probability_wrong": wrong})])
        assert ("do not use it" in said) is (wrong > UNUSABLE)


@pytest.mark.parametrize("fmt", FORMATS)
def test_every_format_says_it_and_is_read_as_before(fmt: str, tmp_path: Path) -> None:
    transform = written(tmp_path)
    for each in (transform, inverted(transform)):
        text = FORMATS[fmt].write(each)
        assert text.count(LINE) == 1
        bare = FORMATS[fmt].write(replace_verdict(each))
        for found, same in zip(
            FORMATS[fmt].read(text.encode()), FORMATS[fmt].read(bare.encode()), strict=True
        ):
            np.testing.assert_array_equal(found.pose(), same.pose())
            assert (found.parent, found.child) == (same.parent, same.child)


def replace_verdict(transform: Transform) -> Transform:
    return Transform(
        transform.T_parent_child,
        transform.parent,
        transform.child,
        transform.covariance,
        transform.roles,
    )


def test_json_keeps_it_and_takes_no_other_text_for_one(tmp_path: Path) -> None:
    document = json.loads(FORMATS["json"].write(written(tmp_path)))
    for verdict, kept in ((LINE, LINE), ("-->\n<joint/>", ""), (f"{LINE}\nx", "")):
        (found,) = FORMATS["json"].read(json.dumps(document | {"verdict": verdict}).encode())
        assert found.verdict == kept


def test_all_frames_of_a_site_say_it(tmp_path: Path) -> None:
    pytest.importorskip("mcap")
    from mcap.reader import make_reader

    site = replace(document_of(made_up_site("warn")), reasons=[DOUBT])
    (tmp_path / "site-result.json").write_bytes(encode(site))
    tree = read_tree(tmp_path)
    assert tree is not None
    for name in TREE_FORMATS.keys() - {"geojson"}:
        assert LINE in TREE_FORMATS[name].write(tree)
    reader = make_reader(io.BytesIO(write_transforms(tree.edges, tree.verdict)))
    assert [each.metadata for each in reader.iter_metadata()] == [{"verdict": LINE}]
