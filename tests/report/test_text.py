"""The result in words."""

import re

import numpy as np
import pytest
from msgspec.structs import replace

from retropole.base import se3
from retropole.base.bounded import Status
from retropole.base.datatypes import Array
from retropole.base.quantities import counted
from retropole.base.reasons import plain, reasons
from retropole.base.sensors import LITTLE
from retropole.base.uncertainty.purpose import Fitness
from retropole.pipeline import calibrate
from retropole.report.listings import clocks, pose_rows
from retropole.report.subject import as_subject, recorded_by
from retropole.report.text import (
    LINES,
    WIDTH,
    describe_detection,
    describe_result,
    reason_lines,
    table,
    transform_lines,
    wrapped,
)
from retropole.result import (
    ErrorAtRange,
    InputDoc,
    PlacementDoc,
    PolesDoc,
    ReasonDoc,
    RunConfig,
    result_document,
)
from retropole.result.contents import detection_document
from retropole.result.site import SiteDoc
from retropole.simulation import simulate_pair
from retropole.surfaces.scans import find_poles
from tests.report.made_up import made_up
from tests.report.pages import of_each_kind, with_each_verdict
from tests.report.site.made_up import document_of, made_up_site

INPUTS = [InputDoc(f"{name}.pcd", "0" * 64, 100, 3, "auto", 120.0) for name in ("a", "b")]


@pytest.mark.parametrize("seed", range(5))
def test_every_notation_of_a_transform_is_the_same(seed: int) -> None:
    T = se3.random(np.random.default_rng(seed))
    *rows, translation, quaternion, angles = transform_lines(T)

    def numbers(line: str) -> Array:
        return np.array([float(n) for n in re.findall(r"-?\d+\.\d+", line)])

    np.testing.assert_allclose([numbers(row) for row in rows], T, atol=1e-8)
    np.testing.assert_allclose(numbers(translation), T[:3, 3], atol=1e-4)
    T_rotation = se3.from_quaternion_xyzw(numbers(quaternion), np.zeros(3))
    np.testing.assert_allclose(T_rotation[:3, :3], T[:3, :3], atol=1e-6)
    roll, pitch, yaw = np.radians(numbers(angles))
    x, y, z = (
        se3.exp_so3(angle * axis) for angle, axis in zip((roll, pitch, yaw), np.eye(3), strict=True)
    )
    np.testing.assert_allclose(z @ y @ x, T[:3, :3], atol=1e-5)


@pytest.mark.full
def test_it_names_what_a_person_looks_for() -> None:
    pair = simulate_pair("street", np.random.default_rng(3))
    answer = calibrate(pair.target, pair.source)
    document = result_document(answer, inputs=INPUTS, config=RunConfig(), seconds={})
    text = describe_result(document, ["r/result.json"], verbose=True)
    words = ("T_target_source", "above the next best", "predicted error", "verdict: ")
    for word in (*words, "r/result.json", "a.pcd"):
        assert word in text
    assert len(
        [line for line in text.splitlines() if re.match(r"  [a-h]( · chosen)?  +T", line)]
    ) == len(answer.hypotheses)


@pytest.mark.parametrize("code", reasons())
def test_what_to_do_stands_below_the_reason(code: str) -> None:
    first, *rest = reason_lines(ReasonDoc(code, "because of 7", {}))
    assert first == f"  {code}: because of 7"
    advice = reasons()[code].advice
    below = " ".join(line.strip() for line in rest)
    assert below.startswith("what to do: ") is bool(advice)
    for action in advice[:2]:
        assert plain(action) in below
    assert not set("`*[") & set(below)
    assert all(len(line) <= WIDTH for line in rest)


def test_an_unknown_code_is_written_with_its_message_alone() -> None:
    assert reason_lines(ReasonDoc("unheard_of", "why", {})) == ["  unheard_of: why"]


WRITTEN = ("out/result.json", "out/report.html")
FOLLOWING = {"next": "retropole export 'my out'", "later": "retropole check out\u202e"}


def words_of(kind: str, status: Status = "ok", *, verbose: bool = False) -> str:
    if kind == "pair":
        return describe_result(made_up(status, 500).result, WRITTEN, FOLLOWING, verbose=verbose)
    document = document_of(made_up_site(status))
    return describe_result(document, WRITTEN, FOLLOWING, verbose=verbose)


