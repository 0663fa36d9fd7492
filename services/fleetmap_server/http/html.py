"""HTML made of elements; whatever is not made here is text, and escaped."""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Sequence
from html import escape
from typing import TypeAlias

_VOID = frozenset({"meta", "input", "br", "link"})


class Html(str):
    """Text that is HTML already: made by ``element``, never of somebody's words."""

    __slots__ = ()


Child: TypeAlias = "str | int | Sequence[Child] | None"


def element(tag: str, *children: Child, **attributes: str | int | bool | None) -> Html:
    """``<tag attribute="...">children</tag>``, strings that are no Html escaped.

    A child may be a list of children. Attributes that are None or False are left out; ``class_`` stands for
    ``class``, and ``stroke_width`` for ``stroke-width``.
    """
    start = f"<{tag}{''.join(_attribute(name, value) for name, value in attributes.items())}>"
    return Html(start if tag in _VOID else f"{start}{''.join(map(_inner, children))}</{tag}>")


def document(title: str, style: str, *body: Child) -> Html:
    """A whole page that needs nothing else, and lets nothing else in; see ``content_security_policy``."""
    head = element(
        "head",
        element("meta", charset="utf-8"),
        element("meta", name="viewport", content="width=device-width, initial-scale=1"),
        element("meta", name="color-scheme", content="light dark"),
        element("link", rel="icon", href="data:,"),
        element("title", title),
        element("style", Html(style)),
    )
    return Html(f"<!DOCTYPE html>\n{element('html', head, element('body', *body), lang='en')}\n")


def content_security_policy(style: str) -> str:
    """No script, nothing from elsewhere, and this one style."""
    digest = base64.b64encode(hashlib.sha256(style.encode()).digest()).decode()
    return (
        f"default-src 'none'; style-src 'sha256-{digest}'; img-src data:; form-action 'self'; base-uri 'none'; "
        "frame-ancestors 'none'"
    )


def _attribute(name: str, value: str | int | bool | None) -> str:
    if value is None or value is False:
        return ""
    written = name.rstrip("_").replace("_", "-")
    return f" {written}" if value is True else f' {written}="{escape(str(value))}"'


def _inner(child: Child) -> str:
    if child is None:
        return ""
    if isinstance(child, Html):
        return child
    if isinstance(child, str | int):
        return escape(str(child))
    return "".join(map(_inner, child))
