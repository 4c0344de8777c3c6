"""A page runs and shows what it was made of, and nothing else."""

from __future__ import annotations

import base64
import hashlib
import re

from retropole.report.page import fill_page


def test_the_policy_names_every_script_and_the_style_by_its_hash() -> None:
    names = ("title", "status", "created", "verdict", "links", "map", "viewer", "parts", "data")
    html = fill_page(
        "site.html",
        ("style.css", "site.css"),
        ("page.js", "site.js"),
        dict.fromkeys(names, ""),
        "x",
    )
    (policy,) = re.findall(r'Security-Policy" content="([^"]*)"', html)
    texts = re.findall(r"<(?:script|style)>(.*?)</(?:script|style)>", html, re.DOTALL)
    assert len(texts) == 3
    assert texts[0].endswith("x")
    for text in texts:
        digest = hashlib.sha256(text.encode()).digest()
        assert f"'sha256-{base64.b64encode(digest).decode()}'" in policy
