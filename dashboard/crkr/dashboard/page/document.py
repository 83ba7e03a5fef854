"""The whole page: one file without dependencies, which runs only its own two scripts."""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Sequence
from functools import cache
from importlib.metadata import version
from importlib.resources import files

from crkr.dashboard.page.markup import Element, html, tag

__all__ = ["document", "policy", "task_list"]


@cache
def _asset(name: str) -> str:
    return "\n" + (files("crkr.dashboard.page") / name).read_text(encoding="utf-8")


def policy(*, live: bool) -> str:
    """The content security policy: scripts and styles by their hashes, nothing from elsewhere."""
    styles, scripts = (
        " ".join(f"'sha256-{_digest(_asset(name))}'" for name in names)
        for names in (("page.css",), ("page.js", "film.js"))
    )
    reach = "'self'" if live else "'none'"
    return (
        f"default-src 'none'; style-src {styles}; script-src {scripts}; connect-src {reach}; img-src data:; "
        "base-uri 'none'; form-action 'none'"
    )


def _digest(text: str) -> str:
    return base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()


def document(title: str, parts: Sequence[Element], footer: str, source: str | None = None) -> str:
    """The page as HTML.

    Args:
        title: The window's title.
        parts: The header, then the sections.
        footer: A line beneath them.
        source: Where a live page fetches updates; None for a static page.
    """
    head, *shown = parts
    lost = tag("span", "connection lost, trying again", id="lost", klass="pill off", hidden=True)
    return _whole(
        title,
        tag("header", head, lost if source else None),
        tag("main", tag("div", *shown, id="sections", klass="sections")),
        tag("footer", f"{footer} Made by crkr {version('crkr')}."),
        source=source,
    )


def task_list(names: Sequence[str], more: str | None) -> str:
    """A page of links to the pages of tasks; `more` is the address of the next one."""
    links = [tag("li", tag("a", name, href=f"task/{name}")) for name in names]
    listed = tag("ul", *links, klass="tasks") if links else tag("p", "No task yet.", klass="empty")
    following = tag("p", tag("a", "more", href=more)) if more else None
    return _whole("crkr", tag("header", tag("h1", "Tasks")), tag("main", listed, following), source=None, live=True)


def _whole(title: str, *content: Element, source: str | None, live: bool = False) -> str:
    head = tag(
        "head",
        tag("meta", charset="utf-8"),
        tag("meta", name="viewport", content="width=device-width, initial-scale=1"),
        _policy_tag(live=live or source is not None),
        tag("meta", name="referrer", content="no-referrer"),
        tag("title", f"{title} \u2013 crkr" if title != "crkr" else title),
        _inline("style", "page.css"),
    )
    scripts = [_inline("script", name) for name in ("page.js", "film.js")]
    body = tag("body", *content, *scripts, data_live=source)
    return "<!doctype html>\n" + html(tag("html", head, body, lang="en"))


def _policy_tag(*, live: bool) -> Element:
    element = tag("meta", content=policy(live=live))
    element.set("http-equiv", "Content-Security-Policy")
    return element


def _inline(kind: str, name: str) -> Element:
    element = tag(kind)
    element.text = _asset(name)
    return element
