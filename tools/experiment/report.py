"""The report: one HTML file with everything in it, and in words only what the numbers say."""

from __future__ import annotations

import base64
import html
import io
import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any, Final

from matplotlib.figure import Figure

from vibrissa.tools.experiment.analysis import EM_SETS, PRINTED_EM, Row
from vibrissa.tools.experiment.design import CONTACT_ANGLE, MAX_ANGLE, NOISE
from vibrissa.tools.experiment.figures import NAMES
from vibrissa.tools.experiment.statistics import geometric_mean

STYLE: Final = """
body { font: 15px/1.5 system-ui, sans-serif; max-width: 78em; margin: 2em auto; padding: 0 1em; }
table { border-collapse: collapse; font-size: 13px; margin: .6em 0 1.4em; }
td, th { padding: .15em .7em; text-align: right; border-bottom: 1px solid #ddd; }
td { white-space: nowrap; }
td:first-child, th:first-child, td.w, th.w { text-align: left; }
th { border-bottom: 2px solid #888; vertical-align: bottom; }
img { max-width: 100%; } figure { margin: 1em 0; } code { font-size: 90%; }
.yes { color: #1a7f37; } .no { color: #b42318; } .open { color: #666; }
.wide { overflow-x: auto; }
"""

SHORT: Final = {
    "arr": "ARR",
    "arcr": "ARCR",
    "arcr_and_not": "ARCR (and-not)",
    "returns": "returns",
    "right": "right",
    "earlier": "to earlier circuits",
    "earlier_right": "right",
    "templates": "templates",
    "experiences": "experiences",
}


def number(value: Any, digits: int = 3) -> str:
    """A number for a table cell."""
    if value is None or (isinstance(value, float) and not math.isfinite(value)):
        return "-"
    if isinstance(value, int) or abs(value) >= 1000:
        return f"{value:.0f}"
    return f"{value:.{digits}g}"


def spread(summary: Row) -> str:
    """Mean, with the standard deviation over seeds."""
    if not summary["n"]:
        return "-"
    return f"{number(summary['mean'])} &plusmn; {number(summary['sd'], 2)}"


def interval(summary: Row) -> str:
    """Mean difference and its bootstrap interval."""
    if not summary["n"]:
        return "-"
    sign = "+" if summary["mean"] > 0 else ""
    return f"{sign}{number(summary['mean'])} [{number(summary['low'])}, {number(summary['high'])}]"


def grid(head: Sequence[str], rows: Iterable[Sequence[str]], words: int = 1) -> str:
    """An HTML table; cells are HTML already. The first `words` columns hold text."""

    def cells(tag: str, row: Sequence[str]) -> str:
        return "".join(
            f"<{tag}{' class=w' if k < words else ''}>{cell}</{tag}>" for k, cell in enumerate(row)
        )

    body = "".join(f"<tr>{cells('td', row)}</tr>" for row in rows)
    top = cells("th", head)
    return f"<div class=wide><table><tr>{top}</tr>{body}</table></div>"


def picture(figure: Figure) -> str:
    """A figure as an image inside the page."""
    data = io.BytesIO()
    figure.savefig(data, format="png", dpi=110)
    code = base64.b64encode(data.getvalue()).decode("ascii")
    return f'<figure><img alt="" src="data:image/png;base64,{code}"></figure>'


def condition(row: Row) -> str:
    """A condition in words."""
    name = f"{NAMES[row['controller']]}, {NAMES[row['image']]}"
    return name if row["control"] == "none" else f"{name}: <b>{row['control']}</b>"


def score_tables(results: Row) -> str:
    """The main table: every ARR beside its controls, every EM beside its odometry's."""
    rows = [row for row in results["table"] if row["noise"] == NOISE]
    scores = list(SHORT)
    first = grid(
        ["", *(SHORT[s] for s in scores), "paper: ARR"],
        (
            [condition(r), *(spread(r["scores"][s]) for s in scores),
             number(r["paper"].get("arr"))]
            for r in rows
        ),
    )  # fmt: skip
    second = grid(
        ["", *(f"EM {name.replace('_', ', ')}" for name in EM_SETS), "paper: EM"],
        [
            line
            for r in rows
            for line in (
                [condition(r), *(spread(r["scores"][f"em_{n}"]) for n in EM_SETS),
                 number(r["paper"].get("em"))],
                ["&nbsp;&nbsp;its odometry",
                 *(spread(r["scores"][f"odo_{n}"]) for n in EM_SETS), ""],
            )
        ],
    )  # fmt: skip
    return first + second


