"""What was not tried is said, in numbers, and nothing where all was tried."""

from retropole.base.errors import Refusal
from retropole.hypotheses.placements import NOTHING, Share, Tried, with_what_was_tried

REFUSAL = Refusal("no_overlap", "nothing lies on anything", {"overlap": 0.1})


def test_where_all_was_tried_nothing_is_said() -> None:
    whole = Tried(Share(200, 200), Share(9, 9), Share(4, 4))
    for tried in ([], [NOTHING], [NOTHING, whole]):
        assert with_what_was_tried(REFUSAL, tried) is REFUSAL


def test_every_cut_is_said_and_no_whole() -> None:
    said = with_what_was_tried(REFUSAL, [Tried(Share(200, 229), Share(16, 310), Share(3, 3))])
    assert (said.code, said.message) == (REFUSAL.code, REFUSAL.message)
    counts = {"pairs": 229, "pairs_laid": 200, "ways": 310, "ways_tried": 16}
    assert said.values == {**REFUSAL.values, **counts}


def test_of_several_attempts_the_one_with_most_ways_is_told() -> None:
    few, many = (Tried(ways=Share(16, count)) for count in (20, 400))
    for tried in ([few, many], [many, few]):
        assert with_what_was_tried(REFUSAL, tried).values["ways"] == 400
