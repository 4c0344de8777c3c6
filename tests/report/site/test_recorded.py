"""What was read and found: every recording, and what it is worth."""

from __future__ import annotations

import msgspec

from retropole.report.site.recorded import found, run
from tests.report.made_up import HOSTILE, Page
from tests.report.site.made_up import NAMES, document_of, made_up_site

DOCUMENT = document_of(made_up_site("refused", lidars=8, placements=2, count=10))


def test_every_recording_says_what_was_found() -> None:
    text = Page(found(DOCUMENT)).text
    assert "not recorded" in text
    assert "too_few_poles" in text
    assert "0.8 m wide, at most 0.12 m" in text
    assert all(name in text for name in NAMES)


def test_a_refused_site_unfolds_what_has_too_little() -> None:
    assert "<details open>" in found(DOCUMENT)
    answered = document_of(made_up_site("ok", lidars=8, placements=2, count=10))
    assert "<details open>" not in found(answered)


def test_inputs_have_their_hashes_and_options_their_values() -> None:
    page = Page(run(DOCUMENT))
    assert page.text.count(8 * "0f3a9c1e") == len(DOCUMENT.inputs)
    assert "quay.toml" in page.text
    assert "2 cm at 30 m" in page.text
    assert "20 ± 0.5 mm" in page.text


def test_paths_and_notes_stay_text() -> None:
    inputs = [msgspec.structs.replace(DOCUMENT.inputs[0], path=HOSTILE, notes=[HOSTILE])]
    page = Page(run(msgspec.structs.replace(DOCUMENT, inputs=inputs)))
    assert page.open == []
    assert page.text.count(HOSTILE) == 2
