"""HTML and SVG as trees, so that foreign text is always escaped: tags are never written as strings."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final
from xml.etree.ElementTree import Element, tostring

from crkr.protocol import printable

__all__ = ["Content", "Element", "card", "html", "label", "number", "table", "tag"]

Content = Element | str | None

_NAMES: Final = {"klass": "class", "for_": "for", "aria_label": "aria-label", "view_box": "viewBox", "tip": "data-tip"}


def tag(kind: str, /, *content: Content, **attributes: object) -> Element:
    """An element.

    Args:
        kind: Its tag.
        content: Elements and text in order; None is left out.
        attributes: By name, with "_" for "-"; None and False are left out, True is an attribute without a value.
    """
    element = Element(kind)
    for key, value in attributes.items():
        if value is not None and value is not False:
            text = (
                ""
                if value is True
                else f"{value:.6g}"
                if isinstance(value, float)
                else printable(str(value), keep="\n")
            )
            element.set(_NAMES.get(key, key.replace("_", "-")), text)
    last: Element | None = None
    for each in content:
        if isinstance(each, str):
            if last is None:
                element.text = (element.text or "") + printable(each)
            else:
                last.tail = (last.tail or "") + printable(each)
        elif each is not None:
            element.append(each)
            last = each
    return element


def html(element: Element) -> str:
    """The element as HTML; text and attributes are escaped, scripts and styles are written as they are."""
    return str(tostring(element, encoding="unicode", method="html"))


def card(identity: str, title: str, *content: Content, note: str = "", klass: str = "") -> Element:
    """A section of the page with a heading and, beneath it, a sentence that says how to read it."""
    about = tag("p", note, klass="note") if note else None
    return tag("section", tag("h2", title), about, *content, id=identity, klass=f"card {klass}".strip())


def table(head: Iterable[str], rows: Iterable[Iterable[Content]], klass: str = "") -> Element:
    """A table, which scrolls on a narrow screen."""
    top = tag("tr", *(tag("th", cell, scope="col") for cell in head))
    body = [tag("tr", *(tag("td", cell) for cell in row)) for row in rows]
    return tag("div", tag("table", tag("thead", top), tag("tbody", *body), klass=klass or None), klass="scroll")


def number(value: float, digits: int = 3) -> str:
    """A number for people: thousands apart by a thin space, a true minus, at most `digits` significant digits."""
    if value == int(value) and abs(value) < 1e15:
        text = f"{int(value):,}".replace(",", "\u202f")
    else:
        text = f"{value:.{digits}g}"
    return text.replace("-", "\u2212")


def label(name: str, unit: str) -> str:
    """An axis with its unit."""
    return f"{name} [{unit}]" if unit else name