def effect_table(results: Row) -> str:
    """The paper's comparisons under every noise."""
    colour = {"as in the paper": "yes", "opposite to the paper": "no"}
    return grid(
        ["comparison", "score", "noise", "paper says", "before", "after",
         "difference [95 %]", "seeds up / down", "here"],
        (
            [
                row["effect"],
                row["score"].replace("_", " "),
                row["noise"],
                "rises" if row["sign"] > 0 else "falls",
                number(row["a"]),
                number(row["b"]),
                interval(row),
                f"{row['up']} / {row['down']}",
                f"<span class={colour.get(row['reading'], 'open')}>{row['reading']}</span>",
            ]
            for row in results["effects"]
        ),
        words=3,
    )  # fmt: skip


def verdict(results: Row) -> str:
    """Where the paper's direction appears and where it does not, counted from the effect table."""
    lines = []
    for name in dict.fromkeys(row["effect"] for row in results["effects"]):
        for kind in ("arr", "em"):
            rows = [
                row
                for row in results["effects"]
                if row["effect"] == name and row["score"].startswith(kind)
            ]
            if not rows:
                continue
            says = "rises" if rows[0]["sign"] > 0 else "falls"
            parts = []
            for reading in ("as in the paper", "opposite to the paper", "not resolved"):
                these = [row for row in rows if row["reading"] == reading]
                if these:
                    where = ", ".join(
                        dict.fromkeys(
                            row["noise"]
                            if kind == "arr"
                            else f"{row['score'][3:].replace('_', ' ')} ({row['noise']})"
                            for row in these
                        )
                    )
                    parts.append(f"<b>{reading}</b> in {len(these)} of {len(rows)}: {where}")
            lines.append(f"<li>{name}: the paper's {kind.upper()} {says}. {'; '.join(parts)}.</li>")
    return f"<ul>{''.join(lines)}</ul>"


def odometry_words(results: Row) -> str:
    """How near RatSLAM comes to beating its own odometry, from the ratios alone."""
    sighted = [r for r in results["against_odometry"] if r["control"] == "none"]
    blind = [r for r in results["against_odometry"] if r["control"] == "blind"]
    if not sighted:
        return "<p>Only odometry without error was run; nothing can beat it.</p>"
    lines = []
    for name in EM_SETS:
        best = min(
            (r for r in sighted if r["ratios"][name]["runs"]),
            key=lambda r: r["ratios"][name]["ratio"],
            default=None,
        )
        if best is None:
            continue
        found = best["ratios"][name]
        same = [r["ratios"][name]["ratio"] for r in blind if r["noise"] == best["noise"]]
        lines.append(
            f"<li>{name.replace('_', ', ')}: nearest is {condition(best)} under noise "
            f"{best['noise']}, ratio {number(found['ratio'])}, below 1 in {found['wins']} of "
            f"{found['runs']} runs; blind under the same noise {number(geometric_mean(same))}.</li>"
        )
    return f"<ul>{''.join(lines)}</ul>"


