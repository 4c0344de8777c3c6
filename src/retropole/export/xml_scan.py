"""Where the elements of an XML file stand, byte by byte, so that one can be changed alone."""

from __future__ import annotations

import codecs
import re
from bisect import bisect_right
from dataclasses import dataclass, field
from xml.parsers import expat

from ..base.errors import ReadError, said

_ATTRIBUTE = re.compile(r"""([^\s=/<>"']+)\s*=\s*("[^"]*"|'[^']*')""")


@dataclass
class Element:
    """An element, and the bytes it takes.

    Attributes
    ----------
    tag, attributes
        As in the file, attributes with entities resolved.
    children
        Elements directly inside.
    start, end
        Bytes of the whole element, ``data[start:end]``.
    head_end
        End of its start tag; equals `end` for ``<tag/>``.
    foot
        Start of its end tag; equals `end` for ``<tag/>``.
    """

    tag: str
    attributes: dict[str, str]
    start: int
    children: list[Element] = field(default_factory=list)
    end: int = 0
    head_end: int = 0
    foot: int = 0

    def named(self, tag: str) -> list[Element]:
        """Children with a tag."""
        return [child for child in self.children if child.tag == tag]

    def walk(self) -> list[Element]:
        """Itself and all elements below it, in the order of the file."""
        found, left = [], [self]
        while left:
            found.append(left.pop())
            left.extend(reversed(found[-1].children))
        return found


@dataclass(frozen=True)
class Scan:
    """A parsed file: its bytes, the codec of its text, and its root element."""

    data: bytes
    codec: str
    root: Element

    def text(self, start: int, end: int) -> str:
        """Decode some bytes of the file."""
        return self.data[start:end].decode(self.codec)

    def encode(self, text: str) -> bytes:
        """Encode text as the file is, what its encoding lacks as character references."""
        return text.encode(self.codec, "xmlcharrefreplace")


def is_xml(data: bytes) -> bool:
    """Tell XML, in any encoding, by how it begins."""
    return data.lstrip().startswith((b"<", b"\xef\xbb\xbf<", b"\xff\xfe", b"\xfe\xff"))


def scan_xml(data: bytes) -> Scan:
    """Find all elements of an XML file and where they stand.

    Raises
    ------
    ReadError
        For what is not well-formed, and for a DOCTYPE: entities can blow a small file up, and none
        of the files read here need one.
    """
    parser = expat.ParserCreate()
    declared: list[str] = []
    document = Element("", {}, 0)
    open_elements = [document]
    # Tags, text and comments: each begins where the one before it ends.
    places: list[int] = []

    def place(*_: object) -> int:
        places.append(parser.CurrentByteIndex)
        return places[-1]

    def start(tag: str, attributes: dict[str, str]) -> None:
        element = Element(tag, attributes, place())
        open_elements[-1].children.append(element)
        open_elements.append(element)

    def end(_tag: str) -> None:
        open_elements.pop().foot = place()

    def doctype(*_: object) -> None:
        raise ReadError("the XML has a DOCTYPE; such files are not read")

    parser.StartElementHandler = start
    parser.EndElementHandler = end
    parser.StartDoctypeDeclHandler = doctype
    parser.XmlDeclHandler = lambda _version, encoding, _standalone: declared.append(encoding or "")
    parser.DefaultHandler = place
    try:
        parser.Parse(data, True)
    except expat.ExpatError as error:
        raise ReadError(f"no well-formed XML: {said(error)}") from None
    except (LookupError, ValueError) as error:
        raise ReadError(f"cannot decode the XML: {said(error)}") from None
    scan = Scan(data, _codec(data, declared[0] if declared else ""), document.children[0])
    places.append(len(data))
    for element in scan.root.walk():
        element.head_end = places[bisect_right(places, element.start)]
        is_whole = scan.text(element.start, element.head_end).endswith("/>")
        element.end = element.foot if is_whole else places[bisect_right(places, element.foot)]
    return scan


def _codec(data: bytes, declared: str) -> str:
    """Codec without a byte order mark, as slices have none."""
    if data.startswith((codecs.BOM_UTF16_LE, b"<\x00")):
        return "utf-16-le"
    if data.startswith((codecs.BOM_UTF16_BE, b"\x00<")):
        return "utf-16-be"
    return declared or "utf-8"


def with_attributes(tag: str, values: dict[str, str]) -> str:
    """Set attributes of a start tag; every other character of it stays.

    Parameters
    ----------
    tag
        The start tag as in the file, ``<origin xyz='0 0 0' />``.
    values
        New values, free of markup.
    """
    for name, value in values.items():
        spans = {m[1]: m.span(2) for m in _ATTRIBUTE.finditer(tag)}
        if name in spans:
            begin, stop = spans[name][0] + 1, spans[name][1] - 1
            tag = tag[:begin] + value + tag[stop:]
        else:
            bare = len(re.split(r"[\s/>]", tag, maxsplit=1)[0])
            last = max((stop for _, stop in spans.values()), default=bare)
            tag = f'{tag[:last]} {name}="{value}"{tag[last:]}'
    return tag
