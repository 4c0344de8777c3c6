"""XML that others wrote: read by the standard library, edited by lxml, never with a DOCTYPE."""

from __future__ import annotations

import codecs
import re
from typing import Any
from xml.etree.ElementTree import XML, Element, ParseError, TreeBuilder, XMLParser

from ..base.errors import MissingExtraError, ReadError, said


def is_xml(data: bytes) -> bool:
    """Tell XML, in any encoding, by how it begins."""
    return data.lstrip().startswith((b"<", b"\xef\xbb\xbf<", b"\xff\xfe", b"\xfe\xff"))


class _WithoutDoctype(TreeBuilder):
    def doctype(self, *_: object) -> None:
        raise ReadError("the XML has a DOCTYPE; such files are not read")


def read_xml(data: bytes) -> Element:
    """Parse an XML file; gives its root element.

    Raises
    ------
    ReadError
        For what is not well-formed, and for a DOCTYPE: entities can blow a small file up, and none
        of the files read here need one.
    """
    try:
        return XML(data, XMLParser(target=_WithoutDoctype()))
    except ParseError as error:
        raise ReadError(f"no well-formed XML: {said(error)}") from None
    except (LookupError, ValueError) as error:
        raise ReadError(f"cannot decode the XML: {said(error)}") from None


def xml_to_edit(data: bytes) -> Any:
    """Parse an XML file with its comments and processing instructions; needs the extra ``urdf``.

    Returns
    -------
    lxml.etree._Element
        The root element; `edited_xml` writes it again.

    Raises
    ------
    MissingExtraError
        Where lxml is not installed.
    ReadError
        As `read_xml`, and for elements nested deeper than 256.
    """
    try:
        from lxml import etree
    except ImportError:
        raise MissingExtraError("urdf", "putting a joint into a URDF") from None
    read_xml(data)
    parser = etree.XMLParser(
        resolve_entities=False,
        no_network=True,
        load_dtd=False,
        huge_tree=False,
        strip_cdata=False,
    )
    try:
        return etree.fromstring(data, parser)
    except etree.XMLSyntaxError as error:
        raise ReadError(f"cannot edit the XML: {said(error)}") from None


def edited_xml(root: Any, data: bytes) -> bytes:
    """Write the root element of `xml_to_edit` into the file that it was parsed from.

    Parameters
    ----------
    root
        The lxml element.
    data
        That file. What stands before the root element is taken from there as it is.

    Returns
    -------
    bytes
        In the encoding and with the line endings of `data`; what the encoding lacks is written as
        character references.
    """
    from lxml import etree

    is_utf_16 = data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    codec: str = "utf-16" if is_utf_16 else root.getroottree().docinfo.encoding
    before = data.decode(codec)
    text: str = re.findall(r"\A\ufeff?(?:\s+|<\?.*?\?>|<!--.*?-->)*", before, re.DOTALL)[0]
    text += etree.tostring(root, encoding="unicode", with_tail=False) + "\n"
    # Comments and the like. By `tostring`, the time would grow with the square of their number.
    text += "".join(f"{node}\n" for node in root.itersiblings())
    if "\r\n" in before:
        text = text.replace("\r\n", "\n").replace("\n", "\r\n")
    return text.encode(codec, "xmlcharrefreplace")
