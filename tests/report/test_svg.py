"""Labels of a picture: none covers another where there is room."""

from __future__ import annotations

import re

from retropole.report.svg import LONGEST_LABEL, Labels, short
from tests.report.made_up import HOSTILE


def test_long_names_are_shortened() -> None:
    assert short("gate") == "gate"
    assert len(short("x" * 100)) == LONGEST_LABEL


def test_labels_of_marks_that_lie_together_stand_apart() -> None:
    labels = Labels(300, 300)
    written = [labels.place("crane", 150 + k, 150 + k, 11) for k in range(4)]
    assert len({re.sub(r'text-anchor="\w+"', "", each) for each in written}) == 4
    boxes = labels.taken
    for i, (ax, ay, bx, by) in enumerate(boxes):
        for cx, cy, dx, dy in boxes[:i]:
            assert bx <= cx or dx <= ax or by <= cy or dy <= ay


def test_a_label_at_the_edge_stays_in_the_picture() -> None:
    labels = Labels(300, 300)
    labels.place("mast-a", 298, 150, 11)
    left, _, right, _ = labels.taken[0]
    assert left >= 0
    assert right <= 300


def test_a_label_is_escaped() -> None:
    assert "<script" not in Labels(300, 300).place(HOSTILE, 10, 10, 5)