@of_each_kind
@with_each_verdict
def test_a_result_begins_with_its_verdict_and_ends_with_what_comes_next(
    kind: str, status: Status
) -> None:
    text = words_of(kind, status)
    assert text.startswith(f"verdict: {status}\n")
    assert ("what to do: " in text) is (status != "ok")
    assert ("1 sigma" in text) is (status != "refused")
    assert "\nwritten: out/result.json, out/report.html" in text
    following = ["next: retropole export 'my out'", "later: retropole check out\\u202e"]
    assert (text.splitlines()[-2:] == following) is (status != "refused")
    assert ("read on: docs/reasons.md#ambiguous" in text) is (status == "refused")


def test_certainty_is_reported_in_two_kinds_with_its_largest_source_and_the_radius() -> None:
    result = made_up(count=500).result
    text = " ".join(describe_result(result, [], verbose=True).split())
    for line in (
        "predicted error, 1 sigma: ± 5.6 mm at 1 m, ± 6.2 mm at 10 m, ± 9.5 mm at 30 m, "
        "± 16 mm at 60 m",
        "at 30 m: random ± 4.3 mm, systematic ± 8.5 mm",
        "main error source at 30 m: range offset of the source LiDAR (58 %)",
        "radius of the poles: 20.00 mm given, 20.31 ± 0.42 mm estimated",
        "scene check: 412 patches agree, 3 contradict (0.7 % against it)",
    ):
        assert line in text
    older = replace(result, uncertainty=None, budget=None, radius=None, confirmation=None)
    text = describe_result(older, [], verbose=True)
    assert "predicted error" in text
    for word in ("systematic", "main error", "radius", "scene check"):
        assert word not in text


def test_the_transform_names_the_recordings() -> None:
    result = made_up("ok", 500).result
    first = "T_target_source maps points of the source (rear.pcd) into the frame of the target"
    assert f"{first} (front.pcd)" in " ".join(describe_result(result, []).split())
    alike = [replace(each, path=f"{k}/{'x' * 30}.pcd") for k, each in enumerate(result.inputs)]
    text = describe_result(replace(result, inputs=alike), [])
    assert f"points of the source (1/{'x' * 30}.pcd)" in text
    assert max(map(len, text.splitlines())) <= WIDTH
    several = replace(result, inputs=2 * result.inputs)
    assert recorded_by(several) == ("the target (front.pcd, …)", "the source (rear.pcd, …)")
    assert recorded_by(replace(result, inputs=[])) == ("the target", "the source")


def test_what_was_left_out_to_bound_the_time_is_for_those_who_ask() -> None:
    counts: dict[str, float | int | str] = {
        "pairs": 229,
        "pairs_laid": 200,
        "ways": 310,
        "ways_tried": 16,
    }
    reason = ReasonDoc("no_match", "no pose fits", counts)
    result = replace(made_up("refused", 500).result, reasons=[reason])
    assert "to bound the time" not in describe_result(result, []).lower()
    whole = " ".join(describe_result(result, [], verbose=True).split())
    words = "To bound the time, the 200 most similar of 229 pairs of possible poles were matched,"
    assert f"{words} the best 16 of 310 ways of pairing possible poles were tried" in whole
    assert "registered" not in whole


@pytest.mark.parametrize(
    ("hashes", "offsets", "said", "unsaid"),
    [
        # One recorder: the clocks of both LiDARs are compared.
        ("aa", (-0.05, 36.95), "the clock of the source is 37.0 s ahead of that of the target", ()),
        ("aa", (37.0, 36.9), "the clock of the target is 37.0 s ahead of the rec", ("that",)),
        # Two: nobody knows how far their clocks are apart.
        ("ab", (-0.05, 36.95), "the clock of the source is 37.0 s ahead of the rec", ("that",)),
        ("aa", (-1.7e9, 0.0), "the clock of the target is not set", ("ahead", "the source is")),
        ("aa", (-0.1, 0.2), "", ("the clock of",)),
        ("ab", (None, None), "", ("the clock of",)),
    ],
)  # fmt: skip
def test_clocks_that_differ_are_named_as_far_as_recordings_have_them(
    hashes: str, offsets: tuple[float | None, float | None], said: str, unsaid: tuple[str, ...]
) -> None:
    result = made_up().result
    inputs = [
        replace(each, sha256=64 * own, clock_offset_s=offset)
        for each, own, offset in zip(result.inputs, hashes, offsets, strict=True)
    ]
    lines = list(clocks(as_subject(replace(result, inputs=inputs))))
    whole = " ".join(describe_result(replace(result, inputs=inputs), ["r"], verbose=True).split())
    assert said in whole
    assert all(each in whole for each in lines)
    assert not any(word in line for word in unsaid for line in lines)
    assert all("no time was changed" in line for line in lines)


