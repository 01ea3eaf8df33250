"""Reports as tables for the terminal: one run with all its figures, or many runs with one row each."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dmotion_bench.cli.tables import show_figures, stdout_console
from dmotion_bench.figure_intervals import interval_words, mean_and_spread
from dmotion_bench.figure_words import figure_words
from dmotion_bench.wording import from_to, printable, rounded

if TYPE_CHECKING:
    from dmotion_bench.scoring.report import FigureJson, Report

SHOWN_AHEAD = (1, 2, 5, 10, 15)
"""Steps of a rollout that a table shows, besides the last; the report has all steps."""

FACTORS = {
    "action": "action",
    "agent_motion": "agent's motion",
    "agent_place": "agent's place",
    "camera": "camera's motion",
    "background": "background's motion",
    "movers": "movers' motion",
}
"""What probes read from a latent action; it should hold the first two."""
HELD = ("action", "agent_motion")
PROBE_COLUMNS = ("probe_linear", "probe_linear_shuffled", "probe_mlp", "probe_mlp_shuffled")

CONTROL_STEPS = (10, 20, 40, 60, 80, 100)
"""Steps of control that a table shows, besides the last; the report has all steps."""

ROLLOUT = "rollout_"
DISTANCES = ("control_distance", "control_picture_distance")

BESIDE = ("paper", "copy_last", "agent_moves", "idle", "random", "scripted", "oracle")
OVERVIEW = ("mse", "mse_push", "position_error_paper", "position_error", "miss_rate")


def show_report(report: Report, run: Path) -> None:
    """Print all main figures of one run beside those of its references; ``run`` is the run's folder."""
    beside = [name for name in BESIDE if name in report.reference]
    rows: list[tuple[str, ...]] = []
    for name in _shown(report.figures):
        figure = report.figures[name]
        others = [_mean_std(name, report.reference[other].get(name), short=other != "paper") for other in beside]
        counts = [_count(figure.get(name)) for name in ("n", "episodes")]
        rows.append((figure_words(name), _mean_std(name, figure), interval_words(name, figure), *counts, *others))
    headings = ("figure", "mean ± std", "95% interval", "n", "episodes", *map(_plain, beside))
    show_figures(_headline(report), headings, rows)
    _show_probes(report)
    console = stdout_console()
    _say_why_no_interval(report.figures.values())
    for name in (
        *beside,
        "contract",
        "labels",
        "trained_on",
        "actions",
        "positions",
        "gain",
        "control",
        "rollout",
        "split",
    ):
        if name in report.remarks:
            console.print(printable(f"  {_plain(name)}: {report.remarks[name]}"))
    if others := [f"{name} {version}" for name, version in report.versions.items() if name.endswith(")")]:
        console.print(printable(f"  scored earlier, with other versions: {', '.join(others)}"))
    console.print(
        printable(f"  labels used: {report.labels['total']}; all figures and samples in {run / report.place}/")
    )


def _say_why_no_interval(figures: Iterable[FigureJson]) -> None:
    from dmotion_bench.api.scoring import why_no_interval

    if (why := why_no_interval(figures)) is not None:
        stdout_console().print(printable(f"  95% interval: {why}"))


def _plain(name: str) -> str:
    return name.replace("_", " ")


def _count(count: float | None) -> str:
    return "" if count is None else f"{count:,.0f}"


def _show_probes(report: Report) -> None:
    """Print what probes read from the latent action beside what they read of shuffled values, if any was asked."""
    rows: list[tuple[str, ...]] = []
    for factor, words in FACTORS.items():
        found = [report.figures.get(f"{column}[{factor}]") for column in PROBE_COLUMNS]
        cells = [
            _share(figure) + ("" if name.endswith("shuffled") else _share_interval(figure))
            for name, figure in zip(PROBE_COLUMNS, found, strict=True)
            if figure is not None
        ]
        if cells:
            rows.append((words + " (wanted)" * (factor in HELD), *cells))
    if rows:
        headings = ("factor", "linear probe (95%)", "chance", "network (95%)", "chance")
        show_figures("What probes read from the latent action: accuracy of named actions, else R²", headings, rows)


