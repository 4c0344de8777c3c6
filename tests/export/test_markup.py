"""XML that others wrote: what is no plain XML is refused, and none of it is followed."""

from collections.abc import Callable
from pathlib import Path

import pytest

from retropole.base.errors import ReadError
from retropole.export.markup import edited_xml, is_xml, read_xml, xml_to_edit

parsers = pytest.mark.parametrize("parse", [read_xml, xml_to_edit])

LAUGHS = "".join(f'<!ENTITY l{k + 1} "{f"&l{k};" * 10}">' for k in range(12))
"""Each entity ten times the one before."""


@parsers
@pytest.mark.parametrize("codec", ["utf-8", "utf-8-sig", "utf-16", "iso-8859-1"])
@pytest.mark.parametrize(
    ("doctype", "body"),
    [
        ("<!DOCTYPE r>", "<r/>"),
        (f'<!DOCTYPE r [<!ENTITY l0 "ha">{LAUGHS}]>', "<r>&l12;</r>"),
        (f'<!DOCTYPE r [<!ENTITY l0 "ha">{LAUGHS}]>', '<r a="&l12;"/>'),
        ('<!DOCTYPE r [<!ENTITY x SYSTEM "FILE">]>', "<r>&x;</r>"),
        ('<!DOCTYPE r [<!ENTITY % x SYSTEM "FILE">%x;]>', "<r/>"),
        ('<!DOCTYPE r SYSTEM "FILE">', "<r/>"),
        ('<!DOCTYPE r [<!ATTLIST r a CDATA "given">]>', "<r/>"),
    ],
)
def test_a_doctype_is_refused_whatever_it_holds(
    parse: Callable[[bytes], object], codec: str, doctype: str, body: str, tmp_path: Path
) -> None:
    secret = tmp_path / "secret"
    secret.write_text("secret")
    declared = "utf-8" if codec == "utf-8-sig" else codec
    text = f'<?xml version="1.0" encoding="{declared}"?>\n<!-- c -->{doctype}{body}'
    with pytest.raises(ReadError, match="DOCTYPE"):
        parse(text.replace("FILE", secret.as_uri()).encode(codec))


@parsers
@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (b"", "no well-formed XML"),
        (b"<r", "no well-formed XML"),
        (b"<r/><r/>", "no well-formed XML"),
        (b"<r>&undeclared;</r>", "undefined entity"),
        (b"<r><undeclared:e/></r>", "unbound prefix"),
        (b"<r>\xff</r>", "no well-formed XML"),
        (b'<?xml version="1.0" encoding="none"?><r/>', "cannot decode the XML"),
        (b'<?xml version="1.0" encoding="gb2312"?><r/>', "cannot decode the XML"),
    ],
)
def test_what_is_no_xml_is_refused(
    parse: Callable[[bytes], object], data: bytes, reason: str
) -> None:
    with pytest.raises(ReadError, match=reason):
        parse(data)


@pytest.mark.parametrize(
    "data",
    [
        b"<r/>\n",
        b"\xef\xbb\xbf<r/>\n",
        b"<?xml version='1.0' standalone='yes' ?>\r\n\r\n<!-- a --><r>\r\n</r>\r\n",
        b"<?p a?>\n<!-- <?p b?> -->\n<r>&lt;&#13;<!-- c --><?p d?></r>\n<!-- <r/> -->\n<?p?>\n",
        "<r a='é'/>\n".replace("'", '"').encode("utf-16"),
        '<?xml version="1.0" encoding="windows-1252"?>\n<r a="€"/>\n'.encode("cp1252"),
        b'<?xml version="1.0" encoding="us-ascii"?>\n<r a="&#8364;&#10;"/>\n',
    ],
)
def test_what_is_not_edited_is_written_as_it_was(data: bytes) -> None:
    assert is_xml(data)
    assert edited_xml(xml_to_edit(data), data) == data


def test_much_behind_the_root_takes_no_longer_than_its_size() -> None:
    data = b"<r/>\n" + b"<!---->\n" * 20_000
    assert edited_xml(xml_to_edit(data), data) == data