def test_what_was_requested_is_answered() -> None:
    words = "within 2 cm at 30 m: yes, 98 % sure"
    asked = Fitness(0.02, 30.0, "yes", 0.98, 0.018, words)
    text = describe_result(replace(made_up("ok", 500).result, fitness=asked), ["r"])
    assert text.startswith(f"verdict: ok\n  {words}\n")


def test_no_error_is_written_as_nothing() -> None:
    small = [ErrorAtRange(r, 1e-6 * r) for r in (1.0, 10.0)]
    text = describe_result(replace(made_up(count=500).result, predicted_error=small), [])
    assert "± 0.0010 mm at 1 m, ± 0.010 mm at 10 m" in text


def test_placements_are_written_with_the_change_of_the_pose() -> None:
    listed = [PlacementDoc(2, 3, 0.001, 0.004), PlacementDoc(2, 2, None, None)]
    text = describe_result(replace(made_up(count=500).result, placements=listed), [])
    assert re.search(r"^ +1: front.pcd ← rear.pcd +2 \+ 3 +0\.057 +4\.0 +source$", text, re.M)
    assert re.search(r"^ +2 +2 \+ 2 +– +– +source$", text, re.M)


def test_where_nothing_stands_out_few_clusters_are_listed() -> None:
    pair = simulate_pair("street", np.random.default_rng(1))
    found = find_poles(pair.target, sensor=None, threshold=None, radius=0.02).detection
    assert found is not None
    document = detection_document(found, INPUTS[0])
    cluster = document.rejected[0]
    bare = replace(document, poles=[], rejected=48 * [cluster], threshold_source=f"auto; {LITTLE}")
    text = describe_detection(bare, [])
    assert "nothing is distinctly brighter than the rest" in text
    assert "48 rejected clusters, the largest 3 of them listed here" in text
    assert text.count(cluster.reason[:30]) == 3
    whole = describe_detection(replace(bare, threshold_source="VLP-16"), [])
    assert "brighter" not in whole
    assert whole.count(cluster.reason[:30]) == 48


def test_detections_say_why_a_cluster_is_rejected() -> None:
    pair = simulate_pair("street", np.random.default_rng(1))
    found = find_poles(pair.target, sensor=None, threshold=None, radius=0.02).detection
    assert found is not None
    assert found.rejected
    text = describe_detection(detection_document(found, INPUTS[0]), [])
    assert counted(len(found.poles), "pole") in text
    assert all(len(line) <= WIDTH for line in text.splitlines())
    for cluster in found.rejected:
        assert cluster.code in text


WORDS = "a reason of as many words as the longest that there is, with numbers such as 28.2 % " * 4