def show_control(figures: Mapping[str, Mapping[str, FigureJson]], title: str) -> None:
    """Print the control figures of some references, one column each."""
    headings = [heading for name in figures for heading in (name, "95% interval")]
    everything = list(dict.fromkeys(figure for one in figures.values() for figure in one))
    rows: list[tuple[str, ...]] = []
    shown = set(_shown(everything))
    for figure in everything:
        if figure in shown or figure == everything[-1]:
            pairs = [
                (_mean_std(figure, one[figure]), interval_words(figure, one[figure])) if figure in one else ("", "")
                for one in figures.values()
            ]
            rows.append((figure_words(figure), *(cell for pair in pairs for cell in pair)))
    show_figures(title, ("figure", *headings), rows)
    _say_why_no_interval(figure for one in figures.values() for figure in one.values())


def show_overview(reports: Mapping[Path, Report]) -> None:
    """Print one row for each run, sorted by data set and MSE; references and the paper's results stand below."""
    for board in _boards(reports).values():
        _show_board(board)


def _show_board(reports: Mapping[Path, Report]) -> None:
    paths = sorted(reports, key=lambda path: ("contract" in reports[path].remarks, _mse(reports[path])))
    here = [reports[path] for path in paths]
    furthest = f"rollout_mse[{max(report.settings['horizon'] for report in here)}]"
    every = [name for report in here for name in report.figures]
    columns = [*OVERVIEW, furthest, "planning_gain"]
    columns += [f"{begin}[{last}]" for begin in DISTANCES if (last := _last_step(every, f"{begin}["))]
    shown = [name for name in columns if any(name in report.figures for report in here)]
    shown = shown or ["mse_true_motion"]  # all there is where actions are not known
    behind = _behind(paths, here) if "mse" in shown else {}
    headings = ["run", "labels"]
    for name in shown:
        headings += [figure_words(name)] + ["MSE above the best, 95%"] * (name == "mse" and bool(behind))
    rows: list[tuple[str, ...]] = []
    for path, report in zip(paths, here, strict=True):
        use = f", {report.labels['use']}" if "use" in report.labels else ""
        labels = f"{report.labels['asked']} ({report.labels['total']}{use})"
        notes = [f"trained on {report.trained_on}"] if report.trained_on is not None else []
        notes += ["breaks the contract"] if "contract" in report.remarks else []
        run = f"{report.run} ({', '.join(notes)})" if notes else report.run
        rows.append((run, labels, *_row(report.figures, shown, behind.get(path, "") if behind else None)))
        if "paper" in report.reference:
            paper = _row(report.reference["paper"], shown, "" if behind else None)
            rows.append((f"  {report.model} in the paper", "", *paper))
    known = [name for name in ("agent_moves", "copy_last") if name in here[0].reference]
    rows += [(_plain(name), "", *_row(here[0].reference[name], shown, "" if behind else None)) for name in known]
    title = f"{here[0].dataset['name']}, {here[0].settings['split']} episodes"
    show_figures(title, headings, rows, below=len(known))


def _boards(reports: Mapping[Path, Report]) -> dict[tuple[str, ...], dict[Path, Report]]:
    """The reports that were scored on the same triplets."""
    found: dict[tuple[str, ...], dict[Path, Report]] = defaultdict(dict)
    for path, report in reports.items():
        found[report.dataset["name"], *report.frames][path] = report
    return dict(found)


