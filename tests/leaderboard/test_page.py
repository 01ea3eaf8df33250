"""The page as text: nothing of an entry becomes markup, nothing is fetched, the same entries make the same bytes."""

from __future__ import annotations

import base64
import copy
import hashlib
import itertools
import re
from collections import Counter
from collections.abc import Callable
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pytest

from dmotion_bench.errors import EntryInvalid
from dmotion_bench.scoring.references import published_results
from leaderboard import planners
from leaderboard.board import make_boards
from leaderboard.columns import number
from leaderboard.entry import Entry, published_entry
from leaderboard.gallery import LEFT_OUT, fitting_steps
from leaderboard.markup import VOID
from leaderboard.page import LARGEST, make_page
from leaderboard.paper import ADDRESS, label_count

from .conftest import controlled
from .test_markup import Reader

Changed = Callable[..., Entry]
HOSTILE = "</style></script><script>hacked()</script><img src=x onerror=hacked()>\"' onload=hacked() {{1}}"


class Nesting(HTMLParser):
    """Whether every element is closed where it should be."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.wrong: list[str] = []
        self.feed(text)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag not in VOID:
            self.wrong.append(tag)

    def handle_endtag(self, tag: str) -> None:
        if not self.open or self.open.pop() != tag:
            self.wrong.append(tag)


@pytest.fixture
def entries(sound: Entry, changed: Changed) -> list[Entry]:
    published = [published_entry(row, label_count(row.environment, row.labels)) for row in published_results()]
    return [sound, changed(run="cswm-s0", model="cswm", weights="1" * 64), *published]


def test_the_page_is_whole_and_says_what_is_in_it(entries: list[Entry]) -> None:
    page = make_page(entries)
    nesting, read = Nesting(page), Reader(page)

    assert (nesting.open, nesting.wrong) == ([], [])
    said = " ".join(read.said)
    for wanted in (
        "dmotion",
        "Yuan et al. 2021",
        "one-shot",
        "14.3",
        "copy the last frame",
        "Grid World",
        "Robot Push",
    ):
        assert wanted in said
    for hash_ in (entries[0].content["weights"], entries[0].content["dataset"]["fingerprint"]):
        assert hash_ in said
    assert len(page) < 5_000_000


def test_nothing_is_fetched_and_every_link_leads_somewhere(entries: list[Entry]) -> None:
    elsewhere = dict(entries[0].content) | {"dataset": entries[0].content["dataset"] | {"fingerprint": "2" * 64}}
    tags = Reader(make_page([*entries, Entry(elsewhere)])).tags  # published rows stand on both boards
    names = Counter(attributes["id"] for _, attributes in tags if "id" in attributes)
    files = {f"entries/{entry.slug}.json" for entry in (*entries, Entry(elsewhere))} | {"schema.json", ADDRESS}

    assert set(names.values()) == {1}
    for tag, attributes in tags:
        assert tag not in ("link", "iframe", "object", "embed", "base", "form")
        assert not any(name.startswith("on") or name == "style" for name in attributes)
        source, leads = attributes.get("src"), attributes.get("href")
        assert source is None or source.startswith("data:image/webp;base64,")
        assert leads is None or leads in files or leads.removeprefix("#") in names
        labelled = attributes.get("aria-labelledby")
        assert labelled is None or labelled in names
        assert tag != "img" or attributes.get("alt")


def test_boards_of_two_data_sets_of_one_name_have_links_that_differ(sound: Entry, changed: Changed) -> None:
    other = changed(dataset=sound.content["dataset"] | {"fingerprint": "2" * 64})
    own = sound.content["dataset"]["fingerprint"][:8]
    links = {name: target for target, name in re.findall(r'href="#(board-\d+)">([^<]+)<', make_page([sound, other]))}
    assert sorted(name.rpartition(" ")[2] for name in links) == sorted([own, "2" * 8])
    assert len(set(links.values())) == 2


def test_the_policy_allows_the_page_s_own_style_and_script_alone(entries: list[Entry]) -> None:
    page = make_page(entries)
    (policy,) = (a["content"] or "" for t, a in Reader(page).tags if a.get("http-equiv") == "Content-Security-Policy")

    for tag, name in (("style", "style-src"), ("script", "script-src")):
        (content,) = re.findall(rf"<{tag}>(.*?)</{tag}>", page, re.DOTALL)
        digest = base64.b64encode(hashlib.sha256(content.encode()).digest()).decode()
        assert f"{name} 'sha256-{digest}'" in policy
    assert policy.startswith("default-src 'none'")
    assert "unsafe" not in policy


def _everywhere(value: Any, names: bool = False) -> Any:
    """A content in which every text that may be anything is hostile."""
    if isinstance(value, str):
        return value if re.fullmatch(r"[0-9a-f]{64}|[A-Za-z0-9+/=]{60,}", value) else HOSTILE
    if isinstance(value, list):
        return [_everywhere(one) for one in value]
    if isinstance(value, dict):
        return {
            (HOSTILE if names and index == 0 else name): _everywhere(one)
            for index, (name, one) in enumerate(value.items())
        }
    return value


def _hostile(sound: Entry) -> Entry:
    fixed = ("format", "kind", "protocol", "figures", "by_episode")
    content = {name: value if name in fixed else _everywhere(value) for name, value in sound.content.items()}
    for name in ("versions", "remarks", "training", "reference"):
        content[name] = (
            dict(sound.content[name]) if name == "reference" else _everywhere(sound.content[name], names=True)
        )
    content["reference"] = {HOSTILE: content["reference"]["copy_last"]}
    content["settings"] |= {name: sound.content["settings"][name] for name in ("split", "protocol")}  # of few values
    return Entry(copy.deepcopy(content))


def test_text_of_an_entry_never_becomes_markup(sound: Entry) -> None:
    hostile = _hostile(sound)
    row = dict(published_entry(published_results()[0], 4).content)
    printed = Entry(row | {"model": HOSTILE, "environment": HOSTILE, "source": HOSTILE, "note": HOSTILE})

    page = make_page([hostile, printed])
    nesting, read = Nesting(page), Reader(page)

    assert (nesting.open, nesting.wrong) == ([], [])
    assert Counter(tag for tag, _ in read.tags)["script"] == 1
    assert not any(name.startswith("on") for _, attributes in read.tags for name in attributes)
    assert all((a.get("src") or "data:").startswith("data:") for _, a in read.tags)
    assert "hacked()" in " ".join(read.said)
    assert "<script>hacked" not in page


@pytest.mark.slow
def test_the_same_entries_make_the_same_page(entries: list[Entry]) -> None:
    assert make_page(entries) == make_page(list(entries))


@pytest.mark.slow
def test_pictures_give_way_before_the_page_grows_too_large(
    entries: list[Entry], monkeypatch: pytest.MonkeyPatch
) -> None:
    other = dict(entries[0].content) | {"dataset": entries[0].content["dataset"] | {"fingerprint": "2" * 64}}
    boards = make_boards([*entries, Entry(other)])
    small, large = sorted(fitting_steps([board], 10**9)[1] for board in boards if board.measured)
    whole = make_page([*entries, Entry(other)])
    monkeypatch.setattr("leaderboard.page.BUDGET", small)

    fewer = make_page([*entries, Entry(other)])
    monkeypatch.setattr("leaderboard.page.LARGEST", 1_000)
    none = make_page([*entries, Entry(other)])

    assert small < large
    counts = [page.count("<img") for page in (whole, fewer, none)]
    assert counts[0] > counts[1] > counts[2] == 0
    assert whole.count(LEFT_OUT) == 0
    assert re.findall(r"\d of 3 steps are left out", fewer)
    assert none.count(f"The pictures are {LEFT_OUT}") == 2


def test_each_board_has_its_first_picture_before_one_has_its_second(entries: list[Entry]) -> None:
    other = dict(entries[0].content) | {"dataset": entries[0].content["dataset"] | {"fingerprint": "2" * 64}}
    boards = [board for board in make_boards([*entries, Entry(other)]) if board.measured]
    sizes = [fitting_steps([board], 10**9)[1] for board in boards]
    first = [
        next(b for b in range(0, size + 100, 100) if any(fitting_steps([board], b)[0]))
        for board, size in zip(boards, sizes, strict=True)
    ]

    assert fitting_steps(boards, min(first) - 100) == ([0, 0], 0)
    counts, taken = fitting_steps(boards, sum(first))
    assert counts == [1, 1]
    assert taken <= sum(first)
    assert fitting_steps(boards, sum(sizes)) == ([3, 3], sum(sizes))


def test_the_published_page_has_pictures_and_is_no_larger_than_a_page_may_be() -> None:
    page = (Path(__file__).parents[2] / "docs/leaderboard/index.html").read_text()
    assert "What the models predict" in page
    assert "data:image/webp" in page
    assert len(page.encode()) <= LARGEST


def test_of_each_entry_the_page_says_what_is_not_as_usual(sound: Entry, changed: Changed) -> None:
    planned = sound.content["settings"] | {"control_objective": None, "control_set": []}
    alike = [changed(run=f"dmotion-s{seed}", seed=seed, weights=f"{seed}" * 64, settings=planned) for seed in (1, 2)]
    without = {name: value for name, value in planned.items() if name != "resamples"}
    other = changed(run="another", seed=7, weights="7" * 64, settings=without | {"horizon": 99})
    page = make_page([*alike, other])
    _, usual, *folded = page.split('<details class="provenance"')

    (settings,) = re.findall(r"<dt>settings</dt><dd>(.*?)</dd>", usual)
    assert settings.split(", ") == sorted(settings.split(", "))
    assert {"horizon 3", "precision float32", "resamples 200"} <= set(settings.split(", "))
    assert len(folded) == 3
    for entry, own in zip([*alike, other], sorted(folded, key=lambda text: "another" in text), strict=True):
        assert entry.content["weights"] in own
        assert f"entries/{entry.slug}.json" in own
        assert "dmbench leaderboard check " in own
        assert ("<dt>settings</dt><dd>horizon 99</dd>" in own) == (entry is other)
        assert ("<dt>without</dt><dd>resamples</dd>" in own) == (entry is other)
    assert "None" not in "".join(re.findall(r"<dd>.*?</dd>", page))
    assert "control objective" not in page


def test_the_page_does_not_depend_on_the_order_of_the_entries(sound: Entry, changed: Changed) -> None:
    """All have one name and seed, and two settings are as frequent."""
    entries = [
        changed(run="twice-s0", weights=hashed * 64, settings=sound.content["settings"] | {"horizon": horizon})
        for hashed, horizon in (("1", 3), ("2", 3), ("3", 99), ("4", 99))
    ]
    pages = {make_page(list(order)) for order in itertools.permutations(entries)}
    assert len(pages) == 1


def test_what_most_entries_were_trained_on_is_not_said_of_another_one(sound: Entry, changed: Changed) -> None:
    elsewhere = dict(sound.content["dataset"]) | {"trained_on": {"name": "far", "fingerprint": "f" * 64}}
    remarks = {"gain": "64 sequences"}
    alike = [
        changed(run=f"dmotion-s{seed}", seed=seed, weights=f"{seed}" * 64, dataset=elsewhere, remarks=remarks)
        for seed in (1, 2)
    ]
    page = make_page([*alike, changed(run="another", seed=7, weights="7" * 64, remarks={})])
    _, usual, *folded = page.split('<details class="provenance"')

    assert "<dt>trained on</dt>" in usual
    assert "<dt>gain</dt>" in usual
    for own in folded:
        assert ("<dt>without</dt><dd>trained on, gain</dd>" in own) == ("another" in own)


def test_the_page_says_which_command_fetches_the_samples_of_an_entry(sound: Entry) -> None:
    read = " ".join("".join(Reader(make_page([sound])).said).split())
    assert "The samples that the figures are made of are part of the run: dmbench share pull entries/NAME.json" in read


def test_a_picture_that_cannot_be_read_is_named_with_its_file(changed: Changed, sound: Entry) -> None:
    spoilt = changed(pictures=[dict(sound.pictures[0]) | {"predicted": "A" * 60}])

    with pytest.raises(EntryInvalid, match=rf"{spoilt.slug}\.json cannot be shown: a picture .* it is no PNG"):
        make_page([spoilt])


@pytest.mark.parametrize(("copied", "all_labels"), [(0.0, 0.1), (2.0, 0.0)])
def test_label_curves_without_any_error_to_compare_with_are_left_out_of_ratios(
    changed: Changed, sound: Entry, copied: float, all_labels: float
) -> None:
    """Of a data set in which nothing moves copying has no error; a model may have none, either."""

    def entry(labels: str, count: int, error: float) -> Entry:
        run = f"dmotion-grid_world-tiny-{labels.replace('%', 'pct')}-s0"
        reference = copy.deepcopy(sound.content["reference"])
        reference["copy_last"]["mse"]["mean"] = copied
        figures = dict(sound.figures) | {"mse": dict(sound.figures["mse"]) | {"mean": error}}
        asked = {"asked": labels, "given": {}, "total": count}
        return changed(run=run, labels=asked, figures=figures, reference=reference)

    page = make_page([entry("4", 4, 1.0), entry("16", 16, 0.5), entry("100%", 100, all_labels)])

    assert "Label efficiency, MSE" in page
    assert ("Worth of labels" in page) == (all_labels > 0)
    assert ("Label efficiency against copying" in page) == (copied > 0)


def test_the_page_says_what_each_model_is_and_of_which_figures_more_is_better(sound: Entry) -> None:
    page = make_page([sound])
    assert "<dt>dmotion</dt><dd>DMotion (Yuan et al. 2021): a forward model" in page
    assert "<dt>cswm</dt>" not in page
    assert "except for PSNR, SSIM, Agent IoU" in page


def test_small_print_says_what_it_is_of_and_compute_on_what(sound: Entry, changed: Changed) -> None:
    second = changed(
        run="dmotion-grid_world-tiny-s1", seed=1, weights="1" * 64, training={"seconds": 600, "device": "cuda:0"}
    )
    first = changed(training={"seconds": 50, "device": "cpu"})
    page = make_page([first, second])
    (row,) = re.findall(r"<tr class=\"measured\">.*?</tr>", page)
    (own,) = (one for one in make_boards([first, second])[0].rows if one.kind == "measured")
    value = own.figures["mse"]
    assert value.interval is not None

    low, high = (number(one) for one in value.interval)
    assert f"<small>95%: {low} to {high}</small><small>seeds: " in row
    assert "50 s CPU, 10 min GPU" in row
    assert "<small>one-shot: 1 each</small>" in row


def test_a_board_without_known_actions_shows_the_error_with_the_true_motion_and_no_heading_of_nothing(
    changed: Changed, sound: Entry
) -> None:
    figures = {"mse_true_motion": sound.figures["mse"]}
    bare = changed(figures=figures, by_episode={}, reference={"copy_last": figures}, pictures=[])
    page = make_page([bare])

    assert "MSE with the true motion" in page
    assert "when it is told the latent action of the true one" in page
    assert ">Curves<" not in page
    assert "MSE with the true motion" not in make_page([sound])


def test_control_has_a_table_and_a_chart_of_its_own(sound: Entry) -> None:
    page = make_page([controlled(sound, "far", 0.8), controlled(sound, "near", 0.3), sound])
    predictions, control = re.findall(r"<table class=\"standings\">.*?</table>", page, re.DOTALL)[:2]

    def names(table: str) -> list[str]:
        return re.findall(r"<tr[^>]*><th[^>]*><(?:a|span)[^>]*>([^<]*)", table)

    assert sorted(names(predictions)) == ["copy the last frame", "dmotion", "far", "near", "only the agent moves"]
    assert names(control) == ["true simulator as the model", "near", "far", "idle"]
    headings = re.findall(r"<th[^>]*scope=\"col\"[^>]*>([^<]*)", control)
    assert headings == [
        "Model",
        "Labels",
        *(f"Distance, {step} steps" for step in (50, 40, 10)),
        "Tasks solved",
        "Objects lost",
    ]
    assert "7 tasks: bring the objects" in page
    chart = re.search(r"<svg[^>]*aria-label=\"Control:.*?</svg>", page, re.DOTALL)
    assert chart is not None
    assert re.findall(r"class=\"name\"[^>]*>([^<]*)", chart[0]) == ["true simulator as the model", "idle"]


def test_control_by_a_planner_that_was_tuned_on_the_tasks_says_so_in_the_table_and_in_the_chart(
    sound: Entry, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = dict(controlled(sound, "near", 0.3).content)
    entry = Entry(made | {"settings": made["settings"] | {"control_code": "planner-1", "control_tasks": 7}})
    fingerprint = entry.content["dataset"]["fingerprint"]
    monkeypatch.setattr(planners, "_tuned_tasks", lambda: {"planner-1": {fingerprint: 7}})
    page = make_page([entry])
    assert ">Tuned here</th>" in page
    assert '<td data-value="yes">yes</td>' in page
    assert "near, tuned here, labels one-shot" in page
    monkeypatch.setattr(planners, "_tuned_tasks", lambda: {"planner-1": {}})
    page = make_page([entry])
    assert '<td data-value="no">no</td>' in page
    assert "near, labels one-shot" in page


def test_without_control_there_is_no_table_of_it(sound: Entry) -> None:
    page = make_page([sound])
    assert "<h3>Control</h3>" not in page
    assert page.count('<table class="standings">') == 1


@pytest.mark.slow
def test_several_demonstrations_are_a_point_over_labels_and_no_line_over_the_rollout(
    sound: Entry, changed: Callable[..., Entry]
) -> None:
    several = {"asked": "5-shot", "given": {"demonstrations": 20}, "total": 20}
    five = changed(labels=several, weights="1" * 64, run="five")

    def charts(entries: list[Entry]) -> tuple[str, str]:
        page = make_page(entries)
        found = [
            re.search(rf"<svg[^>]*aria-label=\"{kind}:.*?</svg>", page, re.DOTALL)
            for kind in ("Label efficiency, MSE", "Error over the rollout")
        ]
        assert found[0] is not None
        assert found[1] is not None
        return found[0][0], found[1][0]

    labels, rollout = charts([sound, five])
    assert "5-shot" in labels
    assert "one-shot" in rollout
    assert "5-shot" not in rollout
    assert "5-shot" in charts([five])[1]
