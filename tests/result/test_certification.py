"""The document of a field test holds what the test has."""

import json

from retropole.checking.certification import ALPHA, DistanceTest, FieldTest, PolesSeen
from retropole.result import encode
from retropole.result.certification import field_test_document


def test_the_document_holds_every_distance() -> None:
    lengths = (2.5, 2.46, 0.005, 0.006, 0.003, 0.004)
    distance = DistanceTest(1, (0, 2), *lengths, 0.04, 0.0039, 0.0205, passed=False)
    test = FieldTest("fail", (), (distance,), ALPHA, 2.63, None, (PolesSeen(4, 4, 4),))
    document = field_test_document(
        {("target", "source"): test}, lidars=("target", "source"), radius=0.02, inputs=[]
    )
    data = json.loads(encode(document))
    assert data["schema"] == "retropole/field-test/1"
    assert data["status"] == "fail"
    (pair,) = data["pairs"]
    assert pair["variances"] is None
    assert pair["poles"] == [{"target": 4, "source": 4, "compared": 4}]
    (found,) = pair["distances"]
    assert found["poles"] == [0, 2]
    assert found["difference_m"] == 0.04
    assert not found["passed"]


def test_a_pass_is_of_every_lidar() -> None:
    """Where one is in no pair that could be tested, what passes is a part, and it is named."""
    good = FieldTest("pass", (), (), ALPHA, None, None, ())
    none = FieldTest("refused", (), (), ALPHA, None, None, ())
    bad = FieldTest("fail", (), (), ALPHA, None, None, ())
    three = ("a", "b", "c")

    def said(*tests: FieldTest) -> tuple[str, list[str]]:
        names = [("a", "b"), ("a", "c"), ("b", "c")]
        found = field_test_document(
            dict(zip(names, tests, strict=False)), lidars=three, radius=0.02, inputs=[]
        )
        return found.status, found.untested

    assert said(good, none, none) == ("partial", ["c"])
    assert said(good, good, none) == ("pass", [])
    assert said(good) == ("partial", ["c"])
    assert said(none, none, none) == ("refused", ["a", "b", "c"])
    assert said(bad, none, none)[0] == "fail"