def _behind(paths: Sequence[Path], reports: Sequence[Report]) -> dict[Path, str]:
    """How much higher each run's MSE is than the first run's on the same triplets; empty if a run has no samples."""
    from dmotion_bench.api.scoring import behind, read_report_samples, standing_words

    samples = {
        path: found
        for path, report in zip(paths, reports, strict=True)
        if "mse" in report.figures and (found := read_report_samples(path / report.place, report)) is not None
    }
    if len(samples) < 2 or paths[0] not in samples:
        return {}
    told = {paths[0]: "best"}
    for path in paths[1:]:
        difference = behind(samples[path], samples[paths[0]]) if path in samples else None
        if difference is not None:
            above, between = f"+{rounded(difference.mean)}", from_to(difference.low, difference.high)
            told[path] = standing_words(difference, above, between)
    return told


def show_differences(
    differences: Sequence[Any], first: str, second: str, over: str = "episodes", *, everything: bool = False
) -> None:
    """Print two models' figures, their paired difference, and which is better if the interval excludes zero.

    Args:
        differences: Of each figure.
        first, second: The models' names.
        over: What the intervals are over.
        everything: Whether to show every figure, not only the main ones.
    """
    rows: list[tuple[str, ...]] = []
    shown = set(_shown([one.figure for one in differences]))
    for one in differences:
        if everything or one.figure in shown:
            apart = one.difference
            between = from_to(apart.low, apart.high)
            values = (rounded(one.first), rounded(one.second), rounded(apart.mean), between)
            rows.append((figure_words(one.figure), *values, one.verdict))
    headings = ("figure", "first", "second", "first - second", "95% interval", "better")
    show_figures(f"{first} against {second}, on the same held-out frames; intervals over {over}", headings, rows)


def _headline(report: Report) -> str:
    arch = "" if report.arch == "compact" else f" ({report.arch})"
    own = "" if report.trained_on is None else f" (trained on {report.trained_on})"
    return f"{report.run}: {report.model}{arch} on {report.dataset['name']}{own}, {report.settings['split']} episodes"


def _shown(names: Iterable[str]) -> list[str]:
    """The figures that a table shows; of rollouts and of control some steps and the last one."""
    every = list(names)
    lasts = {begin: _last_step(every, begin) for begin in (ROLLOUT, *DISTANCES)}
    return [name for name in every if _is_shown(name, lasts)]


def _last_step(names: Iterable[str], begin: str) -> int:
    """The last step that there is a figure of; 0 without any."""
    return max((_step(name) for name in names if name.startswith(begin) and name.endswith("]")), default=0)


def _step(name: str) -> int:
    return int(name.rpartition("[")[2].rstrip("]"))


def _is_shown(name: str, lasts: Mapping[str, int]) -> bool:
    if "_objects" in name or name.startswith(("rollout_position_error_paper", "probe_")):
        return False
    begin = next((begin for begin in lasts if name.startswith(begin)), None)
    if begin is None:
        return True
    return _step(name) in (*(SHOWN_AHEAD if begin == ROLLOUT else CONTROL_STEPS), lasts[begin])


def _mse(report: Report) -> float:
    figure = report.figures.get("mse")
    return float("inf") if figure is None or figure["mean"] is None else figure["mean"]


def _row(figures: Mapping[str, FigureJson], shown: Iterable[str], behind: str | None) -> list[str]:
    """The cells of a row: the figures and, if there is such a column, the distance from the best MSE."""
    cells: list[str] = []
    for name in shown:
        cells.append(_mean_std(name, figures.get(name)))
        if name == "mse" and behind is not None:
            cells.append(behind)
    return cells


def _mean_std(name: str, figure: FigureJson | None, *, short: bool = False) -> str:
    if figure is None:
        return ""
    return rounded(figure["mean"]) if short else mean_and_spread(name, figure)


def _share(figure: FigureJson) -> str:
    return "" if figure["mean"] is None else f"{figure['mean']:.2f}"


def _share_interval(figure: FigureJson) -> str:
    return "" if figure["low"] is None else f" ({figure['low']:.2f} to {figure['high']:.2f})"
