"""HTML and SVG that cannot be broken by what stands in it: text is escaped unless it is ``Markup`` already.

Entries come from anybody, so nothing of theirs may ever be pasted into a page as it is. The page is therefore put
together by ``element`` alone, which escapes every child that is not itself made by ``element``.
"""

from __future__ import annotations

import html
from collections.abc import Iterable

VOID = frozenset({"meta", "img", "br", "line", "path", "circle", "rect", "col"})
"""Elements without content; the SVG shapes among them are closed as ``<path/>``."""

Attribute = str | int | float | bool | None


class Markup(str):
    """Text that is markup already."""

    __slots__ = ()


Child = Markup | str | None


def escaped(child: Child) -> Markup:
    """A child as markup."""
    if isinstance(child, Markup):
        return child
    return Markup(html.escape(child or "", quote=True))


def joined(children: Iterable[Child]) -> Markup:
    """Children one after the other."""
    return Markup("".join(escaped(child) for child in children))


def element(name: str, /, *children: Child, **attributes: Attribute) -> Markup:
    """An element with its children.

    Args:
        name: Of the element.
        children: Escaped unless they are markup; None is nothing.
        attributes: ``class_`` stands for ``class``, ``aria_label`` for ``aria-label``. None and False leave one
            away, True writes its bare name.
    """
    words = [name]
    for key, value in attributes.items():
        if value is None or value is False:
            continue
        written = key.rstrip("_").replace("_", "-")
        words.append(written if value is True else f'{written}="{html.escape(_text(value), quote=True)}"')
    opened = " ".join(words)
    if name in VOID:
        return Markup(f"<{opened}/>")
    return Markup(f"<{opened}>{joined(children)}</{name}>")


def _text(value: str | int | float) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)
