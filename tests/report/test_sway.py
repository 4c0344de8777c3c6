import math

import msgspec
import numpy as np

from retropole.base.sway import Sway, stated_sway
from retropole.report import render_report
from retropole.report.text import describe_result
from retropole.result import SwayDoc
from tests.report.made_up import Page, made_up


def test_what_swayed_is_drawn_and_told() -> None:
    run = made_up()
    times = np.arange(20) / 10
    angles = 0.001 * np.sin(2 * np.pi * 0.5 * times)
    seen = Sway(
        0.0007, 0.5, 2.0, np.diag([1e-8] * 6), tuple(times.tolist()), tuple(angles.tolist())
    )
    found = [SwayDoc(0, 0, seen), SwayDoc(1, 0, stated_sway(math.radians(0.05)))]
    document = msgspec.structs.replace(run.result, sways=found)
    page = render_report(document, run.placements)
    assert 'id="sway"' in page
    assert "The target: ± 0.04° at 0.5 Hz" in page
    assert "The source: ± 0.05° as stated" in page
    assert page.count('aria-labelledby="sway-') == 1
    # The terminal has one line: of the one whose rest is known the least.
    text = " ".join(describe_result(document, ()).split())
    assert "swayed while recorded: the source ± 0.05° as stated" in text
    assert "swayed" not in describe_result(run.result, ())
    assert 'id="sway"' not in render_report(run.result, run.placements)
    Page(page)