def why(results: Row) -> str:
    """What stands between the map and its odometry, in numbers of these runs."""
    table = [row for row in results["table"] if row["noise"] == NOISE and row["control"] == "none"]

    def span(found: Iterable[float]) -> str:
        values = [v for v in found if v is not None and math.isfinite(v)]
        return f"{number(min(values))} to {number(max(values))}" if values else "-"

    def of(score: str) -> str:
        return span(row["scores"][score]["mean"] for row in table)

    steps = results["runs"][0]["steps"]
    shared = span(
        steps / row["scores"]["experiences"]["mean"]
        for row in table
        if row["scores"]["experiences"]["mean"]
    )
    far = ("whisk_all", "experience_all")
    below = {
        control: [
            row["noise"]
            for row in results["against_odometry"]
            if row["control"] == control and all(row["ratios"][n]["ratio"] < 1.0 for n in far)
        ]
        for control in ("none", "blind", "shuffled")
    }
    runs = {
        control: sum(row["control"] == control for row in results["against_odometry"])
        for control in below
    }
    counts = ", ".join(
        f"{len(below[c])} of {runs[c]} {name}"
        for c, name in (("none", "sighted"), ("blind", "blind"), ("shuffled", "shuffled"))
    )
    hits = span(row["top1"] for row in results["quality"] if "top1" in row)
    return (
        "<p>Why, under noise "
        f"{NOISE} over the conditions: a step's most similar image of the first circuit is of the "
        f"same place in only {hits} of the cases, so a single image can't be trusted; "
        f"{of('earlier')} of the steps return to an earlier circuit at all, {of('earlier_right')} "
        "of these rightly, and every wrong link bends the map as much as a right one mends it, "
        f"because all links weigh alike. An experience stands for {shared} whisks; the motion "
        "within it is lost, which neighbouring relations feel first. On far relations the ratio is "
        f"below 1 for {counts} conditions: where the blind ones win too, it is because a collapsed "
        "map is small, not because of touch.</p>"
    )


def odometry_table(results: Row) -> str:
    """Ratios of EM to the odometry's own."""
    return grid(
        ["", "noise", *(name.replace("_", ", ") for name in EM_SETS)],
        (
            [
                condition(row),
                row["noise"],
                *(
                    f"{number(r['ratio'])} ({r['wins']}/{r['runs']})"
                    for r in (row["ratios"][name] for name in EM_SETS)
                ),
            ]
            for row in results["against_odometry"]
        ),
        words=2,
    )


def side_table(results: Row) -> str:
    """What RCP changes in images, whiskers and returns."""
    return grid(
        ["of", "score", "open loop", "RCP", "difference [95 %]", "seeds up / down"],
        (
            [
                NAMES.get(row["of"], row["of"]),
                row["score"].replace("_", " "),
                number(row["open_loop"]),
                number(row["rcp"]),
                interval(row),
                f"{row['up']} / {row['down']}",
            ]
            for row in results["side_effects"]
        ),
        words=2,
    )


def figure4_table(results: Row) -> str:
    """Kidnap and reversal in numbers."""
    scores = ("arr", "arcr", "earlier", "earlier_right", "em_whisk_consecutive", PRINTED_EM,
              "em_whisk_all")  # fmt: skip
    head = ["image", "run", *(f"{s.replace('_', ' ')}" for s in scores)]
    rows = []
    for row in results["figure4"]:
        rows.append(
            [NAMES[row["image"]], row["behaviour"], *(spread(row[score]) for score in scores)]
        )
        if row["behaviour"] != "plain":
            changes = (row[f"{score}_change"] for score in scores)
            rows.append(
                [
                    "",
                    "&nbsp;&nbsp;change",
                    *(f"{interval(c)} {c['up']}/{c['down']}" for c in changes),
                ]
            )
    return grid(head, rows, words=2)


def sensitivity_table(results: Row) -> str:
    """Every variant: images, whiskers and SLAM."""
    scores = {
        "auc": "AUC",
        "same": "same place",
        "impingement_deg": "impingement, deg",
        "slips": "slips per whisk",
        "arr": "ARR",
        "earlier": "to earlier",
        "earlier_right": "right",
        "templates": "templates",
        PRINTED_EM: "EM exp. 20",
        "em_over_odometry": "EM / odometry, whisk 20",
    }
    return grid(
        ["varied", "value", "control", "image", *scores.values()],
        (
            [row["what"], row["value"], NAMES[row["controller"]] if row["controller"] in NAMES
             else row["controller"].replace("_", " "), NAMES[row["image"]],
             *(number(row[s]) for s in scores)]
            for row in results["sensitivity"]
        ),
        words=4,
    )  # fmt: skip


def tuning_table(results: Row) -> str:
    """The grid from which the working points were chosen."""
    chosen = results["working_points"]
    return grid(
        ["image", "threshold", "inject", "right returns to earlier circuits", "wrong ones", ""],
        (
            [
                NAMES[row["image"]],
                number(row["threshold"]),
                number(row["inject"]),
                number(row["earlier_right"]),
                number(row["earlier_wrong"]),
                "chosen"
                if chosen[row["image"]] == {k: row[k] for k in ("threshold", "inject")}
                else "",
            ]
            for row in results["tuning_grid"]
        ),
    )


