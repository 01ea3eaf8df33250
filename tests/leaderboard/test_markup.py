from __future__ import annotations

from html.parser import HTMLParser

from hypothesis import given
from hypothesis import strategies as st

from leaderboard.markup import Markup, element


class Reader(HTMLParser):
    """What a browser would make of it."""

    def __init__(self, text: str) -> None:
        super().__init__(convert_charrefs=True)
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.said: list[str] = []
        self.feed(text)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))

    def handle_data(self, data: str) -> None:
        self.said.append(data)


anything = st.text(st.characters(exclude_categories=("Cs", "Cc")), max_size=40)


@given(text=anything, value=anything)
def test_whatever_stands_in_it_stays_text(text: str, value: str) -> None:
    read = Reader(element("p", text, element("b", text), title=value))

    assert [tag for tag, _ in read.tags] == ["p", "b"]
    assert read.tags[0][1] == {"title": value}
    assert "".join(read.said) == text + text


def test_markup_is_not_escaped_twice_and_nothing_is_left_away() -> None:
    made = element("td", element("b", "a & b"), None, class_="x", data_value=3, hidden=True, title=None, open=False)

    assert made == '<td class="x" data-value="3" hidden><b>a &amp; b</b></td>'
    assert element("img", src="s") == '<img src="s"/>'
    assert isinstance(made, Markup)