@pytest.mark.parametrize("status", ["ok", "warn", "refused"])
@pytest.mark.parametrize("many", [0, 1, 2, 5, 40])
def test_a_result_is_a_screen_at_most_and_names_every_verdict(status: Status, many: int) -> None:
    result = made_up(status, 500).result
    first = result.poles.target[0]
    codes = list(reasons())[:many] if status != "ok" else []
    asked = Fitness(0.02, 30.0, "yes", 0.98, 0.018, "within 2 cm at 30 m: yes, 98 % sure")
    for poles, placements in ((many, 0), (2, many), (0, 0)):
        each = replace(
            result,
            reasons=[ReasonDoc(code, WORDS, {}) for code in codes] or result.reasons,
            poles=PolesDoc([first] * poles, [first] * poles),
            placements=[PlacementDoc(2, 3, 0.001, 0.004)] * placements,
            fitness=asked if status == "ok" else None,
        )
        following = {"next": "retropole export " + "r" * 200}
        text = describe_result(each, ["r" * 200], following)
        lines = text.splitlines()
        assert len(lines) <= LINES
        copied = ("written: ", "next: ")
        assert all(len(line) <= WIDTH for line in lines if not line.startswith(copied))
        assert lines[0] == f"verdict: {status}"
        assert all(code in text for code in [reason.code for reason in each.reasons][:3])
        assert (status == "ok") or "what to do" in text
        assert ("T_target_source" in text) is (each.T_target_source is not None)
        # What has no room is counted, and never dropped without a word.
        listed = (poles, 0) if placements < 2 else (0, placements)
        seen = (text.count("\n  T"), text.count("  4.0"))
        assert "more; -v lists them" in text or seen == listed
        whole = describe_result(each, [], verbose=True)
        assert placements > 1 or whole.count("\n  T") == poles
        assert all(reason.code in whole for reason in each.reasons)


@with_each_verdict
@pytest.mark.parametrize(("lidars", "placements"), [(2, 1), (3, 2), (8, 4)])
def test_a_site_is_a_screen_at_most(status: Status, lidars: int, placements: int) -> None:
    document = document_of(made_up_site(status, lidars=lidars, placements=placements))
    words = describe_result(document, WRITTEN, FOLLOWING)
    assert fits(words)
    for lidar in document.lidars:
        assert lidar.name in words
    for reason in document.reasons:
        assert f"  {reason.code}: " in words


def fits(words: str) -> bool:
    lines = words.split("\n")
    return len(lines) <= LINES and max(map(len, lines)) <= WIDTH


def many(document: SiteDoc, count: int) -> SiteDoc:
    """Give a document many LiDARs of long names, and many reasons."""
    first = document.lidars[1]
    lidars = [replace(first, name=f"lidar-{k}" + 50 * "x") for k in range(count)]
    reasons = [ReasonDoc("few_points", f"pole {k} " + 40 * "has few points ", {}) for k in range(9)]
    found = count * document.found[:1]
    return replace(document, lidars=lidars, reasons=reasons, found=found)


@pytest.mark.parametrize("status", ["warn", "refused"])
def test_many_lidars_and_reasons_fit_too(status: Status) -> None:
    words = describe_result(many(document_of(made_up_site(status)), 60), WRITTEN)
    assert fits(words)
    assert "more; -v lists them" in words
    assert "what to do about each: -v, or site-report.html" in words


def test_large_coordinates_are_the_frames_own() -> None:
    document = document_of(made_up_site(surveyed=True))
    frame = replace(document.frame, offset=np.array([500_000.0, 5_700_000.0, 0.0]))
    document = replace(document, frame=frame)
    row = pose_rows(document)[0]
    assert (row.x, row.y, row.z) == ("500000.000", "5700000.000", "0.000")
    words = describe_result(document, WRITTEN)
    assert "5700000.000" in words
    assert fits(words)


def test_verbose_lists_every_check_and_recording() -> None:
    document = document_of(made_up_site("warn"))
    words = describe_result(document, WRITTEN, verbose=True)
    for test in document.tests:
        assert test.name in words
    assert words.count("/data/quay/") == len(document.inputs)
    for said in ("mast-a – mast-b", "2: noon", "loop "):
        assert said in words


def test_names_steer_no_terminal() -> None:
    document = document_of(made_up_site())
    lidar = replace(document.lidars[0], name="\x1b[31mred")
    document = replace(document, lidars=[lidar, *document.lidars[1:]])
    assert "\x1b" not in describe_result(document, WRITTEN)


def test_tables_line_up() -> None:
    lines = table(("name", "x"), [["a", "1.0"], ["longer", "-22.5"]]).splitlines()
    assert len({len(line) for line in lines}) == 1


def test_a_value_stays_with_its_unit() -> None:
    for width in range(60, 80):
        for line in wrapped("x" * width + " ± 40 mm at 60 m, 3 σ, 28.2 % of 12 s", "  "):
            assert not re.match(r" *(mm|m|σ|%|s|40)\b", line)
            assert not line.endswith("±")