def page(results: Row, figures: dict[str, Figure]) -> str:
    """The whole report. figures: by the names `2` to `7`, `odometry`, `sensitivity`."""
    shown: Callable[[str], str] = lambda name: picture(figures[name]) if name in figures else ""  # noqa: E731
    scale = results["scale"]
    timing = results["timing"]
    made_on = results["machine"]
    intro = (
        f"<p>{len(scale['seeds'])} seeds, circuits <code>{scale['sequence']}</code>, head speed "
        f"{1e3 * scale['speed']:g} mm per whisk, maze of 7 x 5 cells. Open loop and RCP are "
        "carried along the same path and meet the same sensor and odometry noise. Thresholds were "
        f"tuned on seeds {', '.join(map(str, scale['tuning_seeds']))}, not used for the result. "
        f"{timing['robot_s'] / 3600:.1f} hours of robot time in {timing['wall_s']:.0f} s on "
        f"{timing['jobs']} processes ({html.escape(str(made_on['cpu']))}).</p>"
        "<p>All constants of the simulated rig are guesses where the paper gives none. Every "
        "statement holds for this rig, this maze and these settings. Intervals are bootstrap over "
        "seeds, which with few seeds are too narrow; the counts of seeds up and down stand beside "
        "them. ARR rewards blindness, so every ARR stands beside its blind and shuffled control; "
        "EM depends on which relations are taken, so six readings stand side by side.</p>"
    )
    parts = [
        ("Where the paper's direction appears, and where it does not", verdict(results)),
        ("The paper's comparisons", effect_table(results)),
        ("Figure 6: open loop against RCP, max angle", shown("6")),
        ("Figure 7: open loop against RCP, contact angle", shown("7")),
        (f"All scores under odometry noise {NOISE}", score_tables(results)),
        ("What RCP does to images and whiskers", side_table(results)),
        ("RatSLAM against its own odometry", odometry_words(results) + why(results)
         + shown("odometry") + odometry_table(results)),
        ("Figure 2: the path", shown("2")),
        ("Figure 3: experiences", shown("3")),
        ("Figure 4: kidnapping and reversal", shown("4") + figure4_table(results)),
        ("Figure 5: maps by direction", shown("5")),
        ("Sensitivity", "<p>Two circuits, means over the first seeds; AUC compares circuit 2 with "
         "circuit 1.</p>" + shown("sensitivity") + sensitivity_table(results)
         if results["sensitivity"] else "<p>Not run in a quick look.</p>"),
        ("Tuning", tuning_table(results)),
    ]  # fmt: skip
    body = "".join(f"<h2>{title}</h2>{content}" for title, content in parts)
    return (
        "<!doctype html><html lang=en><meta charset=utf-8><title>vibrissa: the paper's experiment"
        f"</title><style>{STYLE}</style><h1>Whisker RatSLAM: open loop against RCP</h1>"
        f"{intro}{body}<h2>Terms</h2>{TERMS}</html>\n"
    )


TERMS: Final = (
    "<p><b>ARR</b>, <b>ARCR</b>: Experience Metric, Algorithm 1, line 25 read as &ldquo;or&rdquo; "
    "(and &ldquo;and-not&rdquo; where said), base set the first circuit, one step per whisk. "
    "<b>returns</b>: share of steps that enter a known experience; <b>right</b>: of those, within "
    "0.1 m and 25&deg; of where it was made; <b>to earlier circuits</b>: share of steps spent in "
    "an experience of an earlier circuit. <b>EM</b>: m&sup2; + rad&sup2;, by whisk (each whisk "
    "where its experience lies in the final map) or by experience (each once, where it was made); "
    "consecutive, 20 apart, or 20 000 pairs drawn from all. <b>blind</b>: all images zero; "
    "<b>shuffled</b>: images in another order. <b>AUC</b>: probability that the same place looks "
    "more alike than another. <b>impingement</b>: how far walls push a shaft back, deepest per "
    "whisk, mean over whiskers that touch; <b>slip</b>: a whisker snaps off a wall.</p>"
)

__all__ = ["CONTACT_ANGLE", "MAX_ANGLE", "page"]
