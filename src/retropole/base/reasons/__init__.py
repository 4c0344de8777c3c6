"""Every reason code: what it means, and what to do about it.

One table for each place where codes are met. The report, the command line and the page *Every
reason code* of the documentation take their words from here, and `Code` is the type of all codes,
so that mypy finds a code that is in no table. To add one, add it to the type and the table of its
file.
"""

from __future__ import annotations

from typing import NamedTuple, cast

from .check import CHECK, PREFIXED, CheckCode, Prefix
from .cluster import CLUSTER, ClusterCode
from .explanation import Explanation, plain, unlinked
from .field_test import FIELD_TEST, FieldTestCode
from .other_methods import OTHER_METHODS, OtherMethodCode
from .refused import REFUSED, RefusedCode
from .site import SITE, SiteCode
from .warning import WARNINGS, WarningCode

__all__ = [
    "GROUPS",
    "PREFIXED",
    "REASONS",
    "ClusterCode",
    "Code",
    "Explanation",
    "Group",
    "Prefix",
    "explain",
    "page",
    "plain",
    "prefixed",
    "unlinked",
]

Code = (
    RefusedCode | WarningCode | CheckCode | SiteCode | FieldTestCode | OtherMethodCode | ClusterCode
)


class Group(NamedTuple):
    """The codes of one place where they are met, with the words that introduce them."""

    title: str
    introduction: str
    reasons: tuple[tuple[Code, Explanation], ...]


GROUPS: tuple[Group, ...] = (
    Group("Calibration refused", "Exit code 3, and no transform.", tuple(REFUSED.items())),
    Group(
        "Calibrated, with a warning", "There is a transform; look twice.", tuple(WARNINGS.items())
    ),
    Group(
        "Check",
        "Reasons of [`retropole check`](check.md): why it cannot tell, or what to know of its "
        "answer.",
        tuple(CHECK.items()),
    ),
    Group(
        "Site",
        "Reasons of [`retropole site calibrate`](site.md), beside those of a pair: the first eight "
        "and `site_inconsistent` refuse, the others warn.",
        tuple(SITE.items()),
    ),
    Group(
        "Field test",
        "Why [`retropole certify`](certify.md) cannot tell; also `too_few_poles`, `no_match` and "
        "others of the first table.",
        tuple(FIELD_TEST.items()),
    ),
    Group(
        "Other methods",
        "Codes of the other methods in [`retropole compare`](compare.md). They say nothing of "
        "retropole's own answer.",
        tuple(OTHER_METHODS.items()),
    ),
    Group(
        "Why a cluster is no pole",
        "`retropole detect` and the report give each retro-reflective cluster that was rejected "
        "one of these, or `too_few_points`. Most are right: signs and vests ought to be rejected. "
        "They matter where your pole is among them.",
        tuple(CLUSTER.items()),
    ),
)

REASONS: dict[str, Explanation] = {code: text for group in GROUPS for code, text in group.reasons}


def page(code: str) -> str | None:
    """Name the page of the documentation that explains a code; None where it is not known."""
    if code in REASONS:
        return f"reasons.html#{code.replace('_', '-')}"
    prefix = next((p for p in PREFIXED if code.startswith(f"{p}_")), None)
    return None if prefix is None else f"reasons.html#{prefix}"


def prefixed(prefix: Prefix, code: str) -> Code:
    """Put a prefix in front of a code: ``prefixed("stored", "few_points")``."""
    return cast("Code", f"{prefix}_{code}")


def explain(code: str) -> Explanation | None:
    """Look a code up, with or without a prefix; None where it is not known."""
    if code in REASONS:
        return REASONS[code]
    return next((text for p, text in PREFIXED.items() if code.startswith(f"{p}_")), None)
